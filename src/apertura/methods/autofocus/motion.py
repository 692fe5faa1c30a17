"""Motion of a node by its log and by echoes that change from pulse to pulse: plausible clock offsets."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.core.geometry.aperture import Aperture

PhaseCentres = Callable[[Floats], Aperture]
"""Seconds of the log's clock (time,), inside the log → phase centres."""

LEAST_COVERED = 0.5
"""Share of the pulses that must lie inside the log."""

_MARGIN = 8  # pulses added on both sides of the plausible offsets
_SIGMA = 3.0  # standard deviations below the best correlation at which offsets are ruled out


@dataclass(frozen=True, eq=False)
class Recorded:
    """Echoes by a recorder's clock, of one node that sends and receives.

    Attributes
    ----------
    transfer
        (pulse, subcarrier) complex64: Σ a·exp(-j2πf(τ - reference_delay_s)).
    frequency_hz
        (subcarrier,) float64, ascending in equal steps.
    reference_delay_s
        (pulse,) float64.
    time_s
        (pulse,) float64, seconds by the recorder, ascending.
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
        """Return the echoes less what all pulses have in common: coupling, and echoes of a node at rest."""
        return replace(self, transfer=self.transfer - self.transfer.mean(axis=0))


@dataclass(frozen=True, eq=False)
class Logged:
    """Positions of the antennas, by the log's clock.

    Attributes
    ----------
    phase_centres
        Times inside the log → phase centres.
    first_s, last_s
        Times of its first and last epoch.
    """

    phase_centres: PhaseCentres
    first_s: float
    last_s: float

    def inside(self, at_s: Floats) -> NDArray[np.bool_]:
        """Return (time,) bool, those between its ends."""
        return (at_s >= self.first_s) & (at_s <= self.last_s)

    def speeds_m_s(self, at_s: Floats) -> Floats:
        """Return (time,) float64, by how much the total path of what lies ahead changes each second; 0 outside."""
        speed = np.zeros(len(at_s))
        kept = self.inside(at_s)
        if kept.sum() > 1:
            centres = self.phase_centres(at_s[kept]).tx_m
            speed[kept] = 2 * np.linalg.norm(np.gradient(centres, at_s[kept], axis=0), axis=1)
        return speed


def plausible_offsets(echo: Recorded, log: Logged, within_s: tuple[float, float]) -> tuple[float, float]:
    """Return the least and the largest offset at which the node moves when its echoes change, seconds.

    Parameters
    ----------
    echo, log
        What was recorded, and flown.
    within_s
        Least and largest offset to consider, seconds.

    Notes
    -----
    Source: docs/theory/tracks.md, "Clock of the recorder". Compared are how much a pulse differs from the one before,
    and how far the node went meanwhile, up to half a wavelength, beyond which pulses are uncorrelated. Where the
    node moves uniformly nothing is ruled out.
    """
    # |H_p − H_{p−1}|/|H_p|, between pulses, and the node's speed on a grid of the log's times.
    change = np.linalg.norm(np.diff(echo.transfer, axis=0), axis=1) / np.linalg.norm(echo.transfer[1:], axis=1)
    middle_s, interval_s = (echo.time_s[1:] + echo.time_s[:-1]) / 2, np.diff(echo.time_s)
    step_s = max(float(np.median(interval_s)), (within_s[1] - within_s[0]) / 4096)
    grid_s = np.arange(log.first_s, log.last_s, float(np.median(interval_s)) / 2)
    flown = log.speeds_m_s(grid_s)
    offsets_s = np.arange(within_s[0], within_s[1] + step_s / 2, step_s)
    alike = np.full(len(offsets_s), -1.0)
    changed = np.log(np.maximum(change, 1e-12))
    # Its correlation with min(4π·v(t + δ)·Δt/λ, 1) for each offset; −1 where too few pulses lie inside the log.
    for number, offset_s in enumerate(offsets_s):
        kept = log.inside(middle_s + offset_s)
        if kept.mean() < LEAST_COVERED:
            continue
        moved_m = np.interp(middle_s[kept] + offset_s, grid_s, flown) * interval_s[kept]
        turned_by = np.minimum(2 * np.pi * moved_m / echo.shortest_wave_m, 1.0)
        if turned_by.std() > 0 and changed[kept].std() > 0:
            alike[number] = np.corrcoef(changed[kept], turned_by)[0, 1]
    covered = np.array([log.inside(echo.time_s + offset_s).mean() >= LEAST_COVERED for offset_s in offsets_s])
    if not covered.any():
        raise ValueError("no offset puts half of the pulses inside the log")
    # Offsets within three deviations, (1 − r²)/√n, of the best correlation r.
    best = float(alike.max())
    independent = max(4.0, len(change) * float(np.median(interval_s)) * 4)  # motion lasts a quarter of a second or more
    std = (1 - max(best, 0.0) ** 2) / np.sqrt(independent)
    kept = offsets_s[covered & (alike >= best - _SIGMA * std)] if best > _SIGMA * std else offsets_s[covered]
    apart_s = _MARGIN * step_s
    return max(within_s[0], float(kept[0]) - apart_s), min(within_s[1], float(kept[-1]) + apart_s)
