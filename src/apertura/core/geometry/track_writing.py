"""What is wrong with how a flight log was written: positions that stood still, times that were rounded."""

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.track_faults import GRAIN_M, MATTERS_M, Floats, misfits


def find_frozen(time_s: Floats, position_m: Floats) -> NDArray[np.bool_]:
    """Return (epoch,) bool: epochs that only repeat the position before them although the node flew on.

    A node that stops comes to rest and starts from rest. One that was flying just before and just after, and is found
    as far away as that takes it, did not stand where a log repeats to the last digit: if three repeats or more follow
    each other, or every tenth epoch is one, since noise may repeat a coarse position by chance.

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
    still = np.append((np.minimum(travel, jump) > 3 * GRAIN_M) & (jump > travel / 2), False)
    length = last - first
    still[-1] = length[-1] <= length[still].max(initial=-1)  # a landing is longer
    frozen = repeats & still[run]
    return np.asarray(frozen if frozen.mean() > 0.1 else frozen & (length >= 3)[run])


def rounded_time_m(time_s: Floats, position_m: Floats) -> float:
    """Return how far times written too coarsely move positions along the flight, RMS metres; 0 where they do not.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, whole multiples of how finely they were written.

    Notes
    -----
    Times rounded to a grain g err by g/√12, positions by that times the speed, along the flight alone: this is
    believed where intervals are unequal and positions scatter along the flight as much as that and three times as
    much as across. Source: docs/theory/tracks.md, "Rounded times".

    Examples
    --------
    >>> true_s = np.arange(200) * 0.13
    >>> flown = np.stack([8 * true_s, 0 * true_s, 0 * true_s], -1)
    >>> round(rounded_time_m(true_s.round(1), flown), 2), rounded_time_m(true_s, flown)  # 8 m/s · 0.1 s/√12
    (0.23, 0.0)
    """
    steps = np.diff(time_s)
    grain = next((g for g in (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01) if _multiples(time_s, g)), 0.0)
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
    believed = typical > max(0.5 * expected, 3 * float(np.median(across)), MATTERS_M)
    return float(expected) if believed else 0.0


def _multiples(time_s: Floats, grain_s: float) -> bool:
    steps = np.diff(time_s) / grain_s
    return bool((np.abs(steps - np.round(steps)) < 1e-4).all())
