"""Mean power of squares of pixels, on a coarser grid: linear, for measuring, and in decibels."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from rasterio import Affine

from apertura.common.errors import ContractError
from apertura.formats.export.cog import POWER, NorthUpRaster, Pixels, write_cog
from apertura.formats.export.db import DB, write_db

_EFFORT = 6  # of many looks, and of noise alone, less is speckle


def write_mean_power(
    path: Path, power: NorthUpRaster, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write power, (y, x) float32, as it is: below zero where more noise was subtracted than there was.

    Else as `cog.write_slc`.
    """
    band = replace(POWER, effort=_EFFORT)
    write_cog(path, power, band, transform=transform, crs=crs, tags=tags, title=title, value=_real)


def write_mean_db(
    path: Path, power: NorthUpRaster, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write 10 log10 of power, (y, x) float32; NaN where it is not above zero.

    Overviews are the dB of the mean of all, those below zero included. Else as `cog.write_slc`.

    Examples
    --------
    >>> import rasterio
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path, power = Path(folder) / "multilook_db.tif", np.array([[100, -1]], "f4")
    ...     write_mean_db(path, power, transform=Affine(1, 0, 5, 0, -1, 9), crs="EPSG:32632", tags={})
    ...     with rasterio.open(path) as raster:
    ...         raster.read(1)
    array([[20., nan]], dtype=float32)
    """
    band = replace(DB, effort=_EFFORT)
    write_db(path, power, transform=transform, crs=crs, tags=tags, title=title, value=_real, band=band)


def _real(power: Pixels) -> Pixels:
    if power.dtype != np.float32:
        raise ContractError(f"power to export is {power.dtype}, not float32")
    return power
