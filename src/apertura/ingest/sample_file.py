"""Samples in a recorder's file, read where they are wanted, a bounded number at a time.

They are read and not mapped: pages of a mapped file count as memory of the process, and a file that is cut short
meanwhile ends the process instead of raising an error.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.atomic import naming
from apertura.errors import CampaignError

_COUNT = np.dtype("<i2")
_COMPONENTS = 2  # I and Q


@dataclass(frozen=True)
class SampleFile:
    """I and Q counts of a recording, channels interleaved per sample.

    Attributes
    ----------
    path
        The file.
    channels
        How many.
    """

    path: Path
    channels: int

    @property
    def sample_bytes(self) -> int:
        """Bytes of one sample of all channels."""
        return self.channels * _COMPONENTS * _COUNT.itemsize

    def __len__(self) -> int:
        """Return the samples of each channel in the file as it is now."""
        with naming(self.path):
            return self.path.stat().st_size // self.sample_bytes

    def read(self, first: int, last: int) -> NDArray[np.int16]:
        """Return samples `first` to `last`, (sample, channel, 2) int16.

        Raises
        ------
        CampaignError
            If the file ends before.

        Examples
        --------
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     np.arange(12, dtype="<i2").tofile(Path(folder) / "iq")
        ...     SampleFile(Path(folder) / "iq", channels=2).read(1, 3)[:, 0].tolist()
        [[4, 5], [8, 9]]
        """
        return self._read([(first, last)]).reshape(-1, self.channels, _COMPONENTS)

    def captures(self, start: NDArray[np.int64], length: int) -> NDArray[np.int16]:
        """Return some captures, each of `length` samples from its `start` on, (pulse, sample, channel, 2) int16.

        Parameters
        ----------
        start
            (pulse,) int64, first sample of each, ascending.
        length
            Samples of each.
        """
        shape = len(start), length, self.channels, _COMPONENTS
        first, last = int(start[0]), int(start[-1]) + length
        if last - first == length * len(start) and (np.diff(start) == length).all():
            return self._read([(first, last)]).reshape(shape)
        return self._read([(one, one + length) for one in start.tolist()]).reshape(shape)

    def _read(self, spans: list[tuple[int, int]]) -> NDArray[np.int16]:
        """Return the counts of some spans of samples, one after the other."""
        counts = np.empty(sum(last - first for first, last in spans) * self.sample_bytes, np.uint8)
        with naming(self.path), self.path.open("rb", buffering=0) as stream:
            filled = memoryview(counts.data)
            for first, last in spans:
                size = (last - first) * self.sample_bytes
                stream.seek(first * self.sample_bytes)
                while size:
                    count = stream.readinto(filled[:size])
                    if not count:
                        raise self._cut_short(last)
                    size, filled = size - count, filled[count:]
        return counts.view(_COUNT)

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
    """One channel of a file of samples; slices of it are arrays, (sample, 2) int16."""

    file: SampleFile
    index: int

    def __len__(self) -> int:
        return len(self.file)

    def __getitem__(self, span: slice) -> NDArray[np.int16]:
        first, last, _ = span.indices(len(self))
        return np.ascontiguousarray(self.file.read(first, max(first, last))[:, self.index])
