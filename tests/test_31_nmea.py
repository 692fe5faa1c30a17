"""NMEA logs: heights above the ellipsoid, dates past midnight, checksums against wrong positions."""

import re

import numpy as np
import pytest
from folders import complaint
from hypothesis import given
from hypothesis import strategies as st
from properties import tried

from apertura.common.contracts import check
from apertura.core.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from apertura.formats.reading import read_track
from apertura.formats.tracks.log_options import LogOptions
from tests.attack import logs

TIMES, PLACES = logs.circle()


def read(tmp_path, text, name="a.track.nmea", **options):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return check(read_track(path, node="a", options=LogOptions(**options)), "track")


def test_height_adds_geoid_separation_and_date_passes_midnight(tmp_path):
    track = read(tmp_path, logs.nmea(TIMES, PLACES))
    np.testing.assert_array_equal(track.time.values, TIMES)
    np.testing.assert_allclose(track.position.values, ecef_from_geodetic(*PLACES.T), atol=2e-5, rtol=0)
    assert str(track.time.values[-1])[:10] == "2025-05-15"
    assert set(track.fix.values) == {1}
    np.testing.assert_array_equal(track.position_std.values, np.tile([0.01, 0.02, 0.03], (40, 1)))
    assert track.dropped == {}


@pytest.mark.parametrize("south_west", [False, True])
def test_hemispheres_give_the_signs(tmp_path, south_west):
    places = PLACES * ([-1, -1, 1] if south_west else 1)
    track = read(tmp_path, logs.nmea(TIMES, places))
    np.testing.assert_allclose(track.position.values, ecef_from_geodetic(*places.T), atol=2e-5, rtol=0)


def test_single_date_applies_to_the_whole_log(tmp_path):
    lines = logs.nmea(TIMES, PLACES, every=0).splitlines()
    for date in (logs.zda(TIMES[35]), logs.rmc(TIMES[35])):
        track = read(tmp_path, "\n".join([*lines[:70], date, *lines[70:]]) + "\n")
        np.testing.assert_array_equal(track.time.values, TIMES)


@pytest.mark.parametrize("wrong", [1, 3, 10])
def test_late_date_change_after_midnight_is_corrected(tmp_path, wrong):
    """Some receivers briefly send the previous date after midnight; without a correction, epochs are one day early."""
    lines, late = logs.nmea(TIMES, PLACES, every=1).splitlines(), 0
    for place, line in enumerate(lines):
        if "RMC,000" in line and late < wrong:
            lines[place] = logs.sealed(line[1:].partition("*")[0].replace(",150525,", ",140525,"))
            late += 1
    track = read(tmp_path, "\n".join(lines) + "\n")
    np.testing.assert_array_equal(track.time.values, TIMES)
    assert track.remarks[0].startswith(f"{wrong} dates after midnight are those of the previous day")


def test_invalid_rmc_gives_no_date(tmp_path):
    text = logs.rmc(TIMES[0] + np.timedelta64(400, "D"), status="V") + "\n" + logs.nmea(TIMES, PLACES, every=0)
    assert "no RMC or ZDA with a date; expected key nodes.a.log.start_utc" in complaint(lambda: read(tmp_path, text))
    track = read(tmp_path, text, start_utc="2025-05-14")
    np.testing.assert_array_equal(track.time.values, TIMES)


def test_configured_time_system_other_than_utc_is_rejected(tmp_path):
    assert "times of NMEA are UTC" in complaint(lambda: read(tmp_path, logs.nmea(TIMES, PLACES), time_system="gpst"))


@pytest.mark.parametrize("separation", ["", "0.0"])
def test_altitudes_without_geoid_separation_need_an_offset(tmp_path, separation):
    text = logs.nmea(TIMES, PLACES, separation=separation)
    assert "expected key nodes.a.log.height_offset_m" in complaint(lambda: read(tmp_path, text))
    heights = geodetic_from_ecef(read(tmp_path, text, height_offset_m=48.0).position.values)[:, 2]
    np.testing.assert_allclose(heights, PLACES[:, 2] + 48, atol=1e-6)
    stated = logs.nmea(TIMES, PLACES)
    assert "GGA contains the geoid separation" in complaint(lambda: read(tmp_path, stated, height_offset_m=48.0))


def test_epochs_without_geoid_separation_are_dropped(tmp_path):
    lines = [logs.rmc(TIMES[0]), *(logs.gga(*epoch) for epoch in zip(TIMES, PLACES, strict=True))]
    lines[7] = logs.gga(TIMES[6], PLACES[6], separation="")
    track = read(tmp_path, "\n".join(lines) + "\n")
    assert track.dropped == {"without geoid separation": 1}
    np.testing.assert_array_equal(track.time.values, np.delete(TIMES, 6))


def test_solution_types_are_kept_and_invalid_ones_dropped(tmp_path):
    qualities = [1, 2, 3, 4, 5, 9, 0, 6, 7, 8]
    lines = [logs.rmc(TIMES[0])]
    lines += [logs.gga(*epoch, quality=q) for q, *epoch in zip(qualities, TIMES, PLACES, strict=False)]
    lines.append(logs.sealed(f"GNGGA,{logs.of_day(TIMES[11])},,,,,0,00,99.99,,,,,,"))
    lines.append(logs.sealed("GNGGA,,,,,,0,00,99.99,,,,,,"))
    track = read(tmp_path, "\n".join(lines) + "\n")
    assert track.fix.values.tolist() == [5, 4, 5, 1, 2, 3]
    assert track.dropped == {"no fix": 3, "dead reckoning": 1, "manual input": 1, "simulated": 1}


def test_gn_talker_is_preferred_and_duplicates_are_dropped(tmp_path):
    lines = [logs.rmc(TIMES[0])]
    for time, place in zip(TIMES, PLACES, strict=True):
        lines += [logs.gga(time, place + [1e-4, 0, 0], talker="GP"), logs.gga(time, place)]
    track = read(tmp_path, "\n".join([*lines, lines[-1]]) + "\n")
    np.testing.assert_allclose(track.position.values, ecef_from_geodetic(*PLACES.T), atol=2e-5, rtol=0)
    assert track.dropped == {"from another talker": 40, "duplicate": 1}
    other = logs.gga(TIMES[0], PLACES[0] + [1e-3, 0, 0])
    assert "two positions of talker GN" in complaint(lambda: read(tmp_path, "\n".join([*lines, other]) + "\n"))


@pytest.mark.parametrize("prefix", ["2025-05-14 23:59:57.123 ", "[1747267197.5] ", "23:59:57;"])
def test_host_time_stamps_are_removed_with_a_remark(tmp_path, caplog, prefix):
    track = read(tmp_path, logs.nmea(TIMES, PLACES, prefix=prefix), name="a.track.txt")
    np.testing.assert_array_equal(track.time.values, TIMES)
    assert "88 lines start with a time stamp of the host" in track.remarks[0]
    assert track.remarks[0] in caplog.text
    assert "remarks" not in read(tmp_path, logs.nmea(TIMES, PLACES)).attrs


def test_binary_messages_between_sentences_are_skipped(tmp_path):
    data = b"\xb5\x62\x01\x07$\x00\xff".join(line + b"\n" for line in logs.nmea(TIMES, PLACES).encode().splitlines())
    track = read(tmp_path, data)
    np.testing.assert_array_equal(track.time.values, TIMES)
    assert track.dropped == {}


def test_sentence_with_wrong_or_missing_checksum_is_dropped(tmp_path):
    lines = logs.nmea(TIMES, PLACES).splitlines()
    at = [place for place, line in enumerate(lines) if "GGA" in line]
    lines[at[3]] = lines[at[3]].replace("N,00957", "N,00956")
    lines[at[5]] = lines[at[5]].partition("*")[0]
    lines[at[7]] = lines[at[7]][:40]
    lines[at[8]] = lines[at[8]][:-1]
    track = read(tmp_path, "\n".join(lines) + "\n")
    assert track.dropped == {
        "sentences with a wrong checksum": 1,
        "sentences without a checksum in a log with checksums": 1,
        "truncated sentences": 2,
    }
    np.testing.assert_array_equal(track.time.values, np.delete(TIMES, [3, 5, 7, 8]))


@pytest.mark.parametrize("end", ["\r\n", "\n", " \r\n"])
def test_log_without_checksums_is_read_with_a_remark(tmp_path, end):
    """A truncated sentence is dropped, even if only the last digits at the end of the log are missing."""
    lines = [line.partition("*")[0] for line in logs.nmea(TIMES, PLACES).splitlines()]
    at = next(place for place, line in enumerate(lines) if "GGA,235957.30" in line)
    lines[at] = lines[at][:40]
    track = read(tmp_path, end.join(lines) + end)
    assert track.dropped == {"truncated sentences": 1}
    np.testing.assert_array_equal(track.time.values, np.delete(TIMES, 3))
    np.testing.assert_allclose(track.position.values, ecef_from_geodetic(*np.delete(PLACES, 3, 0).T), atol=2e-5, rtol=0)
    np.testing.assert_array_equal(track.position_std.values, np.tile([0.01, 0.02, 0.03], (39, 1)))
    assert "none of 87 sentences has a checksum" in track.remarks[0]
    cut = read(tmp_path, end.join(lines[:-1])[:-1])
    assert cut.dropped == {"truncated sentences": 2}
    np.testing.assert_array_equal(cut.time.values, np.delete(TIMES, [3, 39]))


def test_sentence_within_a_leap_second_is_dropped(tmp_path):
    lines = logs.nmea(TIMES, PLACES).splitlines()
    inserted = logs.sealed(lines[1][1:].partition("*")[0].replace("235957.00", "235960.50"))
    assert read(tmp_path, "\n".join([*lines, inserted]) + "\n").dropped == {"within a leap second": 1}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("235957.20", "235977.20"),
        (",4,12", ",77,12"),
        (",M,48", ",F,48"),
        ("4824.", "48"),
        (",E,", ",Q,"),
        ("48.000", "48_0"),
    ],
)
def test_invalid_sentence_is_one_message(tmp_path, old, new):
    bodies = [line[1:].partition("*")[0] for line in logs.nmea(TIMES, PLACES).splitlines()]
    at = next(place for place, body in enumerate(bodies) if "GGA,235957.20" in body)
    assert old in bodies[at]
    bodies[at] = bodies[at].replace(old, new, 1)
    message = complaint(lambda: read(tmp_path, "\n".join(map(logs.sealed, bodies)) + "\n"))
    assert re.search(r"a\.track\.nmea: invalid sentence '.*GGA", message)
    assert message.isprintable()


@pytest.mark.slow
@tried(200)
@given(data=st.data())
def test_flipped_bit_changes_no_epoch(tmp_path_factory, data):
    """A flipped bit removes a sentence or a date, but never changes a position or a time."""
    whole = logs.nmea(TIMES, PLACES).encode()
    place, bit = data.draw(st.integers(0, len(whole) - 1)), data.draw(st.integers(0, 7))
    damaged = bytearray(whole)
    damaged[place] ^= 1 << bit
    folder = tmp_path_factory.mktemp("log")
    track, good = read(folder, bytes(damaged)), read(folder, whole)
    kept = np.searchsorted(good.time.values, track.time.values)
    assert 39 <= len(kept) <= 40
    np.testing.assert_array_equal(good.time.values[kept], track.time.values)
    np.testing.assert_array_equal(good.position.values[kept], track.position.values)


def test_configured_day_that_contradicts_the_log_is_rejected(tmp_path):
    text = logs.nmea(TIMES, PLACES)
    for day in ("2025-05-13", "2025-05-15", "1970-01-01"):
        message = complaint(lambda day=day: read(tmp_path, text, start_utc=day))
        assert (
            "the date of the first epoch by RMC or ZDA is 2025-05-14; expected nodes.a.log.start_utc of config.yaml"
            in message
        )
    np.testing.assert_array_equal(read(tmp_path, text, start_utc="2025-05-14T09:00").time.values, TIMES)
