"""Who may write a stage: kernel locks that die with their process, and the rename that finishes the work."""

import fcntl
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import xarray as xr

from apertura.contracts import Window, canonical_json
from apertura.provenance import sha256_tree
from apertura.store.manifest import manifest_of, write_json
from apertura.store.progress import is_work_on, not_written, tiles_missing


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
        if not is_work_on(wip, empty):
            _take_whole(lock, folder, wip)
            tiles_missing(wip, empty, name, windows)
            fcntl.flock(lock, fcntl.LOCK_SH)  # not at once: one who waits for the whole may come between
        yield wip, not_written(wip, name, windows) if is_work_on(wip, empty) else []


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


def finish(wip: Path, folder: Path) -> None:
    """Turn work in progress into the finished stage and write its manifest."""
    for partial in wip.rglob("*.partial"):  # what a killed writer left
        partial.unlink()
    shutil.rmtree(folder, ignore_errors=True)
    wip.rename(folder)
    files = sha256_tree(folder)
    _seal_of(folder).write_text(canonical_json(files), encoding="utf-8")
    write_json(manifest_of(folder), {"folder": folder.name, "files": files})
