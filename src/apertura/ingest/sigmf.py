"""SigMF recordings: one capture segment per trigger, channels interleaved per sample.

Only what is read of the metadata is checked: the schema of the sigmf package takes jsonschema, which costs more to
import than a recording to open.
"""

from codecs import BOM_UTF8
from collections import deque
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Annotated, BinaryIO, NamedTuple, TypeVar

import ijson
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from apertura.atomic import naming
from apertura.errors import CampaignError, quoted, shown
from apertura.ingest.recording import Captures, Recording
from apertura.ingest.sample_file import SampleFile
from apertura.ingest.times import utc_times

_DATATYPE = "ci16_le"
_BYTES_PER_SAMPLE = 4  # of one channel: two int16

LARGEST_META = 256_000_000
"""Bytes of a metadata file: some 2 million captures."""

_EXPECTED = "SigMF metadata with one capture segment per trigger, ISO 8601 UTC in the core:datetime of each"

_REMEDY = "Correct the metadata or record again."

_AT_ONCE = 4096  # captures

Model = TypeVar("Model")

Count = Annotated[int, Field(ge=0, le=1 << 40, strict=True)]
"""Of samples, chips or bits."""

ChannelName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_. -]{1,80}$")]
"""Shown in messages and named in stages."""

Frequency = Annotated[float, Field(ge=-1e12, le=1e12)]


class _Framing(BaseModel):
    preamble: str = Field(min_length=1, max_length=200)
    chip_samples: Annotated[int, Field(ge=1, le=1 << 20, strict=True)]
    centre_hz: Frequency
    counter_bits: Annotated[int, Field(ge=0, le=62, strict=True)]
    bit_chips: Annotated[int, Field(ge=1, le=1 << 20, strict=True)]
    guard_samples: Count


class _Global(BaseModel):
    datatype: str = Field(alias="core:datatype")
    version: str = Field(alias="core:version")
    sample_rate_hz: float = Field(alias="core:sample_rate", ge=1, le=1e12)
    num_channels: int = Field(1, alias="core:num_channels", ge=1, le=64, strict=True)
    sha512: str | None = Field(None, alias="core:sha512", pattern="^[0-9a-fA-F]{128}$")
    channels: list[ChannelName] | None = Field(None, alias="apertura:channels")
    framing: _Framing | None = Field(None, alias="apertura:framing")


class _Capture(BaseModel):
    start: Count = Field(alias="core:sample_start")
    datetime: str = Field(alias="core:datetime", pattern="Z$")
    frequency_hz: Frequency | None = Field(None, alias="core:frequency")
    frame: int = Field(-1, alias="apertura:frame", ge=-1, lt=1 << 62, strict=True)


_SOME_CAPTURES = TypeAdapter(list[_Capture])


class _Captures(NamedTuple):
    """What the metadata say of the captures, (capture,) each."""

    start: NDArray[np.int64]
    time: NDArray[np.datetime64]
    frequency_hz: NDArray[np.float64]  # NaN where not stated
    frame: NDArray[np.int64]


def open_sigmf(meta_path: Path, data_path: Path) -> Recording:
    """Open a SigMF recording of datatype ci16_le after checking its metadata and size.

    Metadata are read as a stream: a long flight has some hundred thousand captures.

    Raises
    ------
    CampaignError
        If the metadata are not SigMF, the data are truncated, or a capture lies past their end.

    Notes
    -----
    Source: SigMF specification 1.2, section "Captures Array".
    """
    header, captures = _read_meta(meta_path)
    channels = _channels(header, meta_path)
    samples = _samples(data_path, len(channels), captures, meta_path)
    return Recording(
        samples=samples,
        channels=channels,
        sample_rate_hz=header.sample_rate_hz,
        frequency_hz=_frequency_hz(captures, meta_path),
        captures=Captures(
            captures.start,
            _length(captures, len(samples), meta_path),
            _checked(captures.time, meta_path),
            captures.frame,
        ),
        framing=header.framing.model_dump() if header.framing and len(captures.start) == 1 else None,
        files=(meta_path, data_path),
        sha512=header.sha512,
    )


def _read_meta(path: Path) -> tuple[_Global, _Captures]:
    if not path.is_file():
        raise CampaignError("no such file", path, _EXPECTED, _REMEDY)
    if path.stat().st_size > LARGEST_META:
        found, expected = f"{path.stat().st_size} bytes", f"a file of at most {LARGEST_META} bytes"
        raise CampaignError(found, path, expected, "Is it the right file? Shorten it.")
    try:
        with naming(path), path.open("rb") as stream:
            document = next(ijson.items(_from_start(stream), "global", use_float=True), None)
            header = _of_sigmf(TypeAdapter(_Global), document, path, "global")
            captures = _read_captures(ijson.items(_from_start(stream), "captures.item", use_float=True), path)
            deque(ijson.basic_parse(_from_start(stream)), maxlen=0)  # what follows is JSON, too
    except (ijson.JSONError, UnicodeDecodeError) as error:
        why = shown(str(error).strip().splitlines()[0])
        raise CampaignError(f"not valid SigMF: no JSON: {why}", path, _EXPECTED, _REMEDY) from error
    if header.datatype != _DATATYPE:
        raise CampaignError(f"core:datatype {quoted(header.datatype)}", path, _DATATYPE, "Convert the recording.")
    return header, captures


def _from_start(stream: BinaryIO) -> BinaryIO:
    """Return a stream at its beginning, behind its byte-order mark."""
    stream.seek(0)
    stream.seek(len(BOM_UTF8) if stream.read(len(BOM_UTF8)) == BOM_UTF8 else 0)
    return stream


def _read_captures(documents: Iterator[object], path: Path) -> _Captures:
    parts: list[_Captures] = []
    while some := list(islice(documents, _AT_ONCE)):
        captures = _of_sigmf(_SOME_CAPTURES, some, path, "captures", first=_AT_ONCE * len(parts))
        try:
            time = utc_times([capture.datetime.removesuffix("Z") for capture in captures])
        except ValueError as error:
            raise CampaignError(
                f"core:datetime: {error}", path, "ISO 8601 UTC on every capture", "Write the time tags."
            ) from error
        stated = [np.nan if capture.frequency_hz is None else capture.frequency_hz for capture in captures]
        start, frame = ([getattr(capture, name) for capture in captures] for name in ("start", "frame"))
        parts.append(_Captures(np.array(start, np.int64), time, np.array(stated), np.array(frame, np.int64)))
    if not parts:
        raise CampaignError("not valid SigMF: captures: none", path, _EXPECTED, _REMEDY)
    return _Captures(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _of_sigmf(adapter: TypeAdapter[Model], document: object, path: Path, name: str, *, first: int = 0) -> Model:
    """Return part `name` of the metadata checked; it begins with capture `first`."""
    try:
        return adapter.validate_python(document)
    except ValidationError as error:
        wrong = error.errors(include_url=False, include_context=False)[0]
        key = ".".join([name, *(str(at + first) if isinstance(at, int) else at for at in wrong["loc"])])
        given = f", not {quoted(wrong['input'])}" if isinstance(wrong["input"], (str, int, float)) else ""
        raise CampaignError(f"not valid SigMF: {key}: {wrong['msg']}{given}", path, _EXPECTED, _REMEDY) from error


def _frequency_hz(captures: _Captures, path: Path) -> float:
    """Return the RF frequency at baseband zero, which all captures share; 0 where none says."""
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


def _channels(header: _Global, path: Path) -> list[str]:
    names = ["radar", "sidelink"][: header.num_channels] if header.channels is None else header.channels
    if len(names) != header.num_channels or "radar" not in names or len(set(names)) < len(names):
        raise CampaignError(
            f"apertura:channels {names} for core:num_channels {header.num_channels}",
            path,
            "one name per channel, each its own, 'radar' among them",
            "Correct the metadata.",
        )
    return names


def _samples(path: Path, channels: int, captures: _Captures, meta_path: Path) -> SampleFile:
    if not path.is_file():
        raise CampaignError("no such file", path, f"the samples of {meta_path.name}", "Copy it there.")
    size, frame = path.stat().st_size, channels * _BYTES_PER_SAMPLE
    if size % frame or size == 0:
        raise CampaignError(
            f"{size} bytes, not a multiple of {channels}-channel samples",
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
    return SampleFile(path, channels)


def _length(captures: _Captures, total: int, path: Path) -> int:
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
