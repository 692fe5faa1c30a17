"""The files that a crate tells of, held against its hashes."""

from pathlib import Path
from typing import Any
from urllib.parse import unquote

from apertura.common.documents import DAMAGED, read_json, undamaged
from apertura.common.errors import CampaignError
from apertura.common.paths import inside
from apertura.common.provenance import sha256_file
from apertura.formats.catalog import CRATE
from apertura.formats.catalog.crate import input_id

LARGEST_CRATE = 1_000_000_000
"""Bytes; a file takes about 300, so three million files."""

_EXPECTED = "an RO-Crate as the workflow writes it"


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

    Examples
    --------
    >>> changed_files(Path("nowhere"))
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere/ro-crate-metadata.json: no such file; expected an RO-Crate ...
    """
    crate = inside(root, CRATE, where=root)
    document = read_json(crate, expected=_EXPECTED, remedy="Run the workflow first.", largest=LARGEST_CRATE)
    with undamaged(crate, expected=_EXPECTED, remedy=DAMAGED):
        told = [_place(entity, root, crate) for entity in document["@graph"] if "sha256" in entity]
        found = {name: _differs(path, sha256) for name, path, sha256, outside in told if inputs or not outside}
    return {name: how for name, how in sorted(found.items()) if how}


def _place(entity: dict[str, Any], root: Path, crate: Path) -> tuple[str, Path, str, bool]:
    """Return name, path and hash of a file, and whether it lies above the crate."""
    called, prefix = str(entity["@id"]), input_id("")
    outside = called.startswith(prefix)
    name = unquote(called.removeprefix(prefix))
    return name, inside(root.parent if outside else root, name, where=crate), str(entity["sha256"]), outside


def _differs(path: Path, sha256: str) -> str:
    if not path.is_file():
        return "missing"
    try:
        return "" if sha256_file(path) == sha256 else "changed"
    except OSError as error:
        expected, remedy = "a file that can be read", "Let it be read, or copy it again."
        raise CampaignError(f"not readable ({error.strerror})", path, expected, remedy) from error
