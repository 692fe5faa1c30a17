"""Calibration on a reflector at a known position: path offset of a node, and echo phase from pulse to pulse."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.special import gammainccinv, gammaincinv

from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.echo.captures import AT_ONCE

FALSE_REFLECTOR = 1e-3
"""Probability that clutter or noise alone is detected as a reflector."""

NEEDED_STD_M = 0.02
"""Standard deviation of a path offset, metres, above which coherent sums of several nodes are defocused."""

RIVAL_DB = -6.0
"""Level of a second echo relative to the reflector, dB, above which the identification of the reflector is uncertain.
"""

_GROUPS = 16
_OVERSAMPLING = 8


class Pulses(Protocol):
    """(pulse, subcarrier) complex64: an array, or an object that reads slices of an array."""

    def __len__(self) -> int: ...

    def __getitem__(self, pulses: slice, /) -> Complexes: ...


@dataclass(frozen=True)
class PathOffset:
    """Electrical path of a receiving node in addition to the geometric path.

    Attributes
    ----------
    offset_m
        Offset of the total path, metres. Monostatic: `path_offset_m.radar`. Bistatic: offset of the radar channel minus
        that of the sidelink channel, the only combination observable in echoes divided by the sidelink.
    std_m
        Standard deviation of the offset, from the scatter over sixteenths and quarters of the flight; infinite for
        fewer than 16 pulses.
    contrast_db
        Power of the reflector relative to the surroundings, dB.
    pulses
        Number of pulses used.
    flags
        Flag → measured values, one line.
    """

    offset_m: float
    std_m: float
    contrast_db: float
    pulses: int
    flags: Mapping[str, str]


def estimate_path_offset(
    transfer: Pulses,
    frequency_hz: Floats,
    *,
    path_m: Floats,
    search_m: float = 10.0,
    where: str = "calibration flight",
) -> PathOffset:
    """Estimate the path offset of a node from the echo of a reflector at a known position.

    Parameters
    ----------
    transfer
        (pulse, subcarrier) complex64: Σ a·exp(-j2πfτ) with absolute delays, in which the path offset is included. An
        array, or an object that reads slices of an array from a file.
    frequency_hz
        (subcarrier,) float64, RF frequencies, equally spaced, ascending.
    path_m
        (pulse,) float64, predicted total path tx → reflector → rx, minus the sidelink path in a bistatic pair, metres.
    search_m
        Largest offset of either sign that is searched, metres.
    where
        Name of the flight in error messages.

    Raises
    ------
    CampaignError
        If no reflector is detected within `search_m`.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Calibration". Pulses are added coherently within each sixteenth of the flight,
    over which track errors are nearly constant. The powers of the sixteenths are added.

    Examples
    --------
    >>> frequency, path = 1e9 + 1e6 * np.arange(200), np.hypot(20, np.linspace(-5, 5, 64)) * 2
    >>> echo = np.exp(-2j * np.pi * frequency * (path[:, None] + 1.374) / SPEED_OF_LIGHT_M_S)
    >>> calibration = estimate_path_offset(echo.astype(np.complex64), frequency, path_m=path)
    >>> round(calibration.offset_m, 3), calibration.std_m < 0.001
    (1.374, True)
    """
    groups = _aligned_groups(transfer, frequency_hz, path_m)
    offset_m, power = _offset_profile(groups, frequency_hz, search_m)
    peak = int(np.argmax(power))
    surroundings = float(np.median(power)) * len(groups) / float(gammaincinv(len(groups), 0.5))  # mean of clutter
    _require_visible(power, peak, surroundings, len(groups), search_m, where)
    group_offsets_m = _refine(groups, frequency_hz, offset_m[peak])
    mean_m, std_m = float(group_offsets_m.mean()), _deviation_of_mean(group_offsets_m)
    contrast_db = decibels(float(power[peak]) / max(surroundings, 1e-30))
    flags = Flags()
    if std_m > NEEDED_STD_M:
        flags["calibration_uncertain"] = f"path offset {mean_m:.3f} ± {std_m:.3f} m; tolerated ± {NEEDED_STD_M} m"
    rival_db, rival_m = _rival(offset_m, power, peak, frequency_hz)
    if rival_db > RIVAL_DB:
        flags["calibration_ambiguous"] = (
            f"a second reflector, {rival_db:.1f} dB relative to the first, has a path offset of {rival_m:.2f} m; the "
            f"first has {mean_m:.2f} m"
        )
    return PathOffset(mean_m, std_m, contrast_db, len(transfer), flags)


def reflector_history(transfer: Pulses, frequency_hz: Floats, *, path_m: Floats) -> NDArray[np.complex128]:
    """Return the echo of a reflector, (pulse,) complex128; the phase is constant if path and clocks are correct.

    Parameters
    ----------
    transfer, frequency_hz
        As for `estimate_path_offset`.
    path_m
        (pulse,) float64, total path of the reflector including offsets, metres; constant in a static recording.

    Examples
    --------
    >>> frequency, path = 1e9 + 1e6 * np.arange(200), np.array([40.0, 41.0])
    >>> echo = 2 * np.exp(-2j * np.pi * frequency * path[:, None] / SPEED_OF_LIGHT_M_S).astype(np.complex64)
    >>> reflector_history(echo, frequency, path_m=path).round(4) + 0.0
    array([2.+0.j, 2.+0.j])
    """
    blocks = (slice(first, first + AT_ONCE) for first in range(0, len(transfer), AT_ONCE))
    return np.concatenate([_aligned(transfer[block], frequency_hz, path_m[block]).mean(axis=1) for block in blocks])


def _aligned(transfer: Complexes, frequency_hz: Floats, path_m: Floats) -> NDArray[np.complex128]:
    cycles = np.outer(path_m / SPEED_OF_LIGHT_M_S, frequency_hz)
    return np.asarray(transfer * np.exp(2j * np.pi * (cycles % 1.0)))


def _aligned_groups(transfer: Pulses, frequency_hz: Floats, path_m: Floats) -> NDArray[np.complex128]:
    """Return the mean of the pulses of each group, aligned to the predicted path, (group, subcarrier)."""
    taper = np.hanning(frequency_hz.size + 2)[1:-1]
    edges = np.linspace(0, len(transfer), min(_GROUPS, len(transfer)) + 1).astype(int)
    return np.array([_mean(transfer, frequency_hz, path_m, *ends) * taper for ends in pairwise(edges)])


def _mean(transfer: Pulses, frequency_hz: Floats, path_m: Floats, first: int, last: int) -> NDArray[np.complex128]:
    """Return the mean of pulses first to last, (subcarrier,), aligned to the predicted path, block by block."""
    total = np.zeros(len(frequency_hz), np.complex128)
    for start in range(first, last, AT_ONCE):
        block = slice(start, min(start + AT_ONCE, last))
        total += _aligned(transfer[block], frequency_hz, path_m[block]).sum(axis=0)
    return total / (last - first)


def _offset_profile(groups: NDArray[np.complex128], frequency_hz: Floats, search_m: float) -> tuple[Floats, Floats]:
    """Return the offsets that are searched, metres, and the mean power of the groups at each offset."""
    length = scipy.fft.next_fast_len(_OVERSAMPLING * frequency_hz.size)
    spacing_hz = float(frequency_hz[-1] - frequency_hz[0]) / (frequency_hz.size - 1)
    step_m = SPEED_OF_LIGHT_M_S / (spacing_hz * length)
    reach = min(int(search_m / step_m), length // 2 - 1)
    power = (np.abs(scipy.fft.ifft(groups, length, axis=1)) ** 2).mean(0)
    cells = np.arange(-reach, reach + 1)
    return cells * step_m, np.asarray(power[cells])


def _require_visible(power: Floats, peak: int, surroundings: float, groups: int, search_m: float, where: str) -> None:
    """Raise CampaignError if the peak is at the edge, or not above the maximum expected from clutter alone."""
    cells = power.size / _OVERSAMPLING
    highest = gammainccinv(groups, FALSE_REFLECTOR / cells) / groups
    ratio_db, needed_db = (decibels(r) for r in (power[peak] / max(surroundings, 1e-30), highest))
    inside = 0 < peak < power.size - 1
    if ratio_db > needed_db and inside:
        return
    at_edge = "" if inside else " and lies at the edge of the search interval"
    raise CampaignError(
        f"no reflector: the strongest echo within {search_m:g} m of the predicted path is {ratio_db:.1f} dB above "
        f"the mean of the surroundings{at_edge}",
        where=where,
        expected=f"an echo of more than {needed_db:.1f} dB inside the search interval",
        remedy="Check that the coordinates of the reflector are correct and that the reflector was in the beam; or "
        "increase calibration.search_m.",
    )


def _refine(groups: NDArray[np.complex128], frequency_hz: Floats, start_m: float) -> Floats:
    """Maximise the power of each group by Newton's method within half a cell of the start; return (group,) metres."""
    cell_m = SPEED_OF_LIGHT_M_S / float(frequency_hz[-1] - frequency_hz[0])
    phase_per_m = 2j * np.pi * (frequency_hz - frequency_hz.mean()) / SPEED_OF_LIGHT_M_S
    offset = np.full(len(groups), start_m)
    for _ in range(8):
        aligned = groups * np.exp(np.outer(offset, phase_per_m))
        total, first, second = aligned.sum(1), aligned @ phase_per_m, aligned @ phase_per_m**2
        slope = 2 * np.real(total.conj() * first)
        curvature = 2 * (np.abs(first) ** 2 + np.real(total.conj() * second))
        step = np.clip(-slope / np.where(curvature < 0, curvature, -np.inf), -cell_m / 8, cell_m / 8)
        offset = np.clip(offset + step, start_m - cell_m / 2, start_m + cell_m / 2)
    return offset


def _deviation_of_mean(offsets_m: Floats) -> float:
    """Return the standard deviation of the mean offset; adjacent groups may have common track errors."""
    if len(offsets_m) < _GROUPS:
        return np.inf
    quarters_m = offsets_m.reshape(4, -1).mean(1)
    return float(max(np.std(values, ddof=1) / np.sqrt(len(values)) for values in (offsets_m, quarters_m)))


def _rival(offset_m: Floats, power: Floats, peak: int, frequency_hz: Floats) -> tuple[float, float]:
    """Return level (dB) and offset of the strongest echo outside the main lobe of 2·c/B on each side."""
    cell_m = SPEED_OF_LIGHT_M_S / float(frequency_hz[-1] - frequency_hz[0])
    outside = np.where(np.abs(offset_m - offset_m[peak]) > 2.5 * cell_m, power, 0.0)
    second = int(np.argmax(outside))
    return decibels(float(outside[second] / power[peak])), float(offset_m[second])
