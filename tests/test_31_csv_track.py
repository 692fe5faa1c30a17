"""CSV logs: mapped column names, three frames, and times of every kind."""

import numpy as np
import pytest
from folders import complaint

from apertura.common.contracts import check
from apertura.core.geometry.geodesy import ecef_from_geodetic
from apertura.formats.reading import read_track
from apertura.formats.tracks.log_options import LogOptions
from tests.attack import logs

TIMES, PLACES = logs.circle()
ECEF = ecef_from_geodetic(*PLACES.T)
GEODETIC = "latitude_deg,longitude_deg,height_m"


def read(tmp_path, heading, *columns, **options):
    path = tmp_path / "a.track.csv"
    rows = (",".join(map(str, row)) for row in zip(*columns, strict=True))
    path.write_text("\n".join([heading, *rows]) + "\n")
    return check(read_track(path, node="a", options=LogOptions(**options)), "track")


def test_columns_of_other_names_are_mapped(tmp_path):
    mapped = {"time_utc": "t", "latitude_deg": "lat", "longitude_deg": "lon", "height_m": "alt", "quality": "q"}
    columns = TIMES, PLACES[:, 2], *PLACES[:, :2].T, np.full(40, 2)
    track = read(tmp_path, "t,alt,lat,lon,q", *columns, columns=mapped, quality="rtklib")
    np.testing.assert_allclose(track.position.values, ECEF, atol=1e-6, rtol=0)
    np.testing.assert_array_equal(track.time.values, TIMES)
    assert set(track.fix.values) == {2}


def test_heights_of_another_datum_take_an_offset(tmp_path):
    columns = TIMES, *(PLACES - [0, 0, 48]).T
    track = read(tmp_path, f"time_utc,{GEODETIC}", *columns, height_offset_m=48.0)
    np.testing.assert_allclose(track.position.values, ECEF, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("names", "frame"), [("x_m,y_m,z_m", "ecef"), ("east_m,north_m,up_m", "local")])
def test_positions_in_metres_are_read_unchanged(tmp_path, names, frame):
    metres = ECEF if frame == "ecef" else ECEF - ECEF[0]
    track = read(tmp_path, f"time_utc,{names}", TIMES, *metres.T)
    np.testing.assert_array_equal(track.position.values, metres)
    assert track.frame == frame


def test_complete_frame_is_used_if_another_lacks_a_column(tmp_path):
    track = read(tmp_path, "time_utc,latitude_deg,longitude_deg,x_m,y_m,z_m", TIMES, *PLACES[:, :2].T, *ECEF.T)
    np.testing.assert_array_equal(track.position.values, ECEF)


@pytest.mark.parametrize(
    ("start", "options"),
    [
        ("2025-05-14T23:59:57", {"start_utc": "2025-05-14T23:59:57Z"}),
        ("1970-01-01", {"start_utc": "1970-01-01"}),
        ("1980-01-06", {"time_system": "gpst"}),
    ],
)
def test_seconds_count_from_the_configured_time_zero(tmp_path, start, options):
    """The time zero is the start of the log or the Unix epoch, in UTC or in GPS time with 18 leap seconds."""
    seconds = (TIMES - np.datetime64(start, "ns")) / np.timedelta64(1, "s") + (18 if "time_system" in options else 0)
    track = read(tmp_path, f"time_s,{GEODETIC}", [f"{second:.6f}" for second in seconds], *PLACES.T, **options)
    assert (np.abs(track.time.values - TIMES) <= np.timedelta64(500, "ns")).all()


def test_seconds_without_time_zero_are_rejected(tmp_path):
    message = complaint(lambda: read(tmp_path, f"time_s,{GEODETIC}", range(40), *PLACES.T))
    assert "without a time zero" in message
    assert "nodes.a.log.start_utc" in message
    assert "a time of nan s" in complaint(
        lambda: read(tmp_path, f"time_s,{GEODETIC}", ["", *range(39)], *PLACES.T, start_utc="2025-05-14")
    )


def test_times_without_a_zone_need_a_time_system(tmp_path):
    heading = f"time,{GEODETIC}"
    message = complaint(lambda: read(tmp_path, heading, TIMES, *PLACES.T))
    assert "without a time system (UTC or GPST); expected key nodes.a.log.time_system" in message
    utc, gpst = (read(tmp_path, heading, TIMES, *PLACES.T, time_system=system) for system in ("utc", "gpst"))
    np.testing.assert_array_equal(utc.time.values, TIMES)
    np.testing.assert_array_equal(TIMES - gpst.time.values, np.timedelta64(18, "s"))
    zoned = read(tmp_path, heading, [f"{time}+00:00" for time in TIMES], *PLACES.T)
    np.testing.assert_array_equal(zoned.time.values, TIMES)


@pytest.mark.parametrize("name", ["time_utc", "time"])
def test_utc_times_contradict_a_configured_gps_time(tmp_path, name):
    columns = [f"{time}Z" for time in TIMES], *PLACES.T
    message = complaint(lambda: read(tmp_path, f"{name},{GEODETIC}", *columns, time_system="gpst"))
    assert f"times in column {name} are UTC; expected nodes.a.log.time_system of config.yaml" in message


@pytest.mark.parametrize(
    ("heading", "options", "expected"),
    [
        ("t,a,b,c", {"columns": {"lat": "a"}}, "nodes.a.log.columns: column 'lat'; expected one of time_utc"),
        ("t,a,b,c", {"columns": {"time_utc": "tt"}}, "no column tt among"),
        (f"time_utc,{GEODETIC.replace('height_m', 'c')}", {}, "no column height_m among"),
        (f"t,{GEODETIC}", {}, "no column time_utc among"),
        (f"t,{GEODETIC}", {"columns": {"time_s": "t"}, "start_utc": "noon"}, "nodes.a.log.start_utc: 'noon'"),
    ],
)
def test_column_map_that_does_not_fit_the_log_is_one_message(tmp_path, heading, options, expected):
    assert expected in complaint(lambda: read(tmp_path, heading, range(40), *PLACES.T, **options))


def test_ambiguous_column_is_rejected(tmp_path):
    heading = f"time_utc,{GEODETIC},alt"
    message = complaint(lambda: read(tmp_path, heading, TIMES, *PLACES.T, PLACES[:, 2], columns={"height_m": "alt"}))
    assert "column height_m in addition to 'alt', which config.yaml maps to height_m" in message
    assert "columns time and time_s" in complaint(
        lambda: read(tmp_path, f"time,time_s,{GEODETIC}", TIMES, range(40), *PLACES.T)
    )


def test_unknown_columns_are_listed_with_the_mapping_key(tmp_path):
    message = complaint(lambda: read(tmp_path, "when,lat,lon,alt", TIMES, *PLACES.T))
    assert "no column latitude_deg among ['when', 'lat', 'lon', 'alt']" in message
    assert "nodes.a.log.columns: {latitude_deg: NAME}; to try a name, use --set columns.latitude_deg=NAME" in message
    message = complaint(lambda: read(tmp_path, f"when,{GEODETIC}", TIMES, *PLACES.T))
    assert "no column time_utc among ['when', 'latitude_deg', 'longitude_deg', 'height_m']" in message
    wide = ",".join(f"column{number}" for number in range(900))
    assert len(complaint(lambda: read(tmp_path, wide, *[range(40)] * 900))) < 1500


@pytest.mark.parametrize("comma", [".", ","])
def test_semicolon_separators_are_reported_with_their_line(tmp_path, comma):
    rows = [
        f"{time};{north};{east};{up}".replace(".", comma) for time, (north, east, up) in zip(TIMES, PLACES, strict=True)
    ]
    message = complaint(lambda: read(tmp_path, "time_utc;latitude_deg;longitude_deg;height_m", rows))
    assert "cells of line 1 are separated by semicolons, not commas" in message


def test_line_with_extra_cells_is_named(tmp_path):
    rows = [f"{time},{north},{east},{up}" for time, (north, east, up) in zip(TIMES, PLACES, strict=True)]
    rows[6] += ",0"
    assert "line 8 has 5 cells, the header 4" in complaint(lambda: read(tmp_path, f"time_utc,{GEODETIC}", rows))
    assert (
        read(
            tmp_path,
            f"time_utc,{GEODETIC}",
            [f"{time},{n},{e},{u}," for time, (n, e, u) in zip(TIMES, PLACES, strict=True)],
        ).sizes["epoch"]
        == 40
    )


def test_columns_in_other_units_are_scaled(tmp_path):
    """ulog2csv writes µs, 1e-7 degrees and millimetres."""
    elapsed = (TIMES - np.datetime64("1970-01-01", "ns")).astype("timedelta64[us]").astype(int)
    whole = np.rint(PLACES / [1e-7, 1e-7, 1e-3]).astype(int)
    scales = {"time_s": 1e-6, "latitude_deg": 1e-7, "longitude_deg": 1e-7, "height_m": 1e-3}
    track = read(tmp_path, f"time_s,{GEODETIC}", elapsed, *whole.T, scales=scales, start_utc="1970-01-01")
    assert (np.abs(track.time.values - TIMES) <= np.timedelta64(500, "ns")).all()
    np.testing.assert_allclose(track.position.values, ecef_from_geodetic(*(whole * [1e-7, 1e-7, 1e-3]).T), atol=1e-6)
    message = complaint(lambda: read(tmp_path, f"time_s,{GEODETIC}", elapsed, *whole.T, scales={"lat": 1.0}))
    assert "nodes.a.log.scales: column 'lat'; expected one of time_utc" in message


@pytest.mark.parametrize("numbers", [[1], [5], [4, 5], [1, 2, 5], [2, 9]])
def test_numeric_solution_types_need_a_numbering(tmp_path, numbers):
    """Type 4 is a fixed solution in GGA and DGPS in RTKLIB; type 1 is a single solution in GGA and a fix in RTKLIB."""
    columns = TIMES, *PLACES.T, np.resize(numbers, 40)
    message = complaint(lambda: read(tmp_path, f"time_utc,{GEODETIC},quality", *columns))
    assert f"solution types {', '.join(map(str, numbers))} in column 'quality'" in message
    assert "nodes.a.log.quality in config.yaml. Add it: rtklib (1 fix, 2 float, 5 single) or gga (4 fix" in message


@pytest.mark.parametrize(
    ("numbering", "kinds"), [("gga", [0, 5, 4, 5, 1, 2, 3]), ("rtklib", [0, 1, 2, 3, 4, 5, 6])], ids=["gga", "rtklib"]
)
def test_solution_types_follow_the_configured_numbering(tmp_path, numbering, kinds):
    numbers = ["", 1, 2, 3, 4, 5, 9 if numbering == "gga" else 6]
    columns = TIMES[:7], *PLACES[:7].T, numbers
    track = read(tmp_path, f"time_utc,{GEODETIC},quality", *columns, quality=numbering)
    assert track.fix.values.tolist() == kinds


def test_epochs_without_measurement_by_gga_are_dropped(tmp_path):
    columns = TIMES, *PLACES.T, [4] * 36 + [0, 6, 7, 8]
    track = read(tmp_path, f"time_utc,{GEODETIC},quality", *columns, quality="gga")
    assert track.dropped == {
        "no fix (quality 0)": 1,
        "dead reckoning (quality 6)": 1,
        "manual input (quality 7)": 1,
        "simulated (quality 8)": 1,
    }
    assert set(track.fix.values) == {1}


def rows_of(times=TIMES, places=PLACES):
    return [f"{time},{north},{east},{up}" for time, (north, east, up) in zip(times, places, strict=True)]


@pytest.mark.parametrize(
    "lines",
    [
        [f"time_utc,{GEODETIC}", *rows_of()[:20], f"time_utc,{GEODETIC}", *rows_of()[20:]],
        ["# flown by nobody, 5 m/s", f"time_utc,{GEODETIC}", *rows_of()[:9], "# pause", *rows_of()[9:]],
        [f"# time_utc,{GEODETIC}", *rows_of()],
        [" Time_UTC , Latitude_deg,LONGITUDE_DEG , height_m ", *rows_of()],
    ],
    ids=["joined", "comments", "heading is a comment", "capitals"],
)
def test_headings_and_comments_of_programs_are_read(tmp_path, lines):
    track = read(tmp_path, lines[0], lines[1:])
    np.testing.assert_array_equal(track.time.values, TIMES)
    np.testing.assert_allclose(track.position.values, ECEF, atol=1e-6, rtol=0)


def test_second_heading_with_other_columns_is_rejected(tmp_path):
    lines = [*rows_of()[:20], "longitude_deg,latitude_deg,time_utc,height_m", *rows_of()[20:]]
    message = complaint(lambda: read(tmp_path, f"time_utc,{GEODETIC}", lines))
    assert "line 22 is a second, different header: concatenated files" in message


@pytest.mark.parametrize(
    ("encoding", "name", "expected"),
    [
        ("utf-16", "höhe", 'text in UTF-16, such as "Unicode text" of Excel; save the file as UTF-8'),
        ("latin-1", "höhe", "byte 0xf6 in line 1 is not UTF-8; save the file as UTF-8"),
        ("cp1252", "µ", "byte 0xb5 in line 1 is not UTF-8; save the file as UTF-8"),
    ],
)
def test_text_that_is_not_utf_8_is_rejected_with_a_remedy(tmp_path, encoding, name, expected):
    path = tmp_path / "a.track.csv"
    path.write_bytes("\n".join([f"time_utc,{GEODETIC},{name}", *(f"{row},1" for row in rows_of())]).encode(encoding))
    message = complaint(lambda: read_track(path, node="a"))
    assert expected in message
    assert "codec" not in message


@pytest.mark.parametrize(
    "text", ["14.05.2025 09:29:58", "14-May-2025 09:29:58", "29:58.0", "2025-05-14 25:00:00", "5/14/25"]
)
@pytest.mark.parametrize("name", ["time_utc", "time"])
def test_time_not_in_iso_8601_is_named_with_its_column(tmp_path, name, text):
    columns = [*TIMES[:20], text, *TIMES[21:]], *PLACES.T
    message = complaint(lambda: read(tmp_path, f"{name},{GEODETIC}", *columns, time_system="utc"))
    assert f"column {name}: '{text}' is not an ISO 8601 time such as 2025-05-14T09:30:00.5Z" in message


def test_decimal_comma_of_seconds_is_read(tmp_path):
    texts = [f'"{str(time)[:23].replace(".", ",")}Z"' for time in TIMES]
    np.testing.assert_array_equal(read(tmp_path, f"time_utc,{GEODETIC}", texts, *PLACES.T).time.values, TIMES)


def test_epochs_within_a_leap_second_are_dropped(tmp_path):
    start = np.datetime64("2016-12-31T23:59:57", "ns")
    texts = [str(time) for time in start + np.arange(30) * np.timedelta64(100, "ms")]
    texts += [f"2016-12-31T23:59:60.{tenth}" for tenth in range(10)]
    track = read(tmp_path, f"time_utc,{GEODETIC}", texts, *PLACES.T)
    assert track.dropped == {"within a leap second": 10}
    assert str(track.time.values[-1]) == "2016-12-31T23:59:59.900000000"
    gps = start + np.timedelta64(17, "s") + np.arange(40) * np.timedelta64(100, "ms")
    track = read(tmp_path, f"time,{GEODETIC}", gps, *PLACES.T, time_system="gpst")
    assert track.dropped == {"within a leap second": 10}
    assert str(track.time.values[-1]) == "2016-12-31T23:59:59.900000000"


@pytest.mark.parametrize("spelling", ["1.#INF", "-nan(ind)", "-1.#IND", "1.#J"])
def test_standard_deviation_printed_as_nan_is_unknown(tmp_path, spelling):
    columns = TIMES, *PLACES.T, *[[spelling, *[0.01] * 39]] * 3
    track = read(tmp_path, f"time_utc,{GEODETIC},std_north_m,std_east_m,std_up_m", *columns)
    assert np.isnan(track.position_std.values[0]).all()
    np.testing.assert_array_equal(track.position_std.values[1:], 0.01)
