"""Unit conversions: power ratios to decibels, times to seconds."""

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats, Times


def decibels(power_ratio: float) -> float:
    """Convert a power ratio to decibels, with -300 dB as the lower limit.

    Examples
    --------
    >>> decibels(100.0), decibels(0.0)
    (20.0, -300.0)
    """
    return float(10 * np.log10(max(power_ratio, 1e-30)))


def seconds_since(times: Times, start: np.datetime64) -> Floats:
    """Convert times to seconds since `start`, (time,) float64.

    Examples
    --------
    >>> times = np.array(["2025-05-14T09:30:00", "2025-05-14T09:30:01.5"], "datetime64[ns]")
    >>> seconds_since(times, times[0])
    array([0. , 1.5])
    """
    return np.asarray((times - start) / np.timedelta64(1, "s"), np.float64)


def nanoseconds(times: Times) -> NDArray[np.int64]:
    """Convert times to nanoseconds since 1970-01-01.

    Examples
    --------
    >>> nanoseconds(np.array(["1970-01-01T00:00:01"], "datetime64[s]")).tolist()
    [1000000000]
    """
    return times.astype("datetime64[ns]").astype(np.int64)
