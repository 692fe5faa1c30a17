"""What every recorder's files become: memory-mapped samples, captures in UTC, and what was sent before each symbol."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.errors import CampaignError


@dataclass(frozen=True)
class Captures:
    """Segments of a recording.

    Attributes
    ----------
    start
        (capture,) int64, first sample.
    length
        Samples of each.
    time
        (capture,) datetime64[ns], UTC time tag of the first sample.
    frame
        (capture,) int64, frame number, -1 without.
    """

    start: NDArray[np.int64]
    length: int
    time: NDArray[np.datetime64]
    frame: NDArray[np.int64]


@dataclass(frozen=True)
class Recording:
    """An opened recording.

    Attributes
    ----------
    samples
        (sample, channel, 2) int16 I and Q, memory-mapped.
    sample_rate_hz, frequency_hz
        Complex samples per second and RF frequency at baseband zero.
    captures
        As the recorder was triggered; one, of all samples, if it ran through.
    framing
        What was sent before each symbol, where the recorder ran through; else None.
    files
        Metadata first, samples last, for messages and hashes; one file may hold both.
    sha512
        Of the file of samples as the recorder stated it.
    """

    samples: NDArray[np.int16]
    channels: list[str]
    sample_rate_hz: float
    frequency_hz: float
    captures: Captures
    framing: Mapping[str, Any] | None
    files: tuple[Path, ...]
    sha512: str | None

    def captures_at(self, start: NDArray[np.int64], length: int, frame: NDArray[np.int64]) -> Captures:
        """Return captures of a recording that never stopped, timed by their first samples."""
        elapsed = np.round(start / self.sample_rate_hz * 1e9).astype(np.int64).astype("timedelta64[ns]")
        return Captures(start, length, self.captures.time[0] + elapsed, frame)

    def check_hash(self) -> None:
        """Raise CampaignError unless the samples are those that the recorder hashed."""
        if self.sha512 is None:
            return
        with self.files[-1].open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha512").hexdigest()
        if digest != self.sha512:
            raise CampaignError(
                f"sha512 {digest[:12]}…",
                self.files[-1],
                f"{self.sha512[:12]}… (core:sha512 of the metadata)",
                "The data were changed or damaged; copy them again.",
            )

    def cut(self, captures: Captures, *, node: str) -> xr.Dataset:
        """Return the `raw` stage of some captures of a node: iq, int16 counts, with UTC time and frame of each pulse.

        Raises
        ------
        CampaignError
            If a capture holds only zeros.
        """
        iq = np.stack([self.samples[start : start + captures.length] for start in captures.start])
        for index, name in enumerate(self.channels):
            dead = np.flatnonzero(~iq[:, :, index].any(axis=(1, 2)))
            if dead.size:
                raise CampaignError(
                    f"{dead.size} captures of channel {name} hold only zeros, first capture {int(dead[0])}",
                    self.files[-1],
                    "samples",
                    "The receiver or the copy failed; record or copy again, or remove those captures.",
                )
        return xr.Dataset(
            {
                "iq": (("channel", "pulse", "sample", "component"), np.moveaxis(iq, 2, 0)),
                "time": ("pulse", captures.time),
                "frame": ("pulse", captures.frame),
            },
            attrs={
                "node": node,
                "channels": self.channels,
                "sample_rate_hz": self.sample_rate_hz,
                "frequency_hz": self.frequency_hz,
            },
        )
