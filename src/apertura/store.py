"""Stages on disk: zarr folders that are whole or absent, each beside a manifest of hashes.

A stage is written as ``<stage>.zarr.wip`` under a kernel lock, finished by a rename, and described by
``<stage>.manifest.json``, which is written last: where the manifest stands, the folder is whole.
"""

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr

from apertura.contracts import check
from apertura.errors import CampaignError
from apertura.provenance import sha256_file, sha256_tree

# An all-zero chunk must exist on disk: a missing chunk means "not computed yet".
zarr.config.set({"array.write_empty_chunks": True})


def save_stage(dataset: xr.Dataset, folder: Path, *, chunks: Mapping[str, int] | None = None) -> None:
    """Write a whole stage at once: `folder`.wip, rename, manifest.

    Parameters
    ----------
    dataset
        A stamped stage.
    folder
        ``…/<stage>.zarr``.
    chunks
        Dimension → chunk length; a dimension not named is one chunk.
    """
    with writing(folder) as wip:
        shutil.rmtree(wip, ignore_errors=True)
        encoding = {
            name: {"chunks": tuple((chunks or {}).get(str(dim), size) for dim, size in array.sizes.items())}
            for name, array in dataset.variables.items()
            if array.ndim and array.size
        }
        for name in set(encoding) & {"time"}:
            encoding[name] |= {"units": "nanoseconds since 1970-01-01", "dtype": "int64"}  # type: ignore[dict-item]
        for name, array in dataset.data_vars.items():
            if "spatial_ref" in dataset.variables and {"y", "x"} <= set(array.dims):
                encoding[name]["grid_mapping"] = "spatial_ref"  # type: ignore[assignment]
        dataset.to_zarr(wip, mode="w", consolidated=False, zarr_format=3, encoding=encoding)
        finish(wip, folder)


def open_stage(folder: Path, stage: str) -> xr.Dataset:
    """Open a finished stage lazily after checking its files against the manifest and its arrays against the contract.

    Raises
    ------
    CampaignError
        If the folder is missing, or is not what the manifest describes.
    ContractError
        If its arrays break the contract.
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
    return check(xr.open_zarr(folder, consolidated=False, chunks=None), stage)


def manifest_of(folder: Path) -> Path:
    """Return where the manifest of a stage folder lies.

    Examples
    --------
    >>> manifest_of(Path("results/f01/uav1/raw.zarr")).name
    'raw.manifest.json'
    """
    return folder.with_name(f"{folder.stem}.manifest.json")


@contextmanager
def writing(folder: Path) -> Iterator[Path]:
    """Hold the right to write `folder` and yield where work in progress goes.

    A kernel lock that dies with its process keeps a second writer out: a step that outlived its
    snakemake finishes its work, and the new one waits for it.

    Yields
    ------
    pathlib.Path
        ``<folder>.wip``; kept if the body fails, so that finished chunks are picked up again.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_name(f".{folder.name}.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        manifest_of(folder).unlink(missing_ok=True)
        yield folder.with_name(f"{folder.name}.wip")


def finish(wip: Path, folder: Path) -> None:
    """Turn work in progress into the finished stage and write its manifest."""
    shutil.rmtree(folder, ignore_errors=True)
    wip.rename(folder)
    write_json(manifest_of(folder), {"folder": folder.name, "files": sha256_tree(folder)})


def manifest_sha256(folder: Path) -> str:
    """Return the one hash that stands for every byte of a finished stage."""
    return sha256_file(manifest_of(folder))


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
