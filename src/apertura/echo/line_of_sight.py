"""The direct path inside a sidelink: its delay, phase and amplitude in every pulse, and whether it is there at all."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Complexes = NDArray[np.complex64]
Floats = NDArray[np.float64]

LOCK_FALSE_ALARM = 1e-3
"""Chance that a pulse of pure noise passes for one with a sidelink."""

_PULSES_AT_ONCE = 64


@dataclass(frozen=True)
class LineOfSight:
    """The strongest path of each pulse, S_n = amplitude·exp(j(phase - 2π·n·delay/N)) with n counted from mid-band.

    Attributes
    ----------
    delay_cells
        (pulse,) float64, delay in cells of 1/B, -N/2…N/2.
    phase_rad
        (pulse,) float64, phase at the middle of the band.
    amplitude
        (pulse,) float64, per subcarrier, in the units of the sidelink.
    noise_power
        (pulse,) float64, per subcarrier.
    locked
        (pulse,) bool, whether the path stands out of the noise.
    """

    delay_cells: Floats
    phase_rad: Floats
    amplitude: Floats
    noise_power: Floats
    locked: NDArray[np.bool_]

    def select(self, pulses: slice | NDArray[np.bool_] | NDArray[np.intp]) -> "LineOfSight":
        """Return the path of some pulses."""
        return LineOfSight(*(getattr(self, field.name)[pulses] for field in fields(self)))


def fit_line_of_sight(sidelink: Complexes) -> LineOfSight:
    """Fit one path to each pulse of a sidelink, (pulse, subcarrier) complex64, by maximum likelihood.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Two parameters of a pulse" and "Lock".

    Examples
    --------
    >>> centred = np.arange(64) - 31.5
    >>> path = fit_line_of_sight(3 * np.exp(1j * (0.5 - 2 * np.pi * centred * 7.3 / 64))[None].astype(np.complex64))
    >>> path.delay_cells.round(4), path.phase_rad.round(4), path.amplitude.round(4), path.locked
    (array([7.3]), array([0.5]), array([3.]), array([ True]))
    """
    blocks = [_fit(sidelink[i : i + _PULSES_AT_ONCE]) for i in range(0, len(sidelink), _PULSES_AT_ONCE)]
    delay, phase, amplitude, noise = (np.concatenate(part) for part in zip(*blocks, strict=True))
    threshold = _lock_threshold(sidelink.shape[1])
    locked = amplitude**2 > threshold * noise / sidelink.shape[1]
    return LineOfSight(delay, phase, amplitude, noise, locked)


def phasor(path: LineOfSight, subcarriers: int) -> NDArray[np.complex128]:
    """Return (pulse, subcarrier) complex128 exp(j(phase - 2π·n·delay/N)) of the fitted paths."""
    turns = np.outer(path.delay_cells / subcarriers, centred_numbers(subcarriers))
    return np.asarray(np.exp(1j * (path.phase_rad[:, None] - 2 * np.pi * turns)))


def centred_numbers(subcarriers: int) -> Floats:
    """Return subcarrier numbers counted from the middle of the band, so that delay and phase do not mix."""
    return np.asarray(np.arange(subcarriers) - (subcarriers - 1) / 2)


def _fit(sidelink: Complexes) -> tuple[Floats, Floats, Floats, Floats]:
    subcarriers = sidelink.shape[1]
    symbols = sidelink.astype(np.complex128)
    number = centred_numbers(subcarriers)
    coarse = np.abs(fft.ifft(symbols, 2 * subcarriers, axis=1)).argmax(axis=1) / 2
    delay = np.where(coarse >= subcarriers / 2, coarse - subcarriers, coarse)
    for _ in range(4):  # Newton's steps on the power |Σ S_n exp(+j2πn·delay/N)|²
        aligned = symbols * np.exp(2j * np.pi / subcarriers * np.outer(delay, number))
        total, first, second = aligned.sum(1), (aligned @ number), (aligned @ number**2)
        slope = -2 * np.imag(total.conj() * first)
        curvature = 2 * (np.abs(first) ** 2 - np.real(total.conj() * second))
        step = -slope / np.where(curvature < 0, curvature, -np.inf) * subcarriers / (2 * np.pi)
        delay = delay + np.clip(step, -0.25, 0.25)
    aligned = symbols * np.exp(2j * np.pi / subcarriers * np.outer(delay, number))
    total = aligned.mean(1)
    # the median of an exponential variable is ln 2 of its mean; few strong cells (echoes, ripple) do not move it
    noise = np.median(np.abs(fft.ifft(aligned, axis=1)) ** 2, axis=1) / np.log(2) * subcarriers
    return delay, np.angle(total), np.abs(total), noise


def _lock_threshold(subcarriers: int) -> float:
    """Return how far above the mean noise of a delay cell the highest of pure noise rises once in 1/P_fa pulses.

    |h(τ)|² of noise of bandwidth B crosses T times its mean √(πT/3)·exp(-T) times per 1/B, and there are N of these.
    """
    alone = float(np.log(subcarriers / LOCK_FALSE_ALARM))
    threshold = alone
    for _ in range(5):
        threshold = alone + 0.5 * float(np.log(np.pi * threshold / 3))
    return threshold
