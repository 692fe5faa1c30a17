"""Products: validity, position on the configured grid, provenance tags, numerical error and flags."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import xarray as xr
from pyproj import Transformer
from rio_cogeo.cogeo import cog_validate

from apertura.campaign.store import open_stage, read_manifest
from apertura.common.paths import shipped
from apertura.common.provenance import Provenance, packages, sha256_file, software
from apertura.core.backprojection.engines import instruction_set
from apertura.formats.catalog import DOCUMENTS
from apertura.formats.export import exports_in, product_files
from apertura.run.process import process
from apertura.simulation import ImageGrid, preset, simulate
from apertura.stages.image_tags import quality_tags

PAIRS = ("uav1-uav1", "uav1-uav2")
PRODUCTS = list(product_files({"f01": (*PAIRS, "fused")}))
LAYERS = [
    f"f01/{pair}/{export.file}" for pair in PAIRS for export in exports_in("layers") if export.file.endswith(".tif")
]
RASTERS = [name for name in PRODUCTS if name.endswith(".tif") and name not in LAYERS]
RECORDED = [
    *(f"raw/f01/uav1.{suffix}" for suffix in ("sigmf-meta", "sigmf-data", "track.csv")),
    *(f"raw/f01/uav2.{suffix}" for suffix in ("sigmf-meta", "sigmf-data", "track.pos")),
]


def tags_of(campaign, name):
    with rasterio.open(str(campaign.results / name)) as raster:
        return raster.tags()


def test_products_are_exactly_those_of_the_table(finished_tiny):
    results = finished_tiny.results
    suffixes = {".tif", ".png", ".geojson", ".qml", ".vrt"}
    products = {path for path in results.rglob("*") if path.suffix in suffixes or path.name in {*DOCUMENTS, "map.json"}}
    assert (len(RASTERS), len(LAYERS)) == (12, 10)
    assert {path.relative_to(results).as_posix() for path in products} == {*PRODUCTS, "f01/tracks/tracks.png"}


@pytest.mark.parametrize("name", [*RASTERS, *LAYERS])
def test_raster_is_a_valid_cog_on_the_configured_grid(finished_tiny, name):
    path = finished_tiny.results / name
    valid, errors, warnings = cog_validate(str(path), strict=True, quiet=True)
    assert valid, (errors, warnings)
    with rasterio.open(str(path)) as raster:
        np.testing.assert_allclose(tuple(raster.bounds), finished_tiny.settings.scene.bounds_m, atol=1e-3)
        assert raster.crs.to_epsg() == 32632
        assert raster.transform.a == -raster.transform.e == 0.1
        kinds = {"slc.tif": "complex64", "coherent_slc.tif": "complex64", "mask.tif": "uint8"}
        assert raster.dtypes[0] == kinds.get(path.name, "float32")


@pytest.mark.parametrize("name", [*RASTERS, *LAYERS])
def test_raster_tags_state_settings_and_inputs(finished_tiny, name):
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


@pytest.mark.parametrize("name", [*RASTERS, *LAYERS])
def test_raster_tags_state_sources_and_software(finished_tiny, name):
    tags, folder = tags_of(finished_tiny, name), (finished_tiny.results / name).parent
    manifest = folder / ("layers.manifest.json" if name in LAYERS else "export.manifest.json")
    sources = json.loads(tags["APERTURA_SOURCES"])
    assert sources == read_manifest(manifest)["sources"]
    assert "results/scene.manifest.json" in sources
    for source, digest in sources.items():
        assert digest == sha256_file(finished_tiny.root / source)
    assert json.loads(tags["APERTURA_SOFTWARE"]) == software()
    assert tags["APERTURA_LOCK_SHA256"] == sha256_file(shipped() / "requirements" / "all.txt")
    if name in RASTERS:
        assert tags["APERTURA_INSTRUCTION_SET"] == instruction_set("native")


@pytest.mark.slow
def test_raster_tags_name_only_recordings_of_their_flight(tmp_path):
    plan = replace(preset("demo", pulses=20), scene=ImageGrid("EPSG:32632", half_width_m=1.5, spacing_m=0.1))
    (flight,) = plan.flights
    campaign = process(simulate(tmp_path / "two", replace(plan, flights=(flight, replace(flight, name="f02"))), seed=3))
    for name in product_files(campaign.images):
        if name.endswith(".tif"):
            inputs = json.loads(tags_of(campaign, name)["APERTURA_INPUTS"])
            assert {role.split("/")[1] for role in inputs} == {"codes.npy", name.split("/")[0]}


def test_provenance_lists_differing_software_versions(finished_tiny):
    image = open_stage(finished_tiny.stage("image", "f01", "uav1-uav1"), "image")
    assert image.attrs["software"] == packages()
    older = xr.Dataset(attrs=image.attrs | {"software": packages() | {"numpy": "0.1"}})
    origin = Provenance.of(["apertura.common.errors"], [older], software=packages())
    assert origin.software["numpy"] == f"0.1, {packages()['numpy']}"
    assert origin.software["zarr"] == packages()["zarr"]


@pytest.mark.parametrize("name", RASTERS)
def test_raster_tags_state_the_numerical_error(finished_tiny, name):
    tags = tags_of(finished_tiny, name)
    report = json.loads((finished_tiny.results / name).with_name("image.json").read_text())
    for tag, key in (("ERROR_DB", "numerical_error_db"), ("ERROR_CONFIDENCE", "numerical_error_confidence")):
        assert float(tags[f"APERTURA_{tag}"]) == report[key]
    assert -160 < float(tags["APERTURA_ERROR_DB"]) < -60
    assert json.loads(tags["APERTURA_MODELS"]) == report["models"]
    assert json.loads(tags["APERTURA_FLAGS"]) == report["flags"]
    assert "APERTURA_REDONE" not in tags


def test_fused_raster_states_the_settings_of_each_pair(finished_tiny):
    runspec = json.loads(tags_of(finished_tiny, "f01/fused/coherent_db.tif")["APERTURA_RUNSPEC"])
    for pair in PAIRS:
        assert runspec[pair] == json.loads(tags_of(finished_tiny, f"f01/{pair}/db.tif")["APERTURA_RUNSPEC"])
    assert set(runspec) == {*PAIRS, "fusion"}
    assert runspec["uav1-uav1"] != runspec["uav1-uav2"]


def test_title_names_the_kind_of_sum(finished_tiny):
    for name, words in (("coherent", "coherent sum"), ("noncoherent", "non-coherent sum")):
        title = tags_of(finished_tiny, f"f01/fused/{name}_db.tif")["TIFFTAG_IMAGEDESCRIPTION"]
        assert title.split(" · ")[1:] == ["flight f01", f"{words} of uav1-uav1 + uav1-uav2"]


def test_power_and_db_are_the_slc_squared(finished_tiny):
    folder = finished_tiny.results / "f01" / "uav1-uav1"
    slc, power, db = (rasterio.open(str(folder / f"{name}.tif")).read(1) for name in ("slc", "power", "db"))
    np.testing.assert_allclose(power, np.abs(slc) ** 2, rtol=1e-5)
    np.testing.assert_allclose(db, 20 * np.log10(np.abs(slc)), atol=1e-3)


def test_cube_opens_with_xarray_and_contains_every_image(finished_tiny):
    cube = xr.open_zarr(str(finished_tiny.results / "cube.zarr"), consolidated=False, chunks=None)
    assert cube.image.dims == ("flight", "pair", "y", "x")
    assert cube.image.attrs["grid_mapping"] == "spatial_ref"
    assert "UTM zone 32N" in cube.spatial_ref.attrs["crs_wkt"]
    slc = rasterio.open(str(finished_tiny.results / "f01" / "uav1-uav2" / "slc.tif")).read(1)
    np.testing.assert_array_equal(cube.image.values[0, cube.attrs["pairs"].index("uav1-uav2")], slc)


def test_coverage_contains_tracks_and_footprints(finished_tiny):
    features = json.loads((finished_tiny.results / "coverage.geojson").read_text())["features"]
    kinds = [(feature["properties"]["kind"], feature["properties"]["pair"]) for feature in features]
    assert kinds == [("track", PAIRS[0]), ("footprint", PAIRS[0]), *2 * [("track", PAIRS[1])], ("footprint", PAIRS[1])]
    xmin, ymin, xmax, ymax = finished_tiny.settings.scene.bounds_m
    ((ring,),) = features[1]["geometry"]["coordinates"]
    east, north = Transformer.from_crs("OGC:CRS84", "EPSG:32632", always_xy=True).transform(*np.transpose(ring))
    assert (east.min(), north.min()) == pytest.approx((xmin, ymin), abs=0.01)
    assert (east.max(), north.max()) == pytest.approx((xmax, ymax), abs=0.01)
    echo = xr.open_zarr(str(finished_tiny.results / "f01" / PAIRS[1] / "echo.zarr"), consolidated=False)
    for track, name in ((features[2], "tx_position"), (features[3], "rx_position")):
        longitude, latitude, height_m = np.transpose(track["geometry"]["coordinates"])
        ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(latitude, longitude, height_m)
        assert np.abs(np.stack(ecef, -1)[0] - echo[name].values[0]).max() < 0.01


def test_noise_layer_lies_below_its_image(finished_tiny):
    folder = finished_tiny.results / "f01" / "uav1-uav1"
    db, nesz, looks, mask = (
        rasterio.open(str(folder / f"{name}.tif")).read(1) for name in ("db", "nesz", "looks", "mask")
    )
    assert np.nanmax(nesz) < np.nanpercentile(db, 20)
    assert len(np.unique(looks)) == 1  # every pulse contributes to every pixel
    assert not mask.any()


def test_tags_contain_the_flags_of_an_image(finished_tiny):
    report = json.loads((finished_tiny.results / "f01/uav1-uav1/image.json").read_text())
    flags = {"track_gap": "uav1: a gap of 1.2 s"}
    assert json.loads(quality_tags(report | {"flags": flags})["APERTURA_FLAGS"]) == flags
