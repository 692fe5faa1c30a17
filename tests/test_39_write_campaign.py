"""ap.write_campaign: data are read back unchanged, errors are reported, and no partial files remain."""

from dataclasses import replace

import numpy as np
import pytest
import sigmf
from folders import complaint, contents
from hypothesis import given
from hypothesis import strategies as st
from properties import tried

import apertura as ap
from apertura.campaign.folder import Campaign
from apertura.core.geometry.geodesy import geodetic_from_ecef
from apertura.formats.reading import open_recording
from apertura.stages.node_log import read_log

WAVEFORM = {
    "kind": "ofdm",
    "carrier_hz": 1.2e9,
    "subcarriers": 8,
    "subcarrier_spacing_hz": 1e6,
    "symbol_s": 1e-6,
    "cyclic_prefix_s": 0.5e-6,
    "sample_rate_hz": 16e6,
    "prf_hz": 1.0,
}
CONFIG = {"campaign": "c", "waveform": WAVEFORM, "nodes": {"uav1": {}, "uav2": {}}}
CODES = np.ones(8)
TAGS = ["2025-05-14T09:30:01", "2025-05-14T09:30:02.5", "2025-05-14T09:30:04"]
NODE = ap.RecordedNode(
    samples=np.arange(1, 3 * 24 * 2 + 1).reshape(3, 24, 1, 2).astype(np.int16),
    time_utc=TAGS,
    track=np.array([[48.0, 9.0, 600.0], [48.0, 9.001, 601.0]]),
    track_utc=["2025-05-14T09:30:00", "2025-05-14T09:30:09"],
)


def write(folder, node=NODE, *, config=CONFIG, codes=CODES, **flight):
    lines = {"transmitter": "uav1", "nodes": {"uav1": node}, **flight}
    return ap.write_campaign(folder, config, {"f01": ap.RecordedFlight(**lines)}, sent=codes)


def opened(folder):
    campaign = Campaign.load(folder)
    return open_recording(campaign.recording_files("f01", "uav1")), read_log(campaign, "f01", "uav1")


@pytest.mark.parametrize("dtype", ["int8", "int16", "int32", "float32", ">i2"])
def test_samples_of_any_dtype_read_back_with_tags_frames_and_positions(tmp_path, dtype):
    samples = (NODE.samples % 100).astype(dtype)
    attitude = np.array([[1.0, 2.0, 359.0], [-1.0, -2.0, 1.0]])
    root = write(tmp_path / "c", replace(NODE, samples=samples, frame=[7, 8, 10], attitude_deg=attitude))
    recording, track = opened(root)
    np.testing.assert_array_equal(recording.samples.captures(recording.captures.start, 24), samples)
    np.testing.assert_array_equal(recording.captures.time, np.array(TAGS, "datetime64[ns]"))
    assert recording.captures.frame.tolist() == [7, 8, 10]
    np.testing.assert_allclose(geodetic_from_ecef(track.position.values), NODE.track, atol=1e-5)
    np.testing.assert_allclose(np.degrees(track.attitude.values), attitude, atol=1e-4)
    sigmf.fromfile(str(root / "raw/f01/uav1")).validate()


def along(latitude, longitude, speed_m_s, unit=np.degrees):
    """Return a node with a log of one epoch per second along a meridian, in degrees or radians."""
    north = np.radians(latitude) + speed_m_s * np.arange(10) / 6.37e6
    track = np.stack([unit(north), unit(np.full(10, np.radians(longitude))), np.full(10, 600.0)], -1)
    return replace(NODE, track=track, track_utc=np.datetime64("2025-05-14T09:30", "ns") + np.arange(10) * 10**9)


NEAR = {"crs": "EPSG:32632", "bounds_m": [574000, 5317000, 574010, 5317010], "height_m": 500.0}  # at 48 N, 10 E
GULF = {"crs": "EPSG:32631", "bounds_m": [184000, 92000, 184010, 92010], "height_m": 0.0}  # at 0.83 N, 0.16 E


@pytest.mark.parametrize("scene", [None, NEAR])
def test_track_in_radians_is_refused(tmp_path, scene):
    config = CONFIG | ({"scene": scene} if scene else {})
    message = complaint(lambda: write(tmp_path / "c", along(48.0, 10.0, 8.0, np.float64), config=config))
    assert "apparently in radians: read as radians, the" in message
    assert "expected degrees" in message
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(("speed_m_s", "scene"), [(8.0, None), (8.0, GULF), (0.4, GULF)])
def test_track_in_degrees_near_latitude_and_longitude_zero_is_accepted(tmp_path, speed_m_s, scene):
    config = CONFIG | ({"scene": scene} if scene else {})
    assert write(tmp_path / "c", along(0.83, 0.16, speed_m_s), config=config).is_dir()


@pytest.mark.slow
@tried(20)
@given(gaps=st.lists(st.integers(1, 10**12), min_size=1, max_size=9), between=st.integers(0, 5))
def test_captures_with_any_gaps_read_back_to_the_nanosecond(tmp_path_factory, gaps, between):
    time = np.datetime64("2025-05-14T09:30:00", "ns") + np.cumsum(gaps).astype("timedelta64[ns]")
    start = np.arange(len(gaps)) * (24 + between)
    samples = np.random.default_rng(1).integers(1, 99, (start[-1] + 24 + between, 1, 2), dtype=np.int16)
    node = replace(NODE, samples=samples, time_utc=time, start=start)
    recording, _ = opened(write(tmp_path_factory.mktemp("written") / "c", node))
    np.testing.assert_array_equal(recording.captures.time, time)
    np.testing.assert_array_equal(recording.captures.start, start)
    np.testing.assert_array_equal(recording.samples.read(0, len(samples)), samples)


def test_samples_and_logs_are_accepted_as_files(tmp_path):
    np.save(tmp_path / "iq.npy", NODE.samples)
    NODE.samples.astype("<i2").tofile(tmp_path / "iq.bin")
    (tmp_path / "log.csv").write_text(
        "time_utc,latitude_deg,longitude_deg,height_m\n2025-05-14T09:30:00Z,48,9,600\n2025-05-14T09:30:09Z,48,9,601\n"
    )
    for name in ("iq.npy", "iq.bin"):
        given_files = replace(NODE, samples=tmp_path / name, track=tmp_path / "log.csv", track_utc=None)
        recording, track = opened(write(tmp_path / f"of_{name}", given_files))
        np.testing.assert_array_equal(recording.samples.captures(recording.captures.start, 24), NODE.samples)
        assert track.sizes["epoch"] == 2


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"samples": NODE.samples.astype(np.float64)}, "samples of float64, shape (3, 24, 1, 2); expected (sample, 1"),
        ({"samples": NODE.samples[:, :, 0]}, "samples of int16, shape (3, 24, 2)"),
        ({"channels": ("radar", "sidelink")}, "expected (sample, 2, 2) or (capture, sample, 2, 2)"),
        ({"samples": np.zeros_like(NODE.samples)}, "3 captures of channel radar contain only zeros"),
        ({"samples": "nowhere.iq"}, "nowhere.iq: no such file"),
        ({"samples": NODE.samples.reshape(-1, 1, 2)[:-1]}, "71 samples, 3 captures; expected captures of equal length"),
        ({"time_utc": TAGS[:2]}, "2 time tags, 3 starts and 2 frame numbers"),
        ({"time_utc": TAGS[::-1]}, "capture 1 has time tag 2025-05-14T09:30:02.5"),
        ({"time_utc": ["yesterday"] * 3}, "time_utc: 'yesterday' is not a time"),
        ({"time_utc": [f"{tag}+02:00" for tag in TAGS]}, "time_utc: '2025-05-14T09:30:01+02:00' is not a time"),
        ({"time_utc": np.array(["3025-05-14"] * 3, "datetime64[s]")}, "is not between 1980 and 2199"),
        ({"start": [0, 24, 480]}, "capture 2 starts at sample 480, the data end at 72"),
        ({"frame": [1, 2]}, "and 2 frame numbers"),
        ({"frame": [1, 2, -7]}, "captures.2.apertura:frame"),
        ({"track": NODE.track[:, :2]}, "track of shape (2, 2); expected shape (2, 3)"),
        ({"track": NODE.track * np.nan}, "0 epochs (2 excluded: no fix)"),
        ({"track_utc": NODE.track_utc[::-1]}, "is before that of the previous epoch"),
        ({"track": "nowhere.pos"}, "nowhere.pos: no such file"),
        ({"attitude_deg": np.ones((3, 3))}, "attitude_deg of shape (3, 3)"),
        ({"channels": ("sidelink",)}, "apertura:channels ['sidelink']"),
    ],
)  # fmt: skip
def test_invalid_recording_is_refused_and_leaves_no_file(tmp_path, change, expected):
    message = complaint(lambda: write(tmp_path / "c", replace(NODE, **change)))
    assert expected in message
    assert ".wip" not in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"config": CONFIG | {"scen": {}}}, "write_campaign: config: scen: unknown key (did you mean 'scene'?)"),
        ({"config": CONFIG | {"waveform": WAVEFORM | {"prf_hz": "fast"}}}, "waveform.prf_hz"),
        ({"codes": np.ones(7)}, "raw/codes.npy: complex64 of shape (7,)"),
        ({"codes": None}, "raw/codes.npy: no such file"),
        ({"transmitter": "uav3"}, "node 'uav3' is not in config/config.yaml: nodes"),
        ({"transmitter": "uav2"}, "uav2.sigmf-meta: no such file"),
        ({"kind": "picture"}, "unknown kind 'picture', not one of bench, calibration, image"),
        (
            {"config": CONFIG | {"waveform": {"kind": "phase_history", "format": "afrl_mat"}}},
            "waveform.kind phase_history; expected a waveform that is recorded as samples",
        ),
        ({"config": CONFIG | {"waveform": WAVEFORM | {"codes": "../codes.npy"}}}, "leads out of the campaign folder"),
    ],
)
def test_invalid_config_or_flight_is_refused_and_leaves_no_file(tmp_path, change, expected):
    message = complaint(lambda: write(tmp_path / "c", **change))
    assert expected in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["../f01", "fused", "f 01", ""])
def test_flight_name_outside_the_folder_is_refused(tmp_path, name):
    flights = {name: ap.RecordedFlight("uav1", {"uav1": NODE})}
    complaint(lambda: ap.write_campaign(tmp_path / "c", CONFIG, flights, sent=np.ones(8)))
    assert list(tmp_path.iterdir()) == []


def test_existing_campaign_is_not_overwritten(tmp_path):
    root = write(tmp_path / "c")
    before = contents(root)
    assert "already exists and is not an empty folder" in complaint(lambda: write(tmp_path / "c"))
    assert contents(root) == before
