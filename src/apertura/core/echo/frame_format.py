"""Format of the frames that the symbols of a pulse carry: header, counter, data and check sum.

Source: docs/theory/data_symbols.md, "Frames"; check sum: ITU-T V.41 polynomial with initial value 0xFFFF (CRC-16).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.core.echo.constellation import Constellation, Labels

Bits = NDArray[np.uint8]

CRC_BITS = 16
_POLYNOMIAL = 0x1021  # x¹⁶ + x¹² + x⁵ + 1
_START = 0xFFFF
_AT_ENDS = 9  # frames at each end of a recording, whose median counter is used


@dataclass(frozen=True, eq=False)
class FrameFormat:
    """Format of a frame: header, counter, data, check sum, most significant bits first.

    Attributes
    ----------
    header
        (bit,) uint8, known bits at the start of each frame.
    counter_bits
        Length of the frame counter that follows.
    crc
        True if the last 16 bits are the check sum of counter and data.
    total_bits
        Length of the frame: data symbols of a pulse times bits per symbol.

    Examples
    --------
    >>> frames = FrameFormat(np.array([1, 0, 1, 1], np.uint8), 8, True, 64)
    >>> sent = frames.bits(np.array([7, 8]), np.ones((2, 36), np.uint8))
    >>> sent[0, :12].tolist()
    [1, 0, 1, 1, 0, 0, 0, 0, 0, 1, 1, 1]
    >>> sent[1, 20] ^= 1
    >>> received = frames.parsed(sent)
    >>> received.counter.tolist(), received.intact.tolist()
    ([7, 8], [True, False])
    """

    header: Bits
    counter_bits: int
    crc: bool
    total_bits: int

    @property
    def data_bits(self) -> int:
        """Number of data bits of a frame; negative if header, counter and check sum are too long."""
        return self.total_bits - self.header.size - self.counter_bits - CRC_BITS * self.crc

    def known_labels(self, constellation: Constellation) -> Labels:
        """Return the labels of the first data symbols, whose bits are all in the header."""
        whole = self.header.size // constellation.bits_per_symbol * constellation.bits_per_symbol
        return constellation.labels(self.header[:whole])

    def bits(self, counter: NDArray[np.int64], data: Bits) -> Bits:
        """Return the bits of frames, (frame, bit) uint8, from counters, (frame,), and data, (frame, bit)."""
        shifts = np.arange(self.counter_bits - 1, -1, -1)
        counted = (np.asarray(counter)[:, None] >> shifts & 1).astype(np.uint8)
        checked = np.concatenate([counted, data], axis=1)
        header = np.broadcast_to(self.header, (len(checked), self.header.size))
        parts = [header, checked, self._crc(checked)] if self.crc else [header, checked]
        return np.concatenate(parts, axis=1)

    def parsed(self, bits: Bits) -> "Frames":
        """Return the fields of received frames, (frame, bit) uint8."""
        start, stop = self.header.size, self.total_bits - CRC_BITS * self.crc
        weights = 1 << np.arange(self.counter_bits - 1, -1, -1)
        counter = bits[:, start : start + self.counter_bits].astype(np.int64) @ weights
        wrong = (bits[:, :start] != self.header).sum(1)
        intact = wrong == 0
        if self.crc:
            intact &= (self._crc(bits[:, start:stop]) == bits[:, stop:]).all(1)
        return Frames(counter, bits[:, start + self.counter_bits : stop], wrong, intact)

    def _crc(self, bits: Bits) -> Bits:
        """Return the check sums of rows of bits, (frame, 16): an affine function of the bits over GF(2)."""
        matrix, offset = self._check
        return ((bits.astype(np.float32) @ matrix + offset) % 2).astype(np.uint8)

    @cached_property
    def _check(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Matrix (bit, 16) of the contributions of the bits to the check sum, and contribution of the start value."""
        count = self.counter_bits + self.data_bits
        shifts = np.arange(CRC_BITS - 1, -1, -1)
        register, rows = _POLYNOMIAL, []
        for _ in range(count):  # the last bit first: a bit k places before the end contributes x^(k + 16)
            rows.append(register)
            register = _next(register)
        start = _START
        for _ in range(count):
            start = _next(start)
        matrix = (np.array(rows[::-1])[:, None] >> shifts & 1).astype(np.float32)
        return matrix, (start >> shifts & 1).astype(np.float32)


def _next(register: int) -> int:
    """Return a register of the check sum after a further bit 0."""
    shifted = register << 1
    return (shifted ^ _POLYNOMIAL) & 0xFFFF if shifted >> CRC_BITS else shifted


@dataclass(frozen=True, eq=False)
class Frames:
    """Fields of received frames.

    Attributes
    ----------
    counter
        (frame,) int64.
    data
        (frame, bit) uint8.
    header_errors
        (frame,) number of wrong bits of the header.
    intact
        (frame,) bool, True if the header is right and the check sum, if there is one, agrees.
    """

    counter: NDArray[np.int64]
    data: Bits
    header_errors: NDArray[np.intp]
    intact: NDArray[np.bool_]


@dataclass(frozen=True)
class FrameCount:
    """Frames sent during a recording, by time tags and counter.

    Attributes
    ----------
    sent
        Number of frames sent from the first to the last capture.
    steps, agreeing
        Number of pairs of consecutive intact frames, and of those whose counters agree with the time tags.
    advance
        Median advance of the counter in a frame interval.
    """

    sent: int
    steps: int
    agreeing: int
    advance: float

    @classmethod
    def of(
        cls, counter: NDArray[np.int64], intact: NDArray[np.bool_], time_s: Floats, *, prf_hz: float, bits: int
    ) -> "FrameCount":
        """Count the frames sent during a recording (eq. 17); without a usable counter, by the time tags alone.

        Parameters
        ----------
        counter, intact
            (capture,) counter, and True for intact frames.
        time_s
            (capture,) time tags, seconds from any origin, ascending.
        prf_hz
            Frames per second.
        bits
            Length of the counter.

        Examples
        --------
        >>> counter = np.array([14, 15, 0, 3])
        >>> FrameCount.of(counter, counter >= 0, np.array([0.0, 0.1, 0.2, 0.5]), prf_hz=10, bits=4)
        FrameCount(sent=6, steps=3, agreeing=3, advance=1.0)
        """
        interval = np.concatenate([[0], np.rint(np.diff(time_s) * prf_hz)]).astype(np.int64).cumsum()
        by_time, used = int(interval[-1]) + 1, np.flatnonzero(intact)
        if used.size < 2:
            return cls(by_time, 0, 0, float("nan"))
        period, passed, counted = 1 << bits, np.diff(interval[used]), np.diff(counter[used])
        deviation = (counted - passed + period // 2) % period - period // 2
        agreeing, steps = int((deviation == 0).sum()), used.size - 1
        advance = float(np.median(counted % period / np.maximum(passed, 1)))
        if 2 * agreeing < steps:
            return cls(by_time, steps, agreeing, advance)
        drift = np.concatenate([[0], deviation.cumsum()])
        change = round(float(np.median(drift[-_AT_ENDS:]) - np.median(drift[:_AT_ENDS])))
        return cls(max(by_time + change, 1), steps, agreeing, advance)
