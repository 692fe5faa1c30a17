"""What blocks of pulses add at single places: the compiled library and numpy against the double sum in float64."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import compiled, decibels, ecef, fly, pixel_grid, scatter, without_library

from apertura.core.backprojection.contributions import (
    DEGREE,
    TAPS,
    band_limited_image,
    band_limited_terms,
    block_contributions,
    tap_polynomials,
)
from apertura.core.backprojection.engines import native

LOCAL = pixel_grid(40, 40)
PLACES = ecef(LOCAL).reshape(-1, 3)[::7]
SCENE = fly(scatter(LOCAL))
PROFILES = SCENE.profiles(ecef(LOCAL))
PULSES = len(PROFILES)
EVEN = np.arange(0, PULSES + 1, 7)
WAYS = [pytest.param(True, marks=compiled, id="compiled"), pytest.param(False, id="numpy")]


@pytest.fixture(params=WAYS)
def way(request, monkeypatch):
    """Both ways in which contributions are computed, one after the other."""
    if not request.param:
        without_library(monkeypatch)


def exact(block: slice) -> np.ndarray:
    """The double sum over some pulses and all subcarriers."""
    return replace(SCENE, transfer=SCENE.transfer[block], tx=SCENE.tx[block], rx=SCENE.rx[block]).exact(PLACES)


def exact_terms() -> np.ndarray:
    """What each pulse adds, by the double sum."""
    return np.stack([exact(slice(pulse, pulse + 1)) for pulse in range(PULSES)])


@pytest.mark.usefixtures("way")
def test_blocks_add_what_the_double_sum_over_their_pulses_gives():
    found = block_contributions(PROFILES, PLACES, edges=EVEN)
    truth = np.stack([exact(slice(first, first + 7)) for first in EVEN[:-1]], axis=-1)
    assert (found.shape, found.dtype) == (truth.shape, np.complex64)
    assert decibels(found - truth, truth) < -65


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("every", [1, 5, PULSES])
def test_all_blocks_together_are_the_image_however_pulses_are_divided(every):
    edges = np.unique([*range(0, PULSES, every), PULSES])
    truth = band_limited_image(PROFILES, PLACES)
    assert decibels(block_contributions(PROFILES, PLACES, edges=edges).sum(1) - truth, truth) < -65


@compiled
def test_the_compiled_engine_forms_the_same_image():
    image = native.form(native.prepare(PROFILES), ecef(LOCAL)).reshape(-1)[::7]
    sums = block_contributions(PROFILES, PLACES, edges=np.array([0, PULSES]))[:, 0]
    assert decibels(sums - image, image) < -65


@compiled
@pytest.mark.usefixtures("isa")
def test_every_instruction_set_adds_what_numpy_adds(monkeypatch):
    weights = np.random.default_rng(1).uniform(0, 1, PULSES)
    fast = block_contributions(PROFILES, PLACES, edges=EVEN, weights=weights)
    without_library(monkeypatch)
    slow = block_contributions(PROFILES, PLACES, edges=EVEN, weights=weights)
    assert decibels(fast - slow, slow) < -115


@pytest.mark.usefixtures("way")
def test_terms_in_float64_are_those_of_the_double_sum():
    found, truth = band_limited_terms(PROFILES, PLACES), exact_terms()
    assert decibels(found - truth, truth) < -115  # what float32 samples hold


@compiled
@pytest.mark.usefixtures("isa")
def test_every_instruction_set_gives_the_terms_of_numpy(monkeypatch):
    """Inside the samples, across both ends, beyond them, and at a place that is none."""
    line = np.stack([np.linspace(-200, 200, 401), np.zeros(401), np.zeros(401)], -1)
    places = ecef(np.concatenate([line, [[np.nan, 0, 0]]]))
    fast = band_limited_terms(PROFILES, places)
    without_library(monkeypatch)
    slow = band_limited_terms(PROFILES, places)
    assert np.isnan(fast[:, -1]).all()
    at = (PROFILES.aperture.path(places[:-1]) - PROFILES.start_m[:, None]) / PROFILES.step_m
    assert at.min() < -TAPS < 0 < PROFILES.samples.shape[1] + TAPS < at.max()
    assert ((fast[:, :-1] == 0) == (slow[:, :-1] == 0)).all()
    assert decibels(fast[:, :-1] - slow[:, :-1], slow[:, :-1]) < -240


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("oversampling", [4, 8])
def test_more_oversampled_profiles_are_interpolated_as_well(oversampling):
    spectrum, factor = np.fft.fft(PROFILES.samples.astype(complex)), oversampling // 2
    length, half = PROFILES.samples.shape[1], PROFILES.samples.shape[1] // 2
    wide = np.zeros((PULSES, length * factor), complex)
    wide[:, :half], wide[:, -half:] = spectrum[:, :half] * factor, spectrum[:, -half:] * factor
    finer = replace(
        PROFILES,
        samples=np.fft.ifft(wide).astype(np.complex64),
        step_m=PROFILES.step_m / factor,
        oversampling=float(oversampling),
    )
    truth = band_limited_image(finer, PLACES)
    sums = block_contributions(finer, PLACES, edges=np.array([0, PULSES]))[:, 0]
    assert decibels(sums - truth, truth) < -65


@pytest.mark.usefixtures("way")
def test_beyond_the_samples_there_is_no_echo():
    near, far = ecef(np.array([[12.0, 0, 12.0]])), ecef(np.array([[900.0, 0, 0]]))
    assert not block_contributions(PROFILES, np.concatenate([near, far]), edges=EVEN).any()


@pytest.mark.usefixtures("way")
def test_at_the_ends_samples_beyond_count_as_zero():
    short = replace(PROFILES, samples=PROFILES.samples[:, 15:-15], start_m=PROFILES.start_m + 15 * PROFILES.step_m)
    edge = np.zeros_like(PROFILES.samples)
    edge[:, 15:-15] = short.samples
    same = block_contributions(replace(PROFILES, samples=edge), PLACES, edges=EVEN)
    assert np.allclose(block_contributions(short, PLACES, edges=EVEN), same, atol=2e-5 * np.abs(same).max())


def test_neither_value_nor_slope_jumps_where_another_sample_becomes_the_nearest():
    power = np.arange(DEGREE + 1)
    for of_end in (0.5**power, power * 0.5 ** (power - 1.0)):
        sign = (-1.0) ** (power if of_end[0] else power + 1)
        ahead, behind = of_end @ tap_polynomials(), (sign * of_end) @ tap_polynomials()
        assert np.abs(np.append(ahead, 0) - np.append(0, behind)).max() < 1e-12


@pytest.mark.usefixtures("way")
def test_a_place_that_is_not_finite_is_nan_and_spoils_no_other():
    places = PLACES.copy()
    places[3, 1] = np.nan
    found = block_contributions(PROFILES, places, edges=EVEN)
    assert np.isnan(found[3]).all()
    assert np.isfinite(np.delete(found, 3, axis=0)).all()


class Recorded:
    """Samples that note which pulses are read."""

    def __init__(self, samples):
        self._samples, self.read = samples, []
        self.shape, self.ndim, self.dtype = samples.shape, samples.ndim, samples.dtype

    def __len__(self):
        return len(self._samples)

    def __getitem__(self, pulses):
        self.read.append((pulses.start, pulses.stop))
        return self._samples[pulses]


@pytest.mark.usefixtures("way")
def test_pulses_are_read_a_few_at_a_time_and_never_those_without_weight(monkeypatch):
    monkeypatch.setattr(
        "apertura.core.backprojection.contributions._BYTES_AT_ONCE", 8 * 10 * (PROFILES.samples.shape[1] + 2 * TAPS)
    )
    weights = np.ones(PULSES)
    weights[14:28] = 0
    lazy = Recorded(PROFILES.samples)
    edges = np.array([7, 14, 21, 28, 28, 53])
    found = block_contributions(replace(PROFILES, samples=lazy), PLACES, edges=edges, weights=weights)
    assert lazy.read == [(7, 14), (28, 31), (31, 41), (41, 51), (51, 53)]
    truth = np.stack([exact(slice(7, 14)), *np.zeros((3, len(PLACES))), exact(slice(28, 53))], axis=-1)
    assert not found[:, 1:4].any()
    assert decibels(found - truth, truth) < -65


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"edges": np.array([0, 9, 8])}, "must ascend"),
        ({"edges": np.array([0, PULSES + 1])}, "must ascend"),
        ({"edges": np.array([0, 1]), "weights": np.ones(3)}, "weights.shape"),
    ],
)
def test_what_does_not_fit_is_refused(changes, said):
    with pytest.raises(ValueError, match=said):
        block_contributions(PROFILES, PLACES, **changes)
