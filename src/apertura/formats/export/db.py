"""Export of images in decibels, the product for display in a GIS."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from rasterio import Affine

from apertura.formats.export.cog import Band, NorthUpRaster, Pixels, only, power, write_cog

DB = Band("float32", np.nan, "dB", "{power}, 10 log10", "AVERAGE")


def write_db(
    path: Path,
    image: NorthUpRaster,
    *,
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    title: str = "",
    value: Callable[[Pixels], Pixels] = power,
) -> None:
    """Write 20 log10 |image| as a float32 COG; overviews contain the averaged power in dB.

    A pixel with zero power is nodata (NaN), never -inf, but contributes zero to the averaged power of the overviews.
    For parameters and errors see `write_slc`.

    Parameters
    ----------
    path, image, transform, crs, tags, title
        See `write_slc`.
    value
        Function that returns the power of a block of `image`.

    Notes
    -----
    Source: docs/theory/export.md, "Overviews in dB".

    Examples
    --------
    >>> import rasterio
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "db.tif"
    ...     write_db(path, np.array([[10j, 0]], "c8"), transform=Affine(1, 0, 5, 0, -1, 9), crs="EPSG:32632", tags={})
    ...     with rasterio.open(path) as raster:
    ...         raster.read(1)
    array([[20., nan]], dtype=float32)
    """

    def shown(linear: Pixels) -> Pixels:
        return decibels(linear.astype(np.float64)).astype(np.float32)

    write_cog(path, image, DB, transform=transform, crs=crs, tags=tags, title=title, value=value, shown=shown)


def write_mean_db(
    path: Path, power: NorthUpRaster, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write 10 log10 of a multilooked power, (y, x) float32; NaN where the power is not positive.

    Overviews contain the mean power of all pixels, including negative pixels, in dB. Otherwise as `write_db`.

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
    write_db(path, power, transform=transform, crs=crs, tags=tags, title=title, value=only("float32"))


def decibels(linear: Pixels) -> Pixels:
    """Convert power to decibels; NaN where the power is not positive.

    Examples
    --------
    >>> decibels(np.array([100.0, 0.0, np.nan]))
    array([20., nan, nan])
    """
    return 10 * np.log10(np.where(linear > 0, linear, linear.dtype.type(np.nan)))
