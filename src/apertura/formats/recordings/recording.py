"""Recordings, common to all recorders: samples to be read, captures in UTC, and what was sent before each symbol."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.common.provenance import hashes_of_file
from apertura.formats.recordings.sample_file import SampleFile

_AT_ONCE = 4096
_FIRST = 16  # samples of a capture that show that it is not empty, and that it repeats no other


def _sha512(path: Path) -> str:
    return hashes_of_file(path, ["sha512"])["sha512"]


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
        The file of I and Q.
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

    samples: SampleFile
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

    def check_hash(self, sha512_of: Callable[[Path], str] = _sha512) -> None:
        """Raise CampaignError unless the samples are those that the recorder hashed."""
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
        """Return the `raw` stage of some captures of a node: where they lie in the file, with UTC time and frame.

        Raises
        ------
        CampaignError
            If a capture holds only zeros, or the file ends before the last.
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
        """Find captures that repeat an earlier one bit for bit, which noise never does; (capture,) bool.

        Captures that begin like no other one are not read further.

        Raises
        ------
        CampaignError
            If a capture holds only zeros.
        """
        start, few = captures.start, min(_FIRST, captures.length)
        dead, alike = list[NDArray[np.bool_]](), dict[bytes, list[int]]()
        for first in range(0, len(start), _AT_ONCE):
            some = start[first : first + _AT_ONCE]
            beginnings = self.samples.captures(some, few)
            for number, beginning in enumerate(beginnings, first):
                alike.setdefault(beginning.tobytes(), []).append(number)
            silent = np.asarray(~beginnings.any(axis=(1, 3)))
            for capture in np.flatnonzero(silent.any(axis=1)):
                silent[capture] = ~self.samples.captures(some[capture : capture + 1], captures.length).any(
                    axis=(0, 1, 3)
                )
            dead.append(silent)
        for name, silent in zip(self.channels, np.concatenate(dead).T, strict=True):
            if silent.any():
                raise CampaignError(
                    f"{silent.sum()} captures of channel {name} hold only zeros, first capture {int(silent.argmax())}",
                    self.files[-1],
                    "samples",
                    "The receiver or the copy failed; record or copy again, or remove those captures.",
                )
        repeats = np.zeros(len(start), bool)
        for numbers in alike.values():
            known = set[bytes]()
            for number in numbers if len(numbers) > 1 else ():
                samples = self.samples.captures(start[number : number + 1], captures.length).tobytes()
                digest = hashlib.blake2b(samples, digest_size=16).digest()
                repeats[number] = digest in known
                known.add(digest)
        return repeats
