"""Code symbols of the transmitted pulses: tables by frame number, pseudo-noise tables, and frame numbers of captures.

The pulse of frame f carries row f mod F of a table of F rows. A code that is the same in all pulses is a table of one
row (docs/theory/changing_codes.md).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Complexes
from apertura.core.echo.association import unwrapped
from apertura.core.echo.constellation import constellation
from apertura.core.echo.trigger import ABSENT

Frames = NDArray[np.int64]


class Rows(Protocol):
    """(row, subcarrier) complex: an array in memory or in a file, or a generator of rows."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of rows and of subcarriers."""

    def __getitem__(self, rows: Frames, /) -> NDArray[np.complexfloating]: ...


# ---- Inverse spectra of the pulses -----------------------------------------------------------------------------------


@dataclass(eq=False)
class Inverses:
    """Inverse spectra of the transmitted pulses: the pulse of frame f has that of row f mod `count`.

    Attributes
    ----------
    count
        Number of rows.
    of_rows
        Row numbers → inverse spectra, (row, subcarrier) complex64.

    Examples
    --------
    >>> inverses = Inverses.of_codes(np.array([[1, 2], [4, 8]], np.complex64))
    >>> inverses.at(np.array([0, 1, 2])).real
    array([[1.   , 0.5  ],
           [0.25 , 0.125],
           [1.   , 0.5  ]], dtype=float32)
    """

    count: int
    of_rows: Callable[[Frames], Complexes]
    _latest: tuple[Frames, Complexes] | None = field(default=None, init=False, repr=False)

    @classmethod
    def of_codes(cls, codes: Rows) -> "Inverses":
        """Return the reciprocals 1/c of the code symbols of a table."""
        return cls(codes.shape[0], lambda rows: 1 / np.asarray(codes[rows], np.complex64))

    @classmethod
    def fixed(cls, inverse: Complexes) -> "Inverses":
        """Return the same inverse spectrum, (subcarrier,) complex64, for all pulses."""
        return cls(1, lambda rows: inverse[None][rows])

    def at(self, frames: Frames) -> Complexes:
        """Return the inverse spectra of pulses, (pulse, subcarrier), or (1, subcarrier) if all pulses are equal."""
        rows = frames % self.count
        if len(rows) and (rows == rows[0]).all():
            rows = rows[:1]
        latest = self._latest
        if latest is None or not np.array_equal(latest[0], rows):  # both channels of a block have the same rows
            latest = self._latest = rows, self.of_rows(rows)
        return latest[1]

    def sampled(self) -> Complexes:
        """Return the inverse spectra of `sampled_rows`, (row, subcarrier) complex64, for averages over pulses."""
        return self.of_rows(sampled_rows(self.count))


def sampled_rows(count: int) -> Frames:
    """Return at most 64 row numbers, evenly spaced in a table, from which averages over pulses are estimated.

    Examples
    --------
    >>> sampled_rows(1), len(sampled_rows(100_000))
    (array([0]), 64)
    """
    return np.unique(np.linspace(0, count - 1, min(64, count)).round().astype(np.int64))


# ---- Pseudo-noise codes ----------------------------------------------------------------------------------------------


def pn_sequence(exponents: Sequence[int], seed: int) -> NDArray[np.uint8]:
    """Return one period of a pseudo-noise sequence of a primitive polynomial, (2^n - 1,) uint8 of 0 and 1.

    Parameters
    ----------
    exponents
        Exponents of the polynomial other than 0, such as (7, 6) for x⁷ + x⁶ + 1; the largest is the degree n.
    seed
        First n bits of the sequence as a number, most significant bit first; 1 to 2^n - 1.

    Raises
    ------
    ValueError
        If the polynomial is not primitive, or the seed is out of range.

    Notes
    -----
    Source: docs/theory/changing_codes.md, "Pseudo-noise codes": the recurrence b_k = ⊕ b_{k-e}, and its powers of two,
    b_k = ⊕ b_{k-e·2^j}, by which blocks of growing length follow from the bits before them.

    Examples
    --------
    >>> pn_sequence((3, 2), seed=1).tolist()
    [0, 0, 1, 0, 1, 1, 1]
    """
    degree = max(exponents)
    if not 0 < seed < 1 << degree:
        raise ValueError(f"seed {seed} must be 1 to {(1 << degree) - 1} for a polynomial of degree {degree}")
    period = (1 << degree) - 1
    bits = np.zeros(period + degree, np.uint8)
    bits[:degree] = [seed >> (degree - 1 - bit) & 1 for bit in range(degree)]
    known = degree
    while known < len(bits):
        power = 1 << int(known // degree).bit_length() - 1
        stop = min(len(bits), known + min(exponents) * power)
        for exponent in exponents:
            bits[known:stop] ^= bits[known - exponent * power : stop - exponent * power]
        known = stop
    # a shorter period divides 2^n - 1, which is odd: the number of ones is then not a power of two
    if (bits[period:] != bits[:degree]).any() or bits[:period].sum() != 1 << (degree - 1):
        raise ValueError(f"polynomial with exponents {list(exponents)}: it is not primitive")
    return bits[:period]


class PnCodes:
    """Table of code symbols that carry consecutive bits of a pseudo-noise sequence, generated on reading.

    Parameters
    ----------
    sequence
        One period of the sequence.
    name
        Name of the constellation.
    subcarriers
        Symbols per frame.
    frames
        Number of frames after which the sequence starts again; None: it continues, and the table has as many rows as
        frames differ.

    Examples
    --------
    >>> PnCodes(pn_sequence((3, 2), seed=1), "qpsk", 2, None)[np.array([0, 7])].round(2)
    array([[-0.71-0.71j,  0.71-0.71j],
           [-0.71-0.71j,  0.71-0.71j]], dtype=complex64)
    """

    def __init__(self, sequence: NDArray[np.uint8], name: str, subcarriers: int, frames: int | None) -> None:
        self._period, self._constellation = len(sequence), constellation(name)
        self._bits = subcarriers * self._constellation.bits_per_symbol
        self._sequence = np.resize(sequence, self._period + self._bits)  # continued by one row
        rows = len(sequence) // int(np.gcd(len(sequence), self._bits)) if frames is None else frames
        self.shape = rows, subcarriers

    def __getitem__(self, rows: Frames) -> Complexes:
        bits = np.empty((len(rows), self._bits), np.uint8)
        for row, start in zip(bits, rows * self._bits % self._period, strict=True):
            row[:] = self._sequence[start : start + self._bits]
        return self._constellation.symbols(bits)


# ---- Frame numbers of captures ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FrameNumbers:
    """Frame numbers of captures, by which rows of a code table are selected.

    Attributes
    ----------
    numbers
        (capture,) int64.
    basis
        Source of the numbers, one line.
    """

    numbers: Frames
    basis: str


def frame_numbers(time_ns: NDArray[np.int64], counted: Frames, *, interval_s: float) -> FrameNumbers:
    """Return the frame numbers of a transmitter's captures, by its frame counter or else by their order.

    Parameters
    ----------
    time_ns
        (capture,) int64, time tags, nanoseconds.
    counted
        (capture,) int64, frame counter, -1 where it was not decoded.
    interval_s
        Repetition interval of the pulses, seconds.

    Notes
    -----
    Source: docs/theory/changing_codes.md, "Frames of captures". Missed triggers are counted by the intervals of the
    time tags, from the closest earlier capture with a counter, or from the first capture, which is frame 0.

    Examples
    --------
    >>> tags = np.array([0, 50, 150, 200]) * 1_000_000
    >>> found = frame_numbers(tags, np.full(4, -1), interval_s=0.05)
    >>> found.numbers, found.basis
    (array([0, 1, 3, 4]), 'order of captures; 1 missed trigger counted by time tags')
    >>> frame_numbers(tags, np.array([7, -1, 10, 11]), interval_s=0.05).numbers
    array([ 7,  8, 10, 11])
    """
    steps = np.rint(np.diff(time_ns) / (interval_s * 1e9)).astype(np.int64)
    order = np.concatenate([np.zeros(min(1, len(time_ns)), np.int64), np.cumsum(steps)])
    known = counted != ABSENT
    if not known.any():
        missed = int(order[-1]) + 1 - len(order) if len(order) else 0
        plural = "" if missed == 1 else "s"
        stated = f"; {missed} missed trigger{plural} counted by time tags" if missed > 0 else ""
        return FrameNumbers(order, f"order of captures{stated}")
    at = np.flatnonzero(known)
    read = counted[at]
    if (np.diff(read) < 0).any():  # the counter returned to zero
        read = unwrapped(read, time_ns[at], interval_s * 1e9, 1 << int(read.max()).bit_length())
    closest = np.maximum(np.searchsorted(at, np.arange(len(counted)), "right") - 1, 0)
    numbers = read[closest] + order - order[at[closest]]
    unread = int((~known).sum())
    stated = f"; {unread} without a number by time tags" if unread else ""
    return FrameNumbers(numbers, f"frame counter{stated}")


MOST_DISPLACED = 16
"""Largest displacement of frame numbers that is searched, in frames."""

_CLEARER, _FEWEST = 2.0, 8
"""Least ratio of the compression at a displacement to that without one, and fewest captures: noise reaches this ratio
by chance in fewer captures."""


def displacement(received: Complexes, inverses: Inverses, frames: Frames, *, same_delay: bool) -> int:
    """Return the number of frames by which the symbols of captures lie after their frame numbers; 0 if none is found.

    Parameters
    ----------
    received
        (capture, subcarrier) complex64, received symbols with the code, of any number of captures.
    inverses, frames
        Inverse spectra of the transmitted pulses, and frame numbers of the captures.
    same_delay
        True if an echo has the same delay in all captures, so that their power may be averaged in each delay cell.

    Notes
    -----
    Source: docs/theory/changing_codes.md, "Frames of captures": only the symbols of the right frame compress an echo.

    Examples
    --------
    >>> codes = np.exp(2j * np.pi * np.random.default_rng(1).random((50, 64))).astype(np.complex64)
    >>> displacement(codes[3:40], Inverses.of_codes(codes), np.arange(37), same_delay=True)
    3
    """
    reach = min(MOST_DISPLACED, inverses.count // 2) if len(received) >= _FEWEST else 0
    peaks = {}
    for shift in sorted(range(-reach, reach + 1), key=abs):
        power = np.abs(scipy.fft.ifft(received * inverses.at(frames + shift), axis=1)) ** 2
        cells = power / np.maximum(power.mean(axis=1, keepdims=True), np.finfo(np.float32).tiny)
        peaks[shift] = float(cells.mean(axis=0).max() if same_delay else cells.max(axis=1).mean())
    best = max(peaks, key=lambda shift: peaks[shift])
    return best if peaks[best] > _CLEARER * peaks[0] else 0
