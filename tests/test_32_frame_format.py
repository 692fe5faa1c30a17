"""Frames of data symbols: fields, check sum, and frame errors by symbol errors."""

import numpy as np
import pytest
from own_campaign import crc16, frame

from apertura.core.echo.constellation import constellation
from apertura.core.echo.frame_format import FrameFormat

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
    """Eq. 15: frames of 128 QPSK symbols, within four standard deviations."""
    qam, random, count, symbols = constellation("qpsk"), np.random.default_rng(4), 3000, 128
    frames = FrameFormat(HEADER, 16, True, symbols * qam.bits_per_symbol)
    bits = frames.bits(np.arange(count), random.integers(0, 2, (count, frames.data_bits), np.uint8))
    noise = random.normal(scale=np.sqrt(0.5 / 10 ** (snr_db / 10)), size=(count, symbols, 2)) @ [1, 1j]
    received = frames.parsed(qam.bits(qam.decide(qam.symbols(bits) + noise)))
    expected = 1 - (1 - float(qam.symbol_error_rate(10 ** (snr_db / 10)))) ** symbols
    assert np.mean(~received.intact) == pytest.approx(expected, abs=4 * np.sqrt(expected / count))
