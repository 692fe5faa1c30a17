"""Samples in a recorder's file: their layout, mixing of real samples to baseband, and reading in bounded blocks."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.atomic import naming
from apertura.common.errors import CampaignError
from apertura.core.echo.captures import ordered

# ---- Real samples at an intermediate frequency to complex baseband --------------------------------------------------

SETTLING = 63
"""Half length of the filter in samples; at both ends of a capture, this number of samples is invalid."""

EDGE = 0.025
"""Minimum distance of a band from the edges of its Nyquist zone for 80 dB image rejection, in sample rates."""

_KAISER = 8.0


@dataclass(frozen=True)
class Mixing:
    """Mixing of real samples x to baseband: s = (x + j·H{x})·exp(-j2π·if_hz·n/f_s), with H the Hilbert transform.

    Attributes
    ----------
    if_hz
        Intermediate frequency: position of zero baseband frequency before aliasing; negative if the mixer inverts the
        spectrum.
    sample_rate_hz
        Real samples per second, equal to the complex samples per second after mixing.
    restarts
        True: the phase is zero (n = 0) at the first sample of every capture; False: at the first sample of the file.

    Notes
    -----
    Source: docs/theory/recordings.md, eq. 1 and 2.
    """

    if_hz: float
    sample_rate_hz: float
    restarts: bool

    @property
    def alias_hz(self) -> float:
        """Intermediate frequency after aliasing, -f_s/2 to f_s/2."""
        half = self.sample_rate_hz / 2
        return (self.if_hz + half) % self.sample_rate_hz - half

    def baseband(self, real: NDArray[np.int16 | np.float32], first: int = 0) -> NDArray[np.float32]:
        """Convert blocks of real samples to I and Q; `SETTLING` samples at both ends are invalid.

        Parameters
        ----------
        real
            (block, sample, channel).
        first
            Number n of the first sample.

        Returns
        -------
        ndarray
            (block, sample, channel, 2) float32.

        Examples
        --------
        >>> tone = np.cos(2 * np.pi * 0.3 * np.arange(400))[None, :, None]
        >>> Mixing(0.25, 1.0, restarts=True).baseband(tone)[0, 205, 0].round(4)  # exp(j2π·0.05·205)
        array([0., 1.], dtype=float32)
        """
        from scipy.signal import oaconvolve

        if not real.shape[0] * real.shape[1]:
            return np.zeros((*real.shape, 2), np.float32)
        x = real.astype(np.float64)
        side = 1.0 if self.alias_hz >= 0 else -1.0
        quadrature = oaconvolve(x, _hilbert()[None, :, None], mode="full", axes=1)[:, SETTLING : SETTLING + x.shape[1]]
        cycles = self.if_hz / self.sample_rate_hz * (first + np.arange(x.shape[1]))
        mixed = (x + 1j * side * quadrature) * np.exp(-2j * np.pi * (cycles % 1.0))[None, :, None]
        return np.asarray(mixed.astype(np.complex64)[..., None].view(np.float32))

    def problem(self, lowest_hz: float, highest_hz: float, prefix_samples: int) -> str | None:
        """Return the reason why a band cannot be extracted from these samples; None if it can be extracted.

        Parameters
        ----------
        lowest_hz, highest_hz
            Edges of the band at baseband.
        prefix_samples
            Samples at the start of each capture that are not used for measurements.

        Examples
        --------
        >>> Mixing(20e6, 64e6, restarts=True).problem(0.0, 16e6, 100)
        'the band of 20 to 36 MHz, sampled at 64 MHz, is within 1.6 MHz of the edge of a Nyquist zone, or crosses it'
        """
        rate = self.sample_rate_hz
        low, high = self.if_hz + lowest_hz, self.if_hz + highest_hz
        zone = np.floor(2 * self.if_hz / rate)
        inside = low >= (zone / 2 + EDGE) * rate and high <= (zone / 2 + 0.5 - EDGE) * rate
        if not inside:
            return (
                f"the band of {low / 1e6:g} to {high / 1e6:g} MHz, sampled at {rate / 1e6:g} MHz, is within "
                f"{EDGE * rate / 1e6:g} MHz of the edge of a Nyquist zone, or crosses it"
            )
        if self.restarts and prefix_samples < SETTLING:
            return f"a prefix of {prefix_samples} samples; the filter requires {SETTLING} samples to settle"
        return None


@cache
def _hilbert() -> NDArray[np.float64]:
    """Return the taps of H, (2·SETTLING+1,): 2/(πk) for odd k, with a Kaiser window."""
    k = np.arange(-SETTLING, SETTLING + 1)
    taps = np.zeros(k.size)
    odd = k % 2 == 1
    taps[odd] = 2 / (np.pi * k[odd])
    return np.asarray(taps * np.kaiser(k.size, _KAISER))


# ---- Layout of the samples in a file --------------------------------------------------------------------------------

Samples = NDArray[np.int16 | np.float32]
"""(…, 2), I and Q: integers of up to 16 bits as int16, all others as float32."""

_DATATYPE = re.compile(r"([cr])(?:([iu]8)|([iu](?:16|32)|f(?:16|32|64))_([lb])e)", re.ASCII)

DATATYPES = "ci16_le: c or r (complex, real); i8, u8, or i16, u16, i32, u32, f16, f32, f64 with _le or _be"
"""Supported datatypes, for messages."""

_EXAMINED_BYTES = 1 << 16
# plausible floats: minimum number of non-zero and of distinct values, limit and minimum fraction of usual magnitudes
_FEWEST, _DISTINCT, _TINIEST, _USUAL = 256, 32, 1e-12, 0.999
_HALF = 0.45

_LARGEST = np.float64(1e15)  # largest float accepted; sums of squares stay within float32


def _none() -> NDArray[np.int64]:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class SampleLayout:
    """Layout of samples in a file.

    Attributes
    ----------
    datatype
        SigMF datatype.
    trailing_bytes
        Bytes at the end of the file that are not samples.
    segment_start, skipped_bytes
        (segment,) int64: first sample after bytes that are not samples, ascending, and the total number of such bytes
        before this sample in the file; empty if all bytes are samples.
    mixing
        Mixing of real samples; None: complex samples.

    Examples
    --------
    >>> SampleLayout("ri16_be").stored, SampleLayout("ri16_be").components
    (dtype('>i2'), 1)
    """

    datatype: str = "ci16_le"
    trailing_bytes: int = 0
    segment_start: NDArray[np.int64] = field(default_factory=_none)
    skipped_bytes: NDArray[np.int64] = field(default_factory=_none)
    mixing: Mixing | None = None

    @cached_property
    def stored(self) -> np.dtype[Any]:
        """NumPy dtype of a number in the file; ValueError if the datatype is not supported."""
        match = _DATATYPE.fullmatch(self.datatype)
        if match is None:
            raise ValueError(f"datatype {self.datatype} is not supported")
        kind, order = match[2] or match[3], "<" if match[4] == "l" else ">"
        return np.dtype(f"{order if match[4] else '|'}{kind[0]}{int(kind[1:]) // 8}")

    @property
    def components(self) -> int:
        """Numbers per sample of a channel: 2 for I and Q, 1 for real samples."""
        return 2 if self.datatype.startswith("c") else 1

    def numbers(self, data: NDArray[np.uint8]) -> Samples:
        """Convert the bytes of a file to a flat array: int16 for integers of up to 16 bits, otherwise float32.

        The zero level of unsigned integers is half their range, such as 128 for u8. Integers of 32 bits are rounded to
        24 bits.

        Raises
        ------
        ValueError
            If a float is not finite or exceeds 1e15; the second argument of the error is the index of the first one.
        """
        stored = data.view(self.stored)
        if stored.dtype.kind == "u":
            stored = stored - np.float64(1 << 8 * stored.itemsize - 1)
        elif stored.dtype.kind == "f":
            with np.errstate(invalid="ignore"):  # signalling NaN
                good = np.abs(stored) <= _LARGEST  # false for NaN
            if not good.all():
                raise ValueError("not finite or exceeds 1e15", int(np.argmin(good)))
        if self.stored.kind in "iu" and self.stored.itemsize <= 2:
            return stored.astype(np.int16, copy=False)
        return stored.astype(np.float32, copy=False)

    def kept(self) -> tuple[dict[str, Any], dict[str, xr.Variable]]:
        """Return the layout as attributes and variables of the `raw` stage, see `of`."""
        attributes = {
            "datatype": self.datatype,
            "trailing_bytes": self.trailing_bytes,
            "mixing": None if self.mixing is None else asdict(self.mixing),
        }
        segments = {"segment_start": self.segment_start, "segment_skipped": self.skipped_bytes}
        return attributes, {name: xr.Variable("segment", values) for name, values in segments.items() if values.size}

    @classmethod
    def of(cls, raw: xr.Dataset) -> "SampleLayout":
        """Restore the layout from a `raw` stage."""
        start, skipped = (raw[name].values if name in raw else _none() for name in ("segment_start", "segment_skipped"))
        parameters = raw.attrs["mixing"]
        mixing = None if parameters is None else Mixing(**parameters)
        return cls(raw.attrs["datatype"], raw.attrs["trailing_bytes"], start, skipped, mixing)


# ---- Samples of a file, read in bounded blocks ----------------------------------------------------------------------
#
# Files are read, not memory-mapped: pages of a mapped file count as memory of the process, and truncation of a mapped
# file crashes the process instead of raising an error.

Spans = Sequence[tuple[int, int]]
"""First sample of each span, and the sample after the span."""


def _are_samples(numbers: NDArray[np.floating[Any]]) -> bool:
    """Return True if floats are plausible samples: finite, with several values of usual magnitude, or 0."""
    with np.errstate(invalid="ignore"):  # signalling NaN
        magnitude = np.abs(numbers[numbers != 0].astype(np.float64))
    if magnitude.size < _FEWEST or not np.isfinite(magnitude).all() or np.unique(magnitude).size <= _DISTINCT:
        return False
    return bool(np.mean((magnitude > _TINIEST) & (magnitude < 1 / _TINIEST)) > _USUAL)


@dataclass(frozen=True)
class SampleFile:
    """File of I and Q samples of a recording, channels interleaved per sample.

    Attributes
    ----------
    path
        The file.
    channels
        Number of channels.
    layout
        Layout of the samples.
    """

    path: Path
    channels: int
    layout: SampleLayout = field(default_factory=SampleLayout, compare=False)

    @cached_property
    def sample_bytes(self) -> int:
        """Bytes of one sample of all channels; cached because it is used for every capture."""
        return self.channels * self.layout.components * self.layout.stored.itemsize

    @property
    def other_bytes(self) -> int:
        """Bytes of the file that are not samples."""
        return int(self.layout.skipped_bytes[-1:].sum()) + self.layout.trailing_bytes

    def __len__(self) -> int:
        """Return the number of samples per channel in the file at present."""
        with naming(self.path):
            return max(0, self.path.stat().st_size - self.other_bytes) // self.sample_bytes

    def read(self, first: int, last: int) -> Samples:
        """Read samples from `first` up to but excluding `last`, (sample, channel, 2).

        Raises
        ------
        CampaignError
            If the file ends before `last`, or contains a float that is not finite.

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
        padded_first, padded_last = max(0, first - SETTLING), min(len(self), last + SETTLING)
        real = self._read([(padded_first, max(last, padded_last))]).reshape(1, -1, self.channels)
        return mixing.baseband(real, padded_first)[0, first - padded_first : last - padded_first]

    def floats_among_counts(self, first: int) -> str | None:
        """Detect floats in a file whose layout declares integers; return their datatype, such as f32_le, or None.

        Integer samples interpreted as floats are NaN or of implausible magnitude; actual floats are finite and within a
        few orders of magnitude.

        Parameters
        ----------
        first
            First sample of the examined block.
        """
        if self.layout.stored.kind == "f":
            return None
        offset, size = next(self._pieces(first, len(self)), (0, 0))
        with naming(self.path), self.path.open("rb") as stream:
            stream.seek(offset)
            data = stream.read(min(size, _EXAMINED_BYTES))
        data = data[: len(data) // 8 * 8]
        plausible = [kind for kind in ("<f4", ">f4", "<f8", ">f8") if _are_samples(np.frombuffer(data, kind))]
        if not plausible:
            return None
        # float64 numbers with few digits resemble float32 numbers that alternate with zeros
        are_doubles = np.mean(np.frombuffer(data, "<u4") == 0) > _HALF
        kind = np.dtype(next((kind for kind in plausible if kind.endswith("8") == bool(are_doubles)), plausible[0]))
        return f"f{8 * kind.itemsize}_{'b' if kind.str.startswith('>') else 'l'}e"

    def captures(self, start: NDArray[np.int64], length: int) -> Samples:
        """Read captures of `length` samples from `start` on, (pulse, sample, channel, 2).

        Parameters
        ----------
        start
            (pulse,) int64: first sample of each capture, ascending.
        length
            Samples in each capture.
        """
        mixing = self.layout.mixing
        if mixing is None:
            return self._stretches(start, length).reshape(len(start), length, self.channels, 2)
        if not mixing.restarts:
            return np.stack([self.read(first, first + length) for first in start.tolist()])
        longer = length + SETTLING
        real = self._stretches(start, longer).reshape(len(start), longer, self.channels)
        return mixing.baseband(real)[:, :length]

    def _stretches(self, start: NDArray[np.int64], length: int) -> Samples:
        """Read the numbers of blocks of equal length."""
        first, last = int(start[0]), int(start[-1]) + length
        if last - first == length * len(start) and (np.diff(start) == length).all():
            return self._read([(first, last)])
        return self._read([(start_sample, start_sample + length) for start_sample in start.tolist()])

    def _read(self, spans: Spans) -> Samples:
        """Read the numbers of spans of samples, concatenated."""
        data = np.empty(sum(last - first for first, last in spans) * self.sample_bytes, np.uint8)
        with naming(self.path), self.path.open("rb", buffering=0) as stream:
            unfilled = memoryview(data.data)
            for first, last in spans:
                for offset, size in self._pieces(first, last):
                    stream.seek(offset)
                    while size:
                        count = stream.readinto(unfilled[:size])
                        if not count:
                            raise self._truncated(last)
                        size, unfilled = size - count, unfilled[count:]  # noqa: PLW2901
        try:
            return self.layout.numbers(data)
        except ValueError as error:
            reason, index = error.args
            raise self._invalid_sample(
                reason, spans, index * self.layout.stored.itemsize // self.sample_bytes
            ) from error

    def _pieces(self, first: int, last: int) -> Iterator[tuple[int, int]]:
        """Yield file offset and size in bytes of a span of samples, split at bytes that are not samples."""
        starts, skipped = self.layout.segment_start, self.layout.skipped_bytes
        if not starts.size:
            yield first * self.sample_bytes, (last - first) * self.sample_bytes
            return
        inner = starts[np.searchsorted(starts, first, "right") : np.searchsorted(starts, last)].tolist()
        for start, stop in zip([first, *inner], [*inner, last], strict=True):
            segment = int(np.searchsorted(starts, start, "right")) - 1
            before = int(skipped[segment]) if segment >= 0 else 0
            yield start * self.sample_bytes + before, (stop - start) * self.sample_bytes

    def _invalid_sample(self, reason: str, spans: Spans, index: int) -> CampaignError:
        sample = index
        for first, last in spans:
            if index < last - first:
                sample = first + index
                break
            index -= last - first
        return CampaignError(
            f"sample {sample} is {reason}",
            self.path,
            f"finite numbers of datatype {self.layout.datatype}",
            "Record or copy again, or correct core:datatype.",
        )

    def _truncated(self, last: int) -> CampaignError:
        return CampaignError(
            f"the file ends at sample {len(self)}, truncated while it was read",
            self.path,
            f"at least {last} samples",
            "The file was truncated or is being copied; copy it again and run the workflow again.",
        )

    def channel(self, index: int, order: str = "complex") -> "ChannelOfFile":
        """Return a channel that is read by slicing, with I and Q in the given order (see `ordered`)."""
        return ChannelOfFile(self, index, order)


@dataclass(frozen=True)
class ChannelOfFile:
    """Channel of a sample file; its slices are arrays, (sample, 2)."""

    file: SampleFile
    index: int
    order: str = "complex"

    def __len__(self) -> int:
        return len(self.file)

    def __getitem__(self, span: slice) -> Samples:
        first, last, _ = span.indices(len(self))
        return np.ascontiguousarray(ordered(self.file.read(first, max(first, last))[:, self.index], self.order))
