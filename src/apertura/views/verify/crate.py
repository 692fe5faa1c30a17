"""`apertura verify --crate`: results that were passed on, compared with the crate and the catalog that lie in them."""

from pathlib import Path

from apertura.campaign.store import compare
from apertura.common.errors import CampaignError, shown
from apertura.common.provenance import sha256_file
from apertura.formats.catalog import CATALOG, CRATE
from apertura.formats.catalog.crate import recorded_files
from apertura.formats.catalog.validation import stac_problems

_MOST = 20


def changed_files(root: Path, *, inputs: bool = True) -> dict[str, str]:
    """Return file → 'changed' or 'missing', of those whose bytes are not what the crate says; every byte is read.

    Parameters
    ----------
    root
        The crate's folder, a campaign's results.
    inputs
        Recordings and config, too, which lie in the folder above.

    Raises
    ------
    CampaignError
        If there is no crate, it is damaged, or it names a file outside of these folders.
    """
    files = recorded_files(root, inputs=inputs)

    def present(name: str) -> str:
        path = files[name].path
        try:
            return sha256_file(path) if path.is_file() else ""
        except OSError as error:
            expected, remedy = "a file that can be read", "Let it be read, or copy it again."
            raise CampaignError(f"not readable ({error.strerror})", path, expected, remedy) from error

    differences = compare({name: file.sha256 for name, file in files.items()}, present)
    return {one.name: "missing" if one.state == "missing" else "changed" for one in differences}


def print_checked(folder: Path, *, quiet: bool = False) -> int:
    """Print which files are not what the crate says, and what is wrong with the catalog; return the exit code.

    Parameters
    ----------
    folder
        A campaign, or its results alone: recordings are compared where the campaign lies above them.
    quiet
        Only what is not the same.

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
    if folder.is_file():
        raise CampaignError("a file", folder, "a campaign folder, or its results", "Name the folder.")
    above = (root.parent / "config").is_dir()
    lines = [f"{name}: {state}" for name, state in changed_files(root, inputs=above).items()]
    if (root / "stac" / CATALOG).is_file():
        lines += [f"stac/{problem}" for problem in stac_problems(root / "stac")]
    for line in lines[:_MOST]:
        print(shown(line, 500))
    if len(lines) > _MOST:
        print(f"and {len(lines) - _MOST} more")
    if not lines and not quiet:
        beside = "recordings and config, too" if above else "recordings and config are not here to be compared"
        print(f"every file as the crate says ({beside}), the catalog valid")
    return 1 if lines else 0
