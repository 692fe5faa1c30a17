"""Check of a campaign folder before a run: all problems are reported at once, from headers alone."""

import io
import os
import re
import shutil
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
    """Return the line of the only problem."""
    lines = reported(root)
    assert len(lines) == 1, lines
    return lines[0]


def retag(shift, node="uav2"):
    """Return a function that shifts the time tags of a node."""

    def change(meta):
        for capture in meta["captures"]:
            time = np.datetime64(capture["core:datetime"].rstrip("Z"), "ns") + shift
            capture["core:datetime"] = f"{time}Z"

    return lambda root: edit_meta(root, node, change)


def renumber(first, node):
    """Return a function that numbers the frames of a node from `first`."""

    def change(meta):
        for number, capture in enumerate(meta["captures"]):
            capture["apertura:frame"] = first + number

    return lambda root: edit_meta(root, node, change)


@pytest.mark.quick("continuous", "flight")
@pytest.mark.parametrize("name", list(PRESETS))
def test_presets_have_no_problems(tmp_path, name):
    short = simulate(tmp_path / "campaign", preset(name, pulses=8))
    whole = ["segments", "imaging"] if (short / "config/segments.tsv").is_file() else []
    assert reported(short, without=whole) == []  # segments cover the whole flight, not the first 8 pulses


def test_sample_campaign_has_no_problems(shared):
    assert reported(shared / "campaign-sample", without=["results"]) == []


def test_problems_of_all_kinds_are_reported_at_once(tiny):
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


def test_errors_of_config_flights_and_segments_are_reported_together(tiny):
    edit_config(tiny, lambda document: document["scene"].update(spacing=0.1))
    (tiny / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\tpicture\tuav1\tuav1\n")
    (tiny / "config/segments.tsv").write_text("flight\tpair\tstart\tend\nf01\tuav1-uav9\t2025-05-14\t2025-05-15\n")
    config, flights, segments = reported(tiny)
    assert "scene.spacing: unknown key (did you mean 'spacing_m'?)" in config
    assert "unknown kind 'picture', not one of bench, calibration, image" in flights
    assert "flight f01 has no pair 'uav1-uav9'" in segments


def test_invalid_flight_line_is_not_reported_again_for_segments(tiny):
    (tiny / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\tpicture\tuav1\tuav1\n")
    (tiny / "config/segments.tsv").write_text("flight\tpair\tstart\tend\nf01\tuav1-uav1\t2025-05-14\t2025-05-15\n")
    assert "picture" in only(tiny)


def test_missing_folder_is_one_problem(tmp_path):
    assert "no such folder" in only(tmp_path / "nowhere")


def test_problems_are_printed_one_per_line_and_counted(tiny):
    edit_meta(tiny, "uav1", lambda meta: meta["global"].update({"core:sample_rate": 1.0e9}))
    edit_meta(tiny, "uav2", lambda meta: meta["global"].update({"apertura:channels": ["radar", "side\nlink"]}))
    printed = io.StringIO()
    assert print_problems(tiny, stream=printed) == len(printed.getvalue().splitlines()) == 2


def test_excluded_check_reports_nothing(tiny):
    (tiny / "raw/codes.npy").unlink()
    assert reported(tiny, without=["files", "imaging"]) == []


def test_unexpected_exception_of_a_check_propagates(tiny, monkeypatch):
    monkeypatch.setitem(CHECKS, "broken", "builtins:int")
    with pytest.raises(TypeError):
        problems(tiny)


def test_samples_are_not_read(tiny):
    edit_data(tiny, "uav1", lambda samples: samples.fill(0))  # ingest refuses captures of zeros
    assert reported(tiny) == []


@pytest.mark.slow
def test_check_imports_no_library_beyond_those_for_headers(tiny):
    heavy = ("zarr", "matplotlib", "scipy.io", "rasterio", "snakemake", "jsonschema")
    code = f"import sys; from apertura.check import problems; assert problems({str(tiny)!r}) == []"
    code += "; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert sorted(set(heavy) & set(done.stdout.split())) == []


def test_every_missing_file_is_reported(tiny):
    missing = ["raw/codes.npy", "raw/f01/uav1.sigmf-data", "raw/f01/uav2.sigmf-meta", "raw/f01/uav2.track.pos"]
    for name in missing:
        (tiny / name).unlink()
    lines = reported(tiny)
    assert len(lines) == len(missing)
    for name in missing[:3]:
        assert sum(line.startswith(f"{name}: no such file") for line in lines) == 1
    assert sum(": no flight log" in line for line in lines) == 1


def test_two_logs_of_a_node_are_named_with_their_remedy(tiny):
    shutil.copyfile(tiny / "raw/f01/uav2.track.pos", tiny / "raw/f01/uav2.track.nmea")
    line = only(tiny)
    assert "2 flight logs ['uav2.track.nmea', 'uav2.track.pos']" in line
    assert line.endswith("Remove or rename all but one of them.")


@pytest.mark.parametrize("name", ["raw/codes.npy", "raw/f01/uav1.sigmf-data", "raw/f01/uav2.track.pos"])
def test_empty_file_is_reported_once(tiny, name):
    (tiny / name).write_bytes(b"")
    assert only(tiny).startswith(f"{name}: empty, 0 bytes")


def test_transmitter_without_receiver_role_needs_a_recording(tiny):
    (tiny / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\tuav2\n")
    assert reported(tiny) == []
    (tiny / "raw/f01/uav1.sigmf-meta").unlink()
    assert only(tiny).startswith("raw/f01/uav1.sigmf-meta: no such file")


def test_campaign_without_image_flight_is_reported(tiny):
    (tiny / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\tcalibration\tuav1\tuav1\n")
    assert "config/flights.tsv: 1 flight, none of kind image" in reported(tiny)[0]


def test_results_path_that_is_a_file_is_reported(tiny):
    (tiny / "results").write_text("")
    assert only(tiny).startswith("results: not a folder")


def test_wrong_carrier_is_reported_for_each_recording(tiny):
    edit_config(tiny, lambda document: document["waveform"].update(carrier_hz=1.205e9))
    lines = reported(tiny)
    assert [line.split(":")[0] for line in lines] == ["raw/f01/uav1.sigmf-meta", "raw/f01/uav2.sigmf-meta"]
    assert "recorded with carrier_hz 1200000000.000000; expected 1205000000.000000" in lines[0]


def test_invalid_sigmf_metadata_are_reported_by_their_reader(tiny):
    edit_meta(tiny, "uav1", lambda meta: meta["captures"][-1].update({"core:sample_start": 10**9}))
    assert "starts at sample 1000000000" in only(tiny)


def test_only_a_receiving_node_needs_a_sidelink(tiny):
    edit_meta(tiny, "uav2", lambda meta: meta["global"].update({"apertura:channels": ["radar", "direct"]}))
    line = only(tiny)  # uav1 has no sidelink either
    assert line.startswith("raw/f01/uav2.sigmf-meta: apertura:channels ['radar', 'direct']; expected a channel named")


def test_captures_shorter_than_prefix_and_window_are_reported(tiny):
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
    ids=["exact", "slower", "a gap", "most are missed", "jitter", "whole milliseconds", "two pulses"],
)
def test_tags_at_the_prf_are_accepted(times, prf_hz):
    assert odd_interval_s(START + times, prf_hz) is None


@pytest.mark.parametrize(("prf_hz", "ratio"), [(20.0, 2), (30.0, 3), (5.0, 0.5), (13.0, 1.3), (7.5, 0.75)])
def test_tags_at_another_prf_are_reported(prf_hz, ratio):
    assert odd_interval_s(START + EVERY_SECOND, prf_hz) == pytest.approx(ratio / prf_hz)


def test_missing_every_second_pulse_is_reported(tiny):
    edit_config(tiny, lambda document: document["waveform"].update(prf_hz=40.0))
    line = only(tiny)
    assert line.startswith("raw/f01/uav1.sigmf-meta")  # a receiver may record every second pulse
    assert (
        "time tag interval 0.05 s (20 Hz): only every second pulse was recorded, or waveform.prf_hz is 2 times" in line
    )
    assert "expected 0.025 s, 1/waveform.prf_hz (40 Hz)" in line


def test_receiver_tags_without_matching_pulses_are_reported(tiny):
    edit_config(tiny, lambda document: document["waveform"].update(prf_hz=27.0))
    assert [line.split(":")[0] for line in reported(tiny)] == ["raw/f01/uav1.sigmf-meta", "raw/f01/uav2.sigmf-meta"]


def test_tag_offset_of_an_hour_is_a_problem_and_half_a_second_is_not(tiny):
    retag(np.timedelta64(500, "ms"))(tiny)
    assert reported(tiny) == []
    retag(np.timedelta64(3600, "s"))(tiny)
    line = only(tiny)
    assert line.startswith("raw/f01/uav1.sigmf-meta and uav2.sigmf-meta: recorded 2025-")
    assert re.search(r"a difference of [\d.]+ s \(possible cause: local time interpreted as UTC\)", line)


def test_frame_numbers_pair_captures_despite_tag_offset(tiny):
    retag(np.timedelta64(3600, "s"))(tiny)
    for node in ("uav1", "uav2"):
        renumber(0, node)(tiny)
    assert reported(tiny) == []
    renumber(1000, "uav2")(tiny)
    assert "without a common number" in only(tiny)


def test_segment_without_pulses_is_reported(tiny):
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
def test_codes_are_finite_nonzero_complex_and_one_per_subcarrier(tiny, codes, found):
    np.save(tiny / "raw/codes.npy", codes)
    assert reported(tiny) == [] if found is None else found in only(tiny)


@pytest.mark.parametrize("content", [b"PK\x03\x04 an archive", b"\x93NUMPY\x01\x00", b"\x00"])
def test_unreadable_codes_file_is_reported(tiny, content):
    (tiny / "raw/codes.npy").write_bytes(content)
    assert "raw/codes.npy: not readable (" in only(tiny)


def test_codes_header_larger_than_the_file_is_reported(tiny):
    np.save(tiny / "raw/codes.npy", CODES)
    whole = (tiny / "raw/codes.npy").read_bytes()
    (tiny / "raw/codes.npy").write_bytes(whole.replace(b"(1024,), }           ", b"(1099511627776, 8), }"))
    assert "mmap length is greater than file size" in only(tiny)
    (tiny / "raw/codes.npy").write_bytes(whole[:-8])
    assert "mmap length is greater than file size" in only(tiny)


def test_page_of_checks_lists_exactly_the_checks():
    rows = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/checks.md").read_text(encoding="utf-8"), re.M)
    assert list(dict.fromkeys(rows)) == list(CHECKS)


def test_file_dated_in_the_future_is_reported_with_remedy(tiny):
    path = tiny / "raw/f01/uav1.sigmf-meta"
    for ahead_s, count in ((2, 0), (7200, 1)):
        os.utime(path, (time.time() + ahead_s,) * 2)
        lines = reported(tiny)
        assert len(lines) == count
    found = "the modification time is 2.0 h in the future"
    assert f"{found}; expected a modification time in the past, according to the clock of this machine" in lines[0]
    assert "run `touch raw/f01/uav1.sigmf-meta`" in lines[0]


def test_default_terrain_height_is_noted_and_named_in_consequences(tiny):
    edit_config(tiny, lambda document: document["scene"].pop("height_m"))
    (line,) = assumptions(Examination(Campaign.load(tiny)))
    assert line.startswith("note: no terrain height is configured: scene.height_m is 0 m")
    assert "the track is 625 m above the ellipsoid" in line
    assert "scene.height_m (0 m by default)" in only(tiny)
    edit_config(tiny, lambda document: document["scene"].update(height_m=620.0))
    assert [*assumptions(Examination(Campaign.load(tiny)))] == []


def test_valid_folder_is_reported_with_the_next_command(tiny, capsys):
    assert print_findings(tiny) == 0
    line = capsys.readouterr().out
    assert line.startswith("No problems found in 1 flight, 2 recordings with their logs. Next: apertura plan ")
    assert line.endswith(f", then apertura run {tiny}\n")
