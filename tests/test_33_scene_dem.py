"""Terrain from DEMs: heights at their positions, vertical datums, voids, coverage."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from folders import complaint
from pyproj import CRS, Transformer
from rasterio.transform import from_origin
from scenes import UTM_GRID

import apertura as ap
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import frame_from_map, geodetic_from_ecef, projected_from_ecef
from apertura.core.scene import geoid
from apertura.core.scene.dem import NAMES_FILES, open_dem, steepest_step
from apertura.core.scene.grid import SceneGrid


def write_dem(path, heights, transform, crs="EPSG:32632", **profile):
    rows, columns = heights.shape
    shape = {"height": rows, "width": columns, "count": 1, "dtype": heights.dtype}
    with rasterio.open(path, "w", "GTiff", crs=crs, transform=transform, **shape, **profile) as raster:
        raster.write(heights, 1)
    return path


def plane_dem(path, slope=(0.0, 0.0), base=600.0, crs="EPSG:32632", **profile):
    """Write a DEM with 2 m posts south-east of (500000, 5400100); `slope` to east and north, metres per metre."""
    east, north = 500001.0 + 2 * np.arange(60), 5400099.0 - 2 * np.arange(60)
    heights = base + slope[0] * (east[None] - 500060) + slope[1] * (north[:, None] - 5400040)
    return write_dem(path, heights, from_origin(500000, 5400100, 2, 2), crs, **profile)


# Heights


def test_plane_is_interpolated_exactly(tmp_path):
    heights = open_dem(plane_dem(tmp_path / "dem.tif", (0.3, -0.2)), UTM_GRID.crs, datum="ellipsoid").heights(UTM_GRID)
    expected = 600 + 0.3 * (UTM_GRID.x_m[None] - 500060) - 0.2 * (UTM_GRID.y_m[:, None] - 5400040)
    np.testing.assert_allclose(heights, expected, atol=1e-6)


def test_geoid_undulation_is_added_to_heights(tmp_path):
    """The geoid slopes to the east, from 40 m above the ellipsoid at 8° to 48 m at 10°; the scene is at 9°."""
    gtx = tmp_path / "sloping.gtx"
    posts = np.broadcast_to([40.0, 44.0, 48.0], (3, 3)).astype(">f4")
    gtx.write_bytes(struct.pack(">4d2i", 47.0, 8.0, 1.0, 1.0, *posts.shape) + posts.tobytes())
    terrain = open_dem(plane_dem(tmp_path / "dem.tif"), UTM_GRID.crs, datum="ellipsoid")
    raised = replace(terrain, geoid=gtx).heights(UTM_GRID) - terrain.heights(UTM_GRID)
    np.testing.assert_allclose(raised, 44.0, atol=0.01)
    assert (np.diff(raised[0]) > 0).all()


def test_dem_in_another_crs_keeps_post_heights(shared):
    """The height at the UTM position of each post equals the height of this post in the isce3 DEM."""
    path = shared / "dem_isce3" / "SanAnd_dem.tif"
    with rasterio.open(path) as raster:
        posts, transform = raster.read(1), raster.transform
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32611", always_xy=True)
    terrain = open_dem(path, "EPSG:32611", datum="ellipsoid")
    for row, column in ((0, 0), (120, 50), (251, 107)):
        x, y = to_utm.transform(*(transform @ (column + 0.5, row + 0.5)))
        post_grid = SceneGrid("EPSG:32611", x - 0.5, y + 0.5, 1.0, (1, 1))
        assert terrain.heights(post_grid)[0, 0] == pytest.approx(posts[row, column], abs=2e-3)


def test_egm96_heights_are_converted_by_the_grid_file(shared):
    """Heights are compared with the .gtx file, read directly without PROJ."""
    path, gtx = shared / "dem_isce3" / "SanAnd_dem.tif", shared / "dem_isce3" / "egm96_15.gtx"
    grid = SceneGrid("EPSG:32611", 368000.0, 3783000.0, 40.0, (60, 50))
    raised = open_dem(path, grid.crs, datum="egm96", geoid=gtx).heights(grid)
    raw = open_dem(path, grid.crs, datum="ellipsoid").heights(grid)
    with rasterio.open(gtx) as raster:
        undulations, inverse = raster.read(1).astype(float), ~raster.transform
    x, y = np.meshgrid(grid.x_m, grid.y_m)
    longitude, latitude = Transformer.from_crs(grid.crs, "EPSG:4326", always_xy=True).transform(x, y)
    column, row = inverse @ (longitude, latitude)
    column, row = column - 0.5, row - 0.5
    i, j = np.floor(row).astype(int), np.floor(column).astype(int)
    low, high = ((1 - column % 1) * undulations[k, j] + column % 1 * undulations[k, j + 1] for k in (i, i + 1))
    np.testing.assert_allclose(raised - raw, (1 - row % 1) * low + row % 1 * high, atol=1e-3)
    assert -36 < (raised - raw).mean() < -34


def test_height_of_a_pixel_does_not_depend_on_the_window(shared):
    path, gtx = shared / "dem_isce3" / "SanAnd_dem.tif", shared / "dem_isce3" / "egm96_15.gtx"
    grid = SceneGrid("EPSG:32611", 368000.0, 3783000.0, 7.0, (100, 130))
    terrain = open_dem(path, grid.crs, datum="egm96", geoid=gtx)
    whole = terrain.heights(grid)
    for window in grid.tiles(48):
        np.testing.assert_array_equal(terrain.heights(grid[window]), whole[window])


def test_missing_geoid_grid_is_named(shared, monkeypatch, tmp_path):
    monkeypatch.setattr(geoid, "grid_folders", lambda: [tmp_path])
    path = shared / "dem_isce3" / "SanAnd_dem.tif"
    with pytest.raises(CampaignError, match=r"us_nga_egm96_15\.tif or egm96_15\.gtx.*scene\.geoid"):
        open_dem(path, "EPSG:32611", datum="egm96")
    with pytest.raises(CampaignError, match=r"us_nga_egm08_25\.tif"):
        open_dem(path, "EPSG:32611", datum="egm2008")
    with pytest.raises(CampaignError, match=r"nowhere\.gtx: no such file"):
        open_dem(path, "EPSG:32611", datum="egm96", geoid=tmp_path / "nowhere.gtx")


def test_geoid_grid_is_found_in_the_proj_search_path(shared, monkeypatch, tmp_path):
    folder = tmp_path / "with space"
    folder.mkdir()
    (folder / "egm96_15.gtx").write_bytes((shared / "dem_isce3" / "egm96_15.gtx").read_bytes())
    monkeypatch.setenv("PROJ_DATA", str(folder))
    terrain = open_dem(shared / "dem_isce3" / "SanAnd_dem.tif", "EPSG:32611", datum="egm96")
    assert terrain.geoid == folder / "egm96_15.gtx"
    assert np.isfinite(terrain.heights(SceneGrid("EPSG:32611", 368000.0, 3783000.0, 40.0, (3, 3)))).all()


def test_geoid_grid_in_the_working_folder_is_opened(shared, monkeypatch):
    """The workflow names the grid relative to the campaign folder, in which it runs."""
    monkeypatch.chdir(shared / "dem_isce3")
    terrain = open_dem(Path("SanAnd_dem.tif"), "EPSG:32611", datum="egm96", geoid=Path("egm96_15.gtx"))
    assert np.isfinite(terrain.heights(SceneGrid("EPSG:32611", 368000.0, 3783000.0, 40.0, (3, 3)))).all()


def test_grid_of_another_geoid_is_rejected(shared):
    with pytest.raises(CampaignError, match="a geoid other than egm2008"):
        geoid.geoid_file("egm2008", shared / "dem_isce3" / "egm96_15.gtx")


def test_vertical_datum_of_the_dem_is_used_or_must_agree(shared, tmp_path, monkeypatch):
    monkeypatch.setattr(geoid, "grid_folders", lambda: [tmp_path])
    gtx = shared / "dem_isce3" / "egm96_15.gtx"
    compound = plane_dem(tmp_path / "carrying.tif", crs="EPSG:32632+5773")
    horizontal = plane_dem(tmp_path / "silent.tif")
    carried = open_dem(compound, UTM_GRID.crs, datum="carried", geoid=gtx).heights(UTM_GRID)
    stated = open_dem(horizontal, UTM_GRID.crs, datum="egm96", geoid=gtx).heights(UTM_GRID)
    np.testing.assert_allclose(carried, stated, atol=1e-6)
    assert 45 < (carried - 600).mean() < 50
    with pytest.raises(CampaignError, match="heights above egm96, according to the CRS of the file"):
        open_dem(compound, UTM_GRID.crs, datum="ellipsoid")
    with pytest.raises(CampaignError, match="a CRS without heights"):
        open_dem(horizontal, UTM_GRID.crs, datum="carried")
    with pytest.raises(CampaignError, match=r"de_bkg_gcg2016\.tif"):
        open_dem(plane_dem(tmp_path / "de.tif", crs="EPSG:25832+7837"), UTM_GRID.crs, datum="carried")


@pytest.mark.parametrize(
    ("west", "sides"), [(499990.0, "to the west"), (500100.0, "to the east"), (500200.0, "100.0 % of the scene")]
)
def test_incomplete_cover_is_reported_with_share_and_side(tmp_path, west, sides):
    terrain = open_dem(plane_dem(tmp_path / "dem.tif"), UTM_GRID.crs, datum="ellipsoid")
    terrain.check_cover(UTM_GRID)
    grid = SceneGrid(UTM_GRID.crs, west, 5400060.0, 0.5, (70, 90))
    with pytest.raises(CampaignError, match=sides) as caught:
        terrain.check_cover(grid)
    share = float(str(caught.value).split(": ")[1].split(" %")[0])
    missing = np.mean((grid.x_m < 500000) | (grid.x_m > 500120))
    assert share == pytest.approx(100 * missing, abs=1.5)
    assert np.isnan(terrain.heights(grid)).mean() == pytest.approx(missing, abs=0.02)


@pytest.mark.parametrize("void", ["nan", "nodata"])
def test_void_affects_only_pixels_around_its_post(tmp_path, void):
    heights = np.full((60, 60), 600.0, np.float32)
    heights[30, 20] = np.nan if void == "nan" else -9999
    nodata = {} if void == "nan" else {"nodata": -9999}
    path = write_dem(tmp_path / "dem.tif", heights, from_origin(500000, 5400100, 2, 2), **nodata)
    heights_m = open_dem(path, UTM_GRID.crs, datum="ellipsoid").heights(UTM_GRID)
    x, y = np.meshgrid(UTM_GRID.x_m, UTM_GRID.y_m)
    near = (np.abs(x - 500041) < 2) & (np.abs(y - 5400039) < 2)
    np.testing.assert_array_equal(np.isnan(heights_m), near)


@pytest.mark.parametrize("wild", [-9999.0, -32768.0, 3.4e38, 29029.0])
def test_implausible_heights_are_rejected_within_the_scene(tmp_path, wild):
    """Posts 20 and 21 of row 30 are in the scene, row 2 is outside; in a local frame, any height is accepted."""
    heights = np.full((60, 60), 600.0)
    heights[2] = wild
    path, corner = tmp_path / "dem.tif", from_origin(500000, 5400100, 2, 2)
    assert np.all(open_dem(write_dem(path, heights, corner), UTM_GRID.crs, datum="ellipsoid").heights(UTM_GRID) == 600)
    heights[30, 20:22] = wild
    terrain = open_dem(write_dem(path, heights, corner), UTM_GRID.crs, datum="ellipsoid")
    with pytest.raises(CampaignError, match=r"dem\.tif: 2 of the \d+ posts in rows ") as caught:
        terrain.heights(UTM_GRID)
    assert f"most frequently {wild:g} m" in str(caught.value)
    local = open_dem(write_dem(path, heights, corner, crs=None), "local", datum="carried")
    assert np.isfinite(local.heights(SceneGrid("local", 500020.0, 5400060.0, 0.5, (70, 90)))).all()


@pytest.mark.quick("EPSG:31467-EPSG:31287", "EPSG:4326-EPSG:32632")
@pytest.mark.parametrize("crs", ["EPSG:31467", "EPSG:31287", "EPSG:25832", "EPSG:32632"])
@pytest.mark.parametrize("dem_crs", ["EPSG:31467", "EPSG:32632", "EPSG:4326"])
def test_heights_refer_to_wgs_84_for_any_crs(tmp_path, crs, dem_crs):
    """The Bessel ellipsoid is 47 m below WGS 84 here; a DEM and flat ground, both 620 m above WGS 84, must agree."""
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(9.955, 48.42)
    grid = SceneGrid(crs, x, y, 1.0, (8, 8))
    west, north = Transformer.from_crs("EPSG:4326", dem_crs, always_xy=True).transform(9.954, 48.421)
    post = 1e-5 if dem_crs == "EPSG:4326" else 2.0
    path = write_dem(tmp_path / "dem.tif", np.full((200, 200), 620.0), from_origin(west, north, post, post), dem_crs)
    for heights in (np.full((8, 8), 620.0), open_dem(path, grid, datum="ellipsoid").heights(grid)):
        geodetic = geodetic_from_ecef(grid.positions(heights))
        np.testing.assert_allclose(geodetic[..., 2], 620.0, atol=1e-3)
        np.testing.assert_allclose(geodetic[0, 0, :2], [48.42, 9.955], atol=2e-5)
    east, north, up = projected_from_ecef(crs, grid.positions(np.full((8, 8), 620.0))[4, 3])
    np.testing.assert_allclose([east - x, north - y, up], [3.5, -4.5, 620.0], atol=3e-3)


@pytest.mark.parametrize("fill", [0, -1, 1, 255, 999])
@pytest.mark.parametrize("side", [1, 2, 12])
def test_void_filled_with_a_constant_is_rejected_in_the_scene(tmp_path, fill, side):
    """The terrain is hilly, near 400 m; the same block outside the scene is accepted."""
    heights = 400 + np.random.default_rng(5).normal(0, 3, (60, 60)).astype(np.float32)
    heights[2 : 2 + side, 50 - side : 50] = fill
    path, corner = tmp_path / "dem.tif", from_origin(500000, 5400100, 2, 2)
    sound = open_dem(write_dem(path, heights, corner), UTM_GRID.crs, datum="ellipsoid").heights(UTM_GRID)
    assert np.abs(sound - 400).max() < 20
    heights[30 : 30 + side, 20 : 20 + side] = fill
    terrain = open_dem(write_dem(path, heights, corner), UTM_GRID.crs, datum="ellipsoid")
    message = complaint(lambda: terrain.heights(UTM_GRID))
    count = "1 post" if side == 1 else f"{side**2} posts"
    void = f"a void filled with {fill}: {count} of this value from row 30, column 20, surrounded by posts that differ"
    assert void in message
    assert f"Declare {fill} as nodata for these posts, and fill the voids with a GIS" in message


@pytest.mark.parametrize("kind", ["sea cliff", "coast", "lake", "declared"])
def test_terrain_at_the_height_of_fill_values_is_no_void(tmp_path, kind):
    heights = 400 + np.random.default_rng(5).normal(0, 3, (60, 60))
    if kind == "sea cliff":
        heights[:, 25:] = 0
    elif kind == "coast":
        heights[:] = np.maximum(0, np.linspace(-20, 60, 60))[None]
    elif kind == "lake":
        heights = np.maximum(np.hypot(*np.mgrid[-30:30, -30:30]) * 3 - 30, 0) - 1
    else:
        heights[30:33, 20:23] = -9999
    path, nodata = tmp_path / "dem.tif", {"nodata": -9999} if kind == "declared" else {}
    write_dem(path, heights.astype(np.float32), from_origin(500000, 5400100, 2, 2), **nodata)
    found = open_dem(path, UTM_GRID.crs, datum="ellipsoid").heights(UTM_GRID)
    assert np.isnan(found).any() == (kind == "declared")


@pytest.mark.parametrize(
    ("drop_m", "over_m", "found"), [(400, 2, True), (130, 2, True), (80, 2, False), (110, 40, False), (400, 40, True)]
)
def test_terrain_step_steeper_than_79_degrees_is_found(tmp_path, drop_m, over_m, found):
    east = np.arange(60) * 2.0
    heights = 600 - drop_m * np.clip((east - 30) / over_m, 0, 1) + np.zeros((60, 1))
    path = write_dem(tmp_path / "dem.tif", heights.astype(np.float32), from_origin(500000, 5400100, 2, 2))
    step = steepest_step(open_dem(path, UTM_GRID.crs, datum="ellipsoid"), UTM_GRID)
    assert (step is not None) is found
    if step is not None:
        assert step.height_m == pytest.approx(drop_m * min(1, 20 / over_m), rel=0.1)
        assert 500020 < step.x_m < 500065


def test_invalid_dem_file_is_rejected(tmp_path):
    (tmp_path / "dem.tif").write_text("not a raster")
    for path, expected in (
        (tmp_path / "dem.tif", "not readable"),
        (tmp_path / "none.tif", "no such file"),
        (write_dem(tmp_path / "bare.tif", np.zeros((4, 4)), from_origin(0, 4, 1, 1), crs=None), "no geodetic CRS"),
    ):
        with pytest.raises(CampaignError, match=expected):
            open_dem(path, UTM_GRID.crs, datum="ellipsoid")
    with pytest.raises(CampaignError, match="for a scene in the local frame"):
        open_dem(plane_dem(tmp_path / "utm.tif"), "local", datum="carried")


# Python interface


@pytest.mark.slow
def test_target_on_a_slope_is_imaged_at_its_position_with_a_dem(tmp_path):
    """Flat ground 1.8 m lower displaces the target; the raster is in geographic coordinates, the scene in UTM."""
    grid = ap.SceneGrid("EPSG:32632", 500059.0, 5400041.0, 0.1, (40, 40))
    path = geographic_dem(tmp_path / "dem.tif", slope=(0.3, -0.2))
    terrain = ap.open_dem(str(path), grid, datum="ellipsoid")
    track = frame_from_map(grid.crs, np.linspace(500052, 500068, 96), np.full(96, 5400020.0), np.full(96, 618.0))
    target = frame_from_map(grid.crs, 500061.0, 5400039.0, 600 + 0.3 * 1.0 + 0.2 * 1.0)
    frequency, flown = 1.2e9 + 2e6 * np.arange(200), ap.Aperture(track, track)
    echo = np.exp(-2j * np.pi * frequency * flown.path(target[None]) / SPEED_OF_LIGHT_M_S).astype(np.complex64)
    history = ap.PhaseHistory(echo, frequency, np.full(200, 1 / 200), np.zeros(96), flown)
    places = {}
    for name, ground in (("dem", terrain), ("flat", ap.FlatGround(598.7))):
        level = abs(ap.backproject(history, grid, terrain=ground, certified_pixels=0)).compute()
        peak = level[level.argmax(...)]
        places[name] = np.hypot(float(peak.x) - 500061.0, float(peak.y) - 5400039.0)
    assert places["dem"] < 0.1
    assert places["flat"] > 0.5


def geographic_dem(path, slope):
    """Write a DEM of a plane in map coordinates: height 600 m at (500060, 5400040), posts every 0.00002°."""
    to_map = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    longitude, latitude = to_map.transform(500060, 5400040, direction="INVERSE")
    step = 2e-5
    places = np.meshgrid(longitude + step * np.arange(-40, 41), latitude - step * np.arange(-40, 41))
    x, y = to_map.transform(*places)
    heights = 600 + slope[0] * (x - 500060) + slope[1] * (y - 5400040)
    return write_dem(
        path, heights, from_origin(longitude - 40.5 * step, latitude + 40.5 * step, step, step), "EPSG:4326"
    )


def test_dem_without_a_datum_is_rejected(tmp_path):
    with pytest.raises(CampaignError, match=r"without heights.*ellipsoid, egm96 or egm2008.*in Python: path and datum"):
        ap.open_dem(plane_dem(tmp_path / "dem.tif"), UTM_GRID.crs)


def test_dem_that_ends_inside_the_scene_is_rejected(tmp_path):
    path, grid = plane_dem(tmp_path / "dem.tif"), ap.SceneGrid("EPSG:32632", 500100.0, 5400060.0, 0.5, (40, 80))
    with pytest.raises(CampaignError, match=r"dem\.tif: .* % of the scene lies outside the DEM, to the east"):
        ap.open_dem(path, grid, datum="ellipsoid")
    assert np.isnan(ap.open_dem(path, grid.crs, datum="ellipsoid").heights(grid)).any()


@pytest.mark.parametrize("grids", ["nadgrids=/elsewhere/g.gsb", "nadgrids=~/g.gsb", "geoidgrids=../g.gtx"])
def test_crs_that_names_a_file_is_detected(grids):
    assert NAMES_FILES.search(CRS(f"+proj=utm +zone=32 +ellps=bessel +{grids} +units=m +type=crs").to_wkt())
    for code in ("EPSG:25832", "EPSG:31467", "EPSG:26711", "EPSG:25832+7837", "EPSG:4326+5773", "EPSG:5555"):
        assert not NAMES_FILES.search(CRS(code).to_wkt())
