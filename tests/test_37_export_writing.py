"""Verification of files written by GDAL, in memory and on disk."""

import errno

import numpy as np
import pytest
import rasterio
from rasterio import Affine

from apertura.formats.export import cog, writing
from apertura.formats.export.cog import power, write_power, write_slc
from apertura.formats.export.db import write_db
from apertura.formats.export.writing import added, check_written

UTM = {"transform": Affine(1, 0, 5, 0, -1, 9), "crs": "EPSG:32632", "tags": {"APERTURA_RUNSPEC": "{}"}}


def image():
    return np.random.default_rng(0).standard_normal((700, 600, 2)).astype(np.float32).view(np.complex64)[..., 0]


@pytest.fixture
def on_disk(monkeypatch):
    """Write every file on disk, none in memory."""
    for module in (cog, writing):
        monkeypatch.setattr(module, "IN_MEMORY_BYTES", 0)


@pytest.mark.parametrize("write", [write_slc, write_power, write_db])
def test_writing_through_memory_and_disk_gives_the_same_bytes(tmp_path, request, write):
    write(tmp_path / "x.tif", image(), **UTM)
    in_memory = (tmp_path / "x.tif").read_bytes()
    request.getfixturevalue("on_disk")
    write(tmp_path / "x.tif", image(), **UTM)
    assert (tmp_path / "x.tif").read_bytes() == in_memory
    assert [path.name for path in tmp_path.iterdir()] == ["x.tif"]


@pytest.mark.quick("write_power")
@pytest.mark.parametrize("write", [write_slc, write_power, write_db])
def test_gdal_threads_do_not_change_the_file(tmp_path, write):
    several = np.tile(image(), (3, 3))
    for threads in (1, 3):
        with rasterio.Env(GDAL_NUM_THREADS=threads):
            write(tmp_path / f"{threads}.tif", several, **UTM)
    assert (tmp_path / "1.tif").read_bytes() == (tmp_path / "3.tif").read_bytes()


@pytest.fixture
def written(tmp_path):
    write_power(tmp_path / "x.tif", image(), **UTM)
    return tmp_path / "x.tif"


def test_read_back_check_detects_missing_pixels_and_tags(written):
    checksum = added(0, power(image()))
    check_written(written, checksum, UTM["tags"])
    with pytest.raises(OSError, match="differs from the data written"):
        check_written(written, checksum + 1, UTM["tags"])
    with pytest.raises(OSError, match="differs from the data written"):
        check_written(written, checksum, {"APERTURA_FLAGS": "{}"})


def test_gdal_write_failure_is_an_os_error_with_the_file_name(tmp_path, monkeypatch, on_disk):
    def fail(*_):
        raise rasterio.errors.RasterioIOError("Write failed. See previous exception for details.")

    monkeypatch.setattr(cog, "check_written", fail)
    with pytest.raises(OSError, match="Write failed") as caught:
        write_slc(tmp_path / "x.tif", image(), **UTM)
    assert (caught.value.errno, caught.value.filename) == (errno.EIO, str(tmp_path / "x.tif"))
    assert list(tmp_path.iterdir()) == []
