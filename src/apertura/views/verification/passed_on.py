"""`apertura check-crate`: results that were passed on, held against the crate and the catalog that lie in them."""

from pathlib import Path

from apertura.common.errors import shown
from apertura.formats.catalog import CATALOG, CRATE
from apertura.formats.catalog.crate_check import changed_files
from apertura.formats.catalog.validation import stac_problems

_MOST = 20


def print_checked(folder: Path) -> int:
    """Print which files are not what the crate says, and what is wrong with the catalog; return the exit code.

    Parameters
    ----------
    folder
        A campaign, or its results alone: recordings are looked at where the campaign lies above them.

    Returns
    -------
    int
        0: all as it was made; 1: not.

    Raises
    ------
    CampaignError
        If there is no crate, or it is damaged.
    """
    root = folder if (folder / CRATE).is_file() else folder / "results"
    above = (root.parent / "config").is_dir()
    lines = [f"{name}: {how}" for name, how in changed_files(root, inputs=above).items()]
    if (root / "stac" / CATALOG).is_file():
        lines += [f"stac/{problem}" for problem in stac_problems(root / "stac")]
    for line in lines[:_MOST]:
        print(shown(line, 500))
    if len(lines) > _MOST:
        print(f"and {len(lines) - _MOST} more")
    if not lines:
        beside = "recordings and config, too" if above else "recordings and config are not here to be looked at"
        print(f"every file as the crate says ({beside}), the catalog valid")
    return 1 if lines else 0
