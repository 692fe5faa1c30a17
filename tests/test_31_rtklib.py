"""RTKLIB solutions in every format that RTKLIB writes are one track; what a header leaves open is asked for."""

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
    """As RTKLIB writes it: the sign stands before the degrees, -0 included."""
    degrees, rest = divmod(round(abs(angle) * 3600e7), 3600 * 10**7)
    minutes, seconds = divmod(rest, 60 * 10**7)
    return separator.join([f"{'-' if angle < 0 else ''}{degrees}", f"{minutes:02d}", f"{seconds / 1e7:010.7f}"])


def baselines():
    axes = ned_axes(ecef_from_geodetic(*np.array(BASE)))
    return (ECEF - ecef_from_geodetic(*np.array(BASE))) @ np.stack([axes[:, 1], axes[:, 0], -axes[:, 2]], -1)


def written(kind, separator=" "):
    """Return a solution of the one flight in a format."""
    if kind == "dms":
        rows = [[*(sexagesimal(angle, separator) for angle in row[:2]), row[2]] for row in PLACES.tolist()]
        return logs.solution(TIMES, rows, DMS, separator=separator)
    values, names = {"llh": (PLACES, LLH), "ecef": (ECEF, XYZ), "enu": (baselines(), ENU)}[kind]
    head = [f"% ref pos   : {separator.join(f'{value:.9f}' for value in BASE)}"] if kind == "enu" else []
    return logs.solution(TIMES, values, names, separator=separator, head=head)


@pytest.mark.parametrize("separator", [" ", ",", "\t", ";", ", "])
@pytest.mark.parametrize("kind", ["llh", "dms", "ecef", "enu"])
def test_a_flight_is_the_same_in_every_format_and_with_every_separator(tmp_path, kind, separator):
    track = read(tmp_path, written(kind, separator))
    np.testing.assert_allclose(track.position.values, ECEF, atol=1e-4 if kind == "dms" else 1e-5, rtol=0)
    np.testing.assert_array_equal(track.time.values, TIMES)
    assert set(track.fix.values) == {1}


def test_a_degree_of_minus_zero_is_south_or_west(tmp_path):
    rows = [["-0 30 00.0", "-0 15 36.0", "600.0"]] * 2
    track = read(tmp_path, logs.solution(TIMES[:2], rows, DMS))
    np.testing.assert_allclose(track.position.values[0], ecef_from_geodetic(-0.5, -0.26, 600.0), atol=1e-6)


@pytest.mark.parametrize(("system", "ahead_s"), [("UTC", 0), ("GPST", 18), ("JST", 9 * 3600)])
@pytest.mark.parametrize("weeks", [False, True])
def test_times_of_every_system_become_utc(tmp_path, system, ahead_s, weeks):
    ahead = TIMES + np.timedelta64(ahead_s, "s")
    text = logs.solution(ahead, PLACES, LLH, system=system)
    if weeks:
        since = (ahead - np.datetime64("1980-01-06", "ns")).astype(int)
        for time, (week, rest) in zip(ahead, (divmod(ns, 7 * 86400 * 10**9) for ns in since), strict=True):
            stamp = np.datetime_as_string(time, "ms").replace("-", "/").replace("T", " ")
            text = text.replace(stamp, f"{week} {rest / 1e9:.3f}")
    np.testing.assert_array_equal(read(tmp_path, text).time.values, TIMES)


@pytest.mark.parametrize(("day", "ahead_s"), [("2010-06-01", 15), ("2015-06-30", 16), ("2016-12-31", 17)])
def test_gps_time_of_earlier_years_is_less_ahead(tmp_path, day, ahead_s):
    times = np.datetime64(f"{day}T12:00", "ns") + np.arange(3) * np.timedelta64(1, "s")
    text = logs.solution(times + np.timedelta64(ahead_s, "s"), PLACES[:3], LLH, system="GPST")
    np.testing.assert_array_equal(read(tmp_path, text).time.values, times)


def test_lines_without_a_solution_are_left_out_and_poorer_ones_kept(tmp_path):
    lines = written("llh").splitlines()
    for line, quality in ((5, 0), (6, 5), (7, 2)):
        lines[line] = lines[line][:-1] + str(quality)
    track = read(tmp_path, "\n".join(lines) + "\n")
    assert track.dropped == {"Q = 0": 1}
    assert track.fix.values[2:6].tolist() == [1, 5, 2, 1]
    np.testing.assert_array_equal(track.time.values, np.delete(TIMES, 3))


def test_standard_deviations_of_ecef_are_turned_to_north_east_and_up(tmp_path):
    """From one that is diagonal in north, east and up, 5, 2 and 1 cm: some covariances in ECEF are negative."""
    axes = ned_axes(ECEF)
    covariance = axes @ np.diag([0.05, 0.02, 0.01]) ** 2 @ np.swapaxes(axes, 1, 2)
    parts = covariance[:, [0, 1, 2, 0, 1, 2], [0, 1, 2, 1, 2, 0]]
    columns = np.hstack([ECEF, np.sign(parts) * np.sqrt(np.abs(parts))])
    assert (parts[:, 3:] < 0).any()
    names = f"{XYZ} sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m)"
    track = read(tmp_path, logs.solution(TIMES, columns, names))
    np.testing.assert_allclose(track.position_std.values, np.tile([0.05, 0.02, 0.01], (40, 1)), atol=1e-7)


def test_standard_deviations_stand_under_their_names_in_any_order(tmp_path):
    columns = np.hstack([baselines(), np.tile([0.02, 0.01, 0.05], (40, 1))])
    text = logs.solution(TIMES, columns, f"{ENU} sde(m) sdn(m) sdu(m)")
    np.testing.assert_array_equal(read(tmp_path, text, base=BASE).position_std.values[0], [0.01, 0.02, 0.05])


def test_a_baseline_begins_where_header_or_config_say(tmp_path):
    text = written("enu")
    bare = "\n".join(line for line in text.splitlines() if "ref pos" not in line) + "\n"
    assert "without the point that they begin at (ref pos); expected key nodes.a.log.base" in complaint(
        lambda: read(tmp_path, bare)
    )
    expected = read(tmp_path, text).position.values
    np.testing.assert_allclose(read(tmp_path, bare, base=BASE).position.values, expected, atol=1e-6)
    np.testing.assert_allclose(read(tmp_path, text, base=BASE).position.values, expected, atol=1e-6)
    elsewhere = (BASE[0] + 1e-6, *BASE[1:])
    assert "ref pos" in complaint(lambda: read(tmp_path, text, base=elsewhere))
    turned = text.replace(" 48.399000000 9.951000000", " 48 23 56.40000 9 57 03.60000")
    assert turned != text
    np.testing.assert_allclose(read(tmp_path, turned).position.values, expected, atol=1e-3)
    wild = text.replace(" 48.399000000 9.951", " 98.399000000 9.951")
    assert "ref pos '98.399" in complaint(lambda: read(tmp_path, wild))


def test_heights_above_a_geoid_take_an_offset_and_ellipsoidal_ones_none(tmp_path):
    text = written("llh").replace("/ellipsoidal", "/geodetic")
    track = read(tmp_path, text, height_offset_m=48.0)
    np.testing.assert_allclose(track.position.values, ecef_from_geodetic(*(PLACES + [0, 0, 48]).T), atol=1e-5)
    message = complaint(lambda: read(tmp_path, written("llh"), height_offset_m=48.0))
    assert "heights are ellipsoidal; expected what config.yaml says, nodes.a.log.height_offset_m" in message


def test_a_header_and_a_config_that_disagree_on_time_are_refused(tmp_path):
    text = logs.solution(TIMES, PLACES, LLH, system="GPST")
    assert "times are GPST; expected what config.yaml says" in complaint(
        lambda: read(tmp_path, text, time_system="utc")
    )
    assert read(tmp_path, text, time_system="gpst").sizes["epoch"] == 40


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (" 600.100000000 1", " 600.100000000", "line 4 has 5 columns, the header names 6"),
        (" 600.100000000 1", " 600.100000000 1 7", "line 4 has 7 columns, the header names 6"),
        ("height(m) Q", "height(m) height(m) Q", "'height(m)' a second time"),
        ("height(m)", "heigth(m)", "no header line"),
        (" 600.100000000 1", " nan 1", "without a position"),
    ],
)
def test_a_table_that_does_not_fit_its_header_is_one_message(tmp_path, old, new, expected):
    text = written("llh")
    assert old in text
    assert expected in complaint(lambda: read(tmp_path, text.replace(old, new, 1)))


def test_minutes_beyond_sixty_are_refused(tmp_path):
    rows = [["48 60 00.0", "9 15 36.0", "600.0"]] * 2
    assert "line 3 is" in complaint(lambda: read(tmp_path, logs.solution(TIMES[:2], rows, DMS)))


def test_a_standard_deviation_that_no_receiver_states_is_refused(tmp_path):
    columns = np.hstack([ECEF, np.full((40, 6), 0.01)])
    names = f"{XYZ} sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m)"
    text = logs.solution(TIMES, columns, names).replace(" 0.010000000", " 1e308", 1)
    assert "a standard deviation of " in complaint(lambda: read(tmp_path, text))
