"""PX4 logs: positions and times of the receiver, heights above the ellipsoid, attitude at the time of validity."""

import struct
from collections import Counter

import numpy as np
import pytest
from autopilot_logs import (
    BOOT_S,
    LAG_S,
    N_M,
    START,
    boot_us,
    flight,
    ulog,
    ulog_attitude,
    ulog_fused,
    ulog_receiver,
    utc_of,
)
from folders import ROOT, complaint
from hypothesis import given
from hypothesis import strategies as st
from properties import tried

from apertura.common.contracts import check
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from apertura.core.geometry.track_checks import check_track
from apertura.formats.reading import read_track
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions
from apertura.formats.tracks.px4_ulog import track_of
from apertura.formats.tracks.ulog_fields import read_fields

REAL = ROOT.parent / "shared" / "data" / "px4_real_flight" / "esc_status_log.ulg"
GPS, SENSOR, FUSED, ATTITUDE = "vehicle_gps_position", "sensor_gps", "vehicle_global_position", "vehicle_attitude"
SECOND = np.timedelta64(1, "s")
WIDE = {"time_utc_usec": "<Q", "fix_type": "<B"}


def read(tmp_path, *topics, options=DEFAULT_OPTIONS, **more):
    path = tmp_path / "a.track.ulg"
    path.write_bytes(ulog(*topics, **more))
    return check(read_track(path, node="a", options=options), "track")


def position_error_m(track, time_s=None):
    """Return the distance of each epoch from the true position at its time or at given times."""
    time_s = (track.time.values - START) / SECOND if time_s is None else time_s
    exact, geodetic, _ = flight(4000, 400.0)
    fine = ecef_from_geodetic(*geodetic.T)
    truth = np.stack([np.interp(time_s, exact, axis) for axis in fine.T], -1)
    return np.linalg.norm(track.position.values - truth, axis=1)


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("old", [True, False])
@pytest.mark.parametrize("topic", [GPS, SENSOR])
def test_track_has_the_values_of_the_receiver(tmp_path, topic, old):
    track = read(tmp_path, (topic, 0, ulog_receiver(old=old)), (ATTITUDE, 0, ulog_attitude()), (FUSED, 0, ulog_fused()))
    time, geodetic, _ = flight()
    np.testing.assert_array_equal(track.time.values, utc_of(time))
    assert position_error_m(track).max() < (0.02 if old else 1e-4)  # 1e-7 degrees are 11 mm
    np.testing.assert_allclose(geodetic_from_ecef(track.position.values)[:, 2], geodetic[:, 2], atol=1e-3)
    np.testing.assert_array_equal(track.position_std.values, np.tile([0.25, 0.25, 0.5], (60, 1)))
    assert set(track.fix.values) == {1}
    assert track.attrs["source"] == f"{topic}:0"
    assert track.attrs["dropped"] == {}


@pytest.mark.usefixtures("reader")
def test_attitude_is_read_at_the_time_of_validity(tmp_path):
    """The autopilot receives an epoch 110 ms late; neglecting this delay causes a yaw error of 1.0° in this turn."""
    track = read(tmp_path, (GPS, 0, ulog_receiver()), (ATTITUDE, 0, ulog_attitude()))
    expected = np.stack([np.full(60, 10.0), np.full(60, 3.0), flight()[2]], -1)
    np.testing.assert_allclose(np.degrees(track.attitude.values), expected, atol=2e-3)
    late = read(tmp_path, (GPS, 0, ulog_receiver()), (ATTITUDE, 0, ulog_attitude()), delay_ms=0.0)
    assert np.degrees(late.attitude.values[:, 2] - track.attitude.values[:, 2]).mean() == pytest.approx(1.008, abs=0.01)


@pytest.mark.usefixtures("reader")
def test_outlier_of_attitude_is_dropped(tmp_path):
    attitude = ulog_attitude()
    kind, values = attitude["q[0]"]
    attitude["q[0]"] = kind, np.where(np.arange(values.size) == 100, -values, values)
    track = read(tmp_path, (GPS, 0, ulog_receiver()), (ATTITUDE, 0, attitude))
    expected = np.stack([np.full(60, 10.0), np.full(60, 3.0), flight()[2]], -1)
    np.testing.assert_allclose(np.degrees(track.attitude.values), expected, atol=2e-3)


@pytest.mark.usefixtures("reader")
def test_attitude_is_not_extrapolated(tmp_path):
    attitude = {name: (kind, values[80:]) for name, (kind, values) in ulog_attitude().items()}  # from 1.5 s
    track = read(tmp_path, (GPS, 0, ulog_receiver()), (ATTITUDE, 0, attitude))
    np.testing.assert_array_equal(np.isnan(track.attitude.values).any(axis=1), flight()[0] < 0.999)


@pytest.mark.usefixtures("reader")
def test_fused_positions_are_timed_by_the_receiver(tmp_path):
    """The estimator and the inverse conversion both assume that the receiver is late by EKF2_GPS_DELAY."""
    topics = (GPS, 0, ulog_receiver()), (ATTITUDE, 0, ulog_attitude()), (FUSED, 0, ulog_fused())
    track = read(tmp_path, *topics, options=LogOptions(body=FUSED))
    assert track.attrs["source"] == f"{FUSED}:0"
    np.testing.assert_allclose((track.time.values - START) / SECOND, flight(120, 20.0)[0], atol=1e-5)
    assert position_error_m(track).max() < 2e-4
    assert "fix" not in track
    lost = np.arange(120) >= 100
    track = read(
        tmp_path, (GPS, 0, ulog_receiver()), (FUSED, 0, ulog_fused(dead_reckoning=lost)), options=LogOptions(body=FUSED)
    )
    assert track.attrs["dropped"] == {"no fix": 20}


@pytest.mark.usefixtures("reader")
def test_receiver_is_selected_by_name(tmp_path):
    other = ulog_receiver(lat=np.full(60, 480_000_000) + np.arange(60))
    topics = (SENSOR, 0, ulog_receiver()), (SENSOR, 1, other)
    assert read(tmp_path, *topics).attrs["source"] == "sensor_gps:0"
    track = read(tmp_path, *topics, options=LogOptions(body="sensor_gps:1"))
    assert geodetic_from_ecef(track.position.values)[0, 0] == pytest.approx(48.0, abs=1e-9)
    message = complaint(lambda: read(tmp_path, *topics, options=LogOptions(body="gps2")))
    assert "no positions of 'gps2'" in message
    assert "sensor_gps:0, sensor_gps:1" in message
    assert "nodes.a.log.body" in message


@pytest.mark.usefixtures("reader")
def test_several_receivers_are_listed_with_their_solutions(tmp_path):
    single, fixed = ulog_receiver(fix_type=np.full(60, 3)), ulog_receiver(fix_type=np.r_[np.full(59, 6), 2])
    topics = (SENSOR, 0, single), (SENSOR, 1, fixed)
    track = read(tmp_path, *topics)
    assert track.attrs["remarks"] == [
        "the log contains receivers sensor_gps:0 (single 60) and sensor_gps:1 (fix 59, no fix 1); sensor_gps:0 is "
        "used; select with nodes.a.log.body"
    ]
    selected = read(tmp_path, *topics, options=LogOptions(body="sensor_gps:1"))
    assert "remarks" not in selected.attrs
    assert selected.sizes["epoch"] == 59


RNG = np.random.default_rng(11)
SYNC = struct.pack("<HB", 8, ord("S")) + bytes([0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12])


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize(
    ("foreign", "inside"),
    [
        (RNG.bytes(200), 0),
        (RNG.bytes(700) + SYNC, 0),
        (RNG.bytes(200), 20),  # within a message
        (bytes(4096), 0),
        (b"\xff" * 512, 31),
        (b"\xff\xff" + RNG.bytes(100), 0),  # a size beyond the file, where pyulog stops
    ],
    ids=["200 bytes", "before a sync", "within a message", "zeros", "ones", "a size beyond the file"],
)
def test_epochs_after_foreign_bytes_are_read_and_bytes_counted(tmp_path, foreign, inside):
    data = ulog((GPS, 0, ulog_receiver(epochs=98)))
    size = len(_last_message(data))
    at = len(data) - 58 * size + inside  # position after epoch 40
    path = tmp_path / "a.track.ulg"
    path.write_bytes(data[:at] + foreign + data[at:])
    track = read_track(path, node="a")
    lost = 98 - track.sizes["epoch"]
    assert 1 <= lost <= 2
    assert np.isin(track.time.values, utc_of(flight(98)[0])).all()
    assert track.time.values[-1] == utc_of(flight(98)[0])[-1]
    assert position_error_m(track).max() < 0.02
    damaged_bytes = len(foreign) + lost * size - len(SYNC) * foreign.endswith(SYNC)
    assert track.attrs["damage"] == track.attrs["remarks"][0]
    assert track.attrs["damage"].startswith(
        f"{damaged_bytes} of {len(data) + len(foreign)} bytes are not valid messages"
    )


def _last_message(data):
    """Return the last message of a log of one topic."""
    fields = ulog_receiver()
    size = 2 + sum(
        {"uint64_t": 8, "double": 8, "int32_t": 4, "float": 4, "uint8_t": 1}[kind] for kind, _ in fields.values()
    )
    return data[-size - 3 :]


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("tail", [b"", bytes(700), b"\xff" * 64, "cut"], ids=["none", "zeros", "ones", "cut"])
def test_truncated_or_padded_end_is_no_damage(tmp_path, tail):
    data = ulog((GPS, 0, ulog_receiver()), (ATTITUDE, 0, ulog_attitude()))
    path = tmp_path / "a.track.ulg"
    path.write_bytes(data[:-9] if tail == "cut" else data + tail)
    track = read_track(path, node="a")
    assert "damage" not in track.attrs
    assert track.sizes["epoch"] == 60


@pytest.mark.usefixtures("reader")
def test_dropouts_of_the_logger_are_reported(tmp_path):
    path = tmp_path / "a.track.ulg"
    data = ulog((GPS, 0, ulog_receiver()))
    at = len(data) - 10 * len(_last_message(data))
    path.write_bytes(data[:at] + struct.pack("<HBH", 2, ord("O"), 1500) + data[at:])
    track = read_track(path, node="a")
    assert track.attrs["remarks"] == ["1 dropouts of the logger, total 1.5 s: messages during dropouts are lost"]
    assert track.sizes["epoch"] == 60


@pytest.mark.parametrize("old", [True, False])
@pytest.mark.usefixtures("reader")
def test_heights_above_sea_level_need_an_offset(tmp_path, old):
    name = "alt" if old else "altitude_msl_m"
    copied = {f"{name}_ellipsoid" if old else "altitude_ellipsoid_m": ulog_receiver(old=old)[name][1]}
    for change in (copied, dict.fromkeys(copied), {key: np.zeros(60, int) for key in copied}):
        receiver = (GPS, 0, ulog_receiver(old=old, **change))
        message = complaint(lambda receiver=receiver: read(tmp_path, receiver))
        assert "no heights above the ellipsoid" in message
        assert "nodes.a.log.height_offset_m" in message
        assert position_error_m(read(tmp_path, receiver, options=LogOptions(height_offset_m=N_M))).max() < 0.02


@pytest.mark.usefixtures("reader")
def test_configured_height_offset_does_not_change_ellipsoidal_heights(tmp_path):
    assert (
        position_error_m(read(tmp_path, (GPS, 0, ulog_receiver()), options=LogOptions(height_offset_m=1000.0))).max()
        < 0.02
    )


@pytest.mark.usefixtures("reader")
def test_solution_types_are_kept_and_epochs_without_fix_counted(tmp_path):
    kinds = np.resize([6, 5, 4, 3, 2, 1, 0, 8], 60)
    track = read(tmp_path, (GPS, 0, ulog_receiver(fix_type=kinds)))
    assert track.attrs["dropped"] == {"no fix": int((~np.isin(kinds, [3, 4, 5, 6])).sum())}
    assert Counter(track.fix.values.tolist()) == {1: 8, 2: 8, 4: 8, 5: 8}
    assert position_error_m(track).max() < 0.02


@pytest.mark.usefixtures("reader")
def test_implausible_accuracies_are_dropped(tmp_path):
    accuracy = np.resize([0.1, np.nan, np.inf, 0.0, -1.0, 4e9], 60)
    std = read(tmp_path, (GPS, 0, ulog_receiver(eph=accuracy))).position_std.values
    np.testing.assert_array_equal(np.isfinite(std[:, 0]), np.arange(60) % 6 == 0)
    np.testing.assert_array_equal(std[:, 2], 0.5)


@pytest.mark.usefixtures("reader")
def test_epochs_without_utc_and_duplicates_are_counted(tmp_path):
    receiver = ulog_receiver(time_utc_usec=np.where(np.arange(60) < 7, 0, ulog_receiver()["time_utc_usec"][1]))
    assert read(tmp_path, (GPS, 0, receiver)).attrs["dropped"] == {"no UTC from the receiver": 7}
    twice = {name: (kind, np.repeat(values, 2)) for name, (kind, values) in ulog_receiver().items()}
    track = read(tmp_path, (GPS, 0, twice))
    assert track.attrs["dropped"] == {"duplicate": 60}
    assert track.sizes["epoch"] == 60


@pytest.mark.usefixtures("reader")
def test_log_without_utc_needs_a_start_time(tmp_path):
    receiver = (GPS, 0, ulog_receiver(time_utc_usec=np.zeros(60, int)))
    message = complaint(lambda: read(tmp_path, receiver))
    assert "no epoch has a time in UTC" in message
    assert "nodes.a.log.start_utc" in message
    start = str(START - np.timedelta64(round((BOOT_S + LAG_S) * 1e9), "ns"))
    assert position_error_m(read(tmp_path, receiver, options=LogOptions(start_utc=start))).max() < 0.02
    assert "nodes.a.log.start_utc: 'noon'" in complaint(
        lambda: read(tmp_path, receiver, options=LogOptions(start_utc="noon"))
    )


@pytest.mark.usefixtures("reader")
def test_clock_drift_is_followed_and_late_messages_are_harmless(tmp_path):
    time = flight(600)[0]
    late = np.where(np.arange(600) % 50 == 7, 0.06, 0)
    receiver = ulog_receiver(epochs=600, timestamp=boot_us(time * (1 + 5e-5) + late))
    attitude = ulog_attitude(600)
    track = read(tmp_path, (GPS, 0, receiver), (ATTITUDE, 0, attitude))
    np.testing.assert_array_equal(track.time.values, utc_of(time))
    error_deg = (np.degrees(track.attitude.values[:, 2]) - flight(600)[2] + 180) % 360 - 180
    # 4 ms due to late messages at 9.2°/s, 3 ms due to a drift that does not affect the attitude
    assert np.abs(error_deg).max() < 0.06


@pytest.mark.usefixtures("reader")
def test_leap_second_learnt_during_the_log_is_rejected(tmp_path):
    """The first times are 2 s early; the correct half cannot be determined from the log alone."""
    times = ulog_receiver()["time_utc_usec"][1] - np.where(np.arange(60) < 25, 2_000_000, 0)
    message = complaint(lambda: read(tmp_path, (GPS, 0, ulog_receiver(time_utc_usec=times))))
    assert "25 of 60 times of the receiver disagree with the autopilot's clock" in message
    assert "differs by 2.00 s" in message
    few = ulog_receiver()["time_utc_usec"][1] - np.where(np.arange(60) < 3, 2_000_000, 0)
    track = read(tmp_path, (GPS, 0, ulog_receiver(time_utc_usec=few)))
    assert track.attrs["dropped"] == {"time contradicts the autopilot's clock": 3}
    assert position_error_m(track).max() < 0.02


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("epoch", [0, 3, 30, 58, 59])
@pytest.mark.parametrize(("field", "step"), [("lat", 90), ("lon", -150), ("alt_ellipsoid", 1000)])
def test_position_that_contradicts_the_velocity_is_dropped(tmp_path, epoch, field, step):
    """Errors of 1 m, e.g. by flipped bits, are found by velocity even at the ends; 59 is dropped together with 58."""
    displaced = ulog_receiver()[field][1] + step * (np.arange(60) == epoch)
    track = read(tmp_path, (GPS, 0, ulog_receiver(**{field: displaced})))
    assert track.attrs["dropped"] == {"position contradicts the receiver's velocity": 1 + (epoch == 58)}
    assert position_error_m(track).max() < 0.02


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("wrong", [{"vel_n_m_s": np.full(60, 30.0)}, {"vel_ned_valid": np.zeros(60, int)}])
def test_velocities_that_contradict_the_whole_log_are_ignored(tmp_path, wrong):
    track = read(tmp_path, (GPS, 0, ulog_receiver(**wrong)))
    assert track.sizes["epoch"] == 60


@pytest.mark.usefixtures("reader")
def test_step_between_solutions_drops_no_epoch(tmp_path):
    """A change to fix displaces all later positions; both parts are valid, and steps are checked elsewhere."""
    displaced = ulog_receiver()["lat"][1] + 180 * (np.arange(60) >= 30)
    assert read(tmp_path, (GPS, 0, ulog_receiver(lat=displaced))).sizes["epoch"] == 60


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"", "Header too short"),
        (b"x" * 500, "Failed to parse header"),
        (ulog((ATTITUDE, 0, ulog_attitude())), "no position messages"),
        (ulog((GPS, 0, ulog_receiver(lat=None))), "no latitude and longitude"),
        (ulog((GPS, 0, ulog_receiver(fix_type=None))), "no fix_type"),
        (ulog((GPS, 0, ulog_receiver(vel_d_m_s=None))), "no vel_d_m_s"),
        (ulog((GPS, 0, ulog_receiver(fix_type=np.zeros(60, int)))), "no heights above the ellipsoid"),
        (ulog((GPS, 0, ulog_receiver(epochs=1))), "1 epochs"),
    ],
)
def test_invalid_log_is_rejected(tmp_path, data, found):
    path = tmp_path / "a.track.ulg"
    path.write_bytes(data)
    assert found in complaint(lambda: read_track(path, node="a"))


# Damaged logs: ULog has no checksums; therefore, changes are detected only by contradictions within the log

MESSAGES = ulog((GPS, 0, ulog_receiver()), (ATTITUDE, 0, ulog_attitude(rate_hz=10.0)))
DAMAGED = tried(300)


def split(data):
    """Return the header and the messages of a log."""
    parts, at = [data[:16]], 16
    while at < len(data):
        size = struct.unpack_from("<H", data, at)[0] + 3
        parts.append(data[at : at + size])
        at += size
    return parts


def read_damaged(path, data):
    """Return the track of a damaged log, or None if the log is rejected; the reader runs in this process."""
    path.write_bytes(data)
    try:
        fields = read_fields(path)
    except Exception:
        return None
    try:
        return check(track_of(fields, node="a", options=DEFAULT_OPTIONS, where=path), "track")
    except CampaignError:
        return None


def assert_no_position_is_silently_wrong(track):
    """Assert that every epoch is at the true position or is detected by the check of all tracks."""
    time_s = (track.time.values - track.time.values[0]) / SECOND
    checked = check_track(time_s, track.position.values, poor_fix=np.zeros(time_s.size, bool), tolerated_m=0.01)
    inside = np.minimum(np.arange(time_s.size), np.arange(time_s.size)[::-1]) >= 6
    # near the ends only the receiver's velocity reveals an error
    wrong = position_error_m(track) > np.where(inside, 0.15, 0.6)
    assert not (wrong & checked.kept).any(), (track.time.values[wrong], position_error_m(track)[wrong])


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("damaged") / "a.track.ulg"


@DAMAGED
@given(st.integers(0, len(MESSAGES) - 1))
def test_truncated_log_is_shorter_or_rejected(place, size):
    track = read_damaged(place, MESSAGES[:size])
    if track is not None:
        assert position_error_m(track).max() < 0.02
        assert track.sizes["epoch"] <= 60


@pytest.mark.slow
@DAMAGED
@given(st.lists(st.tuples(st.integers(0, len(MESSAGES) - 1), st.integers(0, 7)), min_size=1, max_size=4))
def test_flipped_bit_displaces_no_position_silently(place, flips):
    data = bytearray(MESSAGES)
    for at, bit in flips:
        data[at] ^= 1 << bit
    track = read_damaged(place, bytes(data))
    if track is not None:
        assert_no_position_is_silently_wrong(track)


@pytest.mark.slow
@DAMAGED
@given(st.randoms(use_true_random=False), st.integers(1, 20))
def test_reordered_messages_are_rejected_or_harmless(place, random, swaps):
    header, *messages = split(MESSAGES)
    for _ in range(swaps):
        first, second = random.randrange(len(messages)), random.randrange(len(messages))
        messages[first], messages[second] = messages[second], messages[first]
    track = read_damaged(place, header + b"".join(messages))
    if track is not None:
        assert position_error_m(track).max() < 0.02


# A real flight


@pytest.fixture(scope="module")
def flown():
    if not REAL.is_file():
        pytest.skip(f"{REAL} does not exist")
    return read_track(REAL, node="a")


def raw_messages(name):
    """Return the payloads of a topic's messages, parsed without a library."""
    formats, ids, payloads = {}, {}, []
    for message in split(REAL.read_bytes())[1:]:
        kind, body = chr(message[2]), message[3:]
        if kind == "F":
            text = body.decode()
            formats[text.partition(":")[0]] = text.partition(":")[2].rstrip(";").split(";")
        elif kind == "A":
            ids[struct.unpack_from("<H", body, 1)[0]] = body[3:].decode()
        elif kind == "D" and ids.get(struct.unpack_from("<H", body)[0]) == name:
            payloads.append(body[2:])
    return formats[name], payloads


@pytest.mark.usefixtures("reader")
def test_real_log_is_undamaged(flown):
    assert "damage" not in flown.attrs
    assert "remarks" not in flown.attrs


@pytest.mark.slow
def test_foreign_bytes_anywhere_in_a_real_log_are_found(tmp_path):
    """Foreign bytes are inserted at 40 positions; the other epochs of the log remain unchanged."""
    if not REAL.is_file():
        pytest.skip(f"{REAL} does not exist")
    data, generator = REAL.read_bytes(), np.random.default_rng(4)
    whole, path = read_fields(REAL)[f"{GPS}:0/timestamp"], tmp_path / "a.ulg"
    for at in generator.integers(60_000, len(data) - 4000, 40):
        path.write_bytes(data[:at] + generator.bytes(200) + data[at:])
        fields = read_fields(path)
        spans = fields["damage"]
        assert any(first <= at <= last for first, last in spans[:-1])
        assert 200 <= np.diff(spans[:-1], axis=1).sum() < 3000
        kept = fields[f"{GPS}:0/timestamp"]
        assert np.isin(kept, whole).all()
        assert kept.size >= whole.size - 6


def test_real_flight_has_the_epochs_and_positions_of_its_messages(flown):
    """The log is px4_real_flight, a PX4 1.9 multicopter over Zurich; fields are unpacked by their byte offsets."""
    names, payloads = raw_messages(GPS)
    sizes = {"uint64_t": 8, "int32_t": 4, "float": 4, "uint8_t": 1, "bool": 1}
    offsets, at = {}, 0
    for name in names:
        kind, _, field = name.partition(" ")
        if field.startswith("_padding"):
            break
        offsets[field] = at
        at += sizes[kind]
    fields = {
        field: np.array([struct.unpack_from(form, payload, offsets[field])[0] for payload in payloads])
        for field, form in (
            ("time_utc_usec", "<Q"),
            ("lat", "<i"),
            ("lon", "<i"),
            ("alt_ellipsoid", "<i"),
            ("fix_type", "<B"),
        )
    }
    assert flown.sizes["epoch"] == len(payloads) == 179
    assert flown.attrs["dropped"] == {}
    np.testing.assert_array_equal(flown.time.values, fields["time_utc_usec"].astype("datetime64[us]"))
    assert str(flown.time.values[0])[:23] == "2019-05-13T14:09:19.600"
    assert (flown.time.values[-1] - flown.time.values[0]) / SECOND == pytest.approx(39.400004, abs=1e-9)
    assert np.median(np.diff(flown.time.values)) / SECOND == pytest.approx(0.2, abs=1e-5)  # 5 Hz
    geodetic = geodetic_from_ecef(flown.position.values)
    places = np.stack([fields["lat"] * 1e-7, fields["lon"] * 1e-7, fields["alt_ellipsoid"] * 1e-3], -1)
    np.testing.assert_allclose(geodetic, places, atol=1e-6)
    np.testing.assert_allclose(geodetic.min(axis=0), [47.3563268, 8.5187079, 472.089], atol=1e-6)
    np.testing.assert_allclose(geodetic.max(axis=0), [47.3565837, 8.5189515, 482.655], atol=1e-6)
    assert set(fields["fix_type"]) == {4}
    assert set(flown.fix.values) == {4}


def test_attitude_of_a_real_flight_matches_its_quaternions(flown):
    from pyulog import ULog
    from pyulog.px4 import PX4ULog

    log = ULog(str(REAL))
    PX4ULog(log).add_roll_pitch_yaw()
    logged, receiver = log.get_dataset(ATTITUDE).data, log.get_dataset(GPS).data
    received_s = np.interp(
        (flown.time.values - flown.time.values[0]) / SECOND,
        (receiver["time_utc_usec"] - receiver["time_utc_usec"][0]) * 1e-6,
        receiver["timestamp"] * 1e-6,
    )
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        expected = np.interp(received_s - 0.11, logged["timestamp"] * 1e-6, np.unwrap(logged[name]))
        error_rad = flown.attitude.values[:, axis] - expected
        error_rad = (error_rad + np.pi) % (2 * np.pi) - np.pi
        assert np.degrees(np.median(np.abs(error_rad))) < 0.3, name
        assert np.degrees(np.abs(error_rad).max()) < 6, name


@pytest.mark.usefixtures("reader")
def test_fused_positions_of_a_real_flight_are_near_the_receivers(flown):
    fused = read_track(REAL, node="a", options=LogOptions(body=FUSED))
    assert fused.sizes["epoch"] == len(raw_messages(FUSED)[1]) == 95
    seconds, receiver_s = ((track.time.values - START) / SECOND for track in (fused, flown))
    interpolated = np.stack([np.interp(seconds, receiver_s, axis) for axis in flown.position.values.T], -1)
    distance_m = np.linalg.norm(fused.position.values - interpolated, axis=1)
    assert np.median(distance_m) < 0.5
    assert distance_m.max() < 1.5
