"""Recordings of any recorder: samples, captures with UTC time tags, and framing of the transmitted symbols."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.common.provenance import hashes_of_file
from apertura.core.echo.captures import HEAD, repeated
from apertura.formats.recordings.sample_file import SampleFile

_AT_ONCE = 4096


def _sha512(path: Path) -> str:
    return hashes_of_file(path, ["sha512"])["sha512"]


@dataclass(frozen=True)
class Captures:
    """Capture segments of a recording.

    Attributes
    ----------
    start
        (capture,) int64: first sample.
    length
        Samples in each capture.
    time
        (capture,) datetime64[ns]: UTC time tag of the first sample.
    frame
        (capture,) int64: frame number; -1: none.
    """

    start: NDArray[np.int64]
    length: int
    time: NDArray[np.datetime64]
    frame: NDArray[np.int64]


@dataclass(frozen=True)
class Recording:
    """Opened recording.

    Attributes
    ----------
    samples
        File of I and Q samples.
    channels
        Names of the channels.
    sample_rate_hz, frequency_hz
        Complex samples per second, and RF frequency at zero baseband frequency.
    captures
        One capture per trigger; for a continuous recording, a single capture with all samples.
    framing
        Preamble and payload before each symbol of a continuous recording; otherwise None.
    files
        Metadata files first, sample file last, for messages and hashes; may be a single file.
    sha512
        Hash of the sample file given in the metadata of the recording; None: not given.
    """

    samples: SampleFile
    channels: list[str]
    sample_rate_hz: float
    frequency_hz: float
    captures: Captures
    framing: Mapping[str, Any] | None
    files: tuple[Path, ...]
    sha512: str | None

    def captures_at(self, start: NDArray[np.int64], length: int, frame: NDArray[np.int64]) -> Captures:
        """Return captures of a continuous recording, with times derived from their first samples."""
        elapsed = np.round(start / self.sample_rate_hz * 1e9).astype(np.int64).astype("timedelta64[ns]")
        return Captures(start, length, self.captures.time[0] + elapsed, frame)

    def check_hash(self, sha512_of: Callable[[Path], str] = _sha512) -> None:
        """Raise CampaignError if the samples do not match the hash given in the metadata of the recording."""
        if self.sha512 is None:
            return
        digest = sha512_of(self.files[-1])
        if digest != self.sha512:
            raise CampaignError(
                f"sha512 {digest[:12]}…",
                self.files[-1],
                f"{self.sha512[:12]}… (core:sha512 of the metadata)",
                "The data were changed or damaged; copy them again.",
            )

    def cut(self, captures: Captures, *, node: str) -> xr.Dataset:
        """Build the `raw` stage from captures of a node: positions in the file, UTC times and frame numbers.

        Raises
        ------
        CampaignError
            If a capture contains only zeros, or the file ends before the last capture.
        """
        repeats = self._repeats(captures)
        layout, segments = self.samples.layout.kept()
        return xr.Dataset(
            {
                **segments,
                "start": ("pulse", captures.start),
                "time": ("pulse", captures.time),
                "frame": ("pulse", captures.frame),
                "repeats": ("pulse", repeats),
            },
            attrs={
                **layout,
                "node": node,
                "samples": str(self.samples.path),
                "channels": self.channels,
                "capture_samples": captures.length,
                "sample_rate_hz": self.sample_rate_hz,
                "frequency_hz": self.frequency_hz,
            },
        )

    def _repeats(self, captures: Captures) -> NDArray[np.bool_]:
        """Return a mask of the captures that repeat an earlier one; raise CampaignError if a capture is all zeros."""
        start, zero_blocks = captures.start, list[NDArray[np.bool_]]()

        def heads() -> Iterator[NDArray[Any]]:
            for first in range(0, len(start), _AT_ONCE):
                block = start[first : first + _AT_ONCE]
                samples = self.samples.captures(block, min(HEAD, captures.length))
                is_zero = np.asarray(~samples.any(axis=(1, 3)))
                for capture in np.flatnonzero(is_zero.any(axis=1)):
                    whole = self.samples.captures(block[capture : capture + 1], captures.length)
                    is_zero[capture] = ~whole.any(axis=(0, 1, 3))
                zero_blocks.append(is_zero)
                yield from samples

        repeats = repeated(heads(), lambda number: self.samples.captures(start[number : number + 1], captures.length))
        for name, is_zero in zip(self.channels, np.concatenate(zero_blocks).T, strict=True):
            if is_zero.any():
                raise CampaignError(
                    f"{is_zero.sum()} captures of channel {name} contain only zeros, first capture "
                    f"{int(is_zero.argmax())}",
                    self.files[-1],
                    "non-zero samples",
                    "The receiver or the copy failed; record or copy again, or remove those captures.",
                )
        return repeats
