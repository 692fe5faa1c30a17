"""Stages on disk: zarr folders that are whole or absent, each beside a manifest of hashes.

A stage is written as ``<stage>.zarr.wip`` under a kernel lock, finished by a rename, and described by
``<stage>.manifest.json``, which is written last: where the manifest stands, the folder is whole.
"""

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import xarray as xr
import zarr

from apertura.contracts import Window, canonical_json, check
from apertura.errors import CampaignError
from apertura.provenance import sha256_tree

# An all-zero chunk must exist on disk: a missing chunk means "not computed yet".
zarr.config.set({"array.write_empty_chunks": True})

_PROVENANCE = ("runspec", "inputs", "code_sha256")


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
    snakemake finishes its work, and the new one waits for it. A finished folder that is still as it was sealed
    becomes work in progress again, so that what the other finished is not computed twice.

    Yields
    ------
    pathlib.Path
        ``<folder>.wip``; kept if the body fails, so that finished chunks are picked up again.
    """
    with _opened(folder) as (wip, lock):
        _take_whole(lock, folder, wip)
        yield wip


@contextmanager
def sharing(
    folder: Path, empty: xr.Dataset, name: str, windows: Sequence[Window]
) -> Iterator[tuple[Path, list[Window]]]:
    """Join the jobs that write tiles of one stage at once; each writes tiles of its own, whoever finishes waits.

    Parameters
    ----------
    folder, empty, name, windows
        As `writing` and `tiles_missing` take them.

    Yields
    ------
    tuple
        ``<folder>.wip``, and the windows that it does not hold yet: none if meanwhile others finished it, or began
        other work there.
    """
    with _opened(folder) as (wip, lock):
        fcntl.flock(lock, fcntl.LOCK_SH)
        if _attributes(wip) != _identity(empty):
            _take_whole(lock, folder, wip)
            tiles_missing(wip, empty, name, windows)
            fcntl.flock(lock, fcntl.LOCK_SH)  # not at once: one who waits for the whole may come between
        yield wip, _missing(wip, name, windows) if _attributes(wip) == _identity(empty) else []


@contextmanager
def _opened(folder: Path) -> Iterator[tuple[Path, IO[str]]]:
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _seal_of(folder).open("a+") as lock:
        yield folder.with_name(f"{folder.name}.wip"), lock


def _take_whole(lock: IO[str], folder: Path, wip: Path) -> None:
    fcntl.flock(lock, fcntl.LOCK_EX)
    manifest_of(folder).unlink(missing_ok=True)
    if folder.is_dir() and not wip.exists():
        lock.seek(0)
        if lock.read() == canonical_json(sha256_tree(folder)):
            folder.rename(wip)


def _seal_of(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.seal")


def tiles_missing(wip: Path, empty: xr.Dataset, name: str, windows: Sequence[Window]) -> list[Window]:
    """Return the windows of array `name` that `wip` does not hold yet, starting `wip` afresh if it is other work.

    Parameters
    ----------
    wip
        Work in progress, from `writing`.
    empty
        The stamped stage; of array `name` only shape and dtype count, so it may be a broadcast zero.
    name
        The array that is written tile by tile.
    windows
        Every tile, square but at the edges; the first one's shape is the chunk's.

    Notes
    -----
    A chunk file is written beside and renamed, so one that exists is whole. Work in progress is other work
    when its settings, inputs or code differ.
    """
    if _attributes(wip) != _identity(empty):
        lay_out(wip, empty, {name: _side(windows)})
    return _missing(wip, name, windows)


def _side(windows: Sequence[Window]) -> tuple[int, ...]:
    return tuple(part.stop - part.start for part in windows[0])


def _missing(wip: Path, name: str, windows: Sequence[Window]) -> list[Window]:
    chunks, (high, wide) = wip / name / "c", _side(windows)
    return [
        (rows, columns)
        for rows, columns in windows
        if not (chunks / str(rows.start // high) / str(columns.start // wide)).is_file()
    ]


def lay_out(wip: Path, empty: xr.Dataset, chunks: Mapping[str, tuple[int, ...]]) -> None:
    """Start `wip` afresh: metadata and coordinates of `empty`, and arrays to be written block by block.

    Parameters
    ----------
    wip
        Work in progress, from `writing`; what is there is thrown away.
    empty
        The stamped stage; of the arrays in `chunks` only dims, dtype and attributes count, so they may be broadcast.
    chunks
        Array name → shape of its chunks.
    """
    shutil.rmtree(wip, ignore_errors=True)
    empty.drop_vars(list(chunks)).to_zarr(wip, mode="w", consolidated=False, zarr_format=3)
    group = zarr.open_group(wip, mode="r+")
    for name, side in chunks.items():
        array = empty[name]
        group.create_array(
            name,
            shape=array.shape,
            chunks=side,
            dtype=array.dtype,
            fill_value=array.values.flat[0],  # what a block that nobody writes holds
            dimension_names=[str(dim) for dim in array.dims],
            attributes={**array.attrs, "grid_mapping": "spatial_ref"},
        )


def _identity(stage: xr.Dataset) -> dict[str, Any]:
    return {key: stage.attrs[key] for key in _PROVENANCE}


def _attributes(wip: Path) -> dict[str, Any] | None:
    try:
        attributes = zarr.open_group(wip, mode="r").attrs
        return {key: attributes[key] for key in _PROVENANCE}
    except (FileNotFoundError, KeyError, ValueError):
        return None


def finish(wip: Path, folder: Path) -> None:
    """Turn work in progress into the finished stage and write its manifest."""
    for partial in wip.rglob("*.partial"):  # what a killed writer left
        partial.unlink()
    shutil.rmtree(folder, ignore_errors=True)
    wip.rename(folder)
    files = sha256_tree(folder)
    _seal_of(folder).write_text(canonical_json(files), encoding="utf-8")
    write_json(manifest_of(folder), {"folder": folder.name, "files": files})


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
