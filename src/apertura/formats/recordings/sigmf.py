"""SigMF recordings: metadata, collections, one capture segment per trigger, channels interleaved per sample."""

import json
import re
from codecs import BOM_UTF8
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, BinaryIO, NamedTuple, TypeVar

import ijson
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from apertura.common.atomic import naming
from apertura.common.confined import ConfinedPath
from apertura.common.documents import read_json
from apertura.common.errors import CampaignError, quoted, shown
from apertura.common.provenance import hashes_of_file
from apertura.formats.recordings.recording import Captures, Recording
from apertura.formats.recordings.sample_file import DATATYPES, SETTLING, Mixing, SampleFile, SampleLayout
from apertura.formats.times import utc_times

# ---- Metadata: global object and captures, read as a stream ---------------------------------------------------------
#
# Only what is read is checked: the schema of the sigmf package takes jsonschema, which costs more to import than a
# recording to open.

LARGEST_META = 256_000_000
"""Bytes of a metadata file: some 2 million captures."""

_EXPECTED = "SigMF metadata with one capture segment per trigger, ISO 8601 UTC in the core:datetime of each"

_REMEDY = "Correct the metadata or record again."

_AT_ONCE = 4096  # captures

Model = TypeVar("Model")

Count = Annotated[int, Field(ge=0, le=1 << 40, strict=True)]
"""Of samples, chips, bits or bytes."""

ChannelName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_. -]{1,80}$")]
"""Shown in messages and named in stages."""

FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_. ()-]{0,199}$")]
"""In the same folder."""

Frequency = Annotated[float, Field(ge=-1e12, le=1e12)]


class SigmfFraming(BaseModel):
    """Preamble and payload sent before each symbol."""

    preamble: str = Field(min_length=1, max_length=200)
    chip_samples: Annotated[int, Field(ge=1, le=1 << 20, strict=True)]
    centre_hz: Frequency
    counter_bits: Annotated[int, Field(ge=0, le=62, strict=True)]
    bit_chips: Annotated[int, Field(ge=1, le=1 << 20, strict=True)]
    guard_samples: Count


class Extension(BaseModel):
    """An extension of SigMF that metadata use."""

    name: Annotated[str, Field(max_length=200)]
    optional: bool = True


DESCRIPTIVE = frozenset({"antenna", "apertura", "capture_details", "signal", "spatial", "traceability", "volatile"})
"""Extensions that describe a recording and change no sample or time; one that is required and unknown is refused."""


class Global(BaseModel):
    """The global object."""

    datatype: str = Field(alias="core:datatype")
    version: str = Field(alias="core:version")
    sample_rate_hz: float = Field(alias="core:sample_rate", ge=1, le=1e12)
    num_channels: int = Field(1, alias="core:num_channels", ge=1, le=64, strict=True)
    sha512: str | None = Field(None, alias="core:sha512", pattern="^[0-9a-fA-F]{128}$")
    channels: list[ChannelName] | None = Field(None, alias="apertura:channels")
    framing: SigmfFraming | None = Field(None, alias="apertura:framing")
    if_hz: Frequency | None = Field(None, alias="apertura:if_hz")
    dataset: FileName | None = Field(None, alias="core:dataset")
    trailing_bytes: Count = Field(0, alias="core:trailing_bytes")
    offset: Count = Field(0, alias="core:offset")
    extensions: list[Extension] = Field(default_factory=list, alias="core:extensions", max_length=100)


class Capture(BaseModel):
    """One of the captures array."""

    start: Count = Field(alias="core:sample_start")
    datetime: str = Field(alias="core:datetime", pattern="Z$")
    frequency_hz: Frequency | None = Field(None, alias="core:frequency")
    header_bytes: Count = Field(0, alias="core:header_bytes")
    frame: int = Field(-1, alias="apertura:frame", ge=-1, lt=1 << 62, strict=True)


_SOME_CAPTURES = TypeAdapter(list[Capture])


class StatedCaptures(NamedTuple):
    """Fields of the captures, (capture,) each."""

    start: NDArray[np.int64]
    time: NDArray[np.datetime64]
    frequency_hz: NDArray[np.float64]  # NaN where not stated
    header_bytes: NDArray[np.int64]
    frame: NDArray[np.int64]

    def first(self, count: int) -> "StatedCaptures":
        """Return the first ones."""
        return StatedCaptures._make(column[:count] for column in self)

    def followed_by(self, later: "StatedCaptures") -> "StatedCaptures":
        """Return these and later ones."""
        return StatedCaptures._make(np.concatenate(both) for both in zip(self, later, strict=True))


def read_meta(path: Path) -> tuple[Global, StatedCaptures]:
    """Return the metadata of a recording.

    A long flight has some hundred thousand captures: at most a few thousand of their objects are in memory at a time.

    Raises
    ------
    CampaignError
        If they are not SigMF.
    """
    with _opened(path) as stream:
        header = _read_global(stream, path)
        captures = _read_captures(ijson.items(_from_start(stream), "captures.item", use_float=True), path, header)
        deque(ijson.basic_parse(_from_start(stream)), maxlen=0)  # what follows is JSON, too
    return header, captures


def read_global(path: Path) -> Global:
    """Return the global object alone; raise CampaignError as `read_meta` does."""
    with _opened(path) as stream:
        return _read_global(stream, path)


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    if not path.is_file():
        raise CampaignError("no such file", path, _EXPECTED, _REMEDY)
    if path.stat().st_size > LARGEST_META:
        found, expected = f"{path.stat().st_size} bytes", f"a file of at most {LARGEST_META} bytes"
        raise CampaignError(found, path, expected, "Is it the right file? Shorten it.")
    try:
        with naming(path), path.open("rb") as stream:
            yield stream
    except (ijson.JSONError, UnicodeDecodeError) as error:
        why = shown(str(error).strip().splitlines()[0])
        raise CampaignError(f"not valid SigMF: no JSON: {why}", path, _EXPECTED, _REMEDY) from error


def _read_global(stream: BinaryIO, path: Path) -> Global:
    document = next(ijson.items(_from_start(stream), "global", use_float=True), None)
    return _global(document, path)


def _global(document: object, path: Path) -> Global:
    """Return the global object checked; raise CampaignError where it requires an extension that is not known here."""
    header = of_sigmf(TypeAdapter(Global), document, path, "global")
    required = [one.name for one in header.extensions if not one.optional and one.name not in DESCRIPTIVE]
    if required:
        raise CampaignError(
            f"core:extensions requires {quoted(required[0])}",
            path,
            f"no extension beyond {', '.join(sorted(DESCRIPTIVE))}: it may change how samples are read",
            "Convert the recording to plain SigMF; where the extension only describes, set its `optional` to true.",
        )
    return header


def _from_start(stream: BinaryIO) -> BinaryIO:
    """Return a stream at its beginning, behind its byte-order mark."""
    stream.seek(0)
    stream.seek(len(BOM_UTF8) if stream.read(len(BOM_UTF8)) == BOM_UTF8 else 0)
    return stream


def _read_captures(documents: Iterator[object], path: Path, whole: Global) -> StatedCaptures:
    """Return the captures; their first samples count from the begin of the file (core:offset is taken off)."""
    parts: list[StatedCaptures] = []
    while some := list(islice(documents, _AT_ONCE)):
        captures = of_sigmf(_SOME_CAPTURES, some, path, "captures", first=_AT_ONCE * len(parts))
        try:
            time = utc_times([capture.datetime.removesuffix("Z") for capture in captures])
        except ValueError as error:
            raise CampaignError(
                f"core:datetime: {error}", path, "ISO 8601 UTC on every capture", "Write the time tags."
            ) from error
        stated = [np.nan if capture.frequency_hz is None else capture.frequency_hz for capture in captures]
        start, header, frame = (
            np.array([getattr(capture, name) for capture in captures], np.int64)
            for name in ("start", "header_bytes", "frame")
        )
        before = np.flatnonzero(start < whole.offset)
        if before.size:
            raise CampaignError(
                f"capture {_AT_ONCE * len(parts) + before[0]}: core:sample_start {start[before[0]]}",
                path,
                f"no sample before core:offset {whole.offset}, the index of the file's first",
                "The recording was split: correct core:sample_start, or leave core:offset out where they count from 0.",
            )
        start -= whole.offset
        parts.append(StatedCaptures(start, time, np.array(stated), header, frame))
    if not parts:
        raise CampaignError("not valid SigMF: captures: none", path, _EXPECTED, _REMEDY)
    return StatedCaptures(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def of_sigmf(adapter: TypeAdapter[Model], document: object, path: Path, name: str, *, first: int = 0) -> Model:
    """Return part `name` of the metadata checked; it begins with capture `first`."""
    try:
        return adapter.validate_python(document)
    except ValidationError as error:
        wrong = error.errors(include_url=False, include_context=False)[0]
        key = ".".join([name, *(str(at + first) if isinstance(at, int) else at for at in wrong["loc"])])
        given = f", not {quoted(wrong['input'])}" if isinstance(wrong["input"], (str, int, float)) else ""
        raise CampaignError(f"not valid SigMF: {key}: {wrong['msg']}{given}", path, _EXPECTED, _REMEDY) from error


# ---- Files of a node's recording: by name, collection or core:dataset -----------------------------------------------

_SUFFIX = ".sigmf-collection"
_A_COLLECTION = "a SigMF collection: core:version, core:streams (name, hash) and, where names differ, apertura:nodes"
_CORRECT_IT = "Correct the collection, or take it out of the folder."


class _Stream(BaseModel):
    name: FileName
    sha512: Annotated[str, Field(alias="hash", pattern="^[0-9a-fA-F]{128}$")]


class SigmfCollection(BaseModel):
    """The collection object."""

    version: str = Field(alias="core:version")
    streams: list[_Stream] = Field(alias="core:streams", max_length=10_000)
    nodes: dict[str, FileName] = Field(default_factory=dict, alias="apertura:nodes")


def find_sigmf(folder: Path, node: str) -> tuple[Path, Path]:
    """Return metadata and samples of a node's recording, which need not be there.

    The metadata are <node>.sigmf-meta, or where that is missing those of the stream that `apertura:nodes` of a
    collection in the folder gives the node. The samples have their name, or the one of `core:dataset`.

    Raises
    ------
    CampaignError
        If a collection is none, gives the node a stream that it does not list, or two collections give it one; or if
        an archive lies there instead.
    """
    meta = folder / f"{node}.sigmf-meta"
    archive = folder / f"{node}{ARCHIVE}"
    if not meta.is_file() and archive.is_file():
        raise archived(archive)
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


ARCHIVE = ".sigmf"
"""Suffix of a tar archive of metadata and samples."""


def archived(path: Path) -> CampaignError:
    """Return the error of a recording that lies in an archive.

    Examples
    --------
    >>> print(archived(Path("uav2.sigmf")))
    uav2.sigmf: a SigMF archive; expected .sigmf-meta and .sigmf-data. Unpack it: tar -xf uav2.sigmf.
    """
    return CampaignError(
        "a SigMF archive", path, ".sigmf-meta and .sigmf-data", f"Unpack it: tar -xf {shown(path.name, 100)}."
    )


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


def _collections(folder: Path) -> Iterator[tuple[Path, SigmfCollection]]:
    for found in sorted(folder.glob(f"*{_SUFFIX}")):
        path = ConfinedPath.at(folder).named(found.name, where=folder)
        document = read_json(path, expected=_A_COLLECTION, remedy=_CORRECT_IT)
        collection = of_sigmf(TypeAdapter(SigmfCollection), document.get("collection"), path, "collection")
        listed = {stream.name for stream in collection.streams}
        for node, name in collection.nodes.items():
            if name not in listed:
                found_there = f"apertura:nodes gives {quoted(node, 40)} the stream {quoted(name, 40)}"
                raise CampaignError(found_there, path, f"one of core:streams {sorted(listed)}", _CORRECT_IT)
        yield path, collection


# ---- Recordings: one capture segment per trigger, interleaved channels ----------------------------------------------


def open_sigmf(meta_path: Path, data_path: Path) -> Recording:
    """Open a SigMF recording after checking its metadata, the collections that list it, and its size.

    Raises
    ------
    CampaignError
        If the metadata are not SigMF, the data are truncated, a capture lies past their end, or the first samples are
        floating-point numbers where core:datatype states counts.

    Notes
    -----
    Source: SigMF specification 1.2, sections "Captures Array" and "Dataset Format".
    """
    header, captures = read_meta(meta_path)
    check_listed(meta_path)
    if header.dataset not in (None, data_path.name):
        raise CampaignError(
            f"core:dataset {header.dataset}",
            meta_path,
            f"{data_path.name}, which lies beside it",
            "Remove one of them.",
        )
    channels, layout = _channels(header, meta_path), _layout(header, captures, meta_path)
    samples = _samples(SampleFile(data_path, len(channels), layout), captures, meta_path)
    floats = samples.floats_among_counts(int(captures.start[0]))
    if floats is not None:
        right = f"{header.datatype[0]}{floats}"
        raise CampaignError(
            f"core:datatype {header.datatype}, and {data_path.name} holds finite floating-point numbers",
            meta_path,
            right,
            f"Set core:datatype to {right}.",
        )
    return Recording(
        samples=samples,
        channels=channels,
        sample_rate_hz=header.sample_rate_hz,
        frequency_hz=_frequency_hz(captures, meta_path),
        captures=Captures(
            captures.start,
            _usable(_length(captures, len(samples), meta_path), layout, meta_path),
            _checked(captures.time, meta_path),
            captures.frame,
        ),
        framing=header.framing.model_dump() if header.framing and len(captures.start) == 1 else None,
        files=(meta_path, data_path),
        sha512=header.sha512 and header.sha512.lower(),
    )


def _layout(header: Global, captures: StatedCaptures, path: Path) -> SampleLayout:
    """Return the layout of the samples in their file."""
    real, continuous = header.datatype.startswith("r"), header.framing is not None and len(captures.start) == 1
    mixing = None
    if header.if_hz is not None:
        mixing = Mixing(header.if_hz, header.sample_rate_hz, restarts=not continuous)
    skipped = np.cumsum(captures.header_bytes)
    start, skipped = (captures.start, skipped) if skipped[-1] else (skipped[:0], skipped[:0])
    layout = SampleLayout(header.datatype, header.trailing_bytes, start, skipped, mixing)
    try:
        _ = layout.stored
    except ValueError:
        found = f"core:datatype {quoted(header.datatype)}"
        raise CampaignError(found, path, DATATYPES, "Convert the recording.") from None
    if real is (mixing is None):
        raise CampaignError(
            f"core:datatype {header.datatype} {'without' if real else 'with'} apertura:if_hz",
            path,
            "the intermediate frequency at which baseband zero lies with real samples, and only there",
            "Add apertura:if_hz, Hz, to the global object." if real else "Remove it, or correct core:datatype.",
        )
    return layout


def _frequency_hz(captures: StatedCaptures, path: Path) -> float:
    """Return the RF frequency at baseband zero, which all captures share; 0 where none is stated."""
    stated = np.flatnonzero(~np.isnan(captures.frequency_hz))
    if not stated.size:
        return 0.0
    hz = captures.frequency_hz[stated]
    other = np.flatnonzero(hz != hz[0])
    if other.size:
        raise CampaignError(
            f"capture {stated[other[0]]}: core:frequency {hz[other[0]]:.6f}",
            path,
            f"{hz[0]:.6f}, as capture {stated[0]} says: one carrier for the whole recording",
            "Correct the metadata, or split the recording.",
        )
    return float(hz[0])


def _channels(header: Global, path: Path) -> list[str]:
    names = ["radar", "sidelink"][: header.num_channels] if header.channels is None else header.channels
    if len(names) != header.num_channels or "radar" not in names or len(set(names)) < len(names):
        raise CampaignError(
            f"apertura:channels {names} for core:num_channels {header.num_channels}",
            path,
            "one name per channel, each its own, 'radar' among them",
            "Correct the metadata.",
        )
    return names


def _samples(samples: SampleFile, captures: StatedCaptures, meta_path: Path) -> SampleFile:
    """Return samples that are there, whole, and reach to the last capture."""
    path, frame = samples.path, samples.sample_bytes
    if not path.is_file():
        raise CampaignError("no such file", path, f"the samples of {meta_path.name}", "Copy it there.")
    size = path.stat().st_size - samples.other_bytes
    if size % frame or size <= 0:
        other = f" less {samples.other_bytes} of core:header_bytes and core:trailing_bytes" * bool(samples.other_bytes)
        raise CampaignError(
            f"{path.stat().st_size} bytes{other}, not a multiple of {samples.channels}-channel samples",
            path,
            f"a multiple of {frame} bytes",
            "The file is truncated; copy it again.",
        )
    if captures.start[-1] >= size // frame:
        raise CampaignError(
            f"capture {len(captures.start) - 1} starts at sample {captures.start[-1]}, the data end at {size // frame}",
            meta_path,
            f"captures inside {path.name}",
            "The data are truncated or the metadata belong to another file; copy both again.",
        )
    return samples


def _length(captures: StatedCaptures, total: int, path: Path) -> int:
    lengths = np.diff(captures.start, append=total)
    length = int(np.median(lengths))
    short = np.flatnonzero((lengths < length) | (lengths < 1))
    if short.size:
        pulse = int(short[0])
        raise CampaignError(
            f"capture {pulse} holds {lengths[pulse]} samples (the data end at sample {total})",
            path,
            f"{max(length, 1)}, as most captures do",
            "The data are truncated (copy them again) or core:sample_start is wrong.",
        )
    return length


def _usable(length: int, layout: SampleLayout, path: Path) -> int:
    """Return the samples of each capture that can be had: the filter of real ones runs over their end."""
    if layout.mixing is None or not layout.mixing.restarts:
        return length
    if length <= 2 * SETTLING:
        found = f"captures of {length} real samples"
        raise CampaignError(found, path, f"more than {2 * SETTLING}: a filter needs them", "Record longer captures.")
    return length - SETTLING


def _checked(tags: NDArray[np.datetime64], path: Path) -> NDArray[np.datetime64]:
    backwards = np.flatnonzero(np.diff(tags) <= np.timedelta64(0, "ns"))
    if backwards.size:
        raise CampaignError(
            f"capture {int(backwards[0]) + 1} is tagged {tags[backwards[0] + 1]}, not after the one before",
            path,
            "increasing core:datetime",
            "Sort the captures or correct the tags.",
        )
    return tags


# ---- Recordings that still grow: captures as far as they are whole --------------------------------------------------

_DECODER = json.JSONDecoder()
_BETWEEN = re.compile(r"[\s,:]*")
_KNOWN_BYTES = 256  # before the place read to, by which metadata are known to have only been appended to


class GrowingSigmf:
    """A SigMF recording while its recorder writes it: metadata and samples are read from where the last read ended.

    Metadata may be written as a stream, whose captures are not closed yet, or anew each time; what is not whole, a
    capture's object or its samples, is left for the next read.

    Parameters
    ----------
    meta_path, data_path
        As of `open_sigmf`.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> meta = ('{"global": {"core:datatype": "ci16_le", "core:version": "1.2.5", "core:sample_rate": 1e6}, '
    ...         '"captures": ['
    ...         '{"core:sample_start": 0, "core:datetime": "2025-05-14T09:30:00Z"}, '
    ...         '{"core:sample_start": 4, "core:datetime": "2025-05-14T09:30:01Z"}, {"core:sample_st')
    >>> with TemporaryDirectory() as folder:
    ...     files = Path(folder) / "a.sigmf-meta", Path(folder) / "a.sigmf-data"
    ...     _ = files[0].write_text(meta)
    ...     np.ones(2 * 7, "<i2").tofile(files[1])  # the second capture lacks a sample
    ...     GrowingSigmf(*files).read().captures.start
    array([0])
    """

    def __init__(self, meta_path: Path, data_path: Path) -> None:
        self.files = meta_path, data_path
        self.ended = False
        """Whether the metadata are closed, state the hash of the samples, and all of these are there."""
        self._forget()

    @property
    def runs_through(self) -> bool:
        """True if its recorder never stops: pulses are then found in all samples at once, and `read` returns none."""
        return self._header is not None and self._header.framing is not None

    def _forget(self) -> None:
        self._header: Global | None = None
        self._captures: StatedCaptures | None = None
        self._read_to, self._known, self._closed = 0, b"", False

    def read(self) -> Recording | None:
        """Return the recording as far as it is whole; None before its second capture has begun.

        Raises
        ------
        CampaignError
            If what is there is not SigMF.
        """
        self._read_meta()
        header, captures, (meta, data) = self._header, self._captures, self.files
        if header is None or self.runs_through or captures is None or len(captures.start) < 2 or not data.is_file():
            return None
        channels, layout = _channels(header, meta), _layout(header, captures, meta)
        length = int(np.median(np.diff(captures.start)))
        whole = captures.start + length <= len(SampleFile(data, len(channels), layout))
        self.ended = self._closed and header.sha512 is not None and bool(whole.all())
        if not whole.any():
            return None
        captures = captures.first(int(whole.sum()))
        layout = _layout(header, captures, meta)
        _length(captures, int(captures.start[-1]) + length, meta)
        return Recording(
            SampleFile(data, len(channels), layout),
            channels,
            header.sample_rate_hz,
            _frequency_hz(captures, meta),
            Captures(captures.start, _usable(length, layout, meta), _checked(captures.time, meta), captures.frame),
            None,
            self.files,
            header.sha512 and header.sha512.lower(),
        )

    def _read_meta(self) -> None:
        """Read the captures that were appended; all of them where what was read before is no longer there."""
        path = self.files[0]
        if not path.is_file() or path.stat().st_size > LARGEST_META:
            return
        with naming(path), path.open("rb") as stream:
            stream.seek(self._read_to - len(self._known))
            known, appended = stream.read(len(self._known)), stream.read(LARGEST_META)
        if known != self._known:
            if len(known) == len(self._known):  # else it is being written anew
                self._forget()
                self._read_meta()
            return
        mark = len(BOM_UTF8) if not self._read_to and appended.startswith(BOM_UTF8) else 0
        text = appended[mark:].decode("utf-8", errors="ignore")  # a letter that is cut is no part of what is whole
        at = 0 if self._header else self._begin(text)
        documents: list[object] = []
        for document, end in _whole_objects(text, at):
            documents.append(document)
            at = end
        rest = text[at:].lstrip()
        self._closed = rest.startswith("]") and rest.rstrip().endswith("}")
        if self._header is None:
            return
        if documents:
            read = _read_captures(iter(documents), path, self._header)
            self._captures = read if self._captures is None else self._captures.followed_by(read)
        behind = appended[: mark + len(text[:at].encode())]
        self._read_to, self._known = self._read_to + len(behind), (self._known + behind)[-_KNOWN_BYTES:]

    def _begin(self, text: str) -> int:
        """Read the global object; return where the captures begin, or the text's end where they have not yet."""
        path, header = self.files[0], None
        try:
            at = _at_next(text, text.index("{") + 1)
            while True:
                key, at = _DECODER.raw_decode(text, at)
                at = _at_next(text, at)
                if key == "captures":
                    break
                value, at = _DECODER.raw_decode(text, at)
                at, header = _at_next(text, at), value if key == "global" else header
        except (ValueError, RecursionError):  # not whole yet
            return len(text)
        if header is None:
            raise CampaignError(
                "captures before global",
                path,
                "global first, in a recording that grows",
                "Look at it when it has ended.",
            )
        self._header = _global(header, path)
        return at + 1  # behind the bracket


def _at_next(text: str, at: int) -> int:
    """Return the place of the next value."""
    found: Any = _BETWEEN.match(text, at)
    return int(found.end())


def _whole_objects(text: str, at: int) -> Iterator[tuple[object, int]]:
    """Yield the objects of an array as far as they are whole, each with where it ends."""
    while text.startswith("{", at := _at_next(text, at)):
        try:
            document, at = _DECODER.raw_decode(text, at)
        except (ValueError, RecursionError):
            return
        yield document, at
