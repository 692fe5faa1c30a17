"""Before anything runs: every problem of a campaign folder at once, from headers alone."""

import io
import os
import re
import subprocess
import sys
import time

import numpy as np
import pytest
from folders import ROOT, edit_config, edit_data, edit_meta

from apertura.campaign.folder import Campaign
from apertura.check import CHECKS, as_line, assumptions, print_findings, print_problems, problems
from apertura.check.examination import Examination
from apertura.check.recordings import odd_interval_s
from apertura.simulation import PRESETS, preset, simulate

EVERY_SECOND = np.timedelta64(50, "ms") * np.arange(0, 80, 2)
START = np.datetime64("2025-05-14T09:30", "ns")


def reported(root, **options):
    return [as_line(problem).replace(f"{root}/", "") for problem in problems(root, **options)]


def only(root):
    """The one problem there is."""
    lines = reported(root)
    assert len(lines) == 1, lines
    return lines[0]


def retag(shift, node="uav2"):
    """Move the time tags of a node."""

    def change(meta):
        for capture in meta["captures"]:
            time = np.datetime64(capture["core:datetime"].rstrip("Z"), "ns") + shift
            capture["core:datetime"] = f"{time}Z"

    return lambda root: edit_meta(root, node, change)


def renumber(first, node):
    """Give the captures of a node frame numbers from `first` on."""

    def change(meta):
        for number, capture in enumerate(meta["captures"]):
            capture["apertura:frame"] = first + number

    return lambda root: edit_meta(root, node, change)


@pytest.mark.quick("continuous", "flight")
@pytest.mark.parametrize("name", list(PRESETS))
def test_every_preset_is_without_problems(tmp_path, name):
    short = simulate(tmp_path / "campaign", preset(name, pulses=8))
    whole = ["segments", "imaging"] if (short / "config/segments.tsv").is_file() else []
    assert reported(short, without=whole) == []  # segments are of the whole flight


def test_the_sample_is_without_problems(shared):
    assert reported(shared / "campaign-sample", without=["results"]) == []


def test_problems_of_every_kind_are_reported_at_once(tiny):
    (tiny / "raw/f01/uav2.sigmf-data").unlink()
    np.save(tiny / "raw/codes.npy", np.ones(5, np.complex64))
    edit_config(tiny, lambda document: document["scene"].update(crs="EPSG:4326"))
    edit_meta(tiny, "uav1", lambda meta: meta["global"].update({"core:sample_rate": 1.0e9}))
    lines = reported(tiny)
    for beginning in (
        "raw/f01/uav2.sigmf-data: no such file",
        "raw/codes.npy: complex64 of shape (5,)",
        "config/config.yaml: scene.crs: EPSG:4326",
        "raw/f01/uav1.sigmf-meta: recorded with sample_rate_hz 1000000000.000000; expected 1024000000.000000",
    ):
        assert sum(line.startswith(beginning) for line in lines) == 1, beginning
    assert len(lines) == 4


def test_config_flights_and_segments_are_reported_of_together(tiny):
    edit_config(tiny, lambda document: document["scene"].update(spacing=0.1))
    (tiny / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\tpicture\tuav1\tuav1\n")
    (tiny / "config/segments.tsv").write_text("flight\tpair\tstart\tend\nf01\tuav1-uav9\t2025-05-14\t2025-05-15\n")
    config, flights, segments = reported(tiny)
    assert "scene.spacing: unknown key (did you mean 'spacing_m'?)" in config
    assert "unknown kind 'picture', not one of bench, calibration, image" in flights
    assert "flight f01 has no pair 'uav1-uav9'" in segments


def test_a_flight_is_not_unknown_to_segments_because_its_own_line_is_wrong(tiny):
    (tiny / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\tpicture\tuav1\tuav1\n")
    (tiny / "config/segments.tsv").write_text("flight\tpair\tstart\tend\nf01\tuav1-uav1\t2025-05-14\t2025-05-15\n")
    assert "picture" in only(tiny)


def test_a_folder_that_is_not_there_is_one_problem(tmp_path):
    assert "no such folder" in only(tmp_path / "nowhere")


def test_each_line_is_one_problem_and_they_are_counted(tiny):
    edit_meta(tiny, "uav1", lambda meta: meta["global"].update({"core:sample_rate": 1.0e9}))
    edit_meta(tiny, "uav2", lambda meta: meta["global"].update({"apertura:channels": ["radar", "side\nlink"]}))
    printed = io.StringIO()
    assert print_problems(tiny, stream=printed) == len(printed.getvalue().splitlines()) == 2


def test_a_check_that_is_left_out_tells_nothing(tiny):
    (tiny / "raw/codes.npy").unlink()
    assert reported(tiny, without=["files", "imaging"]) == []


def test_an_exception_of_a_check_is_a_defect_and_not_a_problem(tiny, monkeypatch):
    monkeypatch.setitem(CHECKS, "broken", "builtins:int")
    with pytest.raises(TypeError):
        problems(tiny)


def test_samples_are_not_read(tiny):
    edit_data(tiny, "uav1", lambda samples: samples.fill(0))  # ingest refuses captures of zeros
    assert reported(tiny) == []


@pytest.mark.slow
def test_no_library_is_imported_that_headers_do_not_need(tiny):
    heavy = ("zarr", "matplotlib", "scipy.io", "rasterio", "snakemake", "jsonschema")
    code = f"import sys; from apertura.check import problems; assert problems({str(tiny)!r}) == []"
    code += "; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert sorted(set(heavy) & set(done.stdout.split())) == []


def test_every_missing_file_is_reported(tiny):
    gone = ["raw/codes.npy", "raw/f01/uav1.sigmf-data", "raw/f01/uav2.sigmf-meta", "raw/f01/uav2.track.pos"]
    for name in gone:
        (tiny / name).unlink()
    lines = reported(tiny)
    assert len(lines) == len(gone)
    for name in gone[:3]:
        assert sum(line.startswith(f"{name}: no such file") for line in lines) == 1
    assert sum(": no flight log" in line for line in lines) == 1


@pytest.mark.parametrize("name", ["raw/codes.npy", "raw/f01/uav1.sigmf-data", "raw/f01/uav2.track.pos"])
def test_an_empty_file_is_reported_once(tiny, name):
    (tiny / name).write_bytes(b"")
    assert only(tiny).startswith(f"{name}: empty, 0 bytes")


def test_a_transmitter_that_does_not_receive_must_have_recorded_as_well(tiny):
    (tiny / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\tuav2\n")
    assert reported(tiny) == []
    (tiny / "raw/f01/uav1.sigmf-meta").unlink()
    assert only(tiny).startswith("raw/f01/uav1.sigmf-meta: no such file")


def test_a_campaign_without_a_flight_to_image_is_reported(tiny):
    (tiny / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\tcalibration\tuav1\tuav1\n")
    assert "config/flights.tsv: 1 flight, none of kind image" in reported(tiny)[0]


def test_results_that_are_no_folder_are_reported(tiny):
    (tiny / "results").write_text("")
    assert only(tiny).startswith("results: not a folder")


def test_a_carrier_that_is_not_the_recorded_one_names_each_recording(tiny):
    edit_config(tiny, lambda document: document["waveform"].update(carrier_hz=1.205e9))
    lines = reported(tiny)
    assert [line.split(":")[0] for line in lines] == ["raw/f01/uav1.sigmf-meta", "raw/f01/uav2.sigmf-meta"]
    assert "recorded with carrier_hz 1200000000.000000; expected 1205000000.000000" in lines[0]


def test_metadata_that_are_not_sigmf_are_reported_by_their_reader(tiny):
    edit_meta(tiny, "uav1", lambda meta: meta["captures"][-1].update({"core:sample_start": 10**9}))
    assert "starts at sample 1000000000" in only(tiny)


def test_only_a_node_that_does_not_transmit_needs_a_sidelink(tiny):
    edit_meta(tiny, "uav2", lambda meta: meta["global"].update({"apertura:channels": ["radar", "direct"]}))
    line = only(tiny)  # uav1 has no sidelink either
    assert line.startswith("raw/f01/uav2.sigmf-meta: apertura:channels ['radar', 'direct']; expected a channel named")


def test_captures_may_be_as_long_as_prefix_and_window_and_no_shorter(tiny):
    for samples, problem in ((1440, False), (1441, True)):  # captures have 4000, the window 2560
        edit_config(tiny, lambda d, samples=samples: d["waveform"].update(cyclic_prefix_s=samples / 1.024e9))
        lines = reported(tiny)
        assert [f"captures of 4000 samples; expected at least {2560 + samples}" in line for line in lines] == (
            [True, True] if problem else []
        )


@pytest.mark.parametrize(
    ("times", "prf_hz"),
    [
        (EVERY_SECOND / 2, 20.0),
        (EVERY_SECOND, 10.0),
        (np.delete(EVERY_SECOND, range(5, 30)), 10.0),
        (np.sort(np.random.default_rng(3).choice(400, 150, replace=False)) * np.timedelta64(50, "ms"), 20.0),
        (EVERY_SECOND + np.random.default_rng(3).normal(0, 20e6, 40).astype("timedelta64[ns]"), 10.0),
        (np.floor(np.arange(200) * 1.25).astype("timedelta64[ms]"), 800.0),
        (EVERY_SECOND[:2], 20.0),
    ],
    ids=["right", "slower", "a gap", "most are missed", "jitter", "whole milliseconds", "two pulses"],
)
def test_tags_of_a_right_recording_have_the_spacing_of_its_prf(times, prf_hz):
    assert odd_interval_s(START + times, prf_hz) is None


@pytest.mark.parametrize(("prf_hz", "ratio"), [(20.0, 2), (30.0, 3), (5.0, 0.5), (13.0, 1.3), (7.5, 0.75)])
def test_tags_of_another_spacing_are_reported(prf_hz, ratio):
    assert odd_interval_s(START + EVERY_SECOND, prf_hz) == pytest.approx(ratio / prf_hz)


def test_every_second_pulse_missing_is_said_so(tiny):
    edit_config(tiny, lambda document: document["waveform"].update(prf_hz=40.0))
    line = only(tiny)
    assert line.startswith("raw/f01/uav1.sigmf-meta")  # the receiver may take every second one
    assert (
        "time tag interval 0.05 s (20 Hz): only every second pulse was recorded, or waveform.prf_hz is 2 times" in line
    )
    assert "expected 0.025 s, 1/waveform.prf_hz (40 Hz)" in line


def test_a_receiver_whose_tags_fit_no_pulses_is_reported(tiny):
    edit_config(tiny, lambda document: document["waveform"].update(prf_hz=27.0))
    assert [line.split(":")[0] for line in reported(tiny)] == ["raw/f01/uav1.sigmf-meta", "raw/f01/uav2.sigmf-meta"]


def test_nodes_an_hour_apart_are_reported_of_and_half_a_second_is_left_to_a_flag(tiny):
    retag(np.timedelta64(500, "ms"))(tiny)
    assert reported(tiny) == []
    retag(np.timedelta64(3600, "s"))(tiny)
    line = only(tiny)
    assert line.startswith("raw/f01/uav1.sigmf-meta and uav2.sigmf-meta: recorded 2025-")
    assert re.search(r"a difference of [\d.]+ s: local time taken for UTC\?", line)


def test_frame_numbers_join_what_tags_do_not(tiny):
    retag(np.timedelta64(3600, "s"))(tiny)
    for node in ("uav1", "uav2"):
        renumber(0, node)(tiny)
    assert reported(tiny) == []
    renumber(1000, "uav2")(tiny)
    assert "without a common number" in only(tiny)


def test_a_segment_without_a_pulse_is_reported(tiny):
    table = tiny / "config/segments.tsv"
    table.write_text("flight\tpair\tstart\tend\nf01\tuav1-uav2\t2025-05-14\t2035-05-15\n")
    assert reported(tiny) == []
    table.write_text("flight\tpair\tstart\tend\nf01\tuav1-uav2\t2025-05-13\t2025-05-14\n")
    assert "no pulse of flight f01, pair uav1-uav2 within 2025-05-13T00:00:00…2025-05-14T00:00:00" in only(tiny)


CODES = np.exp(1j * np.arange(1024)).astype(np.complex64)


@pytest.mark.parametrize(
    ("codes", "found"),
    [
        (CODES, None),
        (CODES.astype(np.complex128), None),
        (CODES[:-1], "complex64 of shape (1023,)"),
        (CODES.real, "<f4 of shape (1024,)"),
        (CODES.astype("U9"), "<U9 of shape (1024,)"),
        (CODES * (np.arange(1024) != 7), "1 are zero and 0 not finite"),
        (np.where(np.arange(1024) == 7, np.nan, CODES), "1 not finite"),
    ],
)
def test_codes_are_complex_one_per_subcarrier_finite_and_not_zero(tiny, codes, found):
    np.save(tiny / "raw/codes.npy", codes)
    assert reported(tiny) == [] if found is None else found in only(tiny)


@pytest.mark.parametrize("content", [b"PK\x03\x04 an archive", b"\x93NUMPY\x01\x00", b"\x00"])
def test_codes_that_are_no_npy_are_reported(tiny, content):
    (tiny / "raw/codes.npy").write_bytes(content)
    assert "raw/codes.npy: not readable (" in only(tiny)


def test_codes_of_a_shape_that_no_disk_holds_are_reported_by_their_header(tiny):
    np.save(tiny / "raw/codes.npy", CODES)
    whole = (tiny / "raw/codes.npy").read_bytes()
    (tiny / "raw/codes.npy").write_bytes(whole.replace(b"(1024,), }           ", b"(1099511627776, 8), }"))
    assert "mmap length is greater than file size" in only(tiny)
    (tiny / "raw/codes.npy").write_bytes(whole[:-8])
    assert "mmap length is greater than file size" in only(tiny)


def test_the_page_of_checks_has_a_row_for_each_and_for_no_other():
    rows = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/checks.md").read_text(encoding="utf-8"), re.M)
    assert list(dict.fromkeys(rows)) == list(CHECKS)


def test_a_file_from_the_future_is_reported_with_what_to_do(tiny):
    path = tiny / "raw/f01/uav1.sigmf-meta"
    for ahead_s, count in ((2, 0), (7200, 1)):
        os.utime(path, (time.time() + ahead_s,) * 2)
        lines = reported(tiny)
        assert len(lines) == count
    assert "dated 2.0 h in the future; expected a modification time in the past, by this machine's clock" in lines[0]
    assert "run `touch raw/f01/uav1.sigmf-meta`" in lines[0]


def test_a_ground_height_that_is_not_configured_is_noted_and_named_in_what_follows_from_it(tiny):
    edit_config(tiny, lambda document: document["scene"].pop("height_m"))
    (line,) = assumptions(Examination(Campaign.load(tiny)))
    assert line.startswith("note: no terrain height is configured: scene.height_m is 0 m")
    assert "the track is 625 m above the ellipsoid" in line
    assert "scene.height_m (0 m by default)" in only(tiny)
    edit_config(tiny, lambda document: document["scene"].update(height_m=620.0))
    assert [*assumptions(Examination(Campaign.load(tiny)))] == []


def test_a_sound_folder_is_told_with_the_next_command(tiny, capsys):
    assert print_findings(tiny) == 0
    line = capsys.readouterr().out
    assert line.startswith("No problems found in 1 flight, 2 recordings with their logs. Next: apertura plan ")
    assert line.endswith(f", then apertura run {tiny}\n")
