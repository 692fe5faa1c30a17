"""Checks of a flight log's epochs: spikes, steps, frozen positions, rounded times and positions, and gaps."""

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
# Thresholds follow from the log itself. An epoch is compared with the cubic through two epochs on either side; a fault
# is what, once it is taken out, leaves its neighbours smooth. Movement that the log samples badly does not become
# smooth that way, and is left alone.


LEAST_FAULT_M = 5e-3
"""Metres: smaller errors of single epochs are taken as the log's noise; 5 mm is λ/48 at L-band."""

FINEST_GRAIN_M = 0.01
"""Metres, grain of the coarsest log that resolves centimetres: still epochs count as scattering by no more."""

_SIGMA = 10.0  # a fault is so many times the log's own scatter
_SMOOTHER = {1: 7.0, 2: 12.0, 3: 20.0}  # epochs taken out → how many times smoother their neighbours must become
_STEP_SMOOTHER = 10.0  # times smoother the neighbours of a step must become without it
_AGILE_M_S2 = 10.0  # a node may have flown a step that takes no more than this, forth and back within an interval
_CHI3_MEDIAN = 1.538  # median length of a vector of three standard normal components
_MOST_ROUNDS = 20


class Fault(NamedTuple):
    """Epochs first…last that are wrong by `size_m`; a step lies between them."""

    first: int
    last: int
    size_m: float


def misfits(time_s: Floats, position_m: Floats) -> Floats:
    """Return how far each epoch lies from the cubic through two epochs on either side.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, ascending.
    position_m
        (epoch, axis) float64, metres.

    Returns
    -------
    ndarray
        (epoch, axis) float64, metres; zero at the first and last two.

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
    """Return the robust scatter of an axis of `misfits`, metres; also of a log that mostly repeats one position.

    Where most epochs repeat a coarse position exactly, its grain follows from the few that move.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (5000, 3))
    >>> round(scatter_m(noise), 3)
    0.01
    """
    size = np.linalg.norm(misfit_m[2:-2], axis=1)
    moved = size[size > 1e-7]
    if not moved.size:
        return 0.0
    return max(float(np.median(size)), min(float(np.median(moved)), FINEST_GRAIN_M)) / _CHI3_MEDIAN


def find_spikes(time_s: Floats, position_m: Floats) -> list[Fault]:
    """Return spikes: one to three epochs in a row that deviate from their neighbours.

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
        time, place = time_s[index], position_m[index]
        misfit = misfits(time, place)
        scatter = scatter_m(misfit)
        here = [_spike(time, place, epoch, scatter) for epoch in _outlying(misfit, scatter)]
        spikes = [spike for spike in here if spike is not None]
        if not spikes:
            break
        faults += [Fault(int(index[first]), int(index[last]), size) for first, last, size in spikes]
        index = np.delete(index, np.concatenate([np.arange(first, last + 1) for first, last, _ in spikes]))
    return sorted(faults)


def find_steps(time_s: Floats, position_m: Floats) -> list[Fault]:
    """Return pairs of epochs between which all positions are shifted at once, as when a receiver gets a new fix.

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
        tried = [_step(time_s, misfit, before, scatter) for before in (epoch - 1, epoch)]
        steps = [step for step in tried if step is not None]
        if steps:
            faults.append(max(steps, key=lambda step: step.size_m))
    return sorted(faults)


def _lagrange(nodes: Floats, at: Floats) -> Floats:
    """Return (epoch, node) weights of the polynomial through `nodes` (epoch, node) at `at` (epoch,)."""
    weights = np.ones_like(nodes)
    for own in range(nodes.shape[1]):
        for other in range(nodes.shape[1]):
            if other != own:
                weights[:, own] *= (at - nodes[:, other]) / (nodes[:, own] - nodes[:, other])
    return weights


def _outlying(misfit_m: Floats, scatter: float) -> list[int]:
    """Return epochs whose misfit is large, and larger than within six epochs either way."""
    size = np.linalg.norm(misfit_m, axis=1)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(size, 6), 13).max(axis=1)
    return np.flatnonzero((size > max(0.6 * _SIGMA * scatter, 0.6 * LEAST_FAULT_M)) & (size >= around)).tolist()


def _spike(time_s: Floats, position_m: Floats, epoch: int, scatter: float) -> Fault | None:
    """Return the fewest epochs about an outlying one without which its neighbours are smooth."""
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
            left = misfits(time_s[near], position_m[near])[4:8] @ (worst / max(size, 1e-12))
            if size > max(_SIGMA * scatter, LEAST_FAULT_M, smoother * float(np.sqrt(np.mean(left**2)))):
                return Fault(first, last, size)
    return None


def _step(time_s: Floats, misfit_m: Floats, before: int, scatter: float) -> Fault | None:
    near = np.arange(max(before - 5, 0), min(before + 7, len(time_s)))
    pattern = misfits(time_s[near], (near > before)[:, None].astype(float))[2:-2, 0]
    power = float(pattern @ pattern)
    if power == 0:
        return None
    step = pattern @ misfit_m[near][2:-2] / power
    size = float(np.linalg.norm(step))
    left = misfit_m[near][2:-2] @ (step / max(size, 1e-12)) - size * pattern
    rough = _STEP_SMOOTHER * float(np.sqrt(np.mean(left**2) / power))
    flown = _AGILE_M_S2 * float(time_s[before + 1] - time_s[before]) ** 2 / 4
    return Fault(before, before + 1, size) if size > max(_SIGMA * scatter, 3 * FINEST_GRAIN_M, rough, flown) else None


# ---- Frozen positions, rounded times and rounded positions


def find_frozen(time_s: Floats, position_m: Floats) -> NDArray[np.bool_]:
    """Return (epoch,) bool: epochs that only repeat the position before them although the node flew on.

    A node that stops decelerates to rest and starts from rest. One that flew just before and just after, and then is as
    far away as that speed takes it, did not stand while its log repeated a position to the last digit: if three repeats
    or more follow each other, or every tenth epoch is one, since noise may repeat a coarse position by chance.

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
    still = np.append((np.minimum(travel, jump) > 3 * FINEST_GRAIN_M) & (jump > travel / 2), False)
    length = last - first
    still[-1] = length[-1] <= length[still].max(initial=-1)  # a landing is longer
    frozen = repeats & still[run]
    return np.asarray(frozen if frozen.mean() > 0.1 else frozen & (length >= 3)[run])


def rounded_time_m(time_s: Floats, position_m: Floats) -> float:
    """Return the RMS error of positions along the flight by coarsely written times, metres; 0 without.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, integer multiples of the grain they were written with.
    position_m
        (epoch, 3) float64, metres.

    Notes
    -----
    Times rounded to a grain g err by g/√12, positions by that times the speed, along the flight alone: this is
    accepted where intervals are unequal and positions scatter along the flight as much as that and three times as
    much as across. Source: docs/theory/tracks.md, "Rounded times".

    Examples
    --------
    >>> true_s = np.arange(200) * 0.13
    >>> flown = np.stack([8 * true_s, 0 * true_s, 0 * true_s], -1)
    >>> round(rounded_time_m(true_s.round(1), flown), 2), rounded_time_m(true_s, flown)  # 8 m/s · 0.1 s/√12
    (0.23, 0.0)
    """
    steps = np.diff(time_s)
    grains = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
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
    believed = typical > max(0.5 * expected, 3 * float(np.median(across)), LEAST_FAULT_M)
    return float(expected) if believed else 0.0


def rounded_position_m(time_s: Floats, position_m: Floats, *, least_m: float) -> float:
    """Return the RMS error of positions by coarsely written coordinates, metres; 0 without.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, ascending.
    position_m
        (epoch, 3) float64, metres: ECEF, or any Cartesian frame within 1000 km of its origin.
    least_m
        Errors below are not looked for.

    Notes
    -----
    A coordinate rounded to a grain g errs by g/√12. The grain is the greatest common divisor of the differences of all
    values of a coordinate: of the frame's axes, and on Earth of latitude, longitude and height. It is accepted where
    positions scatter by at least a tenth of it; grains up to 1.5 cm are those of logs that resolve centimetres, and
    count as none. Source: docs/theory/tracks.md, "Rounded positions".

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
            sum(grain**2 / 12 for grain, rough in zip(grains, scatter, strict=True) if rough > _ROUGH * grain)
        )
    error_m = float(np.sqrt(max(squared)))
    return error_m if error_m > least_m else 0.0


_ON_EARTH_M = 1e6
_DEGREE_M = 111_195.0  # of latitude
_ROUGH = 0.1  # of a grain: what positions scatter by at least that are rounded to it
_SAME_M = 1e-5
_COARSE_M = 1.5e-2  # receivers that resolve centimetres write 1e-7 degrees, 1.1 cm
_FEWEST_VALUES, _MOST_VALUES = 8, 500


def _grain(values_m: Floats, least_m: float) -> float:
    """Return the greatest common divisor of the differences of values, metres; 0 where it is less than `least_m`."""
    steps = np.diff(np.unique(values_m))
    steps = np.unique(steps[steps > _SAME_M])[:_MOST_VALUES]
    if len(np.unique(values_m)) < _FEWEST_VALUES or not steps.size:
        return 0.0
    grain = float(steps[0])
    for step in steps.tolist():
        rest = step % grain
        while min(rest, grain - rest) > _SAME_M:  # Euclid's algorithm
            grain, rest = rest, grain % rest
            if grain < least_m:
                return 0.0
    return grain if grain >= least_m else 0.0


# ---- Valid epochs and gaps

LONG_GAP = 3.5
"""Gap in median intervals between epochs from which its interpolation error is estimated."""

_TRIED = 40  # places of the log where a gap of the same length is made, to measure the spline's error
_SUPPORT = 6  # epochs on either side of the spline of such a trial


class Hole(NamedTuple):
    """A time without positions, seconds of the log: its cause, and the error of a spline through it (metres)."""

    start_s: float
    end_s: float
    cause: str
    size_m: float


@dataclass(frozen=True, eq=False)
class CheckedTrack:
    """Valid epochs and holes of a log.

    Attributes
    ----------
    kept
        (epoch,) bool, valid epochs.
    holes
        Times at which pulses have no position.
    faults
        Flag → times (s) and sizes (m) of faults, largest first.
    interpolation_m
        RMS error of the spline between epochs, metres; None where the log is too short.
    """

    kept: NDArray[np.bool_]
    holes: tuple[Hole, ...]
    faults: Mapping[str, tuple[tuple[float, float], ...]]
    interpolation_m: float | None

    def excluded(self, at_s: Floats) -> dict[str, NDArray[np.bool_]]:
        """Return cause → (pulse,) bool, pulses that fall into its holes."""
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
    """Return the valid epochs and the holes of a log.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, ascending.
    position_m
        (epoch, 3) float64, logged point, any Cartesian frame, metres.
    poor_fix
        (epoch,) bool, epochs whose solution is worse than required.
    tolerated_m
        Tolerated error of the spline through a gap, such as λ/16, metres.
    longest_gap_s
        Between epochs, whatever the error of a spline through it, seconds.

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
    place = position_m - position_m.mean(axis=0)
    cause, size = _classified(time_s, place, poor_fix)
    steps = [
        Hole(float(time_s[part[step.first - 1]]), float(time_s[part[step.last + 1]]), "track_outlier", step.size_m)
        for part in _parts(time_s, cause)
        for step in find_steps(time_s[part], place[part])
    ]
    sound = np.flatnonzero(cause == "")
    faults = {
        name: list(zip(time_s[cause == name].tolist(), size[cause == name].tolist(), strict=True))
        for name in ("track_outlier", "track_frozen")
    }
    faults["track_outlier"] += [((step.start_s + step.end_s) / 2, step.size_m) for step in steps]
    rounded_m = rounded_time_m(time_s, place)
    if rounded_m > tolerated_m:
        faults["track_times"] = [(float(time_s[0]), rounded_m)]
    coarse_m = rounded_position_m(time_s, position_m, least_m=tolerated_m)
    if coarse_m > tolerated_m:
        faults["track_positions"] = [(float(time_s[0]), coarse_m)]
    return CheckedTrack(
        cause == "",
        (*_holes(time_s, place, cause, tolerated_m, longest_gap_s), *steps),
        {name: tuple(sorted(where, key=lambda fault: -fault[1])) for name, where in faults.items() if where},
        _interpolation_m(time_s[sound], place[sound]),
    )


def _classified(time_s: Floats, position_m: Floats, poor_fix: NDArray[np.bool_]) -> tuple[NDArray[np.str_], Floats]:
    """Return (epoch,) the flag that excludes an epoch, '' where it is valid, and the size of its error."""
    cause, size = np.where(poor_fix, "fix_quality_low", "").astype("U16"), np.zeros(len(time_s))
    cause[find_frozen(time_s, position_m) & ~poor_fix] = "track_frozen"
    for part in _parts(time_s, cause):
        for spike in find_spikes(time_s[part], position_m[part]):
            inside = part[spike.first : spike.last + 1]
            cause[inside], size[inside] = "track_outlier", spike.size_m
    return cause, size


def _parts(time_s: Floats, cause: NDArray[np.str_]) -> list[NDArray[np.intp]]:
    """Return the valid epochs between gaps: no epoch is compared with neighbours beyond one."""
    sound = np.flatnonzero(cause == "")
    if sound.size < 2:
        return []
    lengths = np.diff(time_s[sound])
    return np.split(sound, np.flatnonzero(lengths > LONG_GAP * np.median(lengths)) + 1)


def _holes(
    time_s: Floats, position_m: Floats, cause: NDArray[np.str_], tolerated_m: float, longest_gap_s: float
) -> list[Hole]:
    """Return the times between valid epochs where the log has no epochs for too long, or its fix is poor."""
    sound = np.flatnonzero(cause == "")
    if sound.size < 2:
        return [Hole(-np.inf, np.inf, str(cause[0]) or "track_gap", np.inf)]
    time, place = time_s[sound], position_m[sound]
    interval_s = float(np.median(np.diff(time)))
    bearable_m = max(tolerated_m, 3 * scatter_m(misfits(time, place)))
    ends = ((-np.inf, float(time[0]), 0), (float(time[-1]), np.inf, -1))
    holes = [Hole(start_s, end_s, str(cause[epoch]), np.inf) for start_s, end_s, epoch in ends if cause[epoch]]
    lengths = np.diff(time)
    shortest_s = min(LONG_GAP * interval_s, longest_gap_s)
    for number in np.flatnonzero((lengths > shortest_s) | (np.diff(sound) > 1)):
        inside = set(cause[sound[number] + 1 : sound[number + 1]].tolist())
        poor, missing = "fix_quality_low" in inside, max(1, round(float(lengths[number]) / interval_s) - 1)
        if not poor and lengths[number] <= shortest_s:
            continue
        error_m = _gap_error_m(time, place, missing)
        if poor or error_m > bearable_m or lengths[number] > longest_gap_s:
            name = "fix_quality_low" if poor else min(inside, default="track_gap")
            holes.append(Hole(float(time[number]), float(time[number + 1]), name, error_m))
    return holes


def _gap_error_m(time_s: Floats, position_m: Floats, missing: int) -> float:
    """Return the error of the spline without so many epochs in a row, by trials where the log has them, metres.

    The 90 % quantile over places of the largest error inside; inf where the log is nowhere complete for so long.
    """
    width = missing + 2 * _SUPPORT
    interval_s = float(np.median(np.diff(time_s)))
    starts = np.arange(len(time_s) - width + 1)  # none where the log is shorter than the trial
    complete = starts[time_s[starts + width - 1] - time_s[starts] < (width - 1) * interval_s * 1.2]
    errors = []
    for start in complete[:: max(1, len(complete) // _TRIED)]:
        here = np.arange(start, start + width)
        out = here[_SUPPORT:-_SUPPORT]
        rest = np.setdiff1d(here, out)
        error_m = position_spline(time_s[rest], position_m[rest])(time_s[out]) - position_m[out]
        errors.append(float(np.linalg.norm(error_m, axis=1).max()))
    return float(np.quantile(errors, 0.9)) if errors else np.inf


def _interpolation_m(time_s: Floats, position_m: Floats) -> float | None:
    """Return the RMS error of the spline between epochs: that of every second epoch over 2⁴, one axis, metres."""
    if len(time_s) < 12:
        return None
    error_m = position_spline(time_s[::2], position_m[::2])(time_s[1:-1:2]) - position_m[1:-1:2]
    inner = np.linalg.norm(error_m, axis=1)[2:-2] / np.sqrt(3)
    return float(np.sqrt(np.mean(inner**2))) / 16


# ---- Yaw against the course

_COURSE_STEP_M = 2.0  # over ground, from which a course is taken: 1 cm of noise turns it by 0.4°
_LEAST_STEPS = 10
_FOLLOWS = 0.85  # mean of phasors of yaw less course: within 33° rms, wind, slips and turns by hand included
_LEAVES = 0.8  # the same where yaw does not follow it: 38° rms
_CLOSER = 2.0  # times less must yaw scatter about the course by another convention than as logged
_ROUND_DEG = 60.0  # no wider gap between courses: no heading held, or turned to the scene, does the same by chance
_WHOLE_TURN = 1.01 * 2 * np.pi  # that no angle in radians exceeds
_UPSIDE = 1.01 * np.pi / 2  # nor roll and pitch of a node that is not upside down
_LEVEL = 0.6  # roll and pitch in radians stay below in level flight; in degrees none that flies stays as level
_STILL = 1e-3  # roll and pitch that move less are those of a level, or of nothing
_NEAR_DEG, _FAR_DEG = 20.0, 45.0  # of straight flight: yaw less course by the other convention, and as logged


class YawFault(NamedTuple):
    """Yaw that follows the course by another convention than degrees clockwise.

    Attributes
    ----------
    convention
        'in radians' or 'anticlockwise'.
    certain
        Whether the course turned through so many directions that nothing else explains it.
    as_logged_deg, otherwise_deg
        Scatter of yaw less course, RMS about its mean, as logged and by the convention; of a straight flight the mean.
    """

    convention: str
    certain: bool
    as_logged_deg: float
    otherwise_deg: float

    @property
    def line(self) -> str:
        """What was measured, in one line."""
        return (
            f"angles of attitude look {self.convention}: yaw is {self.otherwise_deg:.0f}° off the course so, "
            f"{self.as_logged_deg:.0f}° as degrees clockwise from north"
        )


def check_yaw(position_m: Floats, attitude_rad: Floats, ned: Floats) -> YawFault | None:
    """Return by which other convention yaw follows the course over ground, where it does not as logged.

    A node that flies sideways or backwards, in wind, or with its heading held, is none: its yaw follows the course by
    no convention, or as well as logged.

    Parameters
    ----------
    position_m
        (epoch, 3) float64, logged point, metres.
    attitude_rad
        (epoch, 3) float64, roll, pitch, yaw as they were read, from degrees to radians.
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
    places = np.cumsum(np.column_stack([north, east]), axis=0)
    ends = _apart(places, _COURSE_STEP_M)
    if len(ends) <= _LEAST_STEPS:
        return None
    flown = np.diff(places[ends], axis=0)
    course = np.arctan2(flown[:, 1], flown[:, 0])
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


def _apart(places_m: Floats, least_m: float) -> NDArray[np.intp]:
    """Return indices of places, each at least so far from the one before."""
    kept, places = [0], places_m.tolist()
    for index, place in enumerate(places):
        if math.dist(place, places[kept[-1]]) >= least_m:
            kept.append(index)
    return np.array(kept)


def _scatter_deg(mean: complex) -> float:
    """Return the circular standard deviation of angles whose phasors have a mean, degrees."""
    return float(np.degrees(np.sqrt(-2 * np.log(max(min(abs(mean), 1.0), 1e-9)))))


# ---- Hovers: pulses sent while the antennas stood -------------------------------------------------------------------

HOVER_SPEED = 0.2
"""Of the speed of the flight: slower than a flight that turns or climbs, faster than a hover in wind."""

HOVER_S, HOVER_SHARE = 5.0, 0.05
"""Seconds that a hover lasts at least, and share of the pulses in all of them: fewer raise a pedestal below -26 dB."""

_HOVER_WINDOW_S = 2.0  # over which speeds are taken: noise of a log of 1 cm makes 1 cm/s


def hovering(time_s: Floats, legs: Sequence[Floats]) -> NDArray[np.bool_]:
    """Return (pulse,) bool: pulses of long hovers within a flight; none of a recording that stands all along.

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
    none = np.zeros(len(time_s), bool)
    if len(time_s) < 2 or time_s[-1] - time_s[0] < HOVER_S:
        return none
    ends_s = [np.clip(time_s + half, time_s[0], time_s[-1]) for half in (-_HOVER_WINDOW_S / 2, _HOVER_WINDOW_S / 2)]
    moved_m = np.zeros(len(time_s))
    for leg in legs:
        before, after = (np.stack([np.interp(at, time_s, axis) for axis in leg.T], axis=-1) for at in ends_s)
        moved_m += np.linalg.norm(after - before, axis=-1)
    speed = moved_m / (ends_s[1] - ends_s[0])
    slow = speed < HOVER_SPEED * np.quantile(speed, 0.9)
    for first, last in stretches(slow):
        if time_s[last - 1] - time_s[first] >= HOVER_S:
            none[first:last] = True
    return none if none.mean() >= HOVER_SHARE else np.zeros(len(time_s), bool)


def stretches(marked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return (stretch, 2) int64: first and behind the last of each run of (pulse,) bool that are marked.

    Examples
    --------
    >>> stretches(np.array([True, False, True, True])).tolist()
    [[0, 1], [2, 4]]
    """
    return np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(np.int8))).reshape(-1, 2)
