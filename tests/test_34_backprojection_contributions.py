"""Contributions of pulse blocks at single points: compiled library and numpy against the float64 double sum."""

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
POINTS = ecef(LOCAL).reshape(-1, 3)[::7]
SCENE = fly(scatter(LOCAL))
PROFILES = SCENE.profiles(ecef(LOCAL))
PULSES = len(PROFILES)
EVEN = np.arange(0, PULSES + 1, 7)
IMPLEMENTATIONS = [pytest.param(True, marks=compiled, id="compiled"), pytest.param(False, id="numpy")]


@pytest.fixture(params=IMPLEMENTATIONS)
def implementation(request, monkeypatch):
    """Run a test with the compiled library and with numpy."""
    if not request.param:
        without_library(monkeypatch)


def exact(block: slice) -> np.ndarray:
    """Return the double sum over a block of pulses and all subcarriers."""
    return replace(SCENE, transfer=SCENE.transfer[block], tx=SCENE.tx[block], rx=SCENE.rx[block]).exact(POINTS)


def exact_terms() -> np.ndarray:
    """Return the contribution of each pulse to the double sum."""
    return np.stack([exact(slice(pulse, pulse + 1)) for pulse in range(PULSES)])


@pytest.mark.usefixtures("implementation")
def test_blocks_contribute_the_double_sum_over_their_pulses():
    contributions = block_contributions(PROFILES, POINTS, edges=EVEN)
    truth = np.stack([exact(slice(first, first + 7)) for first in EVEN[:-1]], axis=-1)
    assert (contributions.shape, contributions.dtype) == (truth.shape, np.complex64)
    assert decibels(contributions - truth, truth) < -65


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("every", [1, 5, PULSES])
def test_blocks_of_any_size_sum_to_the_image(every):
    edges = np.unique([*range(0, PULSES, every), PULSES])
    truth = band_limited_image(PROFILES, POINTS)
    assert decibels(block_contributions(PROFILES, POINTS, edges=edges).sum(1) - truth, truth) < -65


@compiled
def test_the_compiled_engine_forms_the_same_image():
    image = native.form(native.prepare(PROFILES), ecef(LOCAL)).reshape(-1)[::7]
    sums = block_contributions(PROFILES, POINTS, edges=np.array([0, PULSES]))[:, 0]
    assert decibels(sums - image, image) < -65


@compiled
@pytest.mark.usefixtures("isa")
def test_every_instruction_set_gives_the_contributions_of_numpy(monkeypatch):
    weights = np.random.default_rng(1).uniform(0, 1, PULSES)
    fast = block_contributions(PROFILES, POINTS, edges=EVEN, weights=weights)
    without_library(monkeypatch)
    slow = block_contributions(PROFILES, POINTS, edges=EVEN, weights=weights)
    assert decibels(fast - slow, slow) < -115


@pytest.mark.usefixtures("implementation")
def test_float64_terms_equal_those_of_the_double_sum():
    contributions, truth = band_limited_terms(PROFILES, POINTS), exact_terms()
    assert decibels(contributions - truth, truth) < -115  # the precision of float32 samples


@compiled
@pytest.mark.usefixtures("isa")
def test_every_instruction_set_gives_the_terms_of_numpy(monkeypatch):
    """Points inside the samples, near both ends, beyond the ends, and one undefined point."""
    line = np.stack([np.linspace(-200, 200, 401), np.zeros(401), np.zeros(401)], -1)
    points = ecef(np.concatenate([line, [[np.nan, 0, 0]]]))
    fast = band_limited_terms(PROFILES, points)
    without_library(monkeypatch)
    slow = band_limited_terms(PROFILES, points)
    assert np.isnan(fast[:, -1]).all()
    sample_index = (PROFILES.aperture.path(points[:-1]) - PROFILES.start_m[:, None]) / PROFILES.step_m
    assert sample_index.min() < -TAPS < 0 < PROFILES.samples.shape[1] + TAPS < sample_index.max()
    assert ((fast[:, :-1] == 0) == (slow[:, :-1] == 0)).all()
    assert decibels(fast[:, :-1] - slow[:, :-1], slow[:, :-1]) < -240


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("oversampling", [4, 8])
def test_more_oversampled_profiles_are_interpolated_as_accurately(oversampling):
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
    truth = band_limited_image(finer, POINTS)
    sums = block_contributions(finer, POINTS, edges=np.array([0, PULSES]))[:, 0]
    assert decibels(sums - truth, truth) < -65


@pytest.mark.usefixtures("implementation")
def test_points_beyond_the_samples_get_no_echo():
    near, far = ecef(np.array([[12.0, 0, 12.0]])), ecef(np.array([[900.0, 0, 0]]))
    assert not block_contributions(PROFILES, np.concatenate([near, far]), edges=EVEN).any()


@pytest.mark.usefixtures("implementation")
def test_samples_beyond_the_ends_count_as_zero():
    short = replace(PROFILES, samples=PROFILES.samples[:, 15:-15], start_m=PROFILES.start_m + 15 * PROFILES.step_m)
    padded = np.zeros_like(PROFILES.samples)
    padded[:, 15:-15] = short.samples
    expected = block_contributions(replace(PROFILES, samples=padded), POINTS, edges=EVEN)
    assert np.allclose(block_contributions(short, POINTS, edges=EVEN), expected, atol=2e-5 * np.abs(expected).max())


def test_interpolant_and_its_slope_are_continuous_between_samples():
    power = np.arange(DEGREE + 1)
    for derivatives in (0.5**power, power * 0.5 ** (power - 1.0)):
        sign = (-1.0) ** (power if derivatives[0] else power + 1)
        ahead, behind = derivatives @ tap_polynomials(), (sign * derivatives) @ tap_polynomials()
        assert np.abs(np.append(ahead, 0) - np.append(0, behind)).max() < 1e-12


@pytest.mark.usefixtures("implementation")
def test_non_finite_point_is_nan_and_leaves_other_points_unchanged():
    points = POINTS.copy()
    points[3, 1] = np.nan
    contributions = block_contributions(PROFILES, points, edges=EVEN)
    assert np.isnan(contributions[3]).all()
    assert np.isfinite(np.delete(contributions, 3, axis=0)).all()


class RecordingSamples:
    """Samples that record the pulses read."""

    def __init__(self, samples):
        self._samples, self.read = samples, []
        self.shape, self.ndim, self.dtype = samples.shape, samples.ndim, samples.dtype

    def __len__(self):
        return len(self._samples)

    def __getitem__(self, pulses):
        self.read.append((pulses.start, pulses.stop))
        return self._samples[pulses]


@pytest.mark.usefixtures("implementation")
def test_pulses_are_read_in_batches_and_skipped_if_their_weight_is_zero(monkeypatch):
    monkeypatch.setattr(
        "apertura.core.backprojection.contributions._BYTES_AT_ONCE", 8 * 10 * (PROFILES.samples.shape[1] + 2 * TAPS)
    )
    weights = np.ones(PULSES)
    weights[14:28] = 0
    lazy = RecordingSamples(PROFILES.samples)
    edges = np.array([7, 14, 21, 28, 28, 53])
    contributions = block_contributions(replace(PROFILES, samples=lazy), POINTS, edges=edges, weights=weights)
    assert lazy.read == [(7, 14), (28, 31), (31, 41), (41, 51), (51, 53)]
    truth = np.stack([exact(slice(7, 14)), *np.zeros((3, len(POINTS))), exact(slice(28, 53))], axis=-1)
    assert not contributions[:, 1:4].any()
    assert decibels(contributions - truth, truth) < -65


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"edges": np.array([0, 9, 8])}, "must ascend"),
        ({"edges": np.array([0, PULSES + 1])}, "must ascend"),
        ({"edges": np.array([0, 1]), "weights": np.ones(3)}, "weights.shape"),
    ],
)
def test_invalid_edges_and_weights_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        block_contributions(PROFILES, POINTS, **changes)
