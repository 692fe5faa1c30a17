"""GDAL's files held to the promise of all others: complete or absent, and an error is one that says what it was."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

from apertura.atomic import replacement

READ = 2048  # pixels along a side of what is held in memory at once: four tiles of a COG
GDAL = {"GDAL_CACHEMAX": 128, "GDAL_PAM_ENABLED": False}  # MB; no .aux.xml beside the file

_FULL_BYTES = 1 << 20  # less than this free, and the disk counts as full

Block = tuple[slice, slice]


@contextmanager
def gdal_replacement(path: Path) -> Iterator[Path]:
    """Yield where GDAL writes what becomes `path`; what it cannot write or read back is an `OSError`.

    GDAL's own errors do not say why a write failed, and some, at the closing of a file, it keeps to itself.

    Raises
    ------
    OSError
        With a number and `path`: `ENOSPC` where the disk is full, `EIO` where GDAL does not say what it was.
    """
    with replacement(path) as temporary, rasterio.Env(**GDAL):
        try:
            yield temporary
        except Exception as error:
            if not type(error).__module__.startswith("rasterio") or getattr(error, "errno", None):
                raise
            number = errno.ENOSPC if shutil.disk_usage(temporary.parent).free < _FULL_BYTES else errno.EIO
            raise OSError(number, f"{os.strerror(number)}: GDAL says: {error}", str(path)) from error


def blocks_of(shape: tuple[int, ...]) -> Iterator[Block]:
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


def check_written(path: Path, checksum: int) -> None:
    """Read a raster back, overviews too, and compare its pixels with what was written.

    Raises
    ------
    OSError
        If it does not hold them.
    """
    with rasterio.open(path) as raster:
        levels = len(raster.overviews(1))
        found = _checksum(raster)
    for level in range(levels):
        with rasterio.open(path, OVERVIEW_LEVEL=level) as overview:
            _checksum(overview)  # its tiles carry sums of their own, which GDAL compares
    if found != checksum:
        raise OSError(errno.EIO, "what was written does not read back", str(path))


def _checksum(raster: Any) -> int:
    found = 0
    for block in blocks_of(raster.shape):
        found = added(found, raster.read(1, window=Window.from_slices(*block)))
    return found
