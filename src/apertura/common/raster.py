"""Untrusted rasters, opened as GeoTIFF and nothing else, without sidecar files.

GDAL would otherwise choose a driver by content: a VRT or WMS document named .tif reads other files and the network, and
a file beside a raster changes its heights or its place.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from apertura.common.confined import on_disk
from apertura.common.errors import CampaignError, shown

ISOLATED = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",  # no .ovr, .msk, .tfw, .aux.xml is looked for
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_GEOREF_SOURCES": "INTERNAL",
    "GTIFF_IGNORE_READ_ERRORS": "NO",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "{none}",
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "/vsicurl/none",
    "GDAL_HTTP_MAX_RETRY": "0",
    "PROJ_NETWORK": "OFF",
}
"""Settings of GDAL under which an untrusted raster is opened and read."""

LARGEST_BLOCK = 100_000_000
"""Values of one block or strip of a raster: GDAL allocates it whole before it is decompressed."""

LARGEST_SIDE = 1 << 30
"""Rows or columns."""


@contextmanager
def opened_raster(path: Path, *, expected: str, remedy: str) -> Iterator[Any]:
    """Open a GeoTIFF for reading; what goes wrong meanwhile, too, becomes one message.

    Parameters
    ----------
    path
        The file; only what it holds itself counts.
    expected, remedy
        For the message.

    Yields
    ------
    rasterio.DatasetReader
        The raster.

    Raises
    ------
    CampaignError
        If it is not there, is no GeoTIFF, has blocks or sides that no raster of ours has, or cannot be read.
    """
    import rasterio

    if not path.is_file():
        raise CampaignError("no such file", where=path, expected=expected, remedy=remedy)
    try:
        with on_disk(path) as file, rasterio.Env(**ISOLATED), _opened(str(file.absolute())) as raster:
            block, shape = raster.block_shapes[0], raster.shape
            if block[0] * block[1] > LARGEST_BLOCK or max(shape) > LARGEST_SIDE:
                raise OSError(f"{shape[0]} × {shape[1]} posts in blocks of {block[0]} × {block[1]}")
            yield raster
    except CampaignError:
        raise
    except (rasterio.errors.RasterioError, OSError, ValueError, ArithmeticError, LookupError) as error:
        cause = f"{error}: {error.__cause__}" if error.__cause__ else str(error)
        cause = re.sub(rf"{re.escape(str(path.absolute()))}|/proc/self/fd/\d+", path.name, cause)
        found = f"not readable as GeoTIFF ({shown(cause, 200)})"
        raise CampaignError(found, where=path, expected=expected, remedy=remedy) from error


def _opened(name: str) -> Any:
    import rasterio

    if name.startswith("/vsi"):  # an absolute path has no scheme
        raise OSError("a path that GDAL takes for another file system")
    return rasterio.open(name, driver="GTiff", sharing=False)
