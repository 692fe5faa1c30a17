"""Noise power of a pulse, measured on profiles that also contain echoes."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import monostatic, straight_track

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.contributions import band_limited_image
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.echo.sidelink import DIVIDING, METHODS
from apertura.core.geometry.sector import Sector
from apertura.core.imaging.noise import noise_power, sidelink_noise
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround

CENTRE_HZ, STEP_M = 1.2e9, 0.375 / 2
APERTURE = monostatic(straight_track(2048, length_m=40.0))
POINTS = np.c_[np.random.default_rng(2).uniform([-15, 20], [15, 60], (64, 2)), np.zeros(64)]


def profiles(noise, *, echo=1.0, seed=3, pulses=2048):
    """Simulate profiles of two targets in white noise of the given power per sample."""
    aperture = APERTURE[:pulses]
    start = np.full(pulses, 30.0)
    range_m = start[0] + STEP_M * np.arange(800)
    rng = np.random.default_rng(seed)
    path = aperture.path(np.array([[2.0, 35.0, 0.0], [-6.0, 48.0, 0.0]]))
    echoes = sum(
        echo
        * np.sinc((range_m - target_path[:, None]) / 0.375)
        * np.exp(-2j * np.pi * CENTRE_HZ / C * target_path[:, None])
        for target_path in path.T
    )
    band = np.fft.fft(rng.standard_normal((pulses, 800)) + 1j * rng.standard_normal((pulses, 800)), axis=1)
    band[:, 200:600] = 0  # twice oversampled
    samples = echoes + np.sqrt(noise) * np.fft.ifft(band, axis=1)  # power 2 in half of the band
    return Profiles(samples.astype(np.complex64), start, STEP_M, CENTRE_HZ, 2.0, aperture)


@pytest.mark.quick("0.01")
@pytest.mark.parametrize("noise", [1e-4, 1e-2, 4.0])
def test_noise_is_measured_below_the_echoes_of_a_recording(noise):
    """Echoes 40 dB above the pulse noise, focused at other points, do not affect the estimate."""
    assert 10 * np.log10(noise_power(profiles(noise), POINTS).power / noise) == pytest.approx(0, abs=0.35)


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_missing_pulses_do_not_leak_echoes_into_the_noise(share):
    """An echo is 40 dB above the noise at the range of all points; contiguous pulse numbers would cause phase jumps."""
    noise, kept = 1e-4, np.flatnonzero(np.random.default_rng(5).random(128) >= share)
    whole, target, middle = profiles(noise, pulses=128), np.array([2.0, 35.0, 0.0]), APERTURE.tx_m[64]
    angle = np.random.default_rng(2).uniform(-0.6, 0.6, 64)
    equidistant = middle * [1, 1, 0] + np.hypot(*(target - middle)[:2]) * np.c_[np.sin(angle), np.cos(angle), 0 * angle]
    kept_profiles = replace(whole, samples=whole.samples[kept], start_m=whole.start_m[kept], aperture=APERTURE[kept])
    with_times, without_times = (noise_power(kept_profiles, equidistant, time_s=times) for times in (kept / 20.0, None))
    assert abs(10 * np.log10(with_times.power / noise)) < 3 * with_times.std_db < 2.0
    assert 10 * np.log10(without_times.power / noise) > 2


@pytest.mark.parametrize(("every", "sparse"), [(1, False), (2, True)])
def test_deviation_for_sparse_pulses_includes_leaked_echoes(every, sparse):
    """With pulses at twice the Doppler of the scene, little band remains, and outside echoes raise the estimate."""
    noise, whole = 1e-2, profiles(1e-2)
    decimated = replace(
        whole, samples=whole.samples[::every], start_m=whole.start_m[::every], aperture=APERTURE[::every]
    )
    measured = noise_power(decimated, POINTS)
    assert (measured.std_db > 0.6) == sparse
    assert abs(10 * np.log10(measured.power / noise)) < max(0.35, 2 * measured.std_db)


@pytest.mark.slow
def test_reported_deviation_equals_the_scatter_of_many_recordings():
    """This also holds if 64 points lie in a few resolution cells and are hardly independent."""
    drawn = [profiles(1.0, echo=0.0, seed=seed, pulses=128) for seed in range(24)]
    for points in (POINTS, 0.05 * POINTS + [0, 30, 0]):
        measured = [noise_power(recording, points) for recording in drawn]
        scatter_db = np.std([10 * np.log10(result.power) for result in measured])
        assert np.median([result.std_db for result in measured]) == pytest.approx(scatter_db, rel=0.4)


def test_pixel_noise_follows_from_pulse_noise():
    """Eq. 2: without echo, |I|² is σ² Σw² over the squared number of pulses."""
    noise_only, sector = profiles(0.01, echo=0.0), Beams(sector=Sector.of(APERTURE, chord_m=1.0, centre=0.0, half=0.15))
    image = band_limited_image(noise_only, POINTS, beams=sector)
    squares = (sector.weight(APERTURE, POINTS) ** 2).sum(axis=0)
    pulse_noise = noise_power(noise_only, POINTS, beams=sector).power
    assert 10 * np.log10(np.mean(np.abs(image) ** 2 / squares) / pulse_noise) == pytest.approx(0, abs=1.2)


def test_noise_of_too_few_pulses_is_undefined():
    few = profiles(1.0)[:12]
    assert np.isnan(noise_power(few, POINTS).power)
    assert np.isfinite(noise_power(replace(profiles(1.0)[:40]), POINTS).power)


@pytest.mark.quick("wiener", "two_parameter")
@pytest.mark.parametrize("method", ["divide", "wiener", "gated", "two_parameter"])
def test_sidelink_noise_is_added_to_the_echoes_by_the_correction(method):
    """Eq. 8a: division by a sidelink of 13 dB SNR adds noise to strong echoes."""
    subcarriers, snr_db, rng = 128, 13.0, np.random.default_rng(4)
    frequency = CENTRE_HZ + 1.6e6 * (np.arange(subcarriers) - subcarriers // 2)
    targets, grid = np.array([[2.0, 35.0, 0.0], [-6.0, 48.0, 0.0]]), SceneGrid("local", -15.0, 60.0, 0.5, (80, 60))
    echo = np.exp(-2j * np.pi / C * APERTURE.path(targets)[..., None] * frequency).sum(axis=1)
    receiver, sidelink = rng.standard_normal((2, *echo.shape, 2)) @ np.array([1, 1j]) / np.sqrt(2)
    sidelink = 3 * (1 + 10 ** (-snr_db / 20) * sidelink)
    radar = np.asarray(echo + 0.02 * receiver, np.complex64)
    history = PhaseHistory(
        METHODS[method](radar, sidelink.astype(np.complex64)),
        frequency,
        np.full(subcarriers, 1 / subcarriers),
        np.zeros(len(APERTURE)),
        APERTURE,
    )
    added = sidelink_noise(history, grid, FlatGround(0.0), POINTS, method=method, snr_db=snr_db)
    thermal, measured = 0.02**2 / subcarriers, noise_power(range_compress(history, grid, FlatGround(0.0)), POINTS).power
    # Noise that is kept only on the echoes affects few points, so that the median differs from that of a sum.
    least_db = 1.5 if method == "two_parameter" else 0.5
    assert 10 * np.log10(measured / (thermal + added)) == pytest.approx(0, abs=least_db)
    if method in DIVIDING:
        assert added > 20 * thermal  # two echoes of amplitude 1, sidelink SNR 13 dB: 0.1 per subcarrier
        assert added == pytest.approx(2 * 10 ** (-snr_db / 10) / subcarriers, rel=0.15)
