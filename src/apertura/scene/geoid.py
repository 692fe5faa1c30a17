"""From heights above a geoid to heights above the ellipsoid, through a grid file that must be there."""

import os
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.datadir import get_data_dir, get_user_data_dir  # type: ignore[attr-defined]
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from apertura.errors import CampaignError, quoted
from apertura.scene.raster import opened_raster

GRIDS = {"egm96": ("us_nga_egm96_15.tif", "egm96_15.gtx"), "egm2008": ("us_nga_egm08_25.tif", "egm08_25.gtx")}
"""Datum → names of its grid of undulations, as PROJ ships them."""

EPSG = {"EPSG:5773": "egm96", "EPSG:3855": "egm2008"}
"""Vertical CRS → datum."""

HIGHEST_M = 150.0
"""No geoid lies farther above or below the ellipsoid: −107 m south of India, +86 m in New Guinea."""

MOST_POSTS = 300_000_000
"""Posts of a grid: one minute all round the Earth."""

_GTX = struct.Struct(">4d2i")
"""Latitude and longitude of the first post, steps of both, degrees; rows, columns."""

_MARKS = {"egm96": ("egm96",), "egm2008": ("egm08", "egm2008")}


def geoid_file(datum: str, given: Path | None, *, names: Sequence[str] = ()) -> Path:
    """Return the grid of undulations of a datum: the one given, else the one on PROJ's search path.

    Parameters
    ----------
    datum
        What heights count from, for the message and to check that the file is not another datum's.
    given
        What scene.geoid says, as a path that opens here.
    names
        File names to look for; `GRIDS` of the datum by default.

    Raises
    ------
    CampaignError
        If there is no such file: a height is never taken for ellipsoidal for want of a grid.

    Examples
    --------
    >>> geoid_file("egm96", Path("nowhere.gtx"))
    Traceback (most recent call last):
    ...
    apertura.errors.CampaignError: nowhere.gtx: no such file; expected the undulations of egm96, such as ...
    """
    names = tuple(names) or GRIDS.get(datum, ())
    wanted = f"the undulations of {datum}" + (f", such as {' or '.join(names)}" if names else "")
    if given is None:
        paths = [folder / name for folder in grid_folders() for name in names if (folder / name).is_file()]
        if paths:
            return paths[0]
        raise CampaignError(
            f"heights count from {datum}, but its geoid grid is not here",
            where="scene.geoid",
            expected=wanted,
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
        raise CampaignError(wrong, where=given, expected=wanted, remedy="Get that file, or correct scene.geoid.")
    _check_header(given, wanted)
    return given


def _check_header(path: Path, wanted: str) -> None:
    """Raise CampaignError unless a file is as large as the grid that its header promises: PROJ trusts the header."""
    remedy, wrong = "Get that file again, or correct scene.geoid.", None
    if path.suffix.lower() == ".tif":
        with opened_raster(path, expected=wanted, remedy=remedy) as raster:
            posts = raster.width * raster.height
        wrong = None if posts <= MOST_POSTS else f"{posts} posts"
    elif path.suffix.lower() == ".gtx":
        with path.open("rb") as stream:
            header = stream.read(_GTX.size)
        south, west, *steps, rows, columns = _GTX.unpack(header) if len(header) == _GTX.size else (np.nan,) * 4 + (0, 0)
        size = path.stat().st_size
        if min(rows, columns) < 2 or rows * columns > MOST_POSTS or size != _GTX.size + 4 * rows * columns:
            wrong = f"{size} bytes for {rows} × {columns} posts"
        elif not (abs(south) <= 90 and abs(west) <= 360 and all(1e-4 <= step <= 30 for step in steps)):
            wrong = f"a grid that begins at latitude {south:g}, longitude {west:g} in steps of {steps} degrees"
    else:
        wrong = f"a file of kind {quoted(path.suffix, 20)}"
    if wrong:
        raise CampaignError(wrong, where=path, expected=f"{wanted}: a .gtx or .tif grid of PROJ", remedy=remedy)


def grid_folders() -> list[Path]:
    """Return the folders in which grids of undulations are looked for: PROJ's."""
    listed = [*os.environ.get("PROJ_DATA", "").split(os.pathsep), *get_data_dir().split(os.pathsep)]
    return [Path(folder) for folder in [*listed, get_user_data_dir()] if folder]


def undulation(
    grid: Path, longitude_deg: NDArray[np.float64], latitude_deg: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how high the geoid lies above the ellipsoid.

    Parameters
    ----------
    grid
        A grid that PROJ reads (.gtx, .tif).
    longitude_deg, latitude_deg
        (...,) float64, degrees, in the geodetic CRS of the grid.

    Returns
    -------
    ndarray
        (...,) float64, metres, bilinear in the grid: ellipsoidal height = height above the geoid + undulation.

    Raises
    ------
    CampaignError
        If PROJ cannot read the grid or it does not reach a place.

    Notes
    -----
    Source: PROJ, operation vgridshift. The grid is named in the operation itself, because PROJ skips one that it has to
    look for and does not find.
    """
    steps = f'+step +proj=vgridshift +grids="{grid.absolute()}" +multiplier=1'  # a bare name PROJ would look for
    try:
        shift = Transformer.from_pipeline(f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad {steps}")
    except ProjError as error:
        raise CampaignError(
            "not readable as a vertical grid", where=grid, expected="a .gtx or .tif of PROJ", remedy="Get it again."
        ) from error
    height = np.asarray(shift.transform(longitude_deg, latitude_deg, np.zeros_like(longitude_deg))[2], np.float64)
    lost = ~(np.abs(height) <= HIGHEST_M)
    if lost.any():
        longitude, latitude = (np.ravel(angle)[lost.argmax()] for angle in (longitude_deg, latitude_deg))
        raise CampaignError(
            f"has no undulation of the Earth at longitude {longitude:.4f}, latitude {latitude:.4f}",
            where=grid,
            expected="a grid that reaches over the scene",
            remedy="Get a grid of the region and name it in scene.geoid.",
        )
    return height


def carried_datum(crs: CRS) -> str | None:
    """Return what a CRS says of its heights: 'ellipsoid', 'egm96', 'egm2008', the name of another datum, or None.

    Examples
    --------
    >>> [carried_datum(CRS(code)) for code in ("EPSG:4326", "EPSG:4979", "EPSG:4326+5773", "EPSG:25832+7837")]
    [None, 'ellipsoid', 'egm96', 'DHHN2016 height']
    """
    vertical = next((part for part in crs.sub_crs_list if part.is_vertical), None)
    if vertical is None:
        return "ellipsoid" if len(crs.axis_info) == 3 else None
    authority = vertical.to_authority() or ("", "")
    return EPSG.get(":".join(authority), vertical.name)


def grid_names(system: CRS) -> list[str]:
    """Return the grid file that PROJ would want for the heights of a compound CRS."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = TransformerGroup(system, "EPSG:4979", always_xy=True, allow_ballpark=False)
    operations = [part for one in group.transformers for part in (one.operations or ())] + group.unavailable_operations
    return list(dict.fromkeys(grid.short_name for operation in operations[:1] for grid in operation.grids))
