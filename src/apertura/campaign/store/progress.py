"""Stages written, read and resumed: their blocks, the lock on work in progress, the rename that finishes one."""

import errno
import fcntl
import json
import logging
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.store.manifest import ResultOrigin, check_stage, manifest_of, write_manifest
from apertura.common.atomic import confined_target, naming, remove, rename, write_beside
from apertura.common.confined import ConfinedPath
from apertura.common.contracts import Window, check
from apertura.common.errors import CampaignError, ContractError
from apertura.common.progress import progress
from apertura.common.provenance import canonical_json, sha256_tree

if TYPE_CHECKING:
    import xarray as xr

if TYPE_CHECKING:
    import xarray as xr


# ---- Lock of a stage, and the rename that finishes it ---------------------------------------------------------------


@contextmanager
def writing(folder: Path) -> Iterator[ConfinedPath]:
    """Hold the right to write `folder` and yield where work in progress goes.

    A kernel lock that dies with its process keeps a second writer out: a step that outlived its snakemake finishes its
    work, and the new one waits for it. A finished folder whose files are as `finish` left them becomes work in progress
    again, so that nothing is computed twice.

    Yields
    ------
    apertura.common.confined.ConfinedPath
        ``<folder>.wip``; kept if the body fails, so that finished chunks are picked up again.
    """
    folder = confined_target(folder)
    with _opened(folder) as (wip, lock):
        _take(lock, folder, wip)
        yield wip


@contextmanager
def sharing(
    folder: Path, stage: "xr.Dataset", name: str, windows: Sequence[Window]
) -> Iterator[tuple[ConfinedPath, list[Window]]]:
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
    folder = confined_target(folder)
    with _opened(folder) as (wip, lock):
        fcntl.flock(lock, fcntl.LOCK_SH)
        if not (is_work_on(wip, stage) and is_intact(wip, skeleton_of(stage, name, windows))):
            _take(lock, folder, wip)
            resume(wip, stage, name, windows)
            fcntl.flock(lock, fcntl.LOCK_SH)  # not atomic: another writer may come between
        yield wip, missing(wip, name, windows) if is_work_on(wip, stage) else []


@contextmanager
def _opened(folder: ConfinedPath) -> Iterator[tuple[ConfinedPath, IO[str]]]:
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _lock_of(folder).open("a+") as lock:
        yield folder.with_name(f"{folder.name}.wip"), lock


def _take(lock: IO[str], folder: ConfinedPath, wip: ConfinedPath) -> None:
    """Wait for every other writer; turn a finished folder that is undamaged into work in progress."""
    fcntl.flock(lock, fcntl.LOCK_EX)
    manifest_of(folder).unlink(missing_ok=True)
    if folder.is_dir() and not wip.exists():
        lock.seek(0)
        linked = any(path.is_symlink() for path in folder.rglob("*"))  # none of ours: not even hashed
        if not linked and lock.read() == canonical_json(sha256_tree(folder)):
            folder.rename(wip)


def _lock_of(folder: ConfinedPath) -> ConfinedPath:
    """Return the lock file of a stage, which keeps the hashes of its files: snakemake removes manifests."""
    return folder.with_name(f".{folder.name}.lock")


def finish(wip: Path, folder: Path, *, lineage: ResultOrigin | None = None, **attributes: Any) -> None:
    """Turn work in progress into the finished stage and write its manifest.

    Parameters
    ----------
    wip, folder
        As `writing` yields and takes them.
    lineage
        Its sources, settings and code, for `write_manifest`.
    **attributes
        Attributes of the stage that are known only now, such as what was measured on it.
    """
    wip, folder = ConfinedPath.of(wip), ConfinedPath.of(folder)
    if attributes:
        from apertura.campaign.store.chunks import update_attributes

        update_attributes(wip, attributes)
    for partial in wip.rglob("*.partial"):  # of a killed writer
        partial.unlink()
    files = sha256_tree(wip)
    with naming(_lock_of(folder)), _lock_of(folder).open("w", encoding="utf-8") as lock:
        lock.write(canonical_json(files))
        lock.flush()
        os.fsync(lock.fileno())
    remove(folder)
    rename(wip, folder)
    write_manifest(manifest_of(folder), {f"{folder.name}/{name}": digest for name, digest in files.items()}, lineage)


# ---- Resuming work in progress: checks and repair of its chunks -----------------------------------------------------

_LOG = logging.getLogger(__name__)
_REWRITTEN = "rewritten_chunks"
_PROVENANCE = ("runspec", "inputs", "code_sha256")


def resume(wip: Path, stage: "xr.Dataset", name: str, windows: Sequence[Window]) -> list[Window]:
    """Return the windows of array `name` that `wip` does not hold yet; create `wip` if it is absent or other work.

    Nothing in `wip` is trusted: damaged chunks are computed again, with a notice.

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
    wip, files = ConfinedPath.of(wip), skeleton_of(stage, name, windows)
    if is_work_on(wip, stage):
        chunks = {f"{name}/{_key(window, windows)}" for window in windows}
        for key in chunks.intersection(_attributes(wip).get(_REWRITTEN, [])):
            remove(wip / key)
        _repair(wip, files, chunks)
    else:
        _begin(wip, files)
    return missing(wip, name, windows)


def mark_rewritten(wip: Path, name: str, windows: Sequence[Window], rewritten: Sequence[Window]) -> None:
    """Note which windows are about to be written otherwise than at first: `resume` begins them anew.

    Work that goes on after a kill, and a finished stage that becomes work again, thus ends in the same bytes.
    """
    from apertura.campaign.store.chunks import update_attributes

    known = set(_attributes(wip).get(_REWRITTEN, []))
    keys = known | {f"{name}/{_key(window, windows)}" for window in rewritten}
    update_attributes(wip, {_REWRITTEN: sorted(keys)})


def _attributes(wip: Path) -> dict[str, Any]:
    attributes: dict[str, Any] = json.loads((wip / "zarr.json").read_bytes())["attributes"]
    return attributes


def is_work_on(wip: Path, stage: "xr.Dataset") -> bool:
    """Test whether `wip` was begun with the settings, inputs and code of the stamped `stage`."""
    try:
        begun = _attributes(wip)
        return {key: begun[key] for key in _PROVENANCE} == {key: stage.attrs[key] for key in _PROVENANCE}
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (ValueError, TypeError, KeyError, RecursionError, IsADirectoryError) as error:
        _notice(wip / "zarr.json", error, "all of it is begun anew")
        return False


def missing(wip: Path, name: str, windows: Sequence[Window]) -> list[Window]:
    """Return the windows of array `name` whose chunks `wip` does not hold as they were written.

    A damaged chunk is removed, with a notice.
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
    except Exception as error:  # a codec may raise anything
        if isinstance(error, OSError) and error.errno != errno.EIO:
            raise
        _notice(path, error, "it is formed again")
        remove(path)
        return False
    return True


def _notice(path: Path, error: BaseException, what: str) -> None:
    """Log on stderr, if no handler is set up, that part of work in progress is computed again."""
    _LOG.warning("%s is damaged (%s): %s", path, f"{error}".split(";")[0] or type(error).__name__, what)


def skeleton_of(stage: "xr.Dataset", name: str, windows: Sequence[Window]) -> dict[str, bytes]:
    """Return the files of a stage whose array `name` is written by `windows`, before any is."""
    from apertura.campaign.store.chunks import skeleton

    return skeleton(stage, {name: _chunk(windows)})


def _begin(wip: ConfinedPath, files: Mapping[str, bytes]) -> None:
    """Write metadata and coordinates; that of the stage, by which it is known, last. Resuming checks all of it."""
    remove(wip)
    for name, content in files.items():
        if name != "zarr.json":
            (wip / name).parent.mkdir(parents=True, exist_ok=True)
            with naming(wip / name):
                (wip / name).write_bytes(content)
    write_beside(wip / "zarr.json", files["zarr.json"])


def is_intact(wip: ConfinedPath, files: Mapping[str, bytes]) -> bool:
    """Test whether metadata and coordinates of work in progress are as it was begun, but for what was measured."""
    paths = ((wip / name, content) for name, content in files.items() if name != "zarr.json")
    return all(path.is_file(follow_symlinks=False) and path.read_bytes() == content for path, content in paths)


def _repair(wip: ConfinedPath, files: Mapping[str, bytes], chunks: Collection[str]) -> None:
    """Bring metadata and coordinates of work in progress back to how it was begun; remove what does not belong."""
    for path in [path for path in wip.rglob("*") if not path.is_dir(follow_symlinks=False)]:
        if (name := path.relative_to(wip).as_posix()) not in files and name not in chunks:
            path.unlink()
    for name, content in files.items():
        path = wip / name
        if not path.is_file(follow_symlinks=False) or path.read_bytes() != content:
            if name != "zarr.json":  # of a finished stage it also says what was measured
                _notice(path, ValueError("not as it was written"), "it is written again")
            remove(path)
            write_beside(path, content)


def _key(window: Window, windows: Sequence[Window]) -> str:
    """Return the chunk indices of a window in its array."""
    return "/".join(["c", *(str(part.start // size) for part, size in zip(window, _chunk(windows), strict=True))])


def _chunk(windows: Sequence[Window]) -> tuple[int, ...]:
    return tuple(part.stop - part.start for part in windows[0])


def create(
    wip: Path,
    stage: "xr.Dataset",
    chunks: Mapping[str, tuple[int, ...]],
    *,
    packed: bool = True,
    consolidated: bool = False,
) -> None:
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
    packed
        Whether chunks are compressed.
    consolidated
        As `apertura.campaign.store.chunks.skeleton` takes it.
    """
    from apertura.campaign.store.chunks import skeleton

    _begin(ConfinedPath.of(wip), skeleton(stage, chunks, packed=packed, consolidated=consolidated))


def open_array(folder: Path, name: str, mode: str = "r+") -> Any:
    """Return an array of a stage, a `zarr.Array` to be read by blocks, and written while it is work in progress."""
    from apertura.campaign.store.chunks import array_of

    return array_of(folder, name, mode)


def save_stage(
    dataset: "xr.Dataset",
    folder: Path,
    *,
    chunks: Mapping[str, int] | None = None,
    lineage: ResultOrigin | None = None,
) -> None:
    """Write a stage at once: `folder`.wip, rename, manifest.

    Parameters
    ----------
    dataset
        A stamped stage.
    folder
        ``…/<stage>.zarr``.
    chunks
        Dimension → chunk length; a dimension not named is one chunk.
    lineage
        Its sources, settings and code, for `apertura.campaign.store.manifest.write_manifest`.
    """
    from apertura.campaign.store.chunks import StageStore, encoding_of

    with writing(folder) as wip, naming(folder):
        remove(wip)
        encoding = encoding_of(dataset, chunks or {})
        dataset.to_zarr(
            StageStore(wip, finished_later=True), mode="w", consolidated=False, zarr_format=3, encoding=encoding
        )
        finish(wip, folder, lineage=lineage)


def open_stage(folder: Path, stage: str) -> "xr.Dataset":
    """Open a finished stage lazily, after checking its metadata and coordinates against the manifest and the contract.

    Chunks are checked against the manifest as they are read.

    Raises
    ------
    CampaignError
        If the folder is missing, contradicts its manifest, or is whole and no such stage: another version's; on
        reading, if a chunk is damaged.
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
            expected=f"stage {stage} as this version writes it",
            remedy="Run the workflow again: it makes what another version made anew.",
        ) from error


# ---- Arrays written block by block along their first dimension ------------------------------------------------------

_CHUNK_BYTES = 8 << 20
_FEWEST_ROWS = 16


def write_blocks(wip: Path, stage: "xr.Dataset", name: str, blocks: Iterable[NDArray[Any]]) -> None:
    """Write a stage whose array `name` comes in blocks; earlier content of `wip` is discarded.

    Parameters
    ----------
    wip
        Work in progress, from `writing`.
    stage
        The stamped stage; of array `name` only dims, shape, dtype and attributes count, so it may be a broadcast zero.
    name
        The array.
    blocks
        It, some rows at a time, in order. On the disk it lies in chunks of some 8 MB, however blocks are cut, not
        compressed: echoes are mostly noise. A chunk of nothing but zeros is left out.

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
        taken = 0
        while taken < len(block):
            count = min(chunk - filled, len(block) - taken)
            buffer[filled : filled + count] = block[taken : taken + count]
            filled, taken = filled + count, taken + count
            if filled == chunk or written + filled == rows:
                if buffer[:filled].any():
                    array[written : written + filled] = buffer[:filled]
                written, filled = written + filled, 0
    if written + filled != rows:
        raise ValueError(f"{written + filled} rows of {name}: must be {rows}")


def _counted(blocks: Iterable[NDArray[Any]], array: "xr.DataArray") -> Iterator[NDArray[Any]]:
    """Yield blocks, and report how many rows are done."""
    with progress(f"{array.dims[0]}s", len(array)) as done:
        for block in blocks:
            yield block
            done(len(block))


def blocks_of_rows(stage: "xr.Dataset", name: str) -> Iterator[slice]:
    """Yield rows of an array of a stage, as many at a time as one of its chunks holds, or would hold."""
    array, rows = stage[name], len(stage[name])
    would = rows_of_chunk(array.dtype.itemsize * int(np.prod(array.shape[1:], dtype=int)))
    size = int(array.encoding.get("chunks", (would,))[0]) or would
    for first in range(0, rows, size):
        yield slice(first, min(first + size, rows))


def rows_of_chunk(row_bytes: int) -> int:
    """Return the number of rows of a chunk, a power of two.

    Examples
    --------
    >>> rows_of_chunk(8 * 1024), rows_of_chunk(1 << 30)
    (1024, 16)
    """
    return max(_FEWEST_ROWS, 1 << (max(1, _CHUNK_BYTES // max(1, row_bytes)).bit_length() - 1))
