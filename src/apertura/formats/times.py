"""Parsing of times in recordings and logs, restricted to plausible years."""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import quoted

FIRST, LAST = np.datetime64("1980-01-01", "ns"), np.datetime64("2200-01-01", "ns")
"""Accepted interval of times; datetime64[ns] covers 1678 to 2262 and overflows outside without a warning."""

_ISO = re.compile(r"(\d{4}-\d\d-\d\d(?:[T ]\d\d:\d\d(?::\d\d(?:\.\d{1,9})?)?)?)\d*", re.ASCII)


def utc_times(texts: Sequence[str]) -> NDArray[np.datetime64]:
    """Parse UTC times in ISO 8601 without a zone designator.

    Parameters
    ----------
    texts
        For example 2025-05-14T09:30:00.5; digits beyond nanoseconds are truncated.

    Returns
    -------
    ndarray
        (time,) datetime64[ns].

    Raises
    ------
    ValueError
        If a text is not a time, or a time is before 1980 or after 2199.

    Examples
    --------
    >>> utc_times(["2025-05-14T09:30"]).astype(str).tolist()
    ['2025-05-14T09:30:00.000000000']
    """
    matches = [_ISO.fullmatch(text) for text in texts]
    if None in matches:
        raise ValueError(f"{quoted(texts[matches.index(None)], 40)} is not a time such as 2025-05-14T09:30:00.5")
    plain = [match[1] for match in matches if match]
    years = np.array([text[:4] for text in plain], np.int64)
    beyond = np.flatnonzero((years < 1980) | (years > 2199))
    if beyond.size:
        raise ValueError(f"{quoted(plain[beyond[0]], 40)} is not between 1980 and 2199")
    return np.array(plain, "datetime64[ns]")


LEAP_SECOND = "within a leap second"
"""Reason for excluding an epoch: datetime64 cannot represent 23:59:60 UTC."""

_LEAP_SECOND = re.compile(r"[T ]\d\d:[25]9:60(?!\d)", re.ASCII)  # :29 or :59, for zones with whole or half hours


def in_leap_second(texts: Sequence[str]) -> NDArray[np.bool_]:
    """Return a mask of the ISO 8601 times that lie within a leap second.

    Examples
    --------
    >>> in_leap_second(["2016-12-31T23:59:59.9", "2016-12-31T23:59:60.1"]).tolist()
    [False, True]
    """
    return np.array([_LEAP_SECOND.search(text) is not None for text in texts], bool)


def coarsened(times: NDArray[np.datetime64]) -> NDArray[np.datetime64]:
    """Convert times to the coarsest of milli-, micro- and nanoseconds that represents them exactly, for output.

    Examples
    --------
    >>> coarsened(np.array(["2025-05-14T09:30:00.1", "2025-05-14T09:30:00.0002"], "datetime64[ns]")).dtype
    dtype('<M8[us]')
    """
    units = ("datetime64[ms]", "datetime64[us]")
    return next((times.astype(unit) for unit in units if (times.astype(unit) == times).all()), times)


def outside(times: NDArray[np.datetime64]) -> NDArray[np.int64]:
    """Return the indices of times that are NaT, before 1980 or after 2199."""
    first, last = (bound.astype(times.dtype) for bound in (FIRST, LAST))  # conversion to ns could overflow
    return np.flatnonzero(~((times >= first) & (times < last)))
