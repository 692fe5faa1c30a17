"""Exact gradient of an objective of an image, compared with finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scenes import (
    TARGET_GRID,
    compiled,
    ecef,
    fly,
    pixel_grid,
    point_history,
    scatter,
    swaying_beam,
    without_library,
)

import apertura as ap
from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.contributions import Echoes, block_contributions, path_gradient

LOCAL = pixel_grid(40, 40)
POINTS = ecef(LOCAL).reshape(-1, 3)[::7]
PROFILES = fly(scatter(LOCAL)).profiles(ecef(LOCAL))
PULSES = len(PROFILES)
SIDES = ["tx_m", "rx_m"]
STEP_M = 1e-4


@pytest.fixture(params=[pytest.param(True, marks=compiled, id="compiled"), pytest.param(False, id="numpy")])
def implementation(request, monkeypatch):
    """Run a test with the compiled library and with numpy."""
    if not request.param:
        without_library(monkeypatch)


def contributions(profiles):
    """Return (pulse, point) complex128: contributions of each pulse, interpolated as in `block_contributions`."""
    return Echoes.read(profiles, [slice(0, len(profiles))]).at(POINTS)[0]


def peaks(image):
    return -(np.abs(image) ** 4).sum(), -4 * np.abs(image) ** 2 * image


def entropy(image):
    power = np.abs(image) ** 2
    share = power / power.sum()
    value = -(share * np.log(share)).sum()
    return value, -2 * image / power.sum() * (np.log(share) + value)


def displaced(pulse, axis, side, step_m):
    """Return (pulse, point) complex128: contributions with one phase centre or one path length displaced."""
    displacement_m = step_m * np.eye(PULSES)[pulse]
    if side == "path_m":  # autofocus.md, eq. 3; `moved` rotates float32 samples: too inaccurate
        rotation = np.exp(-2j * np.pi * PROFILES.centre_frequency_hz / C * displacement_m)
        return contributions(replace(PROFILES, start_m=PROFILES.start_m + displacement_m)) * rotation[:, None]
    legs = dict(zip(SIDES, PROFILES.aperture.legs, strict=True))
    legs[side] = legs[side] + displacement_m[:, None] * np.eye(3)[axis]
    return contributions(replace(PROFILES, aperture=ap.Aperture(**legs)))


def difference(objective, pulse, axis, side, weight=1.0):
    """Return the derivative of the objective by one component: central difference in float64."""
    ends = [objective((displaced(pulse, axis, side, step_m) * weight).sum(0))[0] for step_m in (STEP_M, -STEP_M)]
    return (ends[0] - ends[1]) / (2 * STEP_M)


def test_derivatives_of_the_test_objectives_are_correct():
    image = contributions(PROFILES).sum(0)
    change = 1e-6 * np.random.default_rng(5).standard_normal(image.size) * np.abs(image).max() * (1 + 2j)
    for objective in (peaks, entropy):
        gained = (objective(image + change)[0] - objective(image - change)[0]) / 2
        assert gained == pytest.approx((objective(image)[1].conj() * change).real.sum(), rel=1e-6)


@pytest.mark.quick("compiled-peaks")
@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("objective", [peaks, entropy])
def test_gradient_components_equal_finite_differences_of_the_image(objective):
    gradient = path_gradient(PROFILES, POINTS, objective(contributions(PROFILES).sum(0))[1])
    for pulse in (0, 11, 38, PULSES - 1):
        for side in SIDES:
            for axis in range(3):
                expected = difference(objective, pulse, axis, side)
                assert getattr(gradient, side)[pulse, axis] == pytest.approx(expected, rel=1e-4)
        assert gradient.path_m[pulse] == pytest.approx(difference(objective, pulse, 0, "path_m"), rel=1e-4)


@pytest.mark.usefixtures("implementation")
def test_beam_weights_are_constant_in_the_gradient():
    beams = Beams(*(swaying_beam(leg, (12.0, 0.5, 0.0), width_deg=12.0) for leg in PROFILES.aperture.legs))
    weight = beams.weight(PROFILES.aperture, POINTS)
    gradient = path_gradient(PROFILES, POINTS, peaks((contributions(PROFILES) * weight).sum(0))[1], beams=beams)
    for pulse, axis, side in [(11, 0, "tx_m"), (38, 2, "rx_m"), (60, 1, "rx_m"), (38, 0, "path_m")]:
        column = getattr(gradient, side).reshape(PULSES, -1)[pulse, axis]
        assert column == pytest.approx(difference(peaks, pulse, axis, side, weight), rel=1e-4)


@compiled
def test_block_contributions_sum_to_the_image_of_the_gradient():
    sums = block_contributions(PROFILES, POINTS, edges=np.array([0, PULSES]))[:, 0]
    image = contributions(PROFILES).sum(0)
    assert np.abs(sums - image).max() < 1e-5 * np.abs(image).max()


@compiled
@pytest.mark.usefixtures("isa")
def test_every_instruction_set_gives_the_gradient_of_numpy(monkeypatch):
    slope = peaks(contributions(PROFILES).sum(0))[1]
    beams = Beams(receive=swaying_beam(PROFILES.aperture.rx_m, (12.0, 0.5, 0.0)))
    monkeypatch.setattr(
        "apertura.core.backprojection.contributions._BYTES_AT_ONCE", 8 * 33 * (PROFILES.samples.shape[1] + 16)
    )
    monkeypatch.setattr("apertura.core.backprojection.contributions._VALUES_AT_ONCE", 33 * 50)
    fast = path_gradient(PROFILES, POINTS, slope, beams=beams)
    without_library(monkeypatch)
    slow = path_gradient(PROFILES, POINTS, slope, beams=beams)
    for side in (*SIDES, "path_m"):
        compiled_gradient, numpy_gradient = getattr(fast, side), getattr(slow, side)
        assert np.abs(compiled_gradient - numpy_gradient).max() < 2e-6 * np.abs(numpy_gradient).max()


@pytest.mark.usefixtures("implementation")
def test_gradient_scales_with_the_unit_of_the_objective():
    slope = peaks(contributions(PROFILES).sum(0))[1]
    gradient = path_gradient(PROFILES, POINTS, slope)
    assert np.allclose(path_gradient(PROFILES, POINTS, 1e-60 * slope).tx_m / 1e-60, gradient.tx_m, rtol=1e-9)
    assert not path_gradient(PROFILES, POINTS, 0 * slope).path_m.any()


@pytest.mark.slow
def test_gradient_predicts_the_change_of_the_exact_image():
    """The image is the double sum over pulses and subcarriers; all phase centres are displaced simultaneously."""
    history, patch = point_history(), TARGET_GRID[40:120, 40:120]
    rng = np.random.default_rng(6)
    displacements = {side: rng.standard_normal((len(history), 3)) for side in SIDES}
    extra_paths = rng.standard_normal(len(history))

    def value(step_m):
        legs = {
            side: leg + step_m * displacements[side] for side, leg in zip(SIDES, history.aperture.legs, strict=True)
        }
        displaced_history = history.moved(ap.Aperture(**legs), step_m * extra_paths)
        image = ap.backproject(
            displaced_history, patch, engine="reference", integration="all", presum=1, certified_pixels=0
        )
        return peaks(image.values.astype(complex))

    offset_m = 5e-3  # with exact tracks, the objective is stationary and its derivative is zero
    legs = {side: leg + offset_m * displacements[side] for side, leg in zip(SIDES, history.aperture.legs, strict=True)}
    profiles = ap.range_compress(history, TARGET_GRID, ap.FlatGround(0.0))
    profiles = profiles.moved(ap.Aperture(**legs), offset_m * extra_paths)
    gradient = ap.gradient(profiles, patch, value(offset_m)[1])
    predicted = (
        sum((getattr(gradient, side) * displacements[side]).sum() for side in SIDES) + gradient.path_m @ extra_paths
    )
    assert (value(offset_m + 2e-4)[0] - value(offset_m - 2e-4)[0]) / 4e-4 == pytest.approx(predicted, rel=2e-3)


def test_gradients_of_patches_add_up():
    history, ground = point_history(), ap.FlatGround(0.3)
    profiles = ap.range_compress(history, TARGET_GRID, ground)
    slope = np.random.default_rng(7).standard_normal((*TARGET_GRID.shape, 2)) @ [1, 1j]
    whole = ap.gradient(profiles, TARGET_GRID, slope, terrain=ground)
    halves = [slice(0, 70), slice(70, None)]
    parts = [ap.gradient(profiles, TARGET_GRID[rows, :], slope[rows], terrain=0.3) for rows in halves]
    assert np.allclose(parts[0].rx_m + parts[1].rx_m, whole.rx_m, rtol=1e-4, atol=1e-4 * np.abs(whole.rx_m).max())
    assert not np.allclose(ap.gradient(profiles, TARGET_GRID, slope).rx_m, whole.rx_m, rtol=1e-2)


@pytest.mark.parametrize(
    ("slope", "points", "message"),
    [
        (np.ones(3), POINTS[:4], "must be"),
        (np.full(4, np.nan), POINTS[:4], "finite"),
        (np.ones(4), np.full((4, 3), np.inf), "finite"),
    ],
)
def test_invalid_slopes_and_points_are_refused(slope, points, message):
    with pytest.raises(ValueError, match=message):
        path_gradient(PROFILES, points, slope)


def test_profile_stage_is_accepted_and_other_stages_are_refused():
    profiles = ap.range_compress(point_history(), TARGET_GRID, ap.FlatGround(0.0))
    patch, slope = TARGET_GRID[60:70, 60:70], np.full((10, 10), 1 + 1j)
    stage = xr.Dataset(
        {
            "profile": (("pulse", "range"), profiles.samples),
            "start": ("pulse", profiles.start_m),
            "tx_position": (("pulse", "axis"), profiles.aperture.tx_m),
            "rx_position": (("pulse", "axis"), profiles.aperture.rx_m),
        },
        attrs={
            name: getattr(profiles, name)
            for name in ("step_m", "centre_frequency_hz", "oversampling", "wave_speed_m_s")
        },
    )
    from_arrays, from_stage = (ap.gradient(profile_input, patch, slope) for profile_input in (profiles, stage))
    assert np.array_equal(from_arrays.rx_m, from_stage.rx_m)
    for profile_input in (point_history(), stage.drop_vars("profile")):
        with pytest.raises(CampaignError, match="expected Profiles, or the dataset of stage profile"):
            ap.gradient(profile_input, patch, slope)


def test_public_function_requires_a_slope_for_each_pixel():
    with pytest.raises(CampaignError, match="of the grid's shape"):
        ap.gradient(PROFILES, TARGET_GRID, np.ones((4, 4)))
