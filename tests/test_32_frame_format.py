"""Frames of data symbols: fields, check sum, and frame errors by symbol errors."""

import numpy as np
import pytest
from own_campaign import crc16, frame

from apertura.core.echo.constellation import constellation
from apertura.core.echo.frame_format import FrameCount, FrameFormat

HEADER = np.unpackbits(np.frombuffer(bytes.fromhex("1acffc1d"), np.uint8))


def test_check_sum_is_that_of_the_standard():
    """The check sum of the text 123456789 is 0x29b1, as in catalogues of CRC-16; a wrong bit anywhere is detected."""
    text = np.unpackbits(np.frombuffer(b"123456789", np.uint8))
    frames = FrameFormat(HEADER[:0], 8, True, 88)
    bits = frames.bits(np.array([text[:8] @ (1 << np.arange(7, -1, -1))]), text[None, 8:])
    assert np.packbits(bits[0, -16:]).tobytes().hex() == "29b1"
    assert crc16(text.tolist()) == bits[0, -16:].tolist()
    wrong = np.repeat(bits, 88, axis=0) ^ np.eye(88, dtype=np.uint8)
    assert not frames.parsed(wrong).intact.any()


def test_frames_of_other_code_are_parsed():
    """Fields written by a loop over bits are read; frames without check sum are intact by their header."""
    data = np.random.default_rng(1).integers(0, 2, (3, 64))
    bits = np.array([frame(counter, row) for counter, row in zip((7, 300, 65535), data, strict=True)])
    frames = FrameFormat(HEADER, 16, True, bits.shape[1])
    parsed = frames.parsed(bits)
    assert parsed.intact.all()
    assert parsed.counter.tolist() == [7, 300, 65535]
    assert np.array_equal(parsed.data, data)
    assert np.array_equal(frames.bits(parsed.counter, parsed.data), bits)
    bits[1, 5] ^= 1
    unchecked = FrameFormat(HEADER, 16, False, bits.shape[1]).parsed(bits)
    assert unchecked.intact.tolist() == [True, False, True]
    assert unchecked.header_errors.tolist() == [0, 1, 0]


@pytest.mark.parametrize("snr_db", [9.0, 11.0])
def test_frame_errors_follow_from_the_symbol_error_rate(snr_db):
    """Eq. 16: frames of 128 QPSK symbols, within four standard deviations."""
    qam, random, count, symbols = constellation("qpsk"), np.random.default_rng(4), 3000, 128
    frames = FrameFormat(HEADER, 16, True, symbols * qam.bits_per_symbol)
    bits = frames.bits(np.arange(count), random.integers(0, 2, (count, frames.data_bits), np.uint8))
    noise = random.normal(scale=np.sqrt(0.5 / 10 ** (snr_db / 10)), size=(count, symbols, 2)) @ [1, 1j]
    received = frames.parsed(qam.bits(qam.decide(qam.symbols(bits) + noise)))
    expected = 1 - (1 - float(qam.symbol_error_rate(10 ** (snr_db / 10)))) ** symbols
    assert np.mean(~received.intact) == pytest.approx(expected, abs=4 * np.sqrt(expected / count))


def recorded(kept, *, bits=4, count=60, prf_hz=20.0):
    """Return counter, intact and time tags of the recorded ones of `count` frames, with time jitter."""
    number, jitter_s = np.arange(count)[kept], np.random.default_rng(2).uniform(-0.01, 0.01, count)[kept]
    return (number + 5) % (1 << bits), np.ones(number.size, bool), number / prf_hz + jitter_s


def test_sent_frames_are_counted_across_gaps_longer_than_the_period_of_the_counter():
    """Eq. 17: of 60 frames with a counter of 4 bits, 25 in a row are missing."""
    counter, intact, time_s = recorded(np.r_[0:20, 45:60])
    count = FrameCount.of(counter, intact, time_s, prf_hz=20.0, bits=4)
    assert (count.sent, count.steps, count.agreeing) == (60, 34, 34)
    counter[3], intact[7] = 1, False  # a wrong counter disagrees in the steps before and after it
    count = FrameCount.of(counter, intact, time_s, prf_hz=20.0, bits=4)
    assert (count.sent, count.steps, count.agreeing) == (60, 33, 31)


def test_frames_that_the_transmitter_omitted_are_not_sent():
    """The counter stands still for 10 intervals in which nothing is sent: 50 frames in 60 intervals."""
    counter, intact, time_s = recorded(np.r_[0:20, 30:60], bits=8)
    counter[20:] -= 10
    count = FrameCount.of(counter, intact, time_s, prf_hz=20.0, bits=8)
    assert (count.sent, count.steps, count.agreeing) == (50, 49, 48)


def test_counter_of_the_wrong_length_does_not_count_frames():
    """8 data bits behind a counter of 16 bits: the number advances by 256 on average; time tags count the frames."""
    counter, intact, time_s = recorded(slice(None), bits=16)
    counter = 256 * counter + np.random.default_rng(3).integers(0, 256, counter.size)
    count = FrameCount.of(counter, intact, time_s, prf_hz=20.0, bits=24)
    assert (count.sent, count.agreeing) == (60, 0)
    assert count.advance == pytest.approx(256, abs=64)
