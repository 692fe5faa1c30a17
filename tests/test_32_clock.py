"""Clock offset of a receiver: measured on the sidelink, corrected in the samples, and neglected where harmless."""

import numpy as np
import pytest

from apertura.core.echo.captures import correct_clock
from apertura.core.echo.clock import AMBIGUOUS_SHARE, ClockOffset, decide_clock, estimate_clock, interference_floor_db
from apertura.core.echo.demodulate import Numerology

NUMBERS = np.arange(512)
NUMEROLOGY = Numerology(1.2e9, 102.4e6, NUMBERS, prefix_samples=320, dft_samples=1024)  # Δf = 100 kHz, B = 51.2 MHz
SYMBOL = 1600  # T = 1.25/Δf plus prefix
CODES = np.exp(2j * np.pi * np.random.default_rng(0).random(512))
ECHOES_S = np.array([0.2e-6, 0.53e-6, 1.4e-6])


def record(delays_s, *, cfo_hz=0.0, sfo_hz=0.0, pulses=1, snr_db=None, rng=None, waveform=NUMEROLOGY):
    """Return (pulse, sample) captures of a receiver whose oscillator and sampling clock are fast by the offsets."""
    t = np.arange(SYMBOL) / (waveform.sample_rate_hz + sfo_hz) - waveform.prefix_samples / waveform.sample_rate_hz
    tones = np.exp(2j * np.pi * np.outer(t, waveform.numbers * waveform.spacing_hz))
    frequency = waveform.carrier_hz + waveform.numbers * waveform.spacing_hz
    path = sum(np.exp(-2j * np.pi * frequency * delay) for delay in np.atleast_1d(delays_s))
    capture = tones @ (CODES * path) * np.exp(-2j * np.pi * cfo_hz * t)
    captures = np.tile(capture, (pulses, 1))
    if snr_db is not None:
        captures *= np.exp(2j * np.pi * rng.random((pulses, 1)))
        noise = rng.normal(size=(2, *captures.shape)) / np.sqrt(2)
        captures += (noise[0] + 1j * noise[1]) * 10 ** (-snr_db / 20) * np.sqrt(NUMBERS.size)
    return captures.astype(np.complex64)


def transfer(samples, waveform=NUMEROLOGY):
    """Return the transfer functions for the ratio R/S: DFT after the prefix, with the code removed."""
    window = samples[:, waveform.prefix_samples : waveform.prefix_samples + waveform.dft_samples]
    return (np.fft.fft(window, axis=1) / waveform.dft_samples)[:, waveform.numbers] / CODES


def floor_db(radar, sidelink):
    """Return the RMS error of the divided range profile, relative to the peak of the ideal profile."""
    ratio = (transfer(radar) / transfer(sidelink))[0]
    frequency = NUMEROLOGY.carrier_hz + NUMBERS * NUMEROLOGY.spacing_hz
    ideal = np.exp(-2j * np.pi * np.outer(ECHOES_S - 0.1e-6, frequency)).sum(0)
    gain = np.vdot(ideal, ratio) / np.vdot(ideal, ideal)
    profile, error = np.fft.ifft(ideal), np.fft.ifft(ratio / gain - ideal)
    return 10 * np.log10(np.mean(np.abs(error) ** 2) / np.abs(profile).max() ** 2)


def both(**clock):
    return record(ECHOES_S, **clock), record(0.1e-6, **clock)


def corrected(offset, *captures):
    cfo_hz = offset.cfo_of_pulses_hz(1)
    return [correct_clock(samples, NUMEROLOGY, cfo_hz=cfo_hz, sfo_ppm=offset.sfo_ppm) for samples in captures]


def test_correction_lowers_the_floor_of_an_8_ppm_clock_by_40_db():
    radar, sidelink = both(cfo_hz=9600.0, sfo_hz=819.2)
    offset = estimate_clock(sidelink, NUMEROLOGY)
    before, after = floor_db(radar, sidelink), floor_db(*corrected(offset, radar, sidelink))
    assert before > -45
    assert after < before - 40


def test_separate_sampling_clock_is_corrected():
    radar, sidelink = both(cfo_hz=-3000.0, sfo_hz=200 * 102.4)
    offset = estimate_clock(np.repeat(sidelink, 4, 0), NUMEROLOGY)
    assert not offset.one_clock
    assert offset.sfo_ppm == pytest.approx(200, abs=0.5)
    assert offset.cfo_hz == pytest.approx(-3000, abs=20)
    assert floor_db(*corrected(offset, radar, sidelink)) < floor_db(radar, sidelink) - 30


@pytest.mark.parametrize("ppm", [-35.0, -8.0, 0.0, 1.0, 8.0, 35.0])
def test_clock_accuracy_in_noise_matches_theory(ppm):
    rng = np.random.default_rng(1)
    captures = record(0.7e-6, cfo_hz=1200 * ppm, sfo_hz=102.4 * ppm, pulses=64, snr_db=0, rng=rng)
    offset = estimate_clock(captures, NUMEROLOGY)
    # 64 pulses, two copies, separated by 10 µs, of 128 in-band samples at 3 dB: variance of the phase 1/SNR +
    # 1/(2·SNR²)
    theory_hz = np.sqrt((1 / 2 + 1 / 8) / (64 * 128)) / (2 * np.pi * 10e-6)
    assert offset.one_clock
    assert abs(offset.cfo_hz - 1200 * ppm) < 4 * theory_hz
    assert 0.5 * theory_hz < offset.cfo_std_hz < 2 * theory_hz
    assert offset.sfo_ppm == pytest.approx(ppm, abs=4 * theory_hz / 1200)


def test_clock_drift_is_followed():
    rng = np.random.default_rng(2)
    drift_hz = np.linspace(-600, 600, 128)
    captures = record(0.7e-6, cfo_hz=5000, pulses=128, snr_db=20, rng=rng)
    captures = captures * np.exp(-2j * np.pi * np.outer(drift_hz, np.arange(SYMBOL) / 102.4e6)).astype(np.complex64)
    offset = estimate_clock(captures, NUMEROLOGY)
    assert offset.cfo_of_pulses_hz(128) == pytest.approx(5000 + drift_hz, abs=40)
    constant = estimate_clock(record(0.7e-6, cfo_hz=5000, pulses=128, snr_db=20, rng=rng), NUMEROLOGY)
    assert constant.cfo_slope_hz == 0


def test_blocked_pulses_do_not_bias_the_clock():
    rng = np.random.default_rng(3)
    captures = record(0.7e-6, cfo_hz=5000, pulses=128, snr_db=20, rng=rng)
    captures[40:64] = record(0.7e-6, pulses=24, snr_db=20, rng=rng) * 1e-3
    assert estimate_clock(captures, NUMEROLOGY).cfo_hz == pytest.approx(5000, abs=40)


@pytest.mark.parametrize(("cfo_hz", "sfo_hz"), [(10e3, 0.0), (2e3, 0.0), (0.0, 200 * 102.4), (9600.0, 819.2)])
def test_predicted_floor_matches_the_measured_floor(cfo_hz, sfo_hz):
    predicted = interference_floor_db(cfo_hz, sfo_hz / 102.4, NUMEROLOGY)
    # components common to echo and sidelink cancel in the ratio; the residual grows with the delay between echo and
    # sidelink
    phase_rad = 2 * np.pi * 100e3 * (ECHOES_S - 0.1e-6)
    excess = ((np.pi * phase_rad / 2 - phase_rad**2 / 4) / (np.pi**2 / 6)).sum()
    assert floor_db(*both(cfo_hz=cfo_hz, sfo_hz=sfo_hz)) == pytest.approx(predicted + 10 * np.log10(excess), abs=1)


def decision(ppm, *, std_hz=1.0, accuracy_db=-60.0, cfo_hz=None):
    offset = ClockOffset(1200 * ppm if cfo_hz is None else cfo_hz, 0.0, ppm, std_hz, 0.1, one_clock=True)
    return decide_clock(offset, NUMEROLOGY, accuracy_db=accuracy_db)


@pytest.mark.parametrize(
    ("ppm", "accuracy_db", "correct"), [(0.3, -60, False), (1.0, -60, True), (1.0, -40, False), (8.0, -40, True)]
)
def test_clock_is_corrected_only_if_the_accuracy_needs_it(ppm, accuracy_db, correct):
    decided = decision(ppm, accuracy_db=accuracy_db)
    assert decided.correct == correct
    assert decided.reason.endswith(": samples corrected" if correct else ": not corrected")
    assert (decided.floor_db > accuracy_db) == correct


def test_insignificant_clock_offset_is_not_corrected():
    """An offset of 2400 Hz, below three standard deviations, is not corrected; both values are reported."""
    assert not decision(2.0, std_hz=820.0).correct
    assert decision(2.0, std_hz=820.0).reason.startswith("clock +2.00 ± 0.68 ppm (CFO")
    assert decision(2.0, std_hz=820.0).reason.endswith("not corrected: below 3 σ")
    assert decision(2.0, std_hz=780.0).correct
    assert ClockOffset(2400.0, 0.0, 2.0, 820.0, 0.1, one_clock=True).ppm(NUMEROLOGY) == pytest.approx(
        (2.0, 0.6833), abs=1e-3
    )


@pytest.mark.slow
def test_accurate_clock_with_a_weak_sidelink_is_not_corrected():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        offset = estimate_clock(record(0.7e-6, cfo_hz=60.0, sfo_hz=5.0, pulses=48, snr_db=-14, rng=rng), NUMEROLOGY)
        ppm, std_ppm = offset.ppm(NUMEROLOGY)
        assert abs(ppm - 0.05) < 5 * std_ppm
        assert not decide_clock(offset, NUMEROLOGY, accuracy_db=-60).correct


@pytest.mark.parametrize(("std_hz", "flagged"), [(250.0, False), (1000.0, True)])
def test_uncertain_clock_is_flagged(std_hz, flagged):
    assert ("clock_uncertain" in decision(8.0, std_hz=std_hz).flags) == flagged


@pytest.mark.parametrize(("share", "flagged"), [(AMBIGUOUS_SHARE - 0.01, False), (AMBIGUOUS_SHARE + 0.01, True)])
@pytest.mark.parametrize("sign", [-1, 1])
def test_offset_near_its_ambiguity_is_flagged(share, flagged, sign):
    assert ("clock_ambiguous" in decision(0.0, cfo_hz=sign * share * 100e3).flags) == flagged


def test_correction_of_zero_changes_nothing():
    radar, sidelink = both()
    offset = estimate_clock(sidelink, NUMEROLOGY)
    assert abs(offset.cfo_hz) < 1
    corrected_radar = correct_clock(radar, NUMEROLOGY, cfo_hz=np.zeros(1), sfo_ppm=0.0)
    assert np.abs(corrected_radar - radar[:, :1344]).max() < 1e-5 * np.abs(radar).max()


def test_band_centred_on_the_carrier_is_corrected():
    centred = Numerology(1.2e9, 102.4e6, NUMBERS - 256, prefix_samples=320, dft_samples=1024)
    capture = record(0.1e-6, cfo_hz=9600.0, sfo_hz=819.2, waveform=centred)
    offset = estimate_clock(capture, centred)
    assert offset.cfo_hz == pytest.approx(9600, abs=5)
    repaired = correct_clock(capture, centred, cfo_hz=offset.cfo_of_pulses_hz(1), sfo_ppm=offset.sfo_ppm)
    symbols = transfer(repaired, centred)
    assert np.std(np.abs(symbols)) < 2e-3 * np.mean(np.abs(symbols)) < 0.1 * np.std(np.abs(transfer(capture, centred)))


def test_clock_of_a_single_pulse_is_not_corrected():
    _, sidelink = both(cfo_hz=9600.0, sfo_hz=819.2)
    decided = decide_clock(estimate_clock(sidelink, NUMEROLOGY), NUMEROLOGY, accuracy_db=-60)
    assert not decided.correct
    assert "clock_uncertain" in decided.flags


def test_captures_without_a_repetition_are_rejected():
    with pytest.raises(ValueError, match="repeat only 20"):
        estimate_clock(np.ones((3, 1024 + 160 + 20), np.complex64), NUMEROLOGY)


def test_late_captures_give_the_same_clock():
    """The end of a chirp-like code has one edge of the band; 8 samples of silence there are not taken for an offset."""
    chirp = np.exp(1j * np.pi * NUMBERS**2 / NUMBERS.size)  # Newman's phases
    rng = np.random.default_rng(3)
    captures = np.zeros((400, SYMBOL), np.complex64)
    t = np.arange(SYMBOL) / NUMEROLOGY.sample_rate_hz
    tones = np.exp(2j * np.pi * np.outer(t, NUMBERS * NUMEROLOGY.spacing_hz)) @ chirp
    for pulse, late in enumerate(rng.integers(0, 9, len(captures))):
        capture = np.zeros(SYMBOL, complex)
        capture[: SYMBOL - late] = tones[late:]
        noise = rng.normal(size=(2, SYMBOL)) / np.sqrt(2) * 10 ** (-30 / 20) * np.sqrt(NUMBERS.size)
        captures[pulse] = capture * np.exp(-2j * np.pi * 12.0 * t + 1j * rng.uniform(0, 6)) + noise[0] + 1j * noise[1]
    offset = estimate_clock(captures, NUMEROLOGY)
    assert abs(offset.cfo_hz - 12.0) < 5 * offset.cfo_std_hz
    assert offset.one_clock
