"""From heights above a geoid to heights above the ellipsoid, through a checked grid file."""

import os
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from pyproj.datadir import get_data_dir, get_user_data_dir  # type: ignore[attr-defined]
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from apertura.common.arrays import Floats
from apertura.common.confined import on_disk
from apertura.common.constants import VERTICAL_DATUMS
from apertura.common.errors import CampaignError, quoted
from apertura.common.raster import LARGEST_BLOCK, opened_raster
from apertura.core.scene.terrain import bilinear

# ---- Grids of undulations: checked headers and values
#
# PROJ reads .gtx; its TIFF reader divides by zero on a damaged file, so GDAL reads those, as it does DEMs.

HIGHEST_M = 150.0
"""Metres, largest undulation either way: it is −107 m south of India, +86 m in New Guinea."""

MOST_POSTS = 300_000_000
"""Posts of a grid at most: a grid of one arc minute over the Earth has 233 million."""

_STEPS_DEG = (1e-4, 30.0)  # between posts, of any grid
_GTX = struct.Struct(">4d2i")
"""Latitude and longitude of the first post, steps of both, degrees; rows, columns."""

_EXPECTED = "a .gtx or .tif grid of undulations, as PROJ's collection has them"
_REMEDY = "Get that file again, or correct scene.geoid."


def check_grid(path: Path) -> None:
    """Raise CampaignError unless the size of a file is that of the grid in its header."""
    wrong = None
    if path.suffix.lower() == ".tif":
        with opened_raster(path, expected=_EXPECTED, remedy=_REMEDY) as raster:
            posts, place = raster.width * raster.height, raster.transform
        stepped = all(_STEPS_DEG[0] <= abs(step) <= _STEPS_DEG[1] for step in (place.a, place.e))  # NaN is neither
        placed = stepped and abs(place.c) <= 2 * 360 and abs(place.f) <= 2 * 90
        if posts > MOST_POSTS or place.b or place.d or not placed:
            wrong = f"{posts} posts placed by {[float(value) for value in place[:6]]}"
    elif path.suffix.lower() == ".gtx":
        with path.open("rb") as stream:
            header = stream.read(_GTX.size)
        south, west, *steps, rows, columns = _GTX.unpack(header.ljust(_GTX.size, b"\0"))
        size = path.stat().st_size
        if min(rows, columns) < 2 or rows * columns > MOST_POSTS or size != _GTX.size + 4 * rows * columns:
            wrong = f"{size} bytes for {rows} × {columns} posts"
        elif not (
            abs(south) <= 90 and abs(west) <= 360 and all(_STEPS_DEG[0] <= step <= _STEPS_DEG[1] for step in steps)
        ):
            wrong = f"a grid that begins at latitude {south:g}, longitude {west:g} in steps of {steps} degrees"
    else:
        wrong = f"a file of kind {quoted(path.suffix, 20)}"
    if wrong:
        raise CampaignError(wrong, where=path, expected=_EXPECTED, remedy=_REMEDY)


def undulation(grid: Path, longitude_deg: Floats, latitude_deg: Floats) -> Floats:
    """Return the height of the geoid above the ellipsoid.

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
        If the grid cannot be read or does not cover a place.

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
    """Return undulations read by PROJ; the operation names the grid, because PROJ skips a missing grid.

    A bare name would be searched elsewhere.
    """
    with on_disk(grid.absolute().parent) as folder:  # PROJ tells the format by the name
        steps = f'+step +proj=vgridshift +grids="{folder / grid.name}" +multiplier=1'
        try:
            shift = Transformer.from_pipeline(f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad {steps}")
        except ProjError as error:
            raise CampaignError("not readable as a vertical grid", grid, _EXPECTED, "Get it again.") from error
        return np.asarray(shift.transform(longitude, latitude, np.zeros_like(longitude))[2], np.float64)


def _of_tif(grid: Path, longitude: Floats, latitude: Floats) -> Floats:
    """Return band 1 between posts, NaN beyond them; a grid around the Earth wraps in longitude."""
    from rasterio.windows import Window

    with opened_raster(grid, expected=_EXPECTED, remedy=_REMEDY) as raster:
        place, (rows, columns) = raster.transform, raster.shape
        turn = 360 / abs(place.a)
        column = np.mod((longitude - place.c) / place.a - 0.5 + 1e-6, turn) - 1e-6  # the first post is inside
        row = (latitude - place.f) / place.e - 0.5
        around_earth = columns >= round(turn)
        inside = (row >= -1e-6) & (row <= rows - 1 + 1e-6) & (column >= -1e-6)
        inside &= around_earth | (column <= columns - 1 + 1e-6)
        undulations = np.full(row.shape, np.nan)
        if not inside.any():
            return undulations
        first = int(np.clip(np.floor(row[inside].min()), 0, max(rows - 2, 0)))
        last = int(np.clip(np.floor(row[inside].max()) + 2, 1, rows))
        if (last - first) * columns > LARGEST_BLOCK:
            raise ValueError(f"{last - first} rows of {columns} posts are needed at once")
        values = raster.read(1, window=Window(0, first, columns, last - first), masked=True)
        values = values.astype(np.float64).filled(np.nan) * raster.scales[0] + raster.offsets[0]
    if around_earth:
        values = np.concatenate([values, values[:, :1]], axis=1)
    undulations[inside] = bilinear(values[None], row[inside] - first, column[inside])[0]
    return undulations


# ---- Vertical datums and their grids

GRIDS = {"egm96": ("us_nga_egm96_15.tif", "egm96_15.gtx"), "egm2008": ("us_nga_egm08_25.tif", "egm08_25.gtx")}
"""Datum → names of its grid of undulations, as PROJ ships them."""

_MARKS = {"egm96": ("egm96",), "egm2008": ("egm08", "egm2008")}


def geoid_file(datum: str, given: Path | None, *, names: Sequence[str] = ()) -> Path:
    """Return the grid of undulations of a datum: the one given, else the one on PROJ's search path.

    Parameters
    ----------
    datum
        Datum of the heights, for the message and to check that the file is not another datum's.
    given
        What scene.geoid says, as a path that opens here.
    names
        File names to look for; `GRIDS` of the datum by default.

    Raises
    ------
    CampaignError
        If there is no such file: heights are never taken as ellipsoidal because a grid is missing.

    Examples
    --------
    >>> geoid_file("egm96", Path("nowhere.gtx"))
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere.gtx: no such file; expected the undulations of egm96, such as ...
    """
    names = tuple(names) or GRIDS.get(datum, ())
    expected = f"the undulations of {datum}" + (f", such as {' or '.join(names)}" if names else "")
    if given is None:
        paths = [folder / name for folder in grid_folders() for name in names if (folder / name).is_file()]
        if paths:
            return paths[0]
        raise CampaignError(
            f"heights count from {datum}, but its geoid grid is not here",
            where="scene.geoid",
            expected=expected,
            remedy=f"Get {names[0] if names else 'that grid'} from PROJ's grid collection (`projsync`), "
            "put it beside the DEM, and name it in scene.geoid.",
        )
    others = [mark for other, marks in _MARKS.items() if other != datum for mark in marks]
    wrong = "no such file" if not given.is_file() else None
    if any(mark in given.name.lower() for mark in others):
        wrong = f"the grid of another geoid than {datum}"
    if any(mark in str(given.absolute()) for mark in '",'):
        wrong = "a path with a comma or a quotation mark, which PROJ cannot open"
    if wrong:
        raise CampaignError(wrong, where=given, expected=expected, remedy="Get that file, or correct scene.geoid.")
    check_grid(given)
    return given


def grid_folders() -> list[Path]:
    """Return the folders in which grids of undulations are searched: PROJ's."""
    listed = [*os.environ.get("PROJ_DATA", "").split(os.pathsep), *get_data_dir().split(os.pathsep)]
    return [Path(folder) for folder in [*listed, get_user_data_dir()] if folder]


def declared_datum(crs: CRS) -> str | None:
    """Return the vertical datum of a CRS: 'ellipsoid', 'egm96', 'egm2008', the name of another datum, or None.

    Examples
    --------
    >>> [declared_datum(CRS(code)) for code in ("EPSG:4326", "EPSG:4979", "EPSG:4326+5773", "EPSG:25832+7837")]
    [None, 'ellipsoid', 'egm96', 'DHHN2016 height']
    """
    vertical = next((part for part in crs.sub_crs_list if part.is_vertical), None)
    if vertical is None:
        return "ellipsoid" if len(crs.axis_info) == 3 else None
    authority = vertical.to_authority() or ("", "")
    return VERTICAL_DATUMS.get(":".join(authority), vertical.name)


def grid_names(system: CRS) -> list[str]:
    """Return the grid files that PROJ needs for the heights of a compound CRS."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = TransformerGroup(system, "EPSG:4979", always_xy=True, allow_ballpark=False)
    operations = [part for one in group.transformers for part in (one.operations or ())] + group.unavailable_operations
    return list(dict.fromkeys(grid.short_name for operation in operations[:1] for grid in operation.grids))
