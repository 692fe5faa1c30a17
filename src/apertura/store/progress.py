"""Work in progress: who may write a stage, its arrays written chunk by chunk, and the rename that finishes it."""

import fcntl
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from apertura.atomic import rename
from apertura.contracts import Window
from apertura.provenance import canonical_json, sha256_tree
from apertura.store.manifest import manifest_of, write_manifest

if TYPE_CHECKING:
    import xarray as xr

_PROVENANCE = ("runspec", "inputs", "code_sha256")


@contextmanager
def writing(folder: Path) -> Iterator[Path]:
    """Hold the right to write `folder` and yield where work in progress goes.

    A kernel lock that dies with its process keeps a second writer out: a step that outlived its snakemake finishes its
    work, and the new one waits for it. A finished folder whose files are as `finish` left them becomes work in progress
    again, so that nothing is computed twice.

    Yields
    ------
    pathlib.Path
        ``<folder>.wip``; kept if the body fails, so that finished chunks are picked up again.
    """
    with _opened(folder) as (wip, lock):
        _take(lock, folder, wip)
        yield wip


@contextmanager
def sharing(
    folder: Path, stage: "xr.Dataset", name: str, windows: Sequence[Window]
) -> Iterator[tuple[Path, list[Window]]]:
    """Join the jobs that write chunks of one stage at once, each its own; who finishes the stage waits for them.

    Parameters
    ----------
    folder, stage, name, windows
        As `writing` and `resume` take them.

    Yields
    ------
    tuple
        ``<folder>.wip``, and the windows that it does not hold yet: none if meanwhile others finished it, or began
        other work there.
    """
    with _opened(folder) as (wip, lock):
        fcntl.flock(lock, fcntl.LOCK_SH)
        if not is_work_on(wip, stage):
            _take(lock, folder, wip)
            resume(wip, stage, name, windows)
            fcntl.flock(lock, fcntl.LOCK_SH)  # not atomic: another writer may come between
        yield wip, missing(wip, name, windows) if is_work_on(wip, stage) else []


@contextmanager
def _opened(folder: Path) -> Iterator[tuple[Path, IO[str]]]:
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _lock_of(folder).open("a+") as lock:
        yield folder.with_name(f"{folder.name}.wip"), lock


def _take(lock: IO[str], folder: Path, wip: Path) -> None:
    """Wait for every other writer; turn a finished folder that is undamaged into work in progress."""
    fcntl.flock(lock, fcntl.LOCK_EX)
    manifest_of(folder).unlink(missing_ok=True)
    if folder.is_dir() and not wip.exists():
        lock.seek(0)
        if lock.read() == canonical_json(sha256_tree(folder)):
            folder.rename(wip)


def _lock_of(folder: Path) -> Path:
    """Return the lock file of a stage, which keeps the hashes of its files: snakemake removes manifests."""
    return folder.with_name(f".{folder.name}.lock")


def resume(wip: Path, stage: "xr.Dataset", name: str, windows: Sequence[Window]) -> list[Window]:
    """Return the windows of array `name` that `wip` does not hold yet; create `wip` if it is absent or other work.

    Parameters
    ----------
    wip
        Work in progress, from `writing`.
    stage
        The stamped stage; of array `name` only shape, dtype and fill value count, so it may be a broadcast zero.
    name
        The array that is written tile by tile.
    windows
        Every tile, square but at the edges; the first one's shape is the chunk's.

    Notes
    -----
    Work in progress is other work when its settings, inputs or code differ.
    """
    if not is_work_on(wip, stage):
        create(wip, stage, {name: _chunk(windows)})
    return missing(wip, name, windows)


def is_work_on(wip: Path, stage: "xr.Dataset") -> bool:
    """Return whether `wip` was begun with the settings, inputs and code of the stamped `stage`."""
    expected = {key: stage.attrs[key] for key in _PROVENANCE}
    try:
        begun = writable_zarr().open_group(wip, mode="r").attrs
        return {key: begun[key] for key in expected} == expected
    except (FileNotFoundError, KeyError, ValueError):
        return False


def missing(wip: Path, name: str, windows: Sequence[Window]) -> list[Window]:
    """Return the windows of array `name` whose chunks `wip` does not hold; a chunk file that exists is complete."""
    chunks, (rows, columns) = wip / name / "c", _chunk(windows)
    return [
        window
        for window in windows
        if not (chunks / str(window[0].start // rows) / str(window[1].start // columns)).is_file()
    ]


def _chunk(windows: Sequence[Window]) -> tuple[int, ...]:
    return tuple(part.stop - part.start for part in windows[0])


def create(wip: Path, stage: "xr.Dataset", chunks: Mapping[str, tuple[int, ...]]) -> None:
    """Create `wip`: metadata and coordinates of a stage, and arrays without values, to be written chunk by chunk.

    Parameters
    ----------
    wip
        Work in progress, from `writing`; what is there is removed.
    stage
        The stamped stage; of the arrays in `chunks` only dims, dtype, fill value and attributes count, so they may be
        broadcast.
    chunks
        Array name → shape of its chunks. One process at a time may write a chunk.
    """
    zarr = writable_zarr()
    shutil.rmtree(wip, ignore_errors=True)
    stage.drop_vars(list(chunks)).to_zarr(wip, mode="w", consolidated=False, zarr_format=3)
    group = zarr.open_group(wip, mode="r+")
    for name, shape in chunks.items():
        array = stage[name]
        group.create_array(
            name,
            shape=array.shape,
            chunks=shape,
            dtype=array.dtype,
            fill_value=array.values.flat[0],  # what a chunk that nobody writes holds
            dimension_names=[str(dim) for dim in array.dims],
            attributes={**array.attrs, "grid_mapping": "spatial_ref"},
        )


def open_array(folder: Path, name: str, mode: str = "r+") -> Any:
    """Return an array of a stage, a `zarr.Array` to be read by blocks, and written while it is work in progress."""
    return writable_zarr().open_array(folder / name, mode=mode)


def writable_zarr() -> Any:
    """Return module zarr, imported when it is needed, set to write chunks of zeros: no chunk means not computed yet."""
    import zarr

    zarr.config.set({"array.write_empty_chunks": True})
    return zarr


def finish(wip: Path, folder: Path, *, lineage: Mapping[str, Any] | None = None, **attributes: Any) -> None:
    """Turn work in progress into the finished stage and write its manifest.

    Parameters
    ----------
    wip, folder
        As `writing` yields and takes them.
    lineage
        What it was made from, as `write_manifest` takes it.
    **attributes
        Attributes of the stage that are known only now, such as what was measured on it.
    """
    if attributes:
        writable_zarr().open_group(wip, mode="r+").attrs.update(attributes)
    for partial in wip.rglob("*.partial"):  # what a killed writer left
        partial.unlink()
    files = sha256_tree(wip)
    _lock_of(folder).write_text(canonical_json(files), encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    rename(wip, folder)
    write_manifest(manifest_of(folder), {f"{folder.name}/{name}": digest for name, digest in files.items()}, lineage)
