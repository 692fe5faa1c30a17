"""Every file a user gets is valid, lies where the config says and says where it comes from."""

import json

import numpy as np
import pytest
import rasterio
import xarray as xr
from rio_cogeo.cogeo import cog_validate

RASTERS = [
    *(f"{pair}/{product}.tif" for pair in ("uav1-uav1", "uav1-uav2") for product in ("slc", "power", "db")),
    *(f"fused/coherent_{product}.tif" for product in ("slc", "power", "db")),
    *(f"fused/noncoherent_{product}.tif" for product in ("power", "db")),
]


@pytest.mark.parametrize("name", RASTERS)
def test_a_raster_is_a_valid_cog_on_the_campaigns_grid(finished_tiny, name):
    path = finished_tiny.results / "f01" / name
    valid, errors, warnings = cog_validate(str(path), strict=True, quiet=True)
    assert valid, (errors, warnings)
    with rasterio.open(path) as raster:
        np.testing.assert_allclose(tuple(raster.bounds), finished_tiny.settings.scene.bounds_m, atol=1e-3)
        assert raster.crs.to_epsg() == 32632
        assert raster.transform.a == -raster.transform.e == 0.1
        assert raster.dtypes[0] == ("complex64" if name.endswith("slc.tif") else "float32")


@pytest.mark.parametrize("name", RASTERS)
def test_a_raster_says_where_it_comes_from(finished_tiny, name):
    with rasterio.open(finished_tiny.results / "f01" / name) as raster:
        tags = raster.tags()
    runspec, inputs = json.loads(tags["APERTURA_RUNSPEC"]), json.loads(tags["APERTURA_INPUTS"])
    assert runspec["waveform"]["carrier_hz"] == 1.2e9
    assert "window" in runspec
    assert {"raw/codes.npy", "raw/f01/uav1.sigmf-data", "raw/f01/uav1.track.csv"} <= set(inputs)
    assert all(len(digest) == 64 for digest in [*inputs.values(), tags["APERTURA_CODE_SHA256"]])
    assert float(tags["APERTURA_ERROR_DB"]) < -60
    assert float(tags["APERTURA_PEAK_ERROR_DB"]) < -50
    assert json.loads(tags["APERTURA_MODELS"])
    assert "APERTURA_REDONE" not in tags


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
