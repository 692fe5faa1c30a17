"""Conversion of heights above a geoid to ellipsoidal heights, and checks of the grid of undulations."""

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
# PROJ reads .gtx grids. The TIFF reader of PROJ divides by zero if a file is damaged; TIFF grids are therefore read by
# GDAL, like DEMs.

HIGHEST_M = 150.0
"""Largest accepted magnitude of undulations, metres; the extremes are −107 m south of India and +86 m in New Guinea."""

MOST_POSTS = 300_000_000
"""Largest number of posts of a grid: a global grid with a spacing of one arc minute has 233 million posts."""

_STEPS_DEG = (1e-4, 30.0)  # limits of the spacing of posts
_GTX = struct.Struct(">4d2i")
"""Header of a grid: latitude and longitude of the first post, steps in latitude and longitude, degrees; numbers of rows
and columns."""

_EXPECTED = "a .gtx or .tif grid of undulations in the format of PROJ's grid collection"
_REMEDY = "Download the file again, or correct scene.geoid."


def check_grid(path: Path) -> None:
    """Raise CampaignError if the header of a grid is invalid or does not match the size of the file."""
    wrong = None
    if path.suffix.lower() == ".tif":
        with opened_raster(path, expected=_EXPECTED, remedy=_REMEDY) as raster:
            posts, affine = raster.width * raster.height, raster.transform
        valid_steps = all(_STEPS_DEG[0] <= abs(step) <= _STEPS_DEG[1] for step in (affine.a, affine.e))  # False for NaN
        valid_origin = abs(affine.c) <= 2 * 360 and abs(affine.f) <= 2 * 90
        if posts > MOST_POSTS or affine.b or affine.d or not (valid_steps and valid_origin):
            wrong = f"{posts} posts with the transform {[float(value) for value in affine[:6]]}"
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
            wrong = f"a grid that starts at latitude {south:g}, longitude {west:g} in steps of {steps} degrees"
    else:
        wrong = f"a file of type {quoted(path.suffix, 20)}"
    if wrong:
        raise CampaignError(wrong, where=path, expected=_EXPECTED, remedy=_REMEDY)


def undulation(grid: Path, longitude_deg: Floats, latitude_deg: Floats) -> Floats:
    """Return the height of the geoid above the ellipsoid.

    Parameters
    ----------
    grid
        Grid of undulations in a format of PROJ's grid collection (.gtx, .tif).
    longitude_deg, latitude_deg
        (...,) float64, degrees, in the geodetic CRS of the grid.

    Returns
    -------
    ndarray
        (...,) float64, metres, interpolated bilinearly: ellipsoidal height = height above the geoid + undulation.

    Raises
    ------
    CampaignError
        If the grid is not readable or does not cover a point.

    Notes
    -----
    Source: PROJ, operation vgridshift.
    """
    check_grid(grid)
    sample = _of_tif if grid.suffix.lower() == ".tif" else _of_gtx
    shape = np.shape(longitude_deg)
    height = sample(grid, *(np.ravel(np.asarray(angle, np.float64)) for angle in (longitude_deg, latitude_deg)))
    invalid = ~(np.abs(height) <= HIGHEST_M)
    if invalid.any():
        longitude, latitude = (np.ravel(angle)[invalid.argmax()] for angle in (longitude_deg, latitude_deg))
        raise CampaignError(
            f"no valid undulation at longitude {longitude:.4f}, latitude {latitude:.4f}",
            where=grid,
            expected="a grid that covers the scene",
            remedy="Obtain a grid of the region and set scene.geoid to its path.",
        )
    return height.reshape(shape)


def _of_gtx(grid: Path, longitude: Floats, latitude: Floats) -> Floats:
    """Return undulations interpolated by PROJ.

    The operation contains the absolute path of the grid, because PROJ ignores missing grids and searches file names
    without a path in other folders.
    """
    with on_disk(grid.absolute().parent) as folder:  # PROJ derives the format from the file name
        steps = f'+step +proj=vgridshift +grids="{folder / grid.name}" +multiplier=1'
        try:
            shift = Transformer.from_pipeline(f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad {steps}")
        except ProjError as error:
            raise CampaignError("not readable as a vertical grid", grid, _EXPECTED, _REMEDY) from error
        return np.asarray(shift.transform(longitude, latitude, np.zeros_like(longitude))[2], np.float64)


def _of_tif(grid: Path, longitude: Floats, latitude: Floats) -> Floats:
    """Return band 1, interpolated between posts; NaN outside the grid. A global grid is periodic in longitude."""
    from rasterio.windows import Window

    with opened_raster(grid, expected=_EXPECTED, remedy=_REMEDY) as raster:
        affine, (rows, columns) = raster.transform, raster.shape
        columns_of_circle = 360 / abs(affine.a)
        column = np.mod((longitude - affine.c) / affine.a - 0.5 + 1e-6, columns_of_circle) - 1e-6  # includes post 0
        row = (latitude - affine.f) / affine.e - 0.5
        is_global = columns >= round(columns_of_circle)
        inside = (row >= -1e-6) & (row <= rows - 1 + 1e-6) & (column >= -1e-6)
        inside &= is_global | (column <= columns - 1 + 1e-6)
        undulations = np.full(row.shape, np.nan)
        if not inside.any():
            return undulations
        first = int(np.clip(np.floor(row[inside].min()), 0, max(rows - 2, 0)))
        last = int(np.clip(np.floor(row[inside].max()) + 2, 1, rows))
        if (last - first) * columns > LARGEST_BLOCK:
            raise ValueError(f"{last - first} rows of {columns} posts exceed the block limit of {LARGEST_BLOCK} posts")
        values = raster.read(1, window=Window(0, first, columns, last - first), masked=True)
        values = values.astype(np.float64).filled(np.nan) * raster.scales[0] + raster.offsets[0]
    if is_global:
        values = np.concatenate([values, values[:, :1]], axis=1)
    undulations[inside] = bilinear(values[None], row[inside] - first, column[inside])[0]
    return undulations


# ---- Vertical datums and their grids

GRIDS = {"egm96": ("us_nga_egm96_15.tif", "egm96_15.gtx"), "egm2008": ("us_nga_egm08_25.tif", "egm08_25.gtx")}
"""Datum → file names of the grid of undulations in PROJ's grid collection."""

_MARKS = {"egm96": ("egm96",), "egm2008": ("egm08", "egm2008")}


def geoid_file(datum: str, given: Path | None, *, names: Sequence[str] = ()) -> Path:
    """Return the grid of undulations of a datum: the configured file, or a file on PROJ's search path.

    Parameters
    ----------
    datum
        Datum of the heights, for error messages and to check that the file does not belong to another datum.
    given
        Path configured as scene.geoid; None if it is not configured.
    names
        File names to search (default: names for the datum in `GRIDS`).

    Raises
    ------
    CampaignError
        If no file is found: heights are never treated as ellipsoidal heights instead.

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
            f"heights refer to {datum}, but the grid of this geoid is not installed",
            where="scene.geoid",
            expected=expected,
            remedy=f"Obtain {names[0] if names else 'the grid'} from PROJ's grid collection (`projsync`), "
            "copy it to the folder of the DEM, and set scene.geoid to its path.",
        )
    others = [mark for other, marks in _MARKS.items() if other != datum for mark in marks]
    wrong = "no such file" if not given.is_file() else None
    if any(mark in given.name.lower() for mark in others):
        wrong = f"grid of a geoid other than {datum}"
    if any(mark in str(given.absolute()) for mark in '",'):
        wrong = "path with a comma or a quotation mark, which PROJ cannot open"
    if wrong:
        raise CampaignError(wrong, where=given, expected=expected, remedy="Obtain the file, or correct scene.geoid.")
    check_grid(given)
    return given


def grid_folders() -> list[Path]:
    """Return the folders of PROJ in which grids of undulations are searched."""
    listed = [*os.environ.get("PROJ_DATA", "").split(os.pathsep), *get_data_dir().split(os.pathsep)]
    return [Path(folder) for folder in [*listed, get_user_data_dir()] if folder]


def declared_datum(crs: CRS) -> str | None:
    """Return the vertical datum of a CRS: 'ellipsoid', 'egm96', 'egm2008', or another name; None if it has none.

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
    """Return the names of the grid files that PROJ requires for the heights of a compound CRS."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = TransformerGroup(system, "EPSG:4979", always_xy=True, allow_ballpark=False)
    available = [operation for transformer in group.transformers for operation in (transformer.operations or ())]
    operations = available + group.unavailable_operations
    return list(dict.fromkeys(grid.short_name for operation in operations[:1] for grid in operation.grids))
