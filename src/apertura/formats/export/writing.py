"""Files written by GDAL: complete or absent, with errors that state their cause."""

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
GDAL = {"GDAL_CACHEMAX": 128, "GDAL_PAM_ENABLED": False}  # MB; no .aux.xml beside the file

IN_MEMORY_BYTES = 1 << 27
"""Pixels of a raster that GDAL writes in memory: 4096 x 4096 complex."""

_FULL_BYTES = 1 << 20  # less than this free, and the disk counts as full

BlockSlices = tuple[slice, slice]


@contextmanager
def gdal_replacement(path: Path, *, size: int) -> Iterator[Path]:
    """Yield where GDAL writes what becomes `path`; what cannot be written is an `OSError`.

    GDAL keeps some errors of writing to itself. What is small it writes in memory, and Python brings it to the disk;
    what is larger it writes on the disk, where `check_written` reads it again.

    Parameters
    ----------
    path
        Complete or absent.
    size
        Bytes of the raster's pixels.

    Raises
    ------
    OSError
        With a number and `path`: `ENOSPC` where the disk is full, `EIO` where GDAL does not state the cause.
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
            raise OSError(number, f"{os.strerror(number)}: GDAL says: {error}", str(path)) from error


def blocks_of(shape: tuple[int, ...]) -> Iterator[BlockSlices]:
    """Yield the blocks of a raster that pass through memory one by one.

    Examples
    --------
    >>> [(rows.stop, columns.stop) for rows, columns in blocks_of((10, 3000))]
    [(10, 2048), (10, 3000)]
    """
    for top, left in product(range(0, shape[0], READ), range(0, shape[1], READ)):
        yield slice(top, min(top + READ, shape[0])), slice(left, min(left + READ, shape[1]))


def added(checksum: int, pixels: NDArray[Any]) -> int:
    """Return a sum over pixels with those of another block."""
    total: int = google_crc32c.extend(checksum, np.ascontiguousarray(pixels).view(np.uint8).ravel())
    return total


def check_written(path: Path, checksum: int, tags: Mapping[str, str]) -> None:
    """Read a raster back, overviews too, and compare its pixels and tags with what was written.

    Raises
    ------
    OSError
        If it does not hold them.
    """
    with rasterio.open(path) as raster:
        levels = len(raster.overviews(1))
        read, tags_read = _checksum(raster), raster.tags()
    for level in range(levels):
        with rasterio.open(path, OVERVIEW_LEVEL=level) as overview:
            _checksum(overview)  # its tiles carry sums of their own, which GDAL compares
    if read != checksum or not tags.items() <= tags_read.items():
        raise OSError(errno.EIO, "what was written does not read back", str(path))


def _checksum(raster: Any) -> int:
    checksum = 0
    for block in blocks_of(raster.shape):
        checksum = added(checksum, raster.read(1, window=Window.from_slices(*block)))
    return checksum
