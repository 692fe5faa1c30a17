"""Which epochs of a flight log positions may rest on, and at which times no position can be had from it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.phase_centres import position_spline
from apertura.core.geometry.track_faults import Floats, find_spikes, find_steps, misfits, scatter_m
from apertura.core.geometry.track_writing import find_frozen, rounded_time_m

LONG_GAP = 3.5
"""Intervals between epochs, in the log's own median, from which on a gap is asked what it costs."""

_TRIED = 40  # places of the log where a gap of the same length is made, to see how far the spline then errs
_SUPPORT = 6  # epochs on either side that the spline of such a trial goes through


class Hole(NamedTuple):
    """A time without positions, seconds of the log: why, and how far a spline through it may err (metres)."""

    start_s: float
    end_s: float
    cause: str
    size_m: float


@dataclass(frozen=True, eq=False)
class CheckedTrack:
    """What may be used of a log.

    Attributes
    ----------
    kept
        (epoch,) bool, epochs that positions rest on.
    holes
        Times at which pulses have no position.
    faults
        Flag → time (s) and size (m) of what was found, largest first.
    interpolation_m
        RMS error of the spline between epochs, metres; None where the log is too short to tell.
    """

    kept: NDArray[np.bool_]
    holes: tuple[Hole, ...]
    faults: Mapping[str, tuple[tuple[float, float], ...]]
    interpolation_m: float | None

    def barred(self, at_s: Floats) -> dict[str, NDArray[np.bool_]]:
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
    """Return which epochs of a log are sound and where it has holes.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, ascending.
    position_m
        (epoch, 3) float64, logged point, any Cartesian frame, metres.
    poor_fix
        (epoch,) bool, epochs whose solution is worse than asked for.
    tolerated_m
        Error of the spline through a gap that an image bears, such as λ/16, metres.
    longest_gap_s
        Between epochs, whatever a spline through it costs, seconds.

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
    cause, size = _judged(time_s, place, poor_fix)
    steps = [
        Hole(float(time_s[part[step.first - 1]]), float(time_s[part[step.last + 1]]), "track_outlier", step.size_m)
        for part in _parts(time_s, cause)
        for step in find_steps(time_s[part], place[part])
    ]
    sound = np.flatnonzero(cause == "")
    faults = {name: _listed(time_s[cause == name], size[cause == name]) for name in ("track_outlier", "track_frozen")}
    faults["track_outlier"] += [((step.start_s + step.end_s) / 2, step.size_m) for step in steps]
    rounded_m = rounded_time_m(time_s, place)
    if rounded_m > tolerated_m:
        faults["track_times"] = [(float(time_s[0]), rounded_m)]
    return CheckedTrack(
        cause == "",
        (*_holes(time_s, place, cause, tolerated_m, longest_gap_s), *steps),
        {name: tuple(sorted(where, key=lambda fault: -fault[1])) for name, where in faults.items() if where},
        _interpolation_m(time_s[sound], place[sound]),
    )


def _judged(time_s: Floats, position_m: Floats, poor_fix: NDArray[np.bool_]) -> tuple[NDArray[np.str_], Floats]:
    """Return (epoch,) the flag that keeps an epoch from being used, '' where it is sound, and by how much it is off."""
    cause, size = np.where(poor_fix, "fix_poor", "").astype("U16"), np.zeros(len(time_s))
    cause[find_frozen(time_s, position_m) & ~poor_fix] = "track_frozen"
    for part in _parts(time_s, cause):
        for spike in find_spikes(time_s[part], position_m[part]):
            inside = part[spike.first : spike.last + 1]
            cause[inside], size[inside] = "track_outlier", spike.size_m
    return cause, size


def _parts(time_s: Floats, cause: NDArray[np.str_]) -> list[NDArray[np.intp]]:
    """Return the sound epochs between gaps: no epoch is judged by its neighbours beyond one."""
    sound = np.flatnonzero(cause == "")
    if sound.size < 2:
        return []
    lengths = np.diff(time_s[sound])
    return np.split(sound, np.flatnonzero(lengths > LONG_GAP * np.median(lengths)) + 1)


def _listed(time_s: Floats, size_m: Floats) -> list[tuple[float, float]]:
    return list(zip(time_s.tolist(), size_m.tolist(), strict=True))


def _holes(
    time_s: Floats, position_m: Floats, cause: NDArray[np.str_], tolerated_m: float, longest_gap_s: float
) -> list[Hole]:
    """Return the times between sound epochs where the log is silent for too long, or its fix is poor."""
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
        poor, missing = "fix_poor" in inside, round(float(lengths[number]) / interval_s) - 1
        if not poor and lengths[number] <= shortest_s:
            continue
        error_m = _gap_error_m(time, place, missing)
        if poor or error_m > bearable_m or lengths[number] > longest_gap_s:
            name = "fix_poor" if poor else min(inside, default="track_gap")
            holes.append(Hole(float(time[number]), float(time[number + 1]), name, error_m))
    return holes


def _gap_error_m(time_s: Floats, position_m: Floats, missing: int) -> float:
    """Return what the spline would miss without so many epochs in a row: tried where the log has them, metres.

    The 90 % quantile over places of the largest error inside; inf where the log is nowhere whole for so long.
    """
    width = missing + 2 * _SUPPORT
    interval_s = float(np.median(np.diff(time_s)))
    starts = np.arange(len(time_s) - width + 1)  # none where the log is shorter than the trial
    whole = starts[time_s[starts + width - 1] - time_s[starts] < (width - 1) * interval_s * 1.2]
    errors = []
    for start in whole[:: max(1, len(whole) // _TRIED)]:
        here = np.arange(start, start + width)
        out = here[_SUPPORT:-_SUPPORT]
        rest = np.setdiff1d(here, out)
        apart = position_spline(time_s[rest], position_m[rest])(time_s[out]) - position_m[out]
        errors.append(float(np.linalg.norm(apart, axis=1).max()))
    return float(np.quantile(errors, 0.9)) if errors else np.inf


def _interpolation_m(time_s: Floats, position_m: Floats) -> float | None:
    """Return the RMS error of the spline between epochs: that of every second epoch over 2⁴, one axis, metres."""
    if len(time_s) < 12:
        return None
    apart = position_spline(time_s[::2], position_m[::2])(time_s[1:-1:2]) - position_m[1:-1:2]
    inner = np.linalg.norm(apart, axis=1)[2:-2] / np.sqrt(3)
    return float(np.sqrt(np.mean(inner**2))) / 16
