"""SigMF recordings: one capture segment per trigger, channels interleaved per sample."""

import hashlib
import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from sigmf.validate import validate as validate_schema

from apertura.errors import CampaignError

_BYTES_PER_SAMPLE = 4  # ci16_le: two int16


@dataclass(frozen=True)
class Recording:
    """An opened SigMF recording.

    Attributes
    ----------
    samples
        (sample, channel, 2) int16, memory-mapped.
    channels
        Names of the channels.
    meta, meta_path, data_path
        Metadata and files.
    """

    samples: NDArray[np.int16]
    channels: list[str]
    meta: dict[str, Any]
    meta_path: Path
    data_path: Path

    @property
    def sample_rate_hz(self) -> float:
        """Complex samples per second."""
        return float(self.meta["global"]["core:sample_rate"])

    @property
    def framing(self) -> dict[str, Any] | None:
        """What was sent before each symbol, where the recorder ran through instead of being triggered; else None."""
        described = self.meta["global"].get("apertura:framing")
        return dict(described) if described and len(self.meta["captures"]) == 1 else None

    def captures(self) -> "Captures":
        """Return the capture segments that the metadata describe."""
        starts, length = _segments(self.meta["captures"], len(self.samples), self.meta_path)
        numbers = np.array([capture.get("apertura:frame", -1) for capture in self.meta["captures"]], np.int64)
        return Captures(np.array(starts), length, _times(self.meta["captures"], self.meta_path), numbers)

    def captures_at(self, starts: NDArray[np.int64], length: int, frame: NDArray[np.int64]) -> "Captures":
        """Return capture segments of a recording that never stopped, timed by their first samples."""
        begun = _times(self.meta["captures"], self.meta_path)[0]
        elapsed = np.round(starts / self.sample_rate_hz * 1e9).astype(np.int64).astype("timedelta64[ns]")
        return Captures(starts, length, begun + elapsed, frame)


@dataclass(frozen=True)
class Captures:
    """Segments of a recording: first samples, one length, UTC time tags, frame numbers (-1 without)."""

    starts: NDArray[np.int64]
    length: int
    time: NDArray[np.datetime64]
    frame: NDArray[np.int64]


def read_sigmf(meta_path: Path, data_path: Path, *, node: str) -> xr.Dataset:
    """Return the `raw` stage of a triggered SigMF recording: `open_sigmf`, then `cut` at its captures."""
    recording = open_sigmf(meta_path, data_path)
    return cut(recording, recording.captures(), node=node)


def open_sigmf(meta_path: Path, data_path: Path) -> Recording:
    """Open a SigMF recording after checking its metadata, size and hash.

    Parameters
    ----------
    meta_path, data_path
        ``.sigmf-meta`` and ``.sigmf-data``, datatype ci16_le.

    Raises
    ------
    CampaignError
        If the metadata break the SigMF schema, the data are truncated, not those hashed, or a capture lies past
        their end.

    Notes
    -----
    Source: SigMF specification 1.2, section "Captures Array".
    """
    meta = _read_meta(meta_path)
    channels = _channels(meta["global"], meta_path)
    recording = Recording(_map(data_path, len(channels), meta, meta_path), channels, meta, meta_path, data_path)
    recording.captures()
    _check_hash(meta["global"], data_path)
    return recording


def cut(recording: Recording, captures: Captures, *, node: str) -> xr.Dataset:
    """Return the `raw` stage of some captures of a recording.

    Parameters
    ----------
    recording
        From `open_sigmf`.
    captures
        Where to cut.
    node
        Name of the node that recorded.

    Returns
    -------
    xarray.Dataset
        iq (channel, pulse, sample, component) int16 counts, time (pulse) UTC, frame (pulse).

    Raises
    ------
    CampaignError
        If a capture holds only zeros.
    """
    iq = np.stack([recording.samples[start : start + captures.length] for start in captures.starts])
    _check_alive(iq, recording.channels, recording.data_path)
    return xr.Dataset(
        {
            "iq": (("channel", "pulse", "sample", "component"), np.moveaxis(iq, 2, 0)),
            "time": ("pulse", captures.time),
            "frame": ("pulse", captures.frame),
        },
        attrs={
            "node": node,
            "channels": recording.channels,
            "sample_rate_hz": recording.sample_rate_hz,
            "frequency_hz": float(recording.meta["captures"][0].get("core:frequency", 0.0)),
        },
    )


def _read_meta(path: Path) -> dict[str, Any]:
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
        with warnings.catch_warnings():  # the library warns of extensions that are used but not declared
            warnings.simplefilter("ignore", DeprecationWarning)
            validate_schema(meta)
    except Exception as error:  # the library raises jsonschema's, json's and its own errors
        reason = str(getattr(error, "message", error)).splitlines()[0]
        raise CampaignError(f"not valid SigMF: {reason}", path, "SigMF metadata", "Mend it.") from error
    datatype = meta["global"]["core:datatype"]
    if datatype != "ci16_le":
        raise CampaignError(f"core:datatype {datatype}", path, "ci16_le", "Convert the recording.")
    if "core:sample_rate" not in meta["global"] or not meta["captures"]:
        raise CampaignError("no core:sample_rate or no captures", path, "both", "One capture segment per trigger.")
    return dict(meta)


def _channels(header: dict[str, Any], path: Path) -> list[str]:
    count = int(header.get("core:num_channels", 1))
    names = header.get("apertura:channels", ["radar", "sidelink"][:count])
    if len(names) != count or "radar" not in names:
        raise CampaignError(
            f"apertura:channels {names} for core:num_channels {count}",
            path,
            "one name per channel, 'radar' among them",
            "Correct the metadata.",
        )
    return list(names)


def _map(path: Path, channels: int, meta: dict[str, Any], meta_path: Path) -> NDArray[np.int16]:
    size, frame = path.stat().st_size, channels * _BYTES_PER_SAMPLE
    last = meta["captures"][-1]["core:sample_start"]
    if size % frame or size == 0:
        raise CampaignError(
            f"{size} bytes, not a whole number of {channels}-channel samples",
            path,
            f"a multiple of {frame} bytes",
            "The file is truncated; copy it again.",
        )
    if last >= size // frame:
        raise CampaignError(
            f"capture {len(meta['captures']) - 1} starts at sample {last}, the data end at {size // frame}",
            meta_path,
            f"captures inside {path.name}",
            "The data are truncated or the metadata belong to another file; copy both again.",
        )
    return np.memmap(path, np.dtype("<i2"), "r", shape=(size // frame, channels, 2))


def _segments(captures: list[dict[str, Any]], total: int, path: Path) -> tuple[list[int], int]:
    starts = [int(capture["core:sample_start"]) for capture in captures]
    lengths = np.diff([*starts, total])
    length = int(np.median(lengths))
    short = np.flatnonzero(lengths < length)
    if short.size:
        pulse = int(short[0])
        raise CampaignError(
            f"capture {pulse} holds {lengths[pulse]} samples (the data end at sample {total})",
            path,
            f"{length}, as most captures do",
            "The data are truncated (copy them again) or core:sample_start is wrong.",
        )
    return starts, length


def _check_hash(header: dict[str, Any], path: Path) -> None:
    if "core:sha512" not in header:
        return
    with path.open("rb") as stream:
        found = hashlib.file_digest(stream, "sha512").hexdigest()
    if found != header["core:sha512"]:
        raise CampaignError(
            f"sha512 {found[:12]}…",
            path,
            f"{header['core:sha512'][:12]}… (core:sha512 of the metadata)",
            "The data were changed or damaged; copy them again.",
        )


def _check_alive(iq: NDArray[np.int16], channels: list[str], path: Path) -> None:
    for index, name in enumerate(channels):
        dead = np.flatnonzero(~iq[:, :, index].any(axis=(1, 2)))
        if dead.size:
            raise CampaignError(
                f"{dead.size} captures of channel {name} hold only zeros, first capture {int(dead[0])}",
                path,
                "samples",
                "The receiver or the copy failed; record or copy again, or remove those captures.",
            )


def _times(captures: list[dict[str, Any]], path: Path) -> NDArray[np.datetime64]:
    try:
        tags = np.array([capture["core:datetime"].removesuffix("Z") for capture in captures], "datetime64[ns]")
    except (KeyError, ValueError) as error:
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
