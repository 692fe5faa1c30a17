"""From heights above a geoid to heights above the ellipsoid, through a grid file that must be there."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path

from pyproj import CRS
from pyproj.datadir import get_data_dir, get_user_data_dir  # type: ignore[attr-defined]
from pyproj.transformer import TransformerGroup

from apertura.common.constants import VERTICAL_DATUMS
from apertura.common.errors import CampaignError
from apertura.core.scene.geoid_grid import check_grid

GRIDS = {"egm96": ("us_nga_egm96_15.tif", "egm96_15.gtx"), "egm2008": ("us_nga_egm08_25.tif", "egm08_25.gtx")}
"""Datum → names of its grid of undulations, as PROJ ships them."""

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
    apertura.common.errors.CampaignError: nowhere.gtx: no such file; expected the undulations of egm96, such as ...
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
    check_grid(given)
    return given


def grid_folders() -> list[Path]:
    """Return the folders in which grids of undulations are looked for: PROJ's."""
    listed = [*os.environ.get("PROJ_DATA", "").split(os.pathsep), *get_data_dir().split(os.pathsep)]
    return [Path(folder) for folder in [*listed, get_user_data_dir()] if folder]


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
    return VERTICAL_DATUMS.get(":".join(authority), vertical.name)


def grid_names(system: CRS) -> list[str]:
    """Return the grid file that PROJ would want for the heights of a compound CRS."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = TransformerGroup(system, "EPSG:4979", always_xy=True, allow_ballpark=False)
    operations = [part for one in group.transformers for part in (one.operations or ())] + group.unavailable_operations
    return list(dict.fromkeys(grid.short_name for operation in operations[:1] for grid in operation.grids))
