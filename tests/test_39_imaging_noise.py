"""The noise of a pulse, measured on profiles that hold echoes as well."""

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
FLOWN = monostatic(straight_track(2048, length_m=40.0))
PLACES = np.c_[np.random.default_rng(2).uniform([-15, 20], [15, 60], (64, 2)), np.zeros(64)]


def profiles(noise, *, echo=1.0, seed=3, pulses=2048):
    """Two targets, and white noise of that power at every sample."""
    flown = FLOWN[:pulses]
    start = np.full(pulses, 30.0)
    at = start[0] + STEP_M * np.arange(800)
    rng = np.random.default_rng(seed)
    path = flown.path(np.array([[2.0, 35.0, 0.0], [-6.0, 48.0, 0.0]]))
    held = sum(
        echo * np.sinc((at - each[:, None]) / 0.375) * np.exp(-2j * np.pi * CENTRE_HZ / C * each[:, None])
        for each in path.T
    )
    band = np.fft.fft(rng.standard_normal((pulses, 800)) + 1j * rng.standard_normal((pulses, 800)), axis=1)
    band[:, 200:600] = 0  # twice oversampled
    samples = held + np.sqrt(noise) * np.fft.ifft(band, axis=1)  # 2 of power, half of the band
    return Profiles(samples.astype(np.complex64), start, STEP_M, CENTRE_HZ, 2.0, flown)


@pytest.mark.quick("0.01")
@pytest.mark.parametrize("noise", [1e-4, 1e-2, 4.0])
def test_noise_of_a_recording_is_found_below_its_echoes(noise):
    """Its echoes are focused at other places, 40 dB above the noise of a pulse, and leave no mark on it."""
    assert 10 * np.log10(noise_power(profiles(noise), PLACES).power / noise) == pytest.approx(0, abs=0.35)


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_pulses_that_are_missing_let_no_echo_into_the_noise(share):
    """Of an echo 40 dB above it, as far as all places: by numbers without gaps its phase jumps at each."""
    noise, kept = 1e-4, np.flatnonzero(np.random.default_rng(5).random(128) >= share)
    whole, target, middle = profiles(noise, pulses=128), np.array([2.0, 35.0, 0.0]), FLOWN.tx_m[64]
    turn = np.random.default_rng(2).uniform(-0.6, 0.6, 64)
    as_far = middle * [1, 1, 0] + np.hypot(*(target - middle)[:2]) * np.c_[np.sin(turn), np.cos(turn), 0 * turn]
    some = replace(whole, samples=whole.samples[kept], start_m=whole.start_m[kept], aperture=FLOWN[kept])
    told, deaf = (noise_power(some, as_far, time_s=times) for times in (kept / 20.0, None))
    assert abs(10 * np.log10(told.power / noise)) < 3 * told.std_db < 2.0
    assert 10 * np.log10(deaf.power / noise) > 2


@pytest.mark.parametrize(("every", "sparse"), [(1, False), (2, True)])
def test_where_pulses_are_sparse_the_deviation_holds_what_echoes_leak_into_the_noise(every, sparse):
    """Twice the scene's Doppler leaves too little of the band: echoes beside the scene raise what is measured."""
    noise, whole = 1e-2, profiles(1e-2)
    some = replace(whole, samples=whole.samples[::every], start_m=whole.start_m[::every], aperture=FLOWN[::every])
    found = noise_power(some, PLACES)
    assert (found.std_db > 0.6) == sparse
    assert abs(10 * np.log10(found.power / noise)) < max(0.35, 2 * found.std_db)


@pytest.mark.slow
def test_the_deviation_told_is_that_of_many_recordings():
    """Also where 64 places lie in a few resolution cells and are hardly more than one."""
    drawn = [profiles(1.0, echo=0.0, seed=seed, pulses=128) for seed in range(24)]
    for places in (PLACES, 0.05 * PLACES + [0, 30, 0]):
        told = [noise_power(one, places) for one in drawn]
        scatter_db = np.std([10 * np.log10(one.power) for one in told])
        assert np.median([one.std_db for one in told]) == pytest.approx(scatter_db, rel=0.4)


def test_the_noise_of_a_pixel_follows_from_that_of_a_pulse():
    """Eq. 2: |I|² where there is no echo is σ² Σw² over the pulses counted, squared."""
    only, sector = profiles(0.01, echo=0.0), Beams(sector=Sector.of(FLOWN, chord_m=1.0, centre=0.0, half=0.15))
    image = band_limited_image(only, PLACES, beams=sector)
    squares = (sector.weight(FLOWN, PLACES) ** 2).sum(axis=0)
    told = noise_power(only, PLACES, beams=sector).power
    assert 10 * np.log10(np.mean(np.abs(image) ** 2 / squares) / told) == pytest.approx(0, abs=1.2)


def test_too_few_pulses_tell_nothing():
    few = profiles(1.0)[:12]
    assert np.isnan(noise_power(few, PLACES).power)
    assert np.isfinite(noise_power(replace(profiles(1.0)[:40]), PLACES).power)


@pytest.mark.quick("wiener", "two_parameter")
@pytest.mark.parametrize("method", ["divide", "wiener", "gated", "two_parameter"])
def test_the_noise_of_a_sidelink_lies_on_the_echoes_as_its_correction_leaves_it(method):
    """Eq. 8a: divided by a sidelink of 13 dB, echoes far above their receiver's noise bring noise of their own."""
    subcarriers, snr_db, rng = 128, 13.0, np.random.default_rng(4)
    frequency = CENTRE_HZ + 1.6e6 * (np.arange(subcarriers) - subcarriers // 2)
    places, grid = np.array([[2.0, 35.0, 0.0], [-6.0, 48.0, 0.0]]), SceneGrid("local", -15.0, 60.0, 0.5, (80, 60))
    echo = np.exp(-2j * np.pi / C * FLOWN.path(places)[..., None] * frequency).sum(axis=1)
    receiver, sidelink = rng.standard_normal((2, *echo.shape, 2)) @ np.array([1, 1j]) / np.sqrt(2)
    sidelink = 3 * (1 + 10 ** (-snr_db / 20) * sidelink)
    radar = np.asarray(echo + 0.02 * receiver, np.complex64)
    history = PhaseHistory(
        METHODS[method](radar, sidelink.astype(np.complex64)),
        frequency,
        np.full(subcarriers, 1 / subcarriers),
        np.zeros(len(FLOWN)),
        FLOWN,
    )
    added = sidelink_noise(history, grid, FlatGround(0.0), PLACES, method=method, snr_db=snr_db)
    thermal, measured = 0.02**2 / subcarriers, noise_power(range_compress(history, grid, FlatGround(0.0)), PLACES).power
    # What a method keeps on the echoes alone is seen by few places, whose median is not that of a sum.
    least_db = 1.5 if method == "two_parameter" else 0.5
    assert 10 * np.log10(measured / (thermal + added)) == pytest.approx(0, abs=least_db)
    if method in DIVIDING:
        assert added > 20 * thermal  # two echoes of 1 by a sidelink 13 dB above its noise: 0.1 of a subcarrier's
        assert added == pytest.approx(2 * 10 ** (-snr_db / 10) / subcarriers, rel=0.15)
