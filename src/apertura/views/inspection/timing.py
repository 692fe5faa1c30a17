"""When something was logged or recorded: span, rate, gaps."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Times

NAMED = 10
"""Gaps that are named one by one, the longest."""

_LAG = 16  # intervals over which the rate is measured: what rounds single times averages out
_UNIX_DAYS = np.timedelta64(3650, "D")


def utc(time: np.datetime64) -> str:
    """Return a time to a millisecond, ISO 8601.

    Examples
    --------
    >>> utc(np.datetime64("2025-05-14T09:30:00.1234567", "ns"))
    '2025-05-14T09:30:00.123Z'
    """
    return f"{np.datetime_as_string(time, 'ms')}Z"


def seconds(times: Times) -> NDArray[np.float64]:
    """Return (time,) float64: seconds since the first."""
    return np.asarray((times - times[0]) / np.timedelta64(1, "s"), np.float64)


def interval_s(times: Times) -> float:
    """Return the typical time between neighbours, seconds; inf of one alone.

    The median of single intervals says which stretches are without losses; their mean is finer than times that
    were written coarsely.

    Examples
    --------
    >>> kept = np.delete(np.arange(60), np.arange(20, 60, 9))
    >>> coarse_ms = np.round(kept * 33.34).astype("timedelta64[ms]")
    >>> round(interval_s(np.datetime64("2025-05-14", "ns") + coarse_ms), 4)
    0.0333
    """
    if len(times) < 2:
        return np.inf
    elapsed_s = seconds(times)
    single_s = float(np.median(np.diff(elapsed_s)))
    lag = min(_LAG, len(times) - 1)
    spans_s = elapsed_s[lag:] - elapsed_s[:-lag]
    whole_s = spans_s[np.abs(spans_s - lag * single_s) < single_s / 2]
    return float(np.mean(whole_s)) / lag if whole_s.size else single_s


def gaps(times: Times, longer: float) -> NDArray[np.intp]:
    """Return the numbers of the times before which more than `longer` typical intervals are without any.

    Examples
    --------
    >>> kept = np.delete(np.arange(40), [20, 21])
    >>> gaps(np.datetime64("2025-05-14", "ns") + kept * np.timedelta64(50, "ms"), 1.5)
    array([20])
    """
    return np.flatnonzero(np.diff(seconds(times)) > longer * interval_s(times)) + 1


def timing(times: Times, *, longer: float) -> dict[str, Any]:
    """Return the facts of some times.

    Parameters
    ----------
    times
        (time,) datetime64[ns], ascending, at least one.
    longer
        Intervals from which on there is a gap.
    """
    typical_s, late = interval_s(times), gaps(times, longer)
    lengths_s = np.diff(seconds(times))[late - 1]
    longest = np.sort(late[np.argsort(-lengths_s, kind="stable")[:NAMED]])
    begun = {} if own_clock(times) else {"first_utc": utc(times[0]), "last_utc": utc(times[-1])}
    found: dict[str, Any] = {
        "clock": "its own" if own_clock(times) else "UTC",
        **begun,
        "duration_s": float(seconds(times)[-1]),
        "rate_hz": 1 / typical_s if 0 < typical_s < np.inf else None,
        "gaps": int(late.size),
    }
    if late.size:
        found["lost_in_gaps"] = int((np.round(lengths_s / typical_s) - 1).sum())
        found["longest_gaps"] = [
            {
                "after_s": round(float(seconds(times)[at - 1]), 6),
                "length_s": round(float(seconds(times[at - 1 : at + 1])[-1]), 6),
            }
            for at in longest
        ]
    return found


def own_clock(times: Times) -> bool:
    """Return whether times count from the epoch of the machine: no clock was set when they were taken.

    Examples
    --------
    >>> own_clock(np.array(["1970-01-01T00:00:05"], "datetime64[ns]"))
    True
    """
    return bool(times[0] < np.datetime64(0, "ns") + _UNIX_DAYS)


def counted(times: Times) -> bool:
    """Return whether times only count pulses from the epoch of the machine, one a second: there was no clock at all.

    Examples
    --------
    >>> counted(np.arange(3).astype("datetime64[s]").astype("datetime64[ns]"))
    True
    """
    return own_clock(times) and bool((np.diff(times) == np.timedelta64(1, "s")).all())
