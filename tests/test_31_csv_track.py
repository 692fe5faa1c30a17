"""CSV logs under anybody's names, in three frames, with times of every kind."""

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
    track = read(tmp_path, "t,alt,lat,lon,q", TIMES, PLACES[:, 2], *PLACES[:, :2].T, np.full(40, 2), columns=mapped)
    np.testing.assert_allclose(track.position.values, ECEF, atol=1e-6, rtol=0)
    np.testing.assert_array_equal(track.time.values, TIMES)
    assert set(track.fix.values) == {2}


def test_heights_of_another_datum_take_an_offset(tmp_path):
    columns = TIMES, *(PLACES - [0, 0, 48]).T
    track = read(tmp_path, f"time_utc,{GEODETIC}", *columns, height_offset_m=48.0)
    np.testing.assert_allclose(track.position.values, ECEF, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("names", "frame"), [("x_m,y_m,z_m", "ecef"), ("east_m,north_m,up_m", "local")])
def test_positions_in_metres_are_taken_as_they_are(tmp_path, names, frame):
    metres = ECEF if frame == "ecef" else ECEF - ECEF[0]
    track = read(tmp_path, f"time_utc,{names}", TIMES, *metres.T)
    np.testing.assert_array_equal(track.position.values, metres)
    assert track.frame == frame


def test_a_whole_frame_is_taken_where_another_lacks_a_column(tmp_path):
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
def test_seconds_count_from_where_the_config_says(tmp_path, start, options):
    """Of the log's beginning, of Unix, of GPS time, which has counted 18 leap seconds."""
    seconds = (TIMES - np.datetime64(start, "ns")) / np.timedelta64(1, "s") + (18 if "time_system" in options else 0)
    track = read(tmp_path, f"time_s,{GEODETIC}", [f"{second:.6f}" for second in seconds], *PLACES.T, **options)
    assert (np.abs(track.time.values - TIMES) <= np.timedelta64(500, "ns")).all()


def test_seconds_since_nobody_knows_when_are_refused(tmp_path):
    message = complaint(lambda: read(tmp_path, f"time_s,{GEODETIC}", range(40), *PLACES.T))
    assert "nobody says since when" in message
    assert "nodes.a.log.start_utc" in message
    assert "a time of nan s" in complaint(
        lambda: read(tmp_path, f"time_s,{GEODETIC}", ["", *range(39)], *PLACES.T, start_utc="2025-05-14")
    )


def test_times_without_a_zone_ask_for_their_system(tmp_path):
    heading = f"time,{GEODETIC}"
    message = complaint(lambda: read(tmp_path, heading, TIMES, *PLACES.T))
    assert "do not say whether they are UTC or GPST; expected key nodes.a.log.time_system" in message
    utc, gpst = (read(tmp_path, heading, TIMES, *PLACES.T, time_system=system) for system in ("utc", "gpst"))
    np.testing.assert_array_equal(utc.time.values, TIMES)
    np.testing.assert_array_equal(TIMES - gpst.time.values, np.timedelta64(18, "s"))
    zoned = read(tmp_path, heading, [f"{time}+00:00" for time in TIMES], *PLACES.T)
    np.testing.assert_array_equal(zoned.time.values, TIMES)


@pytest.mark.parametrize("name", ["time_utc", "time"])
def test_times_that_say_utc_are_not_gps_time(tmp_path, name):
    columns = [f"{time}Z" for time in TIMES], *PLACES.T
    message = complaint(lambda: read(tmp_path, f"{name},{GEODETIC}", *columns, time_system="gpst"))
    assert f"times in column {name} are UTC; expected what config.yaml says, nodes.a.log.time_system" in message


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
def test_a_map_that_does_not_fit_the_log_is_one_message(tmp_path, heading, options, expected):
    assert expected in complaint(lambda: read(tmp_path, heading, range(40), *PLACES.T, **options))


def test_a_name_of_ours_that_is_also_mapped_is_not_guessed(tmp_path):
    heading = f"time_utc,{GEODETIC},alt"
    message = complaint(lambda: read(tmp_path, heading, TIMES, *PLACES.T, PLACES[:, 2], columns={"height_m": "alt"}))
    assert "column height_m, besides 'alt' that config.yaml maps to it" in message
    assert "columns time and time_s" in complaint(
        lambda: read(tmp_path, f"time,time_s,{GEODETIC}", TIMES, range(40), *PLACES.T)
    )


def test_a_log_of_other_names_shows_them_and_how_they_are_mapped(tmp_path):
    message = complaint(lambda: read(tmp_path, "when,lat,lon,alt", TIMES, *PLACES.T))
    assert "no column latitude_deg among ['when', 'lat', 'lon', 'alt']" in message
    assert "nodes.a.log.columns: {latitude_deg: NAME}, or to try it --set columns.latitude_deg=NAME" in message
    message = complaint(lambda: read(tmp_path, f"when,{GEODETIC}", TIMES, *PLACES.T))
    assert "no column time_utc among ['when', 'latitude_deg', 'longitude_deg', 'height_m']" in message
    wide = ",".join(f"column{number}" for number in range(900))
    assert len(complaint(lambda: read(tmp_path, wide, *[range(40)] * 900))) < 1500


@pytest.mark.parametrize("comma", [".", ","])
def test_cells_between_semicolons_are_named_with_their_line(tmp_path, comma):
    rows = [
        f"{time};{north};{east};{up}".replace(".", comma) for time, (north, east, up) in zip(TIMES, PLACES, strict=True)
    ]
    message = complaint(lambda: read(tmp_path, "time_utc;latitude_deg;longitude_deg;height_m", rows))
    assert "line 1 has its cells between semicolons, not commas" in message


def test_a_line_with_more_cells_than_the_heading_is_named(tmp_path):
    rows = [f"{time},{north},{east},{up}" for time, (north, east, up) in zip(TIMES, PLACES, strict=True)]
    rows[6] += ",0"
    assert "line 8 has 5 cells, the heading 4" in complaint(lambda: read(tmp_path, f"time_utc,{GEODETIC}", rows))
    assert (
        read(
            tmp_path,
            f"time_utc,{GEODETIC}",
            [f"{time},{n},{e},{u}," for time, (n, e, u) in zip(TIMES, PLACES, strict=True)],
        ).sizes["epoch"]
        == 40
    )
