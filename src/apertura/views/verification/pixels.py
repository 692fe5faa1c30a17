"""Two arrays told apart, block by block: how far, how alike, and where only one of them holds a value."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[Any]


@dataclass
class Tally:
    """Sums over the values of two arrays that lie in one place.

    Attributes
    ----------
    compared
        Values that both hold.
    only
        Values that one holds and the other does not (NaN, infinite), of the first and of the second.
    differing
        Values that are not the same, those that one lacks among them.
    largest, square
        Largest magnitude of the difference, and sum of its squares.
    peak
        Largest magnitude in either.
    phased
        Whether values are complex.

    Examples
    --------
    >>> tally = Tally.of([(np.array([1.0, 2.0, np.nan]), np.array([1.0, 2.5, 0.0]))])
    >>> tally.compared, tally.only, tally.differing, tally.largest, tally.rms
    (2, (0, 1), 2, 0.5, 0.3535533905932738)
    """

    compared: int = 0
    only: tuple[int, int] = (0, 0)
    differing: int = 0
    largest: float = 0.0
    square: float = 0.0
    peak: float = 0.0
    phased: bool = False
    _about: float = 0.0
    _sums: Any = None

    @classmethod
    def of(cls, blocks: Iterable[tuple[Pixels, Pixels]]) -> "Tally":
        """Return the sums over pairs of blocks of one shape, real or complex."""
        tally = cls()
        for first, second in blocks:
            tally.add(np.asarray(first), np.asarray(second))
        return tally

    def add(self, first: Pixels, second: Pixels) -> None:
        """Add a block of each."""
        held = np.isfinite(first), np.isfinite(second)
        lacking = int((held[0] & ~held[1]).sum()), int((held[1] & ~held[0]).sum())
        self.only = self.only[0] + lacking[0], self.only[1] + lacking[1]
        self.phased = np.iscomplexobj(first) or np.iscomplexobj(second)
        wide = np.complex128 if self.phased else np.float64
        a, b = (values[held[0] & held[1]].astype(wide) for values in (first, second))
        apart = np.abs(a - b)
        self.differing += int(np.count_nonzero(apart)) + sum(lacking)
        if not a.size:
            return
        self.compared += a.size
        self.largest, self.square = max(self.largest, float(apart.max())), self.square + float((apart**2).sum())
        self.peak = max(self.peak, float(np.abs(a).max()), float(np.abs(b).max()))
        if self._sums is None:  # of real values the mean is taken off: sums about one of them keep their digits
            self._sums, self._about = np.zeros(5, complex), 0.0 if self.phased else float(a[0])
        a, b = a - self._about, b - self._about
        self._sums += [a.sum(), b.sum(), np.vdot(a, a), np.vdot(b, b), np.vdot(b, a)]

    @property
    def rms(self) -> float:
        """Root of the mean square of the difference; 0 where nothing could be compared."""
        return float(np.sqrt(self.square / self.compared)) if self.compared else 0.0

    @property
    def alike(self) -> float:
        """Coherence |Σ a b*| / √(Σ|a|² Σ|b|²) of complex values, correlation of real ones; NaN where all are equal."""
        if self._sums is None:
            return float("nan")
        of_a, of_b, aa, bb, ab = self._sums
        if not self.phased:
            aa, bb, ab = (
                both - left * right / self.compared
                for both, left, right in ((aa, of_a, of_a), (bb, of_b, of_b), (ab, of_a, of_b))
            )
        scale = np.sqrt(max(aa.real, 0.0) * max(bb.real, 0.0))
        return float((abs(ab) if self.phased else ab.real) / scale) if scale > 0 else float("nan")


def rows_of(shape: tuple[int, ...], itemsize: int, *, block_bytes: int = 1 << 24) -> Iterator[slice]:
    """Yield rows of an array, as many at a time as fit into some bytes, one at least.

    Examples
    --------
    >>> list(rows_of((5, 1000), 8, block_bytes=16_000))
    [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    step = max(1, block_bytes // max(1, itemsize * int(np.prod(shape[1:], dtype=int))))
    for first in range(0, shape[0], step):
        yield slice(first, min(first + step, shape[0]))
