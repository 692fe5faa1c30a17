"""Times that do not meet: by how much, and which mistake that looks like."""

import numpy as np

from apertura.common.leap_seconds import LATEST_S

Span = tuple[np.datetime64, np.datetime64]

_NEAR_S = 3.0  # logs and recordings of one flight begin and end within a few seconds of each other
_NEAR_ZONE_S = 120.0
_ZONE_S = 1800.0
_LONGEST_ZONE_S = 14 * 3600.0


def clock(time: np.datetime64) -> str:
    """Return a time as date and time of day to the millisecond.

    Examples
    --------
    >>> clock(np.datetime64("2025-05-14T09:30:00.0021", "ns"))
    '2025-05-14T09:30:00.002'
    """
    return str(np.datetime_as_string(time, "ms"))


def gap_s(one: Span, other: Span) -> float:
    """Return the seconds between two spans; 0 or less where they touch or overlap.

    Examples
    --------
    >>> first, second = (np.datetime64(f"2025-05-14T{time}", "ns") for time in ("09:30:00", "09:30:10"))
    >>> late = np.timedelta64(1, "h")
    >>> gap_s((first, second), (first + late, second + late)), gap_s((first, second), (second, second + late))
    (3590.0, 0.0)
    """
    second = np.timedelta64(1, "s")
    return float(max((other[0] - one[1]) / second, (one[0] - other[1]) / second))


def shift_s(one: Span, other: Span) -> float:
    """Return by how many seconds the middle of the other span is later."""
    second = np.timedelta64(1, "s")
    return float(((other[0] - one[0]) / second + (other[1] - one[1]) / second) / 2)


def likely_cause(shift: float) -> str:
    """Return which mistake moves times by so many seconds, as the end of a sentence; '' where none comes to mind.

    Examples
    --------
    >>> likely_cause(17.9), likely_cause(-7201.0), likely_cause(400.0)
    (': GPST taken for UTC?', ': local time taken for UTC?', '')
    """
    size = abs(shift)
    if abs(size - LATEST_S) <= _NEAR_S:
        return ": GPST taken for UTC?" if shift > 0 else f": {LATEST_S} s of GPST taken off times in UTC?"
    zones = round(size / _ZONE_S)
    if zones and size <= _LONGEST_ZONE_S + _NEAR_ZONE_S and abs(size - zones * _ZONE_S) <= _NEAR_ZONE_S:
        return ": local time taken for UTC?"
    return ": a log of another day?" if size > 86400 else ""
