"""`apertura init CAMPAIGN FILES`: recognition, assignment by times and names, questions, config, files."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import yaml
from folders import complaint, contents
from loose_files import epochs, int16_and_logs, truth, write_csv, write_nmea, write_samples, write_ulog
from rasterio.transform import from_origin

from apertura import cli
from apertura.campaign.config import CLOCKS, CONFIG, FLIGHTS
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.check import LAST, problems
from apertura.core.echo.dechirp import FrequencySweep
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.quality.bright_points import brightest_near
from apertura.core.quality.point_targets import find_peak
from apertura.formats.reading import open_recording
from apertura.formats.time_tags import read_time_tags
from apertura.run.process import process
from apertura.simulation import preset, simulate
from apertura.simulation.fmcw import FmcwFlight, write_fmcw_campaign
from apertura.tools.init import campaign_from_files
from apertura.tools.init.contents import swath
from apertura.views.inspect.path import look

ANSWERS = {
    "waveform.sample_rate_hz": "1.024e9 1.2e9",
    "waveform.cyclic_prefix_s": "0.78125e-6",
    "scene.height_m": "620 right",
}


def answering(answers):
    """Return a function that answers by the first key of a question; an answer that is not valid is not repeated."""
    return lambda question, problem: "" if problem else answers.get(question.keys[0], "")


def config_of(made):
    return yaml.safe_load((made.folder / CONFIG).read_text())


@pytest.fixture
def loose(tiny, tmp_path):
    """Int16 samples, time tags, an NMEA and a CSV log, and codes of the tiny campaign."""
    return int16_and_logs(tiny, tmp_path / "loose")


def test_int16_samples_with_nmea_and_csv_need_three_answers(tiny, loose, tmp_path):
    made = campaign_from_files(tmp_path / "made", [loose], ask=answering(ANSWERS))
    assert len(made.questions) <= 3
    assert problems(made.folder, without=LAST) == []
    expected, found = Campaign.load(tiny).settings.waveform, Campaign.load(made.folder).settings.waveform
    assert found.model_dump() == pytest.approx(expected.model_dump())
    assert (made.folder / FLIGHTS).read_text().splitlines()[1] == "f01\timage\talpha\talpha,bravo"
    for node, name in (("uav1", "alpha"), ("uav2", "bravo")):
        recordings = [
            open_recording(Campaign.load(root).recording_files("f01", one))
            for root, one in ((tiny, node), (made.folder, name))
        ]
        captures = [one.samples.captures(one.captures.start, one.captures.length) for one in recordings]
        np.testing.assert_array_equal(captures[0], captures[1])
        np.testing.assert_array_equal(recordings[0].captures.time, recordings[1].captures.time)
        assert recordings[0].channels == recordings[1].channels


@pytest.mark.slow
def test_codes_that_change_from_pulse_to_pulse_are_described(tmp_path):
    plan = preset("demo", pulses=60)
    changing = replace(plan, waveform=replace(plan.waveform, code="16qam", frames=60))
    root = simulate(tmp_path / "simulated", changing, seed=1)
    made = campaign_from_files(tmp_path / "made", [int16_and_logs(root, tmp_path / "loose")], ask=answering(ANSWERS))
    expected, found = Campaign.load(root).settings.waveform, Campaign.load(made.folder).settings.waveform
    assert found.model_dump() == pytest.approx(expected.model_dump())
    assert (made.folder / "raw/codes.npy").read_bytes() == (root / "raw/codes.npy").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["int16", "complex64"])
def test_samples_in_arrays_are_read_back(tiny, loose, tmp_path, kind):
    """The header of the .npy file is skipped, so that the file is linked like other samples."""
    for node, name in (("uav1", "alpha"), ("uav2", "bravo")):
        recording = open_recording(Campaign.load(tiny).recording_files("f01", node))
        iq = np.asarray(recording.samples.captures(recording.captures.start, recording.captures.length))
        complex_iq = (iq[..., 0] + 1j * iq[..., 1]).astype(np.complex64)
        np.save(loose / f"{name}.npy", iq if kind == "int16" else complex_iq)
        (loose / f"{name}.iq").unlink()
    made = campaign_from_files(tmp_path / "made", [loose], ask=answering(ANSWERS))
    assert problems(made.folder, without=LAST) == []
    for node, name in (("uav1", "alpha"), ("uav2", "bravo")):
        first = open_recording(Campaign.load(tiny).recording_files("f01", node))
        second = open_recording(Campaign.load(made.folder).recording_files("f01", name))
        captures = [one.samples.captures(one.captures.start, one.captures.length) for one in (first, second)]
        np.testing.assert_array_equal(*captures)
        assert (first.channels, first.captures.time.tolist()) == (second.channels, second.captures.time.tolist())


@pytest.mark.slow
@pytest.mark.parametrize("conjugate", [False, True])
def test_targets_of_int16_samples_are_within_2_cm(tmp_path, conjugate):
    """Conjugate samples, as with I and Q swapped, give the same image."""
    plan = preset("demo")
    nodes = {name: replace(node, lever_arms_m={}, path_offset_m={}) for name, node in plan.nodes.items()}
    root = simulate(tmp_path / "simulated", replace(plan, nodes=nodes), seed=1)
    folder, targets = int16_and_logs(root, tmp_path / "loose"), truth(root)
    for node, name in (("uav1", "alpha"), ("uav2", "bravo")) if conjugate else ():
        write_samples(Campaign.load(root), node, folder, name, conjugate=True)
    west, south, east, north = (*np.floor(targets.min(axis=0) - 1), *np.ceil(targets.max(axis=0) + 1))
    grid = {
        "scene.crs": "EPSG:32632",
        "scene.bounds_m": f"[{west}, {south}, {east}, {north}]",
        "scene.spacing_m": "0.05",
    }
    made = campaign_from_files(tmp_path / "made", [folder], settings=grid, ask=answering(ANSWERS))
    campaign = process(made.folder, last="cube")
    for pair in ("alpha-alpha", "alpha-bravo"):
        stage = open_stage(campaign.stage("image", "f01", pair), "image")
        x, y = stage.x.values, stage.y.values
        for east, north in targets:
            row, column = (y[0] - north) / 0.05, (east - x[0]) / 0.05
            peak = find_peak(stage.image.values, *brightest_near(stage.image.values, row, column, 5))
            assert 0.05 * np.hypot(peak.row - row, peak.column - column) < 0.02


def test_fmcw_and_ulog_need_three_answers(tmp_path):
    sweep = FrequencySweep(2.2e9, 400e6, 20e-6, 25e6)
    flight = FmcwFlight(sweep, 100.0, 20, {"uav1": (0.0, -20.0, 10.0)}, ((0.0, 0.0, 0.0),))
    root = write_fmcw_campaign(tmp_path / "simulated", flight, waveform={})
    folder = tmp_path / "loose"
    folder.mkdir()
    shutil.copyfile(root / "raw/f01/uav1.npy", folder / "drone_beat.npy")
    shutil.copyfile(root / "raw/f01/uav1.time.npy", folder / "drone_times.npy")
    write_ulog(folder / "log_42.ulg", *epochs(Campaign.load(root), "uav1"))
    answers = {
        "waveform.start_hz": "2.2e9 400e6 20e-6",
        "waveform.sample_rate_hz": "25e6",
        "scene.height_m": f"{flight.origin[2]} left",
    }
    made = campaign_from_files(tmp_path / "made", [folder], ask=answering(answers))
    assert len(made.questions) <= 3
    waveform = Campaign.load(made.folder).settings.waveform
    assert [getattr(waveform, key) for key in ("start_hz", "bandwidth_hz", "sweep_s", "sample_rate_hz", "iq")] == [
        *(2.2e9, 400e6, 20e-6, 25e6, "real")
    ]
    times = [np.load(path) for path in (root / "raw/f01/uav1.time.npy", made.folder / "raw/f01/drone.time.npy")]
    np.testing.assert_array_equal(*times)


# ---- Recognition


def test_logs_and_time_tags_are_recognised_by_content(tiny, tmp_path):
    campaign = Campaign.load(tiny)
    time, geodetic = epochs(campaign, "uav1")
    write_nmea(tmp_path / "gnss.dat", time, geodetic)
    write_csv(tmp_path / "positions", time, geodetic)
    write_ulog(tmp_path / "flight.backup", time, geodetic)
    shutil.copyfile(tiny / "raw/f01/uav2.track.pos", tmp_path / "solution.out.txt")
    write_samples(campaign, "uav1", tmp_path, "alpha")
    names = ("gnss.dat", "positions", "flight.backup", "solution.out.txt", "alpha_tags.txt")
    found = [look(tmp_path / name) for name in names]
    assert [(report.kind, report.format) for report in found] == [
        *(("flight log", "nmea"), ("flight log", "csv"), ("flight log", "px4"), ("flight log", "rtklib")),
        ("time tags", ""),
    ]
    assert [report.problem for report in found] == [None] * 5


@pytest.mark.parametrize(
    "text",
    [
        "2025-05-14T09:30:00.05Z\n2025-05-14T09:30:00.1Z\n",
        "time_utc,frame\n2025-05-14T09:30:00.05,7\n2025-05-14T09:30:00.1,9\n",
        "1747215000.05\n1747215000.10\n",
    ],
)
def test_time_tags_are_iso_8601_or_seconds_since_1970(tmp_path, text):
    path = tmp_path / "tags.txt"
    path.write_text(text)
    times, frames = read_time_tags(path)
    assert times.astype(str).tolist() == ["2025-05-14T09:30:00.050000000", "2025-05-14T09:30:00.100000000"]
    assert (frames is None) == ("frame" not in text)
    assert look(path).kind == "time tags"


@pytest.mark.parametrize(
    ("line", "message"),
    [("soon", "line 2: 'soon'; expected a line per"), ("2025-05-14T09:29:59Z", "tag 1, 2025-05-14T09:29:59")],
)
def test_wrong_time_tag_is_reported_with_its_line(tmp_path, line, message):
    path = tmp_path / "tags.txt"
    path.write_text(f"2025-05-14T09:30:00.05Z\n{line}\n")
    assert message in complaint(lambda: read_time_tags(path))


def test_unreadable_recording_is_named_and_nothing_is_written(loose, tmp_path):
    (loose / "bad.sigmf-meta").write_text('{"global": {}}')
    assert "bad.sigmf-meta: not valid SigMF" in complaint(lambda: campaign_from_files(tmp_path / "made", [loose]))
    assert not (tmp_path / "made").exists()


@pytest.mark.slow
def test_file_of_no_use_is_refused_if_named_and_listed_if_in_a_folder(loose, tmp_path):
    (loose / "notes.md").write_text("windy")
    named = complaint(lambda: campaign_from_files(tmp_path / "made", [loose, loose / "notes.md"]))
    assert "notes.md" not in named or "no known format" in named
    alone = complaint(lambda: campaign_from_files(tmp_path / "made", [loose / "notes.md"]))
    assert "notes.md: no known format has the suffix '.md'" in alone
    made = campaign_from_files(tmp_path / "made", [loose], ask=answering(ANSWERS))
    assert "not used: notes.md: no known format has the suffix '.md'" in made.lines


def test_samples_without_time_tags_are_refused_with_the_missing_file(loose, tmp_path):
    (loose / "bravo_tags.txt").unlink()
    tags = (loose / "alpha_tags.txt").read_text().splitlines()
    (loose / "alpha_tags.txt").write_text("\n".join(tags[:37]) + "\n")  # divides neither size
    message = complaint(lambda: campaign_from_files(tmp_path / "made", sorted(loose.iterdir())))
    assert "alpha.iq" in message
    assert "none whose number of tags divides the size" in message


# ---- Assignment


def shift_tags(path, hours):
    times = read_time_tags(path)[0] + np.timedelta64(round(hours * 3600), "s")
    path.write_text("\n".join(f"{time}Z" for time in times.astype(str)) + "\n")


@pytest.mark.slow
def test_recorders_in_another_time_zone_are_corrected_in_clocks_tsv(loose, tmp_path):
    """The log of 2 s can cover the recording after one shift by quarter hours only."""
    for name in ("alpha", "bravo"):
        shift_tags(loose / f"{name}_tags.txt", 5.5)
    made = campaign_from_files(tmp_path / "made", [loose], ask=answering(ANSWERS))
    assert (made.folder / CLOCKS).read_text().splitlines()[1:] == ["f01\talpha\t-19800\t\t", "f01\tbravo\t-19800\t\t"]
    assert problems(made.folder, without=LAST) == []
    assert sum("time zone -5.5 h" in line for line in made.lines) == 2


@pytest.mark.slow
def test_ambiguous_logs_are_asked_or_refused(loose, tmp_path):
    """Two logs cover the recording of alpha, and none of their names contains a node."""
    shutil.copyfile(loose / "alpha_gnss.nmea", loose / "first.nmea")
    (loose / "alpha_gnss.nmea").rename(loose / "second.nmea")
    message = complaint(
        lambda: campaign_from_files(tmp_path / "made", [loose], settings={"waveform.sample_rate_hz": "1.024e9"})
    )
    assert "first.nmea and second.nmea may both be the log of alpha in f01" in message
    assert "Add --assign first.nmea=f01/alpha" in message
    made = campaign_from_files(tmp_path / "asked", [loose], ask=answering({**ANSWERS, "log": "second.nmea"}))
    assert any("alpha.iq" in line and "log second.nmea" in line for line in made.lines)
    assign = {loose / "first.nmea": "f01/alpha"}
    made = campaign_from_files(tmp_path / "made", [loose], assign=assign, ask=answering(ANSWERS))
    assert any("alpha.iq" in line and "log first.nmea" in line for line in made.lines)
    assert "not used: second.nmea: log of no recording" in made.lines


def test_logs_without_names_are_assigned_by_their_times(tiny, tmp_path):
    """Two flights on one morning; each log covers one of them."""
    campaign = Campaign.load(tiny)
    time, geodetic = epochs(campaign, "uav1")
    for number, name in enumerate(("one", "two")):
        folder = tmp_path / "day" / name
        folder.mkdir(parents=True)
        write_samples(campaign, "uav1", folder, "drone")
        shift_tags(folder / "drone_tags.txt", number)
        write_csv(tmp_path / "day" / f"{'ba'[number]}.csv", time + np.timedelta64(number, "h"), geodetic)
    shutil.copyfile(tiny / "raw/codes.npy", tmp_path / "day/codes.npy")
    made = campaign_from_files(tmp_path / "made", [tmp_path / "day"], ask=answering(ANSWERS))
    assert [line.partition(",")[0] for line in made.lines] == [
        "one drone (transmits): drone.iq",
        "two drone (transmits): drone.iq",
    ]
    assert ["log b.csv" in made.lines[0], "log a.csv" in made.lines[1]] == [True, True]
    assert problems(made.folder, without=LAST) == []


@pytest.mark.slow
@pytest.mark.parametrize("nodes", [("uav1",), ("uav1", "uav2")])
def test_names_of_recordings_in_a_folder_give_nodes_of_two_flights(tiny, tmp_path, nodes):
    """The word of the flight, which only the recordings of that flight have, does not name a node."""
    day, raw = tmp_path / "day", tiny / "raw/f01"
    day.mkdir()
    shutil.copyfile(tiny / "raw/codes.npy", day / "codes.npy")
    for node in nodes:
        suffix = {"uav1": "csv", "uav2": "pos"}[node]
        shutil.copyfile(raw / f"{node}.track.{suffix}", day / f"{node}_log.{suffix}")
        for number in (1, 2):
            shutil.copyfile(raw / f"{node}.sigmf-data", day / f"pass{number}_{node}_rec.sigmf-data")
            text = (raw / f"{node}.sigmf-meta").read_text().replace("T09:3", f"T{8 + number:02d}:3")
            (day / f"pass{number}_{node}_rec.sigmf-meta").write_text(text)
    made = campaign_from_files(tmp_path / "made", [day], ask=answering(ANSWERS))
    found = [line.split()[:2] for line in made.lines if "transmits" in line or "receives" in line]
    assert found == [[flight, node] for flight in ("f01", "f02") for node in nodes]


# ---- Questions and config


def test_unknown_values_are_commented_keys_with_a_reason(loose, tmp_path):
    """Without a terminal, required keys stay open, and the check lists them; headers need the sample rate only."""
    made = campaign_from_files(tmp_path / "made", [loose], settings={"waveform.sample_rate_hz": "1.024e9"})
    lines = (made.folder / CONFIG).read_text().splitlines()
    for key in ("carrier_hz", "cyclic_prefix_s", "lever_arms_m", "height_m"):
        assert f"# {key}:" in [line.strip() for line in lines]
    assert lines[[line.strip() for line in lines].index("# carrier_hz:") - 1].strip() == (
        "# not contained in the recordings; write the value, Hz"
    )
    (problem,) = problems(made.folder)
    assert "waveform.carrier_hz: missing" in str(problem)
    assert not made.questions


def test_sample_rate_without_header_is_required(loose, tmp_path):
    message = complaint(lambda: campaign_from_files(tmp_path / "made", [loose]))
    assert "alpha.iq: samples without header" in message
    assert "--set waveform.sample_rate_hz=" in message


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scene.height_m": "high"}, "scene.height_m: 'high': Input should be a valid number"),
        ({"waveform.carrier_hz": "-1"}, "waveform.carrier_hz: '-1': Input should be greater than 0"),
        ({"scene.hight_m": "3"}, "--set: unknown key 'scene.hight_m'"),
        ({"nodes.charlie.path_offset_m": "{radar: 1}"}, "--set: node 'charlie'; expected one of alpha, bravo"),
    ],
)
def test_given_values_are_validated_by_the_schema_of_the_config(loose, tmp_path, settings, message):
    work = lambda: campaign_from_files(tmp_path / "made", [loose], settings=settings, ask=answering(ANSWERS))  # noqa: E731
    assert message in complaint(work)
    assert not (tmp_path / "made").exists()


def test_wrong_answer_is_asked_again_with_the_problem(loose, tmp_path):
    problems_shown, answers = [], {**ANSWERS, "scene.height_m": "high"}

    def ask(question, problem):
        problems_shown.append(problem)
        return "620" if problem else answers.get(question.keys[0], "")

    made = campaign_from_files(tmp_path / "made", [loose], ask=ask)
    assert config_of(made)["scene"]["height_m"] == 620.0
    (problem,) = filter(None, problems_shown)
    assert "'high': Input should be a valid number" in problem


@pytest.mark.parametrize("side", ["right", "left"])
def test_strip_lies_on_the_stated_side_between_10_and_80_degrees(side):
    """A track to the north at 100 m: ground ranges from 100·tan 10° to 100/tan 10°, limited by the longest path."""
    north = np.linspace(0.0, 500.0, 50)
    track = np.stack([np.full(50, 40.0), north, np.full(50, 120.0)], -1)
    sign = 1 if side == "right" else -1
    edges = np.sort(40.0 + sign * np.array([100 * np.tan(np.radians(10)), 100 / np.tan(np.radians(10))]))
    bounds = swath([track], crs=LOCAL, side=side, height_m=20.0, limit_m=np.inf)
    assert bounds[::2] == pytest.approx(edges, abs=1.5)
    assert bounds[1::2] == [0.0, 500.0]
    near = swath([track], crs=LOCAL, side=side, height_m=20.0, limit_m=800.0)  # half of it at a squint of 20 degrees
    far = np.sqrt((400 * np.cos(np.radians(20))) ** 2 - 100**2)
    assert near[::2] == pytest.approx(np.sort(40.0 + sign * np.array([100 * np.tan(np.radians(10)), far])), abs=1.5)
    circle = np.stack([100 * np.cos(north / 60), 100 * np.sin(north / 60), np.full(50, 120.0)], -1)
    assert swath([circle], crs=LOCAL, side=side, height_m=20.0, limit_m=np.inf) is None


@pytest.mark.slow
@pytest.mark.parametrize(("datum", "is_known"), [("ellipsoid", True), ("egm2008", False)])
def test_side_requires_heights_above_the_ellipsoid(loose, tmp_path, datum, is_known):
    """A DEM of 620 m gives the bounds of a stated height of 620 m; heights above a geoid give automatic bounds."""
    place = {"crs": "EPSG:32632", "transform": from_origin(570550, 5363800, 4, 4), "width": 60, "height": 60}
    with rasterio.open(tmp_path / "dem.tif", "w", driver="GTiff", count=1, dtype="float32", **place) as raster:
        raster.write(np.full((60, 60), 620, np.float32), 1)
    answers = {**ANSWERS, "scene.dem_datum": datum}
    made = campaign_from_files(tmp_path / "made", [loose, tmp_path / "dem.tif"], side="right", ask=answering(answers))
    scene = config_of(made)["scene"]
    assert (scene["dem"], scene["dem_datum"]) == ("raw/dem.tif", datum)
    flat = config_of(campaign_from_files(tmp_path / "flat", [loose], ask=answering(ANSWERS)))["scene"]
    assert scene["bounds_m"] == (flat["bounds_m"] if is_known else "auto")
    assert "height_m" not in scene


# ---- Files


def test_existing_campaign_is_refused_and_unchanged(loose, tiny, tmp_path):
    before = contents(tiny)
    assert "already exists and is not an empty folder" in complaint(lambda: campaign_from_files(tiny, [loose]))
    assert contents(tiny) == before


@pytest.mark.slow
def test_files_are_linked_or_copied_and_originals_unchanged(loose, tmp_path):
    before = contents(loose)
    for copy in (False, True):
        made = campaign_from_files(tmp_path / f"made{copy}", [loose], copy=copy, ask=answering(ANSWERS))
        data = made.folder / "raw/f01/alpha.sigmf-data"
        assert data.read_bytes() == (loose / "alpha.iq").read_bytes()
        assert not any(path.is_symlink() for path in made.folder.rglob("*"))
        assert not copy or data.stat().st_ino != (loose / "alpha.iq").stat().st_ino
        assert problems(made.folder, without=LAST) == []
    assert contents(loose) == before


@pytest.mark.slow
def test_command_asks_on_a_terminal_only_and_names_the_next_command(loose, tmp_path, monkeypatch, capsys):
    answers = iter(["1.024e9 1.2e9", "0.78125e-6", "620 right"])
    monkeypatch.setattr("builtins.input", lambda _: next(answers))
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("sys.argv", ["apertura", "init", str(tmp_path / "made"), str(loose)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code in (0, None)
    assert (
        capsys.readouterr()
        .out.splitlines()[-1]
        .endswith(f"Next: apertura plan {tmp_path / 'made'}, then apertura run {tmp_path / 'made'}")
    )
