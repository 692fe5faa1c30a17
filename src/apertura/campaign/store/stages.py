"""Stages saved at once, and opened after checking."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.store.manifest import ResultOrigin, check_stage
from apertura.campaign.store.progress import create, finish, open_array, writing
from apertura.common.atomic import naming, remove
from apertura.common.contracts import check
from apertura.common.errors import CampaignError, ContractError
from apertura.common.progress import progress

if TYPE_CHECKING:
    import xarray as xr


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
    """Return how many rows a chunk holds, a power of two.

    Examples
    --------
    >>> rows_of_chunk(8 * 1024), rows_of_chunk(1 << 30)
    (1024, 16)
    """
    return max(_FEWEST_ROWS, 1 << (max(1, _CHUNK_BYTES // max(1, row_bytes)).bit_length() - 1))
