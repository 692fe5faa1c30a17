"""Mosaics of the rasters of all flights: the last flight is on top, the georeference is kept, paths are relative."""

import json
import shutil

import numpy as np
import pytest
import rasterio
from rasterio import Affine

from apertura.common.errors import ContractError
from apertura.common.provenance import canonical_json
from apertura.core.geometry.geodesy import local_crs
from apertura.formats.export.cog import write_power, write_slc
from apertura.formats.export.layers import OUTSIDE, SHADOW, write_looks, write_mask
from apertura.formats.export.mosaic import write_mosaic
from apertura.formats.export.radiometry import ECHO, TAG

UTM = {"crs": "EPSG:32632", "transform": Affine(0.1, 0, 691523.4, 0, -0.1, 5333000.1)}
LOCAL = {"crs": local_crs('<&"gotcha"> pass 1'), "transform": Affine(0.2, 0, -50, 0, -0.2, 50)}
COLUMN = np.add.outer(np.zeros(6), np.arange(8))


def write_with_mosaic(folder, write, layers, **grid):
    """Write a product of several flights and its mosaic; return the path of the mosaic."""
    files = [folder / f"f{number:02}" / "a-b" / "x.tif" for number, _ in enumerate(layers, start=1)]
    for path, layer in zip(files, layers, strict=True):
        path.parent.mkdir(parents=True)
        write(path, layer, **{"tags": {}, **grid})
    mosaic = folder / "mosaic" / "a-b" / "x.vrt"
    write_mosaic(mosaic, files, title='a & b "<c>"')
    return mosaic


@pytest.mark.parametrize("grid", [UTM, LOCAL], ids=["UTM", "local"])
def test_mosaic_shows_the_last_flight_with_data_on_the_same_grid(tmp_path, grid):
    first = np.where(COLUMN < 6, 1, np.nan).astype(np.complex64)
    last = np.where(COLUMN > 3, 2, np.nan).astype(np.complex64)
    mosaic = write_with_mosaic(tmp_path / "results", write_power, [first, last], **grid)
    shutil.move(tmp_path / "results", tmp_path / "moved")
    with (
        rasterio.open(tmp_path / "moved" / mosaic.relative_to(tmp_path / "results")) as raster,
        rasterio.open(tmp_path / "moved" / "f01" / "a-b" / "x.tif") as below,
    ):
        np.testing.assert_array_equal(raster.read(1), np.where(COLUMN > 3, 4, 1))
        assert (raster.transform, raster.crs, raster.shape) == (below.transform, below.crs, below.shape)
        assert np.isnan(raster.nodata)
        assert raster.tags()["TIFFTAG_IMAGEDESCRIPTION"] == 'a & b "<c>"'


def test_nodata_of_the_last_flight_is_transparent_in_mask_and_looks(tmp_path):
    outside = COLUMN < 4
    bits = [np.full(COLUMN.shape, SHADOW, np.uint8), np.where(outside, OUTSIDE, 0).astype(np.uint8)]
    looks = [np.full(COLUMN.shape, 7, np.float32), np.where(outside, 0, 9).astype(np.float32)]
    with rasterio.open(write_with_mosaic(tmp_path / "mask", write_mask, bits, **UTM)) as raster:
        np.testing.assert_array_equal(raster.read(1), np.where(outside, SHADOW, 0))
        assert raster.colorinterp[0] == rasterio.enums.ColorInterp.palette
        assert raster.colormap(1)[SHADOW] == (45, 55, 115, 255)
        assert raster.nodata == OUTSIDE
    with rasterio.open(write_with_mosaic(tmp_path / "looks", write_looks, looks, **UTM)) as raster:
        np.testing.assert_array_equal(raster.read(1), np.where(outside, 7, 9))


def test_mosaic_metadata_span_all_flights_and_omit_differing_values(tmp_path):
    folder, image = tmp_path / "results", np.ones((3, 4), np.complex64)
    files = []
    for name, amplitude, floor_db in (("f01", 10.0, -50.0), ("f02", 100.0, -40.0)):
        files.append(folder / name / "power.tif")
        files[-1].parent.mkdir(parents=True)
        tags = {TAG: canonical_json(ECHO.measured(amplitude, floor_db).report | {"divided_by": {"a-b": amplitude}})}
        write_power(files[-1], image, **UTM, tags=tags)
    write_mosaic(folder / "power.vrt", files)
    with rasterio.open(folder / "power.vrt") as raster:
        metadata = json.loads(raster.tags()[TAG])
    assert (metadata["peak_db"], metadata["noise_floor_re_peak_db"]) == (40.0, -70.0)
    assert metadata["quantity"] == "echo power, linear"
    assert "divided_by" not in metadata


def test_complex_rasters_and_other_grids_are_refused_in_a_mosaic(tmp_path):
    image, other_grid = np.ones((3, 4), np.complex64), UTM | {"transform": Affine(0.1, 0, 691523.5, 0, -0.1, 5333000.1)}
    write_power(tmp_path / "a.tif", image, **UTM, tags={})
    write_power(tmp_path / "b.tif", image, **other_grid, tags={})
    write_slc(tmp_path / "c.tif", image, **UTM, tags={})
    for names in (("a", "b"), ("a", "c"), ("c", "c")):
        with pytest.raises(ContractError, match=r"not a real raster on the grid of .*\.tif"):
            write_mosaic(tmp_path / "x.vrt", [tmp_path / f"{name}.tif" for name in names])
    assert not (tmp_path / "x.vrt").exists()
