"""Constellations of data symbols: QPSK and square QAM with unit mean power and Gray mapping.

Source: docs/theory/data_symbols.md, "Constellations"; J. Proakis and M. Salehi, Digital Communications, 5th ed., 2008,
section 4.3.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.errors import CampaignError

Labels = NDArray[np.uint8]
"""Bits of symbols as integers, the bits of I before those of Q, most significant bit first."""


DECISION_LOSS_DB = 0.2
"""Loss of an image by wrong decisions, dB, up to which the decisions of a pulse are used; as for `FIT_SNR_DB`."""


_SNRS = 10 ** np.arange(-2.0, 6.0, 0.01)  # from -20 to 60 dB, in steps of 0.1 dB


class DecidedReference(NamedTuple):
    """Properties of symbols ĉ decided in noise, as reference of an echo with the symbols c.

    Attributes
    ----------
    gain
        E[c/ĉ], amplitude of an image relative to that by known symbols.
    error
        Var[c/ĉ]/gain², power of the error of a subcarrier relative to the echo.
    evm
        √E|y - ĉ|², error vector magnitude of the received symbols y relative to the decisions.
    """

    gain: float
    error: float
    evm: float


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
        index = np.fmin(np.fmax(level, 0), self.side - 1).astype(np.uint8)  # 0 for NaN
        gray = index ^ (index >> 1)
        return np.asarray((gray[..., 0] << (self.bits_per_symbol // 2)) | gray[..., 1], np.uint8)

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

    def decided(self, snr: float) -> "DecidedReference":
        """Return the properties of symbols decided in white Gaussian noise of a given SNR (eqs. 4 to 6).

        Examples
        --------
        >>> constellation("qpsk").decided(10.0)
        DecidedReference(gain=0.998..., error=0.003..., evm=0.31...)
        """
        # Of one axis: level a_i received in the interval (low_j, high_j) of level a_j, in standard deviations σ of it
        side, deviation = self.side, np.sqrt(0.5 / snr)
        levels = (2 * np.arange(side) - side + 1) * self.half_distance
        edges = np.concatenate([[-np.inf], levels[:-1] + self.half_distance, [np.inf]])
        bounds = (edges - levels[:, None]) / deviation
        density = np.exp(-(bounds**2) / 2) / np.sqrt(2 * np.pi)
        moment = np.where(np.isfinite(bounds), bounds, 0.0) * density
        chance = np.diff(scipy.special.ndtr(bounds), axis=1)
        offset = (levels[:, None] - levels) / deviation
        # E[(x - a_j)²] of an axis; I and Q are alike
        square = chance - np.diff(moment, axis=1) - 2 * offset * np.diff(density, axis=1) + offset**2 * chance
        evm = float(np.sqrt(2 * deviation**2 * square.sum() / side))
        # Σ over sent symbols, given the decision for level j of I and level l of Q; 1/M is the probability of a symbol
        count, first, second = (levels**power @ chance for power in (0, 1, 2))
        decided = levels[:, None] + 1j * levels
        sent = first[:, None] * count + 1j * count[:, None] * first
        gain = float(np.real(np.sum(sent / decided)) / side**2)
        power = second[:, None] * count + count[:, None] * second
        ratio = float(np.sum(power / np.abs(decided) ** 2) / side**2)
        return DecidedReference(gain, max(ratio / gain**2 - 1, 0.0), evm)

    @cached_property
    def least_snr(self) -> float:
        """Least SNR at which decided symbols are the better reference: gain and error within their limits (eq. 7)."""
        largest_loss = 10 ** (-DECISION_LOSS_DB / 20)

        def inadequate(snr: float) -> bool:
            decided = self.decided(snr)
            return decided.gain < largest_loss or decided.error > self.noise_gain / snr

        return float(_SNRS[1 + max(index for index, snr in enumerate(_SNRS) if inadequate(snr))])

    def snr_of_evm(self, evm: Floats) -> Floats:
        """Return the SNR at which decisions have a given error vector magnitude, the inverse of `decided`.

        Examples
        --------
        >>> qam = constellation("64qam")
        >>> float(qam.snr_of_evm(qam.decided(200.0).evm).round(1))
        200.0
        """
        return np.asarray(np.exp(np.interp(-np.asarray(evm), -self._evms, np.log(_SNRS))))

    @cached_property
    def _evms(self) -> Floats:
        return np.array([self.decided(snr).evm for snr in _SNRS])


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
