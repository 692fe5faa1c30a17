"""Transfer functions from beat signals: one frequency per sample, no residual video phase, for any mixer."""

from dataclasses import replace

import numpy as np
import pytest

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.compression import window_weights
from apertura.core.echo.dechirp import FrequencySweep, sweep_motion_flags, transfer_of
from apertura.simulation.fmcw import beat_signal

FAST = FrequencySweep(2.2e9, 400e6, 20e-6, 25e6)


def beats(sweep, path_m, start_s=(0.0,)):
    return beat_signal(sweep, np.array(start_s), [lambda time: np.full_like(time, path_m)], [1.0])


def against_truth(sweep, path_m, **options):
    """Return the transfer function of one echo divided by the exact transfer function."""
    transfer = transfer_of(beats(sweep, path_m), sweep, **options)[0]
    delay_s = path_m / SPEED_OF_LIGHT_M_S - sweep.reference_delay_s
    return transfer * np.exp(2j * np.pi * sweep.frequency_hz * delay_s)


def gathered(ratio):
    """Return the value of a Hann-weighted profile at the delay of the echo."""
    return complex((ratio * window_weights("hann", len(ratio))).sum())


@pytest.mark.parametrize("path_m", [30.0, 60.0, 150.0])
@pytest.mark.parametrize("bandwidth_hz", [400e6, -400e6])
@pytest.mark.parametrize("iq", ["real", "complex", "conjugate"])
@pytest.mark.parametrize("options", [{}, {"settle_s": 1e-6, "reference_path_m": 9.0}])
def test_echo_has_the_phase_of_its_delay_at_every_frequency(path_m, bandwidth_hz, iq, options):
    sweep = replace(FAST, start_hz=2.4e9 - bandwidth_hz / 2, bandwidth_hz=bandwidth_hz, iq=iq, **options)
    ratio = against_truth(sweep, path_m)
    inside = ratio[60:-60]  # the echo is absent before its delay, at most 12 samples, and its edges ring
    assert np.abs(inside / abs(inside) - 1).max() < 0.05
    assert gathered(ratio) == pytest.approx(1, abs=2e-3)


def test_residual_video_phase_is_pi_gamma_tau_squared_and_removed():
    sweep, path_m = replace(FAST, iq="complex"), 150.0
    residual = np.pi * sweep.slope_hz_s * (path_m / SPEED_OF_LIGHT_M_S) ** 2
    assert residual > np.pi
    kept = gathered(against_truth(sweep, path_m, deskewed=False))
    assert np.angle(kept * np.exp(-1j * residual)) == pytest.approx(0, abs=0.01)
    assert np.angle(gathered(against_truth(sweep, path_m))) == pytest.approx(0, abs=1e-3)


def test_wrong_mixer_sign_gives_negative_delay():
    sweep = replace(FAST, iq="complex")
    wrong = transfer_of(beats(sweep, 60.0), replace(sweep, iq="conjugate"))[0]
    profile = np.abs(np.fft.ifft(wrong * np.hanning(len(wrong))))
    step_m = SPEED_OF_LIGHT_M_S * sweep.sample_rate_hz / sweep.slope_hz_s / len(wrong)
    assert (len(wrong) - profile.argmax()) * step_m == pytest.approx(60.0, abs=step_m)


def test_late_samples_are_corrected():
    late = 0.4 / FAST.sample_rate_hz
    # the swept frequencies at the times of the samples
    behind = replace(FAST, start_hz=FAST.start_hz + FAST.slope_hz_s * late)
    delay_s = 60.0 / SPEED_OF_LIGHT_M_S
    beat = np.cos(np.angle(beats(replace(behind, iq="complex"), 60.0)))
    corrected, uncorrected = (
        gathered(transfer_of(beat, FAST, late_s=late_s)[0] * np.exp(2j * np.pi * FAST.frequency_hz * delay_s))
        for late_s in (np.array([late]), None)
    )
    assert corrected == pytest.approx(1, abs=2e-3)
    assert np.angle(uncorrected) == pytest.approx(-2 * np.pi * FAST.slope_hz_s * late * delay_s, abs=1e-3)


@pytest.mark.parametrize("iq", ["real", "complex"])
def test_echo_beyond_the_path_limit_is_wrong(iq):
    sweep = replace(FAST, iq=iq)
    limit_m = sweep.path_limit_m
    assert limit_m == pytest.approx(
        SPEED_OF_LIGHT_M_S * sweep.sample_rate_hz / sweep.slope_hz_s * {"real": 1 / 2, "complex": 15 / 16}[iq]
    )
    near, far = (gathered(against_truth(sweep, limit_m * part)) for part in (0.95, 1.12))
    assert abs(near - 1) < 2e-3
    assert abs(far - 1) > 0.1


def test_deskew_does_not_wrap_around():
    ratio = against_truth(replace(FAST, iq="complex", settle_s=1e-6), 150.0)  # 12.5 samples of delay
    assert abs(ratio[:8]) == pytest.approx(1, abs=0.3)
    assert abs(ratio[-8:]).max() < 0.3


def test_echo_with_half_a_sweep_of_overlap_is_at_the_limit():
    short = FrequencySweep(2.2e9, 4e6, 2e-6, 25e6)
    assert short.path_limit_m == pytest.approx(SPEED_OF_LIGHT_M_S * 1e-6)
    whole, half = (abs(gathered(against_truth(short, path_m))) for path_m in (3.0, short.path_limit_m))
    assert half == pytest.approx(whole / 2, abs=0.1)


def test_sidelobes_are_those_of_the_window():
    transfer = transfer_of(beats(FAST, 60.0), FAST)[0]
    level = np.abs(np.fft.ifft(transfer * window_weights("hann", len(transfer)), 16 * len(transfer)))
    peak = int(level.argmax())
    sidelobes = np.roll(level, -peak)[2 * 16 : 40 * 16]
    assert 20 * np.log10(sidelobes.max() / level[peak]) == pytest.approx(-31.5, abs=0.3)


@pytest.mark.parametrize(("sweep_s", "flagged"), [(2e-3, False), (4e-3, True)])
def test_motion_within_a_sweep_is_flagged_above_wavelength_16(sweep_s, flagged):
    """At 3 m/s and 2.4 GHz, a path change of λ/16 = 7.8 mm takes 2.6 ms."""
    time = np.datetime64("2025-05-14T09:30", "ns") + np.arange(50) * np.timedelta64(10, "ms")
    flown = np.arange(50)[:, None] * np.array([0.03, 0, 0])
    frequency = np.linspace(2.2e9, 2.6e9, 100)
    flags = sweep_motion_flags(time, (flown, flown), lasting_s=sweep_s, frequency_hz=frequency)
    assert set(flags) == ({"sweep_motion"} if flagged else set())


@pytest.mark.parametrize("bandwidth_hz", [200e6, -200e6])
def test_motion_within_a_sweep_shifts_only_the_envelope(bandwidth_hz):
    slow = FrequencySweep(2.4e9 - bandwidth_hz / 2, bandwidth_hz, 5e-3, 100e3, iq="complex")
    rate_m_s, path_m = 10.0, 60.0
    middle = slow.middle_s
    beat = beat_signal(slow, np.zeros(1), [lambda time: path_m + rate_m_s * (time - middle)], [1.0])
    transfer = transfer_of(beat, slow)[0]
    centre = slow.frequency_hz[[0, -1]].mean()
    step_m = 0.01
    paths = np.arange(path_m - 3, path_m + 3, step_m)
    phasors = np.exp(2j * np.pi * np.outer(paths, slow.frequency_hz) / SPEED_OF_LIGHT_M_S)
    profile = phasors @ (transfer * window_weights("hann", len(transfer)))
    expected_m = centre * rate_m_s / slow.slope_hz_s
    assert abs(expected_m) > 0.5
    assert paths[abs(profile).argmax()] - path_m == pytest.approx(expected_m, abs=2 * step_m)
    at_centre = transfer[len(transfer) // 2] * np.exp(
        2j * np.pi * slow.frequency_hz[len(transfer) // 2] * path_m / SPEED_OF_LIGHT_M_S
    )
    assert np.angle(at_centre) == pytest.approx(0, abs=0.1)
