"""Metadata of SigMF recordings as values: global object and captures, read as a stream.

Only what is read is checked: the schema of the sigmf package takes jsonschema, which costs more to import than a
recording to open.
"""

from codecs import BOM_UTF8
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Annotated, BinaryIO, NamedTuple, TypeVar

import ijson
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from apertura.common.atomic import naming
from apertura.common.errors import CampaignError, quoted, shown
from apertura.formats.times import utc_times

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


class Framing(BaseModel):
    """What was sent before each symbol."""

    preamble: str = Field(min_length=1, max_length=200)
    chip_samples: Annotated[int, Field(ge=1, le=1 << 20, strict=True)]
    centre_hz: Frequency
    counter_bits: Annotated[int, Field(ge=0, le=62, strict=True)]
    bit_chips: Annotated[int, Field(ge=1, le=1 << 20, strict=True)]
    guard_samples: Count


class Global(BaseModel):
    """The global object."""

    datatype: str = Field(alias="core:datatype")
    version: str = Field(alias="core:version")
    sample_rate_hz: float = Field(alias="core:sample_rate", ge=1, le=1e12)
    num_channels: int = Field(1, alias="core:num_channels", ge=1, le=64, strict=True)
    sha512: str | None = Field(None, alias="core:sha512", pattern="^[0-9a-fA-F]{128}$")
    channels: list[ChannelName] | None = Field(None, alias="apertura:channels")
    framing: Framing | None = Field(None, alias="apertura:framing")
    if_hz: Frequency | None = Field(None, alias="apertura:if_hz")
    dataset: FileName | None = Field(None, alias="core:dataset")
    trailing_bytes: Count = Field(0, alias="core:trailing_bytes")


class Capture(BaseModel):
    """One of the captures array."""

    start: Count = Field(alias="core:sample_start")
    datetime: str = Field(alias="core:datetime", pattern="Z$")
    frequency_hz: Frequency | None = Field(None, alias="core:frequency")
    header_bytes: Count = Field(0, alias="core:header_bytes")
    frame: int = Field(-1, alias="apertura:frame", ge=-1, lt=1 << 62, strict=True)


_SOME_CAPTURES = TypeAdapter(list[Capture])


class StatedCaptures(NamedTuple):
    """What the metadata say of the captures, (capture,) each."""

    start: NDArray[np.int64]
    time: NDArray[np.datetime64]
    frequency_hz: NDArray[np.float64]  # NaN where not stated
    header_bytes: NDArray[np.int64]
    frame: NDArray[np.int64]


def read_meta(path: Path) -> tuple[Global, StatedCaptures]:
    """Return the metadata of a recording.

    A long flight has some hundred thousand captures: no more than a few thousand of their objects are held at a time.

    Raises
    ------
    CampaignError
        If they are not SigMF.
    """
    with _opened(path) as stream:
        header = _read_global(stream, path)
        captures = _read_captures(ijson.items(_from_start(stream), "captures.item", use_float=True), path)
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
    return of_sigmf(TypeAdapter(Global), document, path, "global")


def _from_start(stream: BinaryIO) -> BinaryIO:
    """Return a stream at its beginning, behind its byte-order mark."""
    stream.seek(0)
    stream.seek(len(BOM_UTF8) if stream.read(len(BOM_UTF8)) == BOM_UTF8 else 0)
    return stream


def _read_captures(documents: Iterator[object], path: Path) -> StatedCaptures:
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
