"""Grid of a campaign: pixels, windows and positions; automatic bounds and spacing; swath."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import tried
from pyproj import Geod, Transformer
from scenes import UTM_GRID

from apertura.campaign.config import Scene
from apertura.campaign.folder import Campaign
from apertura.common.errors import CampaignError
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import ecef_from_geodetic, ecef_from_projected, projected_from_ecef
from apertura.core.scene.auto_grid import auto_bounds, utm_crs
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.map_crs import block
from apertura.core.scene.swath import swath
from apertura.core.scene.terrain import FlatGround
from apertura.stages.scene import Flown, settled


def test_positions_above_the_scene_convert_to_pixels_and_heights():
    antenna = UTM_GRID.positions_at([3.0], [-20.0], 650.0)
    np.testing.assert_allclose(UTM_GRID.pixel_below(antenna), [[3.0, -20.0, 650.0]], atol=1e-6)
    np.testing.assert_allclose(projected_from_ecef(UTM_GRID.crs, antenna)[0, 2], 650.0, atol=1e-6)


def test_grid_is_anchored_at_its_north_west_corner():
    grid = SceneGrid.from_bounds("EPSG:32632", (570656.9, 5363687.65, 570670.9, 5363701.65), spacing_m=0.05)
    assert grid.shape == (280, 280)
    np.testing.assert_allclose(grid.bounds_m, (570656.9, 5363687.65, 570670.9, 5363701.65), atol=1e-6)
    assert grid.x_m[0] == pytest.approx(570656.925)
    assert grid.y_m[0] == pytest.approx(5363701.625)


def test_tiles_cover_the_grid_once_with_unchanged_positions():
    grid = SceneGrid("EPSG:32632", 570656.9, 5363701.65, 0.05, (100, 70))
    count = np.zeros(grid.shape, int)
    whole = grid.positions(620.0)
    for window in grid.tiles(32):
        count[window] += 1
        np.testing.assert_array_equal(grid[window].positions(620.0), whole[window])
    assert (count == 1).all()


@given(
    crs=st.sampled_from(["local", "EPSG:32632"]),
    spacing_m=st.floats(0.01, 50.0),
    shape=st.tuples(st.integers(1, 600), st.integers(1, 600)),
    side=st.integers(40, 300),
    data=st.data(),
)
@tried(40, derandomize=False)
def test_coordinate_conversions_are_invertible_in_any_window(crs, spacing_m, shape, side, data):
    grid = SceneGrid(crs, 570656.9, 5363701.65, spacing_m, shape)
    window = data.draw(st.sampled_from(list(grid.tiles(side))))
    part = grid[window]
    np.testing.assert_array_equal(part.x_m, grid.x_m[window[1]])
    np.testing.assert_array_equal(part.y_m, grid.y_m[window[0]])
    row, column, height_m = (data.draw(st.floats(-5.0, 700.0)) for _ in range(3))
    tolerance_px = 1e-8 / spacing_m + 1e-9  # coordinates of millions of metres resolve about a nanometre
    np.testing.assert_allclose(part.pixel_of(*part.map_at(row, column)), (row, column), atol=tolerance_px)
    place = part.pixel_below(part.positions_at(row, column, height_m))
    np.testing.assert_allclose(place, (row, column, height_m), rtol=0, atol=10 * tolerance_px + 1e-8)
    whole = grid.pixel_of(*part.map_at(row, column))
    np.testing.assert_allclose(whole, (row + window[0].start, column + window[1].start), atol=tolerance_px)


@pytest.mark.quick("0.002-*", "300.0-EPSG:2056")
@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:2056", "EPSG:3413", "EPSG:3857"])
@pytest.mark.parametrize("spacing_m", [0.002, 1.0, 30.0, 300.0])
def test_pixel_positions_match_proj_on_any_terrain(crs, spacing_m):
    """Positions agree to 10 nm, between nodes, across blocks, on and high above the ellipsoid."""
    west_m, north_m = {"EPSG:32632": (330e3, 9.2e6), "EPSG:2056": (2.6e6, 1.2e6)}.get(crs, (1e6, -2e6))
    grid = SceneGrid(crs, west_m, north_m, spacing_m, (300, 270))[3:, 5:]
    height = np.random.default_rng(1).uniform(-400, 4000, grid.shape)
    for above in (620.0, height):
        exact = ecef_from_projected(crs, *np.meshgrid(grid.x_m, grid.y_m), np.broadcast_to(above, grid.shape))
        np.testing.assert_allclose(grid.positions(above), exact, rtol=0, atol=1e-8)


def test_blocks_too_wide_for_polynomials_use_proj():
    options = ("EPSG:32632", (9.2e6, 330e3))
    assert block(*options, 1.0, (0, 0)).exact
    assert not block(*options, 300.0, (0, 0)).exact


def test_pixel_positions_match_their_coordinates():
    grid = SceneGrid("EPSG:32632", 570656.9, 5363701.65, 0.05, (4, 4))
    np.testing.assert_allclose(
        projected_from_ecef("EPSG:32632", grid.positions(620.0))[1, 2], [570657.025, 5363701.575, 620.0], atol=1e-4
    )
    longitude, latitude = Transformer.from_crs(32632, 4326, always_xy=True).transform(grid.x_m[:2], grid.y_m[[0, 0]])
    ground = Geod(ellps="WGS84").inv(longitude[0], latitude[0], longitude[1], latitude[1])[2]
    ecef = np.linalg.norm(
        np.diff(ecef_from_projected("EPSG:32632", grid.x_m[:2], grid.y_m[[0, 0]], np.zeros(2)), axis=0)
    )
    assert ecef == pytest.approx(ground, rel=1e-6)


@pytest.mark.parametrize(("crs", "expected"), [("EPSG:4326", "not projected"), ("EPSG:99999", "unknown to PROJ")])
def test_crs_that_is_not_projected_is_rejected(crs, expected):
    with pytest.raises(CampaignError, match=expected):
        SceneGrid.from_bounds(crs, (0, 0, 1, 1), spacing_m=1)


def test_swath_contains_every_pixel_closely():
    grid = SceneGrid("local", -4.0, 14.0, 0.1, (80, 80))
    tx = np.array([[0.0, 0.0, 5.0], [1.0, 11.0, 3.0]])
    rx = tx + [1.0, 2.0, 0.0]
    near, far = swath(grid, FlatGround(0.0), Aperture(tx, rx))
    pixels = grid.positions(0.0).reshape(-1, 3)
    path = np.linalg.norm(pixels - tx[:, None], axis=-1) + np.linalg.norm(pixels - rx[:, None], axis=-1)
    assert (near <= path.min(axis=1)).all()
    assert (far >= path.max(axis=1)).all()
    assert (far - near - np.ptp(path, axis=1)).max() < 1.5


def test_automatic_bounds_extend_to_both_sides_of_the_track():
    tx = np.stack([np.linspace(-4, 4, 5), np.zeros(5), np.full(5, 5.0)], -1)
    _, ymin, _, ymax = auto_bounds(Aperture(tx, tx), crs="local", height_m=0.0, path_limit_m=np.inf)
    assert ymax == -ymin == pytest.approx(5 / np.tan(np.radians(10)), abs=1)
    xmin, ymin, xmax, ymax = auto_bounds(Aperture(tx, tx), crs="local", height_m=0.0, path_limit_m=20.0)
    farthest = Aperture(tx, tx).path(np.array([[x, y, 0.0] for x in (xmin, xmax) for y in (ymin, ymax)])).max()
    assert 16 < farthest <= 20  # at the corners, from the ends of the track; rounded to metres
    assert utm_crs(ecef_from_projected("EPSG:32755", *map(np.array, (5e5, 6.1e6, 0.0)))) == "EPSG:32755"


def test_automatic_grid_is_limited_by_the_recorded_samples(tiny):
    """A circle of 5 m at 30 m height resolves 6 cm; at most 9 pixels per sample of 100 × 512 samples are permitted."""
    angle = np.linspace(0, 2 * np.pi, 100)
    circle = np.stack([5 * np.sin(angle), 5 * np.cos(angle), np.full(100, 30.0)], -1)
    frequency = 1.2e9 + 4e5 * np.arange(512)
    flown = Flown(Aperture(circle, circle), frequency, np.inf)
    campaign = Campaign.load(tiny)
    scene = Scene(crs="local")
    campaign = replace(campaign, settings=campaign.settings.model_copy(update={"scene": scene}))
    grid, _, reasons = settled(campaign, lambda: flown)
    assert np.prod(grid.shape) <= 9 * 100 * 512
    assert (
        "than the limit of 0.461 Mpx for this flight; for a finer spacing, configure scene.bounds_m"
        in reasons["spacing_m"]
    )
    small = campaign.settings.model_copy(update={"scene": Scene(crs="local", bounds_m=(-200, -200, 200, 200))})
    # configured bounds keep the fine spacing
    grid, _, reasons = settled(replace(campaign, settings=small), lambda: flown)
    assert reasons["spacing_m"].startswith("a third of the finest resolution cell")


def test_automatic_bounds_at_the_edge_of_a_utm_zone_are_valid():
    """The scene is three metres east of 12° E, in zone 33, with bounds beyond the edge of the zone."""
    edge_m, north_m, _ = projected_from_ecef("EPSG:32633", ecef_from_geodetic(48.0, 12.0, 600.0))
    east_m, height_m = np.full((2, 41), [[edge_m + 3], [610.0]])
    track = ecef_from_projected("EPSG:32633", east_m, north_m + np.linspace(-20, 20, 41), height_m)
    crs = utm_crs(track[20])
    bounds = auto_bounds(Aperture(track, track), crs=crs, height_m=600.0, path_limit_m=np.inf)
    assert crs == "EPSG:32633"
    assert bounds[0] < edge_m < bounds[2]
    assert SceneGrid.from_bounds(crs, bounds, spacing_m=1.0).bounds_m == bounds


@pytest.mark.parametrize("zone", ["EPSG:32632", "EPSG:32633"])
def test_bounds_across_an_edge_of_utm_zones_are_valid_in_both(zone):
    x, y, _ = projected_from_ecef(zone, ecef_from_geodetic(48.0, 12.0, 600.0)).round()
    grid = SceneGrid.from_bounds(zone, (x - 50, y - 50, x + 50, y + 50), spacing_m=1.0)
    place = projected_from_ecef(zone, grid.positions_at([50.0], [50.0], 600.0))[0]
    np.testing.assert_allclose(place, (*grid.map_at(50.0, 50.0), 600.0), atol=1e-6)


@pytest.mark.parametrize(
    ("crs", "latitude", "longitude"),
    [
        ("EPSG:3460", -17.0, 179.9),
        ("EPSG:3460", -17.0, -179.5),
        ("EPSG:3851", -41.0, 174.8),
        ("EPSG:3832", 20.0, 150.0),
    ],
)
def test_crs_across_the_180th_meridian_is_accepted(crs, latitude, longitude):
    x, y, _ = projected_from_ecef(crs, ecef_from_geodetic(latitude, longitude, 10.0)).round()
    assert SceneGrid.from_bounds(crs, (x, y, x + 10, y + 10), spacing_m=1.0).shape == (10, 10)


@pytest.mark.parametrize(("longitude", "accepted"), [(3.1, True), (2.9, False), (14.9, True), (15.1, False)])
def test_utm_is_accepted_up_to_3_degrees_beyond_its_zone(longitude, accepted):
    x, y, _ = projected_from_ecef("EPSG:32632", ecef_from_geodetic(48.0, longitude, 10.0)).round()
    bounds = (x, y, x + 10, y + 10)
    if accepted:
        SceneGrid.from_bounds("EPSG:32632", bounds, spacing_m=1.0)
    else:
        with pytest.raises(CampaignError, match=r"within 3 degrees of the area of use of WGS 84 / UTM zone 32N"):
            SceneGrid.from_bounds("EPSG:32632", bounds, spacing_m=1.0)


def test_coordinates_without_an_inverse_projection_are_rejected():
    """The coordinates lie beyond the edge of the Mercator map, where longitude 181 equals -179."""
    with pytest.raises(CampaignError, match="reach longitude"):
        SceneGrid.from_bounds("EPSG:3857", (20037500.0, 0.0, 20037520.0, 10.0), spacing_m=1.0)
