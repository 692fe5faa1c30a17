"""Conversions of units: powers to decibels, times to seconds."""

import numpy as np

from apertura.common.arrays import Floats, Times


def decibels(power_ratio: float) -> float:
    """Return 10 log10 of a ratio of powers; -300 of none.

    Examples
    --------
    >>> decibels(100.0), decibels(0.0)
    (20.0, -300.0)
    """
    return float(10 * np.log10(max(power_ratio, 1e-30)))


def seconds_since(times: Times, start: np.datetime64) -> Floats:
    """Return (time,) float64: seconds from `start` to each of some times.

    Examples
    --------
    >>> times = np.array(["2025-05-14T09:30:00", "2025-05-14T09:30:01.5"], "datetime64[ns]")
    >>> seconds_since(times, times[0])
    array([0. , 1.5])
    """
    return np.asarray((times - start) / np.timedelta64(1, "s"), np.float64)
