"""Bytes of recorders and flight logs come out as the stages promise."""

import hashlib
import json

import numpy as np
import pytest

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.contracts import check
from apertura.errors import CampaignError
from apertura.geometry.geodesy import geodetic_from_ecef
from apertura.ingest import open_recording, read_phase_history, read_track

HEADER = (
    "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix)\n%  {}                  latitude(deg) longitude(deg)  height(m)   Q\n"
)


def pos(path, system, *lines):
    path.write_text(HEADER.format(system) + "\n".join(lines) + "\n")
    return read_track(path, node="a")


def test_gpst_is_eighteen_seconds_ahead_of_utc(tmp_path):
    lines = [f"2025/05/14 09:30:{second}.500   48.0   9.0   600.0   1" for second in (16, 17)]
    gpst, utc = (pos(tmp_path / f"{system}.pos", system, *lines) for system in ("GPST", "UTC"))
    assert (utc.time.values - gpst.time.values == np.timedelta64(18, "s")).all()
    assert gpst.time.values[0] == np.datetime64("2025-05-14T09:29:58.500")


def test_gps_weeks_and_calendar_dates_are_the_same_times(tmp_path):
    dates = pos(tmp_path / "a.pos", "GPST", *(f"2025/05/14 09:30:{s}.000 48.0 9.0 600.0 1" for s in (16, 17)))
    weeks = pos(tmp_path / "b.pos", "GPST", *(f"2366 {293400 + s}.000 48.0 9.0 600.0 1" for s in (16, 17)))
    np.testing.assert_array_equal(dates.time.values, weeks.time.values)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2025/05/14 09:30:16.0 48.0 9.0 600.0\n", "no header line"),
        ("% (lat/lon/height=WGS84/geodetic)\n% GPST latitude(deg)\n", "above a geoid"),
        ("% JST latitude(deg)\n", "'JST'"),
        (HEADER.format("GPST") + "2025/05/14 09:30:16.0 48.0 north 600.0\n", "line 3"),
        (HEADER.format("GPST") + "2015/05/14 09:30:16.0 48.0 9.0 600.0\n" * 2, "leap second"),
    ],
)
def test_a_solution_that_does_not_say_what_it_holds_is_refused(tmp_path, text, expected):
    (tmp_path / "a.pos").write_text(text)
    with pytest.raises(CampaignError, match=expected):
        read_track(tmp_path / "a.pos", node="a")


def test_a_csv_log_keeps_position_and_attitude(tmp_path):
    path = tmp_path / "a.track.csv"
    path.write_text(
        "time_utc,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,yaw_deg\n"
        "2025-05-14T09:30:00Z,48.0,9.0,600.0,1,2,359\n2025-05-14T09:30:01.5Z,48.0,9.0,601.0,1,2,1\n"
    )
    track = check(read_track(path, node="a"), "track")
    np.testing.assert_allclose(geodetic_from_ecef(track.position.values[1]), [48.0, 9.0, 601.0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(track.attitude.values[0]), [1, 2, 359])
    assert track.time.values[1] - track.time.values[0] == np.timedelta64(1500, "ms")


def test_a_csv_log_without_a_column_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("time_utc,latitude_deg,longitude_deg\n2025-05-14T09:30:00Z,48,9\n")
    with pytest.raises(CampaignError, match="no column height_m"):
        read_track(tmp_path / "a.csv", node="a")


def raw_of(*files):
    opened = open_recording(files)
    opened.check_hash()
    return opened.cut(opened.captures, node="a")


def recording(folder, samples, captures, **header):
    data = folder / "a.sigmf-data"
    samples.astype("<i2").tofile(data)
    meta = {
        "global": {
            "core:datatype": "ci16_le",
            "core:sample_rate": 1e6,
            "core:version": "1.2.5",
            "core:num_channels": samples.shape[1],
            "core:sha512": hashlib.sha512(data.read_bytes()).hexdigest(),
            "core:extensions": [{"name": "apertura", "version": "0.1.0", "optional": True}],
            **header,
        },
        "captures": captures,
        "annotations": [],
    }
    (folder / "a.sigmf-meta").write_text(json.dumps(meta))
    return raw_of(folder / "a.sigmf-meta", data)


def capture(start, second, **more):
    return {"core:sample_start": start, "core:frequency": 1e9, "core:datetime": f"2025-01-01T00:00:0{second}Z", **more}


def test_channels_are_interleaved_per_sample_and_captures_become_pulses(tmp_path):
    samples = np.arange(1, 41).reshape(10, 2, 2)
    raw = recording(
        tmp_path,
        samples,
        [capture(0, 0, **{"apertura:frame": 7}), capture(5, 1)],
        **{"apertura:channels": ["sidelink", "radar"]},
    )
    check(raw, "raw")
    np.testing.assert_array_equal(raw.iq.values[1, 1], samples[5:, 1])
    assert raw.attrs["channels"] == ["sidelink", "radar"]
    assert raw.frame.values.tolist() == [7, -1]
    assert raw.attrs["frequency_hz"] == 1e9


def test_time_tags_that_run_backwards_are_refused(tmp_path):
    with pytest.raises(CampaignError, match="capture 1 is tagged"):
        recording(tmp_path, np.ones((10, 1, 2)), [capture(0, 5), capture(5, 1)], **{"apertura:channels": ["radar"]})


def test_another_datatype_is_refused(shared, tmp_path):
    with pytest.raises(CampaignError, match="cf32_le"):
        recording(tmp_path, np.ones((10, 1, 2)), [capture(0, 0)], **{"core:datatype": "cf32_le"})


def test_a_real_recording_of_another_maker_is_read(shared):
    folder = shared / "sigmf_nbiot"
    names = [folder / f"V16-beacon-NB-IoT-uplink.sigmf-{kind}" for kind in ("meta", "data")]
    raw = check(raw_of(*names), "raw")
    assert raw.iq.shape == (1, 1, 512000, 2)
    assert raw.attrs["sample_rate_hz"] == 640000


def test_gotcha_delays_are_referred_to_the_scene_centre(shared):
    """The antenna's distance to the scene centre is r0, so an echo from there has no phase left."""
    files = sorted((shared / "gotcha_afrl").glob("*.mat"))
    echo = check(read_phase_history("afrl_mat", files, pair="a-a"), "echo")
    assert echo.transfer.shape == (234, 424)
    distance = np.linalg.norm(echo.tx_position.values, axis=1)
    np.testing.assert_allclose(echo.reference_delay.values * SPEED_OF_LIGHT_M_S / 2, distance, atol=2e-3)
    assert echo.attrs["frame"] == "local"
