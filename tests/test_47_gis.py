"""GIS programs read the same geotransform, CRS, no-data value and pixel positions from the rasters."""

import json

import numpy as np
import pytest
import rasterio
from folders import copy_writable
from pyproj import CRS
from rasterio import Affine
from readers import (
    ask_qgis,
    by_gdal,
    by_rasterio,
    by_rioxarray,
    have_gdal,
    have_qgis,
    sampled_by_gdal,
    sampled_by_qgis,
    sampled_by_rasterio,
    sampled_by_rioxarray,
)

from apertura.campaign.folder import Campaign
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.scene.grid import SceneGrid
from apertura.formats.export import exports_in, mosaics, product_files, write_exports
from apertura.formats.export.mosaic import write_mosaic
from apertura.formats.export.radiometry import ECHO
from apertura.stages import mosaic
from apertura.workflow.stale import damaged_results

FLOWN = {"f01": ("uav1-uav1", "uav1-uav2", "fused")}
RASTERS = [name for name in product_files(FLOWN) if name.endswith((".tif", ".vrt"))]
STYLED = [name for name in product_files(FLOWN) if name.endswith(".qml")]
needs_gdal = pytest.mark.skipif(not have_gdal(), reason="gdalinfo and gdallocationinfo are not installed")
needs_qgis = pytest.mark.skipif(not have_qgis(), reason="QGIS is not installed")

MILLIMETRE, SPACING_M, SHAPE = 0.001, 0.05, (40, 60)
ROW, COLUMN = 11, 37


def agree(reported, expected):
    assert reported["transform"] == pytest.approx(expected["transform"], rel=0, abs=1e-8)
    assert tuple(reported["shape"]) == tuple(expected["shape"])
    assert reported["nodata"] == pytest.approx(expected["nodata"], nan_ok=True)
    one, other = (CRS.from_wkt(raster["wkt"]) for raster in (reported, expected))
    assert one.is_engineering == other.is_engineering
    assert one.name == other.name if one.is_engineering else one.to_epsg() == other.to_epsg() is not None


def test_rioxarray_agrees_with_rasterio_on_every_raster(finished_tiny):
    for name in RASTERS:
        agree(by_rioxarray(finished_tiny.results / name), by_rasterio(finished_tiny.results / name))


@needs_gdal
def test_gdal_programs_agree_with_rasterio_on_every_raster(finished_tiny):
    for name in RASTERS:
        agree(by_gdal(finished_tiny.results / name), by_rasterio(finished_tiny.results / name))


@needs_qgis
def test_qgis_agrees_with_rasterio_and_uses_every_style(finished_tiny, tmp_path):
    results = copy_writable(finished_tiny.root, tmp_path / "campaign") / "results"
    paths = {name: results / name for name in RASTERS}
    reports = ask_qgis(tell=[str(path) for path in paths.values()])["told"]
    assert not damaged_results(Campaign.load(results.parent))
    for name, path in paths.items():
        report = reports[str(path)]
        assert report["valid"], name
        assert report["crs"] == "EPSG:32632"
        agree(report, by_rasterio(path))
        if name.endswith("db.tif"):
            radiometry = json.loads(rasterio.open(path).tags()["APERTURA_RADIOMETRY"])
            top = radiometry["peak_db"]
            assert report["stretch"] == pytest.approx([top + radiometry["noise_floor_re_peak_db"], top], abs=0.01)
            assert report["legend"] == [" dB"]  # suffix at both ends of the ramp
        if name.endswith("nesz.tif"):
            assert len(report["legend"]) == 5
            assert all(label.endswith(" dB") for label in report["legend"])
        if name.endswith("mask.tif"):
            assert report["classes"]["2"] == ["layover", 255]
            assert report["classes"]["0"] == ["valid", 0]
        if path.with_suffix(".qml").name in {"incidence.qml", "looks.qml"}:
            assert report["renderer"] == "singlebandpseudocolor"
    assert len(STYLED) == (2 * 7 + 5) * 2  # 2 + 5 layers per pair, 5 of the sums; in the flight and in the mosaic


def known_rasters():
    """Return rasters that differ from their background at one pixel only."""
    rasters = {source: np.ones(SHAPE, np.complex64) for source in ("image", "coherent", "noncoherent")}
    rasters |= {source: np.ones(SHAPE, np.float32) for source in ("magnitude", "incidence", "bistatic_angle")}
    rasters |= {
        "looks": np.ones(SHAPE, np.float32),
        "nesz": np.ones(SHAPE, np.float32),
        "mask": np.ones(SHAPE, np.uint8),
    }
    for raster in rasters.values():
        raster[ROW, COLUMN] = 2
    return rasters


@pytest.fixture(scope="module", params=["EPSG:32632", pytest.param(LOCAL, marks=pytest.mark.slow)])
def control(request, tmp_path_factory):
    """Write every kind of raster with a control point; return their paths and its map position."""
    north_m = 5363701.65 if request.param != LOCAL else 40.0
    west_m = 570656.9 if request.param != LOCAL else -30.0
    grid = SceneGrid(request.param, west_m, north_m, SPACING_M, SHAPE)
    folder, rasters = tmp_path_factory.mktemp("control") / "f01", known_rasters()
    for kind in ("pair", "layers", "fused"):
        into = folder / ("fused" if kind == "fused" else "a-b")
        into.mkdir(parents=True, exist_ok=True)
        write_exports(
            kind,
            into,
            rasters,
            titles=dict.fromkeys(rasters, "control"),
            tags={},
            radiometry=dict.fromkeys(("image", "coherent", "noncoherent"), ECHO.measured(2.0, -6.02).report),
            transform=Affine(*grid.transform),
            crs=grid.crs_wkt,
        )
    for name, files in mosaics({"f01": ["a-b", "fused"]}).items():
        write_mosaic(folder.parent / "mosaic" / name, [folder.parent / file for file in files])
    x, y = map(float, grid.map_at(ROW, COLUMN))
    return sorted([*folder.parent.rglob("*.tif"), *folder.parent.rglob("*.vrt")]), (x, y)


def test_control_points_lie_at_pixel_centres(control):
    paths, (x, y) = control
    assert len(paths) == (3 + 5 + 6) + (2 + 5 + 5)  # pair, layers and sums; the mosaic has no complex raster
    for path in paths:
        with rasterio.open(path) as raster:
            values = np.abs(raster.read(1))
            position = raster.xy(*np.unravel_index(values.argmax(), values.shape))
        assert position == pytest.approx((x, y), rel=0, abs=MILLIMETRE / 10)


@pytest.mark.quick("EPSG:32632-*")
@pytest.mark.parametrize(
    "sampled",
    [
        sampled_by_rasterio,
        sampled_by_rioxarray,
        pytest.param(sampled_by_gdal, marks=needs_gdal),
        pytest.param(sampled_by_qgis, marks=needs_qgis),
    ],
)
def test_control_point_is_read_within_a_millimetre(control, sampled):
    """Points 1 mm inside each edge of the pixel have its value, points 1 mm outside do not."""
    paths, (x, y) = control
    directions = [(1, 0), (-1, 0), (0, 1), (0, -1)]
    reach = [SPACING_M / 2 - MILLIMETRE, SPACING_M / 2 + MILLIMETRE]
    points = [(x + east * far, y + north * far) for far in reach for east, north in directions]
    samples = sampled(dict.fromkeys(paths, points))
    assert len(samples) >= len(paths) - 2
    for path, values in samples.items():
        inside, outside = np.split(np.array(values), 2)
        with rasterio.open(path) as raster:
            point, background = (raster.read(1)[at] for at in ((ROW, COLUMN), (0, 0)))
        np.testing.assert_allclose(inside, point, rtol=1e-6, err_msg=str(path))
        np.testing.assert_allclose(outside, background, rtol=1e-6, atol=1e-6, err_msg=str(path))


@needs_qgis
def test_qgis_renders_peak_white_and_noise_floor_black(finished_tiny, tmp_path):
    db, picture = finished_tiny.results / "f01/uav1-uav1/db.tif", tmp_path / "db.png"
    assert ask_qgis(draw={str(db): [str(picture), 240]})["errors"][str(db)] == []
    with rasterio.open(db) as raster:
        decibel, radiometry = raster.read(1), json.loads(raster.tags()["APERTURA_RADIOMETRY"])
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning), rasterio.open(picture) as png:
        grey = png.read(1)[2::4, 2::4].astype(float)  # 60 pixels, each drawn as 4 × 4 screen pixels
    floor_db = radiometry["peak_db"] + radiometry["noise_floor_re_peak_db"]
    expected = np.clip((decibel - floor_db) / -radiometry["noise_floor_re_peak_db"], 0, 1) * 255
    assert np.abs(grey - expected).max() < 3


def test_every_image_and_sum_states_its_quantity(finished_tiny):
    quantities = {}
    for name in (name for name in RASTERS if name.endswith(".tif")):
        with rasterio.open(str(finished_tiny.results / name)) as raster:
            radiometry = json.loads(raster.tags()["APERTURA_RADIOMETRY"])
            assert (raster.descriptions[0], raster.units[0]) == (radiometry["quantity"], radiometry["unit"])
        quantities[name.removeprefix("f01/")] = radiometry
    assert quantities["uav1-uav1/power.tif"]["quantity"] == "echo power, linear"
    assert not quantities["uav1-uav1/power.tif"]["divided_by"]
    sums = [f"fused/{row.file}" for row in exports_in("fused") if row.file.endswith(".tif")]
    assert (
        len({quantities[name]["quantity"] for name in [*sums, "uav1-uav1/slc.tif", "uav1-uav1/power.tif"]})
        == len(sums) + 2
    )
    reports = {
        name: json.loads((finished_tiny.results / f"f01/{name}/image.json").read_text()) for name in FLOWN["f01"]
    }
    fused = reports.pop("fused")
    peaks = {pair: report["brightest"]["amplitude"] for pair, report in reports.items()}
    for source in ("coherent", "noncoherent", "magnitude"):
        assert fused["radiometry"][source]["divided_by"] == peaks
    for name in sums:
        assert quantities[name]["divided_by"] == peaks
    assert quantities["fused/coherent_db.tif"]["phases_removed_rad"] == fused["fusion"]["phases_rad"]


def test_sum_times_its_divisor_is_the_echo(finished_tiny):
    folder = finished_tiny.results / "f01"
    with rasterio.open(str(folder / "fused" / "noncoherent_power.tif")) as raster:
        mean, peaks = raster.read(1), json.loads(raster.tags()["APERTURA_RADIOMETRY"])["divided_by"]
    powers = [rasterio.open(str(folder / pair / "power.tif")).read(1) / peak**2 for pair, peak in peaks.items()]
    np.testing.assert_allclose(mean, np.mean(powers, axis=0), rtol=1e-5)


def test_mosaic_of_an_edited_or_missing_product_is_refused(finished_tiny, tmp_path):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    path = root / "results" / "f01" / "fused" / "coherent_db.tif"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(
        CampaignError, match=r"coherent_db\.tif: the file has changed since it was written.*Delete .*export\.manifest"
    ):
        mosaic.mosaic(Campaign.load(root))
    path.unlink()
    with pytest.raises(CampaignError, match=r"coherent_db\.tif: no such file"):
        mosaic.mosaic(Campaign.load(root))


@pytest.mark.slow
@needs_qgis
def test_qgis_renders_the_sample_at_its_position(finished_sample, tmp_path):
    db, picture = finished_sample.results / "f01/uav1-uav1/db.tif", tmp_path / "db.png"
    answer = ask_qgis(tell=[str(db)], draw={str(db): [str(picture), 560]})
    report, (west, south, east, north) = answer["told"][str(db)], finished_sample.settings.scene.bounds_m
    assert (report["crs"], answer["errors"][str(db)]) == ("EPSG:32632", [])
    right, _, left, _, down, top = report["transform"]
    rows, columns = report["shape"]
    edges = (left, top + rows * down, left + columns * right, top)
    assert edges == pytest.approx((west, south, east, north), rel=0, abs=MILLIMETRE)
    truth = json.loads((finished_sample.root / "truth.json").read_text())["targets"]
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning), rasterio.open(picture) as png:
        grey = png.read(1).astype(float)
    scale = 560 / (east - west)
    for target in truth:
        row, column = int((north - target["y"]) * scale), int((target["x"] - west) * scale)
        near = grey[row - 20 : row + 21, column - 20 : column + 21]  # half a metre to each side
        brightest = np.subtract(np.unravel_index(near.argmax(), near.shape), 20)
        assert np.hypot(*brightest) < 3 * scale * right
        assert near.max() > 220
