"""Grids of undulations in files: what their headers promise is checked before PROJ trusts it, and TIFF is read here.

PROJ reads .gtx; of a damaged TIFF its reader divides by zero, so that GDAL reads those, as it does DEMs.
"""

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer
from pyproj.exceptions import ProjError

from apertura.common.errors import CampaignError, quoted
from apertura.common.raster import LARGEST_BLOCK, opened_raster
from apertura.core.scene.terrain import bilinear

HIGHEST_M = 150.0
"""No geoid lies farther above or below the ellipsoid: −107 m south of India, +86 m in New Guinea."""

MOST_POSTS = 300_000_000
"""Posts of a grid: one minute all round the Earth."""

_GTX = struct.Struct(">4d2i")
"""Latitude and longitude of the first post, steps of both, degrees; rows, columns."""

_EXPECTED = "a .gtx or .tif grid of undulations, as PROJ's collection has them"
_REMEDY = "Get that file again, or correct scene.geoid."

Floats = NDArray[np.float64]


def check_grid(path: Path) -> None:
    """Raise CampaignError unless a file is as large as the grid that its header promises."""
    wrong = None
    if path.suffix.lower() == ".tif":
        with opened_raster(path, expected=_EXPECTED, remedy=_REMEDY) as raster:
            posts, place = raster.width * raster.height, raster.transform
        if posts > MOST_POSTS or not np.isfinite(place[:6]).all() or place.b or place.d or not place.a * place.e:
            wrong = f"{posts} posts placed by {[float(value) for value in place[:6]]}"
    elif path.suffix.lower() == ".gtx":
        with path.open("rb") as stream:
            header = stream.read(_GTX.size)
        south, west, *steps, rows, columns = _GTX.unpack(header.ljust(_GTX.size, b"\0"))
        size = path.stat().st_size
        if min(rows, columns) < 2 or rows * columns > MOST_POSTS or size != _GTX.size + 4 * rows * columns:
            wrong = f"{size} bytes for {rows} × {columns} posts"
        elif not (abs(south) <= 90 and abs(west) <= 360 and all(1e-4 <= step <= 30 for step in steps)):
            wrong = f"a grid that begins at latitude {south:g}, longitude {west:g} in steps of {steps} degrees"
    else:
        wrong = f"a file of kind {quoted(path.suffix, 20)}"
    if wrong:
        raise CampaignError(wrong, where=path, expected=_EXPECTED, remedy=_REMEDY)


def undulation(grid: Path, longitude_deg: Floats, latitude_deg: Floats) -> Floats:
    """Return how high the geoid lies above the ellipsoid.

    Parameters
    ----------
    grid
        A grid as PROJ ships them (.gtx, .tif).
    longitude_deg, latitude_deg
        (...,) float64, degrees, in the geodetic CRS of the grid.

    Returns
    -------
    ndarray
        (...,) float64, metres, bilinear in the grid: ellipsoidal height = height above the geoid + undulation.

    Raises
    ------
    CampaignError
        If the grid cannot be read or does not reach a place.

    Notes
    -----
    Source: PROJ, operation vgridshift.
    """
    check_grid(grid)
    sample = _of_tif if grid.suffix.lower() == ".tif" else _of_gtx
    shape = np.shape(longitude_deg)
    height = sample(grid, *(np.ravel(np.asarray(angle, np.float64)) for angle in (longitude_deg, latitude_deg)))
    lost = ~(np.abs(height) <= HIGHEST_M)
    if lost.any():
        longitude, latitude = (np.ravel(angle)[lost.argmax()] for angle in (longitude_deg, latitude_deg))
        raise CampaignError(
            f"has no undulation of the Earth at longitude {longitude:.4f}, latitude {latitude:.4f}",
            where=grid,
            expected="a grid that reaches over the scene",
            remedy="Get a grid of the region and name it in scene.geoid.",
        )
    return height.reshape(shape)


def _of_gtx(grid: Path, longitude: Floats, latitude: Floats) -> Floats:
    """Return what PROJ reads; the grid is named in the operation itself, because PROJ skips one that it does not find.

    A bare name would be looked for elsewhere.
    """
    steps = f'+step +proj=vgridshift +grids="{grid.absolute()}" +multiplier=1'
    try:
        shift = Transformer.from_pipeline(f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad {steps}")
    except ProjError as error:
        raise CampaignError("not readable as a vertical grid", grid, _EXPECTED, "Get it again.") from error
    return np.asarray(shift.transform(longitude, latitude, np.zeros_like(longitude))[2], np.float64)


def _of_tif(grid: Path, longitude: Floats, latitude: Floats) -> Floats:
    """Return band 1 between posts, NaN beyond them; a grid all round the Earth has no last column."""
    from rasterio.windows import Window

    with opened_raster(grid, expected=_EXPECTED, remedy=_REMEDY) as raster:
        place, (rows, columns) = raster.transform, raster.shape
        turn = 360 / abs(place.a)
        column = np.mod((longitude - place.c) / place.a - 0.5 + 1e-6, turn) - 1e-6  # the first post is inside
        row = (latitude - place.f) / place.e - 0.5
        whole = columns >= round(turn)
        inside = (row >= -1e-6) & (row <= rows - 1 + 1e-6) & (column >= -1e-6)
        inside &= whole | (column <= columns - 1 + 1e-6)
        found = np.full(row.shape, np.nan)
        if not inside.any():
            return found
        first = int(np.clip(np.floor(row[inside].min()), 0, max(rows - 2, 0)))
        last = int(np.clip(np.floor(row[inside].max()) + 2, 1, rows))
        if (last - first) * columns > LARGEST_BLOCK:
            raise ValueError(f"{last - first} rows of {columns} posts are needed at once")
        values = raster.read(1, window=Window(0, first, columns, last - first), masked=True)
        values = values.astype(np.float64).filled(np.nan) * raster.scales[0] + raster.offsets[0]
    if whole:
        values = np.concatenate([values, values[:, :1]], axis=1)
    found[inside] = bilinear(values[None], row[inside] - first, column[inside])[0]
    return found
