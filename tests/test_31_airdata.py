"""AirData exports of DJI logs: two clocks combined into one, heights with a configured datum offset."""

import numpy as np
import pandas as pd
import pytest
from folders import complaint
from hypothesis import given
from hypothesis import strategies as st
from properties import tried

from apertura.common.contracts import check
from apertura.core.geometry.geodesy import geodetic_from_ecef, ned_axes
from apertura.formats.reading import read_track
from apertura.formats.tracks.log_options import LogOptions
from tests.attack import logs

TIMES, PLACES = logs.circle(60)


def read(tmp_path, text, **options):
    path = tmp_path / "a.track.csv"
    path.write_text(text)
    return check(read_track(path, node="a", options=LogOptions(**{"height_offset_m": 48.0, **options})), "track")


def test_export_has_positions_attitude_and_times(tmp_path):
    track = read(tmp_path, logs.airdata(TIMES, PLACES))
    np.testing.assert_allclose(geodetic_from_ecef(track.position.values), PLACES, atol=2e-6, rtol=0)
    np.testing.assert_allclose(np.degrees(track.attitude.values[0]), [1.5, -2.5, 90.5])
    assert "fix" not in track
    np.testing.assert_array_equal(np.diff(track.time.values), np.diff(TIMES))


@tried(30)
@given(begins_ms=st.integers(0, 5000))
def test_fraction_of_a_second_is_estimated_to_half_an_interval(tmp_path_factory, begins_ms):
    times = TIMES + np.timedelta64(begins_ms, "ms")
    track = read(tmp_path_factory.mktemp("log"), logs.airdata(times, PLACES))
    assert (np.abs(track.time.values - times) <= np.timedelta64(50, "ms")).all()
    assert "misfit to the millisecond clock 0.00 s, continuous clock segments: 1" in track.remarks[0]


def test_stopped_clock_is_aligned_again(tmp_path):
    """As in the real log, 74 s pass between rows whose clocks differ by 100 ms; a segment of 0.3 s is not timed."""
    times = TIMES.copy()
    times[30:33] += np.timedelta64(500_000, "ms")
    times[33:] += np.timedelta64(573_900, "ms")
    clock = 100 + 100 * np.arange(60)
    track = read(tmp_path, logs.airdata(times, PLACES, clock_ms=clock))
    kept = np.delete(times, [30, 31, 32])
    assert (np.abs(track.time.values - kept) <= np.timedelta64(50, "ms")).all()
    assert track.dropped == {"in a segment too short to determine its time": 3}
    assert "continuous clock segments: 3" in track.remarks[0]


def test_heights_above_sea_level_need_an_offset(tmp_path):
    message = complaint(lambda: read(tmp_path, logs.airdata(TIMES, PLACES), height_offset_m=None))
    assert "heights above mean sea level; expected key nodes.a.log.height_offset_m" in message


def test_configured_time_system_other_than_utc_is_rejected(tmp_path):
    assert "datetime(utc) is UTC" in complaint(lambda: read(tmp_path, logs.airdata(TIMES, PLACES), time_system="gpst"))


def test_heights_in_feet_are_converted(tmp_path):
    text = logs.airdata(TIMES, PLACES).replace("seaLevel(meters)", "seaLevel(feet)")
    heights = geodetic_from_ecef(read(tmp_path, text).position.values)[:, 2]
    np.testing.assert_allclose(heights, (PLACES[:, 2] - 48) * 0.3048 + 48, atol=1e-6)


def test_repeated_rows_and_rows_without_satellites_are_dropped(tmp_path):
    lines = logs.airdata(TIMES, PLACES).splitlines()
    lines[20] = lines[20].replace(",17,", ",3,")
    track = read(tmp_path, "\n".join([*lines[:10], lines[9], *lines[10:]]) + "\n")
    assert track.dropped == {"duplicate": 1, "fewer than 4 satellites": 1}
    np.testing.assert_array_equal(np.diff(np.delete(TIMES, 19)), np.diff(track.time.values))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            lambda lines: lines[:5] + [lines[5].replace("23:59:57", "noon")] + lines[6:],
            "'2025-05-14 noon' is not a date",
        ),
        (lambda lines: [*lines[:5], lines[6], lines[5], *lines[7:]], "does not increase"),
        (lambda lines: [lines[0].replace("seaLevel", "takeoff"), *lines[1:]], "no column altitude_above_seaLevel"),
        (lambda lines: [lines[0].replace("latitude,", "lat,"), *lines[1:]], "no column latitude"),
        (lambda lines: [*lines[:7], lines[7].replace("48.4", "x"), *lines[8:]], "column latitude: 'x"),
        (lambda lines: [*lines[:7], lines[7][:40], *lines[8:]], "cells, the header 11"),
        (lambda _: logs.airdata(TIMES, PLACES, clock_ms=110 * np.arange(60)).splitlines(), "a difference of "),
        (lambda lines: [lines[0], *lines[1:5]], "too sparse to determine when the second changes"),
    ],
)
def test_unreadable_export_is_one_message(tmp_path, change, expected):
    text = "\n".join(change(logs.airdata(TIMES, PLACES).splitlines())) + "\n"
    message = complaint(lambda: read(tmp_path, text))
    assert "a.track.csv: " in message
    assert expected in message


def dated(form, times=TIMES):
    """Return an export with dates in another format."""
    text = logs.airdata(times, PLACES)
    for time in times.astype("datetime64[s]").tolist():
        text = text.replace(str(time), form(time), 1) if str(time) in text else text
    return text


FORMATS = {
    "5/14/2025 11:59:57 PM": lambda t: f"{t.month}/{t.day}/{t.year} {t.strftime('%I:%M:%S %p').lstrip('0')}",
    "14/5/2025 23:59:57": lambda t: f"{t.day}/{t.month}/{t.year} {t:%H:%M:%S}",
    "14.05.2025 23:59:57": lambda t: f"{t:%d.%m.%Y %H:%M:%S}",
    "2025/05/14 11:59:57PM": lambda t: f"{t:%Y/%m/%d %I:%M:%S%p}",
}


@pytest.mark.parametrize("form", FORMATS.values(), ids=FORMATS)
@pytest.mark.parametrize("back_days", [0, 9], ids=["14 May", "5 May"])
def test_every_date_format_of_an_account_is_read(tmp_path, form, back_days):
    """The flight passes midnight, and the change of date (5/5 to 5/6 or 6/5) identifies the number of the day."""
    times = TIMES - np.timedelta64(back_days, "D")
    track = read(tmp_path, dated(form, times))
    assert (np.abs(track.time.values - times) <= np.timedelta64(50, "ms")).all()


def test_ambiguous_date_is_reported_with_the_account_setting(tmp_path):
    times = TIMES - np.timedelta64(10 * 86400 + 3600, "s")  # 4 May, 22:59
    message = complaint(lambda: read(tmp_path, dated(FORMATS["5/14/2025 11:59:57 PM"], times)))
    assert "column datetime(utc): '5/4/2025 10:59:57 PM' is ambiguous: month/day or day/month" in message
    assert "Set the date format of the AirData account to YYYY-MM-DD and 24 hours" in message
    german = read(tmp_path, dated(FORMATS["14.05.2025 23:59:57"], times))
    assert (np.abs(german.time.values - times) <= np.timedelta64(50, "ms")).all()


def test_times_in_minutes_are_read_if_the_minute_changes(tmp_path):
    """A spreadsheet saves such times, e.g. 5/14/2025 23:59."""
    track = read(tmp_path, dated(lambda t: f"{t.month}/{t.day}/{t.year} {t:%H:%M}"))
    assert (np.abs(track.time.values - TIMES) <= np.timedelta64(50, "ms")).all()
    assert "datetime(utc) contains whole minutes" in track.remarks[0]
    early = dated(lambda t: f"{t.month}/{t.day}/{t.year} {t:%H:%M}", TIMES - np.timedelta64(30, "s"))
    assert "the epochs are too sparse to determine when the minute changes" in complaint(lambda: read(tmp_path, early))


@pytest.fixture(scope="module")
def real(shared):
    return shared / "dji_rtk_ansfl" / "Jul-7th-2022-11-10AM-Flight-Airdata.csv"


@pytest.fixture(scope="module")
def flight(real):
    return check(read_track(real, node="uav1", options=LogOptions(height_offset_m=17.0)), "track")


@pytest.fixture(scope="module")
def table(real):
    return pd.read_csv(real, skipinitialspace=True)


def test_real_flight_has_the_epochs_and_positions_of_its_rows(flight, table):
    assert flight.sizes["epoch"] == len(table) == 9773
    assert flight.dropped == {}
    assert str(flight.time.values[0])[:19] == "2022-07-07T08:10:25"
    assert np.median(np.diff(flight.time.values)) == np.timedelta64(100, "ms")
    geodetic = geodetic_from_ecef(flight.position.values)
    columns = ["latitude", "longitude", "altitude_above_seaLevel(meters)"]
    for axis, (column, offset_m) in enumerate(zip(columns, (0, 0, 17), strict=True)):
        np.testing.assert_allclose(geodetic[:, axis], table[column] + offset_m, atol=1e-9 if axis < 2 else 1e-6)


def test_epochs_of_a_real_flight_lie_in_their_utc_second(flight, table):
    """This holds although the millisecond clock stopped twice, for 74.5 s and 12.3 s, while the motors were off."""
    second = table["datetime(utc)"].to_numpy("datetime64[ns]")
    within = (flight.time.values - second) / np.timedelta64(1, "s")
    assert within.min() >= -0.051
    assert within.max() <= 1.051
    assert "misfit to the millisecond clock 0.05 s, continuous clock segments: 3" in flight.remarks[0]
    gaps = np.diff(flight.time.values) / np.timedelta64(1, "s")
    np.testing.assert_allclose(np.sort(gaps)[-3:], [0.2, 12.4, 74.6], atol=0.051)


def test_velocity_of_a_real_flight_matches_the_logged_speed(flight, table):
    """Differentiated positions agree with the logged speeds to north and east within 0.1 m/s (median)."""
    rows = slice(2000, 7000)
    north, east = (flight.position.values @ ned_axes(flight.position.values[0]))[rows, :2].T
    seconds = (flight.time.values[rows] - flight.time.values[0]) / np.timedelta64(1, "s")
    logged = table[["xSpeed(m/s)", "ySpeed(m/s)"]].to_numpy()[rows].T
    velocity = np.stack([np.gradient(axis, seconds) for axis in (north, east)])
    assert np.median(np.abs(velocity - logged)) < 0.1


def test_rtk_ground_truth_agrees_with_the_flight(flight, table, shared):
    truth = pd.read_csv(shared / "dji_rtk_ansfl" / "GTExtended.csv", skipinitialspace=True)
    rows = np.flatnonzero(table["time(millisecond)"].isin(truth["time(millisecond)"]))
    assert len(rows) == len(truth) == 239
    position = flight.position.values[rows]
    displacement = (position - position[0]) @ ned_axes(position[0])
    np.testing.assert_allclose(displacement, truth[["North", "East", "Down"]], atol=0.1)
    seconds = (flight.time.values[rows] - flight.time.values[rows[0]]) / np.timedelta64(1, "s")
    np.testing.assert_allclose(seconds, (truth["time(millisecond)"] - 56100) / 1000, atol=1e-6)
    for axis, column in enumerate(["roll(degrees)", "pitch(degrees)", "compass_heading(degrees)"]):
        np.testing.assert_allclose(np.degrees(flight.attitude.values[rows, axis]), truth[column])
