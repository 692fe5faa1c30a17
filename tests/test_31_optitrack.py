"""OptiTrack motion captures: a rigid body in a y-up frame becomes a track in east, north and up."""

import numpy as np
import pytest
from folders import complaint

from apertura.common.contracts import check
from apertura.core.geometry.geodesy import body_axes
from apertura.formats.reading import read_track
from apertura.formats.tracks.log_options import LogOptions
from apertura.formats.tracks.optitrack import read_optitrack
from tests.attack import logs

SECONDS = np.arange(12) / 360
RADAR = {"start_utc": "2019-07-23T20:54:06.021", "body": "Radar"}


def take(tmp_path, *, bodies=None, **written):
    path = tmp_path / "a.track.csv"
    path.write_text(logs.capture(SECONDS, bodies or logs.poses(), **written))
    return path


def read(path, **options):
    return check(read_track(path, node="a", options=LogOptions(**{**RADAR, **options})), "track")


def test_axes_are_x_east_minus_z_north_y_up(tmp_path):
    track = read(take(tmp_path))
    along = np.linspace(0, 1, 12)
    expected = np.stack([along - 5, 3 * along, 0 * along + 1.8], -1)
    np.testing.assert_allclose(track.position.values, expected, atol=1e-6)
    assert track.frame == "local"
    elapsed = (track.time.values - np.datetime64("2019-07-23T20:54:06.021")) / np.timedelta64(1, "s")
    np.testing.assert_allclose(elapsed, SECONDS, atol=1e-6)


def test_rotation_about_y_is_counter_clockwise(tmp_path):
    """The rotation is counter-clockwise seen from above, so that yaw (clockwise from north) decreases."""
    np.testing.assert_allclose(np.degrees(read(take(tmp_path)).attitude.values[-1]), [0, 0, -57.2958], atol=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_attitude_rotates_the_body_axes_like_the_quaternion(tmp_path, seed):
    generator = np.random.default_rng(seed)
    bodies = logs.poses()
    drawn = generator.normal(size=(12, 4))
    bodies["Radar"][:, :4] = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    rotated = body_axes(read(take(tmp_path, bodies=bodies)).attitude.values) @ [1.0, 0, 0]
    x, y, z, w = bodies["Radar"][:, :4].T
    forward = -np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)  # the body's −z
    np.testing.assert_allclose(rotated, np.stack([-forward[:, 2], forward[:, 0], -forward[:, 1]], -1), atol=1e-5)


def test_millimetres_are_converted(tmp_path):
    np.testing.assert_allclose(
        read(take(tmp_path, unit="Millimeters")).position.values, read(take(tmp_path)).position.values / 1000
    )


def test_frames_without_the_body_are_counted(tmp_path):
    track = read(take(tmp_path, lost=[3, 4]))
    assert track.sizes["epoch"] == 10
    assert track.dropped == {"body not tracked": 2}


def test_body_must_be_selected_among_several(tmp_path):
    path = take(tmp_path)
    message = complaint(lambda: read(path, body=None))
    assert "rigid bodies 'Radar', 'Corner Reflector'; expected key nodes.a.log.body" in message
    assert "no rigid body 'radar' among 'Radar'" in complaint(lambda: read(path, body="radar"))
    alone = take(tmp_path, bodies={"Radar": logs.poses()["Radar"]})
    assert read(alone, body=None).sizes["epoch"] == 12


def test_local_time_without_a_zone_is_rejected(tmp_path):
    message = complaint(lambda: read(take(tmp_path), start_utc=None))
    assert "local time without a zone; expected key nodes.a.log.start_utc" in message


def test_stationary_body_has_one_position(tmp_path):
    track = read(take(tmp_path, lost=[0]), body="Corner Reflector")
    np.testing.assert_allclose(np.median(track.position.values, axis=0), [-1, 1.15, 0.07])


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("Quaternion", "XYZ", "Rotation Type 'XYZ', not quaternion"),
        ("Global", "Local", "Coordinate Space 'Local', not global"),
        ("Meters", "Inches", "Length Units 'Inches'"),
        ("Frame,Time", "Fram,Time", "no line that starts with Frame"),
        (",Name,Radar", ",Name,Radaa", "missing or repeated"),
        ("X,Y,Z,W", "Y,Y,Z,W", "missing or repeated"),
        ("Radar,Corner Reflector", "Radar,Radar", "missing or repeated"),
        (",Type,Rigid", ",Typ,Rigid", "header lines Type"),
        ("\r\n5,", "\r\n5,,", "line 13 has"),
        ("\r\n5,0.0", "\r\n5,x", "line 13: 'x"),
        ("\r\n5,0.0", "\r\n5,inf", "line 13: 'inf"),
    ],
)
def test_invalid_take_is_one_message(tmp_path, old, new, expected):
    path = tmp_path / "a.track.csv"
    text = logs.capture(SECONDS, logs.poses())
    assert old in text
    path.write_bytes(text.replace(old, new, 1).encode())
    message = complaint(lambda: read_optitrack(path, node="a", options=LogOptions(**RADAR)))
    assert expected in message
    assert message.isprintable()


def test_incomplete_pose_and_non_unit_quaternion_are_rejected(tmp_path):
    for column, value, expected in ((6, np.nan, "incomplete pose"), (3, 0.5, "not a unit quaternion")):
        bodies = logs.poses()
        bodies["Radar"][4, column] = value
        path = take(tmp_path, bodies=bodies)
        path.write_bytes(path.read_bytes().replace(b"nan", b""))
        assert expected in complaint(lambda path=path: read(path))


def test_real_rail_pass_is_read(shared):
    """The take has 10928 frames at 360 Hz, five without the radar; the rail is 3.42 m long, straight and level."""
    path = shared / "bwsi_rail_passA" / "Rail SAR 2.csv"
    track = read(path)
    assert track.sizes["epoch"] + track.dropped["body not tracked"] == 10928
    assert np.median(np.diff(track.time.values)) / np.timedelta64(1, "s") == pytest.approx(1 / 360, abs=1e-6)
    assert (track.time.values[-1] - track.time.values[0]) / np.timedelta64(1, "s") == pytest.approx(30.35, abs=0.01)
    low, high = track.position.values.min(axis=0), track.position.values.max(axis=0)
    np.testing.assert_allclose(high - low, [0.09, 3.42, 0.01], atol=0.005)
    assert (np.abs(np.degrees(track.attitude.values)) < 5).all()
    reflector = np.median(read(path, body="Corner Reflector").position.values, axis=0)
    np.testing.assert_allclose(reflector, [-1.0067, 1.1487, 0.0670], atol=1e-4)
