"""ArduPilot logs: GPS weeks are converted to UTC, heights must be ellipsoidal, the receiver is selectable."""

from collections import Counter

import numpy as np
import pytest
from autopilot_logs import N_M, START, dataflash, dataflash_rows, dataflash_text, flight, utc_of
from folders import complaint
from hypothesis import given
from hypothesis import strategies as st
from properties import tried

from apertura.common.contracts import check
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from apertura.core.geometry.track_checks import check_track
from apertura.formats.reading import read_track
from apertura.formats.tracks.ardupilot import track_of
from apertura.formats.tracks.dataflash_fields import read_fields
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions

SECOND = np.timedelta64(1, "s")
KINDS = {".bin": dataflash, ".log": dataflash_text}


def read(tmp_path, rows, *, suffix=".bin", options=DEFAULT_OPTIONS, forms=None):
    path = tmp_path / f"a.track{suffix}"
    path.write_bytes(KINDS[suffix](rows, forms))
    return check(read_track(path, node="a", options=options), "track")


def position_error_m(track):
    """Return the distance of each epoch from the true position at its time."""
    exact, geodetic, _ = flight(4000, 400.0)
    seconds = (track.time.values - START) / SECOND
    truth = np.stack([np.interp(seconds, exact, axis) for axis in ecef_from_geodetic(*geodetic.T).T], -1)
    return np.linalg.norm(track.position.values - truth, axis=1)


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("suffix", KINDS)
def test_track_has_the_values_of_the_receiver(tmp_path, suffix):
    track = read(tmp_path, dataflash_rows(), suffix=suffix)
    time, geodetic, yaw = flight()
    np.testing.assert_array_equal(track.time.values, utc_of(time))  # the GPS weeks of the log are 18 s ahead
    np.testing.assert_allclose(geodetic_from_ecef(track.position.values), geodetic, atol=6e-3)
    np.testing.assert_allclose(geodetic_from_ecef(track.position.values)[:, :2], geodetic[:, :2], atol=6e-8)
    np.testing.assert_allclose(track.position_std.values, np.tile([0.02, 0.02, 0.03], (60, 1)))
    np.testing.assert_allclose(
        np.degrees(track.attitude.values), np.stack([np.full(60, 10.0), np.full(60, 3.0), yaw], -1), atol=2e-3
    )
    assert set(track.fix.values) == {1}
    assert track.attrs["dropped"] == {}
    assert track.attrs["source"] == "GPS 0 of 0"


def test_generated_log_is_readable_by_pymavlink(tmp_path):
    """All epochs equal those of pymavlink, at the times that pymavlink computes from GPS weeks."""
    from pymavlink.DFReader import DFReader_binary

    path = tmp_path / "a.track.bin"
    path.write_bytes(dataflash(dataflash_rows()))
    log, rows = DFReader_binary(str(path)), []
    while (message := log.recv_match(type=["GPS"])) is not None:
        rows.append((log.clock._gpsTimeToTime(message.GWk, message.GMS), message.Lat, message.Lng, message.Alt))
    seconds, *places = np.array(rows).T
    track = read_track(path, node="a")
    unix_s = track.time.values.astype(np.int64) / 1e9
    np.testing.assert_allclose(unix_s, seconds, atol=1e-6)
    np.testing.assert_allclose(geodetic_from_ecef(track.position.values)[:, :2].T, places[:2], atol=1e-9)
    np.testing.assert_allclose(geodetic_from_ecef(track.position.values)[:, 2] - N_M, places[2], atol=1e-6)


@pytest.mark.usefixtures("reader")
def test_attitude_is_read_at_the_time_of_validity(tmp_path):
    """GPS1_DELAY_MS is the delay of the receiver; 0 selects the default of the driver, 120 ms in this log."""
    configured = read(tmp_path, dataflash_rows(parameters={"GPS1_DELAY_MS": 220.0}))
    default = read(tmp_path, dataflash_rows(parameters={"GPS1_DELAY_MS": 0.0}))
    difference_deg = np.degrees(default.attitude.values[:, 2] - configured.attitude.values[:, 2])
    np.testing.assert_allclose(difference_deg, 0.1 * np.degrees(8 / 50), atol=2e-3)


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("suffix", KINDS)
def test_heights_above_sea_level_need_an_offset(tmp_path, suffix):
    rows = dataflash_rows(without_ael=True)
    message = complaint(lambda: read(tmp_path, rows, suffix=suffix))
    assert "heights are above sea level (GPS.Alt)" in message
    assert "nodes.a.log.height_offset_m" in message
    assert position_error_m(read(tmp_path, rows, suffix=suffix, options=LogOptions(height_offset_m=N_M))).max() < 0.02


@pytest.mark.usefixtures("reader")
def test_ellipsoidal_heights_of_the_novatel_driver_are_not_used(tmp_path):
    rows = dataflash_rows(parameters={"GPS_TYPE": 15})
    assert "NovAtel" in complaint(lambda: read(tmp_path, rows))
    assert position_error_m(read(tmp_path, rows, options=LogOptions(height_offset_m=N_M))).max() < 0.02


@pytest.mark.usefixtures("reader")
def test_receiver_is_selected_by_number(tmp_path):
    """The second receiver is displaced by 1e-5 degrees (1.11 m) to the north."""
    rows = dataflash_rows(receivers=(0, 1))
    first = read(tmp_path, rows)
    assert first.attrs["source"] == "GPS 0 of 0, 1"
    assert first.sizes["epoch"] == 60
    second = read(tmp_path, rows, options=LogOptions(body="1"))
    north = geodetic_from_ecef(second.position.values)[:, 0] - geodetic_from_ecef(first.position.values)[:, 0]
    np.testing.assert_allclose(north, 1e-5, atol=2e-7)
    message = complaint(lambda: read(tmp_path, rows, options=LogOptions(body="2")))
    assert "no receiver '2'; expected one of 0, 1" in message
    assert "nodes.a.log.body" in message


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("suffix", KINDS)
def test_several_receivers_are_listed_with_their_solutions(tmp_path, suffix):
    rows = [
        (name, {**row, "Status": 3} if name == "GPS" and row["I"] == 0 else row)
        for name, row in dataflash_rows(receivers=(0, 1))
    ]
    track = read(tmp_path, rows, suffix=suffix)
    remark = "the log contains receivers 0 (single 60) and 1 (fix 60); 0 is used; select with nodes.a.log.body"
    assert track.attrs["remarks"] == [remark]
    assert "remarks" not in read(tmp_path, rows, suffix=suffix, options=LogOptions(body="1")).attrs


RNG = np.random.default_rng(12)


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize(
    "foreign",
    [RNG.bytes(200), bytes(4096), RNG.bytes(60) + b"\xa3\x95\x07" + RNG.bytes(60), b"\xa3\x95" * 30],
    ids=["200 bytes", "zeros", "a message of no kind", "beginnings of messages"],
)
@pytest.mark.parametrize("inside", [0, 20])
def test_epochs_after_foreign_bytes_are_read_and_bytes_counted(tmp_path, foreign, inside):
    data = dataflash(dataflash_rows())
    at = data.index(b"\xa3\x95\x82", len(data) // 2) + inside  # within the first GPS message of the second half
    path = tmp_path / "a.track.bin"
    path.write_bytes(data[:at] + foreign + data[at:])
    track = read_track(path, node="a")
    assert 58 <= track.sizes["epoch"] <= 60
    assert np.isin(track.time.values, utc_of(flight()[0])).all()
    assert track.time.values[-1] == utc_of(flight()[0])[-1]
    assert position_error_m(track).max() < 0.02
    lost, total = _counts(track)
    assert total == len(data) + len(foreign)
    assert len(foreign) <= lost <= len(foreign) + 200


def _counts(track):
    """Return the number of bytes that do not belong to messages, and the total."""
    lost, total = track.attrs["damage"].split(" bytes")[0].split(" of ")
    return int(lost), int(total)


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("tail", [b"", bytes(700), b"\xff" * 64, "cut"], ids=["none", "zeros", "ones", "cut"])
def test_truncated_or_padded_end_is_no_damage(tmp_path, tail):
    data = dataflash(dataflash_rows())
    path = tmp_path / "a.track.bin"
    path.write_bytes(data[:-9] if tail == "cut" else data + tail)
    track = read_track(path, node="a")
    assert "damage" not in track.attrs
    assert track.sizes["epoch"] == 60


@pytest.mark.usefixtures("reader")
def test_invalid_lines_of_a_text_log_are_counted(tmp_path):
    lines = dataflash_text(dataflash_rows()).split(b"\n")
    at = next(place for place, line in enumerate(lines) if line.startswith(b"GPS, ") and place > 200)
    lines[at] = lines[at][:30]
    path = tmp_path / "a.track.log"
    path.write_bytes(b"\n".join([*lines[:100], b"@@@@@,,", *lines[100:]]))
    track = read_track(path, node="a")
    assert track.attrs["damage"].startswith("2 of ")
    assert "lines are not valid messages, in 2 blocks, from line 101 on" in track.attrs["damage"]
    assert track.sizes["epoch"] == 59


@pytest.mark.usefixtures("reader")
def test_gps2_messages_of_older_logs_are_a_second_receiver(tmp_path):
    columns = "TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"
    forms = dict.fromkeys(("GPS", "GPS2"), ("QBIHBcLLeffffB", columns))
    rows = [(name + "2" * values.get("I", 0), values) for name, values in dataflash_rows(receivers=(0, 1))]
    rows = [(name, values) for name, values in rows if not name.startswith("GPA")]
    tracks = [
        read(tmp_path, rows, forms=forms, options=LogOptions(body=body, height_offset_m=N_M)) for body in ("0", "1")
    ]
    assert tracks[1].attrs["source"] == "GPS 1 of 0, 1"
    latitudes = [geodetic_from_ecef(track.position.values)[0, 0] for track in tracks]
    assert latitudes[1] - latitudes[0] == pytest.approx(1e-5, abs=2e-7)


@pytest.mark.usefixtures("reader")
def test_solution_types_are_kept_and_epochs_without_fix_counted(tmp_path):
    track = read(tmp_path, dataflash_rows(Status=np.resize([6, 5, 4, 3, 2, 1], 60)))
    assert track.attrs["dropped"] == {"no fix": 20}
    assert Counter(track.fix.values.tolist()) == {1: 10, 2: 10, 4: 10, 5: 10}


@pytest.mark.usefixtures("reader")
def test_epochs_without_gps_week_are_counted(tmp_path):
    weeks = np.where(np.arange(60) < 9, 0, 2366)
    assert read(tmp_path, dataflash_rows(GWk=weeks)).attrs["dropped"] == {"no UTC from the receiver": 9}
    message = complaint(lambda: read(tmp_path, dataflash_rows(GWk=np.zeros(60, int))))
    assert "no epoch has a time in UTC" in message
    assert "nodes.a.log.start_utc" in message


@pytest.mark.usefixtures("reader")
def test_earlier_flight_has_fewer_leap_seconds(tmp_path):
    """In week 1850 (June 2015), GPS time was 16 s ahead of UTC; ten years later, the difference is 18 s."""
    track = read(tmp_path, dataflash_rows(GWk=np.full(60, 1850)))
    assert (track.time.values[0] - START) / SECOND == (1850 - 2366) * 7 * 86400 + 2


@pytest.mark.usefixtures("reader")
def test_position_that_contradicts_the_velocity_is_dropped(tmp_path):
    rows = [
        (name, {**v, "Lat": v["Lat"] + 1e-5 * (name == "GPS" and n == 59)}) if name == "GPS" else (name, v)
        for n, (name, v) in numbered(dataflash_rows())
    ]
    track = read(tmp_path, rows)
    assert track.attrs["dropped"] == {"position contradicts the receiver's velocity": 1}
    assert position_error_m(track).max() < 0.02


def numbered(rows):
    """Yield each message with the number of earlier messages of the same name."""
    counts = Counter()
    for name, values in rows:
        yield counts[name], (name, values)
        counts[name] += 1


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize(
    ("suffix", "data", "found"),
    [
        (".bin", b"", "a flight log with suffix '.bin'"),
        (".log", b"GPS, 1, 2\n" * 50, "a flight log with suffix '.log'"),
        (".log", b"FMT\n" * 50, "no FMT message at the start of the file"),
        (".log", b"FMT, 1\n" * 50, "no GPS message"),
        (".bin", dataflash([]), "no GPS message"),
        (".log", dataflash_text([]), "no GPS message"),
        (
            ".bin",
            dataflash(dataflash_rows(), {"GPS": ("QBB", "TimeUS,I,Status")}),
            "GPS messages without GMS, GWk, Lat",
        ),
        (".bin", dataflash(dataflash_rows(epochs=1)), "1 epochs"),
        (".log", dataflash_text(dataflash_rows()).replace(b"GPS, 3", b"GPS, x"), "not readable"),
        (".log", b"FMT, 1, 2, X, Z, \xff\n" + dataflash_text(dataflash_rows()), "not readable"),
    ],
)
def test_invalid_log_is_rejected(tmp_path, suffix, data, found):
    path = tmp_path / f"a.track{suffix}"
    path.write_bytes(data)
    assert found in complaint(lambda: read_track(path, node="a"))


# Damaged logs: DataFlash has no checksums

LOGS = {suffix: write(dataflash_rows()) for suffix, write in KINDS.items()}
DAMAGED = tried(120)
PLACES = st.integers(0, 10**6)


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


@pytest.fixture(scope="module", params=list(KINDS))
def log(request, tmp_path_factory):
    return tmp_path_factory.mktemp("damaged") / f"a.track{request.param}"


@pytest.mark.quick(".bin")
@DAMAGED
@given(PLACES)
def test_truncated_log_is_shorter_or_rejected(log, place):
    data = LOGS[log.suffix]
    track = read_damaged(log, data[: place % len(data)])
    if track is not None:
        assert_no_position_is_silently_wrong(track)


@pytest.mark.slow
@DAMAGED
@given(st.lists(st.tuples(PLACES, st.integers(0, 7)), min_size=1, max_size=4))
def test_flipped_bit_displaces_no_position_silently(log, flips):
    data = bytearray(LOGS[log.suffix])
    for place, bit in flips:
        data[place % len(data)] ^= 1 << bit
    track = read_damaged(log, bytes(data))
    if track is not None:
        assert_no_position_is_silently_wrong(track)


@pytest.mark.slow
@DAMAGED
@given(st.randoms(use_true_random=False), st.integers(1, 20))
def test_reordered_messages_are_rejected_or_harmless(log, random, swaps):
    rows = dataflash_rows()
    for _ in range(swaps):
        first, second = random.randrange(len(rows)), random.randrange(len(rows))
        rows[first], rows[second] = rows[second], rows[first]
    track = read_damaged(log, KINDS[log.suffix](rows))
    if track is not None:
        assert position_error_m(track).max() < 0.02


def assert_no_position_is_silently_wrong(track):
    """Assert that every epoch is at the true position or is detected by the check of all tracks."""
    time_s = (track.time.values - track.time.values[0]) / SECOND
    checked = check_track(time_s, track.position.values, poor_fix=np.zeros(time_s.size, bool), tolerated_m=0.01)
    inside = np.minimum(np.arange(time_s.size), np.arange(time_s.size)[::-1]) >= 6
    # near the ends only the receiver's velocity reveals an error
    wrong = position_error_m(track) > np.where(inside, 0.15, 0.6)
    assert not (wrong & checked.kept).any(), (track.time.values[wrong], position_error_m(track)[wrong])
