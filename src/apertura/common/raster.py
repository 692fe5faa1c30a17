"""Opening of untrusted rasters as GeoTIFF only, without sidecar files.

By default, GDAL selects a driver by file content: a VRT or WMS document named .tif can access other files and the
network, and a sidecar file can change the heights or the georeference of a raster.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from apertura.common.confined import on_disk
from apertura.common.errors import CampaignError, shown

ISOLATED = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",  # ignore sidecar files: .ovr, .msk, .tfw, .aux.xml
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_GEOREF_SOURCES": "INTERNAL",
    "GTIFF_IGNORE_READ_ERRORS": "NO",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "{none}",
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "/vsicurl/none",
    "GDAL_HTTP_MAX_RETRY": "0",
    "PROJ_NETWORK": "OFF",
}
"""GDAL configuration options for opening and reading an untrusted raster."""

LARGEST_BLOCK = 100_000_000
"""Maximum number of values in a block or strip of a raster; GDAL allocates the whole block before decompression."""

LARGEST_SIDE = 1 << 30
"""Maximum number of rows or columns."""


@contextmanager
def opened_raster(path: Path, *, expected: str, remedy: str) -> Iterator[Any]:
    """Open a GeoTIFF for reading; errors during opening and within the context are converted to a single message.

    Parameters
    ----------
    path
        The file; sidecar files are ignored.
    expected, remedy
        Parts of the error message.

    Yields
    ------
    rasterio.DatasetReader
        The raster.

    Raises
    ------
    CampaignError
        If the file is missing, is not a GeoTIFF, exceeds the limits of block or raster size, or cannot be read.
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

    if name.startswith("/vsi"):  # the path is absolute and thus has no scheme such as zip:
        raise OSError("a path that GDAL interprets as a virtual file system")
    return rasterio.open(name, driver="GTiff", sharing=False)
