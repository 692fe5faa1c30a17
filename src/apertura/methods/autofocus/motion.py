"""Plausible clock offsets of a node, from logged speeds correlated with pulse-to-pulse changes of the echoes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.core.geometry.aperture import Aperture

PhaseCentres = Callable[[Floats], Aperture]
"""Function of times (time,) inside the log, seconds of its clock, that returns phase centres."""

LEAST_COVERED = 0.5
"""Minimum fraction of the pulses inside the log."""

_MARGIN = 8  # pulse intervals added on both sides of the plausible offsets
_SIGMA = 3.0  # standard deviations below the best correlation beyond which offsets are excluded


@dataclass(frozen=True, eq=False)
class Recorded:
    """Echoes of a monostatic node on the recorder's clock.

    Attributes
    ----------
    transfer
        (pulse, subcarrier) complex64: Σ a·exp(-j2πf(τ - reference_delay_s)).
    frequency_hz
        (subcarrier,) float64, ascending in equal steps.
    reference_delay_s
        (pulse,) float64, delay at which the phase of each pulse is zero, seconds.
    time_s
        (pulse,) float64, seconds of the recorder's clock, ascending.
    wave_speed_m_s
        Speed of the wave along the paths.
    """

    transfer: Complexes
    frequency_hz: Floats
    reference_delay_s: Floats
    time_s: Floats
    wave_speed_m_s: float

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, pulses: slice | NDArray[Any]) -> "Recorded":
        delay_s = self.reference_delay_s[pulses]
        return replace(self, transfer=self.transfer[pulses], reference_delay_s=delay_s, time_s=self.time_s[pulses])

    @property
    def shortest_wave_m(self) -> float:
        """Wavelength of the highest frequency, metres."""
        return self.wave_speed_m_s / float(self.frequency_hz[-1])

    def moving(self) -> "Recorded":
        """Return the echoes minus the mean of all pulses, which contains coupling and echoes at a constant delay."""
        return replace(self, transfer=self.transfer - self.transfer.mean(axis=0))


@dataclass(frozen=True, eq=False)
class Logged:
    """Positions of the antennas on the log's clock.

    Attributes
    ----------
    phase_centres
        Function of times inside the log that returns phase centres.
    first_s, last_s
        Times of the first and last epoch of the log.
    """

    phase_centres: PhaseCentres
    first_s: float
    last_s: float

    def inside(self, at_s: Floats) -> NDArray[np.bool_]:
        """Return (time,) bool, True for times between the first and last epoch."""
        return (at_s >= self.first_s) & (at_s <= self.last_s)

    def speeds_m_s(self, at_s: Floats) -> Floats:
        """Return (time,) float64, rate of the total path to a point straight ahead, m/s; 0 outside the log."""
        speed = np.zeros(len(at_s))
        kept = self.inside(at_s)
        if kept.sum() > 1:
            centres = self.phase_centres(at_s[kept]).tx_m
            speed[kept] = 2 * np.linalg.norm(np.gradient(centres, at_s[kept], axis=0), axis=1)
        return speed


def plausible_offsets(echo: Recorded, log: Logged, within_s: tuple[float, float]) -> tuple[float, float]:
    """Return the smallest and largest clock offset at which the logged motion matches changes of the echoes, seconds.

    Parameters
    ----------
    echo, log
        Recorded echoes, and logged antenna positions.
    within_s
        Smallest and largest offset to consider, seconds.

    Raises
    ------
    ValueError
        If no offset puts half of the pulses inside the log.

    Notes
    -----
    Source: docs/theory/tracks.md, "Clock of the recorder". The difference between consecutive pulses is correlated with
    the logged displacement between these pulses, limited to the distance beyond which pulses are uncorrelated. If the
    motion is uniform, no offset is excluded.
    """
    # |H_p − H_{p−1}|/|H_p|, between pulses, and the node's speed on a grid of the log's times.
    change = np.linalg.norm(np.diff(echo.transfer, axis=0), axis=1) / np.linalg.norm(echo.transfer[1:], axis=1)
    middle_s, interval_s = (echo.time_s[1:] + echo.time_s[:-1]) / 2, np.diff(echo.time_s)
    step_s = max(float(np.median(interval_s)), (within_s[1] - within_s[0]) / 4096)
    grid_s = np.arange(log.first_s, log.last_s, float(np.median(interval_s)) / 2)
    speeds_m_s = log.speeds_m_s(grid_s)
    offsets_s = np.arange(within_s[0], within_s[1] + step_s / 2, step_s)
    correlation = np.full(len(offsets_s), -1.0)
    changed = np.log(np.maximum(change, 1e-12))
    # Correlation of the logarithm with min(4π·v(t + δ)·Δt/λ, 1) at each offset; −1 if the log covers too few pulses.
    for number, offset_s in enumerate(offsets_s):
        kept = log.inside(middle_s + offset_s)
        if kept.mean() < LEAST_COVERED:
            continue
        path_change_m = np.interp(middle_s[kept] + offset_s, grid_s, speeds_m_s) * interval_s[kept]
        phase_rad = np.minimum(2 * np.pi * path_change_m / echo.shortest_wave_m, 1.0)
        if phase_rad.std() > 0 and changed[kept].std() > 0:
            correlation[number] = np.corrcoef(changed[kept], phase_rad)[0, 1]
    covered = np.array([log.inside(echo.time_s + offset_s).mean() >= LEAST_COVERED for offset_s in offsets_s])
    if not covered.any():
        raise ValueError("no offset puts half of the pulses inside the log")
    # Offsets within three standard deviations, (1 − r²)/√n, of the best correlation r.
    best = float(correlation.max())
    independent = max(4.0, len(change) * float(np.median(interval_s)) * 4)  # samples; motion correlates over 0.25 s
    std = (1 - max(best, 0.0) ** 2) / np.sqrt(independent)
    kept = offsets_s[covered & (correlation >= best - _SIGMA * std)] if best > _SIGMA * std else offsets_s[covered]
    margin_s = _MARGIN * step_s
    return max(within_s[0], float(kept[0]) - margin_s), min(within_s[1], float(kept[-1]) + margin_s)
