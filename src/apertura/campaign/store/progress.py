"""Writing, reading and resuming of stages: blocks of arrays, lock on work in progress, and renaming when finished."""

import errno
import fcntl
import json
import logging
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.store.manifest import ResultOrigin, check_listed, check_stage, manifest_of, write_manifest
from apertura.common.atomic import confined_target, naming, remove, write_beside
from apertura.common.confined import ConfinedPath
from apertura.common.contracts import Window, check
from apertura.common.errors import CampaignError, ContractError
from apertura.common.progress import progress
from apertura.common.provenance import canonical_json, sha256_tree

if TYPE_CHECKING:
    import xarray as xr

    from apertura.campaign.store.chunks import Groups


# ---- Lock of a stage, and renaming of the finished stage ------------------------------------------------------------


@contextmanager
def writing(folder: Path) -> Iterator[ConfinedPath]:
    """Lock `folder` for writing and yield the folder of work in progress.

    A kernel lock, which is released when its process exits, excludes a second writer: a new step waits for a step that
    is still running after its Snakemake process was killed. A finished folder with unchanged files becomes work in
    progress again, so that its chunks are not recomputed.

    Yields
    ------
    apertura.common.confined.ConfinedPath
        ``<folder>.wip``; the folder is kept if an error is raised in the context, so that finished chunks are reused.
    """
    folder = confined_target(folder)
    with _opened(folder) as (wip, lock):
        _acquire(lock, folder, wip)
        yield wip


@contextmanager
def sharing(
    folder: Path, stage: "xr.Dataset", name: str, windows: Sequence[Window]
) -> Iterator[tuple[ConfinedPath, list[Window]]]:
    """Lock a stage for several jobs that write different chunks at the same time.

    The step that finishes the stage waits for these jobs.

    Parameters
    ----------
    folder, stage, name, windows
        See `writing` and `resume`.

    Yields
    ------
    tuple
        ``<folder>.wip``, and the windows that are missing in this folder; empty if another job has meanwhile finished
        the stage, or started the stage with other settings.
    """
    folder = confined_target(folder)
    with _opened(folder) as (wip, lock):
        fcntl.flock(lock, fcntl.LOCK_SH)
        if not (is_work_on(wip, stage) and is_intact(wip, skeleton_of(stage, name, windows))):
            _acquire(lock, folder, wip)
            resume(wip, stage, name, windows)
            fcntl.flock(lock, fcntl.LOCK_SH)  # not atomic: another writer may have obtained the lock in between
        yield wip, missing(wip, name, windows) if is_work_on(wip, stage) else []


@contextmanager
def replacing(folder: Path) -> Iterator[tuple[ConfinedPath, dict[str, str]]]:
    """Lock a stage for writing beside its finished folder, which remains valid until `finish`.

    Yields
    ------
    tuple
        ``<folder>.wip``, which is absent, and file → SHA-256 of the finished folder. The hashes are those recorded by
        `finish`; chunks are not read. They are empty if there is no finished folder, or if its file names or metadata
        differ from the record.
    """
    folder = confined_target(folder)
    with _opened(folder) as (wip, lock):
        fcntl.flock(lock, fcntl.LOCK_EX)
        wip.remove()
        if not folder.exists(follow_symlinks=False) and _earlier(folder).exists(follow_symlinks=False):
            _earlier(folder).rename(folder)  # the writer was killed between two renamings
        lock.seek(0)
        yield wip, _recorded(folder, lock.read())


def _recorded(folder: ConfinedPath, record: str) -> dict[str, str]:
    try:
        hashes: dict[str, str] = json.loads(record)
        if hashes != sha256_tree(folder, {name: digest for name, digest in hashes.items() if "/c/" in name}):
            return {}
    except (ValueError, AttributeError, RecursionError, CampaignError):
        return {}
    return hashes


@contextmanager
def _opened(folder: ConfinedPath) -> Iterator[tuple[ConfinedPath, IO[str]]]:
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _lock_of(folder).open("a+") as lock:
        yield folder.with_name(f"{folder.name}.wip"), lock


def _acquire(lock: IO[str], folder: ConfinedPath, wip: ConfinedPath) -> None:
    """Wait for all other writers; turn a finished, undamaged folder into work in progress."""
    fcntl.flock(lock, fcntl.LOCK_EX)
    manifest_of(folder).unlink(missing_ok=True)
    if folder.is_dir() and not wip.exists():
        lock.seek(0)
        linked = any(path.is_symlink() for path in folder.rglob("*"))  # stages contain no links; do not follow them
        if not linked and lock.read() == canonical_json(sha256_tree(folder)):
            folder.rename(wip)


def _earlier(folder: ConfinedPath) -> ConfinedPath:
    return folder.with_name(f".{folder.name}.earlier")


def _lock_of(folder: ConfinedPath) -> ConfinedPath:
    """Return the lock file of a stage, which also contains file hashes, because Snakemake removes manifests."""
    return folder.with_name(f".{folder.name}.lock")


def finish(
    wip: Path,
    folder: Path,
    *,
    lineage: ResultOrigin | None = None,
    known: Mapping[str, str] = MappingProxyType({}),
    appended: bool = False,
    **attributes: Any,
) -> None:
    """Turn work in progress into the finished stage and write its manifest.

    Parameters
    ----------
    wip, folder
        Work in progress, from `writing` or `replacing`, and the folder of the stage.
    lineage
        Lineage of the stage, for `write_manifest`.
    known
        File → SHA-256 of files that are not read again, such as linked chunks of an earlier version of the stage.
    appended
        True if `wip` contains the new and changed files of `folder` only, and `known` the others. The files are moved
        into the folder: chunks, which the earlier metadata do not refer to or may refer to without harm, then the
        metadata of arrays, then the consolidated metadata. Readers of these see the stage before or after.
    **attributes
        Attributes of the stage that are known only at the end, such as measurements on the finished arrays.
    """
    wip, folder = ConfinedPath.of(wip), ConfinedPath.of(folder)
    if attributes:
        from apertura.campaign.store.chunks import update_attributes

        update_attributes(wip, attributes)
    for partial in wip.rglob("*.partial"):  # left by a killed writer
        partial.unlink()
    files = sha256_tree(wip, known)
    if appended:
        files = dict(sorted({**known, **files}.items()))
    wip.synchronise()
    manifest_of(folder).unlink(missing_ok=True)
    with naming(_lock_of(folder)), _lock_of(folder).open("w", encoding="utf-8") as lock:
        lock.write(canonical_json(files))
        lock.flush()
        os.fsync(lock.fileno())
    if appended:
        _merge(wip, folder)
    else:
        _replace(folder, wip)
    write_manifest(manifest_of(folder), {f"{folder.name}/{name}": digest for name, digest in files.items()}, lineage)


def _merge(wip: ConfinedPath, folder: ConfinedPath) -> None:
    """Move the files of `wip` into `folder`, metadata last."""
    names = [path.relative_to(wip).as_posix() for path in wip.rglob("*") if path.is_file()]
    for name in sorted(names, key=lambda name: (name == "zarr.json", name.endswith("zarr.json"), name)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (wip / name).rename(folder / name)
    for parent in sorted({parent for name in names for parent in (folder / name).parents if parent != folder.parent}):
        if parent.is_relative_to(folder):
            parent.synchronise_folder()
    wip.remove()


def _replace(folder: ConfinedPath, wip: ConfinedPath) -> None:
    earlier = _earlier(folder)
    earlier.remove()
    if folder.exists(follow_symlinks=False):
        folder.rename(earlier)  # faster than the removal of a large folder
    wip.rename(folder).parent.synchronise_folder()
    earlier.remove()


# ---- Resumption of work in progress: checks and repair of its chunks -------------------------------------------------

_LOG = logging.getLogger(__name__)
_REWRITTEN = "rewritten_chunks"
_PROVENANCE = ("runspec", "inputs", "code_sha256")


def resume(wip: Path, stage: "xr.Dataset", name: str, windows: Sequence[Window]) -> list[Window]:
    """Return the windows of array `name` that are missing in `wip`; create `wip` if absent or of another provenance.

    All files of `wip` are verified; damaged chunks are recomputed, with a warning.

    Parameters
    ----------
    wip
        Work in progress, from `writing`.
    stage
        Stage with provenance. Only shape, dtype and fill value of array `name` are used, so that the array may be a
        broadcast zero.
    name
        Array that is written tile by tile.
    windows
        All tiles, square except at the edges; the shape of the first tile is the chunk shape.

    Notes
    -----
    Work in progress with other settings, inputs or code is discarded.
    """
    wip, files = ConfinedPath.of(wip), skeleton_of(stage, name, windows)
    if is_work_on(wip, stage):
        chunks = {f"{name}/{_key(window, windows)}" for window in windows}
        for key in chunks.intersection(attributes_of(wip).get(_REWRITTEN, [])):
            remove(wip / key)
        _repair(wip, files, chunks)
    else:
        _begin(wip, files)
    return missing(wip, name, windows)


def mark_rewritten(wip: Path, name: str, windows: Sequence[Window], rewritten: Sequence[Window]) -> None:
    """Record windows that are rewritten with settings other than the initial ones; `resume` recomputes these windows.

    A run that resumes after a kill, or from a finished stage, therefore produces the same bytes.
    """
    from apertura.campaign.store.chunks import update_attributes

    earlier = set(attributes_of(wip).get(_REWRITTEN, []))
    keys = earlier | {f"{name}/{_key(window, windows)}" for window in rewritten}
    update_attributes(wip, {_REWRITTEN: sorted(keys)})


def attributes_of(folder: Path) -> dict[str, Any]:
    """Return the attributes of a stage, finished or not."""
    attributes: dict[str, Any] = json.loads((folder / "zarr.json").read_bytes())["attributes"]
    return attributes


def is_work_on(wip: Path, stage: "xr.Dataset") -> bool:
    """Return True if `wip` has the settings, inputs and code of `stage`."""
    try:
        attributes = attributes_of(wip)
        return {key: attributes[key] for key in _PROVENANCE} == {key: stage.attrs[key] for key in _PROVENANCE}
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (ValueError, TypeError, KeyError, RecursionError, IsADirectoryError) as error:
        _warn_damaged(wip / "zarr.json", error, "recomputing from the start")
        return False


def missing(wip: Path, name: str, windows: Sequence[Window]) -> list[Window]:
    """Return the windows of array `name` whose chunks are missing or damaged in `wip`.

    Damaged chunks are removed, with a warning.
    """
    wip = ConfinedPath.of(wip)
    array = open_array(wip, name, "r")
    return [window for window in windows if not _is_whole(wip / name / _key(window, windows), array, window)]


def _is_whole(path: ConfinedPath, array: Any, window: Window) -> bool:
    if not path.is_file(follow_symlinks=False):
        path.remove()
        return False
    try:
        array[window]
    except MemoryError:
        raise
    except Exception as error:  # a codec may raise any exception
        if isinstance(error, OSError) and error.errno != errno.EIO:
            raise
        _warn_damaged(path, error, "recomputing it")
        remove(path)
        return False
    return True


def _warn_damaged(path: Path, error: BaseException, consequence: str) -> None:
    """Log a warning on a damaged file of work in progress; printed to stderr if no log handler is configured."""
    _LOG.warning("%s is damaged (%s): %s", path, f"{error}".split(";")[0] or type(error).__name__, consequence)


def skeleton_of(stage: "xr.Dataset", name: str, windows: Sequence[Window]) -> dict[str, bytes]:
    """Return metadata and coordinates of a stage whose array `name` is written window by window: path → bytes."""
    from apertura.campaign.store.chunks import skeleton

    return skeleton(stage, {name: _chunk(windows)})


def _begin(wip: ConfinedPath, files: Mapping[str, bytes]) -> None:
    """Write metadata and coordinates of a stage; zarr.json, which identifies the stage, is written last."""
    remove(wip)
    for name, content in files.items():
        if name != "zarr.json":
            (wip / name).parent.mkdir(parents=True, exist_ok=True)
            with naming(wip / name):
                (wip / name).write_bytes(content)
    write_beside(wip / "zarr.json", files["zarr.json"])


def is_intact(wip: ConfinedPath, files: Mapping[str, bytes]) -> bool:
    """Return True if metadata and coordinates of work in progress are unchanged; attributes of the stage may differ."""
    paths = ((wip / name, content) for name, content in files.items() if name != "zarr.json")
    return all(path.is_file(follow_symlinks=False) and path.read_bytes() == content for path, content in paths)


def _repair(wip: ConfinedPath, files: Mapping[str, bytes], chunks: Collection[str]) -> None:
    """Restore metadata and coordinates of work in progress; remove files that do not belong to the stage."""
    for path in [path for path in wip.rglob("*") if not path.is_dir(follow_symlinks=False)]:
        if (name := path.relative_to(wip).as_posix()) not in files and name not in chunks:
            path.unlink()
    for name, content in files.items():
        path = wip / name
        if not path.is_file(follow_symlinks=False) or path.read_bytes() != content:
            if name != "zarr.json":  # zarr.json of a finished stage also contains measured attributes
                _warn_damaged(path, ValueError("changed since it was written"), "restoring it")
            remove(path)
            write_beside(path, content)


def _key(window: Window, windows: Sequence[Window]) -> str:
    """Return the chunk key of a window."""
    return "/".join(["c", *(str(part.start // size) for part, size in zip(window, _chunk(windows), strict=True))])


def _chunk(windows: Sequence[Window]) -> tuple[int, ...]:
    return tuple(part.stop - part.start for part in windows[0])


def create(
    wip: Path,
    stage: "xr.Dataset",
    chunks: Mapping[str, tuple[int, ...]],
    *,
    packed: bool = True,
    lengths: Mapping[str, int] = MappingProxyType({}),
    groups: "Groups" = MappingProxyType({}),
    consolidated: bool = False,
) -> None:
    """Create `wip`: metadata and coordinates of a stage, and empty arrays that are written chunk by chunk.

    Parameters
    ----------
    wip
        Work in progress, from `writing`; existing files are removed.
    stage
        Stage with provenance. Only dims, dtype, fill value and attributes of the arrays in `chunks` are used, so that
        these arrays may be broadcast.
    chunks
        Array name → shape of the array's chunks. Only one process at a time may write a chunk.
    packed
        True if chunks are compressed.
    lengths, groups, consolidated
        See `apertura.campaign.store.chunks.skeleton`.
    """
    from apertura.campaign.store.chunks import skeleton

    files = skeleton(stage, chunks, packed=packed, lengths=lengths, groups=groups, consolidated=consolidated)
    _begin(ConfinedPath.of(wip), files)


def open_array(folder: Path, name: str, mode: str = "r+") -> Any:
    """Open an array of a stage as a `zarr.Array`, which may be written if the stage is work in progress."""
    from apertura.campaign.store.chunks import array_of

    return array_of(folder, name, mode)


def save_stage(
    dataset: "xr.Dataset",
    folder: Path,
    *,
    chunks: Mapping[str, int] | None = None,
    lineage: ResultOrigin | None = None,
) -> None:
    """Write a stage as a whole: write `folder`.wip, rename the folder, write the manifest.

    Parameters
    ----------
    dataset
        Stage with provenance.
    folder
        ``…/<stage>.zarr``.
    chunks
        Dimension → chunk length; other dimensions have one chunk.
    lineage
        Lineage of the stage, for `apertura.campaign.store.manifest.write_manifest`.
    """
    from apertura.campaign.store.chunks import StageStore, encoding_of

    with writing(folder) as wip, naming(folder):
        remove(wip)
        encoding = encoding_of(dataset, chunks or {})
        dataset.to_zarr(
            StageStore(wip, finished_later=True), mode="w", consolidated=False, zarr_format=3, encoding=encoding
        )
        finish(wip, folder, lineage=lineage)


def describe_stage(folder: Path) -> "xr.Dataset":
    """Return a finished stage without its arrays; its attributes are checked against the manifest.

    This takes a tenth of the time of `open_stage`.
    """
    import xarray as xr

    check_listed(ConfinedPath.of(folder) / "zarr.json", manifest_of(folder))
    return xr.Dataset(attrs=attributes_of(folder))


def open_stage(folder: Path, stage: str) -> "xr.Dataset":
    """Open a finished stage lazily; check metadata and coordinates against the manifest and the contract.

    Chunks are checked against the manifest when they are read.

    Raises
    ------
    CampaignError
        If the folder is missing, differs from its manifest, or violates the contract because another version wrote it;
        on reading, if a chunk is damaged.
    """
    import xarray as xr

    from apertura.campaign.store.chunks import StageStore

    store = StageStore(folder, read_only=True, sha256=check_stage(folder))
    try:
        return check(xr.open_zarr(store, consolidated=False, chunks=None), stage)
    except ContractError as error:
        raise CampaignError(
            f"written by another version of apertura: {error}",
            where=folder,
            expected=f"stage {stage} of this version",
            remedy="Run the workflow again, which recomputes results of other versions.",
        ) from error


# ---- Arrays written block by block along their first dimension ------------------------------------------------------

_CHUNK_BYTES = 8 << 20
_FEWEST_ROWS = 16


def write_blocks(wip: Path, stage: "xr.Dataset", name: str, blocks: Iterable[NDArray[Any]]) -> None:
    """Write a stage whose array `name` is supplied in blocks; earlier content of `wip` is discarded.

    Parameters
    ----------
    wip
        Work in progress, from `writing`.
    stage
        Stage with provenance. Only dims, shape, dtype and attributes of array `name` are used, so that the array may be
        a broadcast zero.
    name
        Name of the array.
    blocks
        Consecutive blocks of rows of the array. Chunks on disk have a size of about 8 MB, independent of the blocks.
        Chunks are not compressed, because echoes are mostly noise. Chunks of zeros are not written.

    Raises
    ------
    ValueError
        If the blocks have more or fewer rows than the array.
    """
    rows, *rest = stage[name].shape
    chunk = rows_of_chunk(stage[name].dtype.itemsize * int(np.prod(rest, dtype=int)))
    create(wip, stage, {name: (max(1, min(chunk, rows)), *rest)}, packed=False)
    array, buffer, written = open_array(wip, name), np.empty((chunk, *rest), stage[name].dtype), 0
    filled = 0
    for block in _counted(blocks, stage[name]):
        copied = 0
        while copied < len(block):
            count = min(chunk - filled, len(block) - copied)
            buffer[filled : filled + count] = block[copied : copied + count]
            filled, copied = filled + count, copied + count
            if filled == chunk or written + filled == rows:
                if buffer[:filled].any():
                    array[written : written + filled] = buffer[:filled]
                written, filled = written + filled, 0
    if written + filled != rows:
        raise ValueError(f"{written + filled} rows of {name} were supplied; the array has {rows} rows")


def _counted(blocks: Iterable[NDArray[Any]], array: "xr.DataArray") -> Iterator[NDArray[Any]]:
    """Yield blocks, and report the number of rows written."""
    with progress(f"{array.dims[0]}s", len(array)) as done:
        for block in blocks:
            yield block
            done(len(block))


def blocks_of_rows(stage: "xr.Dataset", name: str) -> Iterator[slice]:
    """Yield slices of the rows of an array of a stage; the length of a slice is the chunk length on disk."""
    array, rows = stage[name], len(stage[name])
    default = rows_of_chunk(array.dtype.itemsize * int(np.prod(array.shape[1:], dtype=int)))
    size = int(array.encoding.get("chunks", (default,))[0]) or default
    for first in range(0, rows, size):
        yield slice(first, min(first + size, rows))


def rows_of_chunk(row_bytes: int) -> int:
    """Return the number of rows in a chunk, which is a power of two.

    Examples
    --------
    >>> rows_of_chunk(8 * 1024), rows_of_chunk(1 << 30)
    (1024, 16)
    """
    return max(_FEWEST_ROWS, 1 << (max(1, _CHUNK_BYTES // max(1, row_bytes)).bit_length() - 1))
