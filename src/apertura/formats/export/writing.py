"""Atomic writing of files with GDAL, with error messages that contain the cause."""

import errno
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any
from uuid import uuid4

import google_crc32c
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.io import MemoryFile
from rasterio.windows import Window

from apertura.common.atomic import replacement

READ = 2048  # pixels along a side of a block in memory: four tiles of a COG
GDAL = {"GDAL_CACHEMAX": 128, "GDAL_PAM_ENABLED": False}  # MB; no sidecar file .aux.xml

IN_MEMORY_BYTES = 1 << 27
"""Maximum size of a raster that GDAL writes in memory, bytes: 4096 x 4096 complex pixels."""

_FULL_BYTES = 1 << 20  # free space below which the disk is reported as full

BlockSlices = tuple[slice, slice]


@contextmanager
def gdal_replacement(path: Path, *, size: int) -> Iterator[Path]:
    """Yield the temporary path of a GDAL output that becomes `path`; raise `OSError` if writing fails.

    GDAL does not report all write errors. Small rasters are therefore written in memory and copied to the disk by
    Python; larger rasters are written to the disk and read back by `check_written`.

    Parameters
    ----------
    path
        Output file; complete or absent.
    size
        Size of the raster's pixels in bytes.

    Raises
    ------
    OSError
        With `path` and an errno: `ENOSPC` if the disk is full, `EIO` if GDAL does not state the cause.
    """
    with replacement(path) as temporary, rasterio.Env(**GDAL):
        if size <= IN_MEMORY_BYTES:
            with MemoryFile(dirname=uuid4().hex, filename=path.name) as memory:
                yield Path(memory.name)
                temporary.write_bytes(memory.getbuffer())
            return
        try:
            yield temporary
        except Exception as error:
            number = isinstance(error, OSError) and error.errno
            if number or not type(error).__module__.startswith("rasterio"):
                raise
            number = errno.ENOSPC if shutil.disk_usage(temporary.parent).free < _FULL_BYTES else errno.EIO
            raise OSError(number, f"{os.strerror(number)}: GDAL error: {error}", str(path)) from error


def blocks_of(shape: tuple[int, ...]) -> Iterator[BlockSlices]:
    """Yield the blocks in which a raster is processed.

    Examples
    --------
    >>> [(rows.stop, columns.stop) for rows, columns in blocks_of((10, 3000))]
    [(10, 2048), (10, 3000)]
    """
    for top, left in product(range(0, shape[0], READ), range(0, shape[1], READ)):
        yield slice(top, min(top + READ, shape[0])), slice(left, min(left + READ, shape[1]))


def added(checksum: int, pixels: NDArray[Any]) -> int:
    """Update a checksum with the pixels of another block."""
    total: int = google_crc32c.extend(checksum, np.ascontiguousarray(pixels).view(np.uint8).ravel())
    return total


def check_written(path: Path, checksum: int, tags: Mapping[str, str]) -> None:
    """Read a raster and its overviews back, and compare checksum and tags with the values written.

    Raises
    ------
    OSError
        If checksum or tags differ.
    """
    with rasterio.open(path) as raster:
        levels = len(raster.overviews(1))
        read, tags_read = _checksum(raster), raster.tags()
    for level in range(levels):
        with rasterio.open(path, OVERVIEW_LEVEL=level) as overview:
            _checksum(overview)  # GDAL verifies the checksums of the overview tiles
    if read != checksum or not tags.items() <= tags_read.items():
        raise OSError(errno.EIO, "the file differs from the data written", str(path))


def _checksum(raster: Any) -> int:
    checksum = 0
    for block in blocks_of(raster.shape):
        checksum = added(checksum, raster.read(window=Window.from_slices(*block)))
    return checksum
