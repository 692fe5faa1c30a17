"""Continuous tones of other transmitters in captures: estimation and subtraction before the code is removed.

The DFT window of a symbol is rectangular. A tone between two subcarriers therefore leaks into all subcarriers, and the
exclusion of a few subcarriers does not remove it. Equations: docs/theory/interference.md, eq. 9 to 12.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.echo.demodulate import Numerology
from apertura.core.echo.interference import service_at

_PEAK = 20.0
"""Power of a subcarrier relative to the mean of its capture, above which it is tested for a tone (eq. 10)."""

_LEFT = 0.15
"""Largest share of the power around a tone that remains after its subtraction; more is not a tone (eq. 12)."""

_ABOVE = 2.0
"""Largest power around a tone after its subtraction relative to the median level of the capture; more is not a tone."""

_WIDTH = 15  # subcarriers to which a tone and the echo are fitted
_MOST_CELLS = 6  # longest delay, cells of the fitted band, up to which the echo is fitted
_NEAR = 3  # subcarriers on either side of the peak in which the fit is tested
_STEPS = 4  # Gauss-Newton steps
_MOST = 4  # tones per capture
_OUTSIDE = 20  # largest distance of a tone from the occupied band, subcarriers

_FLAGGED_SHARE = 0.01
"""Smallest share of captures with a tone for which the flag is raised; tones in fewer captures are also subtracted."""


@dataclass
class Tones:
    """Removal of tones from demodulated captures of one channel, and counts for the flag.

    Attributes
    ----------
    numerology
        Numerology of the captures.
    lines
        Numbers of subcarriers with a tone in all captures, which is subtracted whatever its power.
    sent
        (1, subcarrier) complex64, spectrum of the transmitted pulses; None: the reciprocal of their inverse spectra.
    captures, affected
        Number of captures, and of those from which a tone was removed.
    power
        (subcarrier,) float64, removed power, relative to that of the rest of the capture, summed over the captures.
    """

    numerology: Numerology
    lines: tuple[int, ...] = ()
    sent: Complexes | None = None
    captures: int = 0
    affected: int = 0
    power: Floats = field(init=False)
    _shape: tuple[Complexes, NDArray[np.float32]] | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        self.power = np.zeros(self.numerology.numbers.size)

    def removed(self, symbols: Complexes, inverse: Complexes) -> Complexes:
        """Return received symbols without the tones in each pulse, (pulse, subcarrier) complex64 with the code.

        Parameters
        ----------
        symbols
            (pulse, subcarrier) complex64, received symbols with the code.
        inverse
            (pulse, subcarrier) complex64, inverse spectra of the transmitted pulses; one row if they are equal.

        Notes
        -----
        Source: docs/theory/interference.md, eq. 9 to 12.

        Examples
        --------
        >>> numerology = Numerology(1.2e9, 64e6, np.arange(64), prefix_samples=0, dft_samples=64)
        >>> rng = np.random.default_rng(1)
        >>> echo = np.exp(2j * np.pi * rng.random((10, 64))).astype(np.complex64)
        >>> tone = 1000 * np.exp(2j * np.pi * 20.3 * np.arange(64) / 64)
        >>> tones, inverse = Tones(numerology), np.ones((1, 64), np.complex64)
        >>> left = tones.removed((echo + np.fft.fft(tone, norm="forward")).astype(np.complex64), inverse) - echo
        >>> float(np.round((np.abs(left) ** 2).mean(), 2)) < 0.1  # echoes have a power of 1, the tone 15 600
        True
        >>> tones.flags("interference")["interference"].partition(" MHz")[0]
        'tone in 100% of captures, strongest at 1220.00'
        """
        if symbols.shape[1] < _WIDTH:
            return symbols
        self.captures += len(symbols)
        has_tone = np.full(len(symbols), bool(self.lines))
        shape = self._shape_of(inverse)
        cleaned, every = symbols, np.arange(len(symbols))
        for line in self.lines:
            near = np.clip(line + np.arange(-1, 2), 0, symbols.shape[1] - 1)
            peak = near[np.abs(cleaned[:, near]).argmax(axis=1)]
            cleaned = self._subtracted(cleaned, every, peak, self._fitted(cleaned, peak, inverse, shape)[0])
        for _ in range(_MOST):
            relative = (np.square(cleaned.real) + np.square(cleaned.imag)) / shape
            peak = relative.argmax(axis=1)
            suspect = np.flatnonzero(relative.max(axis=1) > _PEAK * relative.mean(axis=1))
            if not suspect.size:
                break
            own = np.zeros(1, np.int64) if len(inverse) == 1 else suspect
            tone, is_tone = self._fitted(cleaned[suspect], peak[suspect], inverse[own], shape[own])
            found = suspect[is_tone]
            if not found.size:
                break
            cleaned = self._subtracted(cleaned, found, peak[found], tone[is_tone])
            has_tone[found] = True
        self.affected += int(has_tone.sum())
        return cleaned

    def _shape_of(self, inverse: Complexes) -> NDArray[np.float32]:
        """Return the power of transmitted spectra relative to the mean of each, at least 0.1."""
        if self._shape is None or self._shape[0] is not inverse:
            sent = self._sent(inverse)
            power = np.square(sent.real) + np.square(sent.imag)
            self._shape = inverse, np.maximum(power / power.mean(axis=1, keepdims=True), np.float32(0.1))
        return self._shape[1]

    def _sent(self, inverse: Complexes) -> Complexes:
        """Return the transmitted spectra, (1 or pulse, subcarrier) complex64; 0 where the inverse is 0."""
        if self.sent is not None:
            return self.sent
        return np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse != 0)

    def _subtracted(
        self, symbols: Complexes, pulses: NDArray[np.intp], peak: NDArray[np.intp], tone: Complexes
    ) -> Complexes:
        """Return symbols without the tones of some pulses, whose relative power is added to `power`."""
        cleaned = symbols.copy()
        cleaned[pulses] -= tone
        rest = np.sum(np.abs(cleaned[pulses]) ** 2, axis=1)
        ratio = np.sum(np.abs(tone) ** 2, axis=1) / np.maximum(rest, np.finfo(np.float32).tiny)
        np.add.at(self.power, peak, ratio)
        return cleaned

    def flags(self, name: str) -> Flags:
        """Return the flag `name` if tones were removed from a relevant share of the captures."""
        if self.affected <= _FLAGGED_SHARE * self.captures:
            return Flags()
        strongest = int(self.power.argmax())
        at_hz = float(self.numerology.frequency_hz[strongest])
        level_db = decibels(float(self.power[strongest] / self.affected))
        line = (
            f"tone in {self.affected / self.captures:.0%} of captures, strongest at {1e-6 * at_hz:.2f} MHz "
            f"({service_at(at_hz)}): {level_db:.1f} dB above the rest of the capture; subtracted"
        )
        return Flags({name: line})

    def _echo(self, near: NDArray[np.intp], inverse: Complexes) -> NDArray[np.complex128]:
        """Return terms of the echo in the subcarriers of a fit, (pulse, subcarrier, term): paths of equal spacing."""
        numerology = self.numerology
        longest = numerology.prefix_samples if numerology.longest_samples is None else numerology.longest_samples
        cells = _WIDTH * longest / numerology.dft_samples
        if cells > _MOST_CELLS:  # the echo is not smooth enough to be distinguished from a tone
            return np.zeros((*near.shape, 0), np.complex128)
        terms = 3 + int(np.ceil(cells))
        delays = np.linspace(-0.5, cells + 0.5, terms) / _WIDTH
        turns = np.exp(-2j * np.pi * numerology.numbers[near][..., None] * delays)
        sent = self._sent(inverse).astype(np.complex128)
        around = np.take_along_axis(np.broadcast_to(sent, (len(near), sent.shape[1])), near, axis=1)
        return np.asarray(around[..., None] * turns / np.sqrt(_WIDTH))

    def _fitted(
        self, symbols: Complexes, peak: NDArray[np.intp], inverse: Complexes, shape: NDArray[np.float32]
    ) -> tuple[Complexes, NDArray[np.bool_]]:
        """Fit a tone to the subcarriers around the peak; return it in all subcarriers, and whether it is a tone."""
        exact = symbols.astype(np.complex128)
        count, window = symbols.shape[1], self.numerology.dft_samples
        first = np.clip(peak - _WIDTH // 2, 0, count - _WIDTH)
        near = first[:, None] + np.arange(_WIDTH)
        received, numbers = np.take_along_axis(exact, near, axis=1), self.numerology.numbers[near].astype(np.float64)
        at = self.numerology.numbers[peak].astype(np.float64)
        # Two lines give the start (eq. 11): Y_{k+1}/Y_k = exp(jπ/N)·x/(x − 1) for |x| ≪ N, x = κ − k.
        right = np.minimum(peak + 1, count - 1) - (peak == count - 1)
        row, lower = np.arange(len(peak)), np.minimum(peak, right)
        ratio = exact[row, lower + 1] / np.where(exact[row, lower] == 0, 1, exact[row, lower])
        ratio = (ratio * np.exp(-1j * np.pi / window)).real
        start = self.numerology.numbers[lower] + ratio / np.where(ratio == 1, np.inf, ratio - 1)
        outside = ((peak == 0) & (start < at)) | ((peak == count - 1) & (start > at))  # next to the occupied band
        at = np.where((np.abs(start - at) < 1) | (outside & (np.abs(start - at) < _OUTSIDE)), start, at)
        kernel, echo = _kernel(at[:, None] - numbers, window), self._echo(near, inverse)
        for _ in range(_STEPS):
            # Gauss-Newton for Y = a·D(κ − k) + echo: the second coefficient is a·δκ.
            distance = at[:, None] - numbers
            slope = (_kernel(distance + _H, window) - _kernel(distance - _H, window)) / (2 * _H)
            solved = _least_squares(np.concatenate([kernel[..., None], slope[..., None], echo], axis=-1), received)
            step = (solved[:, 1] / np.where(solved[:, 0] == 0, 1, solved[:, 0])).real
            at += np.clip(step, -0.5, 0.5)
            kernel = _kernel(at[:, None] - numbers, window)
        amplitude = _least_squares(np.concatenate([kernel[..., None], echo], axis=-1), received)[:, 0]
        around = np.abs(near - peak[:, None]) <= _NEAR
        left = received - amplitude[:, None] * kernel
        # Level of the echo and of the leakage of the tone: of an exponential distribution, by its median.
        level = np.median(np.abs(exact) ** 2 / shape, axis=1) / np.log(2)
        rest, power = (np.sum(np.abs(values) ** 2 * around, axis=1) for values in (left, received))
        is_tone = (rest < _LEFT * power) & (rest < _ABOVE * (2 * _NEAR + 1) * level)
        tone = amplitude[:, None] * _kernel(at[:, None] - self.numerology.numbers, window)
        # The far part of a tone next to the band may be wrong, although it fits around the peak.
        is_tone &= np.sum(np.abs(exact - tone) ** 2, axis=1) < np.sum(np.abs(exact) ** 2, axis=1)
        return np.asarray(tone, np.complex64), is_tone


def _least_squares(basis: NDArray[np.complex128], received: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the coefficients of (pulse, subcarrier, term) bases that fit the received symbols best."""
    adjoint = basis.conj().swapaxes(1, 2)
    gram = adjoint @ basis
    gram += _RIDGE * np.trace(gram, axis1=1, axis2=2)[:, None, None].real * np.eye(basis.shape[2])
    return np.asarray(np.linalg.solve(gram, adjoint @ received[..., None])[..., 0])


_RIDGE = 1e-9  # so that the normal equations are solvable
_H = 1e-3  # step of the derivative, subcarriers


def _kernel(distance: Floats, window: int) -> NDArray[np.complex128]:
    """Return D(x), the spectrum of a tone at a distance of x subcarriers (eq. 9)."""
    below = window * np.sin(np.pi * distance / window)
    magnitude = np.divide(np.sin(np.pi * distance), below, out=np.ones_like(below), where=np.abs(below) > 1e-9)
    return np.asarray(magnitude * np.exp(1j * np.pi * distance * (window - 1) / window))
