"""Constellations of data symbols: QPSK and square QAM with unit mean power and Gray mapping.

Source: docs/theory/data_symbols.md, "Constellations"; J. Proakis and M. Salehi, Digital Communications, 5th ed., 2008,
section 4.3.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.special
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.errors import CampaignError

Labels = NDArray[np.uint8]
"""Bits of symbols as integers, the bits of I before those of Q, most significant bit first."""


@dataclass(frozen=True)
class Constellation:
    """Square constellation of M = 2^b points with unit mean power; the Gray code of I precedes that of Q in a label.

    Attributes
    ----------
    name
        Key in a config: `qpsk`, `16qam`, `64qam` or `256qam`.
    bits_per_symbol
        b, an even number.

    Examples
    --------
    >>> qam = constellation("16qam")
    >>> qam.symbols(np.array([1, 0, 0, 0])).round(3)
    array([0.949-0.949j], dtype=complex64)
    >>> qam.bits(qam.decide(np.array([0.8 - 1.1j])))
    array([1, 0, 0, 0], dtype=uint8)
    >>> round(qam.noise_gain, 4), round(float(qam.symbol_error_rate(100.0)), 7)
    (1.8889, 1.16e-05)
    """

    name: str
    bits_per_symbol: int

    @property
    def side(self) -> int:
        """Number of levels of I and of Q, √M."""
        return int(2 ** (self.bits_per_symbol // 2))

    @property
    def half_distance(self) -> float:
        """Half of the distance between neighbouring points, √(3/(2(M - 1))) (eq. 1)."""
        return float(np.sqrt(1.5 / (self.side**2 - 1)))

    @cached_property
    def points(self) -> Complexes:
        """(label,) complex64, points in the order of their labels."""
        gray = np.arange(self.side) ^ (np.arange(self.side) >> 1)
        levels = np.empty(self.side)
        levels[gray] = (2 * np.arange(self.side) - self.side + 1) * self.half_distance
        return (levels[:, None] + 1j * levels).ravel().astype(np.complex64)

    @property
    def noise_gain(self) -> float:
        """E[1/|c|²], by which division by the symbols amplifies noise (eq. 2); 1 for QPSK."""
        return float(np.mean(1 / np.abs(self.points.astype(complex)) ** 2))

    def decide(self, received: NDArray[np.complexfloating[Any, Any]]) -> Labels:
        """Return the labels of the points nearest to received symbols of any shape."""
        values = np.ascontiguousarray(received)
        parts = values.view(values.real.dtype).reshape(*values.shape, 2)
        level = np.rint((parts / self.half_distance + (self.side - 1)) / 2)
        index = np.nan_to_num(np.clip(level, 0, self.side - 1)).astype(np.uint8)
        gray = index ^ (index >> 1)
        return (gray[..., 0] << (self.bits_per_symbol // 2)) | gray[..., 1]

    def bits(self, labels: Labels) -> NDArray[np.uint8]:
        """Return the bits of labels, (…, symbol), as (…, symbol·b) uint8 of 0 and 1."""
        shifts = np.arange(self.bits_per_symbol - 1, -1, -1, dtype=np.uint8)
        bits = (labels[..., None] >> shifts) & np.uint8(1)
        return bits.reshape(*labels.shape[:-1], -1)

    def labels(self, bits: NDArray[Any]) -> Labels:
        """Return the labels of bits, (…, symbol·b), 0 or 1; the inverse of `bits`."""
        grouped = np.asarray(bits, np.uint8).reshape(*np.shape(bits)[:-1], -1, self.bits_per_symbol)
        weights = (1 << np.arange(self.bits_per_symbol - 1, -1, -1)).astype(np.uint8)
        return np.asarray((grouped * weights).sum(-1, dtype=np.uint8))

    def symbols(self, bits: NDArray[Any]) -> Complexes:
        """Return the symbols of bits, (…, symbol·b), 0 or 1, as (…, symbol) complex64."""
        return self.points[self.labels(bits)]

    def symbol_error_rate(self, snr: float | Floats) -> Floats:
        """Return the symbol error rate of nearest decisions in white Gaussian noise (eq. 3).

        Parameters
        ----------
        snr
            Mean power of the symbols divided by that of the complex noise, not in decibels.
        """
        # error of one axis: 2(1 - 1/√M)·Q(d/σ) with d = half_distance and σ² = 1/(2·snr) per axis
        tail = scipy.special.erfc(self.half_distance * np.sqrt(np.asarray(snr, float))) / 2
        axis = 2 * (1 - 1 / self.side) * tail
        return np.asarray(axis * (2 - axis))


CONSTELLATIONS = {name: Constellation(name, bits) for name, bits in
                  (("qpsk", 2), ("16qam", 4), ("64qam", 6), ("256qam", 8))}  # fmt: skip
"""Name in a config → constellation."""


def constellation(name: str) -> Constellation:
    """Return a constellation by its name in a config.

    Raises
    ------
    CampaignError
        If the name is not a key of `CONSTELLATIONS`.

    Examples
    --------
    >>> constellation("qpsk").points.round(3)
    array([-0.707-0.707j, -0.707+0.707j,  0.707-0.707j,  0.707+0.707j],
          dtype=complex64)
    """
    if name not in CONSTELLATIONS:
        raise CampaignError(
            f"constellation {name!r} is unknown",
            "constellation of the data symbols",
            f"one of {', '.join(CONSTELLATIONS)}",
            "Correct the name of the constellation.",
        )
    return CONSTELLATIONS[name]
