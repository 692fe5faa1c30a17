"""Which files of a flight's folder are a node's SigMF recording: by its name, by a collection, by core:dataset."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field, TypeAdapter

from apertura.common.documents import read_json
from apertura.common.errors import CampaignError, quoted
from apertura.common.paths import inside
from apertura.common.provenance import hashes_of_file
from apertura.formats.recordings.sigmf_meta import FileName, of_sigmf, read_global

_SUFFIX = ".sigmf-collection"
_EXPECTED = "a SigMF collection: core:version, core:streams (name, hash) and, where names differ, apertura:nodes"
_REMEDY = "Correct the collection, or take it out of the folder."


class _Stream(BaseModel):
    name: FileName
    sha512: Annotated[str, Field(alias="hash", pattern="^[0-9a-fA-F]{128}$")]


class Collection(BaseModel):
    """The collection object."""

    version: str = Field(alias="core:version")
    streams: list[_Stream] = Field(alias="core:streams", max_length=10_000)
    nodes: dict[str, FileName] = Field(default_factory=dict, alias="apertura:nodes")


def find_sigmf(folder: Path, node: str) -> tuple[Path, Path]:
    """Return metadata and samples of a node's recording, which need not be there.

    The metadata are <node>.sigmf-meta, or where that is missing those of the stream that `apertura:nodes` of a
    collection in the folder gives the node. The samples have their name, or the one that `core:dataset` says.

    Raises
    ------
    CampaignError
        If a collection is none, gives the node a stream that it does not list, or two collections give it one.
    """
    meta = folder / f"{node}.sigmf-meta"
    if not meta.is_file():
        given = [(path, one.nodes[node]) for path, one in _collections(folder) if node in one.nodes]
        if len(given) > 1:
            found = f"node {node} is in {' and '.join(path.name for path, _ in given)}"
            raise CampaignError(found, folder, "one recording of each node", "Take a collection out of the folder.")
        meta = folder / f"{given[0][1]}.sigmf-meta" if given else meta
    samples = meta.with_suffix(".sigmf-data")
    if meta.is_file() and not samples.is_file():
        dataset = read_global(meta).dataset
        samples = samples if dataset is None else folder / dataset
    return meta, samples


def check_listed(meta_path: Path) -> None:
    """Raise CampaignError unless metadata are those that the collections beside them hashed, where any lists them."""
    for path, collection in _collections(meta_path.parent):
        for stream in collection.streams:
            if stream.name != meta_path.stem:
                continue
            digest = hashes_of_file(meta_path, ["sha512"])["sha512"]
            if digest != stream.sha512.lower():
                raise CampaignError(
                    f"sha512 {digest[:12]}…",
                    meta_path,
                    f"{stream.sha512[:12]}… (core:streams of {path.name})",
                    "The metadata were changed or belong to another recording; copy them again.",
                )


def _collections(folder: Path) -> Iterator[tuple[Path, Collection]]:
    for found in sorted(folder.glob(f"*{_SUFFIX}")):
        path = inside(folder, found.name, where=folder)
        document = read_json(path, expected=_EXPECTED, remedy=_REMEDY)
        collection = of_sigmf(TypeAdapter(Collection), document.get("collection"), path, "collection")
        listed = {stream.name for stream in collection.streams}
        for node, name in collection.nodes.items():
            if name not in listed:
                found_there = f"apertura:nodes gives {quoted(node, 40)} the stream {quoted(name, 40)}"
                raise CampaignError(found_there, path, f"one of core:streams {sorted(listed)}", _REMEDY)
        yield path, collection
