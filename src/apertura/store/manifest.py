"""The manifest beside a stage: the files it is made of, checked when it is opened; and how JSON is written."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

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


def check_whole(folder: Path) -> None:
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
            remedy=f"Delete {manifest} if it exists and run the workflow again.",
        )
    promised = json.loads(manifest.read_text(encoding="utf-8"))["files"]
    found = sha256_tree(folder)
    if promised != found:
        differing = sorted(name for name in promised.keys() | found.keys() if promised.get(name) != found.get(name))
        raise CampaignError(
            f"{len(differing)} files are not as they were written, first {differing[0]}",
            where=folder,
            expected=f"what {manifest.name} describes",
            remedy=f"Delete {manifest} and run the workflow again.",
        )


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON file beside, then rename; the same document gives the same bytes.

    Raises
    ------
    ValueError
        If a number is not finite: JSON has no NaN.
    """
    text = json.dumps(document, indent=1, sort_keys=True, allow_nan=False, default=_plain) + "\n"
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    path.parent.mkdir(parents=True, exist_ok=True)
    beside.write_text(text, encoding="utf-8")
    beside.replace(path)


def _plain(value: object) -> object:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")
