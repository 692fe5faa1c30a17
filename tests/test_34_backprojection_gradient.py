"""The exact gradient of an objective of the image, against finite differences of the image it belongs to."""

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
PLACES = ecef(LOCAL).reshape(-1, 3)[::7]
PROFILES = fly(scatter(LOCAL)).profiles(ecef(LOCAL))
PULSES = len(PROFILES)
SIDES = ["tx_m", "rx_m"]
STEP_M = 1e-4


@pytest.fixture(params=[pytest.param(True, marks=compiled, id="compiled"), pytest.param(False, id="numpy")])
def way(request, monkeypatch):
    """Both ways in which gradients are computed, one after the other."""
    if not request.param:
        without_library(monkeypatch)


def added(profiles):
    """(pulse, place) complex128: what each pulse adds, by the interpolant of `block_contributions` in float64."""
    return Echoes.read(profiles, [slice(0, len(profiles))]).at(PLACES)[0]


def peaks(image):
    return -(np.abs(image) ** 4).sum(), -4 * np.abs(image) ** 2 * image


def entropy(image):
    power = np.abs(image) ** 2
    share = power / power.sum()
    value = -(share * np.log(share)).sum()
    return value, -2 * image / power.sum() * (np.log(share) + value)


def displaced(pulse, axis, side, step_m):
    """(pulse, place) complex128: what is added with one phase centre moved, or one pulse's echoes further."""
    one = step_m * np.eye(PULSES)[pulse]
    if side == "path_m":  # autofocus.md, eq. 3; `moved` turns samples in float32, too coarse for a small step
        turn = np.exp(-2j * np.pi * PROFILES.centre_frequency_hz / C * one)
        return added(replace(PROFILES, start_m=PROFILES.start_m + one)) * turn[:, None]
    legs = dict(zip(SIDES, PROFILES.aperture.legs, strict=True))
    legs[side] = legs[side] + one[:, None] * np.eye(3)[axis]
    return added(replace(PROFILES, aperture=ap.Aperture(**legs)))


def difference(objective, pulse, axis, side, weight=1.0):
    """∂J of one component by a central difference in float64."""
    ends = [objective((displaced(pulse, axis, side, at) * weight).sum(0))[0] for at in (STEP_M, -STEP_M)]
    return (ends[0] - ends[1]) / (2 * STEP_M)


def test_the_objectives_here_change_as_they_say():
    image = added(PROFILES).sum(0)
    change = 1e-6 * np.random.default_rng(5).standard_normal(image.size) * np.abs(image).max() * (1 + 2j)
    for objective in (peaks, entropy):
        gained = (objective(image + change)[0] - objective(image - change)[0]) / 2
        assert gained == pytest.approx((objective(image)[1].conj() * change).real.sum(), rel=1e-6)


@pytest.mark.quick("compiled-peaks")
@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("objective", [peaks, entropy])
def test_every_component_is_the_finite_difference_of_the_image(objective):
    found = path_gradient(PROFILES, PLACES, objective(added(PROFILES).sum(0))[1])
    for pulse in (0, 11, 38, PULSES - 1):
        for side in SIDES:
            for axis in range(3):
                expected = difference(objective, pulse, axis, side)
                assert getattr(found, side)[pulse, axis] == pytest.approx(expected, rel=1e-4)
        assert found.path_m[pulse] == pytest.approx(difference(objective, pulse, 0, "path_m"), rel=1e-4)


@pytest.mark.usefixtures("way")
def test_weights_of_beams_are_in_the_gradient_as_they_stand():
    beams = Beams(*(swaying_beam(leg, (12.0, 0.5, 0.0), width_deg=12.0) for leg in PROFILES.aperture.legs))
    weight = beams.weight(PROFILES.aperture, PLACES)
    found = path_gradient(PROFILES, PLACES, peaks((added(PROFILES) * weight).sum(0))[1], beams=beams)
    for pulse, axis, side in [(11, 0, "tx_m"), (38, 2, "rx_m"), (60, 1, "rx_m"), (38, 0, "path_m")]:
        column = getattr(found, side).reshape(PULSES, -1)[pulse, axis]
        assert column == pytest.approx(difference(peaks, pulse, axis, side, weight), rel=1e-4)


@compiled
def test_the_gradient_belongs_to_the_image_of_block_contributions():
    sums = block_contributions(PROFILES, PLACES, edges=np.array([0, PULSES]))[:, 0]
    image = added(PROFILES).sum(0)
    assert np.abs(sums - image).max() < 1e-5 * np.abs(image).max()


@compiled
@pytest.mark.usefixtures("isa")
def test_every_instruction_set_gives_what_numpy_gives(monkeypatch):
    slope = peaks(added(PROFILES).sum(0))[1]
    beams = Beams(receive=swaying_beam(PROFILES.aperture.rx_m, (12.0, 0.5, 0.0)))
    monkeypatch.setattr(
        "apertura.core.backprojection.contributions._BYTES_AT_ONCE", 8 * 33 * (PROFILES.samples.shape[1] + 16)
    )
    monkeypatch.setattr("apertura.core.backprojection.contributions._VALUES_AT_ONCE", 33 * 50)
    fast = path_gradient(PROFILES, PLACES, slope, beams=beams)
    without_library(monkeypatch)
    slow = path_gradient(PROFILES, PLACES, slope, beams=beams)
    for side in (*SIDES, "path_m"):
        one, other = getattr(fast, side), getattr(slow, side)
        assert np.abs(one - other).max() < 2e-6 * np.abs(other).max()


@pytest.mark.usefixtures("way")
def test_an_objective_may_have_any_unit():
    slope = peaks(added(PROFILES).sum(0))[1]
    found = path_gradient(PROFILES, PLACES, slope)
    assert np.allclose(path_gradient(PROFILES, PLACES, 1e-60 * slope).tx_m / 1e-60, found.tx_m, rtol=1e-9)
    assert not path_gradient(PROFILES, PLACES, 0 * slope).path_m.any()


@pytest.mark.slow
def test_a_change_of_the_exact_image_is_foretold():
    """The double sum over pulses and subcarriers, all phase centres moved at once."""
    history, patch = point_history(), TARGET_GRID[40:120, 40:120]
    rng = np.random.default_rng(6)
    moves = {side: rng.standard_normal((len(history), 3)) for side in SIDES}
    further = rng.standard_normal(len(history))

    def value(step_m):
        legs = {side: leg + step_m * moves[side] for side, leg in zip(SIDES, history.aperture.legs, strict=True)}
        moved = history.moved(ap.Aperture(**legs), step_m * further)
        image = ap.backproject(moved, patch, engine="reference", integration="all", presum=1, certified_pixels=0)
        return peaks(image.values.astype(complex))

    astray = 5e-3  # where the logs are right the objective is at its peak, and nothing is to be foretold
    legs = {side: leg + astray * moves[side] for side, leg in zip(SIDES, history.aperture.legs, strict=True)}
    profiles = ap.range_compress(history, TARGET_GRID, ap.FlatGround(0.0))
    profiles = profiles.moved(ap.Aperture(**legs), astray * further)
    found = ap.gradient(profiles, patch, value(astray)[1])
    foretold = sum((getattr(found, side) * moves[side]).sum() for side in SIDES) + found.path_m @ further
    assert (value(astray + 2e-4)[0] - value(astray - 2e-4)[0]) / 4e-4 == pytest.approx(foretold, rel=2e-3)


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
    ("slope", "places", "said"),
    [
        (np.ones(3), PLACES[:4], "must be"),
        (np.full(4, np.nan), PLACES[:4], "finite"),
        (np.ones(4), np.full((4, 3), np.inf), "finite"),
    ],
)
def test_what_does_not_fit_is_refused(slope, places, said):
    with pytest.raises(ValueError, match=said):
        path_gradient(PROFILES, places, slope)


def test_a_stage_of_profiles_does_as_well_as_arrays_and_other_stages_are_refused():
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
    one, other = (ap.gradient(given, patch, slope) for given in (profiles, stage))
    assert np.array_equal(one.rx_m, other.rx_m)
    for given in (point_history(), stage.drop_vars("profile")):
        with pytest.raises(CampaignError, match="expected Profiles, or the dataset of stage profile"):
            ap.gradient(given, patch, slope)


def test_the_front_door_wants_a_slope_for_each_pixel():
    with pytest.raises(CampaignError, match="of the grid's shape"):
        ap.gradient(PROFILES, TARGET_GRID, np.ones((4, 4)))
