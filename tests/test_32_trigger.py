"""Triggering on a preamble in a continuous recording: detections, misses and false alarms."""

import tracemalloc

import numpy as np
import pytest
from scipy.signal import max_len_seq
from scipy.stats import ncx2

from apertura.core.echo.trigger import PulseFraming, find_preambles, score_threshold

RATE_HZ = 100e6
SYMBOL = 1600
CHIPS = 2 * max_len_seq(8)[0].astype(np.int64) - 1
FRAMING = PulseFraming(CHIPS, 4, 20e6, RATE_HZ, counter_bits=8, bit_chips=7, guard_samples=64)
SIGMA = 100.0  # noise of I and of Q, ADC counts
ALARMS_PER_S = 1e-3


def frame(number, rng):
    """Return preamble, payload, guard and a noise-like symbol of unit power."""
    bits = [(number >> place) & 1 for place in reversed(range(FRAMING.counter_bits))]
    payload = np.repeat([2 * bit - 1 for bit in bits] + [1 - 2 * bit for bit in bits], FRAMING.bit_chips)
    keyed = np.repeat(np.concatenate([CHIPS, payload]), FRAMING.chip_samples)
    keyed = keyed * np.exp(2j * np.pi * FRAMING.centre_hz / RATE_HZ * np.arange(keyed.size))
    spectrum = np.where(np.arange(SYMBOL) < 0.4 * SYMBOL, np.exp(2j * np.pi * rng.random(SYMBOL)), 0)
    symbol = np.fft.ifft(spectrum) * np.sqrt(SYMBOL / 0.4)
    return np.concatenate([keyed, np.zeros(FRAMING.guard_samples), symbol])


def record(starts, snr_db, total, rng, *, sigma=SIGMA, cfo_hz=0.0):
    """Return (sample, 2) int16 with a frame of `snr_db` per sample at each start, numbered from 200."""
    iq = sigma * (rng.normal(size=total) + 1j * rng.normal(size=total))
    for number, start in enumerate(starts):
        sent = frame(200 + number, rng) * np.exp(
            2j * np.pi * (rng.random() - cfo_hz / RATE_HZ * np.arange(4000)[: len(frame(0, rng))])
        )
        iq[start : start + sent.size] += sent * sigma * np.sqrt(2) * 10 ** (snr_db / 20)
    return np.stack([iq.real, iq.imag], -1).round().astype(np.int16)


def find(recording, *, block=50_000, false_alarms_per_s=ALARMS_PER_S):
    blocks = (recording[i : i + block] for i in range(0, len(recording), block))
    return list(find_preambles(blocks, FRAMING, symbol_samples=SYMBOL, false_alarms_per_s=false_alarms_per_s))


@pytest.mark.parametrize("snr_db", [-10, 10, 30])
@pytest.mark.parametrize("block", [333, 50_000, 10**9])
def test_preambles_are_located_for_any_block_size(snr_db, block):
    rng = np.random.default_rng(1)
    starts = 70_000 * np.arange(4) + rng.integers(10, 60_000, 4)
    detections = find(record(starts, snr_db, 300_000, rng), block=block)
    assert [detection.sample for detection in detections] == pytest.approx(starts, abs=0 if snr_db > -10 else 1)
    assert np.mean([detection.snr_db for detection in detections]) == pytest.approx(snr_db, abs=1)


def test_preamble_across_two_transforms_is_detected():
    rng = np.random.default_rng(2)
    step = 2**16 - (FRAMING.template().size - 1)  # positions decided by one transform
    starts = [step, 2 * step - 1, 3 * step + 3]
    assert [detection.sample for detection in find(record(starts, 20, 250_000, rng))] == starts


def test_clock_offset_of_10_khz_does_not_hide_a_preamble():
    starts = [4000]
    detections = find(record(starts, -12, 20_000, np.random.default_rng(3), cfo_hz=10e3))
    assert [detection.sample for detection in detections] == pytest.approx(starts, abs=1)


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [3.0, 1000.0])
def test_noise_triggers_at_the_configured_rate_at_any_level(sigma):
    rng = np.random.default_rng(4)
    samples = 4_000_000
    alarms_per_s = 2e-5 * RATE_HZ  # one in 50 000 samples, so that 80 are expected
    detections = find(record([], 0, samples, rng, sigma=sigma), false_alarms_per_s=alarms_per_s)
    expected = alarms_per_s * samples / RATE_HZ
    # neighbouring samples alarm together and a frame of dead time follows: the rate is below the configured rate
    assert 0.6 * expected < len(detections) < expected + 2 * np.sqrt(expected)


def theory(snr_db, false_alarm):
    """Return the probability that |Σ template*·x|² exceeds the threshold: noncentral χ² with two degrees of freedom."""
    length, ratio = FRAMING.template().size, 10 ** (snr_db / 10)
    threshold = score_threshold(length, false_alarm) * (length * (1 + ratio))
    return ncx2.sf(2 * threshold, 2, 2 * length * ratio)


@pytest.mark.quick("-13.0")
@pytest.mark.parametrize("snr_db", [-17.5, -16.0, -15.0, -13.0])
def test_detection_probability_matches_theory(snr_db):
    rng = np.random.default_rng(5)
    trials = 300
    starts = 5000 * np.arange(trials) + rng.integers(100, 1000, trials)
    detections = [detection.sample for detection in find(record(starts, snr_db, 5000 * trials, rng))]
    hits = np.sum(np.min(np.abs(starts[:, None] - np.array(detections)[None]), axis=1, initial=10**6) <= 2)
    expected = theory(snr_db, ALARMS_PER_S / RATE_HZ)
    assert hits / trials == pytest.approx(expected, abs=3 * np.sqrt(expected * (1 - expected) / trials) + 0.02)
    assert hits >= 0.99 * trials or snr_db < -13


def test_symbol_after_a_preamble_does_not_trigger():
    rng = np.random.default_rng(6)
    starts = 8000 * np.arange(30) + 100
    detections = find(record(starts, 25, 8000 * 31, rng), false_alarms_per_s=1e-5 * RATE_HZ)
    after = [(detection.sample - 100) % 8000 for detection in detections]
    assert not [place for place in after if 0 < place < FRAMING.lead_samples + SYMBOL]
    assert set(starts) <= {detection.sample for detection in detections}


def test_frame_counter_is_read_and_wraps():
    rng = np.random.default_rng(7)
    starts = 6000 * np.arange(80) + 50
    recording = record(starts, 5, 6000 * 81, rng, cfo_hz=5e3)
    numbers = [FRAMING.read_counter(recording[detection.sample :]) for detection in find(recording)]
    assert numbers == [(200 + i) % 256 for i in range(80)]


def test_counter_in_noise_is_absent_rather_than_wrong():
    rng = np.random.default_rng(8)
    starts = 6000 * np.arange(80) + 50
    recording = record(starts, -15, 6000 * 81, rng)
    numbers = np.array([FRAMING.read_counter(recording[start:]) for start in starts])
    truth = (200 + np.arange(80)) % 256
    assert (numbers == -1).sum() > 20
    assert ((numbers != -1) & (numbers != truth)).sum() <= 1
    assert FRAMING.read_counter(np.zeros((4000, 2), np.int16)) == -1


def test_memory_does_not_grow_with_the_recording():
    def peak(blocks):
        rng = np.random.default_rng(9)
        stream = (rng.integers(-300, 300, (50_000, 2), dtype=np.int16) for _ in range(blocks))
        tracemalloc.start()
        for _ in find_preambles(stream, FRAMING, symbol_samples=SYMBOL, false_alarms_per_s=ALARMS_PER_S):
            pass
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return used

    peak(4)
    assert peak(80) < 1.05 * peak(8)


def test_recording_shorter_than_a_preamble_has_none():
    assert find(record([], 0, 500, np.random.default_rng(10))) == []


def test_silence_does_not_trigger():
    assert find(np.zeros((100_000, 2), np.int16)) == []


@pytest.mark.parametrize("rate", [0.0, -1.0, 2e8])
def test_invalid_false_alarm_rate_is_rejected(rate):
    with pytest.raises(ValueError, match="false_alarm"):
        find(np.zeros((5000, 2), np.int16), false_alarms_per_s=rate)
