"""Chunks on disk: brought to the disk before they are renamed, checked by their sum when they are read."""

import asyncio
import hashlib
import json
import warnings
from collections.abc import Hashable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import google_crc32c
import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.store import ByteRequest
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.errors import ZarrUserWarning
from zarr.storage import LocalStore, MemoryStore

from apertura.campaign.store.manifest import ResultOrigin, check_stage, remake
from apertura.campaign.store.progress import create, finish, open_array, writing
from apertura.common.atomic import naming, remove, write_beside
from apertura.common.confined import ConfinedPath
from apertura.common.contracts import check
from apertura.common.documents import other_codec
from apertura.common.errors import CampaignError, ContractError
from apertura.common.progress import progress

if TYPE_CHECKING:
    import xarray as xr

if TYPE_CHECKING:
    import xarray as xr


# What a user has set for zarr (ZARR_…, ~/.config/zarr) changes no byte of ours: one order of arrays and of sums.
zarr.config.update(zarr.config.defaults[0], priority="new")
zarr.config.set({"array.write_empty_chunks": True})  # no chunk means not computed yet: zeros are written too

CODECS = (ZstdCodec(), Crc32cCodec())
"""Codecs of a chunk; the checksum comes last, so that it covers the bytes on the disk."""

_SUM_BYTES = 4
_METADATA = "zarr.json"


class StageStore(LocalStore):
    """A folder of a stage, as zarr reads and writes it.

    A file is complete or absent, also after a power failure; a chunk that is not what was written is never handed out:
    by its own sum, and of a finished stage by its hash in the manifest, where that is given, when it is first read.

    Parameters
    ----------
    folder, read_only
        As `zarr.storage.LocalStore` takes them.
    sha256
        File of the folder → hash.
    finished_later
        Leave it to `finish` to bring all files to the disk at once: what is there after a kill is begun anew.
    """

    root: ConfinedPath

    def __init__(
        self,
        folder: Path,
        *,
        read_only: bool = False,
        sha256: Mapping[str, str] | None = None,
        finished_later: bool = False,
    ) -> None:
        super().__init__(ConfinedPath.of(folder), read_only=read_only)
        self._finished_later = finished_later
        self._unchecked = {key: digest for key, digest in (sha256 or {}).items() if _METADATA not in key}

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return a file of the folder; `CampaignError` if it is a chunk and not what was written."""
        return self._checked(key, await super().get(key, prototype, byte_range), byte_range)

    def get_sync(
        self, key: str, *, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """As `get`."""
        return self._checked(key, super().get_sync(key, prototype=prototype, byte_range=byte_range), byte_range)

    async def set(self, key: str, value: Buffer) -> None:
        """Write a file of the folder."""
        await asyncio.to_thread(self.set_sync, key, value)

    def set_sync(self, key: str, value: Buffer) -> None:
        """As `set`."""
        self._check_writable()
        path = self.root / key
        if self._finished_later:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(value.to_bytes())
        else:
            write_beside(path, value.to_bytes())

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write a file that is not there; a file of a stage has one writer."""
        if not await self.exists(key):
            await self.set(key, value)

    async def delete(self, key: str) -> None:
        """Remove a file, or a folder with its contents."""
        self._check_writable()
        await asyncio.to_thread((self.root / key).remove)

    async def delete_dir(self, prefix: str) -> None:
        """As `delete`."""
        await self.delete(prefix)

    def _checked(self, key: str, value: Buffer | None, byte_range: ByteRequest | None) -> Buffer | None:
        name = key.rpartition("/")[2]
        if name.startswith(".z"):  # of version 2, which is not ours, and whose filters may be a pickle
            return None
        if name == _METADATA and value is not None and other_codec(_json(value)) is not None:
            raise damaged(self.root, key)
        if value is None and key in self._unchecked:  # zarr would take a chunk that is gone for one that is empty
            raise damaged(self.root, key)
        if value is None or byte_range is not None or name == _METADATA:
            return value
        content = value.as_numpy_array()
        whole = google_crc32c.value(content[:-_SUM_BYTES]) == int.from_bytes(content[-_SUM_BYTES:].tobytes(), "little")
        expected = self._unchecked.get(key)
        if not whole or (expected is not None and expected != hashlib.sha256(content.data).hexdigest()):
            raise damaged(self.root, key)
        self._unchecked.pop(key, None)
        return value


def _json(value: Buffer) -> object:
    try:
        return json.loads(value.to_bytes())
    except (ValueError, RecursionError):
        return None  # zarr raises its own error


def array_of(folder: Path, name: str, mode: str) -> Any:
    """Return an array of a stage, a `zarr.Array`."""
    return zarr.open_array(StageStore(folder, read_only=mode == "r"), path=name, mode=mode)


def update_attributes(folder: Path, attributes: Mapping[str, Any]) -> None:
    """Write attributes of a stage in work."""
    zarr.open_group(StageStore(folder), mode="r+").attrs.update(attributes)


def damaged(folder: Path, key: str) -> CampaignError:
    """Return the error that a chunk of a stage, finished or in work, is not what was written."""
    finished = folder.suffix == ".zarr"
    return CampaignError(
        "damaged since it was written",
        where=folder / key,
        expected="bytes that agree with their sum",
        remedy=remake(folder) if finished else "Run the workflow again.",
    )


def encoding_of(dataset: "xr.Dataset", chunks: Mapping[str, int]) -> dict[Hashable, dict[str, Any]]:
    """Return the encoding of each variable of a stage.

    Parameters
    ----------
    dataset
        The stage.
    chunks
        Dimension → chunk length; a dimension not named is one chunk.
    """
    encoding: dict[Hashable, dict[str, Any]] = {}
    for name, array in dataset.variables.items():
        encoding[name] = {"compressors": CODECS}
        if array.ndim and array.size:
            encoding[name]["chunks"] = tuple(chunks.get(str(dim), size) for dim, size in array.sizes.items())
    if "time" in encoding:
        encoding["time"] |= {"units": "nanoseconds since 1970-01-01", "dtype": "int64"}
    if "spatial_ref" in dataset.variables:
        for name, values in dataset.data_vars.items():
            if {"y", "x"} <= set(values.dims):
                encoding[name]["grid_mapping"] = "spatial_ref"
    return encoding


def skeleton(
    stage: "xr.Dataset", chunks: Mapping[str, tuple[int, ...]], *, packed: bool = True, consolidated: bool = False
) -> dict[str, bytes]:
    """Return the files of a stage before anything is computed: its metadata and coordinates, path → bytes.

    Parameters
    ----------
    stage
        The stamped stage; of the arrays in `chunks` only dims, dtype, fill value and attributes count, so they may be
        broadcast.
    chunks
        Array that is written chunk by chunk → shape of its chunks.
    packed
        Whether those are compressed; noise is not made smaller by it.
    consolidated
        Whether the stage's own metadata repeat those of its arrays, for readers that open many of them.
    """
    files: dict[str, Buffer] = {}
    rest, store = stage.drop_vars(list(chunks)), MemoryStore(files)
    rest.to_zarr(store, mode="w", consolidated=False, zarr_format=3, encoding=encoding_of(rest, {}))
    group = zarr.open_group(store, mode="r+")
    for name, shape in chunks.items():
        array = stage[name]
        group.create_array(
            name,
            shape=array.shape,
            chunks=shape,
            dtype=array.dtype,
            compressors=CODECS if packed else CODECS[-1:],
            fill_value=array.values.flat[0],  # of a chunk that is never written
            dimension_names=[str(dim) for dim in array.dims],
            attributes=array.attrs | ({"grid_mapping": "spatial_ref"} if {"y", "x"} <= set(array.dims) else {}),
        )
    if consolidated:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ZarrUserWarning)  # of version 3 it is not in the standard yet
            zarr.consolidate_metadata(store)
    return {path: content.to_bytes() for path, content in files.items()}


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
