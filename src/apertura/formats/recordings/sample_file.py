"""Samples in a recorder's file, read where they are wanted, a bounded number at a time.

They are read and not mapped: pages of a mapped file count as memory of the process, and a file that is cut short
meanwhile ends the process instead of raising an error.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.common.atomic import naming
from apertura.common.errors import CampaignError
from apertura.formats.recordings.real_samples import SETTLING
from apertura.formats.recordings.sample_layout import SampleLayout, Samples

Spans = Sequence[tuple[int, int]]
"""First sample, and that behind the last."""


@dataclass(frozen=True)
class SampleFile:
    """I and Q of a recording, channels interleaved per sample.

    Attributes
    ----------
    path
        The file.
    channels
        How many.
    layout
        How samples lie in it.
    """

    path: Path
    channels: int
    layout: SampleLayout = field(default_factory=SampleLayout, compare=False)

    @property
    def sample_bytes(self) -> int:
        """Bytes of one sample of all channels."""
        return self.channels * self.layout.components * self.layout.stored.itemsize

    @property
    def other_bytes(self) -> int:
        """Bytes of the file that are no samples."""
        return int(self.layout.skipped_bytes[-1:].sum()) + self.layout.trailing_bytes

    def __len__(self) -> int:
        """Return the samples of each channel in the file as it is now."""
        with naming(self.path):
            return max(0, self.path.stat().st_size - self.other_bytes) // self.sample_bytes

    def read(self, first: int, last: int) -> Samples:
        """Return samples `first` to `last`, (sample, channel, 2).

        Raises
        ------
        CampaignError
            If the file ends before, or holds a float that is not finite.

        Examples
        --------
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     np.arange(12, dtype="<i2").tofile(Path(folder) / "iq")
        ...     SampleFile(Path(folder) / "iq", channels=2).read(1, 3)[:, 0].tolist()
        [[4, 5], [8, 9]]
        """
        mixing = self.layout.mixing
        if mixing is None:
            return self._read([(first, last)]).reshape(-1, self.channels, 2)
        begun, ended = max(0, first - SETTLING), min(len(self), last + SETTLING)
        real = self._read([(begun, max(last, ended))]).reshape(1, -1, self.channels)
        return mixing.baseband(real, begun)[0, first - begun : last - begun]

    def captures(self, start: NDArray[np.int64], length: int) -> Samples:
        """Return some captures, each of `length` samples from its `start` on, (pulse, sample, channel, 2).

        Parameters
        ----------
        start
            (pulse,) int64, first sample of each, ascending.
        length
            Samples of each.
        """
        mixing = self.layout.mixing
        if mixing is None:
            return self._stretches(start, length).reshape(len(start), length, self.channels, 2)
        if not mixing.restarts:
            return np.stack([self.read(one, one + length) for one in start.tolist()])
        longer = length + SETTLING
        real = self._stretches(start, longer).reshape(len(start), longer, self.channels)
        return mixing.baseband(real)[:, :length]

    def _stretches(self, start: NDArray[np.int64], length: int) -> Samples:
        """Return the numbers of stretches of one length."""
        first, last = int(start[0]), int(start[-1]) + length
        if last - first == length * len(start) and (np.diff(start) == length).all():
            return self._read([(first, last)])
        return self._read([(one, one + length) for one in start.tolist()])

    def _read(self, spans: Spans) -> Samples:
        """Return the numbers of some spans of samples, one after the other."""
        data = np.empty(sum(last - first for first, last in spans) * self.sample_bytes, np.uint8)
        with naming(self.path), self.path.open("rb", buffering=0) as stream:
            filled = memoryview(data.data)
            for first, last in spans:
                for place, size in self._pieces(first, last):
                    stream.seek(place)
                    while size:
                        count = stream.readinto(filled[:size])
                        if not count:
                            raise self._cut_short(last)
                        size, filled = size - count, filled[count:]  # noqa: PLW2901
        try:
            return self.layout.numbers(data)
        except ValueError as error:
            why, index = error.args
            raise self._no_number(why, spans, index * self.layout.stored.itemsize // self.sample_bytes) from error

    def _pieces(self, first: int, last: int) -> Iterator[tuple[int, int]]:
        """Yield place and size of the bytes of a span of samples, in parts where other bytes lie between them."""
        starts, skipped = self.layout.segment_start, self.layout.skipped_bytes
        if not starts.size:
            yield first * self.sample_bytes, (last - first) * self.sample_bytes
            return
        inner = starts[np.searchsorted(starts, first, "right") : np.searchsorted(starts, last)].tolist()
        for begun, ended in zip([first, *inner], [*inner, last], strict=True):
            segment = int(np.searchsorted(starts, begun, "right")) - 1
            before = int(skipped[segment]) if segment >= 0 else 0
            yield begun * self.sample_bytes + before, (ended - begun) * self.sample_bytes

    def _no_number(self, why: str, spans: Spans, index: int) -> CampaignError:
        sample = index
        for first, last in spans:
            if index < last - first:
                sample = first + index
                break
            index -= last - first
        return CampaignError(
            f"sample {sample} is {why}",
            self.path,
            f"finite numbers of datatype {self.layout.datatype}",
            "Record or copy again, or correct core:datatype.",
        )

    def _cut_short(self, last: int) -> CampaignError:
        return CampaignError(
            f"ends at sample {len(self)}, while it is read",
            self.path,
            f"at least {last} samples, as there were",
            "The file was cut short or is being copied; copy it again and run the workflow again.",
        )

    def channel(self, index: int) -> "ChannelOfFile":
        """Return one channel, to be read by slices."""
        return ChannelOfFile(self, index)


@dataclass(frozen=True)
class ChannelOfFile:
    """One channel of a file of samples; slices of it are arrays, (sample, 2)."""

    file: SampleFile
    index: int

    def __len__(self) -> int:
        return len(self.file)

    def __getitem__(self, span: slice) -> Samples:
        first, last, _ = span.indices(len(self))
        return np.ascontiguousarray(self.file.read(first, max(first, last))[:, self.index])
