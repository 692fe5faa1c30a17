"""Direct path of a sidelink: detection, and estimation of delay, phase and amplitude in every pulse."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.core.echo.compression import phasors, unit_phasor

LOCK_FALSE_ALARM = 1e-3
"""Probability of a lock on a pulse of noise alone."""

Weights = NDArray[np.float32]

_PULSES_AT_ONCE = 64
_GROUPS = 32
_NOISE_CELLS = 256  # number of cells for which the median is accurate to 0.4 dB


@dataclass(frozen=True)
class LineOfSight:
    """Strongest path of each pulse, S_n = amplitude·exp(j(phase - 2π·n·delay/N)) with n counted from mid-band.

    Attributes
    ----------
    delay_cells
        (pulse,) float64, delay in cells of 1/B, -N/2…N/2.
    phase_rad
        (pulse,) float64, phase at the middle of the band.
    amplitude
        (pulse,) float64, per subcarrier, in the units of the sidelink.
    noise_power
        (pulse,) float64, per subcarrier, mean over the subcarriers.
    locked
        (pulse,) bool, True if the path is detected above the noise.
    """

    delay_cells: Floats
    phase_rad: Floats
    amplitude: Floats
    noise_power: Floats
    locked: NDArray[np.bool_]

    def select(self, pulses: slice | NDArray[np.bool_] | NDArray[np.intp]) -> "LineOfSight":
        """Return the paths of the selected pulses."""
        return LineOfSight(*(getattr(self, field.name)[pulses] for field in fields(self)))


def fit_line_of_sight(sidelink: Complexes, weight: Weights | None = None) -> LineOfSight:
    """Fit one path to each pulse of a sidelink by maximum likelihood; parameters as for `fit_block`.

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
    if weight is not None:
        weight = np.broadcast_to(weight, sidelink.shape)
    blocks = [slice(first, first + _PULSES_AT_ONCE) for first in range(0, len(sidelink), _PULSES_AT_ONCE)]
    return joined([fit_block(sidelink[block], weight if weight is None else weight[block])[0] for block in blocks])


def joined(paths: Sequence[LineOfSight]) -> LineOfSight:
    """Return the concatenated paths of consecutive pulses."""
    return LineOfSight(
        *(np.concatenate([getattr(path, field.name) for path in paths]) for field in fields(LineOfSight))
    )


def phasor(path: LineOfSight, subcarriers: int) -> Complexes:
    """Return the phasors exp(j(phase - 2π·n·delay/N)) of the fitted paths, (pulse, subcarrier) complex64."""
    along = phasors(-path.delay_cells / subcarriers, subcarriers, first=-(subcarriers - 1) / 2)
    return np.asarray(along * np.exp(1j * path.phase_rad)[:, None], np.complex64)


def fit_block(sidelink: Complexes, weight: Weights | None = None) -> tuple[LineOfSight, Complexes]:
    """Fit one path to each pulse of a block; return the paths and the profiles aligned so that the path is in cell 0.

    Parameters
    ----------
    sidelink
        (pulse, subcarrier) complex64, code removed.
    weight
        (pulse or 1, subcarrier) float32, inverse noise power of the subcarriers, mean 1 over each pulse: |c|² of
        symbols of varying modulus. None: equal noise.

    Returns
    -------
    tuple
        The paths, and (pulse, cell) complex64.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Two parameters of a pulse". Newton's method from the highest half cell, on
    sums over groups of neighbouring subcarriers, within which a quarter of a cell changes the phase by less than
    0.05 rad.
    """
    subcarriers = sidelink.shape[1]
    weighted = sidelink if weight is None else sidelink * weight
    coarse = np.abs(scipy.fft.ifft(weighted, 2 * subcarriers, axis=1)).argmax(axis=1) / 2
    delay = np.where(coarse >= subcarriers / 2, coarse - subcarriers, coarse)
    edges = np.unique(np.linspace(0, subcarriers, _GROUPS + 1).astype(int))
    sums = np.add.reduceat(_aligned(weighted, delay), edges[:-1], axis=1).astype(np.complex128)
    delay = delay + _residual_cells(sums, (edges[:-1] + edges[1:] - subcarriers) / 2, subcarriers)
    aligned = _aligned(sidelink, delay)
    profile = scipy.fft.ifft(aligned, axis=1)
    direct = (profile[:, 0] if weight is None else (aligned * weight).mean(axis=1)).astype(np.complex128)
    cells = profile[:, :: max(1, subcarriers // _NOISE_CELLS)]
    power = np.square(cells.real) + np.square(cells.imag)
    # the median of an exponential variable is ln 2 times its mean; a few strong cells (echoes, ripple) have no effect
    half = power.shape[1] // 2
    power.sort(axis=1)  # five times as fast as numpy.median
    middle = (power[:, half] + power[:, (power.shape[1] - 1) // 2]).astype(np.float64) / 2
    noise = middle / np.log(2) * subcarriers
    amplitude = np.abs(direct)
    gain = 1.0 if weight is None else (1 / weight).mean(axis=1)  # of the noise that the weights do not have
    locked = amplitude**2 > _lock_threshold(subcarriers) * noise / (gain * subcarriers)
    return LineOfSight(delay, np.angle(direct), amplitude, noise, locked), profile


def _aligned(sidelink: Complexes, delay_cells: Floats) -> Complexes:
    subcarriers = sidelink.shape[1]
    return sidelink * phasors(delay_cells / subcarriers, subcarriers, first=-(subcarriers - 1) / 2)


def _residual_cells(sums: NDArray[np.complex128], number: Floats, subcarriers: int) -> Floats:
    """Return the residual delay of (pulse, group) sums, (pulse,) cells; the groups are centred on `number`."""
    delay = np.zeros(len(sums))
    for _ in range(4):  # Newton's method on the power |Σ S_n exp(+j2πn·delay/N)|²
        aligned = sums * unit_phasor(np.outer(delay, number / subcarriers))
        total, first, second = aligned.sum(1), (aligned @ number), (aligned @ number**2)
        slope = -2 * np.imag(total.conj() * first)
        curvature = 2 * (np.abs(first) ** 2 - np.real(total.conj() * second))
        step = -slope / np.where(curvature < 0, curvature, -np.inf) * subcarriers / (2 * np.pi)
        delay = delay + np.clip(step, -0.25, 0.25)
    return delay


def _lock_threshold(subcarriers: int) -> float:
    """Return the threshold relative to the mean noise of a delay cell for the false-alarm probability P_fa per pulse.

    |h(τ)|² of noise of bandwidth B crosses T times its mean √(πT/3)·exp(-T) times per cell of 1/B; there are N cells.
    """
    first_order = float(np.log(subcarriers / LOCK_FALSE_ALARM))
    threshold = first_order
    for _ in range(5):
        threshold = first_order + 0.5 * float(np.log(np.pi * threshold / 3))
    return threshold
