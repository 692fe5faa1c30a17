"""Flight logs with implausible values: each causes one short, printable message; Windows line ends are accepted."""

import pytest
from folders import complaint, edit_track

from apertura.formats.reading import read_track


def csv_log(tmp_path, *lines, heading="time_utc,latitude_deg,longitude_deg,height_m,yaw_deg"):
    path = tmp_path / "a.track.csv"
    path.write_text("\n".join([heading, *lines]) + "\n")
    return lambda: read_track(path, node="a")


GOOD = "2025-05-14T09:30:00Z,48,9,600,1"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("2025-05-14T09:30:01Z,48,9,1e308,1", "the height between -1000 and 100000 m"),
        ("2025-05-14T09:30:01Z,48,9,inf,1", "1 epoch without a valid position"),
        ("2025-05-14T09:30:01Z,48,1e9,600,1", "1 epoch without a valid position"),
        ("99999-05-14T09:30:01Z,48,9,600,1", "a.track.csv: "),
        ("2500-05-14T09:30:01Z,48,9,600,1", "a.track.csv: "),
        ("0001-05-14T09:30:01Z,48,9,600,1", "a.track.csv: "),
        (",48,9,600,1", "epoch 1 is at NaT"),
        ("2025-05-14T09:30:01Z,48,9,600,1,7", "line 3 has 6 cells, the header 5"),
        ("2025-05-14T09:30:01Z,48,9,\x1b[2J,1", r"column height_m: '\x1b[2J'"),
        ("2025-05-14T09:30:01Z,48,9,6_00,1", "column height_m: '6_00'"),
        ("2025-05-14T09:30:01Z,48,True,600,1", "column longitude_deg: 'True'"),
        ('"2025-05-14T09:30:01Z,48', "a.track.csv: "),
    ],
)
def test_implausible_csv_line_is_one_message(tmp_path, line, expected):
    message = complaint(csv_log(tmp_path, GOOD, line))
    assert expected in message
    assert message.isprintable()
    assert len(message) < 800


def test_repeated_column_is_named(tmp_path):
    heading = "time_utc,latitude_deg,longitude_deg,height_m,height_m"
    assert "repeated column height_m" in complaint(csv_log(tmp_path, GOOD, GOOD, heading=heading))


def test_negative_standard_deviation_is_rejected(tmp_path):
    heading = "time_utc,latitude_deg,longitude_deg,height_m,std_north_m,std_east_m,std_up_m"
    lines = [f"2025-05-14T09:30:0{n}Z,48,9,600,1,{-n},1" for n in range(3)]
    assert "a standard deviation of -1 in epoch 1" in complaint(csv_log(tmp_path, *lines, heading=heading))


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("inf 5.0 48.0 9.0 600.0 1", "line 3 is"),
        ("99999999999999999999 5.0 48.0 9.0 600.0 1", "line 3 is"),
        ("2366 1e300 48.0 9.0 600.0 1", "line 3 is"),
        ("9999/01/01 00:00:00 48.0 9.0 600.0 1", "is not between 1980 and 2199"),
        ("2025/05/14 09:30:01 48.0 9.0 600.0 257", "Q 257"),
        ("2025/05/14 09:30:01 48.0 9.0 60_0.0 1", "line 3 is"),
        ("2025/05/14 09:30:01 48.0 9.0 \x1b[2J 1", r"\x1b[2J"),
    ],
)
def test_implausible_solution_is_one_message(tmp_path, line, expected):
    path = tmp_path / "a.track.pos"
    path.write_text(f"% (lat/lon/height=WGS84/ellipsoidal)\n% UTC latitude(deg) longitude(deg) height(m) Q\n{line}\n")
    message = complaint(lambda: read_track(path, node="a"))
    assert expected in message
    assert message.isprintable()


def test_windows_line_ends_are_read(tiny):
    for node in ("uav1", "uav2"):
        path = next((tiny / "raw" / "f01").glob(f"{node}.track.*"))
        track = read_track(path, node=node)
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
        assert read_track(path, node=node).identical(track)


def test_log_that_is_not_utf8_is_rejected(tiny):
    edit_track(tiny, "uav1", lambda lines: [*lines[:5], lines[5] + "é"])
    for node in ("uav1", "uav2"):
        path = next((tiny / "raw" / "f01").glob(f"{node}.track.*"))
        path.write_bytes(path.read_text().encode("latin-1") + b"\xe9")
        assert path.name in complaint(lambda path=path, node=node: read_track(path, node=node))
