"""Images in decibels, which most users of a GIS open first."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
import rasterio
from rasterio import Affine
from rasterio.enums import Resampling
from rasterio.windows import Window

from apertura.export.cog import BLOCK, POWER, Band, Pixels, Raster, described, fill, finish, placed, power
from apertura.export.writing import Block, check_written, gdal_replacement

DB = Band("float32", np.nan, "dB", "power of the focused scene, 10 log10", "AVERAGE")


def write_db(
    path: Path, image: Raster, *, transform: Affine, crs: str, tags: Mapping[str, str], title: str = ""
) -> None:
    """Write 20 log10 |image| as a float32 COG whose overviews are the dB of averaged power.

    A pixel without power has no dB: it is nodata (NaN), never -inf, yet counts as zero in the
    averaged power of the overviews. Parameters and errors as `write_slc`.

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
    with gdal_replacement(path) as temporary:
        linear = temporary.with_name("power.tif")
        check_written(linear, fill(linear, lambda block: power(np.asarray(image[block])), POWER, place, {}))
        checksums = []
        levels = max(0, int(np.ceil(np.log2(max(image.shape) / BLOCK))))
        with rasterio.open(linear, "r+") as raster:
            raster.build_overviews([2**level for level in range(1, levels + 1)], Resampling.average)
        # GDAL finds the first overview of source.tif in source.tif.ovr, the next in source.tif.ovr.ovr, …
        for level in range(levels + 1):
            with rasterio.open(linear, **({"OVERVIEW_LEVEL": level - 1} if level else {})) as mean:
                size = {"height": mean.height, "width": mean.width}
                checksums.append(
                    fill(
                        temporary.with_name("source.tif" + level * ".ovr"),
                        partial(_read_decibels, mean),
                        DB,
                        size if level else place,
                        {} if level else described(tags, title),
                    )
                )
        finish(temporary.with_name("source.tif"), temporary, DB, checksums[0])


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
