"""Choice of the terrain model: plane, tilted plane or DEM."""

import numpy as np
import pytest
from scenes import WAVELENGTH, ground_of, monostatic, plan, planning_job, straight_track

from apertura.common.errors import CampaignError
from apertura.core.planning.decisions import decide_terrain
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, Plane


def terrain(height_m: float, *, slope: float = 0.0, wobble_m: float = 0.1, spacing_m: float = 10.0):
    heights = np.tile(slope * np.arange(5.0)[:, None], 5)
    heights[2, 2] += height_m
    job = planning_job(
        aperture=monostatic(straight_track(wobble_m=wobble_m)), terrain=ground_of(heights), spacing_m=spacing_m
    )
    return decide_terrain(job).value


def test_flat_terrain_is_assumed_within_the_focus_limit():
    """The limit 4πd·Δθ/(√2λ) < 0.4, with a wobble amplitude d = 0.1 m and Δθ = δh/20 m, gives δh < 2.25 m."""
    limit_m = 0.4 * np.sqrt(2) * WAVELENGTH * 20 / (4 * np.pi * 0.1)
    assert terrain(0.97 * limit_m) == "plane"
    assert terrain(1.1 * limit_m) == "dem"
    assert terrain(1.1 * limit_m, wobble_m=0.05) == "plane"


def test_flat_terrain_is_assumed_within_the_displacement_limit():
    """The limit of half a pixel of 0.2 m, at 10 m height and 20 m ground range, gives δh < 0.2 m."""
    assert terrain(0.15, wobble_m=0.0, spacing_m=0.2) == "plane"
    assert terrain(0.25, wobble_m=0.0, spacing_m=0.2) == "dem"


def test_a_slope_is_a_tilted_plane():
    assert terrain(0.0, slope=1.5) == "tilted_plane"
    assert terrain(0.0, slope=0.3) == "plane"


def test_tilted_plane_is_fitted_to_the_dem():
    """The plane rises by 1 cm per row and 5 cm per column of pixels; pixel (0, 0) is 7 m below the level surface."""
    row, column = np.indices((200, 200))
    heights = 0.01 * row + 0.05 * column - 2.0
    sloped = plan(terrain=ground_of(heights, level_m=5.0))
    assert sloped.choices["terrain"] == "tilted_plane"
    assert isinstance(sloped.terrain, Plane)
    assert (sloped.terrain.east, sloped.terrain.north) == (pytest.approx(1.0), pytest.approx(-0.2))
    assert sloped.choices["ground"] == sloped.terrain.spec
    grid = SceneGrid("local", 0.0, 10.0, 0.05, (200, 200))
    np.testing.assert_allclose(sloped.terrain.heights(grid), heights, atol=1e-9)
    np.testing.assert_array_equal(
        sloped.terrain.heights(grid[100:102, 40:300]), sloped.terrain.heights(grid)[100:102, 40:]
    )


def test_flat_and_rough_terrain_use_plane_and_dem():
    smooth, rough = (
        ground_of(heights) for heights in (np.full((9, 9), 1e-4), np.random.default_rng(0).normal(size=(9, 9)))
    )
    assert plan(terrain=smooth).terrain == FlatGround(0.0)
    assert plan(terrain=rough).terrain is rough.full
    assert plan(terrain=smooth, overrides={"terrain": "dem"}).terrain is smooth.full
    with pytest.raises(CampaignError, match="terrain model dem, but the scene has no DEM; expected plane or auto"):
        plan(overrides={"terrain": "dem"})


def test_plan_without_a_dem_states_the_tolerated_height_error():
    assert "no DEM; tolerated height error" in plan().reasons["terrain"]
