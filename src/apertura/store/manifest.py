"""The manifest beside a stage: the hashes of its files, checked when it is opened."""

import json
from pathlib import Path

from apertura.errors import CampaignError
from apertura.provenance import sha256_tree


def manifest_of(folder: Path) -> Path:
    """Return where the manifest of a stage folder lies.

    Examples
    --------
    >>> manifest_of(Path("results/f01/uav1/raw.zarr")).name
    'raw.manifest.json'
    """
    return folder.with_name(f"{folder.stem}.manifest.json")


def check_files(folder: Path) -> None:
    """Check the files of a finished stage against its manifest.

    Raises
    ------
    CampaignError
        If the folder is missing, or is not what the manifest describes.
    """
    manifest = manifest_of(folder)
    if not manifest.is_file() or not folder.is_dir():
        raise CampaignError(
            "not there, or not finished",
            where=folder,
            expected="a finished stage with its manifest",
            remedy=f"{f'Delete {manifest} and run' if manifest.is_file() else 'Run'} the workflow (`apertura run`).",
        )
    expected = json.loads(manifest.read_text(encoding="utf-8"))["files"]
    present = sha256_tree(folder)
    if expected != present:
        names = sorted(expected.keys() | present.keys())
        differing = [name for name in names if expected.get(name) != present.get(name)]
        raise CampaignError(
            f"{len(differing)} files are not as they were written, first {differing[0]}",
            where=folder,
            expected=f"what {manifest.name} describes",
            remedy=f"Delete {manifest} and run the workflow again.",
        )
