"""Every file a user gets is valid, lies where the config says and says where it comes from."""

import json
import re

import numpy as np
import pytest
import rasterio
import xarray as xr
from rio_cogeo.cogeo import cog_validate

from apertura.export import exports_in, product_files
from apertura.provenance import sha256_file

PAIRS = ("uav1-uav1", "uav1-uav2")
PRODUCTS = list(product_files({"f01": PAIRS}))
LAYERS = [f"f01/{pair}/{export.file}" for pair in PAIRS for export in exports_in("layers")]
RASTERS = [name for name in PRODUCTS if name.endswith(".tif") and name not in LAYERS]
RECORDED = [
    *(f"raw/f01/uav1.{suffix}" for suffix in ("sigmf-meta", "sigmf-data", "track.csv")),
    *(f"raw/f01/uav2.{suffix}" for suffix in ("sigmf-meta", "sigmf-data", "track.pos")),
]


def tags_of(campaign, name):
    with rasterio.open(campaign.results / name) as raster:
        return raster.tags()


def test_every_product_of_the_table_is_there_and_no_other(finished_tiny):
    results = finished_tiny.results
    opened = {".tif", ".png", ".geojson"}
    files = {path.relative_to(results).as_posix() for path in results.rglob("*") if path.suffix in opened}
    reports = {path.relative_to(results).as_posix() for path in results.rglob("image.json")}
    assert (len(RASTERS), len(LAYERS)) == (12, 10)
    assert files | reports == set(PRODUCTS)


@pytest.mark.parametrize("name", [*RASTERS, *LAYERS])
def test_a_raster_is_a_valid_cog_on_the_campaigns_grid(finished_tiny, name):
    path = finished_tiny.results / name
    valid, errors, warnings = cog_validate(str(path), strict=True, quiet=True)
    assert valid, (errors, warnings)
    with rasterio.open(path) as raster:
        np.testing.assert_allclose(tuple(raster.bounds), finished_tiny.settings.scene.bounds_m, atol=1e-3)
        assert raster.crs.to_epsg() == 32632
        assert raster.transform.a == -raster.transform.e == 0.1
        kinds = {"slc.tif": "complex64", "coherent_slc.tif": "complex64", "mask.tif": "uint8"}
        assert raster.dtypes[0] == kinds.get(path.name, "float32")


@pytest.mark.parametrize("name", [*RASTERS, *LAYERS])
def test_a_raster_says_where_it_comes_from(finished_tiny, name):
    tags, pair = tags_of(finished_tiny, name), name.split("/")[1]
    spec = json.loads(tags["APERTURA_RUNSPEC"])
    assert ("fusion" in spec) == (pair == "fused")
    for runspec in [spec[name] for name in ("uav1-uav1", "uav1-uav2")] if pair == "fused" else [spec]:
        assert runspec["waveform"]["carrier_hz"] == 1.2e9
        assert runspec["window"] == "hann"
    inputs = json.loads(tags["APERTURA_INPUTS"])
    assert set(inputs) == {"raw/codes.npy", *(RECORDED if pair != "uav1-uav1" else RECORDED[:3])}
    for role, digest in inputs.items():
        assert digest == sha256_file(finished_tiny.root / role)
    assert re.fullmatch("[0-9a-f]{64}", tags["APERTURA_CODE_SHA256"])


@pytest.mark.parametrize("name", RASTERS)
def test_a_raster_says_how_exact_it_is(finished_tiny, name):
    tags = tags_of(finished_tiny, name)
    report = json.loads((finished_tiny.results / name).with_name("image.json").read_text())
    for tag, key in (("ERROR_DB", "numerical_error_db"), ("ERROR_CONFIDENCE", "numerical_error_confidence")):
        assert float(tags[f"APERTURA_{tag}"]) == report[key]
    assert -160 < float(tags["APERTURA_ERROR_DB"]) < -60
    assert -160 < float(tags["APERTURA_PEAK_ERROR_DB"]) < -50
    assert json.loads(tags["APERTURA_MODELS"]) == report["models"]
    assert json.loads(tags["APERTURA_FLAGS"]) == report["flags"]
    assert "APERTURA_REDONE" not in tags


def test_a_fused_raster_keeps_the_settings_of_its_pairs_apart(finished_tiny):
    apart = json.loads(tags_of(finished_tiny, "f01/fused/coherent_db.tif")["APERTURA_RUNSPEC"])
    for pair in PAIRS:
        assert apart[pair] == json.loads(tags_of(finished_tiny, f"f01/{pair}/db.tif")["APERTURA_RUNSPEC"])
    assert set(apart) == {*PAIRS, "fusion"}
    assert apart["uav1-uav1"] != apart["uav1-uav2"]


def test_a_title_says_what_was_added_up(finished_tiny):
    for name, words in (("coherent", "coherent sum"), ("noncoherent", "non-coherent sum")):
        title = tags_of(finished_tiny, f"f01/fused/{name}_db.tif")["TIFFTAG_IMAGEDESCRIPTION"]
        assert title.split(" · ")[1:] == ["flight f01", f"{words} of uav1-uav1 + uav1-uav2"]


def test_power_and_db_are_the_slc_squared(finished_tiny):
    folder = finished_tiny.results / "f01" / "uav1-uav1"
    slc, power, db = (rasterio.open(folder / f"{name}.tif").read(1) for name in ("slc", "power", "db"))
    np.testing.assert_allclose(power, np.abs(slc) ** 2, rtol=1e-5)
    np.testing.assert_allclose(db, 20 * np.log10(np.abs(slc)), atol=1e-3)


def test_the_cube_opens_with_xarray_and_holds_every_image(finished_tiny):
    cube = xr.open_zarr(finished_tiny.results / "cube.zarr", consolidated=False, chunks=None)
    assert cube.image.dims == ("flight", "pair", "y", "x")
    assert cube.image.attrs["grid_mapping"] == "spatial_ref"
    assert "UTM zone 32N" in cube.spatial_ref.attrs["crs_wkt"]
    slc = rasterio.open(finished_tiny.results / "f01" / "uav1-uav2" / "slc.tif").read(1)
    np.testing.assert_array_equal(cube.image.values[0, cube.attrs["pairs"].index("uav1-uav2")], slc)
