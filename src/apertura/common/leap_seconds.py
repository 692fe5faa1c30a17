"""Leap seconds: offset between GPS time and UTC, and conversions between GPS time and UTC."""

import logging

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Times

GPS_EPOCH = np.datetime64("1980-01-06T00:00:00", "ns")
"""Epoch of GPS time, at which GPS time equals UTC."""

KNOWN_UNTIL = np.datetime64("2027-06-28T00:00:00", "ns")
"""Date until which the table of leap seconds is complete (IERS Bulletin C, as listed in tzdata 2026.6)."""

_BEGINNINGS = (
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01"),
    *("1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01"),
    *("1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
)
_SINCE_UTC = np.array(_BEGINNINGS, "datetime64[ns]")

LATEST_S = len(_BEGINNINGS)
"""Seconds by which GPS time is ahead of UTC after the latest leap second."""

_SECOND = np.timedelta64(1, "s")
_SINCE_GPS = _SINCE_UTC + np.arange(LATEST_S) * _SECOND  # start of each leap second (23:59:60 UTC) in GPS time
_WEEK = np.timedelta64(7, "D")
_LOG = logging.getLogger(__name__)


def gps_ahead_s(time_utc: Times | np.datetime64) -> NDArray[np.int64]:
    """Return the number of seconds by which GPS time is ahead of UTC.

    Parameters
    ----------
    time_utc
        UTC, datetime64[ns], any shape.

    Returns
    -------
    ndarray
        Offset in s, int64, of the same shape. After `KNOWN_UNTIL` the offset is assumed to be constant, with a warning.

    Raises
    ------
    ValueError
        If a time is before 1980-01-06, the epoch of GPS time.

    Examples
    --------
    >>> gps_ahead_s(np.array(["2016-12-31T23:59:59", "2017-01-01"], "datetime64[ns]")).tolist()
    [17, 18]

    Notes
    -----
    Source: IERS Bulletin C (https://hpiers.obspm.fr/iers/bul/bulc/). GPS time is 19 s behind TAI (IS-GPS-200, 3.3.4).
    """
    _check(time_utc)
    return np.asarray(np.searchsorted(_SINCE_UTC, time_utc, side="right"), np.int64)


def gps_from_utc(time_utc: Times) -> Times:
    """Convert UTC to GPS time.

    Parameters
    ----------
    time_utc
        UTC, datetime64[ns], any shape.

    Raises
    ------
    ValueError
        See `gps_ahead_s`.

    Examples
    --------
    >>> gps_from_utc(np.array(["2025-05-14T09:30:00"], "datetime64[ns]")).astype("datetime64[s]").astype(str).tolist()
    ['2025-05-14T09:30:18']
    """
    return np.asarray(time_utc + gps_ahead_s(time_utc) * _SECOND)


def utc_from_gps(time_gps: Times) -> Times:
    """Convert GPS time to UTC.

    Parameters
    ----------
    time_gps
        GPS time as calendar date, such as ``GPS_EPOCH`` + weeks + milliseconds; datetime64[ns], any shape.

    Returns
    -------
    ndarray
        UTC, datetime64[ns], of the same shape; NaT within a leap second, which datetime64 cannot represent (23:59:60).
        After `KNOWN_UNTIL` no further leap second is assumed, with a warning.

    Raises
    ------
    ValueError
        If a time is before 1980-01-06.

    Examples
    --------
    >>> gps = np.array(["2017-01-01T00:00:16", "2017-01-01T00:00:18"], "datetime64[ns]")
    >>> utc_from_gps(gps).astype("datetime64[s]").astype(str).tolist()
    ['2016-12-31T23:59:59', '2017-01-01T00:00:00']
    """
    _check(time_gps)
    ahead = np.asarray(np.searchsorted(_SINCE_GPS, time_gps, side="right"), np.int64)
    # the n-th leap second lasts from _SINCE_GPS[n - 1] for one second
    within = (ahead > 0) & (time_gps - _SINCE_GPS[ahead - 1] < _SECOND)
    return np.where(within, np.datetime64("NaT", "ns"), time_gps - ahead * _SECOND)


def gps_from_weeks(week: NDArray[np.int64], milliseconds: NDArray[np.int64]) -> Times:
    """Convert GPS week (since 1980-01-06, not modulo 1024) and millisecond of the week to GPS time.

    Examples
    --------
    >>> gps_from_weeks(np.array([2366]), np.array([293_418_000])).astype("datetime64[s]").astype(str).tolist()
    ['2025-05-14T09:30:18']
    """
    return np.asarray(GPS_EPOCH + week * _WEEK + milliseconds * np.timedelta64(1, "ms"))


def _check(time: Times | np.datetime64) -> None:
    """Raise ValueError at a time before the GPS epoch; warn about a time after the end of the table."""
    if np.any(~(time >= GPS_EPOCH)):
        raise ValueError("a time before 1980-01-06, the epoch of GPS time")
    if np.any(time >= KNOWN_UNTIL):
        _LOG.warning(
            "leap seconds are known until %s: an offset of %d s is assumed after this date",
            str(KNOWN_UNTIL)[:10],
            LATEST_S,
        )
