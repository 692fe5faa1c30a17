"""Images in decibels, which most users of a GIS open first."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import rasterio
from rasterio import Affine
from rasterio.enums import Resampling
from rasterio.windows import Window

from apertura.formats.export.cog import (
    BLOCK,
    POWER,
    Band,
    NorthUpRaster,
    Pixels,
    described,
    fill,
    finish,
    placed,
    power,
    size_of,
)
from apertura.formats.export.radiometry import with_radiometry
from apertura.formats.export.writing import IN_MEMORY_BYTES, Block, check_written, gdal_replacement

DB = Band("float32", np.nan, "dB", "{power}, 10 log10", "AVERAGE", effort=1)


def write_db(
    path: Path,
    image: NorthUpRaster,
    *,
    transform: Affine,
    crs: str,
    tags: Mapping[str, str],
    title: str = "",
    value: Callable[[Pixels], Pixels] = power,
    band: Band = DB,
) -> None:
    """Write 20 log10 |image| as a float32 COG whose overviews are the dB of averaged power.

    A pixel without power has no dB: it is nodata (NaN), never -inf, yet counts as what it is in the
    averaged power of the overviews. Parameters and errors as `write_slc`.

    Parameters
    ----------
    path, image, transform, crs, tags, title
        As `write_slc`.
    value
        Block of `image` → its power.
    band
        Of the file.

    Notes
    -----
    Source: docs/theory/export.md, "Overviews in dB".

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "db.tif"
    ...     write_db(path, np.array([[10j, 0]], "c8"), transform=Affine(1, 0, 5, 0, -1, 9), crs="EPSG:32632", tags={})
    ...     with rasterio.open(path) as raster:
    ...         raster.read(1)
    array([[20., nan]], dtype=float32)
    """
    place = placed(image, transform, crs)
    band, tags = with_radiometry(band, tags)
    words, size = described(tags, title), size_of(image, POWER)
    with gdal_replacement(path, size=size) as temporary:
        linear = temporary.with_name("power.tif")
        checksums = [fill(linear, lambda block: value(np.asarray(image[block])), POWER, place, {})]
        if size > IN_MEMORY_BYTES:
            check_written(linear, checksums[0], {})
        levels = max(0, int(np.ceil(np.log2(max(image.shape) / BLOCK))))
        with rasterio.open(linear, "r+") as raster:
            raster.build_overviews([2**level for level in range(1, levels + 1)], Resampling.average)
        # GDAL finds the first overview of source.tif in source.tif.ovr, the next in source.tif.ovr.ovr, …
        for level in range(levels + 1):
            with rasterio.open(linear, **({"OVERVIEW_LEVEL": level - 1} if level else {})) as mean:
                smaller = {"height": mean.height, "width": mean.width}
                file, read = temporary.with_name("source.tif" + level * ".ovr"), partial(_read_decibels, mean)
                checksums.append(fill(file, read, band, smaller if level else place, {} if level else words))
        finish(temporary.with_name("source.tif"), temporary, band)
        if size > IN_MEMORY_BYTES:
            check_written(temporary, checksums[1], words)


def _read_decibels(mean: rasterio.DatasetReader, block: Block) -> Pixels:
    return decibels(mean.read(1, window=Window.from_slices(*block)).astype(np.float64)).astype(np.float32)


def decibels(linear: Pixels) -> Pixels:
    """Return 10 log10 of power, NaN where there is none.

    Examples
    --------
    >>> decibels(np.array([100.0, 0.0, np.nan]))
    array([20., nan, nan])
    """
    return 10 * np.log10(np.where(linear > 0, linear, linear.dtype.type(np.nan)))
