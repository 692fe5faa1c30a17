"""SigMF 1.2 recordings: metadata, collections, one capture segment per trigger, channels interleaved per sample."""

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
# Only the keys used are checked: the schema of the sigmf package requires jsonschema, whose import takes longer than
# opening a recording.

LARGEST_META = 256_000_000
"""Maximum size of a metadata file, bytes: about 2 million captures."""

_EXPECTED = "SigMF metadata with one capture segment per trigger, each with core:datetime in ISO 8601 UTC"

_REMEDY = "Correct the metadata or record again."

_AT_ONCE = 4096  # captures in memory

Model = TypeVar("Model")

Count = Annotated[int, Field(ge=0, le=1 << 40, strict=True)]
"""Number of samples, chips, bits or bytes."""

ChannelName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_. -]{1,80}$")]
"""Name of a channel, as used in messages and stages."""

FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_. ()-]{0,199}$")]
"""Name of a file in the same folder."""

Frequency = Annotated[float, Field(ge=-1e12, le=1e12)]


class SigmfFraming(BaseModel):
    """Preamble and payload transmitted before each symbol."""

    preamble: str = Field(min_length=1, max_length=200)
    chip_samples: Annotated[int, Field(ge=1, le=1 << 20, strict=True)]
    centre_hz: Frequency
    counter_bits: Annotated[int, Field(ge=0, le=62, strict=True)]
    bit_chips: Annotated[int, Field(ge=1, le=1 << 20, strict=True)]
    guard_samples: Count


class Extension(BaseModel):
    """SigMF extension declared in metadata."""

    name: Annotated[str, Field(max_length=200)]
    optional: bool = True


DESCRIPTIVE = frozenset({"antenna", "apertura", "capture_details", "signal", "spatial", "traceability", "volatile"})
"""Extensions that do not affect samples or times; metadata that require any other extension are rejected."""


class Global(BaseModel):
    """SigMF global object."""

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
    """Element of the SigMF captures array."""

    start: Count = Field(alias="core:sample_start")
    datetime: str = Field(alias="core:datetime", pattern="Z$")
    frequency_hz: Frequency | None = Field(None, alias="core:frequency")
    header_bytes: Count = Field(0, alias="core:header_bytes")
    frame: int = Field(-1, alias="apertura:frame", ge=-1, lt=1 << 62, strict=True)


_SOME_CAPTURES = TypeAdapter(list[Capture])


class StatedCaptures(NamedTuple):
    """Fields of the captures as arrays, (capture,)."""

    start: NDArray[np.int64]
    time: NDArray[np.datetime64]
    frequency_hz: NDArray[np.float64]  # NaN where not stated
    header_bytes: NDArray[np.int64]
    frame: NDArray[np.int64]

    def first(self, count: int) -> "StatedCaptures":
        """Return the first `count` captures."""
        return StatedCaptures._make(column[:count] for column in self)

    def followed_by(self, later: "StatedCaptures") -> "StatedCaptures":
        """Append later captures."""
        return StatedCaptures._make(np.concatenate(both) for both in zip(self, later, strict=True))


def read_meta(path: Path) -> tuple[Global, StatedCaptures]:
    """Read the metadata of a recording.

    A long flight has several hundred thousand captures; at most a few thousand are in memory as JSON objects.

    Raises
    ------
    CampaignError
        If the file is not valid SigMF metadata.
    """
    with _opened(path) as stream:
        header = _read_global(stream, path)
        captures = _read_captures(ijson.items(_from_start(stream), "captures.item", use_float=True), path, header)
        deque(ijson.basic_parse(_from_start(stream)), maxlen=0)  # check that the rest of the file is valid JSON
    return header, captures


def read_global(path: Path) -> Global:
    """Read the global object only; for errors see `read_meta`."""
    with _opened(path) as stream:
        return _read_global(stream, path)


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    if not path.is_file():
        raise CampaignError("no such file", path, _EXPECTED, _REMEDY)
    if path.stat().st_size > LARGEST_META:
        found, expected = f"{path.stat().st_size} bytes", f"a file of at most {LARGEST_META} bytes"
        raise CampaignError(found, path, expected, "Check the path, or shorten the file.")
    try:
        with naming(path), path.open("rb") as stream:
            yield stream
    except (ijson.JSONError, UnicodeDecodeError) as error:
        reason = shown(str(error).strip().splitlines()[0])
        raise CampaignError(f"not valid SigMF: invalid JSON: {reason}", path, _EXPECTED, _REMEDY) from error


def _read_global(stream: BinaryIO, path: Path) -> Global:
    document = next(ijson.items(_from_start(stream), "global", use_float=True), None)
    return _global(document, path)


def _global(document: object, path: Path) -> Global:
    """Validate the global object; raise CampaignError if it requires an unsupported extension."""
    header = of_sigmf(TypeAdapter(Global), document, path, "global")
    required = [
        extension.name
        for extension in header.extensions
        if not extension.optional and extension.name not in DESCRIPTIVE
    ]
    if required:
        raise CampaignError(
            f"core:extensions requires {quoted(required[0])}, which may change the interpretation of samples",
            path,
            f"no required extension other than {', '.join(sorted(DESCRIPTIVE))}",
            "Convert the recording to plain SigMF; for a purely descriptive extension, set its `optional` to true.",
        )
    return header


def _from_start(stream: BinaryIO) -> BinaryIO:
    """Rewind a stream to the position after its byte-order mark."""
    stream.seek(0)
    stream.seek(len(BOM_UTF8) if stream.read(len(BOM_UTF8)) == BOM_UTF8 else 0)
    return stream


def _read_captures(documents: Iterator[object], path: Path, whole: Global) -> StatedCaptures:
    """Read the captures; their first samples are relative to the start of the file (core:offset is subtracted)."""
    parts: list[StatedCaptures] = []
    while batch := list(islice(documents, _AT_ONCE)):
        captures = of_sigmf(_SOME_CAPTURES, batch, path, "captures", first=_AT_ONCE * len(parts))
        try:
            time = utc_times([capture.datetime.removesuffix("Z") for capture in captures])
        except ValueError as error:
            raise CampaignError(
                f"core:datetime: {error}", path, "ISO 8601 UTC in every capture", "Add the time tags."
            ) from error
        frequency_hz = [np.nan if capture.frequency_hz is None else capture.frequency_hz for capture in captures]
        start, header, frame = (
            np.array([getattr(capture, name) for capture in captures], np.int64)
            for name in ("start", "header_bytes", "frame")
        )
        before = np.flatnonzero(start < whole.offset)
        if before.size:
            raise CampaignError(
                f"capture {_AT_ONCE * len(parts) + before[0]}: core:sample_start {start[before[0]]}",
                path,
                f"at least core:offset {whole.offset}, the index of the first sample in the file",
                "The recording was split: correct core:sample_start, or remove core:offset if the first index is 0.",
            )
        start -= whole.offset
        parts.append(StatedCaptures(start, time, np.array(frequency_hz), header, frame))
    if not parts:
        raise CampaignError("not valid SigMF: captures: empty", path, _EXPECTED, _REMEDY)
    return StatedCaptures(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def of_sigmf(adapter: TypeAdapter[Model], document: object, path: Path, name: str, *, first: int = 0) -> Model:
    """Validate part `name` of the metadata; `first` is the number of its first capture."""
    try:
        return adapter.validate_python(document)
    except ValidationError as error:
        wrong = error.errors(include_url=False, include_context=False)[0]
        key = ".".join([name, *(str(at + first) if isinstance(at, int) else at for at in wrong["loc"])])
        value = f", not {quoted(wrong['input'])}" if isinstance(wrong["input"], (str, int, float)) else ""
        raise CampaignError(f"not valid SigMF: {key}: {wrong['msg']}{value}", path, _EXPECTED, _REMEDY) from error


# ---- Files of a node's recording: by name, collection or core:dataset -----------------------------------------------

_SUFFIX = ".sigmf-collection"
_A_COLLECTION = "a SigMF collection: core:version, core:streams (name, hash) and, if names differ, apertura:nodes"
_CORRECT_IT = "Correct the collection, or remove it from the folder."


class _Stream(BaseModel):
    name: FileName
    sha512: Annotated[str, Field(alias="hash", pattern="^[0-9a-fA-F]{128}$")]


class SigmfCollection(BaseModel):
    """SigMF collection object."""

    version: str = Field(alias="core:version")
    streams: list[_Stream] = Field(alias="core:streams", max_length=10_000)
    nodes: dict[str, FileName] = Field(default_factory=dict, alias="apertura:nodes")


def find_sigmf(folder: Path, node: str) -> tuple[Path, Path]:
    """Return the paths of the metadata and sample files of a node's recording, whether or not they exist.

    The metadata file is <node>.sigmf-meta or, if that is missing, the file of the stream that `apertura:nodes` of a
    collection in the folder assigns to the node. The sample file has the same name, or the name in `core:dataset`.

    Raises
    ------
    CampaignError
        If a collection is invalid or assigns a stream that is not in its list, if two collections assign a stream to
        the node, or if the recording is a SigMF archive.
    """
    meta = folder / f"{node}.sigmf-meta"
    archive = folder / f"{node}{ARCHIVE}"
    if not meta.is_file() and archive.is_file():
        raise archived(archive)
    if not meta.is_file():
        assigned = [
            (path, collection.nodes[node]) for path, collection in _collections(folder) if node in collection.nodes
        ]
        if len(assigned) > 1:
            found = f"node {node} is in {' and '.join(path.name for path, _ in assigned)}"
            raise CampaignError(found, folder, "one recording per node", "Remove a collection from the folder.")
        meta = folder / f"{assigned[0][1]}.sigmf-meta" if assigned else meta
    samples = meta.with_suffix(".sigmf-data")
    if meta.is_file() and not samples.is_file():
        dataset = read_global(meta).dataset
        samples = samples if dataset is None else folder / dataset
    return meta, samples


ARCHIVE = ".sigmf"
"""Suffix of a tar archive of metadata and samples."""


def archived(path: Path) -> CampaignError:
    """Return the error for a recording in a SigMF archive.

    Examples
    --------
    >>> print(archived(Path("uav2.sigmf")))
    uav2.sigmf: a SigMF archive; expected .sigmf-meta and .sigmf-data. Unpack it: tar -xf uav2.sigmf.
    """
    return CampaignError(
        "a SigMF archive", path, ".sigmf-meta and .sigmf-data", f"Unpack it: tar -xf {shown(path.name, 100)}."
    )


def check_listed(meta_path: Path) -> None:
    """Raise CampaignError if metadata do not match their hash in a collection of the same folder."""
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
    for file in sorted(folder.glob(f"*{_SUFFIX}")):
        path = ConfinedPath.at(folder).named(file.name, where=folder)
        document = read_json(path, expected=_A_COLLECTION, remedy=_CORRECT_IT)
        collection = of_sigmf(TypeAdapter(SigmfCollection), document.get("collection"), path, "collection")
        listed = {stream.name for stream in collection.streams}
        for node, name in collection.nodes.items():
            if name not in listed:
                found = f"apertura:nodes assigns stream {quoted(name, 40)} to {quoted(node, 40)}"
                raise CampaignError(found, path, f"one of core:streams {sorted(listed)}", _CORRECT_IT)
        yield path, collection


# ---- Recordings: one capture segment per trigger, interleaved channels ----------------------------------------------


def open_sigmf(meta_path: Path, data_path: Path) -> Recording:
    """Open a SigMF recording after checking its metadata, the collections that list it, and its size.

    Raises
    ------
    CampaignError
        If the metadata are not SigMF, the data are truncated or end before a capture, or the first samples are
        floating-point numbers although core:datatype states integers.

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
            f"{data_path.name}, which is in the same folder",
            "Remove one of the two files, or correct core:dataset.",
        )
    channels, layout = _channels(header, meta_path), _layout(header, captures, meta_path)
    samples = _samples(SampleFile(data_path, len(channels), layout), captures, meta_path)
    floats = samples.floats_among_counts(int(captures.start[0]))
    if floats is not None:
        datatype = f"{header.datatype[0]}{floats}"
        raise CampaignError(
            f"core:datatype {header.datatype}, but {data_path.name} contains floating-point numbers",
            meta_path,
            datatype,
            f"Set core:datatype to {datatype}.",
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
            "an intermediate frequency for real samples, none for complex samples",
            "Add apertura:if_hz, Hz, to the global object."
            if real
            else "Remove apertura:if_hz, or correct core:datatype.",
        )
    return layout


def _frequency_hz(captures: StatedCaptures, path: Path) -> float:
    """Return the RF frequency at zero baseband frequency, common to all captures; 0 if not stated."""
    stated = np.flatnonzero(~np.isnan(captures.frequency_hz))
    if not stated.size:
        return 0.0
    hz = captures.frequency_hz[stated]
    other = np.flatnonzero(hz != hz[0])
    if other.size:
        raise CampaignError(
            f"capture {stated[other[0]]}: core:frequency {hz[other[0]]:.6f}",
            path,
            f"{hz[0]:.6f}, the frequency of capture {stated[0]}: one carrier for the whole recording",
            "Correct the metadata, or split the recording.",
        )
    return float(hz[0])


def _channels(header: Global, path: Path) -> list[str]:
    names = ["radar", "sidelink"][: header.num_channels] if header.channels is None else header.channels
    if len(names) != header.num_channels or "radar" not in names or len(set(names)) < len(names):
        raise CampaignError(
            f"apertura:channels {names} for core:num_channels {header.num_channels}",
            path,
            "one unique name per channel, including 'radar'",
            "Correct the metadata.",
        )
    return names


def _samples(samples: SampleFile, captures: StatedCaptures, meta_path: Path) -> SampleFile:
    """Check that the sample file exists, is complete, and contains the last capture."""
    path, frame = samples.path, samples.sample_bytes
    if not path.is_file():
        raise CampaignError("no such file", path, f"the samples of {meta_path.name}", "Copy the file there.")
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
            f"capture {pulse} contains {lengths[pulse]} samples (the data end at sample {total})",
            path,
            f"{max(length, 1)} samples, the median of all captures",
            "The data are truncated (copy them again) or core:sample_start is wrong.",
        )
    return length


def _usable(length: int, layout: SampleLayout, path: Path) -> int:
    """Return the number of usable samples per capture, without the last samples, which the filter makes invalid."""
    if layout.mixing is None or not layout.mixing.restarts:
        return length
    if length <= 2 * SETTLING:
        found = f"captures of {length} real samples"
        raise CampaignError(found, path, f"more than {2 * SETTLING} samples for the filter", "Record longer captures.")
    return length - SETTLING


def _checked(tags: NDArray[np.datetime64], path: Path) -> NDArray[np.datetime64]:
    backwards = np.flatnonzero(np.diff(tags) <= np.timedelta64(0, "ns"))
    if backwards.size:
        raise CampaignError(
            f"capture {int(backwards[0]) + 1} has time tag {tags[backwards[0] + 1]}, not after the previous capture",
            path,
            "increasing core:datetime",
            "Sort the captures or correct the tags.",
        )
    return tags


# ---- Recordings that are being written: complete captures -----------------------------------------------------------

_DECODER = json.JSONDecoder()
_BETWEEN = re.compile(r"[\s,:]*")
_KNOWN_BYTES = 256  # bytes before the read position; if unchanged, metadata were only appended


class GrowingSigmf:
    """SigMF recording that is being written: each read continues at the end of the previous read.

    The recorder may append to the metadata file, so that its captures array is still unterminated, or rewrite the file
    at each update. Incomplete captures, in metadata or samples, are left for the next read.

    Parameters
    ----------
    meta_path, data_path
        See `open_sigmf`.

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
        """True if the metadata are complete and contain the hash of the samples, and all samples are present."""
        self._forget()

    @property
    def runs_through(self) -> bool:
        """True for a continuous recording: its pulses are detected in all samples at once, and `read` returns None."""
        return self._header is not None and self._header.framing is not None

    def _forget(self) -> None:
        self._header: Global | None = None
        self._captures: StatedCaptures | None = None
        self._read_to, self._known, self._closed = 0, b"", False

    def read(self) -> Recording | None:
        """Return the recording with its complete captures; None until its second capture has started.

        Raises
        ------
        CampaignError
            If the content read so far is not SigMF.
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
        """Read the appended captures, or all captures if the metadata were rewritten."""
        path = self.files[0]
        if not path.is_file() or path.stat().st_size > LARGEST_META:
            return
        with naming(path), path.open("rb") as stream:
            stream.seek(self._read_to - len(self._known))
            known, appended = stream.read(len(self._known)), stream.read(LARGEST_META)
        if known != self._known:
            if len(known) == len(self._known):  # otherwise the recorder is rewriting the file
                self._forget()
                self._read_meta()
            return
        mark = len(BOM_UTF8) if not self._read_to and appended.startswith(BOM_UTF8) else 0
        text = appended[mark:].decode("utf-8", errors="ignore")  # a truncated character follows all complete objects
        at = 0 if self._header else self._start(text)
        documents: list[object] = []
        for document, end in _complete_objects(text, at):
            documents.append(document)
            at = end
        rest = text[at:].lstrip()
        self._closed = rest.startswith("]") and rest.rstrip().endswith("}")
        if self._header is None:
            return
        if documents:
            read = _read_captures(iter(documents), path, self._header)
            self._captures = read if self._captures is None else self._captures.followed_by(read)
        consumed = appended[: mark + len(text[:at].encode())]
        self._read_to, self._known = self._read_to + len(consumed), (self._known + consumed)[-_KNOWN_BYTES:]

    def _start(self, text: str) -> int:
        """Read the global object; return the start of the captures, or the end of the text if they have not started."""
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
        except (ValueError, RecursionError):  # incomplete
            return len(text)
        if header is None:
            raise CampaignError(
                "captures before global",
                path,
                "global before captures, in a recording that is being written",
                "Open the recording when it is finished.",
            )
        self._header = _global(header, path)
        return at + 1  # after the bracket


def _at_next(text: str, at: int) -> int:
    """Return the position of the next value."""
    separator: Any = _BETWEEN.match(text, at)
    return int(separator.end())


def _complete_objects(text: str, at: int) -> Iterator[tuple[object, int]]:
    """Yield the complete objects of an array, each with its end position."""
    while text.startswith("{", at := _at_next(text, at)):
        try:
            document, at = _DECODER.raw_decode(text, at)
        except (ValueError, RecursionError):
            return
        yield document, at
