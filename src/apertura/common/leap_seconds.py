"""Leap seconds: offset of GPS time against UTC, and conversions between both."""

import logging

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Times

GPS_EPOCH = np.datetime64("1980-01-06T00:00:00", "ns")
"""Where GPS time begins, without a second between it and UTC."""

KNOWN_UNTIL = np.datetime64("2027-06-28T00:00:00", "ns")
"""No leap second that the table lacks comes before this date (IERS Bulletin C, as tzdata 2026.6 lists it)."""

_BEGINNINGS = (
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01"),
    *("1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01"),
    *("1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
)
_SINCE_UTC = np.array(_BEGINNINGS, "datetime64[ns]")

LATEST_S = len(_BEGINNINGS)
"""Seconds by which GPS time is ahead of UTC since the last of them."""

_SECOND = np.timedelta64(1, "s")
_SINCE_GPS = _SINCE_UTC + np.arange(LATEST_S) * _SECOND  # each begins with the leap second itself, 23:59:60 in UTC
_WEEK = np.timedelta64(7, "D")
_LOG = logging.getLogger(__name__)


def gps_ahead_s(time_utc: Times | np.datetime64) -> NDArray[np.int64]:
    """Return the seconds by which GPS time is ahead of UTC.

    Parameters
    ----------
    time_utc
        Of any shape, datetime64[ns], UTC.

    Returns
    -------
    ndarray
        Of the same shape, int64, s. After `KNOWN_UNTIL` it stays constant, with a notice.

    Raises
    ------
    ValueError
        If a time is before 1980-01-06, where GPS time begins.

    Examples
    --------
    >>> gps_ahead_s(np.array(["2016-12-31T23:59:59", "2017-01-01"], "datetime64[ns]")).tolist()
    [17, 18]

    Notes
    -----
    Source: IERS Bulletin C (https://hpiers.obspm.fr/iers/bul/bulc/); GPS time is 19 s behind TAI (IS-GPS-200, 3.3.4).
    """
    _check(time_utc)
    return np.asarray(np.searchsorted(_SINCE_UTC, time_utc, side="right"), np.int64)


def gps_from_utc(time_utc: Times) -> Times:
    """Return GPS time of times in UTC.

    Parameters
    ----------
    time_utc
        Of any shape, datetime64[ns].

    Raises
    ------
    ValueError
        As `gps_ahead_s`.

    Examples
    --------
    >>> gps_from_utc(np.array(["2025-05-14T09:30:00"], "datetime64[ns]")).astype("datetime64[s]").astype(str).tolist()
    ['2025-05-14T09:30:18']
    """
    return np.asarray(time_utc + gps_ahead_s(time_utc) * _SECOND)


def utc_from_gps(time_gps: Times) -> Times:
    """Return UTC of times that a GPS receiver counts.

    Parameters
    ----------
    time_gps
        Of any shape, datetime64[ns]: calendar dates of GPS time, such as ``GPS_EPOCH`` + weeks + milliseconds.

    Returns
    -------
    ndarray
        Of the same shape, datetime64[ns]; NaT within a leap second: 23:59:60 is a time of UTC that no datetime64 is.
        After `KNOWN_UNTIL` no further leap second is assumed; with a notice.

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
    # n − 1 s after UTC's midnight GPS time meets the n-th leap second; for a second it has not passed
    within = (ahead > 0) & (time_gps - _SINCE_GPS[ahead - 1] < _SECOND)
    return np.where(within, np.datetime64("NaT", "ns"), time_gps - ahead * _SECOND)


def gps_from_weeks(week: NDArray[np.int64], milliseconds: NDArray[np.int64]) -> Times:
    """Return GPS time of weeks since 1980-01-06 (not modulo 1024) and milliseconds in them.

    Examples
    --------
    >>> gps_from_weeks(np.array([2366]), np.array([293_418_000])).astype("datetime64[s]").astype(str).tolist()
    ['2025-05-14T09:30:18']
    """
    return np.asarray(GPS_EPOCH + week * _WEEK + milliseconds * np.timedelta64(1, "ms"))


def _check(time: Times | np.datetime64) -> None:
    """Raise ValueError of a time before GPS time began; warn of one after the table's end."""
    if np.any(~(time >= GPS_EPOCH)):
        raise ValueError("a time before 1980-01-06, where GPS time begins")
    if np.any(time >= KNOWN_UNTIL):
        _LOG.warning("leap seconds are known until %s: %d s are taken after it", str(KNOWN_UNTIL)[:10], LATEST_S)
