"""Work in progress: who may write a stage, and the rename that finishes it."""

import fcntl
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from apertura.common.atomic import naming, remove, rename
from apertura.common.contracts import Window
from apertura.common.provenance import canonical_json, sha256_tree
from apertura.pipeline.store.manifest import Origin, manifest_of, write_manifest
from apertura.pipeline.store.resuming import is_intact, is_work_on, missing, resume, skeleton_of

if TYPE_CHECKING:
    import xarray as xr


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
        if not (is_work_on(wip, stage) and is_intact(wip, skeleton_of(stage, name, windows))):
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
        linked = any(path.is_symlink() for path in folder.rglob("*"))  # none of ours: not even hashed
        if not linked and lock.read() == canonical_json(sha256_tree(folder)):
            folder.rename(wip)


def _lock_of(folder: Path) -> Path:
    """Return the lock file of a stage, which keeps the hashes of its files: snakemake removes manifests."""
    return folder.with_name(f".{folder.name}.lock")


def finish(wip: Path, folder: Path, *, lineage: Origin | None = None, **attributes: Any) -> None:
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
        from apertura.pipeline.store.chunks import update_attributes

        update_attributes(wip, attributes)
    for partial in wip.rglob("*.partial"):  # what a killed writer left
        partial.unlink()
    files = sha256_tree(wip)
    with naming(_lock_of(folder)), _lock_of(folder).open("w", encoding="utf-8") as lock:
        lock.write(canonical_json(files))
        lock.flush()
        os.fsync(lock.fileno())
    remove(folder)
    rename(wip, folder)
    write_manifest(manifest_of(folder), {f"{folder.name}/{name}": digest for name, digest in files.items()}, lineage)
