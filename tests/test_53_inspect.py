"""`apertura inspect`: reported facts of files, missing information, and previews."""

import csv
import doctest
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import pyulog
import rasterio
import scipy.io
import xarray as xr
import yaml
from folders import SHARED, copy_writable
from matplotlib import image
from rasterio import Affine

from apertura.check.facts import bounds_of, log_facts
from apertura.core.echo.dechirp import FrequencySweep
from apertura.core.geometry.geodesy import ecef_from_geodetic
from apertura.formats.export.cog import write_power, write_slc
from apertura.formats.reading import read_track
from apertura.formats.tracks.track import make_track
from apertura.simulation.fmcw import FmcwFlight, write_fmcw_campaign
from apertura.views.inspect.path import inspect_path, look
from apertura.views.inspect.pictures import draw_history, draw_log

APERTURA = Path(sys.executable).parent / "apertura"
F01 = SHARED / "campaign-sample/raw/f01"

HOWTO = Path(__file__).parents[1] / "docs/howto/inspect.md"
EXAMPLES = Path(__file__).parents[1] / "examples"


def run(*words, **options):
    return subprocess.run([APERTURA, "inspect", *words], capture_output=True, check=False, timeout=120, **options)


def rows_of(path):
    with path.open(encoding="utf-8-sig") as stream:
        return list(csv.DictReader(stream, skipinitialspace=True))


def preview_of(report, path):
    assert inspect_path(report.path, plot=path) == 0
    return image.imread(path)


def test_facts_of_a_csv_log_agree_with_its_columns(shared):
    rows = rows_of(F01 / "uav1.track.csv")
    report = look(F01 / "uav1.track.csv")
    assert (report.kind, report.format, report.problem) == ("flight log", "csv", None)
    assert report.facts["epochs"] == len(rows)
    assert report.facts["first_utc"][:21] == rows[0]["time_utc"][:21].replace(" ", "T")
    assert report.facts["rate_hz"] == pytest.approx(10.0)
    for name in ("latitude_deg", "longitude_deg", "height_m"):
        values = [float(row[name]) for row in rows]
        assert report.facts["bounds"][name] == pytest.approx([min(values), max(values)], abs=1e-6)


def test_attitude_in_radians_is_reported_without_a_campaign(tmp_path):
    """The track is 40 m to the east, with a yaw of π/2 or of 90."""
    for yaw, is_radians in ((1.5708, True), (90.0, False)):
        time = np.datetime64("2026-05-14T09:30:00.0", "ms") + 100 * np.arange(80)
        rows = [
            f"{at}Z,{0.5 * number},0,20,{0.02 * (number % 3)},-0.07,{yaw}" for number, at in enumerate(time.astype(str))
        ]
        path = tmp_path / "uav1.track.csv"
        path.write_text("\n".join(["time_utc,east_m,north_m,up_m,roll_deg,pitch_deg,yaw_deg", *rows, ""]))
        lines = [line for line in look(path).missing if line.startswith("an attitude in degrees")]
        assert bool(lines) is is_radians
        assert not is_radians or "in radians: with this convention, yaw deviates from the course by 0°" in lines[0]


def test_preview_of_a_log_labels_the_axes_of_its_frame(shared, tmp_path):
    """The axes are east and north for positions on Earth, and x, y and z in a local frame."""
    path = tmp_path / "uav1.track.csv"
    rows = [f"2026-05-14T09:30:0{second}Z,{second},0,20" for second in range(9)]
    path.write_text("\n".join(["time_utc,east_m,north_m,up_m", *rows, ""]))
    plan, height, _ = draw_log(read_track(path, node="uav1"), "log").axes
    assert (plan.get_xlabel(), plan.get_ylabel(), height.get_ylabel()) == ("x, m", "y, m", "z, m")
    plan, height, _ = draw_log(read_track(F01 / "uav1.track.csv", node="uav1"), "log").axes
    assert (plan.get_xlabel(), plan.get_ylabel()) == ("east of the median, m", "north of the median, m")


def test_removed_lines_of_a_log_are_a_gap(shared, tmp_path):
    lines = (F01 / "uav1.track.csv").read_text().splitlines(keepends=True)
    (tmp_path / "uav1.track.csv").write_text("".join(lines[:41] + lines[51:]))
    report = look(tmp_path / "uav1.track.csv")
    assert report.facts["gaps"] == 1
    assert report.facts["lost_in_gaps"] == 10
    assert report.facts["longest_gaps"] == [{"after_s": 3.9, "length_s": 1.1}]
    assert any(sentence.startswith("epochs in 1 gap: pulses in gaps") for sentence in report.missing)


def test_solution_types_are_counted_and_unusable_ones_reported(shared, tmp_path):
    text = (F01 / "uav2.track.pos").read_text()
    lines = text.splitlines()
    solutions = [number for number, line in enumerate(lines) if line[0] != "%"]
    for number in solutions[:7]:
        cells = lines[number].split()
        cells[5] = "5"
        lines[number] = " ".join(cells)
    (tmp_path / "uav2.track.pos").write_text("\n".join(lines) + "\n")
    report = look(tmp_path / "uav2.track.pos")
    assert report.facts["fix"] == {"fix": len(solutions) - 7, "single": 7}
    assert report.facts["unusable_epochs"] == 7
    assert any("worst_fix" in sentence for sentence in report.missing)
    assert not any("worst_fix" in sentence for sentence in look(F01 / "uav2.track.pos").missing)


@pytest.mark.parametrize("file", ["uav1.sigmf-meta", "uav1.sigmf-data"])
def test_facts_of_a_recording_agree_with_metadata_and_samples(shared, file):
    meta = json.loads((F01 / "uav1.sigmf-meta").read_text())
    report = look(F01 / file)
    length = meta["captures"][1]["core:sample_start"]
    iq = np.fromfile(F01 / "uav1.sigmf-data", "<i2").reshape(-1, length, 2)[:128].astype(float)
    assert report.kind == "recording"
    assert report.facts["captures"] == len(meta["captures"])
    assert report.facts["sample_rate_hz"] == meta["global"]["core:sample_rate"]
    assert report.facts["carrier_hz"] == meta["captures"][0]["core:frequency"]
    assert report.facts["first_captures"]["radar"]["rms"] == pytest.approx(np.sqrt((iq**2).sum(-1).mean()), rel=1e-5)
    assert report.facts["first_captures"]["radar"]["largest"] == np.abs(iq).max()
    assert report.facts["captures_inside_log_share"] == 1.0
    assert report.missing == ()


def test_single_recording_lacks_log_and_waveform(shared, tmp_path):
    for suffix in ("sigmf-meta", "sigmf-data"):
        (tmp_path / f"x.{suffix}").write_bytes((F01 / f"uav1.{suffix}").read_bytes())
    missing = " ".join(look(tmp_path / "x.sigmf-meta").missing)
    assert "sample_rate_hz: 1.024e+09, carrier_hz: 1.2e+09, prf_hz: 20" in missing
    assert "no flight log x.track.<" in missing


def test_log_of_another_hour_suggests_a_clock_error(tiny):
    log = tiny / "raw/f01/uav1.track.csv"
    times = re.findall(r"T(\d\d):", log.read_text())
    log.write_text(re.sub(r"T\d\d:", f"T{(int(times[0]) + 3) % 24:02}:", log.read_text()))
    report = look(tiny / "raw/f01/uav1.sigmf-meta")
    assert report.facts["captures_inside_log_share"] == 0.0
    assert any("positions for 100.0% of the captures" in line and "apertura align" in line for line in report.missing)


def test_recording_of_a_single_capture_contains_no_pulses(shared):
    report = look(SHARED / "sigmf_nbiot/V16-beacon-NB-IoT-uplink.sigmf-data")
    assert report.facts["captures"] == 1
    found = "pulses: the recording consists of a single capture"
    assert any(sentence.startswith(found) for sentence in report.missing)


def test_facts_of_a_phase_history_agree_with_its_fields(shared):
    path = SHARED / "gotcha_afrl/data_3dsar_pass1_az001_HH.mat"
    fields = scipy.io.loadmat(path, squeeze_me=True)["data"]
    frequency, x = (np.ravel(fields[name].item()) for name in ("freq", "x"))
    report = look(path)
    assert (report.kind, report.format) == ("phase history", "afrl_mat")
    assert report.facts["pulses"] == x.size
    assert report.facts["band_hz"] == pytest.approx([frequency.min(), frequency.max()], rel=1e-6)
    assert report.facts["tx_bounds"]["east_m"] == pytest.approx([x.min(), x.max()])
    assert report.facts["clock"] == "none, pulses are counted"


def test_scans_with_an_own_clock_require_a_log_and_alignment(shared):
    report = look(SHARED / "bwsi_rail_passA/July23_03.out")
    assert report.facts["clock"] == "its own"
    assert "first_utc" not in report.facts
    assert any("apertura align" in sentence for sentence in report.missing)
    assert any("a flight log" in sentence for sentence in report.missing)


@pytest.mark.slow
def test_log_with_heights_above_sea_level_needs_height_offset(shared):
    path = next((SHARED / "dji_rtk_ansfl").glob("*Airdata.csv"))
    refused = look(path)
    assert "height_offset_m" in refused.problem.expected
    assert "to try a value: --set height_offset_m=VALUE" in refused.missing[0]
    report, higher = (look(path, [f"height_offset_m={offset}"]) for offset in (40, 50))
    rows = rows_of(path)
    latitude = [float(row["latitude"]) for row in rows if float(row["latitude"])]
    assert report.facts["epochs"] + sum(report.facts["excluded"].values()) == len(rows)
    assert report.facts["bounds"]["latitude_deg"] == pytest.approx([min(latitude), max(latitude)], abs=1e-7)
    raised = np.subtract(higher.facts["bounds"]["height_m"], report.facts["bounds"]["height_m"])
    assert raised == pytest.approx(10.0, abs=1e-6)


def test_facts_of_a_ulog_agree_with_its_messages(shared):
    path = SHARED / "px4_real_flight/esc_status_log.ulg"
    gps = pyulog.ULog(str(path)).get_dataset("vehicle_gps_position").data
    report = look(path)
    assert (report.kind, report.format) == ("flight log", "px4")
    assert report.facts["epochs"] + sum(report.facts["excluded"].values()) == len(gps["lat"])
    latitude = gps["lat"] * 1e-7
    assert report.facts["bounds"]["latitude_deg"] == pytest.approx([latitude.min(), latitude.max()], abs=1e-7)
    assert report.facts["unusable_epochs"] == 0  # single solutions are used in a log without RTK
    assert any("RTK" in sentence for sentence in report.missing)


def test_missing_datum_of_a_dem_is_reported(shared):
    report = look(SHARED / "dem_isce3/SanAnd_dem.tif")
    assert report.kind == "elevation model"
    assert report.facts["crs"] == "EPSG:4326"
    assert any("scene.dem_datum" in sentence for sentence in report.missing)


def test_facts_of_a_campaign_are_reported_per_node(shared):
    report = look(SHARED / "campaign-sample")
    assert (report.kind, report.missing) == ("campaign folder", ())
    reported = {part.path.name: part.facts for part in report.parts}
    for node in ("uav1", "uav2"):
        meta = json.loads((F01 / f"{node}.sigmf-meta").read_text())
        times = np.array([capture["core:datetime"][:-1] for capture in meta["captures"]], "datetime64[ns]")
        steps = np.diff(times) / np.timedelta64(50, "ms")
        assert reported[node]["captures"] == len(times)
        assert reported[node]["lost"] == round(steps.sum() - steps.size)
        assert reported[node]["prf_hz"] == pytest.approx(20.0)
        assert reported[node]["captures_inside_log_share"] == 1.0
    assert reported["uav2"]["fix"] == {"fix": 108}


@pytest.mark.slow
def test_phase_history_is_reported_with_its_aligned_clock(shared, tmp_path):
    root = copy_writable(EXAMPLES / "rail_pass", tmp_path / "rail")
    flight, node = (root / "config/flights.tsv").read_text().splitlines()[1].split("\t")[::3]
    raw = root / f"raw/{flight}"
    raw.mkdir(parents=True)
    (raw / f"{node}.out").write_bytes((SHARED / "bwsi_rail_passA/July23_03.out").read_bytes())
    (raw / f"{node}.track.csv").write_bytes((SHARED / "bwsi_rail_passA/Rail SAR 2.csv").read_bytes())
    report = look(root)
    (part,) = report.parts
    assert part.facts["pulses"] == 635
    assert part.facts["captures_inside_log_share"] == pytest.approx(1.0, abs=0.01)
    assert look(raw / f"{node}.out").missing == ()
    (root / "config/clocks.tsv").unlink()
    assert "apertura align" in look(raw / f"{node}.out").missing[0]
    assert look(root).parts[0].facts["captures_inside_log_share"] < 0.9


PRODUCT = {"transform": Affine(1, 0, 500000, 0, -1, 5400000), "crs": "EPSG:32632"}


def test_product_of_apertura_is_not_an_elevation_model(tmp_path):
    tags = {
        "APERTURA_VERSION": "1.0",
        "APERTURA_CODE_SHA256": "0123456789abcdef",
        "APERTURA_ERROR_DB": "-61.25",
        "APERTURA_FLAGS": '{"track_gap": "uav1: a gap"}',
        "APERTURA_FOCUS": '{"verdict": "focused"}',
    }
    write_power(tmp_path / "power.tif", np.ones((8, 9), "c8"), tags=tags, title="f01 uav1-uav2, power", **PRODUCT)
    write_slc(tmp_path / "slc.tif", np.ones((8, 9), "c8"), tags=tags, title="f01 uav1-uav2", **PRODUCT)
    for name, values in (
        ("power.tif", "linear (1)"),
        ("slc.tif", "complex, phase flattened, with spatial carrier (1)"),
    ):
        report = look(tmp_path / name)
        assert report.kind == "product of apertura"
        assert (report.problem, report.missing) == (None, ())
        assert report.facts["values"].endswith(values)
        assert report.facts["title"].startswith("f01 uav1-uav2")
        assert report.facts["flags"] == "track_gap"
        assert report.facts["focus"] == "focused"
        assert report.facts["numerical_error"] == "-61.25 dB"
        assert report.facts["pixels"] == "8 × 9"
        assert not any(name.startswith("height") for name in report.facts)


@pytest.mark.parametrize(
    ("unit", "crs", "scale", "fact", "value"),
    [
        ("", "EPSG:32632", 1.0, "height_m", [600.0, 650.0]),
        ("metre", "EPSG:32632", 0.5, "height_m", [300.0, 325.0]),
        ("ft", "EPSG:32632", 1.0, "height", "600.00 to 650.00 ft"),
        ("", "EPSG:26910+6360", 1.0, "height", "600.00 to 650.00 US survey foot"),
    ],
)
def test_heights_are_reported_in_the_unit_of_the_raster(tmp_path, unit, crs, scale, fact, value):
    kind = {"width": 51, "height": 4, "count": 1, "dtype": "int16", "transform": PRODUCT["transform"], "crs": crs}
    with rasterio.open(tmp_path / "dem.tif", "w", "GTiff", **kind) as raster:
        raster.write(np.tile(np.arange(600, 651, dtype=np.int16), (4, 1)), 1)
        raster.scales, raster.units = (scale,), (unit,)
    report = look(tmp_path / "dem.tif")
    assert report.kind == "elevation model"
    assert report.facts[fact] == value
    assert {"height", "height_m"} & set(report.facts) == {fact}


def test_axis_without_a_stated_deviation_is_unknown(tmp_path):
    track = make_track(
        np.datetime64("2025-05-14T09:30", "ns") + np.arange(3) * np.timedelta64(1, "s"),
        np.array([[48.0, 11.0, 500.0]] * 3),
        position_std_m=np.array([[0.01, 0.02, np.nan]] * 3),
        node="uav1",
        where=tmp_path / "x.csv",
    )
    assert log_facts(track).stated_std_m == (0.01, 0.02, None)
    assert log_facts(track.drop_vars("position_std")).stated_std_m is None


def test_clock_offset_of_a_recorder_is_applied_once(tiny):
    recorded = {part.path.name: part.facts["recorded"]["first_utc"] for part in look(tiny).parts}
    (tiny / "config/clocks.tsv").write_text("flight\tnode\toffset_s\tdrift_ppm\tstd_s\nf01\tuav1\t2\t0\t0.001\n")
    for part in look(tiny).parts:
        first, before = (
            np.datetime64(time[:-1], "ns") for time in (part.facts["recorded"]["first_utc"], recorded[part.path.name])
        )
        assert first - before == np.timedelta64(2 if part.path.name == "uav1" else 0, "s")


def test_problems_of_check_are_reported_for_a_campaign(tiny):
    (tiny / "raw/f01/uav1.sigmf-data").unlink()
    report = look(tiny)
    assert any(line.startswith("raw/f01/uav1.sigmf-data: no such file") for line in report.missing)
    (tiny / "config/config.yaml").write_text("campaign: [")
    assert "config/config.yaml: not readable as YAML" in look(tiny).missing[0]


def test_log_in_a_campaign_is_read_with_the_options_of_the_config(tiny, tmp_path):
    log, config = tiny / "raw/f01/uav1.track.csv", tiny / "config/config.yaml"
    log.write_text(log.read_text().replace("height_m", "up", 1))
    document = yaml.safe_load(config.read_text())
    document["nodes"]["uav1"]["log"] = {"columns": {"height_m": "up"}}
    config.write_text(yaml.safe_dump(document))
    assert look(log).problem is None
    alone = tmp_path / "uav1.track.csv"
    alone.write_text(log.read_text())
    assert look(alone).problem is not None
    assert look(alone, ["columns.height_m=up"]).problem is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "campaign-sample",
        "campaign-sample/raw/f01/uav1.sigmf-meta",
        "campaign-sample/raw/f01/uav2.track.pos",
        "sigmf_nbiot/V16-beacon-NB-IoT-uplink.sigmf-meta",
        "gotcha_afrl/data_3dsar_pass1_az001_HH.mat",
        "dem_isce3/SanAnd_dem.tif",
    ],
)
def test_previews_are_images_and_reproducible(shared, tmp_path, capsys, name):
    pictures = []
    for number in range(2):
        assert inspect_path(SHARED / name, plot=tmp_path / f"{number}.png") == 0
        pictures.append((tmp_path / f"{number}.png").read_bytes())
    assert pictures[0] == pictures[1]
    assert image.imread(tmp_path / "0.png")[..., :3].std() > 0.02
    assert str(tmp_path / "0.png") in capsys.readouterr().out.replace("\n", "")


@pytest.mark.slow
def test_examples_of_the_how_to_print_what_it_shows(shared, tmp_path):
    folder = copy_writable(SHARED / "campaign-sample", tmp_path / "sample")
    airdata = next((SHARED / "dji_rtk_ansfl").glob("*Airdata.csv"))
    (folder / "raw/f01/uav1.track.csv").write_text("".join(airdata.open(encoding="utf-8-sig").readlines()[:60]))
    examples = re.findall(r"```text\n\$ apertura inspect (\S+)\n(.*?)```", HOWTO.read_text(encoding="utf-8"), re.S)
    assert len(examples) == 2
    for path, expected in examples:
        printed = run(path, cwd=folder, env={**os.environ, "COLUMNS": "200"}).stdout.decode()
        flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
        assert doctest.OutputChecker().check_output(expected, printed, flags), printed


def test_beats_are_reported_with_their_file_of_times(tmp_path):
    flight = FmcwFlight(
        FrequencySweep(2.2e9, 400e6, 20e-6, 25e6), 100.0, 40, {"uav1": (0.0, -20.0, 10.0)}, ((0.0, 0.0, 0.0),)
    )
    raw = write_fmcw_campaign(tmp_path / "campaign", flight, waveform={}) / "raw/f01"
    times = np.load(raw / "uav1.time.npy")
    for name in ("uav1.npy", "uav1.time.npy"):
        report = look(raw / name)
        assert (report.path.name, report.kind, report.format) == ("uav1.npy", "phase history", "beat_npy")
        assert (report.facts["pulses"], report.facts["clock"]) == (len(times), "UTC")
    assert [part.path.name for part in look(raw).parts].count("uav1.npy") == 1
    np.save(raw / "uav1.time.npy", times[::-1])
    refused = look(raw / "uav1.npy")
    assert (refused.kind, refused.format) == ("phase history", "beat_npy")
    assert "sweep 1 starts" in refused.problem.found


@pytest.mark.slow
def test_times_are_printed_in_full_on_a_narrow_terminal(shared):
    meta = json.loads((F01 / "uav1.sigmf-meta").read_text())
    report = look(SHARED / "campaign-sample")
    node = next(part.facts for part in report.parts if part.path.name == "uav1")
    assert np.datetime64(node["recorded"]["first_utc"][:-1]) == np.datetime64(meta["captures"][0]["core:datetime"][:-1])
    assert len(node["logged"]["last_utc"]) == len("2025-05-14T09:30:08.700000000Z")
    printed = run(SHARED / "campaign-sample", env={**os.environ, "COLUMNS": "50"}).stdout.decode()
    assert max(map(len, printed.splitlines())) <= 50
    assert "…" not in printed
    for part in report.parts:
        for kind in ("recorded", "logged"):
            for time in part.facts[kind].values():
                assert time in printed


def test_preview_of_a_phase_history_covers_all_pulses():
    count = 3000
    ramp = np.exp(
        -2j * np.pi * np.arange(64) * np.linspace(-0.4, 0.4, count)[:, None]
    )  # range sweeps the full interval
    echo = xr.Dataset(
        {"transfer": (("pulse", "subcarrier"), ramp), "frequency": ("subcarrier", 1e9 + 1e6 * np.arange(64.0))}
    )
    (profiles, *_) = draw_history(echo, "a").axes
    (shown,) = profiles.images
    strongest = shown.get_array().argmax(axis=1)
    assert len(strongest) <= 256
    assert strongest.max() - strongest.min() > 45
    assert tuple(shown.get_extent()[2:]) == (count, 0)


def test_bounds_of_a_track_across_180_degrees_are_west_to_east():
    longitude = np.array([179.9999, -179.9998, 180.0, 179.9998])
    position = ecef_from_geodetic(np.full(4, 48.0), longitude, np.full(4, 30.0))
    assert bounds_of(position, "ecef")["longitude_deg"] == pytest.approx([179.9998, -179.9998], abs=1e-9)
    times = np.datetime64("2025-05-14T09:30", "ns") + np.arange(4) * np.timedelta64(1, "s")
    facts = log_facts(make_track(times, position, frame="ecef", node="uav1", where=Path("a.csv")))
    assert abs(facts.middle_geodetic[1]) == pytest.approx(179.99995, abs=1e-6)


@pytest.mark.slow
def test_named_pipe_instead_of_a_log_does_not_block(tiny):
    log = tiny / "raw/f01/uav1.track.csv"
    log.unlink()
    os.mkfifo(log)
    done = subprocess.run(
        [APERTURA, "inspect", str(tiny / "raw/f01/uav1.sigmf-meta")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "uav1.track.csv is not a regular file" in done.stdout
