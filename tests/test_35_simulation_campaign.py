"""Simulated folders, compared with the input contract, the sample campaign and independent packages."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import sigmf
import yaml
from folders import SHARED, contents, recordings_of, small_simulation
from numpy.testing import assert_allclose

from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import ecef_from_geodetic, ecef_from_projected
from apertura.simulation import preset, simulate
from apertura.simulation.impairments import Impairments, Localization
from apertura.simulation.specification import (
    SimulatedNode,
)
from apertura.simulation.targets import (
    Clutter,
    GaussianBeam,
    Line,
    Origin,
    Plate,
    PointTarget,
    Straight,
    TargetChange,
    Waypoints,
    Wobble,
    phase_centre,
    scatterers,
)

C = 299_792_458.0
ORIGIN = Origin(48.0, 9.0, 500.0)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("demo") / "campaign", preset("demo", pulses=24), seed=5)


def leaves(tree, prefix=""):
    if not isinstance(tree, dict):
        return {prefix}
    return set().union(*(leaves(value, f"{prefix}.{key}") for key, value in tree.items()), {prefix})


def test_folder_has_the_files_and_keys_of_the_real_sample(demo):
    sample = SHARED / "campaign-sample"
    if not sample.exists():
        pytest.skip("campaign-sample is not available")
    assert set(contents(demo)) == set(contents(sample))
    simulated, real = (yaml.safe_load((root / "config/config.yaml").read_text()) for root in (demo, sample))
    assert leaves(simulated) == leaves(real)
    for name in ("uav1", "uav2"):
        simulated, real = (json.loads((root / f"raw/f01/{name}.sigmf-meta").read_text()) for root in (demo, sample))
        assert set(simulated["global"]) == set(real["global"])
        assert set(simulated["captures"][0]) == set(real["captures"][0])
    for name in ("uav1.track.csv", "uav2.track.pos"):
        simulated, real = ((root / "raw/f01" / name).read_text().splitlines() for root in (demo, sample))
        assert [line for line in simulated if line[0] in "t%"] == [line for line in real if line[0] in "t%"]


@pytest.mark.parametrize("name", ["uav1", "uav2"])
def test_recordings_are_valid_sigmf_and_contain_the_pulses_of_truth_json(demo, name):
    recording = sigmf.fromfile(str(demo / f"raw/f01/{name}.sigmf-meta"))
    recording.validate()  # against the schema
    recording.calculate_hash()  # raises an error if the data do not match the hash
    node = json.loads((demo / "truth.json").read_text())["flights"]["f01"]["nodes"][name]
    kept = node["kept"] or list(range(24))
    starts = [capture["core:sample_start"] for capture in recording.get_captures()]
    assert starts == [4000 * order for order in range(len(kept))]
    assert recording.sample_count == 4000 * len(kept)


def test_time_tags_are_late_by_the_drawn_error(demo):
    truth = json.loads((demo / "truth.json").read_text())["flights"]["f01"]["nodes"]["uav2"]
    meta = json.loads((demo / "raw/f01/uav2.sigmf-meta").read_text())
    tags = np.array([capture["core:datetime"][:-1] for capture in meta["captures"]], "datetime64[ns]")
    kept = np.array(truth["kept"] if truth["kept"] is not None else range(24))
    late_s = (tags - np.datetime64("2025-05-14T09:30:00")) / np.timedelta64(1, "ns") * 1e-9 - kept / 20
    assert_allclose(late_s, np.array(truth["tag_error_s"])[kept], atol=1.1e-6)
    assert late_s.mean() == pytest.approx(3.7e-3, abs=3e-4)


def test_same_seed_writes_identical_bytes(tmp_path):
    first, again, other = (
        contents(simulate(tmp_path / name, small_simulation(), seed=seed))
        for name, seed in (("first", 1), ("again", 1), ("other", 2))
    )
    assert first == again
    noisy = small_simulation(secondary=Impairments(radar_snr_db=10.0))
    first, again, other = (
        contents(simulate(tmp_path / f"noisy{name}", noisy, seed=seed))
        for name, seed in (("first", 1), ("again", 1), ("other", 2))
    )
    assert first == again
    assert first["raw/f01/b.sigmf-data"] != other["raw/f01/b.sigmf-data"]


def test_non_empty_folder_is_left_unchanged(tmp_path):
    (tmp_path / "occupied").mkdir()
    (tmp_path / "occupied" / "mine.txt").write_text("mine")
    with pytest.raises(CampaignError, match="already exists and is not an empty folder"):
        simulate(tmp_path / "occupied", small_simulation(), seed=0)
    assert contents(tmp_path) == {"occupied/mine.txt": b"mine"}


@pytest.mark.parametrize(("atmosphere", "index"), [("vacuum", 1.0), (320.0, 1.00032)])
def test_recorded_samples_have_the_phase_of_the_logged_geometry(tmp_path, atmosphere, index):
    """The phase is computed from DFT, code, CSV log and true target; the refractive index applies to air only."""
    simulation = small_simulation()
    single = replace(simulation, targets=(PointTarget((0.5, 1.0, 0.3)),), atmosphere=atmosphere)
    offset = {"radar": 1.374}
    with_offset = replace(single, nodes=dict.fromkeys(single.nodes, SimulatedNode(path_offset_m=offset)))
    root = simulate(tmp_path / "c", with_offset, seed=0)
    counts = np.fromfile(root / "raw/f01/a.sigmf-data", "<i2").reshape(6, 224, 2).astype(float)
    captured = (counts[..., 0] + 1j * counts[..., 1])[:, 64:192]
    transfer = np.fft.fft(captured, axis=1)[:, :64] / np.load(root / "raw/codes.npy")
    with (root / "raw/f01/a.track.csv").open() as lines:
        log = list(csv.DictReader(lines))
    keys = ("latitude_deg", "longitude_deg", "height_m")
    epochs = ecef_from_geodetic(*np.array([[float(row[key]) for key in keys] for row in log]).T)
    times = np.array([row["time_utc"][:-1] for row in log], "datetime64[ns]") - np.datetime64("2025-05-14T09:30")
    times = times / np.timedelta64(1, "s")
    antenna = np.column_stack([np.interp(np.arange(6) / 500, times, axis) for axis in epochs.T])
    target = json.loads((root / "truth.json").read_text())["targets"][0]
    position = ecef_from_projected("EPSG:32632", *(np.array(target[key]) for key in ("x", "y", "height_m")))
    path_m = index * 2 * np.linalg.norm(antenna - position, axis=1) + 1.374
    frequency = 1.2e9 + 4567e3 + 250e3 * np.arange(64)
    residual = np.angle(transfer * np.exp(2j * np.pi * frequency * path_m[:, None] / C))
    assert abs(residual.mean(axis=1)).max() < 1e-3
    assert abs(residual).max() < 5e-3  # quantisation with 14 bits


def test_gps_time_is_18_s_ahead_of_utc(tmp_path):
    simulation = small_simulation()
    first = {}
    for name, form in (("gpst", "pos"), ("utc", "pos_utc")):
        nodes = {**simulation.nodes, "b": SimulatedNode(log_format=form)}
        root = simulate(tmp_path / name, replace(simulation, nodes=nodes), seed=0)
        lines = (root / "raw/f01/b.track.pos").read_text().splitlines()
        assert lines[4].split()[1] == {"gpst": "GPST", "utc": "UTC"}[name]
        first[name] = lines[5].split()
    assert first["gpst"][:2] == ["2025/05/14", "09:30:16.000"]
    assert first["utc"][:2] == ["2025/05/14", "09:29:58.000"]
    assert first["gpst"][2:] == first["utc"][2:]


def test_calibration_flight_has_its_own_reflector_and_stated_offsets(tmp_path):
    simulation = small_simulation()
    flight = simulation.flights[0]
    calibration = replace(flight, name="cal", kind="calibration", targets=(PointTarget((0.0, 3.0, 1.0), 5.0),))
    node = SimulatedNode(path_offset_m={"radar": 0.9}, stated_path_offset_m={"radar": 0.0})
    planned = replace(simulation, flights=(flight, calibration), nodes={**simulation.nodes, "b": node})
    root = simulate(tmp_path / "c", planned, seed=0)
    rows = (root / "config/flights.tsv").read_text().splitlines()
    assert rows == ["flight\tkind\ttransmitter\tnodes", "f01\timage\ta\ta,b", "cal\tcalibration\ta\ta,b"]
    truth = json.loads((root / "truth.json").read_text())
    assert [target["amplitude"] for target in truth["flights"]["cal"]["targets"]] == [5.0]
    assert truth["flights"]["cal"]["nodes"]["b"]["path_offset_m"] == {"radar": 0.9}
    config = yaml.safe_load((root / "config/config.yaml").read_text())
    assert config["nodes"]["b"]["path_offset_m"] == {"radar": 0.0}


def test_log_contains_the_localization_error():
    impairments = Impairments(localization=Localization(0.05))
    simulation = small_simulation(secondary=impairments)
    flight = simulation.flights[0]
    recordings, _ = recordings_of(simulation)
    logged = phase_centre(ORIGIN, flight.tracks["b"], np.arange(6) / 500)
    assert abs(recordings["b"].draw.position_error_m).max() > 0.01
    for true_centre in (recordings["b"].truth.radar_rx, recordings["b"].truth.sidelink_rx):
        assert_allclose(logged - true_centre, recordings["b"].draw.position_error_m, atol=1e-8)
    assert_allclose(recordings["b"].truth.radar_tx, phase_centre(ORIGIN, flight.tracks["a"], np.arange(6) / 500))


def test_lever_arms_rotate_with_the_node():
    east = Straight((0.0, 0.0, 5.0), (1.0, 0.0, 0.0))  # heading east: forward is east, right is south
    arm = ORIGIN.enu(phase_centre(ORIGIN, east, np.zeros(1), (1.0, 2.0, 0.5)))[0]
    assert_allclose(arm, [1.0, -2.0, 4.5], atol=1e-5)  # the ellipsoid normal rotates by 1e-6 rad


def test_echo_amplitude_includes_both_antenna_patterns():
    """Level antennas on the left of an eastward flight; bearing and elevation follow from map coordinates."""
    omnidirectional = small_simulation()
    beams = {
        "a": {"radar_tx": GaussianBeam((-90.0, 0.0), (30.0, 40.0))},
        "b": {"radar_rx": GaussianBeam((270.0, 0.0), (50.0, 90.0))},
    }
    nodes = {name: replace(node, antennas=beams[name]) for name, node in omnidirectional.nodes.items()}
    targets = scatterers(ORIGIN, omnidirectional.targets, np.random.default_rng(0))
    amplitude = {
        name: recordings_of(simulation)[0]["b"].channels["radar"].paths.amplitude
        for name, simulation in (("plain", omnidirectional), ("looking", replace(omnidirectional, nodes=nodes)))
    }
    gain = 1.0
    for name, widths in (("a", (30, 40)), ("b", (50, 90))):
        path = omnidirectional.flights[0].tracks[name].position(np.arange(6) / 500.0)
        east, north, up = np.moveaxis(ORIGIN.enu(targets.position_m)[None] - path[:, None], -1, 0)
        bearing, elevation = np.degrees(np.arctan2(east, north)), np.degrees(np.arctan2(up, np.hypot(east, north)))
        db = -12.0412 * ((bearing / widths[0]) ** 2 + (elevation / widths[1]) ** 2)
        gain = gain * 10 ** (db / 20)
    assert gain.max() / gain.min() > 1.2
    assert_allclose(amplitude["looking"] / amplitude["plain"], gain, rtol=1e-3)


def test_wobble_has_the_requested_deviation_and_is_resolved_by_the_log():
    straight = Straight((0.0, 0.0, 5.0), (1.0, 0.0, 0.0))
    wobbling = Wobble(sigma_m=(0.02, 0.03, 0.04)).around(straight, 600.0, np.random.default_rng(0))
    fine = np.arange(0, 600, 0.025)
    deviation = wobbling.position(fine) - straight.position(fine)
    assert deviation.std(axis=0) == pytest.approx([0.02, 0.03, 0.04], rel=0.15)
    coarse = np.arange(0, 600.1, 0.1)
    linear = np.interp(fine, coarse, wobbling.position(coarse)[:, 2])
    assert abs(linear - wobbling.position(fine)[:, 2]).max() < 1e-3


def test_waypoints_of_a_real_log_are_reproduced():
    log = SHARED / "dji_rtk_ansfl" / "GTExtended.csv"
    if not log.exists():
        pytest.skip("dji_rtk_ansfl is not available")
    table = np.genfromtxt(log, delimiter=",", skip_header=1)[:200]
    time_s, geodetic = table[:, 0] / 1e3, table[:, 1:4]
    origin = Origin(*geodetic[0])
    logged = origin.enu(ecef_from_geodetic(*geodetic.T))
    path = Waypoints(tuple(time_s - time_s[10]), tuple(map(tuple, logged))).intended()
    assert_allclose(path.position(np.zeros(1)), logged[10:11], atol=1e-9)
    assert_allclose(path.position(time_s - time_s[10]), logged, atol=1e-9)
    course = np.arctan2(*(logged[11] - logged[9])[:2])
    assert path.attitude(np.zeros(1))[0] == pytest.approx([0.0, 0.0, course])


def test_extended_targets_and_clutter_have_the_stated_amplitude():
    rng = np.random.default_rng(0)
    line = Line((0, 0, 0), (4, 0, 0), 9, amplitude=2.0).points(rng)
    plate = Plate((0, 0, 0), (1, 0, 0), (0, 1, 1), (3, 4), amplitude=1j).points(rng)
    assert line.amplitude.sum() == pytest.approx(2.0)
    assert plate.amplitude.sum() == pytest.approx(1j)
    assert len(plate.amplitude) == 12
    clutter = Clutter((-10, -10, 10, 10), reflectivity=0.25, density_per_m2=20).points(rng)
    assert (abs(clutter.amplitude) ** 2).sum() / 400 == pytest.approx(0.25, rel=0.05)


def test_changed_targets_leave_the_rest_of_the_scene_unchanged(tmp_path):
    specification = small_simulation()
    clutter = Clutter((-2.0, -2.0, 2.0, 2.0), 0.5, 8.0)
    (first,) = specification.flights
    changes = (TargetChange(1, factor=0.5j), TargetChange(2, shift_m=(0.0, 0.3, 0.1)))
    flights = (
        first,
        replace(first, name="f02", changes=(TargetChange(0),)),
        replace(first, name="f03", changes=changes),
    )
    targets = (clutter, *specification.targets)
    root = simulate(tmp_path / "campaign", replace(specification, targets=targets, flights=flights))
    samples = {name: (root / f"raw/{name}/a.sigmf-data").read_bytes() for name in ("f01", "f02", "f03")}
    assert samples["f02"] == samples["f01"]
    assert samples["f03"] != samples["f01"]
    stated = json.loads((root / "truth.json").read_text())["flights"]
    assert "changes" not in stated["f01"]
    assert stated["f03"]["changes"][0] == {"target": 1, "shift_m": [0.0, 0.0, 0.0], "factor": "0.5j"}
    # echoes are linear in the scene: the changed flight is the whole scene with both changed targets
    before, after = (scatterers(ORIGIN, targets, np.random.default_rng(4), made) for made in ((), changes))
    same = slice(0, len(before.amplitude) - 2)
    assert np.array_equal(before.position_m[same], after.position_m[same])
    assert after.amplitude[-2] == 0.5j * before.amplitude[-2]
    assert np.linalg.norm(after.position_m[-1] - before.position_m[-1]) == pytest.approx(np.hypot(0.3, 0.1))


def test_change_of_an_unknown_target_is_refused():
    specification = small_simulation()
    (first,) = specification.flights
    with pytest.raises(ValueError, match="changes target 2; the last target is number 1"):
        replace(specification, flights=(replace(first, changes=(TargetChange(2),)),))
    with pytest.raises(ValueError, match="changes refer to the targets of the campaign"):
        replace(first, targets=specification.targets, changes=(TargetChange(0),))
