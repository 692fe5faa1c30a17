"""Chunks on disk: flushed to disk before they are renamed, and verified by their checksums when they are read."""

import asyncio
import hashlib
import json
import warnings
from collections.abc import Hashable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import google_crc32c
import zarr
from zarr.abc.store import ByteRequest
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.errors import ZarrUserWarning
from zarr.storage import LocalStore, MemoryStore

from apertura.campaign.store.manifest import remake
from apertura.common.atomic import write_beside
from apertura.common.confined import ConfinedPath
from apertura.common.documents import other_codec
from apertura.common.errors import CampaignError

if TYPE_CHECKING:
    import xarray as xr


# Override the user's Zarr settings (ZARR_…, ~/.config/zarr), so that the written bytes do not depend on these settings.
zarr.config.update(zarr.config.defaults[0], priority="new")
zarr.config.set({"array.write_empty_chunks": True})  # write zeros, too, because a missing chunk means 'not computed'

CODECS = (ZstdCodec(), Crc32cCodec())
"""Codecs of a chunk; the checksum is last, so that it covers the bytes on disk."""

EXCHANGED = (ZstdCodec(checksum=True),)
"""Codecs of a stage that other programs read: GDAL (3.12) does not support crc32c; the checksum is that of zstd."""

_SUM_BYTES = 4
_METADATA = "zarr.json"


class StageStore(LocalStore):
    """Zarr store of a stage folder that verifies chunks.

    A file is complete or absent, even after a power failure. Each chunk is verified by its checksum on reading. Chunks
    of a finished stage are also verified by their hashes in the manifest, if given, when they are first read.

    Parameters
    ----------
    folder, read_only
        See `zarr.storage.LocalStore`.
    sha256
        File in the folder → hash.
    finished_later
        True if files are not flushed to disk before `finish`; a stage whose writer is killed is recomputed from the
        start.
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
        self._without_crc = set[str]()
        self._unchecked = {key: digest for key, digest in (sha256 or {}).items() if _METADATA not in key}

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return the content of a file; raise CampaignError if it is a damaged chunk."""
        return self._checked(key, await super().get(key, prototype, byte_range), byte_range)

    def get_sync(
        self, key: str, *, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return the content of a file; synchronous version of `get`."""
        return self._checked(key, super().get_sync(key, prototype=prototype, byte_range=byte_range), byte_range)

    async def set(self, key: str, value: Buffer) -> None:
        """Write a file of the folder."""
        await asyncio.to_thread(self.set_sync, key, value)

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write a file of the folder; synchronous version of `set`."""
        self._check_writable()
        path = self.root / key
        if self._finished_later:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(value.to_bytes())
        else:
            write_beside(path, value.to_bytes())

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write a file unless it exists; each file of a stage has only one writer."""
        if not await self.exists(key):
            await self.set(key, value)

    async def delete(self, key: str) -> None:
        """Remove a file, or a folder with its contents."""
        self._check_writable()
        await asyncio.to_thread((self.root / key).remove)

    async def delete_dir(self, prefix: str) -> None:
        """Remove a folder with its contents."""
        await self.delete(prefix)

    def _checked(self, key: str, value: Buffer | None, byte_range: ByteRequest | None) -> Buffer | None:
        name = key.rpartition("/")[2]
        if name.startswith(".z"):  # metadata of Zarr version 2 are not used, because filters may contain a pickle
            return None
        if name == _METADATA and value is not None:
            metadata = _json(value)
            if other_codec(metadata) is not None:
                raise damaged(self.root, key)
            if isinstance(metadata, dict) and '"crc32c"' not in json.dumps(metadata.get("codecs", [])):
                self._without_crc.add(key.removesuffix(f"/{_METADATA}"))
        if value is None and key in self._unchecked:  # Zarr interprets a missing chunk as an empty chunk
            raise damaged(self.root, key)
        if value is None or byte_range is not None or name == _METADATA:
            return value
        content = value.as_numpy_array()
        whole = key.removesuffix("/c").partition("/c/")[0] in self._without_crc or google_crc32c.value(
            content[:-_SUM_BYTES]
        ) == int.from_bytes(content[-_SUM_BYTES:].tobytes(), "little")
        expected = self._unchecked.get(key)
        if not whole or (expected is not None and expected != hashlib.sha256(content.data).hexdigest()):
            raise damaged(self.root, key)
        self._unchecked.pop(key, None)
        return value


def _json(value: Buffer) -> object:
    try:
        return json.loads(value.to_bytes())
    except (ValueError, RecursionError):
        return None  # Zarr then raises an error


def array_of(folder: Path, name: str, mode: str) -> Any:
    """Open an array of a stage as a `zarr.Array`."""
    return zarr.open_array(StageStore(folder, read_only=mode == "r"), path=name, mode=mode)


def update_attributes(folder: Path, attributes: Mapping[str, Any]) -> None:
    """Write attributes of an unfinished stage."""
    zarr.open_group(StageStore(folder), mode="r+").attrs.update(attributes)


def damaged(folder: Path, key: str) -> CampaignError:
    """Return the error for a damaged chunk of a finished or unfinished stage."""
    finished = folder.suffix == ".zarr"
    return CampaignError(
        "the file is damaged",
        where=folder / key,
        expected="content that matches its checksum",
        remedy=remake(folder) if finished else "Run the workflow again.",
    )


def encoding_of(
    dataset: "xr.Dataset", chunks: Mapping[str, int], codecs: tuple[Any, ...] = CODECS
) -> dict[Hashable, dict[str, Any]]:
    """Return the encoding of each variable of a stage.

    Parameters
    ----------
    dataset
        Stage.
    chunks
        Dimension → chunk length; other dimensions have one chunk.
    codecs
        Codecs of the chunks.
    """
    encoding: dict[Hashable, dict[str, Any]] = {}
    for name, array in dataset.variables.items():
        encoding[name] = {"compressors": codecs}
        if array.ndim and array.size:
            encoding[name]["chunks"] = tuple(chunks.get(str(dim), size) for dim, size in array.sizes.items())
    if "time" in encoding:
        encoding["time"] |= {"units": "nanoseconds since 1970-01-01", "dtype": "int64"}
    if "spatial_ref" in dataset.variables:
        for name, values in dataset.data_vars.items():
            if {"y", "x"} <= set(values.dims):
                encoding[name]["grid_mapping"] = "spatial_ref"
    return encoding


Groups = Mapping[str, tuple["xr.Dataset", Mapping[str, tuple[int, ...]]]]


def skeleton(
    stage: "xr.Dataset",
    chunks: Mapping[str, tuple[int, ...]],
    *,
    packed: bool = True,
    lengths: Mapping[str, int] = MappingProxyType({}),
    groups: Groups = MappingProxyType({}),
    consolidated: bool = False,
) -> dict[str, bytes]:
    """Return metadata and coordinates of a stage before its arrays are computed: path → bytes.

    Parameters
    ----------
    stage
        Stage with provenance. Only dims, dtype, fill value and attributes of the arrays in `chunks` are used, so that
        these arrays may be broadcast.
    chunks
        Array that is written chunk by chunk → shape of its chunks.
    packed
        True if these arrays are compressed, which does not reduce the size of noise.
    lengths
        Dimension → chunk length of the other arrays and coordinates; other dimensions have one chunk.
    groups
        Path of a group below the stage → its dataset and the chunks of its arrays, as `stage` and `chunks`.
    consolidated
        True for a stage that other programs read: its metadata contain those of all arrays, and its chunks have the
        codecs `EXCHANGED`.
    """
    files: dict[str, Buffer] = {}
    store = MemoryStore(files)
    for place, (dataset, shapes) in {"": (stage, chunks), **groups}.items():
        whole = dataset.drop_vars(list(shapes))
        codecs = EXCHANGED if consolidated else CODECS
        how: Any = {"consolidated": False, "zarr_format": 3, "encoding": encoding_of(whole, lengths, codecs)}
        whole.to_zarr(store, group=place or None, mode="a", **how)
        group = zarr.open_group(store, path=place, mode="r+")
        for name, shape in shapes.items():
            array = dataset[name]
            group.create_array(
                name,
                shape=array.shape,
                chunks=shape,
                dtype=array.dtype,
                compressors=codecs if packed else codecs[-1:],
                fill_value=array.values.flat[0],  # value of chunks that are never written
                dimension_names=[str(dim) for dim in array.dims],
                attributes=array.attrs | ({"grid_mapping": "spatial_ref"} if {"y", "x"} <= set(array.dims) else {}),
            )
    if consolidated:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ZarrUserWarning)  # not yet part of the Zarr version 3 standard
            zarr.consolidate_metadata(store)
    return {path: content.to_bytes() for path, content in files.items()}
