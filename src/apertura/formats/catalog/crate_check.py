"""The files that a crate names, with the hashes that it states of them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from apertura.common.documents import DAMAGED, read_json, undamaged
from apertura.common.paths import inside
from apertura.formats.catalog import CRATE
from apertura.formats.catalog.crate import input_id

LARGEST_CRATE = 1_000_000_000
"""Bytes; a file takes about 300, so three million files."""

_EXPECTED = "an RO-Crate as the workflow writes it"


@dataclass(frozen=True)
class CrateFile:
    """A file that a crate names.

    Attributes
    ----------
    path
        Where it lies, or would.
    sha256
        Its hash as the crate states it, hex.
    """

    path: Path
    sha256: str


def recorded_files(root: Path, *, inputs: bool = True) -> dict[str, CrateFile]:
    """Return the files that a crate states hashes of, by their names in it; none is opened.

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

    Examples
    --------
    >>> recorded_files(Path("nowhere"))
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere/ro-crate-metadata.json: no such file; expected an RO-Crate ...
    """
    crate = inside(root, CRATE, where=root)
    document = read_json(crate, expected=_EXPECTED, remedy="Run the workflow first.", largest=LARGEST_CRATE)
    with undamaged(crate, expected=_EXPECTED, remedy=DAMAGED):
        files = [_file(entity, root, crate) for entity in document["@graph"] if "sha256" in entity]
    return {name: file for name, file, outside in files if inputs or not outside}


def _file(entity: dict[str, Any], root: Path, crate: Path) -> tuple[str, CrateFile, bool]:
    """Return name and place of a file, and whether it lies above the crate."""
    identifier, prefix = str(entity["@id"]), input_id("")
    outside = identifier.startswith(prefix)
    name = unquote(identifier.removeprefix(prefix))
    path = inside(root.parent if outside else root, name, where=crate)
    return name, CrateFile(path, str(entity["sha256"])), outside
