"""Invalid campaign folders: each error is one message with cause, location, expected value and remedy."""

import hashlib
import json

import numpy as np
import pytest
from folders import complaint, edit_config, edit_data, edit_meta, edit_track, require_files

from apertura.campaign.folder import Campaign
from apertura.formats.recordings.sample_file import SampleFile
from apertura.run.process import process
from apertura.stages import echo, ingest, profile, scene
from apertura.stages.pair import open_pair


def no_later_stage_finished(root):
    """Return True if only the stages raw and track are finished and no product exists."""
    results = root / "results"
    manifests = {path.name for path in results.rglob("*.manifest.json")}
    return manifests <= {"raw.manifest.json", "track.manifest.json"} and not list(results.rglob("*.tif"))


def test_misspelt_key_is_reported_with_the_nearest_valid_one(tiny):
    edit_config(tiny, lambda document: document["scene"].update(spacing=0.1))
    message = complaint(lambda: Campaign.load(tiny))
    assert "config.yaml" in message
    assert "scene.spacing: unknown key (did you mean 'spacing_m'?)" in message


def test_value_of_wrong_type_is_reported(tiny):
    edit_config(tiny, lambda document: document["waveform"].update(prf_hz="fast"))
    message = complaint(lambda: Campaign.load(tiny))
    assert "waveform.prf_hz" in message
    assert "'fast'" in message


def test_missing_node_file_is_reported(tiny):
    (tiny / "raw" / "f01" / "uav2.sigmf-data").unlink()
    message = complaint(lambda: require_files(Campaign.load(tiny)))
    assert "raw/f01/uav2.sigmf-data" in message
    assert "node uav2" in message


def test_truncated_samples_are_reported(tiny):
    path = tiny / "raw" / "f01" / "uav1.sigmf-data"
    path.write_bytes(path.read_bytes()[:-4000])
    message = complaint(lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav1"))
    assert "contains 3000 samples" in message
    assert "expected 4000" in message
    assert no_later_stage_finished(tiny)


def test_file_truncated_within_a_sample_is_reported(tiny):
    path = tiny / "raw" / "f01" / "uav2.sigmf-data"
    path.write_bytes(path.read_bytes()[:-3])
    assert "truncated" in complaint(lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav2"))


def test_wrong_hash_is_reported_with_the_expected_one(tiny):
    path = tiny / "raw" / "f01" / "uav1.sigmf-data"
    samples = bytearray(path.read_bytes())
    samples[1000] ^= 1
    path.write_bytes(samples)
    message = complaint(lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav1"))
    assert "uav1.sigmf-data" in message
    assert hashlib.sha512(samples).hexdigest()[:12] in message


def test_capture_past_the_end_is_reported(tiny):
    edit_meta(tiny, "uav1", lambda meta: meta["captures"][-1].update({"core:sample_start": 10**9}))
    message = complaint(lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav1"))
    assert "starts at sample 1000000000" in message
    assert "uav1.sigmf-meta" in message


def test_track_that_ends_early_is_reported_with_the_seconds(tiny):
    edit_track(tiny, "uav1", lambda lines: lines[:25])
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    message = complaint(lambda: echo.echo(campaign, "f01", "uav1-uav1"))
    last = np.datetime64(next((tiny / "raw/f01").glob("uav1.track.csv")).read_text().splitlines()[-1][:23])
    meta = json.loads((tiny / "raw/f01/uav1.sigmf-meta").read_text())
    missing = np.datetime64(meta["captures"][-1]["core:datetime"][:23]) - last
    assert f"ends {missing / np.timedelta64(1, 's'):.3f} s before the last" in message
    assert no_later_stage_finished(tiny)


def test_gpst_log_taken_for_utc_is_reported_with_18_seconds(tiny):
    edit_track(tiny, "uav2", lambda lines: [line.replace("GPST", "UTC ") for line in lines])
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    message = complaint(lambda: echo.echo(campaign, "f01", "uav1-uav2"))
    assert "starts 1" in message
    assert "GPST is 18 s ahead" in message


def test_duplicate_epoch_is_reported(tiny):
    edit_track(tiny, "uav1", lambda lines: [*lines[:10], lines[9], *lines[10:]])
    message = complaint(lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav1"))
    assert "epoch 9" in message
    assert "is equal to that of the previous epoch" in message


def test_unsorted_log_is_reported(tiny):
    edit_track(tiny, "uav1", lambda lines: [*lines[:10], *lines[12:14], *lines[10:12]])
    assert "is before that of the previous epoch" in complaint(
        lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav1")
    )


def test_lever_arm_without_attitude_is_refused(tiny):
    edit_config(tiny, lambda document: document["nodes"]["uav1"].update(attitude="none"))
    message = complaint(lambda: Campaign.load(tiny))
    assert "nodes.uav1" in message
    assert "attitude is none" in message


def test_lever_arm_with_a_log_without_attitude_is_refused(tiny):
    edit_config(tiny, lambda document: document["nodes"]["uav1"].update(attitude="log"))
    edit_track(tiny, "uav1", lambda lines: [",".join(line.split(",")[:4]) for line in lines])
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    message = complaint(lambda: echo.echo(campaign, "f01", "uav1-uav1"))
    assert "the attitude is unknown" in message
    assert message.startswith("raw/f01/uav1.track.csv")


def test_wrong_carrier_is_reported_with_the_recording(tiny):
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    edit_config(tiny, lambda document: document["waveform"].update(carrier_hz=1.3e9))
    message = complaint(lambda: echo.echo(Campaign.load(tiny), "f01", "uav1-uav1"))
    assert message.startswith("raw/f01/uav1.sigmf-data and raw/f01/uav1.sigmf-meta: recorded with carrier_hz")
    for stem in message.split(": ")[0].split(" and "):
        assert (tiny / stem).is_file()


BEAM = {"boresight_deg": [90, -20], "beamwidth_deg": [40, 60]}


def with_antenna(antenna, node="uav1"):
    return lambda document: document["nodes"][node].update(antennas={"radar_rx": antenna})


def test_beam_without_attitude_is_refused(tiny):
    edit_config(tiny, with_antenna(BEAM, "uav2"))
    message = complaint(lambda: Campaign.load(tiny))
    assert "nodes.uav2: antennas has a beam, but attitude is none" in message
    assert "set attitude to log or course" in message


def test_beam_with_a_log_without_attitude_is_refused(tiny):
    zero = {"radar_tx": [0, 0, 0], "radar_rx": [0, 0, 0], "sidelink": [0, 0, 0]}
    edit_config(tiny, with_antenna(BEAM))
    edit_config(tiny, lambda document: document["nodes"]["uav1"].update(lever_arms_m=zero))
    edit_track(tiny, "uav1", lambda lines: [",".join(line.split(",")[:4]) for line in lines])
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    message = complaint(lambda: echo.echo(campaign, "f01", "uav1-uav1"))
    assert "an antenna beam is configured, but the attitude is unknown (attitude: log)" in message


@pytest.mark.parametrize(
    ("antenna", "expected"),
    [
        ({"beamwidth_deg": [40, 60]}, "nodes.uav1.antennas.radar_rx.boresight_deg: missing"),
        (
            BEAM | {"boresight_deg": [90, -120]},
            "radar_rx.boresight_deg.1: Input should be greater than or equal to -90",
        ),
        (BEAM | {"beamwidth_deg": [40, 0]}, "radar_rx.beamwidth_deg.1: Input should be greater than 0"),
        (BEAM | {"pattern": "p.csv"}, "radar_rx: state either beamwidth_deg, [azimuth, elevation], or pattern"),
        ({"boresight_deg": [90, 0]}, "radar_rx: state either beamwidth_deg, [azimuth, elevation], or pattern"),
        (BEAM | {"cutoff_db": 20}, "radar_rx.cutoff_db: Input should be less than or equal to -3 (found 20)"),
        (BEAM | {"cutof_db": -20}, "radar_rx.cutof_db: unknown key (did you mean 'cutoff_db'?)"),
    ],
)
def test_invalid_antenna_is_reported(tiny, antenna, expected):
    edit_config(tiny, with_antenna(antenna))
    assert expected in complaint(lambda: Campaign.load(tiny))


def test_missing_pattern_is_reported_with_its_key(tiny):
    edit_config(tiny, with_antenna({"boresight_deg": [90, -20], "pattern": "config/horn.csv"}))
    message = complaint(lambda: require_files(Campaign.load(tiny)))
    assert "config/horn.csv: no such file" in message
    assert "nodes.uav1.antennas.radar_rx.pattern" in message


def test_phase_history_has_no_attitude_for_a_beam(tiny):
    waveform = {"kind": "phase_history", "format": "afrl_mat"}
    edit_config(tiny, with_antenna(BEAM))
    edit_config(tiny, lambda document: document.update(waveform=waveform))
    assert "nodes.uav1.antennas has a beam, but phase histories contain no attitude" in complaint(
        lambda: Campaign.load(tiny)
    )


@pytest.mark.parametrize("west", [5e6, 1e9])
@pytest.mark.filterwarnings("error")
def test_bounds_outside_the_area_of_use_are_refused(tiny, west):
    edit_config(tiny, lambda document: document["scene"].update(bounds_m=[west, 0.0, west + 6.0, 6.0]))
    message = complaint(lambda: scene.scene(Campaign.load(tiny)))
    assert "area of use of WGS 84 / UTM zone 32N" in message


def test_nearest_bounds_in_multiples_of_the_spacing_are_proposed(tiny):
    edit_config(tiny, lambda document: document["scene"].update(bounds_m=[570658.3, 5363704.2, 570664.34, 5363710.2]))
    message = complaint(lambda: Campaign.load(tiny))
    assert "[570658.3, 5363704.2, 570664.3, 5363710.2]" in message


def test_value_outside_all_alternatives_is_reported_by_its_key(tiny):
    edit_config(tiny, lambda document: document.setdefault("processing", {}).update(presum=0))
    message = complaint(lambda: Campaign.load(tiny))
    assert (
        "processing.presum: Input should be greater than or equal to 1 (found 0) or Input should be 'auto'" in message
    )


@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        ({"generator": "pn", "polynomial": [23, 18], "seed": 0}, "seed: Input should be greater than or equal to 1"),
        ({"generator": "pn", "polynomal": [23, 18]}, "polynomal: unknown key (did you mean 'polynomial'?)"),
        ({"source": "sidelink"}, "constellation: missing"),
        ({"source": "sidelnk", "constellation": "qpsk"}, "source: Input should be 'sidelink' (found 'sidelnk')"),
        (
            {"source": "sidelink", "constellation": "qpsk", "frame": {"counter_bits": 0}},
            "frame.counter_bits: Input should be greater than or equal to 1 (found 0)",
        ),
    ],
)
def test_wrong_part_of_an_alternative_is_reported_without_the_other_alternatives(tiny, codes, expected):
    edit_config(tiny, lambda document: document["waveform"].update(codes=codes))
    message = complaint(lambda: Campaign.load(tiny))
    assert f"waveform.codes.{expected}" in message
    assert not any(other in message for other in ("valid string", "generator", " or Input", "Codes"))


def test_value_of_no_alternative_is_reported_with_all_of_them(tiny):
    edit_config(tiny, lambda document: document["waveform"].update(codes=5))
    message = complaint(lambda: Campaign.load(tiny))
    expected = "waveform.codes: Input should be a valid string (found 5) or Input should be a valid mapping (found 5)"
    assert expected in message


def test_swapped_bounds_are_refused_with_sorted_bounds(tiny):
    edit_config(tiny, lambda document: document["scene"].update(bounds_m=[570664.3, 5363704.2, 570658.3, 5363710.2]))
    assert "sorted: [570658.3, 5363704.2, 570664.3, 5363710.2]" in complaint(lambda: Campaign.load(tiny))


def test_capture_of_zeros_is_reported(tiny):
    edit_data(tiny, "uav1", lambda samples: samples.reshape(-1, 8000)[5].fill(0))
    message = complaint(lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav1"))
    assert "first capture 5" in message
    assert "only zeros" in message


def test_nan_in_phase_history_is_reported(shared, tmp_path):
    from scipy.io import loadmat, savemat

    from apertura.formats.reading import read_phase_history

    source = loadmat(shared / "gotcha_afrl" / "data_3dsar_pass1_az001_HH.mat")
    source["data"]["fp"][0, 0][3, 7] = np.nan
    savemat(tmp_path / "a.mat", {"data": source["data"]})
    message = complaint(lambda: read_phase_history("afrl_mat", [tmp_path / "a.mat"], pair="a-a"))
    assert "fp is not a number at index [3, 7]" in message
    assert "a.mat" in message


def test_nan_position_is_reported(tiny):
    edit_track(tiny, "uav1", lambda lines: [*lines[:6], lines[6].replace("48.4", "nan", 1), *lines[7:]])
    message = complaint(lambda: ingest.ingest(Campaign.load(tiny), "f01", "uav1"))
    assert "uav1.track.csv" in message


def test_scene_beyond_the_cyclic_prefix_is_refused_with_its_shortest_path(tiny):
    edit_config(tiny, lambda document: document["waveform"].update(cyclic_prefix_s=20 / 1.024e9))
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    echo.echo(campaign, "f01", "uav1-uav1")
    scene.scene(campaign)
    message = complaint(lambda: profile.profile(campaign, "f01", "uav1-uav1"))
    assert "after the cyclic prefix at 40 pulses; shortest total path" in message
    assert not (tiny / "results/f01/uav1-uav1/profile.manifest.json").exists()


@pytest.mark.slow
def test_path_offset_can_move_echoes_beyond_the_prefix(tiny):
    edit_config(tiny, lambda document: document["nodes"]["uav1"]["path_offset_m"].update(radar=230.0))
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    echo.echo(campaign, "f01", "uav1-uav1")
    scene.scene(campaign)
    assert "cyclic prefix" in complaint(lambda: profile.profile(campaign, "f01", "uav1-uav1"))


def test_codes_of_the_wrong_length_are_refused(tiny):
    np.save(tiny / "raw" / "codes.npy", np.ones(1000, np.complex64))
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    message = complaint(lambda: echo.echo(campaign, "f01", "uav1-uav1"))
    assert "raw/codes.npy" in message
    assert "(1000,)" in message
    assert "(1024,)" in message


def test_nodes_without_common_pulses_are_refused(tiny):
    def an_hour_later(meta):
        for capture in meta["captures"]:
            capture["core:datetime"] = capture["core:datetime"].replace("T09", "T10")

    edit_meta(tiny, "uav2", an_hour_later)
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    message = complaint(lambda: echo.echo(campaign, "f01", "uav1-uav2"))
    assert "half a repetition interval" in message
    assert "uav2" in message


def test_secondary_without_sidelink_is_refused(tiny):
    edit_meta(tiny, "uav2", lambda meta: meta["global"].update({"apertura:channels": ["radar", "spare"]}))
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    message = complaint(lambda: echo.echo(campaign, "f01", "uav1-uav2"))
    assert "a channel named 'sidelink'" in message


def test_node_with_another_sample_rate_is_refused(tiny):
    edit_config(tiny, lambda document: document["waveform"].update(sample_rate_hz=512e6))
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    assert "sample_rate_hz" in complaint(lambda: echo.echo(campaign, "f01", "uav1-uav1"))


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("f-1\timage\tuav1\tuav1", "only letters, digits"),
        ("fused\timage\tuav1\tuav1", "reserved for files in the results folder"),
        ("f02\tphoto\tuav1\tuav1", "not one of bench, calibration, image"),
        ("f02\timage\tuav9\tuav1", "'uav9' is not in"),
        ("f01\timage\tuav1\tuav1", "a second line for flight f01"),
    ],
)
def test_invalid_line_of_flights_is_reported(tiny, line, expected):
    path = tiny / "config" / "flights.tsv"
    path.write_text(path.read_text().rstrip("\n") + "\n" + line + "\n")
    message = complaint(lambda: Campaign.load(tiny))
    assert "flights.tsv: line 3" in message
    assert expected in message


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("f09\tuav1-uav1\t2025-05-14T09:30:00\t2025-05-14T09:30:01", "flight 'f09' is not in"),
        ("f01\tuav2-uav1\t2025-05-14T09:30:00\t2025-05-14T09:30:01", "no pair 'uav2-uav1'"),
        ("f01\tuav1-uav1\t2025-05-14T09:30:01\t2025-05-14T09:30:01Z", "is not before end"),
        ("f01\tuav1-uav1\tnoon\t2025-05-14T09:30:01", "start 'noon' is not a valid time"),
        ("f01\tuav1-uav1\t2025-05-14T09:30:01", "end '' is not a valid time"),
    ],
)
def test_invalid_line_of_segments_is_reported(tiny, line, expected):
    (tiny / "config" / "segments.tsv").write_text(f"flight\tpair\tstart\tend\n{line}\n")
    message = complaint(lambda: Campaign.load(tiny))
    assert "segments.tsv: line 2" in message
    assert expected in message


def test_segments_without_pulses_are_reported_with_recorded_times(tiny):
    line = "f01\tuav1-uav1\t2025-05-14T10:30:00\t2025-05-14T10:30:01"
    (tiny / "config" / "segments.tsv").write_text(f"flight\tpair\tstart\tend\n{line}\n")
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    for read in (echo.echo, open_pair):
        message = complaint(lambda read=read: read(campaign, "f01", "uav1-uav1"))
        assert "no pulse of flight f01, pair uav1-uav1 within 2025-05-14T10:30:00" in message
        assert "segments.tsv" in message
        assert "between 2025-05-14T09:30:00" in message
    assert no_later_stage_finished(tiny)


def test_recording_changed_since_ingestion_is_refused(tiny):
    """The raw stage refers to the file of the recorder by its hash; samples are not copied."""
    campaign = Campaign.load(tiny)
    process(campaign, last="ingest")
    stage = tiny / "results/f01/uav1/raw.zarr"
    stage_bytes = sum(path.stat().st_size for path in stage.rglob("*") if path.is_file())
    assert stage_bytes < 20_000 < (tiny / "raw/f01/uav1.sigmf-data").stat().st_size
    edit_data(tiny, "uav1", lambda iq: iq.sort())
    message = complaint(lambda: echo.echo(campaign, "f01", "uav1-uav1"))
    assert "raw/f01/uav1.sigmf-data: the file has changed since it was ingested" in message
    assert not list((tiny / "results").rglob("echo*"))


def test_recording_truncated_while_read_is_an_error(tiny):
    file = SampleFile(tiny / "raw/f01/uav1.sigmf-data", channels=1)
    whole = len(file)
    file.read(whole - 5, whole)
    with file.path.open("r+b") as stream:
        stream.truncate(4 * (whole - 2))
    message = complaint(lambda: file.read(whole - 5, whole))
    assert f"uav1.sigmf-data: the file ends at sample {whole - 2}, truncated while it was read" in message
