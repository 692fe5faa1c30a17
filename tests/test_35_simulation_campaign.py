"""Simulated folders against the input contract, the sample campaign and packages that know nothing of this one."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sigmf
import yaml
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from apertura.campaign import Campaign
from apertura.cli import app
from apertura.errors import CampaignError
from apertura.geometry.geodesy import ecef_from_geodetic, ecef_from_projected, projected_from_ecef
from apertura.simulation import preset, read_specification, simulate, specification_text
from apertura.simulation.continuous import Framing, continuous_blocks, pulse_samples
from apertura.simulation.impairments import Adc, Clock, Impairments, Localization, TimeTag, Timing, UniformPhase
from apertura.simulation.observation import fly
from apertura.simulation.presets import PRESETS
from apertura.simulation.recording import full_scale
from apertura.simulation.scene import Clutter, Line, Origin, Plate, PointTarget, scatterers
from apertura.simulation.specification import (
    CampaignSpecification,
    ImageGrid,
    SimulatedFlight,
    SimulatedNode,
    WaveformSpecification,
    draw_campaign,
)
from apertura.simulation.synthesis import samples
from apertura.simulation.trajectory import GaussianBeam, Straight, Waypoints, Wobble, phase_centre

C = 299_792_458.0
SHARED = Path(__file__).parents[2] / "shared" / "data"
ORIGIN = Origin(48.0, 9.0, 500.0)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("demo") / "campaign", preset("demo", pulses=24), seed=5)


def small_simulation(*, framing=None, continuous=False, secondary=None, pulses=6, **flight):
    """Two nodes at a low sampling rate; pulses 2 ms apart, so that a continuous recording stays small."""
    waveform = WaveformSpecification(64, 1.2e9 + 4567e3, 250e3, 5e-6, 2e-6, 32e6, 500.0)
    tracks = {"a": Straight((-2.0, -11.0, 5.0), (5.0, 0.0, 0.0)), "b": Straight((2.7, -11.0, 5.0), (5.0, 0.0, 0.0))}
    targets = (PointTarget((0.0, 0.0, 0.0)), PointTarget((1.0, 2.0, 0.5), 0.5))
    nodes = {
        "a": SimulatedNode({"radar_rx": (0.3, 0.0, 0.0)}),
        "b": SimulatedNode(impairments=secondary or Impairments()),
    }
    plan = SimulatedFlight("f01", "a", tracks, pulses, framing=framing, continuous=continuous, **flight)
    grid = ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.05)
    return CampaignSpecification("small", ORIGIN, waveform, targets, nodes, (plan,), grid)


def flown(specification):
    """What each node of the first flight records, and the campaign drawn."""
    campaign = draw_campaign(specification, np.random.default_rng(1))
    standing = scatterers(specification.origin, specification.targets, np.random.default_rng(0))
    return fly(campaign, specification.flights[0], standing, np.random.default_rng(0)), campaign


def leaves(tree, prefix=""):
    if not isinstance(tree, dict):
        return {prefix}
    return set().union(*(leaves(value, f"{prefix}.{key}") for key, value in tree.items()), {prefix})


def contents(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_the_folder_has_the_files_and_keys_of_the_real_sample(demo):
    sample = SHARED / "campaign-sample"
    if not sample.exists():
        pytest.skip("campaign-sample is not here")
    assert set(contents(demo)) == set(contents(sample))
    mine, theirs = (yaml.safe_load((root / "config/config.yaml").read_text()) for root in (demo, sample))
    assert leaves(mine) == leaves(theirs)
    for name in ("uav1", "uav2"):
        mine, theirs = (json.loads((root / f"raw/f01/{name}.sigmf-meta").read_text()) for root in (demo, sample))
        assert set(mine["global"]) == set(theirs["global"])
        assert set(mine["captures"][0]) == set(theirs["captures"][0])
    for name in ("uav1.track.csv", "uav2.track.pos"):
        mine, theirs = ((root / "raw/f01" / name).read_text().splitlines() for root in (demo, sample))
        assert [line for line in mine if line[0] in "t%"] == [line for line in theirs if line[0] in "t%"]


@pytest.mark.parametrize("name", ["uav1", "uav2"])
def test_recordings_are_valid_to_the_sigmf_package_and_hold_what_truth_says(demo, name):
    recording = sigmf.fromfile(str(demo / f"raw/f01/{name}.sigmf-meta"))
    recording.validate()  # schema
    recording.calculate_hash()  # raises where the data are not those hashed
    node = json.loads((demo / "truth.json").read_text())["flights"]["f01"]["nodes"][name]
    kept = node["kept"] or list(range(24))
    starts = [capture["core:sample_start"] for capture in recording.get_captures()]
    assert starts == [4000 * order for order in range(len(kept))]
    assert recording.sample_count == 4000 * len(kept)


def test_time_tags_are_late_by_the_error_drawn(demo):
    truth = json.loads((demo / "truth.json").read_text())["flights"]["f01"]["nodes"]["uav2"]
    meta = json.loads((demo / "raw/f01/uav2.sigmf-meta").read_text())
    tags = np.array([capture["core:datetime"][:-1] for capture in meta["captures"]], "datetime64[ns]")
    kept = np.array(truth["kept"] if truth["kept"] is not None else range(24))
    late_s = (tags - np.datetime64("2025-05-14T09:30:00")) / np.timedelta64(1, "ns") * 1e-9 - kept / 20
    assert_allclose(late_s, np.array(truth["tag_error_s"])[kept], atol=1.1e-6)
    assert late_s.mean() == pytest.approx(3.7e-3, abs=3e-4)


def test_the_same_generator_state_writes_identical_bytes(tmp_path):
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


def test_a_folder_that_holds_something_is_left_alone(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "mine.txt").write_text("mine")
    with pytest.raises(CampaignError, match="something is there already"):
        simulate(tmp_path / "there", small_simulation(), seed=0)
    assert contents(tmp_path) == {"there/mine.txt": b"mine"}


def test_recorded_samples_have_the_phase_of_the_geometry_in_the_logs(tmp_path):
    """From bytes alone: DFT, code, CSV log, truth's target; 1e-3 rad."""
    simulation = small_simulation()
    one = replace(simulation, targets=(PointTarget((0.5, 1.0, 0.3)),))
    offset = {"radar": 1.374}
    fixed = replace(one, nodes=dict.fromkeys(one.nodes, SimulatedNode(path_offset_m=offset)))
    root = simulate(tmp_path / "c", fixed, seed=0)
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
    place = ecef_from_projected("EPSG:32632", *(np.array(target[key]) for key in ("x", "y", "height_m")))
    path_m = 2 * np.linalg.norm(antenna - place, axis=1) + 1.374
    frequency = 1.2e9 + 4567e3 + 250e3 * np.arange(64)
    residual = np.angle(transfer * np.exp(2j * np.pi * frequency * path_m[:, None] / C))
    assert abs(residual.mean(axis=1)).max() < 1e-3
    assert abs(residual).max() < 5e-3  # 14 bits


def test_gps_time_is_eighteen_seconds_ahead_of_the_csv_log(tmp_path):
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


def test_a_calibration_flight_has_its_own_reflector_and_the_config_its_stated_offsets(tmp_path):
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


def stream_of(simulation, name, **settings):
    """A node's continuous recording as complex samples per channel, and its channels."""
    flight = simulation.flights[0]
    channels = flown(simulation)[0][name].channels
    time_s = np.arange(flight.pulses) / simulation.waveform.prf_hz
    frames = {"framing": flight.framing, "first_frame": flight.first_frame}
    blocks = list(continuous_blocks(channels, time_s, Adc(16, 20.0), np.random.default_rng(0), **frames, **settings))
    counts = np.concatenate(blocks).astype(float)
    return counts[..., 0] + 1j * counts[..., 1], channels, time_s, blocks


FRAMING = Framing(register_bits=7, chip_samples=4, counter_bits=3, bit_chips=5, guard_samples=16)


def test_a_continuous_recording_cut_at_its_pulses_is_the_triggered_recording():
    simulation = small_simulation(framing=FRAMING, continuous=True)
    stream, channels, time_s, _ = stream_of(simulation, "a")
    triggered = samples(channels["radar"], None)
    starts = pulse_samples(channels["radar"], time_s)
    assert_allclose(starts, np.rint(starts), atol=1e-6)  # the transmitter's own pulses fall on its samples
    cut = np.stack([stream[start : start + 224, 0] for start in np.rint(starts).astype(int)])
    gain = (cut * triggered.conj()).sum() / (abs(triggered) ** 2).sum()
    assert abs(np.angle(gain)) < 1e-4
    assert_allclose(cut / gain, triggered, atol=1e-3 * abs(triggered).max())


def test_the_preamble_lies_where_truth_says_and_the_payload_counts_and_wraps():
    late = Impairments(
        clock=Clock.of_ppm(1.0, carrier_hz=1.2e9 + 4567e3, sample_rate_hz=32e6), timing=Timing(offset_s=7e-6)
    )
    simulation = small_simulation(framing=FRAMING, continuous=True, secondary=late, first_frame=5)
    stream, channels, time_s, _ = stream_of(simulation, "b")
    chips = np.repeat(FRAMING.preamble().astype(float), 4)
    mixed = stream[:, 1] * np.exp(-2j * np.pi * 32 * 250e3 / 32e6 * np.arange(len(stream)))
    match = abs(np.correlate(mixed, chips))
    delay = channels["sidelink"].paths.delay_s[:, 0]
    expected = (pulse_samples(channels["sidelink"], time_s) + delay * 32e6) - FRAMING.lead_samples
    for pulse, start in enumerate(expected):
        near = slice(int(start) - 2000, int(start) + 2000)
        found = near.start + int(np.argmax(match[near]))
        assert abs(found - start) < 1
        reference = (mixed[found : found + len(chips)] * chips).sum()
        body = mixed[found + len(chips) : found + len(chips) + 6 * 20].reshape(6, 20).sum(axis=1) / reference
        bits = (body.real > 0).astype(int)
        assert (bits[:3] == 1 - bits[3:]).all()
        assert int("".join(map(str, bits[:3])), 2) == (5 + pulse) % 8


def test_a_continuous_recording_is_the_definition_on_the_nodes_own_clock():
    """One oscillator and one sampling clock run through; frames arrive where they arrive."""
    late = Impairments(clock=Clock(cfo_hz=1234.0, sfo_hz=345.0), timing=Timing(offset_s=7.3e-6))
    simulation = small_simulation(framing=FRAMING, continuous=True, secondary=late, first_frame=5)
    stream, channels, time_s, _ = stream_of(simulation, "b")
    waveform, paths = channels["radar"].waveform, channels["radar"].paths
    rate = 32e6 + 345.0
    index = np.arange(len(stream))
    begun_s = -1e-3 + 7.3e-6
    for pulse in (0, 5):
        middle = round((time_s[pulse] - begun_s) * rate)
        near = index[middle - 1800 : middle + 260]
        since = begun_s + near / rate - time_s[pulse]
        expected = np.zeros(len(near), complex)
        for delay, amplitude in zip(paths.delay_s[pulse], paths.amplitude[pulse], strict=True):
            here = since - delay
            turns = np.outer(here - 2e-6, waveform.baseband_hz)
            symbol = ((here >= 0) & (here < 7e-6)) * (np.exp(2j * np.pi * turns) @ waveform.codes)
            sent = symbol + FRAMING.signal(waveform, 5 + pulse, here)
            expected += amplitude * np.exp(-2j * np.pi * waveform.carrier_hz * delay) * sent
        expected *= np.exp(-2j * np.pi * 1234.0 * near / rate)
        scale = full_scale(channels["radar"], Adc(16, 20.0)) / 2**15
        assert_allclose(stream[near, 0] * scale, expected, atol=1e-3 * abs(expected).max())


def test_a_smaller_block_changes_nothing_but_the_memory():
    noisy = Impairments(radar_snr_db=20.0, sidelink_snr_db=20.0)
    simulation = small_simulation(framing=FRAMING, continuous=True, secondary=noisy)
    whole, _, _, blocks = stream_of(simulation, "b")
    pieces, _, _, small = stream_of(simulation, "b", block_samples=3000)
    assert (pieces == whole).all()
    assert max(map(len, small)) <= 3000 < max(map(len, blocks))


def test_nothing_is_missed_by_a_recorder_that_runs_through():
    careless = Impairments(missed_fraction=0.5)
    for continuous in (False, True):
        simulation = small_simulation(continuous=continuous, secondary=careless, pulses=50)
        kept = flown(simulation)[0]["b"].draw.kept
        assert kept.all() == continuous


def test_the_log_is_off_by_the_localization_error():
    wrong = Impairments(localization=Localization(0.05))
    simulation = small_simulation(secondary=wrong)
    flight = simulation.flights[0]
    seen, _ = flown(simulation)
    logged = phase_centre(ORIGIN, flight.tracks["b"], np.arange(6) / 500)
    assert abs(seen["b"].draw.position_error_m).max() > 0.01
    for place in (seen["b"].truth.radar_rx, seen["b"].truth.sidelink_rx):
        assert_allclose(logged - place, seen["b"].draw.position_error_m, atol=1e-8)
    assert_allclose(seen["b"].truth.radar_tx, phase_centre(ORIGIN, flight.tracks["a"], np.arange(6) / 500))


def test_between_frames_there_is_noise_alone():
    noisy = Impairments(radar_snr_db=20.0, sidelink_snr_db=20.0)
    simulation = small_simulation(framing=FRAMING, continuous=True, secondary=noisy)
    stream, channels, _, _ = stream_of(simulation, "b")
    quiet = stream[:30000, 0]  # half an interval before the first pulse
    frame_power = (abs(stream[32000:32224, 0]) ** 2).mean()
    variance = channels["radar"].noise_variance
    echo_power = (abs(samples(channels["radar"], None)[0]) ** 2).mean()
    assert (abs(quiet) ** 2).mean() / frame_power == pytest.approx(variance / (echo_power + variance), rel=0.2)
    assert len(stream) == 6 * 64000


def test_a_continuous_folder_is_one_segment_that_describes_its_frames(tmp_path):
    simulation = small_simulation(framing=FRAMING, continuous=True, secondary=Impairments(time_tag=TimeTag(2e-3)))
    root = simulate(tmp_path / "c", simulation, seed=0)
    recording = sigmf.fromfile(str(root / "raw/f01/b.sigmf-meta"))
    recording.validate()
    (segment,) = recording.get_captures()
    assert segment["core:datetime"] == "2025-05-14T09:30:00.001000Z"  # 1 ms before the first pulse, 2 ms late
    described = recording.get_global_field("apertura:framing")
    chips = np.load(root / described["preamble"])
    assert set(chips.tolist()) == {-1, 1}
    assert described["chip_samples"] == 4
    truth = json.loads((root / "truth.json").read_text())["flights"]["f01"]["nodes"]["b"]
    assert len(truth["pulse_start_sample"]) == 6


def test_overlapping_frames_are_refused(tmp_path):
    simulation = small_simulation(framing=replace(FRAMING, register_bits=14), continuous=True)
    with pytest.raises(CampaignError, match="shorter than half a repetition interval"):
        simulate(tmp_path / "c", simulation, seed=0)
    assert not list(tmp_path.iterdir())


def test_triggered_captures_carry_the_frame_number(tmp_path):
    root = simulate(tmp_path / "c", small_simulation(framing=FRAMING, first_frame=6), seed=0)
    meta = json.loads((root / "raw/f01/b.sigmf-meta").read_text())
    assert [capture["apertura:frame"] for capture in meta["captures"]] == [6, 7, 0, 1, 2, 3]


def test_lever_arms_turn_with_the_node():
    east = Straight((0.0, 0.0, 5.0), (1.0, 0.0, 0.0))  # nose east: forward is east, right is south
    arm = ORIGIN.enu(phase_centre(ORIGIN, east, np.zeros(1), (1.0, 2.0, 0.5)))[0]
    assert_allclose(arm, [1.0, -2.0, 4.5], atol=1e-5)  # the ellipsoid's normal turns by 1e-6 rad


def test_an_echo_is_as_strong_as_both_antennas_see_its_target():
    """Level antennas that look left of a flight eastward: bearings and depressions are those of a map."""
    plain = small_simulation()
    beams = {
        "a": {"radar_tx": GaussianBeam((-90.0, 0.0), (30.0, 40.0))},
        "b": {"radar_rx": GaussianBeam((270.0, 0.0), (50.0, 90.0))},
    }
    nodes = {name: replace(node, antennas=beams[name]) for name, node in plain.nodes.items()}
    standing = scatterers(ORIGIN, plain.targets, np.random.default_rng(0))
    amplitude = {
        name: flown(simulation)[0]["b"].channels["radar"].paths.amplitude
        for name, simulation in (("plain", plain), ("looking", replace(plain, nodes=nodes)))
    }
    gain = 1.0
    for name, widths in (("a", (30, 40)), ("b", (50, 90))):
        path = plain.flights[0].tracks[name].position(np.arange(6) / 500.0)
        east, north, up = np.moveaxis(ORIGIN.enu(standing.position_m)[None] - path[:, None], -1, 0)
        bearing, above = np.degrees(np.arctan2(east, north)), np.degrees(np.arctan2(up, np.hypot(east, north)))
        db = -12.0412 * ((bearing / widths[0]) ** 2 + (above / widths[1]) ** 2)
        gain = gain * 10 ** (db / 20)
    assert gain.max() / gain.min() > 1.2
    assert_allclose(amplitude["looking"] / amplitude["plain"], gain, rtol=1e-3)


def test_a_wobbling_flight_has_the_spread_asked_for_and_its_log_resolves_it():
    straight = Straight((0.0, 0.0, 5.0), (1.0, 0.0, 0.0))
    shaken = Wobble(sigma_m=(0.02, 0.03, 0.04)).around(straight, 600.0, np.random.default_rng(0))
    fine = np.arange(0, 600, 0.025)
    away = shaken.position(fine) - straight.position(fine)
    assert away.std(axis=0) == pytest.approx([0.02, 0.03, 0.04], rel=0.15)
    coarse = np.arange(0, 600.1, 0.1)
    linear = np.interp(fine, coarse, shaken.position(coarse)[:, 2])
    assert abs(linear - shaken.position(fine)[:, 2]).max() < 1e-3


def test_a_real_flight_log_is_flown_point_by_point():
    log = SHARED / "dji_rtk_ansfl" / "GTExtended.csv"
    if not log.exists():
        pytest.skip("dji_rtk_ansfl is not here")
    table = np.genfromtxt(log, delimiter=",", skip_header=1)[:200]
    time_s, geodetic = table[:, 0] / 1e3, table[:, 1:4]
    origin = Origin(*geodetic[0])
    logged = origin.enu(ecef_from_geodetic(*geodetic.T))
    path = Waypoints(tuple(time_s - time_s[10]), tuple(map(tuple, logged))).intended()
    assert_allclose(path.position(np.zeros(1)), logged[10:11], atol=1e-9)
    assert_allclose(path.position(time_s - time_s[10]), logged, atol=1e-9)
    course = np.arctan2(*(logged[11] - logged[9])[:2])
    assert path.attitude(np.zeros(1))[0] == pytest.approx([0.0, 0.0, course])


def test_extended_targets_and_clutter_scatter_as_much_as_they_say():
    rng = np.random.default_rng(0)
    line = Line((0, 0, 0), (4, 0, 0), 9, amplitude=2.0).points(rng)
    plate = Plate((0, 0, 0), (1, 0, 0), (0, 1, 1), (3, 4), amplitude=1j).points(rng)
    assert line.amplitude.sum() == pytest.approx(2.0)
    assert plate.amplitude.sum() == pytest.approx(1j)
    assert len(plate.amplitude) == 12
    clutter = Clutter((-10, -10, 10, 10), reflectivity=0.25, density_per_m2=20).points(rng)
    assert (abs(clutter.amplitude) ** 2).sum() / 400 == pytest.approx(0.25, rel=0.05)


@pytest.mark.parametrize("name", list(PRESETS))
def test_a_preset_keeps_its_echoes_inside_the_prefix_and_its_targets_on_the_grid(name):
    """In a triggered recording; one that runs through is cut where the pulses are."""
    specification = preset(name, pulses=30)
    recordings, campaign = flown(specification)
    waveform = campaign.waveform
    for recording in recordings.values():
        for channel in recording.channels.values():
            late_s = 0.0 if specification.flights[0].continuous else channel.start_s[:, None]
            arrival = channel.paths.delay_s - late_s
            assert arrival.max() < waveform.cyclic_prefix_s
            assert arrival.min() > -(waveform.symbol_s - 1 / waveform.subcarrier_spacing_hz)
    xmin, ymin, xmax, ymax = specification.scene.bounds(specification.origin)
    width = {"demo": 12.0, "swarm": 12.0, "paper": 24.0, "continuous": 40.0}[name]
    assert (xmax - xmin, ymax - ymin) == pytest.approx((width, width))
    standing = scatterers(specification.origin, specification.targets, np.random.default_rng(0))
    x, y, _ = projected_from_ecef(specification.scene.crs, standing.position_m).T
    assert ((xmin < x) & (x < xmax) & (ymin < y) & (y < ymax)).all()


@pytest.mark.parametrize("name", list(PRESETS))
def test_a_preset_makes_a_campaign_that_loads_and_whose_files_pass_the_check(tmp_path, name):
    root = simulate(tmp_path / "campaign", preset(name, pulses=3))
    Campaign.load(root).check_files()


@pytest.mark.parametrize("name", list(PRESETS))
def test_a_preset_printed_as_yaml_reads_back_as_itself(tmp_path, name):
    (tmp_path / "spec.yaml").write_text(specification_text(preset(name)))
    assert read_specification(tmp_path / "spec.yaml") == preset(name)


SPEC = """
campaign: by_hand
origin: {latitude_deg: 48, longitude_deg: 9, height_m: 500}
waveform: {subcarriers: 64, carrier_hz: 1.2e9, subcarrier_spacing_hz: 250e3, symbol_s: 5e-6, cyclic_prefix_s: 2e-6,
  sample_rate_hz: 32e6, prf_hz: 500}
targets:
- {kind: point, position_m: [0, 1, 0], amplitude: 0.5+0.5j}
- {kind: clutter, bounds_m: [-1, -1, 1, 1], reflectivity: 0.1}
nodes:
  a: {}
  b:
    attitude: none
    log_format: pos
    impairments: {carrier_phase: {kind: uniform}, radar_snr_db: 20, time_tag: {offset_s: 1e-3}}
flights:
- name: f01
  transmitter: a
  pulses: 4
  start_utc: 2025-05-14T10:00:00Z
  tracks:
    a: {kind: straight, start_m: [-2, -11, 5], velocity_m_s: [5, 0, 0], wobble: {}}
    b: {kind: waypoints, time_s: [-5, 0, 5], position_m: [[-20, -11, 5], [3, -11, 5], [25, -11, 5]]}
scene: {crs: "EPSG:32632", half_width_m: 3, spacing_m: 0.1}
"""


def test_a_specification_in_yaml_gives_the_bytes_of_the_same_values_in_python(tmp_path):
    (tmp_path / "spec.yaml").write_text(SPEC)
    late = Impairments(carrier_phase=UniformPhase(), radar_snr_db=20, time_tag=TimeTag(1e-3))
    tracks = {
        "a": Straight((-2, -11, 5), (5, 0, 0), Wobble()),
        "b": Waypoints((-5, 0, 5), ((-20, -11, 5), (3, -11, 5), (25, -11, 5))),
    }
    same = CampaignSpecification(
        "by_hand",
        ORIGIN,
        WaveformSpecification(64, 1.2e9, 250e3, 5e-6, 2e-6, 32e6, 500),
        (PointTarget((0, 1, 0), 0.5 + 0.5j), Clutter((-1, -1, 1, 1), 0.1)),
        {"a": SimulatedNode(), "b": SimulatedNode(attitude="none", log_format="pos", impairments=late)},
        (SimulatedFlight("f01", "a", tracks, 4, start_utc="2025-05-14T10:00:00"),),
        ImageGrid("EPSG:32632", half_width_m=3, spacing_m=0.1),
    )
    by_hand, in_python = (
        contents(simulate(tmp_path / name, chosen, seed=3))
        for name, chosen in (("yaml", tmp_path / "spec.yaml"), ("python", same))
    )
    assert by_hand == in_python
    assert b"2025-05-14T10:00:00.00" in by_hand["raw/f01/a.sigmf-meta"]


@pytest.mark.parametrize(
    ("right", "wrong", "complaints"),
    [
        ("radar_snr_db", "radar_snr", ("nodes.b.impairments.radar_snr: unknown key", "'radar_snr_db'")),
        ("half_width_m", "halfwidth_m", ("scene.halfwidth_m: unknown key", "'half_width_m'")),
        ("wobble", "wabble", ("flights.0.tracks.a.wabble: unknown key", "'wobble'")),
        ("reflectivity: 0.1", "reflectivity: -1", ("targets.1.reflectivity", "greater than or equal to 0", "found -1")),
        ("kind: clutter", "kind: tree", ("targets.1", "tree", "clutter")),
        ("pulses: 4", "pulses: 0", ("flights.0.pulses", "greater than 0")),
        ("transmitter: a", "transmitter: c", ("flights.0: transmitter 'c' has no track", "a, b")),
        ("    a: {kind", "    c: {kind", ("transmitter 'a' has no track",)),
        ("subcarriers: 64", "subcarriers: 640", ("waveform", "128.0", "subcarriers=640")),
        ("time_s: [-5, 0, 5]", "time_s: [-5, 5]", ("flights.0.tracks.b", "one row for each of the 2 times")),
        ("symbol_s: 5e-6, ", "", ("waveform.symbol_s: missing",)),
    ],
)
def test_what_is_wrong_in_a_specification_is_named_with_file_key_and_the_nearest_valid_one(
    tmp_path, right, wrong, complaints
):
    assert right in SPEC
    (tmp_path / "spec.yaml").write_text(SPEC.replace(right, wrong))
    with pytest.raises(CampaignError, match=r"spec\.yaml") as error:
        simulate(tmp_path / "campaign", tmp_path / "spec.yaml")
    assert all(complaint in str(error.value) for complaint in complaints), str(error.value)
    assert not (tmp_path / "campaign").exists()


def test_parts_given_in_python_replace_those_of_the_specification(tmp_path):
    root = simulate(
        tmp_path / "campaign",
        small_simulation(),
        targets=[PointTarget((0.0, 2.0, 0.0), 3.0)],
        tracks={"a": Straight((0.0, -11.0, 5.0), (5.0, 0.0, 0.0)), "c": Straight((1.0, -11.0, 5.0), (5.0, 0.0, 0.0))},
        waveform=WaveformSpecification(32, 1.3e9, 250e3, 5e-6, 2e-6, 32e6, 400.0),
        impairments={"c": Impairments(radar_snr_db=7.0)},
    )
    truth = json.loads((root / "truth.json").read_text())
    assert [target["amplitude"] for target in truth["targets"]] == [3.0]
    assert "radar_snr_db=7.0" in truth["flights"]["f01"]["nodes"]["c"]["impairments"]
    settings = Campaign.load(root).settings
    assert set(settings.nodes) == {"a", "c"}
    assert (settings.waveform.subcarriers, settings.waveform.prf_hz) == (32, 400.0)
    with pytest.raises(CampaignError, match="nodes are a, b, z, but tracks are of a, b"):
        simulate(tmp_path / "other", small_simulation(), impairments={"z": Impairments()})


def test_the_command_line_takes_a_specification_or_a_preset_and_a_seed(tmp_path):
    def run(*arguments):
        return CliRunner().invoke(app, ["simulate", *map(str, arguments)])

    printed = run("--print-spec", "swarm").stdout
    assert CampaignSpecification(**yaml.safe_load(printed)) == preset("swarm")
    (tmp_path / "spec.yaml").write_text(SPEC)
    run(tmp_path / "spec.yaml", tmp_path / "first", "--seed", 4)
    simulate(tmp_path / "again", tmp_path / "spec.yaml", seed=4)
    assert contents(tmp_path / "first") == contents(tmp_path / "again")
    for arguments in ((), ("a", "b", "c"), ("a", "b", "--preset", "demo"), ("a", "--preset", "dmeo")):
        assert isinstance(run(*arguments).exception, CampaignError)
