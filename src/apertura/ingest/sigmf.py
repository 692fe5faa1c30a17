"""SigMF recordings: one capture segment per trigger, channels interleaved per sample.

Only what is read of the metadata is checked: the schema of the sigmf package takes jsonschema, which costs more to
import than a recording to open.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError

from apertura.documents import read_text
from apertura.errors import CampaignError, quoted
from apertura.ingest.recording import Captures, Recording
from apertura.ingest.sample_file import SampleFile
from apertura.ingest.times import utc_times

_DATATYPE = "ci16_le"
_BYTES_PER_SAMPLE = 4  # of one channel: two int16

LARGEST_META = 256_000_000
"""Bytes of a metadata file: some 2 million captures."""

_EXPECTED = "SigMF metadata with one capture segment per trigger, ISO 8601 UTC in the core:datetime of each"

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


class _Meta(BaseModel):
    header: _Global = Field(alias="global")
    captures: list[_Capture] = Field(min_length=1)


def open_sigmf(meta_path: Path, data_path: Path) -> Recording:
    """Open a SigMF recording of datatype ci16_le after checking its metadata and size.

    Raises
    ------
    CampaignError
        If the metadata are not SigMF, the data are truncated, or a capture lies past their end.

    Notes
    -----
    Source: SigMF specification 1.2, section "Captures Array".
    """
    meta = _read_meta(meta_path)
    header, captures = meta.header, meta.captures
    channels = _channels(header, meta_path)
    samples = _samples(data_path, len(channels), captures, meta_path)
    return Recording(
        samples=samples,
        channels=channels,
        sample_rate_hz=header.sample_rate_hz,
        frequency_hz=_frequency_hz(captures, meta_path),
        captures=Captures(
            np.array([capture.start for capture in captures], np.int64),
            _length(captures, len(samples), meta_path),
            _times(captures, meta_path),
            np.array([capture.frame for capture in captures], np.int64),
        ),
        framing=header.framing.model_dump() if header.framing and len(captures) == 1 else None,
        files=(meta_path, data_path),
        sha512=header.sha512,
    )


def _read_meta(path: Path) -> _Meta:
    remedy = "Correct the metadata or record again."
    text = read_text(path, expected=_EXPECTED, remedy=remedy, largest=LARGEST_META)
    try:
        meta = _Meta.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        key = ".".join(map(str, first["loc"]))
        given = f", not {quoted(first['input'])}" if isinstance(first["input"], (str, int, float)) and key else ""
        raise CampaignError(
            f"not valid SigMF: {f'{key}: ' if key else ''}{first['msg']}{given}",
            path,
            _EXPECTED,
            remedy,
        ) from error
    if meta.header.datatype != _DATATYPE:
        raise CampaignError(f"core:datatype {quoted(meta.header.datatype)}", path, _DATATYPE, "Convert the recording.")
    return meta


def _frequency_hz(captures: list[_Capture], path: Path) -> float:
    """Return the RF frequency at baseband zero, which all captures share; 0 where none says."""
    stated = [(number, one.frequency_hz) for number, one in enumerate(captures) if one.frequency_hz is not None]
    if not stated:
        return 0.0
    first, other = stated[0][1], next((pair for pair in stated if pair[1] != stated[0][1]), None)
    if other is not None:
        raise CampaignError(
            f"capture {other[0]}: core:frequency {other[1]:.6f}",
            path,
            f"{first:.6f}, as capture {stated[0][0]} says: one carrier for the whole recording",
            "Correct the metadata, or split the recording.",
        )
    return first


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


def _samples(path: Path, channels: int, captures: list[_Capture], meta_path: Path) -> SampleFile:
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
    if captures[-1].start >= size // frame:
        raise CampaignError(
            f"capture {len(captures) - 1} starts at sample {captures[-1].start}, the data end at {size // frame}",
            meta_path,
            f"captures inside {path.name}",
            "The data are truncated or the metadata belong to another file; copy both again.",
        )
    return SampleFile(path, channels)


def _length(captures: list[_Capture], total: int, path: Path) -> int:
    lengths = np.diff([*(capture.start for capture in captures), total])
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


def _times(captures: list[_Capture], path: Path) -> NDArray[np.datetime64]:
    try:
        tags = utc_times([capture.datetime.removesuffix("Z") for capture in captures])
    except ValueError as error:
        raise CampaignError(
            f"core:datetime: {error}", path, "ISO 8601 UTC on every capture", "Write the time tags."
        ) from error
    backwards = np.flatnonzero(np.diff(tags) <= np.timedelta64(0, "ns"))
    if backwards.size:
        raise CampaignError(
            f"capture {int(backwards[0]) + 1} is tagged {tags[backwards[0] + 1]}, not after the one before",
            path,
            "increasing core:datetime",
            "Sort the captures or correct the tags.",
        )
    return tags
