"""Checks of a flight log: spikes, steps, frozen positions, rounded times and positions, gaps, yaw and hovers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.core.geometry.geodesy import geodetic_from_ecef
from apertura.core.geometry.lever_arms import position_spline

# ---- Spikes and steps
#
# Thresholds are derived from the log itself. An epoch is compared with the cubic polynomial through two epochs on
# either side. A group of epochs is a fault if the log is smooth without this group. Undersampled motion does not become
# smooth if epochs are removed, and is not reported.


LEAST_FAULT_M = 5e-3
"""Smallest error of a single epoch that is distinguished from noise, metres; 5 mm is λ/48 at L-band."""

FINEST_GRAIN_M = 0.01
"""Largest rounding step of a log that resolves centimetres, metres; upper limit for the scatter of a static log."""

_SIGMA = 10.0  # minimum size of a fault relative to the scatter of the log
_SMOOTHER = {1: 7.0, 2: 12.0, 3: 20.0}  # number of faulty epochs → minimum size relative to the residual misfits
_STEP_SMOOTHER = 10.0  # minimum size of a step relative to the residual misfits
# acceleration that a node may have in either direction within an interval: smaller steps are attributed to motion
_AGILE_M_S2 = 10.0
_CHI3_MEDIAN = 1.538  # median length of a vector of three standard normal components
_MOST_ROUNDS = 20


class Fault(NamedTuple):
    """Fault of a log: epochs first…last with an error of `size_m`; for a step, the epochs before and after the step."""

    first: int
    last: int
    size_m: float


def misfits(time_s: Floats, position_m: Floats) -> Floats:
    """Return the deviation of each epoch from the cubic polynomial through two epochs on either side.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, ascending.
    position_m
        (epoch, axis) float64, metres.

    Returns
    -------
    ndarray
        (epoch, axis) float64, metres; zero at the first two and the last two epochs.

    Notes
    -----
    Source: docs/theory/tracks.md, "Misfit of an epoch".

    Examples
    --------
    >>> misfits(np.arange(7.0), np.array([[0.0], [0], [0], [6], [0], [0], [0]])).ravel()
    array([ 0.,  0., -4.,  6., -4.,  0.,  0.])
    """
    result = np.zeros_like(position_m)
    if len(time_s) < 5:
        return result
    at = np.arange(2, len(time_s) - 2)
    nodes = at[:, None] + np.array([-2, -1, 1, 2])
    result[at] = position_m[at] - np.einsum("ek,eka->ea", _lagrange(time_s[nodes], time_s[at]), position_m[nodes])
    return result


def scatter_m(misfit_m: Floats) -> float:
    """Return the robust scatter of `misfits` per axis, metres.

    If most epochs repeat a coarsely rounded position exactly, the scatter is estimated from the other epochs.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (5000, 3))
    >>> round(scatter_m(noise), 3)
    0.01
    """
    size = np.linalg.norm(misfit_m[2:-2], axis=1)
    nonzero = size[size > 1e-7]
    if not nonzero.size:
        return 0.0
    return max(float(np.median(size)), min(float(np.median(nonzero)), FINEST_GRAIN_M)) / _CHI3_MEDIAN


def find_spikes(time_s: Floats, position_m: Floats) -> list[Fault]:
    """Detect spikes: one to three consecutive epochs that deviate from the neighbouring epochs.

    Notes
    -----
    Source: docs/theory/tracks.md, "Spikes and steps".

    Examples
    --------
    >>> time_s = np.arange(60) * 0.1
    >>> flown = np.stack([5 * time_s, np.sin(time_s), 0 * time_s], -1)
    >>> flown[30, 2] += 0.2
    >>> [(spike.first, spike.last, round(spike.size_m, 2)) for spike in find_spikes(time_s, flown)]
    [(30, 30, 0.2)]
    """
    index, faults = np.arange(len(time_s)), []
    for _ in range(_MOST_ROUNDS):
        time, position = time_s[index], position_m[index]
        misfit = misfits(time, position)
        scatter = scatter_m(misfit)
        candidates = [_spike(time, position, epoch, scatter) for epoch in _outlying(misfit, scatter)]
        spikes = [spike for spike in candidates if spike is not None]
        if not spikes:
            break
        faults += [Fault(int(index[first]), int(index[last]), size) for first, last, size in spikes]
        index = np.delete(index, np.concatenate([np.arange(first, last + 1) for first, last, _ in spikes]))
    return sorted(faults)


def find_steps(time_s: Floats, position_m: Floats) -> list[Fault]:
    """Detect steps: pairs of epochs between which the position changes abruptly, for example after a new GNSS fix.

    Examples
    --------
    >>> time_s = np.arange(60) * 0.1
    >>> flown = np.stack([5 * time_s, np.sin(time_s), np.where(time_s < 2.95, 0, 0.2)], -1)
    >>> [(step.first, step.last, round(step.size_m, 2)) for step in find_steps(time_s, flown)]
    [(29, 30, 0.2)]
    """
    misfit = misfits(time_s, position_m)
    scatter, faults = scatter_m(misfit), []
    for epoch in _outlying(misfit, scatter):
        candidates = [_step(time_s, misfit, before, scatter) for before in (epoch - 1, epoch)]
        steps = [step for step in candidates if step is not None]
        if steps:
            faults.append(max(steps, key=lambda step: step.size_m))
    return sorted(faults)


def _lagrange(nodes: Floats, at: Floats) -> Floats:
    """Return the Lagrange weights, (epoch, node), of polynomials through `nodes` (epoch, node) at `at` (epoch,)."""
    weights = np.ones_like(nodes)
    for own in range(nodes.shape[1]):
        for other in range(nodes.shape[1]):
            if other != own:
                weights[:, own] *= (at - nodes[:, other]) / (nodes[:, own] - nodes[:, other])
    return weights


def _outlying(misfit_m: Floats, scatter: float) -> list[int]:
    """Return epochs with a misfit above the threshold that is the largest within six epochs on either side."""
    size = np.linalg.norm(misfit_m, axis=1)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(size, 6), 13).max(axis=1)
    return np.flatnonzero((size > max(0.6 * _SIGMA * scatter, 0.6 * LEAST_FAULT_M)) & (size >= around)).tolist()


def _spike(time_s: Floats, position_m: Floats, epoch: int, scatter: float) -> Fault | None:
    """Return the smallest group of epochs about an outlier whose removal leaves a smooth log."""
    for count, smoother in _SMOOTHER.items():
        for first in range(epoch - count, epoch + 2):
            last = first + count - 1
            if first < 6 or last > len(time_s) - 7:
                continue
            near = np.r_[first - 6 : first, last + 1 : last + 7]
            group = np.arange(first, last + 1)
            nodes = np.tile([first - 2, first - 1, last + 1, last + 2], (count, 1))
            error_m = position_m[group] - np.einsum(
                "ek,eka->ea", _lagrange(time_s[nodes], time_s[group]), position_m[nodes]
            )
            worst = error_m[np.argmax(np.linalg.norm(error_m, axis=1))]
            size = float(np.linalg.norm(worst))
            residual = misfits(time_s[near], position_m[near])[4:8] @ (worst / max(size, 1e-12))
            if size > max(_SIGMA * scatter, LEAST_FAULT_M, smoother * float(np.sqrt(np.mean(residual**2)))):
                return Fault(first, last, size)
    return None


def _step(time_s: Floats, misfit_m: Floats, before: int, scatter: float) -> Fault | None:
    """Fit a step after epoch `before` to the surrounding misfits; None if the step is not significant."""
    near = np.arange(max(before - 5, 0), min(before + 7, len(time_s)))
    pattern = misfits(time_s[near], (near > before)[:, None].astype(float))[2:-2, 0]
    power = float(pattern @ pattern)
    if power == 0:
        return None
    step = pattern @ misfit_m[near][2:-2] / power
    size = float(np.linalg.norm(step))
    residual = misfit_m[near][2:-2] @ (step / max(size, 1e-12)) - size * pattern
    roughness = _STEP_SMOOTHER * float(np.sqrt(np.mean(residual**2) / power))
    motion = _AGILE_M_S2 * float(time_s[before + 1] - time_s[before]) ** 2 / 4
    threshold = max(_SIGMA * scatter, 3 * FINEST_GRAIN_M, roughness, motion)
    return Fault(before, before + 1, size) if size > threshold else None


# ---- Frozen positions, rounded times and rounded positions


def find_frozen(time_s: Floats, position_m: Floats) -> NDArray[np.bool_]:
    """Detect epochs that repeat the preceding position although the node was moving, (epoch,) bool.

    A node that stops decelerates before the stop and accelerates afterwards. A run of repeated positions is frozen if
    the node moved just before and just after the run, and if the distance covered agrees with the speed of this motion.
    Noise may also lead to repeats of a coarsely rounded position. Therefore at least three consecutive repeats are
    required, unless more than a tenth of the epochs are frozen.

    Examples
    --------
    >>> time_s = np.arange(10) * 0.1
    >>> find_frozen(time_s, np.stack([np.repeat([0, 1, 2, 3, 4], 2), 0 * time_s, 0 * time_s], -1)).astype(int)
    array([0, 1, 0, 1, 0, 1, 0, 1, 0, 1])
    """
    repeats = np.concatenate([[False], (np.diff(position_m, axis=0) == 0).all(axis=1)])
    if not repeats.any():
        return repeats
    run, first = np.cumsum(~repeats) - 1, np.flatnonzero(~repeats)
    last = np.append(first[1:] - 1, len(time_s) - 1)
    jump = np.linalg.norm(np.diff(position_m[first], axis=0), axis=1)
    speed = np.concatenate([[np.inf], jump / np.diff(time_s[first]), [np.inf]])  # before, between and after the runs
    travel = np.minimum(speed[:-2], speed[2:]) * (time_s[last] - time_s[first])[:-1]
    is_frozen_run = np.append((np.minimum(travel, jump) > 3 * FINEST_GRAIN_M) & (jump > travel / 2), False)
    length = last - first
    is_frozen_run[-1] = length[-1] <= length[is_frozen_run].max(initial=-1)  # longer runs may be landings
    frozen = repeats & is_frozen_run[run]
    return np.asarray(frozen if frozen.mean() > 0.1 else frozen & (length >= 3)[run])


def rounded_time_m(time_s: Floats, position_m: Floats) -> float:
    """Return the RMS along-track error of positions due to rounded times, metres; 0 if times are not rounded.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, integer multiples of the rounding step.
    position_m
        (epoch, 3) float64, metres.

    Notes
    -----
    Times rounded to a step g have an error of g/√12; positions then have an along-track error of g/√12 times the speed.
    Rounding is detected if the intervals are unequal and if the along-track scatter is at least half of this error and
    more than three times the cross-track scatter. Source: docs/theory/tracks.md, "Rounded times".

    Examples
    --------
    >>> true_s = np.arange(200) * 0.13
    >>> flown = np.stack([8 * true_s, 0 * true_s, 0 * true_s], -1)
    >>> round(rounded_time_m(true_s.round(1), flown), 2), rounded_time_m(true_s, flown)  # 8 m/s · 0.1 s/√12
    (0.23, 0.0)
    """
    steps = np.diff(time_s)
    grains = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)  # rounding steps tested, seconds
    grain = next((g for g in grains if (np.abs(steps / g - np.round(steps / g)) < 1e-4).all()), 0.0)
    if not grain or np.ptp(steps) < grain / 2 or len(time_s) < 12:
        return 0.0
    velocity = np.gradient(position_m, time_s, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    mean_m_s = float(np.linalg.norm(np.diff(position_m, axis=0), axis=1).sum() / (time_s[-1] - time_s[0]))
    misfit = misfits(time_s, position_m)
    along = np.abs((misfit * velocity).sum(axis=1) / np.maximum(speed, 1e-9))[2:-2]
    across = np.sqrt(np.maximum((misfit[2:-2] ** 2).sum(axis=1) - along**2, 0)) / np.sqrt(2)
    expected = mean_m_s * grain / np.sqrt(12)
    typical = float(np.median(along))
    is_rounded = typical > max(0.5 * expected, 3 * float(np.median(across)), LEAST_FAULT_M)
    return float(expected) if is_rounded else 0.0


def rounded_position_m(time_s: Floats, position_m: Floats, *, least_m: float) -> float:
    """Return the RMS error of positions due to rounded coordinates, metres; 0 if coordinates are not rounded.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, ascending.
    position_m
        (epoch, 3) float64, metres: ECEF, or any Cartesian frame within 1000 km of its origin.
    least_m
        Smallest error that is searched, metres.

    Notes
    -----
    A coordinate rounded to a step g has an error of g/√12. The step is the greatest common divisor of the differences
    between all values of a coordinate. Coordinates are the axes of the frame and, for ECEF positions, latitude,
    longitude and height. The step is accepted if positions scatter by at least a tenth of the step. Steps up to 1.5 cm
    occur in logs that resolve centimetres, and are ignored. Source: docs/theory/tracks.md, "Rounded positions".

    Examples
    --------
    >>> time_s = np.arange(200) * 0.1
    >>> flown = np.stack([8 * np.sin(time_s), 8 * np.cos(time_s), 600 + time_s], -1)
    >>> error_m = rounded_position_m(time_s, (flown / 0.18).round() * 0.18, least_m=0.01)
    >>> round(error_m, 2), rounded_position_m(time_s, flown, least_m=0.01)  # 0.18 m·√(3/12)
    (0.09, 0.0)
    """
    frames = [position_m]
    if np.linalg.norm(position_m[0]) > _ON_EARTH_M:
        geodetic = geodetic_from_ecef(position_m)
        across = np.cos(np.radians(geodetic[0, 0]))
        frames.append(geodetic * [_DEGREE_M, _DEGREE_M * across, 1.0])
    squared = [0.0]
    for frame in frames:
        scatter = np.sqrt(np.mean(misfits(time_s, frame - frame[0]) ** 2, axis=0))
        grains = [_grain(axis - axis[0], max(least_m, _COARSE_M)) for axis in frame.T]
        squared.append(
            sum(grain**2 / 12 for grain, std_m in zip(grains, scatter, strict=True) if std_m > _ROUGH * grain)
        )
    error_m = float(np.sqrt(max(squared)))
    return error_m if error_m > least_m else 0.0


_ON_EARTH_M = 1e6
_DEGREE_M = 111_195.0  # metres per degree of latitude
_ROUGH = 0.1  # minimum scatter of rounded positions relative to the rounding step
_SAME_M = 1e-5  # difference below which two values are considered equal, metres
_COARSE_M = 1.5e-2  # receivers that resolve centimetres write multiples of 1e-7 degrees, 1.1 cm
_FEWEST_VALUES, _MOST_VALUES = 8, 500


def _grain(values_m: Floats, least_m: float) -> float:
    """Return the greatest common divisor of the differences of values, metres; 0 if it is less than `least_m`."""
    steps = np.diff(np.unique(values_m))
    steps = np.unique(steps[steps > _SAME_M])[:_MOST_VALUES]
    if len(np.unique(values_m)) < _FEWEST_VALUES or not steps.size:
        return 0.0
    grain = float(steps[0])
    for step in steps.tolist():
        remainder = step % grain
        while min(remainder, grain - remainder) > _SAME_M:  # Euclid's algorithm
            grain, remainder = remainder, grain % remainder
            if grain < least_m:
                return 0.0
    return grain if grain >= least_m else 0.0


# ---- Valid epochs and gaps

LONG_GAP = 3.5
"""Length of a gap, in median intervals between epochs, above which the interpolation error is estimated."""

_TRIED = 40  # number of artificial gaps of the same length elsewhere in the log, at which the spline error is measured
_SUPPORT = 6  # epochs on either side of an artificial gap


class Hole(NamedTuple):
    """Interval without valid positions, in seconds of the log, with its cause and the interpolation error (m)."""

    start_s: float
    end_s: float
    cause: str
    size_m: float


@dataclass(frozen=True, eq=False)
class CheckedTrack:
    """Valid epochs and intervals without positions of a log.

    Attributes
    ----------
    kept
        (epoch,) bool, True for valid epochs.
    holes
        Intervals in which pulses have no position.
    faults
        Flag → times (s) and sizes (m) of faults, largest first.
    interpolation_m
        RMS error of the spline between epochs, metres; None if the log is too short.
    """

    kept: NDArray[np.bool_]
    holes: tuple[Hole, ...]
    faults: Mapping[str, tuple[tuple[float, float], ...]]
    interpolation_m: float | None

    def excluded(self, at_s: Floats) -> dict[str, NDArray[np.bool_]]:
        """Return masks of the pulses in intervals without positions: cause → (pulse,) bool."""
        causes = dict.fromkeys(hole.cause for hole in self.holes)
        return {
            cause: np.any([(at_s > h.start_s) & (at_s < h.end_s) for h in self.holes if h.cause == cause], axis=0)
            for cause in causes
        }


def check_track(
    time_s: Floats,
    position_m: Floats,
    *,
    poor_fix: NDArray[np.bool_],
    tolerated_m: float,
    longest_gap_s: float = np.inf,
) -> CheckedTrack:
    """Check a log for faults and gaps; return the valid epochs and the intervals without positions.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, ascending.
    position_m
        (epoch, 3) float64, logged point in any Cartesian frame, metres.
    poor_fix
        (epoch,) bool, True for epochs with a GNSS solution that is worse than required.
    tolerated_m
        Tolerated error of the spline through a gap, such as λ/16, metres.
    longest_gap_s
        Longest gap that is interpolated regardless of the error of the spline, seconds.

    Notes
    -----
    Source: docs/theory/tracks.md.

    Examples
    --------
    >>> time_s = np.delete(np.arange(100) * 0.1, np.arange(40, 60))
    >>> flown = np.stack([5 * time_s, np.sin(3 * time_s), 0 * time_s], -1)
    >>> checked = check_track(time_s, flown, poor_fix=np.zeros(80, bool), tolerated_m=0.01)
    >>> [(round(hole.start_s, 1), round(hole.end_s, 1), hole.cause) for hole in checked.holes]
    [(3.9, 6.0, 'track_gap')]
    """
    offset_m = position_m - position_m.mean(axis=0)  # for precision
    cause, size = _classified(time_s, offset_m, poor_fix)
    steps = [
        Hole(float(time_s[part[step.first - 1]]), float(time_s[part[step.last + 1]]), "track_outlier", step.size_m)
        for part in _parts(time_s, cause)
        for step in find_steps(time_s[part], offset_m[part])
    ]
    valid = np.flatnonzero(cause == "")
    faults = {
        name: list(zip(time_s[cause == name].tolist(), size[cause == name].tolist(), strict=True))
        for name in ("track_outlier", "track_frozen")
    }
    faults["track_outlier"] += [((step.start_s + step.end_s) / 2, step.size_m) for step in steps]
    rounded_m = rounded_time_m(time_s, offset_m)
    if rounded_m > tolerated_m:
        faults["track_times"] = [(float(time_s[0]), rounded_m)]
    coarse_m = rounded_position_m(time_s, position_m, least_m=tolerated_m)
    if coarse_m > tolerated_m:
        faults["track_positions"] = [(float(time_s[0]), coarse_m)]
    return CheckedTrack(
        cause == "",
        (*_holes(time_s, offset_m, cause, tolerated_m, longest_gap_s), *steps),
        {name: tuple(sorted(found, key=lambda fault: -fault[1])) for name, found in faults.items() if found},
        _interpolation_m(time_s[valid], offset_m[valid]),
    )


def _classified(time_s: Floats, position_m: Floats, poor_fix: NDArray[np.bool_]) -> tuple[NDArray[np.str_], Floats]:
    """Return the flag that excludes each epoch ('' for a valid epoch) and the size of its error, (epoch,) each."""
    cause, size = np.where(poor_fix, "fix_quality_low", "").astype("U16"), np.zeros(len(time_s))
    cause[find_frozen(time_s, position_m) & ~poor_fix] = "track_frozen"
    for part in _parts(time_s, cause):
        for spike in find_spikes(time_s[part], position_m[part]):
            inside = part[spike.first : spike.last + 1]
            cause[inside], size[inside] = "track_outlier", spike.size_m
    return cause, size


def _parts(time_s: Floats, cause: NDArray[np.str_]) -> list[NDArray[np.intp]]:
    """Return the groups of valid epochs between gaps; epochs are not compared across a gap."""
    valid = np.flatnonzero(cause == "")
    if valid.size < 2:
        return []
    lengths = np.diff(time_s[valid])
    return np.split(valid, np.flatnonzero(lengths > LONG_GAP * np.median(lengths)) + 1)


def _holes(
    time_s: Floats, position_m: Floats, cause: NDArray[np.str_], tolerated_m: float, longest_gap_s: float
) -> list[Hole]:
    """Return the intervals between valid epochs that are too long to interpolate or contain epochs with a poor fix."""
    valid = np.flatnonzero(cause == "")
    if valid.size < 2:
        return [Hole(-np.inf, np.inf, str(cause[0]) or "track_gap", np.inf)]
    time, position = time_s[valid], position_m[valid]
    interval_s = float(np.median(np.diff(time)))
    limit_m = max(tolerated_m, 3 * scatter_m(misfits(time, position)))
    ends = ((-np.inf, float(time[0]), 0), (float(time[-1]), np.inf, -1))
    holes = [Hole(start_s, end_s, str(cause[epoch]), np.inf) for start_s, end_s, epoch in ends if cause[epoch]]
    lengths = np.diff(time)
    shortest_s = min(LONG_GAP * interval_s, longest_gap_s)
    for number in np.flatnonzero((lengths > shortest_s) | (np.diff(valid) > 1)):
        inside = set(cause[valid[number] + 1 : valid[number + 1]].tolist())
        poor, missing = "fix_quality_low" in inside, max(1, round(float(lengths[number]) / interval_s) - 1)
        if not poor and lengths[number] <= shortest_s:
            continue
        error_m = _gap_error_m(time, position, missing)
        if poor or error_m > limit_m or lengths[number] > longest_gap_s:
            name = "fix_quality_low" if poor else min(inside, default="track_gap")
            holes.append(Hole(float(time[number]), float(time[number + 1]), name, error_m))
    return holes


def _gap_error_m(time_s: Floats, position_m: Floats, missing: int) -> float:
    """Estimate the error of the spline through a gap of `missing` epochs from artificial gaps in the log, metres.

    The result is the 90 % quantile of the largest error within each artificial gap; inf if no part of the log is long
    enough.
    """
    width = missing + 2 * _SUPPORT
    interval_s = float(np.median(np.diff(time_s)))
    starts = np.arange(len(time_s) - width + 1)  # empty if the log is shorter than the window
    complete = starts[time_s[starts + width - 1] - time_s[starts] < (width - 1) * interval_s * 1.2]
    errors = []
    for start in complete[:: max(1, len(complete) // _TRIED)]:
        window = np.arange(start, start + width)
        removed = window[_SUPPORT:-_SUPPORT]
        kept = np.setdiff1d(window, removed)
        error_m = position_spline(time_s[kept], position_m[kept])(time_s[removed]) - position_m[removed]
        errors.append(float(np.linalg.norm(error_m, axis=1).max()))
    return float(np.quantile(errors, 0.9)) if errors else np.inf


def _interpolation_m(time_s: Floats, position_m: Floats) -> float | None:
    """Estimate the RMS spline error between epochs per axis, metres: 2⁻⁴ of the error with every second epoch."""
    if len(time_s) < 12:
        return None
    error_m = position_spline(time_s[::2], position_m[::2])(time_s[1:-1:2]) - position_m[1:-1:2]
    inner = np.linalg.norm(error_m, axis=1)[2:-2] / np.sqrt(3)
    return float(np.sqrt(np.mean(inner**2))) / 16


# ---- Comparison of yaw with the course

_COURSE_STEP_M = 2.0  # distance over ground from which a course is determined: 1 cm of noise causes an error of 0.4°
_LEAST_STEPS = 10
# minimum mean phasor of yaw minus course if yaw follows the course: 33° RMS from wind, sideslip and manual turns
_FOLLOWS = 0.85
_LEAVES = 0.8  # largest mean phasor if yaw does not follow the course: 38° RMS
_CLOSER = 2.0  # minimum ratio of the scatter of yaw about the course as logged to the scatter with another convention
# widest gap between courses for which a constant heading, or a heading towards the scene, can be excluded
_ROUND_DEG = 60.0
_WHOLE_TURN = 1.01 * 2 * np.pi  # limit of an angle in radians
_UPSIDE = 1.01 * np.pi / 2  # limit of roll and pitch in radians of an upright node
_LEVEL = 0.6  # limit of roll and pitch in radians in level flight, which values in degrees exceed in any flight
_STILL = 1e-3  # smallest range of roll or pitch that is accepted as measured
# limits of yaw minus course in straight flight: largest with the other convention, and smallest as logged
_NEAR_DEG, _FAR_DEG = 20.0, 45.0


class YawFault(NamedTuple):
    """Yaw that follows the course in a convention other than degrees clockwise from north.

    Attributes
    ----------
    convention
        'in radians' or 'anticlockwise'.
    certain
        True if the course covers so many directions that there is no other explanation.
    as_logged_deg, otherwise_deg
        RMS scatter of the difference between yaw and course about the mean difference, as logged and with `convention`;
        in straight flight, the mean difference.
    """

    convention: str
    certain: bool
    as_logged_deg: float
    otherwise_deg: float

    @property
    def line(self) -> str:
        """The measured deviations in one line."""
        return (
            f"attitude angles appear to be {self.convention}: with this convention, yaw deviates from the course by "
            f"{self.otherwise_deg:.0f}°; as degrees clockwise from north, it deviates by {self.as_logged_deg:.0f}°"
        )


def check_yaw(position_m: Floats, attitude_rad: Floats, ned: Floats) -> YawFault | None:
    """Detect a wrong convention of yaw: yaw follows the course over ground with another convention, but not as logged.

    A node that flies sideways, backwards, in wind or with a constant heading is not reported: its yaw either follows
    the course as logged, or follows it with no convention.

    Parameters
    ----------
    position_m
        (epoch, 3) float64, logged point, metres.
    attitude_rad
        (epoch, 3) float64, logged roll, pitch, yaw, converted from degrees to radians.
    ned
        (epoch, 3, 3) or (3, 3) float64, columns north, east, down in the frame of the positions.

    Notes
    -----
    Source: docs/theory/tracks.md, eq. 2.

    Examples
    --------
    >>> turn = np.linspace(0, 5, 200)  # rad of a circle, clockwise from north
    >>> circle = 20 * np.stack([np.sin(turn), -np.cos(turn), 0 * turn], -1)  # north, east, down
    >>> level = np.zeros((200, 2))
    >>> logged = np.column_stack([level, turn])
    >>> check_yaw(circle, logged, np.eye(3)) is None, check_yaw(circle, np.radians(logged), np.eye(3)).convention
    (True, 'in radians')
    """
    known = np.isfinite(attitude_rad).all(axis=1)
    attitude_rad, step = attitude_rad[known], np.diff(position_m[known], axis=0)
    north, east = np.einsum("...ij,...i->...j", ned[known][1:] if ned.ndim == 3 else ned, step)[:, :2].T
    horizontal_m = np.cumsum(np.column_stack([north, east]), axis=0)
    ends = _thinned(horizontal_m, _COURSE_STEP_M)
    if len(ends) <= _LEAST_STEPS:
        return None
    displacement_m = np.diff(horizontal_m[ends], axis=0)
    course = np.arctan2(displacement_m[:, 1], displacement_m[:, 0])
    middle = (ends[1:] + ends[:-1]) // 2 + 1
    yaw, logged = attitude_rad[middle, 2], np.degrees(attitude_rad)
    small = bool((np.abs(logged) <= np.array([_UPSIDE, _UPSIDE, _WHOLE_TURN])).all())
    ordered = np.sort(course)
    certain = bool(np.degrees(np.diff(ordered, append=ordered[0] + 2 * np.pi).max()) < _ROUND_DEG)
    others = {"in radians": logged[middle, 2]} if small else {}
    others |= {"anticlockwise": -yaw} if certain else {}
    as_logged, *otherwise = (complex(np.exp(1j * (angle - course)).mean()) for angle in (yaw, *others.values()))
    for convention, mean in zip(others, otherwise, strict=True):
        logged_deg, other_deg = _scatter_deg(as_logged), _scatter_deg(mean)
        if abs(as_logged) < _LEAVES and abs(mean) > _FOLLOWS and _CLOSER * other_deg < logged_deg:
            return YawFault(convention, certain, logged_deg, other_deg)
    tilt = logged[:, :2]
    if small and abs(as_logged) > _FOLLOWS and np.abs(tilt).max() <= _LEVEL and np.ptp(tilt, axis=0).max() > _STILL:
        logged_deg, radians_deg = (abs(float(np.degrees(np.angle(mean)))) for mean in (as_logged, otherwise[0]))
        if logged_deg > _FAR_DEG and radians_deg < _NEAR_DEG and abs(otherwise[0]) > _FOLLOWS:
            return YawFault("in radians", False, logged_deg, radians_deg)
    return None


def _thinned(position_m: Floats, least_m: float) -> NDArray[np.intp]:
    """Return indices of positions, each at least `least_m` from the previously selected position."""
    kept, positions = [0], position_m.tolist()
    for index, position in enumerate(positions):
        if math.dist(position, positions[kept[-1]]) >= least_m:
            kept.append(index)
    return np.array(kept)


def _scatter_deg(mean: complex) -> float:
    """Return the circular standard deviation of angles from the mean of their phasors, degrees."""
    return float(np.degrees(np.sqrt(-2 * np.log(max(min(abs(mean), 1.0), 1e-9)))))


# ---- Hovers: pulses transmitted while the antennas are stationary

HOVER_SPEED = 0.2
"""Upper limit of the speed in a hover relative to the speed of the flight. The limit is below the speed in turns or
climbs and above the speed in a hover in wind."""

HOVER_S, HOVER_SHARE = 5.0, 0.05
"""Minimum duration of a hover, seconds, and minimum fraction of pulses in hovers: a smaller fraction causes a pedestal
below -26 dB."""

_HOVER_WINDOW_S = 2.0  # interval of the speed estimate: 1 cm of log noise causes an error of 1 cm/s


def hovering(time_s: Floats, legs: Sequence[Floats]) -> NDArray[np.bool_]:
    """Detect the pulses of long hovers within a flight, (pulse,) bool; none if the whole recording is static.

    Parameters
    ----------
    time_s
        (pulse,) float64, ascending, seconds.
    legs
        Positions of the transmitting and of the receiving antenna, (pulse, 3) float64 each, metres.

    Notes
    -----
    Source: docs/theory/tracks.md, "Hovers".

    Examples
    --------
    >>> time_s = np.arange(0, 40, 0.1)
    >>> east = np.clip(time_s, 0, 20) * 0.5  # flies for 20 s, then hovers
    >>> leg = np.stack([east, 0 * east, 0 * east], -1)
    >>> out = hovering(time_s, (leg, leg))
    >>> float(time_s[out].min().round(1)), int(out.sum())
    (20.6, 194)
    """
    hovers = np.zeros(len(time_s), bool)
    if len(time_s) < 2 or time_s[-1] - time_s[0] < HOVER_S:
        return hovers
    ends_s = [np.clip(time_s + half, time_s[0], time_s[-1]) for half in (-_HOVER_WINDOW_S / 2, _HOVER_WINDOW_S / 2)]
    moved_m = np.zeros(len(time_s))
    for leg in legs:
        before, after = (np.stack([np.interp(at, time_s, axis) for axis in leg.T], axis=-1) for at in ends_s)
        moved_m += np.linalg.norm(after - before, axis=-1)
    speed = moved_m / (ends_s[1] - ends_s[0])
    slow = speed < HOVER_SPEED * np.quantile(speed, 0.9)
    for first, last in stretches(slow):
        if time_s[last - 1] - time_s[first] >= HOVER_S:
            hovers[first:last] = True
    return hovers if hovers.mean() >= HOVER_SHARE else np.zeros(len(time_s), bool)


def stretches(marked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return start and end (exclusive) of each run of marked pulses, (run, 2) int64.

    Examples
    --------
    >>> stretches(np.array([True, False, True, True])).tolist()
    [[0, 1], [2, 4]]
    """
    return np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(np.int8))).reshape(-1, 2)
