"""RTKLIB solutions: every format of RTKLIB gives the same track; missing header entries must be configured."""

import numpy as np
import pytest
from folders import complaint

from apertura.common.contracts import check
from apertura.core.geometry.geodesy import ecef_from_geodetic, ned_axes
from apertura.formats.reading import read_track
from apertura.formats.tracks.log_options import LogOptions
from tests.attack import logs

TIMES, PLACES = logs.circle()
ECEF = ecef_from_geodetic(*PLACES.T)
BASE = (48.399, 9.951, 590.0)
LLH = "latitude(deg) longitude(deg) height(m)"
DMS = "latitude(d'\") longitude(d'\") height(m)"
XYZ = "x-ecef(m) y-ecef(m) z-ecef(m)"
ENU = "e-baseline(m) n-baseline(m) u-baseline(m)"


def read(tmp_path, text, **options):
    path = tmp_path / "a.track.pos"
    path.write_text(text)
    return check(read_track(path, node="a", options=LogOptions(**options)), "track")


def sexagesimal(angle, separator):
    """Return an angle in RTKLIB's format: the sign precedes the degrees, -0 included."""
    degrees, rest = divmod(round(abs(angle) * 3600e7), 3600 * 10**7)
    minutes, seconds = divmod(rest, 60 * 10**7)
    return separator.join([f"{'-' if angle < 0 else ''}{degrees}", f"{minutes:02d}", f"{seconds / 1e7:010.7f}"])


def baselines():
    axes = ned_axes(ecef_from_geodetic(*np.array(BASE)))
    return (ECEF - ecef_from_geodetic(*np.array(BASE))) @ np.stack([axes[:, 1], axes[:, 0], -axes[:, 2]], -1)


def written(kind, separator=" "):
    """Return a solution of the flight in a format."""
    if kind == "dms":
        rows = [[*(sexagesimal(angle, separator) for angle in row[:2]), row[2]] for row in PLACES.tolist()]
        return logs.solution(TIMES, rows, DMS, separator=separator)
    values, names = {"llh": (PLACES, LLH), "ecef": (ECEF, XYZ), "enu": (baselines(), ENU)}[kind]
    head = [f"% ref pos   : {separator.join(f'{value:.9f}' for value in BASE)}"] if kind == "enu" else []
    return logs.solution(TIMES, values, names, separator=separator, head=head)


@pytest.mark.parametrize("separator", [" ", ",", "\t", ";", ", "])
@pytest.mark.parametrize("kind", ["llh", "dms", "ecef", "enu"])
def test_every_format_and_separator_gives_the_same_track(tmp_path, kind, separator):
    track = read(tmp_path, written(kind, separator))
    np.testing.assert_allclose(track.position.values, ECEF, atol=1e-4 if kind == "dms" else 1e-5, rtol=0)
    np.testing.assert_array_equal(track.time.values, TIMES)
    assert set(track.fix.values) == {1}


def test_minus_zero_degrees_is_south_or_west(tmp_path):
    rows = [["-0 30 00.0", "-0 15 36.0", "600.0"]] * 2
    track = read(tmp_path, logs.solution(TIMES[:2], rows, DMS))
    np.testing.assert_allclose(track.position.values[0], ecef_from_geodetic(-0.5, -0.26, 600.0), atol=1e-6)


@pytest.mark.parametrize(("system", "ahead_s"), [("UTC", 0), ("GPST", 18), ("JST", 9 * 3600)])
@pytest.mark.parametrize("weeks", [False, True])
def test_times_of_every_system_are_converted_to_utc(tmp_path, system, ahead_s, weeks):
    ahead = TIMES + np.timedelta64(ahead_s, "s")
    text = logs.solution(ahead, PLACES, LLH, system=system)
    if weeks:
        since = (ahead - np.datetime64("1980-01-06", "ns")).astype(int)
        for time, (week, rest) in zip(ahead, (divmod(ns, 7 * 86400 * 10**9) for ns in since), strict=True):
            stamp = np.datetime_as_string(time, "ms").replace("-", "/").replace("T", " ")
            text = text.replace(stamp, f"{week} {rest / 1e9:.3f}")
    np.testing.assert_array_equal(read(tmp_path, text).time.values, TIMES)


@pytest.mark.parametrize(("day", "ahead_s"), [("2010-06-01", 15), ("2015-06-30", 16), ("2016-12-31", 17)])
def test_gps_time_of_earlier_years_has_fewer_leap_seconds(tmp_path, day, ahead_s):
    times = np.datetime64(f"{day}T12:00", "ns") + np.arange(3) * np.timedelta64(1, "s")
    text = logs.solution(times + np.timedelta64(ahead_s, "s"), PLACES[:3], LLH, system="GPST")
    np.testing.assert_array_equal(read(tmp_path, text).time.values, times)


def test_lines_without_a_solution_are_dropped(tmp_path):
    lines = written("llh").splitlines()
    for line, quality in ((5, 0), (6, 5), (7, 2)):
        lines[line] = lines[line][:-1] + str(quality)
    track = read(tmp_path, "\n".join(lines) + "\n")
    assert track.dropped == {"Q = 0": 1}
    assert track.fix.values[2:6].tolist() == [1, 5, 2, 1]
    np.testing.assert_array_equal(track.time.values, np.delete(TIMES, 3))


def test_ecef_standard_deviations_are_rotated_to_north_east_up(tmp_path):
    """The covariance is diagonal in north, east and up (5, 2 and 1 cm); some covariances in ECEF are negative."""
    axes = ned_axes(ECEF)
    covariance = axes @ np.diag([0.05, 0.02, 0.01]) ** 2 @ np.swapaxes(axes, 1, 2)
    parts = covariance[:, [0, 1, 2, 0, 1, 2], [0, 1, 2, 1, 2, 0]]
    columns = np.hstack([ECEF, np.sign(parts) * np.sqrt(np.abs(parts))])
    assert (parts[:, 3:] < 0).any()
    names = f"{XYZ} sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m)"
    track = read(tmp_path, logs.solution(TIMES, columns, names))
    np.testing.assert_allclose(track.position_std.values, np.tile([0.05, 0.02, 0.01], (40, 1)), atol=1e-7)


def test_columns_of_standard_deviations_may_have_any_order(tmp_path):
    columns = np.hstack([baselines(), np.tile([0.02, 0.01, 0.05], (40, 1))])
    text = logs.solution(TIMES, columns, f"{ENU} sde(m) sdn(m) sdu(m)")
    np.testing.assert_array_equal(read(tmp_path, text, base=BASE).position_std.values[0], [0.01, 0.02, 0.05])


def test_base_of_baselines_comes_from_header_or_config(tmp_path):
    text = written("enu")
    bare = "\n".join(line for line in text.splitlines() if "ref pos" not in line) + "\n"
    assert "without the position of their base (ref pos); expected key nodes.a.log.base" in complaint(
        lambda: read(tmp_path, bare)
    )
    expected = read(tmp_path, text).position.values
    np.testing.assert_allclose(read(tmp_path, bare, base=BASE).position.values, expected, atol=1e-6)
    np.testing.assert_allclose(read(tmp_path, text, base=BASE).position.values, expected, atol=1e-6)
    elsewhere = (BASE[0] + 1e-6, *BASE[1:])
    assert "ref pos" in complaint(lambda: read(tmp_path, text, base=elsewhere))
    sexagesimal_base = text.replace(" 48.399000000 9.951000000", " 48 23 56.40000 9 57 03.60000")
    assert sexagesimal_base != text
    np.testing.assert_allclose(read(tmp_path, sexagesimal_base).position.values, expected, atol=1e-3)
    invalid_base = text.replace(" 48.399000000 9.951", " 98.399000000 9.951")
    assert "ref pos '98.399" in complaint(lambda: read(tmp_path, invalid_base))


def test_height_offset_applies_to_geoid_heights_only(tmp_path):
    text = written("llh").replace("/ellipsoidal", "/geodetic")
    track = read(tmp_path, text, height_offset_m=48.0)
    np.testing.assert_allclose(track.position.values, ecef_from_geodetic(*(PLACES + [0, 0, 48]).T), atol=1e-5)
    message = complaint(lambda: read(tmp_path, written("llh"), height_offset_m=48.0))
    assert "heights are ellipsoidal; expected nodes.a.log.height_offset_m of config.yaml" in message


def restarted(first, second, **written):
    """Return a log of two parts of 20 epochs, each with a header; the dicts may set system and kind."""
    parts = []
    for part, keys in ((slice(0, 20), first), (slice(20, 40), second)):
        system = keys.get("system", "UTC")
        times = TIMES[part] + np.timedelta64({"GPST": 18, "UTC": 0, "JST": 9 * 3600}[system], "s")
        values, names = {"llh": (PLACES, LLH), "ecef": (ECEF, XYZ)}[keys.get("kind", "llh")]
        parts.append(logs.solution(times, values[part], names, system=system, **written))
    return "".join(parts)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"system": "GPST"}, {"system": "UTC"}),
        ({"system": "UTC"}, {"system": "GPST"}),
        ({"system": "JST"}, {"kind": "ecef"}),
        ({"kind": "ecef"}, {"system": "GPST"}),
    ],
)
def test_each_part_is_read_with_its_own_header(tmp_path, first, second):
    """Such logs are written by rtkrcv after a restart or joined by `cat`."""
    track = read(tmp_path, restarted(first, second))
    np.testing.assert_array_equal(track.time.values, TIMES)
    np.testing.assert_allclose(track.position.values, ECEF, atol=1e-5, rtol=0)


def test_columns_and_time_format_may_change_with_a_header(tmp_path):
    """The second header has weeks, seconds and reordered standard deviations; the first has no standard deviations."""
    columns = np.hstack([PLACES[20:], np.tile([0.02, 0.01, 0.05], (20, 1))])
    second = logs.solution(TIMES[20:], columns, f"{LLH} sde(m) sdn(m) sdu(m)")
    for time in TIMES[20:]:
        week, rest = divmod((time - np.datetime64("1980-01-06", "ns")).astype(int), 7 * 86400 * 10**9)
        stamp = np.datetime_as_string(time, "ms").replace("-", "/").replace("T", " ")
        second = second.replace(stamp, f"{week} {rest / 1e9:.3f}")
    track = read(tmp_path, logs.solution(TIMES[:20], PLACES[:20], LLH) + second)
    np.testing.assert_array_equal(track.time.values, TIMES)
    assert np.isnan(track.position_std.values[:20]).all()
    np.testing.assert_array_equal(track.position_std.values[20:], np.tile([0.01, 0.02, 0.05], (20, 1)))


def test_comment_among_solutions_is_no_header(tmp_path):
    lines = written("llh").splitlines()
    track = read(tmp_path, "\n".join([*lines[:9], "% battery low", *lines[9:]]) + "\n")
    np.testing.assert_array_equal(track.time.values, TIMES)
    half = "\n".join([*lines[:9], "% ref pos : 48 9 600", *lines[9:]]) + "\n"
    assert "no header line after line 9 with latitude(deg)" in complaint(lambda: read(tmp_path, half))


@pytest.mark.parametrize("datum", ["Tokyo", "NAD83", "ED50"])
@pytest.mark.parametrize("kind", ["llh", "ecef", "enu"])
def test_datum_other_than_wgs_84_is_rejected(tmp_path, datum, kind):
    name = {"llh": "lat/lon/height", "ecef": "x/y/z-ecef", "enu": "e/n/u-baseline"}[kind]
    head, rest = written(kind).split("\n", 1)
    assert "WGS84" in head
    text = f"% ({name}={datum}{'/ellipsoidal' if kind == 'llh' else ''},Q=1:fix)\n{rest}"
    message = complaint(lambda: read(tmp_path, text))
    assert f"line 1: positions in datum '{datum}'; expected WGS84" in message
    assert read(tmp_path, text.replace(datum, "ITRF2014")).sizes["epoch"] == 40


def test_header_with_two_time_systems_is_rejected(tmp_path):
    text = logs.solution(TIMES, PLACES, LLH, system="GPST", head=["% obs start : 2025/05/14 23:59:57.0 UTC (week2366)"])
    assert "times are GPST according to the column header and UTC according to line 2, '% obs start" in complaint(
        lambda: read(tmp_path, text)
    )
    assert read(tmp_path, text.replace(".0 UTC", ".0 GPST")).sizes["epoch"] == 40


@pytest.mark.parametrize("spelling", ["-1.#IND", "1.#QNAN", "1.#INF", "-nan(ind)", "nan(snan)", "-nan", "1.#J", "inf"])
def test_standard_deviation_printed_as_nan_is_unknown(tmp_path, spelling):
    columns = np.hstack([PLACES, np.full((40, 3), 0.01)])
    text = logs.solution(TIMES, columns, f"{LLH} sdn(m) sde(m) sdu(m)").replace(" 0.010000000", f" {spelling}", 1)
    track = read(tmp_path, text)
    assert not np.isfinite(track.position_std.values[0, 0])
    np.testing.assert_array_equal(track.position_std.values[1:], 0.01)
    np.testing.assert_allclose(track.position.values, ECEF, atol=1e-5, rtol=0)


@pytest.mark.parametrize("system", ["UTC", "JST"])
def test_epochs_within_a_leap_second_are_dropped(tmp_path, system):
    text = logs.solution(TIMES, PLACES, LLH)
    for second in ("00", "01"):  # move the flight to a year with a leap second, which contains its last epochs
        text = text.replace(f"2025/05/15 00:00:{second}", f"2016/12/31 23:59:6{second[1]}")
    text = text.replace("2025/05/14", "2016/12/31").replace("23:59:61", "23:59:60")
    if system == "JST":
        text = text.replace("UTC", "JST").replace("2016/12/31 23:59", "2017/01/01 08:59")
    track = read(tmp_path, text)
    assert track.dropped == {"within a leap second": 10}
    assert track.sizes["epoch"] == 30
    assert str(track.time.values[-1]) == "2016-12-31T23:59:59.900000000"
    assert "no leap seconds" in complaint(lambda: read(tmp_path, text.replace(system, "GPST")))


def test_backward_filtered_solution_is_reversed(tmp_path, caplog):
    lines = logs.solution(TIMES, PLACES, LLH).splitlines()
    heading = [line for line in lines if line.startswith("%")]
    track = read(tmp_path, "\n".join([*heading, *lines[: len(heading) - 1 : -1]]) + "\n")
    np.testing.assert_array_equal(track.time.values, TIMES)
    np.testing.assert_allclose(track.position.values, ECEF, atol=1e-5, rtol=0)
    assert "times decrease" in track.remarks[0]
    read_track(tmp_path / "a.track.pos", node="a")
    assert caplog.text.count("times decrease") == 1  # once, although each check of a command may read the log


@pytest.mark.parametrize(("weeks", "later"), [(1024, 1024), (2048, 2048), (0, 0)])
def test_week_rollover_gives_a_remark(tmp_path, weeks, later):
    track = read(tmp_path, logs.solution(TIMES - np.timedelta64(7 * weeks, "D"), PLACES, LLH))
    remark = f"{later} weeks later, on 2025-05-14: correct the times of the log"
    assert [remark in text for text in track.attrs.get("remarks", [])] == [True] * bool(weeks)


def test_contradicting_time_systems_of_header_and_config_are_rejected(tmp_path):
    text = logs.solution(TIMES, PLACES, LLH, system="GPST")
    assert "times are GPST; expected nodes.a.log.time_system of config.yaml" in complaint(
        lambda: read(tmp_path, text, time_system="utc")
    )
    assert read(tmp_path, text, time_system="gpst").sizes["epoch"] == 40


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (" 600.100000000 1", " 600.100000000", "line 4 has 5 columns, the header 6"),
        (" 600.100000000 1", " 600.100000000 1 7", "line 4 has 7 columns, the header 6"),
        ("height(m) Q", "height(m) height(m) Q", "repeated column 'height(m)'"),
        ("height(m)", "heigth(m)", "no header line"),
        (" 600.100000000 1", " nan 1", "without a valid position"),
    ],
)
def test_table_that_does_not_fit_its_header_is_one_message(tmp_path, old, new, expected):
    text = written("llh")
    assert old in text
    assert expected in complaint(lambda: read(tmp_path, text.replace(old, new, 1)))


def test_minutes_above_59_are_rejected(tmp_path):
    rows = [["48 60 00.0", "9 15 36.0", "600.0"]] * 2
    assert "line 3 is" in complaint(lambda: read(tmp_path, logs.solution(TIMES[:2], rows, DMS)))


def test_implausible_standard_deviation_is_rejected(tmp_path):
    columns = np.hstack([ECEF, np.full((40, 6), 0.01)])
    names = f"{XYZ} sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m)"
    text = logs.solution(TIMES, columns, names).replace(" 0.010000000", " 1e308", 1)
    assert "a standard deviation of " in complaint(lambda: read(tmp_path, text))
