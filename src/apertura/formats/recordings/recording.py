"""Recordings of any recorder: samples, captures with UTC time tags, and framing of the transmitted symbols."""

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
_FIRST = 16  # samples compared first, so that few captures are read completely to detect empty or repeated captures


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
        """Find captures that are bit-identical to an earlier capture, which noise would prevent; (capture,) bool.

        Captures whose first samples are unique are not read further.

        Raises
        ------
        CampaignError
            If a capture contains only zeros.
        """
        start, head = captures.start, min(_FIRST, captures.length)
        zero_blocks, candidates = list[NDArray[np.bool_]](), dict[bytes, list[int]]()
        for first in range(0, len(start), _AT_ONCE):
            block = start[first : first + _AT_ONCE]
            heads = self.samples.captures(block, head)
            for number, samples in enumerate(heads, first):
                candidates.setdefault(samples.tobytes(), []).append(number)
            is_zero = np.asarray(~heads.any(axis=(1, 3)))
            for capture in np.flatnonzero(is_zero.any(axis=1)):
                is_zero[capture] = ~self.samples.captures(block[capture : capture + 1], captures.length).any(
                    axis=(0, 1, 3)
                )
            zero_blocks.append(is_zero)
        for name, is_zero in zip(self.channels, np.concatenate(zero_blocks).T, strict=True):
            if is_zero.any():
                raise CampaignError(
                    f"{is_zero.sum()} captures of channel {name} contain only zeros, first capture "
                    f"{int(is_zero.argmax())}",
                    self.files[-1],
                    "non-zero samples",
                    "The receiver or the copy failed; record or copy again, or remove those captures.",
                )
        repeats = np.zeros(len(start), bool)
        for numbers in candidates.values():
            known = set[bytes]()
            for number in numbers if len(numbers) > 1 else ():
                content = self.samples.captures(start[number : number + 1], captures.length).tobytes()
                digest = hashlib.blake2b(content, digest_size=16).digest()
                repeats[number] = digest in known
                known.add(digest)
        return repeats
