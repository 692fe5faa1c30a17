"""Specifications of simulations: YAML, Python, presets and their errors."""

import json

import numpy as np
import pytest
import yaml
from folders import contents, recordings_of, require_files, small_simulation
from typer.testing import CliRunner

from apertura.campaign.folder import Campaign
from apertura.cli import app
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import projected_from_ecef
from apertura.simulation import preset, read_specification, simulate, specification_text
from apertura.simulation.impairments import Impairments, TimeTag, UniformPhase
from apertura.simulation.presets import PRESETS
from apertura.simulation.specification import (
    CampaignSpecification,
    ImageGrid,
    SimulatedFlight,
    SimulatedNode,
)
from apertura.simulation.targets import Clutter, Origin, PointTarget, Straight, Waypoints, Wobble, scatterers
from apertura.simulation.waveform import WaveformSpecification


@pytest.mark.quick("demo", "paper", "swarm", "continuous", "flight", "paper-lab")
@pytest.mark.parametrize("name", list(PRESETS))
def test_preset_has_echoes_inside_the_prefix_and_targets_on_the_grid(name):
    """Recordings are triggered; a continuous recording is cut at its pulses."""
    specification = preset(name, pulses=30)
    recordings, campaign = recordings_of(specification)
    waveform = campaign.waveform
    for recording in recordings.values():
        for channel in recording.channels.values():
            late_s = 0.0 if specification.flights[0].continuous else channel.start_s[:, None]
            arrival = channel.paths.delay_s - late_s
            assert arrival.max() < waveform.cyclic_prefix_s
            assert arrival.min() > -(waveform.symbol_s - 1 / waveform.subcarrier_spacing_hz)
    xmin, ymin, xmax, ymax = specification.scene.bounds(specification.origin)
    widths = {
        "demo": 12.0,
        "swarm": 12.0,
        "paper": 24.0,
        "continuous": 40.0,
        "paper-uav": (12.0, 4.0),
        "flight": 409.6,
        "first-flight": 12.0,
        "payload": 12.0,
        "revisit": 22.0,
    }
    width = widths.get(name, 6.0)
    assert (xmax - xmin, ymax - ymin) == pytest.approx(width if isinstance(width, tuple) else (width, width))
    targets = tuple(target for target in specification.targets if not isinstance(target, Clutter))
    points = scatterers(specification.origin, targets, np.random.default_rng(0))
    x, y, _ = projected_from_ecef(specification.scene.crs, points.position_m).T
    assert ((xmin < x) & (x < xmax) & (ymin < y) & (y < ymax)).all()


@pytest.mark.quick("demo", "swarm", "continuous", "flight")
@pytest.mark.parametrize("name", list(PRESETS))
def test_preset_gives_a_campaign_that_loads_and_has_all_files(tmp_path, name):
    root = simulate(tmp_path / "campaign", preset(name, pulses=3))
    campaign = Campaign.load(root)
    require_files(campaign)
    specification = preset(name)
    assert [flight.name for flight in campaign.flights] == [flight.name for flight in specification.flights]
    assert campaign.settings.nodes.keys() == specification.nodes.keys()
    next((root / "raw").rglob("*.sigmf-data")).unlink()
    with pytest.raises(CampaignError, match="no such file"):
        require_files(campaign)


@pytest.mark.parametrize("name", list(PRESETS))
def test_preset_printed_as_yaml_reads_back_unchanged(tmp_path, name):
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


def test_yaml_and_python_specifications_give_identical_bytes(tmp_path):
    (tmp_path / "spec.yaml").write_text(SPEC)
    impairments = Impairments(carrier_phase=UniformPhase(), radar_snr_db=20, time_tag=TimeTag(1e-3))
    tracks = {
        "a": Straight((-2, -11, 5), (5, 0, 0), Wobble()),
        "b": Waypoints((-5, 0, 5), ((-20, -11, 5), (3, -11, 5), (25, -11, 5))),
    }
    specification = CampaignSpecification(
        "by_hand",
        Origin(48.0, 9.0, 500.0),
        WaveformSpecification(64, 1.2e9, 250e3, 5e-6, 2e-6, 32e6, 500),
        (PointTarget((0, 1, 0), 0.5 + 0.5j), Clutter((-1, -1, 1, 1), 0.1)),
        {"a": SimulatedNode(), "b": SimulatedNode(attitude="none", log_format="pos", impairments=impairments)},
        (SimulatedFlight("f01", "a", tracks, 4, start_utc="2025-05-14T10:00:00"),),
        ImageGrid("EPSG:32632", half_width_m=3, spacing_m=0.1),
    )
    from_yaml, from_python = (
        contents(simulate(tmp_path / name, source, seed=3))
        for name, source in (("yaml", tmp_path / "spec.yaml"), ("python", specification))
    )
    assert from_yaml == from_python
    assert b"2025-05-14T10:00:00.00" in from_yaml["raw/f01/a.sigmf-meta"]


@pytest.mark.parametrize(
    ("valid", "invalid", "complaints"),
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
def test_specification_errors_name_file_key_and_nearest_valid_key(tmp_path, valid, invalid, complaints):
    assert valid in SPEC
    (tmp_path / "spec.yaml").write_text(SPEC.replace(valid, invalid))
    with pytest.raises(CampaignError, match=r"spec\.yaml") as error:
        simulate(tmp_path / "campaign", tmp_path / "spec.yaml")
    assert all(complaint in str(error.value) for complaint in complaints), str(error.value)
    assert not (tmp_path / "campaign").exists()


def test_python_arguments_replace_parts_of_the_specification(tmp_path):
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
    with pytest.raises(CampaignError, match="nodes are a, b, z, but the nodes with a track are a, b"):
        simulate(tmp_path / "other", small_simulation(), impairments={"z": Impairments()})


def test_command_line_accepts_a_specification_or_a_preset_and_a_seed(tmp_path):
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
