"""Conversion of GPS time to UTC by the table of leap seconds, across each leap second."""

import logging
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import tried

from apertura.common.leap_seconds import (
    GPS_EPOCH,
    KNOWN_UNTIL,
    LATEST_S,
    gps_ahead_s,
    gps_from_utc,
    gps_from_weeks,
    utc_from_gps,
)

MONTHS = {"Jan": "01", "Jun": "06", "Jul": "07", "Dec": "12"}
SECOND = np.timedelta64(1, "s")


def listed():
    """Return the midnights (UTC) at which leap seconds since the GPS epoch end, and the expiry of tzdata's list."""
    lines = (files("tzdata") / "zoneinfo" / "leapseconds").read_text().splitlines()
    rows = [line.split() for line in lines]
    days = [
        np.datetime64(f"{row[1]}-{MONTHS[row[2]]}-{row[3]}", "D") + np.timedelta64(1, "D")
        for row in rows
        if row and row[0] == "Leap"
    ]
    expires = next(row[1:4] for row in rows if row and row[0] in {"Expires", "#Expires"})
    since = np.array([day for day in days if day > GPS_EPOCH], "datetime64[ns]")
    return since, np.datetime64(f"{expires[0]}-{MONTHS[expires[1]]}-{expires[2]}", "ns")


def test_table_of_leap_seconds_matches_tzdata():
    """A failure with a newer tzdata indicates a new leap second or a later expiry: copy the list of tzdata."""
    since, expires = listed()
    assert len(since) == LATEST_S
    np.testing.assert_array_equal(gps_ahead_s(since), np.arange(1, LATEST_S + 1))
    np.testing.assert_array_equal(gps_ahead_s(since - SECOND), np.arange(LATEST_S))
    assert expires >= KNOWN_UNTIL


@pytest.mark.parametrize(
    ("gps", "utc"),
    [
        ("1980-01-06T00:00:00", "1980-01-06T00:00:00"),
        ("1999-08-22T00:00:00", "1999-08-21T23:59:47"),  # the first rollover of GPS weeks
        ("2016-12-31T23:59:59", "2016-12-31T23:59:42"),
        ("2017-01-01T00:00:16.999999999", "2016-12-31T23:59:59.999999999"),
        ("2017-01-01T00:00:18", "2017-01-01T00:00:00"),
        ("2019-04-07T00:00:00", "2019-04-06T23:59:42"),  # the second rollover
    ],
)
def test_gps_time_around_leap_seconds_is_converted(gps, utc):
    assert utc_from_gps(np.array([gps], "datetime64[ns]"))[0] == np.datetime64(utc, "ns")


@pytest.mark.parametrize("fraction", [0, 1, 999_999_999])
def test_leap_second_itself_has_no_utc(fraction):
    within = np.datetime64("2017-01-01T00:00:17", "ns") + np.timedelta64(fraction, "ns")
    assert np.isnat(utc_from_gps(np.array([within]))).all()


@pytest.mark.parametrize("time", ["1980-01-05T23:59:59", "NaT"])
def test_time_before_the_gps_epoch_is_rejected(time):
    with pytest.raises(ValueError, match="1980-01-06"):
        utc_from_gps(np.array([time], "datetime64[ns]"))


@tried(100, derandomize=False)
@given(st.integers(0, 60 * 365 * 86400 * 10**9))
def test_utc_to_gps_and_back_is_the_same_instant(nanoseconds):
    utc = np.array([GPS_EPOCH + np.timedelta64(nanoseconds, "ns")])
    gps = gps_from_utc(utc)
    np.testing.assert_array_equal(utc_from_gps(gps), utc)
    assert 0 <= (gps - utc)[0] / SECOND <= LATEST_S


def test_gps_week_and_milliseconds_are_converted():
    assert gps_from_weeks(np.array([2052]), np.array([5_400_000]))[0] == np.datetime64("2019-05-05T01:30:00", "ns")


def test_time_beyond_the_table_gives_a_notice(caplog):
    with caplog.at_level(logging.WARNING):
        gps_ahead_s(np.array([KNOWN_UNTIL - SECOND]))
        assert not caplog.text
        gps_ahead_s(np.array([KNOWN_UNTIL]))
    assert "known until 2027-06-28" in caplog.text
