"""Terrain: heights where they are true, datums never guessed, and what of it a radar can see."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import from_origin

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.errors import CampaignError
from apertura.export import layers as exported
from apertura.focus.engines import reference
from apertura.focus.inputs import PhaseHistory
from apertura.geometry.aperture import Aperture
from apertura.geometry.geodesy import projected_from_ecef
from apertura.quality.point_targets import find_peak
from apertura.scene import geoid, sightlines
from apertura.scene.clearance import check_antennas, clearance
from apertura.scene.dem_file import open_dem
from apertura.scene.grid import SceneGrid
from apertura.scene.swath import swath
from apertura.scene.terrain import FlatGround, GridHeights, Plane
from apertura.scene.visibility import Relief, bistatic_angle_deg, incidence_deg, surface_normals, visibility


def write_dem(path, heights, transform, crs="EPSG:32632", **profile):
    rows, columns = heights.shape
    shape = {"height": rows, "width": columns, "count": 1, "dtype": heights.dtype}
    with rasterio.open(path, "w", "GTiff", crs=crs, transform=transform, **shape, **profile) as raster:
        raster.write(heights, 1)
    return path


def plane_dem(path, slope=(0.0, 0.0), base=600.0, crs="EPSG:32632", **profile):
    """Posts every 2 m from (500000, 5400100) to the south-east; `slope` east and north, metres per metre."""
    east, north = 500001.0 + 2 * np.arange(60), 5400099.0 - 2 * np.arange(60)
    heights = base + slope[0] * (east[None] - 500060) + slope[1] * (north[:, None] - 5400040)
    return write_dem(path, heights, from_origin(500000, 5400100, 2, 2), crs, **profile)


GRID = SceneGrid("EPSG:32632", 500020.0, 5400060.0, 0.5, (70, 90))


# Heights


def test_a_plane_comes_out_of_the_dem_as_a_plane(tmp_path):
    heights = open_dem(plane_dem(tmp_path / "dem.tif", (0.3, -0.2)), GRID.crs, datum="ellipsoid").heights(GRID)
    expected = 600 + 0.3 * (GRID.x_m[None] - 500060) - 0.2 * (GRID.y_m[:, None] - 5400040)
    np.testing.assert_allclose(heights, expected, atol=1e-6)


def test_a_dem_in_another_crs_puts_its_posts_where_they_are(shared):
    """Each post of the isce3 DEM, looked up at its own place in UTM, has its own height."""
    path = shared / "dem_isce3" / "SanAnd_dem.tif"
    with rasterio.open(path) as raster:
        posts, transform = raster.read(1), raster.transform
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32611", always_xy=True)
    terrain = open_dem(path, "EPSG:32611", datum="ellipsoid")
    for row, column in ((0, 0), (120, 50), (251, 107)):
        x, y = to_utm.transform(*(transform * (column + 0.5, row + 0.5)))
        place = SceneGrid("EPSG:32611", x - 0.5, y + 0.5, 1.0, (1, 1))
        assert terrain.heights(place)[0, 0] == pytest.approx(posts[row, column], abs=2e-3)


def test_egm96_heights_become_ellipsoidal_by_the_undulation_in_the_grid_file(shared):
    """Against the .gtx read directly, without PROJ."""
    path, gtx = shared / "dem_isce3" / "SanAnd_dem.tif", shared / "dem_isce3" / "egm96_15.gtx"
    grid = SceneGrid("EPSG:32611", 368000.0, 3783000.0, 40.0, (60, 50))
    raised = open_dem(path, grid.crs, datum="egm96", geoid=gtx).heights(grid)
    raw = open_dem(path, grid.crs, datum="ellipsoid").heights(grid)
    with rasterio.open(gtx) as raster:
        undulations, inverse = raster.read(1).astype(float), ~raster.transform
    x, y = np.meshgrid(grid.x_m, grid.y_m)
    longitude, latitude = Transformer.from_crs(grid.crs, "EPSG:4326", always_xy=True).transform(x, y)
    column, row = inverse * (longitude, latitude)
    column, row = column - 0.5, row - 0.5
    i, j = np.floor(row).astype(int), np.floor(column).astype(int)
    low, high = ((1 - column % 1) * undulations[k, j] + column % 1 * undulations[k, j + 1] for k in (i, i + 1))
    np.testing.assert_allclose(raised - raw, (1 - row % 1) * low + row % 1 * high, atol=1e-3)
    assert -36 < (raised - raw).mean() < -34


def test_a_pixel_has_the_same_height_in_whatever_window(shared):
    path, gtx = shared / "dem_isce3" / "SanAnd_dem.tif", shared / "dem_isce3" / "egm96_15.gtx"
    grid = SceneGrid("EPSG:32611", 368000.0, 3783000.0, 7.0, (100, 130))
    terrain = open_dem(path, grid.crs, datum="egm96", geoid=gtx)
    whole = terrain.heights(grid)
    for window in grid.tiles(48):
        np.testing.assert_array_equal(terrain.heights(grid[window]), whole[window])


def test_a_missing_geoid_grid_is_an_error_that_names_it(shared, monkeypatch, tmp_path):
    monkeypatch.setattr(geoid, "grid_folders", lambda: [tmp_path])
    path = shared / "dem_isce3" / "SanAnd_dem.tif"
    with pytest.raises(CampaignError, match=r"us_nga_egm96_15\.tif or egm96_15\.gtx.*scene\.geoid"):
        open_dem(path, "EPSG:32611", datum="egm96")
    with pytest.raises(CampaignError, match=r"us_nga_egm08_25\.tif"):
        open_dem(path, "EPSG:32611", datum="egm2008")
    with pytest.raises(CampaignError, match=r"nowhere\.gtx: no such file"):
        open_dem(path, "EPSG:32611", datum="egm96", geoid=tmp_path / "nowhere.gtx")


def test_a_geoid_grid_is_found_where_proj_looks(shared, monkeypatch, tmp_path):
    folder = tmp_path / "with space"
    folder.mkdir()
    (folder / "egm96_15.gtx").write_bytes((shared / "dem_isce3" / "egm96_15.gtx").read_bytes())
    monkeypatch.setenv("PROJ_DATA", str(folder))
    terrain = open_dem(shared / "dem_isce3" / "SanAnd_dem.tif", "EPSG:32611", datum="egm96")
    assert terrain.geoid == folder / "egm96_15.gtx"
    assert np.isfinite(terrain.heights(SceneGrid("EPSG:32611", 368000.0, 3783000.0, 40.0, (3, 3)))).all()


def test_a_geoid_grid_in_the_working_folder_opens_by_its_bare_name(shared, monkeypatch):
    """As the workflow names it, from inside the campaign folder."""
    monkeypatch.chdir(shared / "dem_isce3")
    terrain = open_dem(Path("SanAnd_dem.tif"), "EPSG:32611", datum="egm96", geoid=Path("egm96_15.gtx"))
    assert np.isfinite(terrain.heights(SceneGrid("EPSG:32611", 368000.0, 3783000.0, 40.0, (3, 3)))).all()


def test_the_grid_of_another_geoid_is_refused(shared):
    with pytest.raises(CampaignError, match="another geoid than egm2008"):
        geoid.geoid_file("egm2008", shared / "dem_isce3" / "egm96_15.gtx")


def test_what_the_dem_carries_is_taken_or_must_agree(shared, tmp_path, monkeypatch):
    monkeypatch.setattr(geoid, "grid_folders", lambda: [tmp_path])
    gtx = shared / "dem_isce3" / "egm96_15.gtx"
    carrying = plane_dem(tmp_path / "carrying.tif", crs="EPSG:32632+5773")
    silent = plane_dem(tmp_path / "silent.tif")
    carried = open_dem(carrying, GRID.crs, datum="carried", geoid=gtx).heights(GRID)
    stated = open_dem(silent, GRID.crs, datum="egm96", geoid=gtx).heights(GRID)
    np.testing.assert_allclose(carried, stated, atol=1e-6)
    assert 45 < (carried - 600).mean() < 50
    with pytest.raises(CampaignError, match="heights of egm96 by its own CRS"):
        open_dem(carrying, GRID.crs, datum="ellipsoid")
    with pytest.raises(CampaignError, match="a CRS without heights"):
        open_dem(silent, GRID.crs, datum="carried")
    with pytest.raises(CampaignError, match=r"de_bkg_gcg2016\.tif"):
        open_dem(plane_dem(tmp_path / "de.tif", crs="EPSG:25832+7837"), GRID.crs, datum="carried")


@pytest.mark.parametrize(
    ("west", "sides"), [(499990.0, "to the west"), (500100.0, "to the east"), (500200.0, "100.0 % of the scene")]
)
def test_a_dem_that_does_not_reach_says_how_much_is_missing_and_where(tmp_path, west, sides):
    terrain = open_dem(plane_dem(tmp_path / "dem.tif"), GRID.crs, datum="ellipsoid")
    terrain.check_cover(GRID)
    grid = SceneGrid(GRID.crs, west, 5400060.0, 0.5, (70, 90))
    with pytest.raises(CampaignError, match=sides) as caught:
        terrain.check_cover(grid)
    share = float(str(caught.value).split(": ")[1].split(" %")[0])
    missing = np.mean((grid.x_m < 500000) | (grid.x_m > 500120))
    assert share == pytest.approx(100 * missing, abs=1.5)
    assert np.isnan(terrain.heights(grid)).mean() == pytest.approx(missing, abs=0.02)


@pytest.mark.parametrize("void", ["nan", "nodata"])
def test_a_void_reaches_as_far_as_its_post_counts_and_no_further(tmp_path, void):
    heights = np.full((60, 60), 600.0, np.float32)
    heights[30, 20] = np.nan if void == "nan" else -9999
    nodata = {} if void == "nan" else {"nodata": -9999}
    path = write_dem(tmp_path / "dem.tif", heights, from_origin(500000, 5400100, 2, 2), **nodata)
    found = open_dem(path, GRID.crs, datum="ellipsoid").heights(GRID)
    x, y = np.meshgrid(GRID.x_m, GRID.y_m)
    near = (np.abs(x - 500041) < 2) & (np.abs(y - 5400039) < 2)
    np.testing.assert_array_equal(np.isnan(found), near)


@pytest.mark.parametrize("wild", [-9999.0, -32768.0, 3.4e38, 29029.0])
def test_a_height_that_no_land_has_is_counted_where_it_counts(tmp_path, wild):
    """Posts 20 and 21 of row 30 are under the scene, row 2 is not; in a local frame anything goes."""
    heights = np.full((60, 60), 600.0)
    heights[2] = wild
    path, corner = tmp_path / "dem.tif", from_origin(500000, 5400100, 2, 2)
    assert np.all(open_dem(write_dem(path, heights, corner), GRID.crs, datum="ellipsoid").heights(GRID) == 600)
    heights[30, 20:22] = wild
    terrain = open_dem(write_dem(path, heights, corner), GRID.crs, datum="ellipsoid")
    with pytest.raises(CampaignError, match=r"dem\.tif: 2 of the \d+ posts in rows ") as caught:
        terrain.heights(GRID)
    assert f"most often {wild:g} m" in str(caught.value)
    local = open_dem(write_dem(path, heights, corner, crs=None), "local", datum="carried")
    assert np.isfinite(local.heights(SceneGrid("local", 500020.0, 5400060.0, 0.5, (70, 90)))).all()


def test_a_file_that_is_no_dem_is_refused(tmp_path):
    (tmp_path / "dem.tif").write_text("not a raster")
    for path, expected in (
        (tmp_path / "dem.tif", "not readable"),
        (tmp_path / "none.tif", "no such file"),
        (write_dem(tmp_path / "bare.tif", np.zeros((4, 4)), from_origin(0, 4, 1, 1), crs=None), "no CRS on Earth"),
    ):
        with pytest.raises(CampaignError, match=expected):
            open_dem(path, GRID.crs, datum="ellipsoid")
    with pytest.raises(CampaignError, match="under a scene in the local frame"):
        open_dem(plane_dem(tmp_path / "utm.tif"), "local", datum="carried")


# Focusing


FREQUENCY = 1.2e9 + 4e6 * np.arange(100)
LOCAL = SceneGrid("local", -3.0, 15.0, 0.1, (60, 60))


def history(track, targets):
    """Exact echoes of unit points at `targets`, monostatic."""
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


def test_a_constant_dem_equals_a_lowered_track():
    spectra = history(track_at(8.0), [0.5, 12.0, 3.0])
    lowered = history(track_at(5.0), [0.5, 12.0, 0.0])
    raised = focus(spectra, np.full(LOCAL.shape, 3.0))
    np.testing.assert_allclose(raised, focus(lowered), atol=1e-5 * np.abs(raised).max())


def test_a_raised_target_is_laid_over_on_flat_ground_and_true_on_its_dem():
    """On flat ground a target h high is found where the ground has its range: √(y² − 2Hh + h²)."""
    spectra = history(track_at(8.0), [0.5, 12.0, 1.2])
    y = np.broadcast_to(LOCAL.y_m[:, None], LOCAL.shape)
    for heights, place in ((0.0, np.sqrt(12.0**2 - 2 * 8 * 1.2 + 1.2**2)), (np.where(y > 10.5, 1.2, 0.0), 12.0)):
        image = focus(spectra, heights)
        peak = find_peak(image, *np.unravel_index(np.abs(image).argmax(), image.shape))
        found = LOCAL.map_at(peak.row, peak.column)
        assert found[0] == pytest.approx(0.5, abs=0.02)
        assert found[1] == pytest.approx(place, abs=0.02)


@pytest.mark.parametrize("facing", [20.0, -20.0])
def test_every_target_on_a_plane_tilted_by_20_degrees_is_focused_by_its_dem_and_not_by_flat_ground(facing):
    """The plane rises across and along the track; on flat ground there is next to nothing where the targets stand."""
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


def test_the_swath_holds_the_path_of_every_pixel_on_terrain():
    generator = np.random.default_rng(4)
    heights = 3 * generator.standard_normal((150, 90))
    grid = SceneGrid("local", 0.0, 15.0, 0.1, (150, 90))
    track = track_at(9.0) - [0.0, 6.0, 0.0]
    near, far = swath(grid, GridHeights(grid, heights), Aperture(track, track))
    path = 2 * np.linalg.norm(grid.positions(heights) - track[:, None, None], axis=-1)
    assert (near <= path.min(axis=(1, 2))).all()
    assert (far >= path.max(axis=(1, 2))).all()
    assert (far - near).max() < np.ptp(path) + 4 * np.ptp(heights)


def test_clearance_is_height_above_the_pixel_below_on_earth_too():
    heights = np.add.outer(np.arange(70.0), np.zeros(90))
    antenna = GRID.positions_at([10, 10.3, 500], [7, 80, 3], np.array([12.0, 15.0, 20.0]))
    above, ground = clearance(GRID, GridHeights(GRID, heights), antenna)
    np.testing.assert_allclose(above, [2, 5, np.nan])  # beside the scene: not known
    np.testing.assert_allclose(ground, [10, 10, np.nan])
    np.testing.assert_allclose(clearance(GRID, FlatGround(600.0), antenna)[0][2], 20 - 600)  # but flat ground goes on


def test_an_antenna_below_flat_ground_is_refused_and_below_a_dem_beside_it_is_flagged():
    hill = GridHeights(GRID, np.full(GRID.shape, 650.0))
    track = GRID.positions_at(np.arange(5.0), -40.0, np.array([660.0, 651.0, 649.5, 655.0, 660.0]))
    high = GRID.positions_at(np.arange(5.0), 10.0, 700.0)
    with pytest.raises(
        CampaignError, match=r"f01: at 1 pulses the receiver is in or below .* worst at pulse 2: -0.50 m"
    ):
        check_antennas(GRID, FlatGround(650.0), Aperture(high, track), where="f01")
    low = GRID.positions_at(np.arange(5.0), 10.0, 649.0)
    with pytest.raises(CampaignError, match=r"scene\.dem: .*transmitter.*where the DEM has 650.00 m"):
        check_antennas(GRID, hill, Aperture(low, track), where="f01")
    flags = check_antennas(GRID, hill, Aperture(high, track), where="f01")
    assert flags["platform_below_scene"].startswith("the receiver is 0.5 m below the lowest ground of the scene")
    assert check_antennas(GRID, hill, Aperture(high, high), where="f01") == {}


@pytest.mark.parametrize("grid", [GRID, LOCAL], ids=["on Earth", "local"])
def test_flat_ground_a_level_plane_and_a_constant_dem_are_one_ground(grid):
    """Positions agree to two units in the last place of ECEF; so does everything between pixels."""
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


def test_a_constant_dem_and_a_level_plane_give_the_image_of_flat_ground_to_the_bit():
    spectra = history(track_at(8.0), [0.5, 12.0, 1.2])
    images = [
        reference.form(spectra, ground.positions(LOCAL))
        for ground in (FlatGround(1.2), Plane(0.0, 0.0, 1.2, 0.0, 0.0), GridHeights(LOCAL, np.full(LOCAL.shape, 1.2)))
    ]
    for image in images[1:]:
        np.testing.assert_array_equal(image, images[0])


def test_heights_between_pixels_follow_a_plane_across_tiles_and_windows():
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


# Seeing

STREET = SceneGrid("local", 0.0, 3.0, 0.25, (12, 240))
ROW = (slice(6, 7), slice(0, 240))


def seen(heights, antenna, grid=STREET, window=ROW):
    relief = Relief.of(grid, GridHeights(grid, heights), 0.0)
    pulses = relief.above(np.atleast_2d(np.asarray(antenna, float)))
    return visibility(relief, pulses, pulses, window)


@pytest.mark.parametrize("wall_m", [1.5, 2.0, 3.0])
def test_a_wall_shades_and_folds_as_far_as_triangles_say(wall_m):
    """Shadow h·d/(H − h) behind; in front all ground farther than the wall's top: d − √(d² − 2Hh + h²)."""
    heights = np.zeros(STREET.shape)
    heights[:, 80] = wall_m
    antenna, wall_x = np.array([-10.0, 1.375, 8.0]), STREET.x_m[80]
    mask, away = seen(heights, antenna)[0], wall_x + 10.0
    shade = np.flatnonzero(mask & 1)
    fold = np.flatnonzero(mask & 2)
    assert shade[0] == 81
    assert len(shade) * 0.25 == pytest.approx(wall_m * away / (8 - wall_m), abs=0.25)
    assert fold[-1] == 80
    assert (len(fold) - 1) * 0.25 == pytest.approx(away - np.sqrt(away**2 - 16 * wall_m + wall_m**2), abs=0.25)


def test_flat_ground_is_seen_once_and_plainly_even_right_below():
    grid = SceneGrid("local", -10.0, 10.0, 0.5, (40, 40))
    everything = (slice(0, 40), slice(0, 40))
    assert not seen(np.zeros(grid.shape), [0.1, 0.2, 6.0], grid, everything).any()


@pytest.mark.parametrize(("slope_deg", "expected"), [(-60.0, 1), (-20.0, 0), (20.0, 0), (75.0, 2)])
def test_a_tilted_plane_is_dark_beyond_grazing_and_folds_beyond_incidence(slope_deg, expected):
    """Seen from about 40° of grazing: a plane falling by more is in shadow, one rising by more than 50° in layover."""
    middle = STREET.x_m - 30
    heights = np.broadcast_to(np.tan(np.radians(slope_deg)) * middle, STREET.shape)
    antenna = np.array([30.0 - 300.0, 1.375, 300 * np.tan(np.radians(40.0))])
    inner = seen(heights, antenna)[0, 2:-2]
    np.testing.assert_array_equal(inner, expected)


def test_shadow_on_random_hills_is_what_dense_sampling_of_every_line_says():
    """The walk that skips whole blocks against brute force over bilinear ground."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    generator = np.random.default_rng(1)
    grid = SceneGrid("local", 0.0, 30.0, 0.5, (60, 60))
    hills = 40 * gaussian_filter(generator.standard_normal(grid.shape), 4)
    antenna = np.array([-60.0, 12.0, 20.0])  # far to the west: every line leaves the scene on a column of pixels
    mask = seen(hills, antenna, grid, (slice(0, 60), slice(0, 60))) & 1
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


def test_a_pixel_hidden_from_few_looks_is_not_in_shadow_and_either_antenna_counts():
    heights = np.zeros(STREET.shape)
    heights[:, 80] = 2.0
    low, high = [-10.0, 1.375, 8.0], [-10.0, 1.375, 200.0]
    behind = (6, 90)
    for looks, dark in (([low, low, high], 1), ([low, high, high], 0)):
        assert seen(heights, looks)[0, behind[1]] & 1 == dark
    relief = Relief.of(STREET, GridHeights(STREET, heights), 0.0)
    tx, rx = (relief.above(np.array([antenna])) for antenna in (high, low))
    for pair in ((tx, rx), (rx, tx)):
        assert visibility(relief, *pair, ROW)[0, behind[1]] & 1 == 1


def test_the_ground_curves_away_below_a_long_line():
    """5 km away and level with the eye, ground is hidden by the bulge d²/8R of half a metre; not in a plane."""
    for crs, west, north, dark in (("local", 0.0, 0.0, 0), ("EPSG:32632", 500000.0, 5400000.0, 1)):
        grid = SceneGrid(crs, west, north, 25.0, (3, 200))
        place = (west, north - 37.5, 0.3)
        antenna = place if crs == "local" else grid.positions_at([1.0], [-0.5], np.array([0.3]))[0]
        mask = seen(np.zeros(grid.shape), antenna, grid, (slice(1, 2), slice(0, 200)))
        assert mask[0, 198] & 1 == dark


def test_incidence_counts_from_the_normal_of_the_slope():
    grid = SceneGrid(GRID.crs, GRID.west_m, GRID.north_m, 0.5, (9, 9))
    tilt = np.tan(np.radians(15.0))
    east = np.broadcast_to((grid.x_m - grid.x_m[4])[None], grid.shape)
    antenna = grid.positions_at([4.0], [4 - 200.0], np.array([700.0]))[0]
    for heights, expected in ((600 + 0 * east, 45.0), (600 + tilt * east, 30.0), (600 - tilt * east, 60.0)):
        position = grid.positions(heights)
        found = incidence_deg(position, surface_normals(position), antenna)[4, 4]
        assert found == pytest.approx(expected, abs=0.05)


def test_the_bistatic_angle_is_zero_for_one_place_and_right_across_for_two():
    target = np.array([0.0, 10.0, 0.0])
    tx, rx = np.array([-5.0, 0.0, 0.0]), np.array([5.0, 0.0, 0.0])
    assert bistatic_angle_deg(target, tx, tx) == 0
    assert bistatic_angle_deg(target, tx, rx) == pytest.approx(2 * np.degrees(np.arctan(0.5)))


def test_the_bits_of_the_mask_are_those_that_are_exported():
    assert (sightlines.SHADOW, sightlines.LAYOVER) == (exported.SHADOW, exported.LAYOVER)


def test_places_above_the_scene_come_back_as_rows_columns_and_heights():
    antenna = GRID.positions_at([3.0], [-20.0], 650.0)
    np.testing.assert_allclose(GRID.pixel_below(antenna), [[3.0, -20.0, 650.0]], atol=1e-6)
    np.testing.assert_allclose(projected_from_ecef(GRID.crs, antenna)[0, 2], 650.0, atol=1e-6)
