"""Visibility of terrain: shadow, layover, incidence and bistatic angle."""

import numpy as np
import pytest
from scenes import UTM_GRID

from apertura.core.scene.angles import bistatic_angle_deg, incidence_deg, surface_normals
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import GridHeights
from apertura.core.scene.visibility import LAYOVER, SHADOW, Relief, visibility
from apertura.formats.export import layers as exported

STREET = SceneGrid("local", 0.0, 3.0, 0.25, (12, 240))


ROW = (slice(6, 7), slice(0, 240))


def mask_of(heights, antenna, grid=STREET, window=ROW):
    relief = Relief.of(grid, GridHeights(grid, heights), 0.0)
    pulses = relief.above(np.atleast_2d(np.asarray(antenna, float)))
    return visibility(relief, pulses, pulses, window)


@pytest.mark.parametrize("wall_m", [1.5, 2.0, 3.0])
def test_shadow_and_layover_of_a_wall_follow_the_geometry(wall_m):
    """Shadow length h·d/(H − h) behind the wall; layover length d − √(d² − 2Hh + h²) in front of it."""
    heights = np.zeros(STREET.shape)
    heights[:, 80] = wall_m
    antenna, wall_x = np.array([-10.0, 1.375, 8.0]), STREET.x_m[80]
    mask, distance_m = mask_of(heights, antenna)[0], wall_x + 10.0
    shade = np.flatnonzero(mask & 1)
    fold = np.flatnonzero(mask & 2)
    assert shade[0] == 81
    assert len(shade) * 0.25 == pytest.approx(wall_m * distance_m / (8 - wall_m), abs=0.25)
    assert fold[-1] == 80
    assert (len(fold) - 1) * 0.25 == pytest.approx(
        distance_m - np.sqrt(distance_m**2 - 16 * wall_m + wall_m**2), abs=0.25
    )


def test_flat_ground_has_no_shadow_or_layover():
    grid = SceneGrid("local", -10.0, 10.0, 0.5, (40, 40))
    everything = (slice(0, 40), slice(0, 40))
    assert not mask_of(np.zeros(grid.shape), [0.1, 0.2, 6.0], grid, everything).any()


@pytest.mark.parametrize(("slope_deg", "expected"), [(-60.0, 1), (-20.0, 0), (20.0, 0), (75.0, 2)])
def test_steep_planes_are_in_shadow_or_layover(slope_deg, expected):
    """At a grazing angle of about 40°, planes that fall more steeply are in shadow, planes above 50° in layover."""
    middle = STREET.x_m - 30
    heights = np.broadcast_to(np.tan(np.radians(slope_deg)) * middle, STREET.shape)
    antenna = np.array([30.0 - 300.0, 1.375, 300 * np.tan(np.radians(40.0))])
    inner = mask_of(heights, antenna)[0, 2:-2]
    np.testing.assert_array_equal(inner, expected)


def test_shadow_on_random_hills_matches_dense_sampling():
    """The search, which skips whole blocks, agrees with dense sampling of bilinear terrain."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    generator = np.random.default_rng(1)
    grid = SceneGrid("local", 0.0, 30.0, 0.5, (60, 60))
    hills = 40 * gaussian_filter(generator.standard_normal(grid.shape), 4)
    antenna = np.array([-60.0, 12.0, 20.0])  # far to the west: every line leaves the scene at a column of pixels
    mask = mask_of(hills, antenna, grid, (slice(0, 60), slice(0, 60))) & 1
    row, column, up = grid.pixel_below(antenna)
    margin = np.full(grid.shape, -np.inf)
    for i, j in np.ndindex(grid.shape):
        share = np.arange(1, j + 0.01, 0.125) / (j - column)
        r, c = i + share * (row - i), j + share * (column - j)
        inside = (r >= 0) & (r <= 59)
        ground = map_coordinates(hills, [r[inside], c[inside]], order=1)
        line = hills[i, j] + share[inside] * (up - hills[i, j])
        margin[i, j] = (ground - line).max(initial=-np.inf)
    clear = np.abs(margin) > 0.02
    assert clear.mean() > 0.95
    assert 0.2 < mask.mean() < 0.8
    np.testing.assert_array_equal(mask[clear], margin[clear] > 0)


def test_shadow_needs_most_pulses_of_either_antenna():
    heights = np.zeros(STREET.shape)
    heights[:, 80] = 2.0
    low, high = [-10.0, 1.375, 8.0], [-10.0, 1.375, 200.0]
    behind = (6, 90)
    for antennas, dark in (([low, low, high], 1), ([low, high, high], 0)):
        assert mask_of(heights, antennas)[0, behind[1]] & 1 == dark
    relief = Relief.of(STREET, GridHeights(STREET, heights), 0.0)
    tx, rx = (relief.above(np.array([antenna])) for antenna in (high, low))
    for pair in ((tx, rx), (rx, tx)):
        assert visibility(relief, *pair, ROW)[0, behind[1]] & 1 == 1


def test_earth_curvature_hides_distant_terrain():
    """At 5 km, terrain at antenna height is hidden by the bulge d²/8R of half a metre, but not in a plane frame."""
    for crs, west, north, dark in (("local", 0.0, 0.0, 0), ("EPSG:32632", 500000.0, 5400000.0, 1)):
        grid = SceneGrid(crs, west, north, 25.0, (3, 200))
        antenna_position = (west, north - 37.5, 0.3)
        antenna = antenna_position if crs == "local" else grid.positions_at([1.0], [-0.5], np.array([0.3]))[0]
        mask = mask_of(np.zeros(grid.shape), antenna, grid, (slice(1, 2), slice(0, 200)))
        assert mask[0, 198] & 1 == dark


def test_incidence_is_measured_from_the_surface_normal():
    grid = SceneGrid(UTM_GRID.crs, UTM_GRID.west_m, UTM_GRID.north_m, 0.5, (9, 9))
    tilt = np.tan(np.radians(15.0))
    east = np.broadcast_to((grid.x_m - grid.x_m[4])[None], grid.shape)
    antenna = grid.positions_at([4.0], [4 - 200.0], np.array([700.0]))[0]
    for heights, expected in ((600 + 0 * east, 45.0), (600 + tilt * east, 30.0), (600 - tilt * east, 60.0)):
        position = grid.positions(heights)
        incidence = incidence_deg(position, surface_normals(position), antenna)[4, 4]
        assert incidence == pytest.approx(expected, abs=0.05)


def test_bistatic_angle_is_zero_for_a_monostatic_pair():
    target = np.array([0.0, 10.0, 0.0])
    tx, rx = np.array([-5.0, 0.0, 0.0]), np.array([5.0, 0.0, 0.0])
    assert bistatic_angle_deg(target, tx, tx) == 0
    assert bistatic_angle_deg(target, tx, rx) == pytest.approx(2 * np.degrees(np.arctan(0.5)))


def test_mask_bits_equal_the_exported_ones():
    assert (SHADOW, LAYOVER) == (exported.SHADOW, exported.LAYOVER)
