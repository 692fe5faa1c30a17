"""Flat ground, planes and DEMs under a scene: heights, target positions, clearance of antennas."""

import numpy as np
import pytest
from scenes import UTM_GRID

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.backprojection.engines import reference
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.geometry.aperture import Aperture
from apertura.core.quality.point_targets import find_peak
from apertura.core.scene.clearance import check_antennas, clearance
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import balls, swath
from apertura.core.scene.terrain import FlatGround, GridHeights, Plane

FREQUENCY = 1.2e9 + 4e6 * np.arange(100)


LOCAL = SceneGrid("local", -3.0, 15.0, 0.1, (60, 60))


def history(track, targets):
    """Return exact monostatic echoes of unit points at `targets`."""
    path = 2 * np.linalg.norm(track[:, None] - np.atleast_2d(targets), axis=-1)
    echo = np.exp(-2j * np.pi * FREQUENCY[None, None] * path[..., None] / SPEED_OF_LIGHT_M_S).sum(axis=1)
    zeros = np.zeros(len(track))
    return PhaseHistory(echo.astype(np.complex64), FREQUENCY, np.hanning(100) / 50, zeros, Aperture(track, track))


def track_at(height, count=48):
    return np.stack([np.linspace(-4, 4, count), np.zeros(count), np.full(count, height)], -1)


def brightest(magnitude, near):
    down, right = np.unravel_index(magnitude[near].argmax(), magnitude[near].shape)
    return near[0].start + down, near[1].start + right


def focus(spectra, heights=0.0):
    return reference.form(spectra, LOCAL.positions(heights)) / len(spectra.transfer)


def test_constant_dem_equals_a_lowered_track():
    spectra = history(track_at(8.0), [0.5, 12.0, 3.0])
    lowered = history(track_at(5.0), [0.5, 12.0, 0.0])
    raised = focus(spectra, np.full(LOCAL.shape, 3.0))
    np.testing.assert_allclose(raised, focus(lowered), atol=1e-5 * np.abs(raised).max())


def test_raised_target_is_displaced_on_flat_ground_but_not_on_its_dem():
    """On flat ground, a target of height h appears at the point of equal range, √(y² − 2Hh + h²)."""
    spectra = history(track_at(8.0), [0.5, 12.0, 1.2])
    y = np.broadcast_to(LOCAL.y_m[:, None], LOCAL.shape)
    for heights, expected_y_m in ((0.0, np.sqrt(12.0**2 - 2 * 8 * 1.2 + 1.2**2)), (np.where(y > 10.5, 1.2, 0.0), 12.0)):
        image = focus(spectra, heights)
        peak = find_peak(image, *np.unravel_index(np.abs(image).argmax(), image.shape))
        place_m = LOCAL.map_at(peak.row, peak.column)
        assert place_m[0] == pytest.approx(0.5, abs=0.02)
        assert place_m[1] == pytest.approx(expected_y_m, abs=0.02)


@pytest.mark.parametrize("facing", [20.0, -20.0])
def test_targets_on_a_tilted_plane_focus_only_with_a_dem(facing):
    """The plane rises across and along the track; on flat ground the targets lose more than half of their amplitude."""
    slope = np.tan(np.radians(facing))
    y, x = np.meshgrid(LOCAL.y_m, LOCAL.x_m, indexing="ij")
    plane = slope * ((y - 12) + x) / np.sqrt(2)
    targets = [(px, py, slope * ((py - 12) + px) / np.sqrt(2)) for px, py in ((-2.0, 10.5), (0.5, 12.0), (2.0, 13.5))]
    spectra = history(track_at(8.0), targets)
    image = focus(spectra, plane)
    right = np.abs(image)
    for px, py, up in targets:
        row, column = map(float, LOCAL.pixel_of(px, py))
        near = (slice(int(row) - 3, int(row) + 5), slice(int(column) - 3, int(column) + 5))
        peak = find_peak(image, *brightest(right, near))
        assert np.hypot(peak.row - row, peak.column - column) * 0.1 < 0.03
        assert abs(peak.value) > 0.97
        if abs(up) > 0.5:
            assert abs(reference.form(spectra, np.array([[px, py, 0.0]]))[0]) / len(spectra.transfer) < 0.5


def test_swath_contains_the_path_of_every_pixel_on_terrain():
    generator = np.random.default_rng(4)
    heights = 3 * generator.standard_normal((150, 90))
    grid = SceneGrid("local", 0.0, 15.0, 0.1, (150, 90))
    track = track_at(9.0) - [0.0, 6.0, 0.0]
    near, far = swath(grid, GridHeights(grid, heights), Aperture(track, track))
    path = 2 * np.linalg.norm(grid.positions(heights) - track[:, None, None], axis=-1)
    assert (near <= path.min(axis=(1, 2))).all()
    assert (far >= path.max(axis=(1, 2))).all()
    assert (far - near).max() < np.ptp(path) + 4 * np.ptp(heights)


def test_bounds_of_windows_do_not_depend_on_joint_reading():
    """Strips of 1200 × 1800 pixels are read in two parts; windows that are not adjacent are read individually."""
    grid = SceneGrid("local", 0.0, 120.0, 0.1, (1200, 1800))
    terrain = GridHeights(grid, np.random.default_rng(5).standard_normal(grid.shape))
    tiles = list(grid.tiles(600))
    windows = [*tiles, tiles[4], tiles[2], tiles[0]]
    middle_m, radius_m = balls(grid, terrain, windows)
    alone = [balls(grid, terrain, [window]) for window in windows]
    assert np.array_equal(middle_m, np.concatenate([middle for middle, _ in alone]))
    assert np.array_equal(radius_m, np.concatenate([radius for _, radius in alone]))


def test_clearance_is_the_height_above_the_pixel_below():
    heights = np.add.outer(np.arange(70.0), np.zeros(90))
    antenna = UTM_GRID.positions_at([10, 10.3, 500], [7, 80, 3], np.array([12.0, 15.0, 20.0]))
    above, ground = clearance(UTM_GRID, GridHeights(UTM_GRID, heights), antenna)
    np.testing.assert_allclose(above, [2, 5, np.nan])  # outside the scene: unknown
    np.testing.assert_allclose(ground, [10, 10, np.nan])
    # flat ground extends beyond the scene
    np.testing.assert_allclose(clearance(UTM_GRID, FlatGround(600.0), antenna)[0][2], 20 - 600)


def test_antenna_below_ground_is_rejected_and_outside_a_dem_flagged():
    hill = GridHeights(UTM_GRID, np.full(UTM_GRID.shape, 650.0))
    track = UTM_GRID.positions_at(np.arange(5.0), -40.0, np.array([660.0, 651.0, 649.5, 655.0, 660.0]))
    high = UTM_GRID.positions_at(np.arange(5.0), 10.0, 700.0)
    with pytest.raises(
        CampaignError, match=r"f01: at 1 pulse the receiver is at or below .* worst at pulse 2: clearance -0.50 m"
    ):
        check_antennas(UTM_GRID, FlatGround(650.0), Aperture(high, track), where="f01")
    low = UTM_GRID.positions_at(np.arange(5.0), 10.0, 649.0)
    with pytest.raises(CampaignError, match=r"scene\.dem: .*transmitter.*, DEM height 650.00 m"):
        check_antennas(UTM_GRID, hill, Aperture(low, track), where="f01")
    flags = check_antennas(UTM_GRID, hill, Aperture(high, track), where="f01")
    assert flags["platform_below_scene"].startswith("the receiver is 0.5 m below the lowest terrain of the scene")
    assert check_antennas(UTM_GRID, hill, Aperture(high, high), where="f01") == {}


@pytest.mark.parametrize("grid", [UTM_GRID, LOCAL], ids=["on Earth", "local"])
def test_flat_ground_level_plane_and_constant_dem_agree(grid):
    """Positions agree to two units in the last place of ECEF, also between pixels."""
    level = [
        FlatGround(612.5),
        Plane(grid.west_m, grid.north_m, 612.5, 0.0, 0.0),
        GridHeights(grid, np.full(grid.shape, 612.5)),
    ]
    window = grid[3:40, 5:50]
    whole = [ground.positions(grid) for ground in level]
    for ground, positions in zip(level, whole, strict=True):
        np.testing.assert_allclose(positions, whole[0], rtol=0, atol=2e-9)
        np.testing.assert_array_equal(ground.positions(window), positions[3:40, 5:50])
        np.testing.assert_array_equal(ground.heights_at(grid, [3.2, 7.0], [5.0, 0.4]), 612.5)


def test_constant_dem_and_level_plane_images_equal_flat_ground():
    spectra = history(track_at(8.0), [0.5, 12.0, 1.2])
    images = [
        reference.form(spectra, ground.positions(LOCAL))
        for ground in (FlatGround(1.2), Plane(0.0, 0.0, 1.2, 0.0, 0.0), GridHeights(LOCAL, np.full(LOCAL.shape, 1.2)))
    ]
    for image in images[1:]:
        np.testing.assert_array_equal(image, images[0])


def test_heights_between_pixels_follow_a_plane():
    grid = SceneGrid("local", -300.0, 600.0, 1.0, (600, 700))
    plane = Plane(0.0, 0.0, 5.0, east=0.3, north=-0.1)
    stored = GridHeights(grid, plane.heights(grid))
    row, column = np.random.default_rng(3).uniform(0, 1, (2, 400)) * (np.array(grid.shape) - 1)[:, None]
    np.testing.assert_allclose(stored.heights_at(grid, row, column), plane.heights_at(grid, row, column), atol=1e-9)
    inner = grid[100:, 200:]
    np.testing.assert_allclose(stored.heights_at(inner, 4.5, 6.5), stored.heights_at(grid, 104.5, 206.5))
    assert np.isnan(stored.heights_at(grid, [-0.6, 10.0], [3.0, 699.6])).all()
    coarse = grid.coarse(50)
    np.testing.assert_allclose(stored.heights(coarse), plane.heights(coarse), atol=1e-9)
