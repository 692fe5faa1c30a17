"""Times that recorders and logs write, within the years that any of them can have been made in."""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import quoted

FIRST, LAST = np.datetime64("1980-01-01", "ns"), np.datetime64("2200-01-01", "ns")
"""Years of any recording; numpy counts nanoseconds only between 1678 and 2262 and wraps beyond without a word."""

_ISO = re.compile(r"(\d{4}-\d\d-\d\d(?:[T ]\d\d:\d\d(?::\d\d(?:\.\d{1,9})?)?)?)\d*", re.ASCII)


def utc_times(texts: Sequence[str]) -> NDArray[np.datetime64]:
    """Return times written as ISO 8601 in UTC without saying so.

    Parameters
    ----------
    texts
        Such as 2025-05-14T09:30:00.5; digits beyond nanoseconds are cut off.

    Returns
    -------
    ndarray
        (time,) datetime64[ns].

    Raises
    ------
    ValueError
        If one is no time, or is before 1980 or after 2199.

    Examples
    --------
    >>> utc_times(["2025-05-14T09:30"]).astype(str).tolist()
    ['2025-05-14T09:30:00.000000000']
    """
    matches = [_ISO.fullmatch(text) for text in texts]
    if None in matches:
        raise ValueError(f"{quoted(texts[matches.index(None)], 40)} is no time such as 2025-05-14T09:30:00.5")
    plain = [match[1] for match in matches if match]
    years = np.array([text[:4] for text in plain], np.int64)
    beyond = np.flatnonzero((years < 1980) | (years > 2199))
    if beyond.size:
        raise ValueError(f"{quoted(plain[beyond[0]], 40)} is not between 1980 and 2199")
    return np.array(plain, "datetime64[ns]")


LEAP_SECOND = "within a leap second"
"""Reason why an epoch is left out: UTC counts 23:59:60, which no datetime64 is."""

_LEAP_SECOND = re.compile(r"[T ]\d\d:[25]9:60(?!\d)", re.ASCII)  # minute of any zone, whole or half hours


def in_leap_second(texts: Sequence[str]) -> NDArray[np.bool_]:
    """Return a mask of the times, written as ISO 8601, that are within a leap second.

    Examples
    --------
    >>> in_leap_second(["2016-12-31T23:59:59.9", "2016-12-31T23:59:60.1"]).tolist()
    [False, True]
    """
    return np.array([_LEAP_SECOND.search(text) is not None for text in texts], bool)


def coarsened(times: NDArray[np.datetime64]) -> NDArray[np.datetime64]:
    """Return times in the coarsest of milli-, micro- and nanoseconds that holds them exactly, to be written.

    Examples
    --------
    >>> coarsened(np.array(["2025-05-14T09:30:00.1", "2025-05-14T09:30:00.0002"], "datetime64[ns]")).dtype
    dtype('<M8[us]')
    """
    units = ("datetime64[ms]", "datetime64[us]")
    return next((times.astype(unit) for unit in units if (times.astype(unit) == times).all()), times)


def outside(times: NDArray[np.datetime64]) -> NDArray[np.int64]:
    """Return the indices of times that are none, or are before 1980 or after 2199."""
    first, last = (bound.astype(times.dtype) for bound in (FIRST, LAST))  # nanoseconds would not hold all others
    return np.flatnonzero(~((times >= first) & (times < last)))
