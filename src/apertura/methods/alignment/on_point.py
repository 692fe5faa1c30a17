"""Offset and drift of a recorder's clock against its log's, and its path beyond geometry, at a known point."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.echo.compression import phasors, rotated
from apertura.methods.autofocus.motion import Logged, Recorded, plausible_offsets

# ---- Offset and path by coherent sum at a known point ---------------------------------------------------------------

MOST_PULSES = 1024
"""Of a recording, evenly spread, on which offsets are tried: the search costs one sum per offset."""

AMBIGUITY_DB = -1.0
"""Power of the second best offset against the best from which the best is ambiguous."""

LEAST_CONTRAST_DB = 6.0
"""Peak over the median of all offsets: less is chance."""

_STEPS_PER_WAVE = 8  # offsets per wavelength of change of the fastest path
_OVERSAMPLING = 8  # of paths
_WIDTH_DB = -1.0  # level of the peak at which widths are measured


@dataclass(frozen=True)
class Alignment:
    """Offset, path and drift of a recorder against its log.

    Attributes
    ----------
    offset_s, path_m
        To add to the recorder's times, seconds; electrical path beyond geometry, metres of total path.
    offset_width_s, path_width_m
        Errors of offset and path that lower the peak by a decibel.
    contrast_db
        Peak over the median of all offsets.
    report
        Method and search, as JSON values.
    drift_ppm
        Further microseconds to add for every second since the first pulse.
    flags
        Flag → what was measured, in one line.
    """

    offset_s: float
    path_m: float
    offset_width_s: float
    path_width_m: float
    contrast_db: float
    report: Mapping[str, Any] = field(default_factory=dict)
    drift_ppm: float = 0.0
    flags: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PointSharpness:
    """Coherent sum of echoes at one point, by offset and path.

    Attributes
    ----------
    echo, log
        Echoes by the recorder's clock; antennas by the log's.
    point_m
        (3,) float64, metres, in the frame of the antennas.
    """

    echo: Recorded
    log: Logged
    point_m: Floats

    def spectrum(self, offset_s: float) -> Complexes:
        """Return (subcarrier,) complex128: pulses turned to the point's path and added, weighed by the way flown."""
        at_s = self.echo.time_s + offset_s
        kept = self.log.inside(at_s)
        some, speed = self.echo[kept], self.log.speeds_m_s(at_s)[kept]
        paths_m = self.log.phase_centres(at_s[kept]).path(self.point_m)
        paths_s = paths_m / self.echo.wave_speed_m_s - some.reference_delay_s
        frequency = self.echo.frequency_hz
        spacing_hz = float(frequency[-1] - frequency[0]) / (frequency.size - 1)
        weight = speed / max(float(speed.sum()), 1e-30)
        start = rotated(weight, paths_s * frequency[0])[:, None]
        taper = np.hanning(frequency.size + 2)[1:-1]
        summed: Complexes = (some.transfer * (start * phasors(paths_s * spacing_hz, frequency.size))).sum(0)
        return np.asarray(summed * (taper / taper.sum()), np.complex64)

    def powers(self, offset_s: float) -> tuple[Floats, Floats]:
        """Return paths beyond geometry (m), over the unambiguous range, and the power of the point at each."""
        frequency = self.echo.frequency_hz
        length = _OVERSAMPLING * frequency.size
        spacing_hz = float(frequency[-1] - frequency[0]) / (frequency.size - 1)
        power = np.abs(np.fft.ifft(self.spectrum(offset_s), length) * length) ** 2
        path_m = np.fft.fftfreq(length) * SPEED_OF_LIGHT_M_S / spacing_hz
        order = np.argsort(path_m)
        return np.asarray(path_m[order], np.float64), np.asarray(power[order], np.float64)

    def power(self, offset_s: float, path_m: float) -> float:
        """Return the power of the point at one offset and path."""
        turns = self.echo.frequency_hz * (path_m / SPEED_OF_LIGHT_M_S)
        return float(np.abs(self.spectrum(offset_s) @ np.exp(2j * np.pi * turns)) ** 2)


def align_on_point(
    echo: Recorded, log: Logged, point_m: Floats, *, within_s: tuple[float, float], search_m: float
) -> Alignment:
    """Return the offset and the path at which echoes add up best at a point whose place is known.

    Parameters
    ----------
    echo, log
        Echoes by the recorder's clock; antennas by the log's.
    point_m
        (3,) float64, metres, in the frame of the antennas.
    within_s
        Least and largest offset to consider, seconds.
    search_m
        Paths of either sign up to this are searched, metres; 0: the path is fixed.

    Raises
    ------
    ValueError
        If no offset puts half of the pulses inside the log, or nothing adds up.

    Notes
    -----
    Source: docs/theory/tracks.md, "Clock of the recorder".
    """
    some = echo.moving()[:: -(-len(echo) // MOST_PULSES)]
    low, high = plausible_offsets(echo, log, within_s)
    sharpness = PointSharpness(some, log, point_m)
    # J(δ, b) on a grid of offsets, at all paths of each by one FFT.
    offsets_s = offset_steps(some, log, low, high)
    searched = [sharpness.powers(offset_s) for offset_s in offsets_s]
    near = np.abs(searched[0][0]) <= max(search_m, 1e-9)
    paths_m, power = searched[0][0][near], np.array([one[near] for _, one in searched])
    row, column = np.unravel_index(int(power.argmax()), power.shape)
    # Its maximum, the widths at a decibel below, and the contrast against all that was searched.
    found = refine_maximum(
        sharpness.power, float(offsets_s[row]), float(paths_m[column]), _steps(offsets_s, paths_m, search_m)
    )
    peak_width = peak_widths(sharpness.power, *found, _steps(offsets_s, paths_m, search_m))
    contrast_db = decibels(sharpness.power(*found) / max(float(np.median(power)), 1e-300))
    flags = alignment_flags(power.max(axis=1), offsets_s, found[0], peak_width[0], contrast_db)
    report = {"method": "point", "plausible_s": [round(low, 3), round(high, 3)], "pulses": len(some)}
    return Alignment(*found, *peak_width, contrast_db, report, flags=flags)


def offset_steps(echo: Recorded, log: Logged, low: float, high: float) -> Floats:
    """Return offsets in steps over which no path changes by more than an eighth of a wave."""
    step_s = offset_step_s(echo, log)
    return np.arange(low, high + step_s, step_s)


def offset_step_s(echo: Recorded, log: Logged) -> float:
    """Return the time over which no path changes by more than an eighth of a wave, seconds."""
    times_s = np.linspace(log.first_s, log.last_s, 2048)
    fastest = float(np.quantile(log.speeds_m_s(times_s), 0.95))
    return echo.shortest_wave_m / (_STEPS_PER_WAVE * max(fastest, 1e-6))


def _steps(offsets_s: Floats, paths_m: Floats, search_m: float) -> tuple[float, float]:
    """Return the steps between offsets and paths; that of paths is 0 where the path is fixed."""
    return float(offsets_s[1] - offsets_s[0]), float(paths_m[1] - paths_m[0]) if search_m > 0 else 0.0


def refine_maximum(
    power: Callable[[float, float], float], offset_s: float, path_m: float, steps: tuple[float, float]
) -> tuple[float, float]:
    """Return offset and path of the maximum next to a node of the search grid."""
    from scipy.optimize import minimize  # slow to import

    def falls(at: Floats) -> float:
        return -power(offset_s + at[0] * steps[0], path_m + at[-1] * steps[1])

    free = 2 if steps[1] else 1
    simplex = np.vstack([np.zeros(free), np.eye(free)])
    done = minimize(falls, np.zeros(free), method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 1e-3})
    return offset_s + float(done.x[0]) * steps[0], path_m + float(done.x[-1]) * steps[1]


def peak_widths(
    power: Callable[[float, float], float], offset_s: float, path_m: float, steps: tuple[float, float]
) -> tuple[float, float]:
    """Return the errors of offset and path that each lower the peak by a decibel."""
    least = power(offset_s, path_m) * 10 ** (_WIDTH_DB / 10)

    def width(step: float, at: Callable[[float], float]) -> float:
        reach = step / 8
        while reach < 64 * step and min(at(reach), at(-reach)) > least:
            reach *= 1.1
        return reach

    path_width = width(steps[1], lambda apart: power(offset_s, path_m + apart)) if steps[1] else 0.0
    return width(steps[0], lambda apart: power(offset_s + apart, path_m)), path_width


def alignment_flags(power: Floats, offsets_s: Floats, best_s: float, width_s: float, contrast_db: float) -> Flags:
    """Return flags of an offset: ambiguous, at the edge of the search, of little contrast."""
    flags = Flags()
    away = np.abs(offsets_s - best_s) > 4 * width_s
    second = float(power.max(initial=0.0, where=away)) / float(power.max())
    if second > 10 ** (AMBIGUITY_DB / 10):
        other_s = float(offsets_s[np.where(away, power, 0.0).argmax()])
        flags["alignment_ambiguous"] = f"an offset of {other_s:.3f} s is only {-decibels(second):.1f} dB worse"
    if 2 * width_s > offsets_s[-1] - offsets_s[0]:
        flags["alignment_ambiguous"] = f"all offsets from {offsets_s[0]:.3f} to {offsets_s[-1]:.3f} s do as well"
    if min(best_s - offsets_s[0], offsets_s[-1] - best_s) < width_s:
        flags["alignment_at_edge"] = f"{best_s:.3f} s lies at an end of {offsets_s[0]:.3f} to {offsets_s[-1]:.3f} s"
    if contrast_db < LEAST_CONTRAST_DB:
        flags["alignment_uncertain"] = f"the best offset is only {contrast_db:.1f} dB above the others"
    return flags


# ---- Drift of a recorder's clock against its log's ------------------------------------------------------------------

MOST_PPM = 200.0
"""Largest drift searched, parts per million: crystal oscillators are within."""


def apply_drift(time_s: Floats, drift_ppm: float) -> Floats:
    """Return times of a recorder corrected for a clock that is slow by `drift_ppm`, about their middle.

    Examples
    --------
    >>> apply_drift(np.array([0.0, 50.0, 100.0]), 20.0).round(6).tolist()
    [-0.001, 50.0, 100.001]
    """
    middle_s = (time_s[0] + time_s[-1]) / 2
    return np.asarray(middle_s + (time_s - middle_s) * (1 + drift_ppm * 1e-6))


def estimate_drift(found: Alignment, echo: Recorded, log: Logged, point_m: Floats) -> Alignment:
    """Return an alignment with the drift at which echoes add up best at a known point, if the recording resolves it.

    Parameters
    ----------
    found
        Without drift.
    echo, log
        Echoes by the recorder's clock; antennas by the log's.
    point_m
        (3,) float64, metres, in the frame of the antennas.

    Notes
    -----
    Source: docs/theory/tracks.md, "Clock of the recorder". Drift is taken about the middle of the recording, where it
    is independent of the offset; what is returned counts from the first pulse, as config/clocks.tsv does. A drift that
    moves no path by an eighth of a wave over half of the recording is not estimated.
    """
    from scipy.optimize import minimize  # slow to import

    some = echo.moving()[:: -(-len(echo) // MOST_PULSES)]
    time_s = some.time_s
    half_s = float(time_s[-1] - time_s[0]) / 2
    step_ppm = 1e6 * offset_step_s(echo, log) / max(half_s, 1e-12)
    if step_ppm > MOST_PPM:
        return replace(found, report={**found.report, "drift": f"not observable: {step_ppm:.0f} ppm move no path"})

    def power(ppm: float, offset_s: float, path_m: float) -> float:
        times_s = apply_drift(time_s, ppm)
        return PointSharpness(replace(some, time_s=times_s), log, point_m).power(offset_s, path_m)

    # Drift alone on a grid, then with offset and path, those that are free, by the simplex method.
    tried = np.arange(-MOST_PPM, MOST_PPM + step_ppm, step_ppm)
    at = found.offset_s, found.path_m
    best = float(tried[int(np.argmax([power(ppm, *at) for ppm in tried]))])
    steps = np.array([found.offset_width_s / 2, max(found.path_width_m, 0.0) / 2, step_ppm])
    free = np.flatnonzero(steps)

    def moved(by: Floats) -> tuple[float, float, float]:
        full = np.zeros(3)
        full[free] = by
        offset_s, path_m, ppm = np.array([*at, best]) + full * steps
        return float(offset_s), float(path_m), float(ppm)

    def falls(by: Floats) -> float:
        offset_s, path_m, ppm = moved(by)
        return -power(ppm, offset_s, path_m)

    simplex = np.vstack([np.zeros(free.size), np.eye(free.size)])
    done = minimize(falls, np.zeros(free.size), method="Nelder-Mead", options={"initial_simplex": simplex})
    offset_s, path_m, ppm = moved(done.x)
    gain_db = decibels(-done.fun / max(power(0.0, *at), 1e-300))
    first_s = float(apply_drift(time_s, ppm)[0] - time_s[0])
    report = {**found.report, "drift": f"{gain_db:.2f} dB better than without"}
    return replace(found, offset_s=offset_s + first_s, path_m=path_m, drift_ppm=ppm, report=report)
