"""Clock offset, clock drift and path offset of a recorder, estimated from the echoes of a known point."""

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
"""Maximum number of pulses, evenly spaced over the recording, that are summed for each trial offset."""

AMBIGUITY_DB = -1.0
"""Level of the second-best offset relative to the best, dB, above which the best is ambiguous."""

LEAST_CONTRAST_DB = 6.0
"""Minimum ratio of the peak power to the median over all offsets for a significant peak, dB."""

_STEPS_PER_WAVE = 8  # offset steps per wavelength of the fastest-changing path
_OVERSAMPLING = 8  # oversampling of paths
_WIDTH_DB = -1.0  # level below the peak at which widths are measured


@dataclass(frozen=True)
class Alignment:
    """Clock offset, path offset and clock drift of a recorder relative to its log.

    Attributes
    ----------
    offset_s, path_m
        Offset to add to the recorder's times, seconds; electrical path in excess of the geometric path, metres of total
        path.
    offset_width_s, path_width_m
        Errors of offset and path that lower the peak by 1 dB.
    contrast_db
        Peak power over the median of all offsets, dB.
    report
        Method and search, as JSON values.
    drift_ppm
        Microseconds to add for every second since the first pulse, in addition to the offset.
    flags
        Flag → measured values, one line.
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
    """Power of the coherent sum of echoes at one point, as a function of clock offset and path.

    Attributes
    ----------
    echo, log
        Echoes on the recorder's clock; antenna positions on the log's clock.
    point_m
        (3,) float64, metres, in the frame of the antennas.
    """

    echo: Recorded
    log: Logged
    point_m: Floats

    def spectrum(self, offset_s: float) -> Complexes:
        """Return (subcarrier,) complex64: sum of pulses with the path to the point compensated, weighted by speed."""
        at_s = self.echo.time_s + offset_s
        kept = self.log.inside(at_s)
        pulses, speed = self.echo[kept], self.log.speeds_m_s(at_s)[kept]
        paths_m = self.log.phase_centres(at_s[kept]).path(self.point_m)
        paths_s = paths_m / self.echo.wave_speed_m_s - pulses.reference_delay_s
        frequency = self.echo.frequency_hz
        spacing_hz = float(frequency[-1] - frequency[0]) / (frequency.size - 1)
        weight = speed / max(float(speed.sum()), 1e-30)
        start = rotated(weight, paths_s * frequency[0])[:, None]
        taper = np.hanning(frequency.size + 2)[1:-1]
        summed: Complexes = (pulses.transfer * (start * phasors(paths_s * spacing_hz, frequency.size))).sum(0)
        return np.asarray(summed * (taper / taper.sum()), np.complex64)

    def powers(self, offset_s: float) -> tuple[Floats, Floats]:
        """Return path offsets (m) over the unambiguous range, and the power of the point at each path offset."""
        frequency = self.echo.frequency_hz
        length = _OVERSAMPLING * frequency.size
        spacing_hz = float(frequency[-1] - frequency[0]) / (frequency.size - 1)
        power = np.abs(np.fft.ifft(self.spectrum(offset_s), length) * length) ** 2
        path_m = np.fft.fftfreq(length) * SPEED_OF_LIGHT_M_S / spacing_hz
        order = np.argsort(path_m)
        return np.asarray(path_m[order], np.float64), np.asarray(power[order], np.float64)

    def power(self, offset_s: float, path_m: float) -> float:
        """Return the power of the point at one offset and one path."""
        cycles = self.echo.frequency_hz * (path_m / SPEED_OF_LIGHT_M_S)
        return float(np.abs(self.spectrum(offset_s) @ np.exp(2j * np.pi * cycles)) ** 2)


def align_on_point(
    echo: Recorded, log: Logged, point_m: Floats, *, within_s: tuple[float, float], search_m: float
) -> Alignment:
    """Estimate the clock offset and path at which the coherent sum of echoes at a known point is largest.

    Parameters
    ----------
    echo, log
        Echoes on the recorder's clock; antenna positions on the log's clock.
    point_m
        (3,) float64, metres, in the frame of the antennas.
    within_s
        Smallest and largest offset to search, seconds.
    search_m
        Largest magnitude of the searched path offsets, metres; 0 keeps the path offset fixed.

    Raises
    ------
    ValueError
        If no offset puts half of the pulses inside the log.

    Notes
    -----
    Source: docs/theory/tracks.md, "Clock of the recorder".
    """
    pulses = echo.moving()[:: -(-len(echo) // MOST_PULSES)]
    low, high = plausible_offsets(echo, log, within_s)
    sharpness = PointSharpness(pulses, log, point_m)
    # J(δ, b) on a grid of offsets, with all paths of an offset from one FFT.
    offsets_s = offset_steps(pulses, log, low, high)
    searched = [sharpness.powers(offset_s) for offset_s in offsets_s]
    within = np.abs(searched[0][0]) <= max(search_m, 1e-9)
    paths_m, power = searched[0][0][within], np.array([powers[within] for _, powers in searched])
    row, column = np.unravel_index(int(power.argmax()), power.shape)
    # Maximum of J, its widths 1 dB below the peak, and its contrast relative to the median of the search.
    refined = refine_maximum(
        sharpness.power, float(offsets_s[row]), float(paths_m[column]), _steps(offsets_s, paths_m, search_m)
    )
    peak_width = peak_widths(sharpness.power, *refined, _steps(offsets_s, paths_m, search_m))
    contrast_db = decibels(sharpness.power(*refined) / max(float(np.median(power)), 1e-300))
    flags = alignment_flags(power.max(axis=1), offsets_s, refined[0], peak_width[0], contrast_db)
    report = {"method": "point", "plausible_s": [round(low, 3), round(high, 3)], "pulses": len(pulses)}
    return Alignment(*refined, *peak_width, contrast_db, report, flags=flags)


def offset_steps(echo: Recorded, log: Logged, low: float, high: float) -> Floats:
    """Return offsets at intervals in which no path changes by more than an eighth of a wavelength."""
    step_s = offset_step_s(echo, log)
    return np.arange(low, high + step_s, step_s)


def offset_step_s(echo: Recorded, log: Logged) -> float:
    """Return the time during which no path changes by more than an eighth of a wavelength, seconds."""
    times_s = np.linspace(log.first_s, log.last_s, 2048)
    fastest = float(np.quantile(log.speeds_m_s(times_s), 0.95))
    return echo.shortest_wave_m / (_STEPS_PER_WAVE * max(fastest, 1e-6))


def _steps(offsets_s: Floats, paths_m: Floats, search_m: float) -> tuple[float, float]:
    """Return the step sizes of offsets and paths; the path step is 0 if the path is fixed."""
    return float(offsets_s[1] - offsets_s[0]), float(paths_m[1] - paths_m[0]) if search_m > 0 else 0.0


def refine_maximum(
    power: Callable[[float, float], float], offset_s: float, path_m: float, steps: tuple[float, float]
) -> tuple[float, float]:
    """Return the offset and path of the maximum next to a point of the search grid."""
    from scipy.optimize import minimize  # slow to import

    def negative_power(at: Floats) -> float:
        return -power(offset_s + at[0] * steps[0], path_m + at[-1] * steps[1])

    free_count = 2 if steps[1] else 1
    simplex = np.vstack([np.zeros(free_count), np.eye(free_count)])
    options = {"initial_simplex": simplex, "xatol": 1e-3}
    result = minimize(negative_power, np.zeros(free_count), method="Nelder-Mead", options=options)
    return offset_s + float(result.x[0]) * steps[0], path_m + float(result.x[-1]) * steps[1]


def peak_widths(
    power: Callable[[float, float], float], offset_s: float, path_m: float, steps: tuple[float, float]
) -> tuple[float, float]:
    """Return the error of the offset and the error of the path that each lower the peak by 1 dB."""
    least = power(offset_s, path_m) * 10 ** (_WIDTH_DB / 10)

    def width(step: float, at: Callable[[float], float]) -> float:
        reach = step / 8
        while reach < 64 * step and min(at(reach), at(-reach)) > least:
            reach *= 1.1
        return reach

    path_width = width(steps[1], lambda error_m: power(offset_s, path_m + error_m)) if steps[1] else 0.0
    return width(steps[0], lambda error_s: power(offset_s + error_s, path_m)), path_width


def alignment_flags(power: Floats, offsets_s: Floats, best_s: float, width_s: float, contrast_db: float) -> Flags:
    """Return the flags of an offset that is ambiguous, at the edge of the search, or has low contrast."""
    flags = Flags()
    away = np.abs(offsets_s - best_s) > 4 * width_s
    second = float(power.max(initial=0.0, where=away)) / float(power.max())
    if second > 10 ** (AMBIGUITY_DB / 10):
        other_s = float(offsets_s[np.where(away, power, 0.0).argmax()])
        line = f"the peak at an offset of {other_s:.3f} s is only {-decibels(second):.1f} dB lower"
        flags["alignment_ambiguous"] = line
    if 2 * width_s > offsets_s[-1] - offsets_s[0]:
        line = f"all searched offsets, {offsets_s[0]:.3f} to {offsets_s[-1]:.3f} s, fit equally well"
        flags["alignment_ambiguous"] = line
    if min(best_s - offsets_s[0], offsets_s[-1] - best_s) < width_s:
        searched = f"{offsets_s[0]:.3f} to {offsets_s[-1]:.3f} s"
        flags["alignment_at_edge"] = f"the best offset, {best_s:.3f} s, lies at the edge of the search, {searched}"
    if contrast_db < LEAST_CONTRAST_DB:
        line = f"the peak at the best offset is only {contrast_db:.1f} dB above the median of all offsets"
        flags["alignment_uncertain"] = line
    return flags


# ---- Drift of the recorder's clock relative to the log's clock ------------------------------------------------------

MOST_PPM = 200.0
"""Largest drift searched, parts per million: the drift of crystal oscillators is smaller."""


def apply_drift(time_s: Floats, drift_ppm: float) -> Floats:
    """Correct the times of a recorder for a clock that is slow by `drift_ppm`; the mid-time remains unchanged.

    Examples
    --------
    >>> apply_drift(np.array([0.0, 50.0, 100.0]), 20.0).round(6).tolist()
    [-0.001, 50.0, 100.001]
    """
    middle_s = (time_s[0] + time_s[-1]) / 2
    return np.asarray(middle_s + (time_s - middle_s) * (1 + drift_ppm * 1e-6))


def estimate_drift(alignment: Alignment, echo: Recorded, log: Logged, point_m: Floats) -> Alignment:
    """Add the drift that maximises the coherent sum at a known point to an alignment, if the drift is observable.

    Parameters
    ----------
    alignment
        Alignment without drift.
    echo, log
        Echoes on the recorder's clock; antenna positions on the log's clock.
    point_m
        (3,) float64, metres, in the frame of the antennas.

    Notes
    -----
    Source: docs/theory/tracks.md, "Clock of the recorder". The drift is fitted about the mid-time of the recording,
    where its estimate is independent of the offset; the returned drift counts from the first pulse, as in
    config/clocks.tsv. A drift that changes no path by an eighth of a wavelength over half of the recording is not
    estimated.
    """
    from scipy.optimize import minimize  # slow to import

    pulses = echo.moving()[:: -(-len(echo) // MOST_PULSES)]
    time_s = pulses.time_s
    half_s = float(time_s[-1] - time_s[0]) / 2
    step_ppm = 1e6 * offset_step_s(echo, log) / max(half_s, 1e-12)
    if step_ppm > MOST_PPM:
        line = f"not observable: a drift below {step_ppm:.0f} ppm changes no path by 1/{_STEPS_PER_WAVE} wavelength"
        return replace(alignment, report={**alignment.report, "drift": line})

    def power(ppm: float, offset_s: float, path_m: float) -> float:
        times_s = apply_drift(time_s, ppm)
        return PointSharpness(replace(pulses, time_s=times_s), log, point_m).power(offset_s, path_m)

    # Drift on a grid, then jointly with the offset and, unless fixed, the path by the simplex method.
    drifts_ppm = np.arange(-MOST_PPM, MOST_PPM + step_ppm, step_ppm)
    start = alignment.offset_s, alignment.path_m
    best_ppm = float(drifts_ppm[int(np.argmax([power(ppm, *start) for ppm in drifts_ppm]))])
    steps = np.array([alignment.offset_width_s / 2, max(alignment.path_width_m, 0.0) / 2, step_ppm])
    free = np.flatnonzero(steps)

    def displaced(by: Floats) -> tuple[float, float, float]:
        full = np.zeros(3)
        full[free] = by
        offset_s, path_m, ppm = np.array([*start, best_ppm]) + full * steps
        return float(offset_s), float(path_m), float(ppm)

    def negative_power(by: Floats) -> float:
        offset_s, path_m, ppm = displaced(by)
        return -power(ppm, offset_s, path_m)

    simplex = np.vstack([np.zeros(free.size), np.eye(free.size)])
    result = minimize(negative_power, np.zeros(free.size), method="Nelder-Mead", options={"initial_simplex": simplex})
    offset_s, path_m, ppm = displaced(result.x)
    gain_db = decibels(-result.fun / max(power(0.0, *start), 1e-300))
    first_s = float(apply_drift(time_s, ppm)[0] - time_s[0])
    report = {**alignment.report, "drift": f"peak {gain_db:.2f} dB higher than without drift"}
    return replace(alignment, offset_s=offset_s + first_s, path_m=path_m, drift_ppm=ppm, report=report)
