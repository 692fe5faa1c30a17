"""Waveforms given by the samples of a pulse: from the recording to images."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from folders import edit_config, state

from apertura.campaign.config import validated
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.check import problems
from apertura.common.errors import CampaignError
from apertura.core.echo.compression import window_weights
from apertura.core.quality.point_targets import find_peak
from apertura.run.process import process
from apertura.simulation import Impairments, PointTarget, PulseSpecification, preset, read_specification, simulate
from apertura.simulation.impairments import Timing
from apertura.simulation.specification import specification_text
from apertura.stages import echo, ingest
from apertura.stages.assess import hypotheses
from apertura.stages.pair import open_pair
from apertura.stages.planning import budget_of
from apertura.stages.scene import open_scene
from apertura.stages.transfer import PairEcho
from apertura.stages.transmitted import read_pulse
from apertura.workflow.resources import Resources

ROOT = Path(__file__).parents[1]
PAIRS = "uav1-uav1", "uav1-uav2"
TARGETS = (PointTarget((0.0, 0.0, 0.0)), PointTarget((-4.0, -4.0, 0.0)), PointTarget((4.0, 4.0, 0.0)))
SIZES = {"carrier_hz": 1.4048e9, "listen_s": 0.5e-6, "sample_rate_hz": 1.024e9, "prf_hz": 20.0, "lead_s": 0.1e-6}
PULSES = {
    "chirp": PulseSpecification("chirp", bandwidth_hz=409.6e6, pulse_s=1e-6, **SIZES),
    "pn": PulseSpecification("pn", bandwidth_hz=512e6, pulse_s=1e-6, band_hz=(-204.8e6, 204.8e6), **SIZES),
}


@pytest.fixture(scope="module", params=[pytest.param(name, marks=pytest.mark.slow) for name in PULSES])
def imaged(request, tmp_path_factory):
    """Image three targets from two nodes with noise, two clocks, missed triggers, random phases and start times."""
    root = tmp_path_factory.mktemp(request.param) / "campaign"
    simulate(root, preset("demo", pulses=150), waveform=PULSES[request.param], targets=TARGETS)
    return process(root, last="cube")


@pytest.fixture
def tiny(tmp_path):
    """Write a campaign of six chirp pulses."""
    return simulate(tmp_path / "campaign", preset("demo", pulses=6), waveform=PULSES["chirp"], targets=TARGETS)


def targets(campaign):
    """Return the grid and the pixels of the targets."""
    grid = open_scene(campaign).grid
    truth = json.loads((campaign.root / "truth.json").read_text())["targets"]
    return grid, [tuple(float(value) for value in grid.pixel_of(one["x"], one["y"])) for one in truth]


@pytest.mark.parametrize("pair", PAIRS)
def test_targets_of_a_pulse_focus_within_a_centimetre(imaged, pair):
    image = open_stage(imaged.stage("image", "f01", pair), "image").image.values
    grid, places = targets(imaged)
    assert len(places) == 3
    for row, column in places:
        peak = find_peak(image, round(row), round(column))
        assert grid.spacing_m * np.hypot(peak.row - row, peak.column - column) < 0.01


def test_pairs_of_a_pulse_are_coherent(imaged):
    images = [open_stage(imaged.stage("image", "f01", pair), "image").image.values for pair in PAIRS]
    _, places = targets(imaged)
    for row, column in places:
        one, other = (find_peak(image, round(row), round(column)).value for image in images)
        assert abs(np.angle(one * np.conj(other))) < 0.15


@pytest.fixture(scope="module", params=PULSES)
def alone(request, tmp_path_factory):
    """Form the echoes of one target without noise."""
    root = tmp_path_factory.mktemp(f"{request.param}-alone") / "campaign"
    quiet = {"uav1": Impairments(), "uav2": Impairments(timing=Timing(half_width_s=20e-9))}
    simulate(root, preset("demo", pulses=20), waveform=PULSES[request.param], targets=TARGETS[:1], impairments=quiet)
    campaign = Campaign.load(root)
    for node in ("uav1", "uav2"):
        ingest.ingest(campaign, "f01", node)
    for pair in PAIRS:
        echo.echo(campaign, "f01", pair)
    return campaign


@pytest.mark.quick("chirp-*")
@pytest.mark.parametrize("pair", PAIRS)
def test_range_sidelobes_of_a_pulse_are_those_of_the_window(alone, pair):
    stage = PairEcho.opened(alone, "f01", pair).stage
    place = preset("demo").origin.ecef(np.zeros(3))
    path = sum(np.linalg.norm(stage[leg].values - place, axis=1) for leg in ("tx_position", "rx_position"))
    phase = np.exp(2j * np.pi * np.outer(path / 299792458, stage.frequency.values))
    mean = (stage.transfer.values * phase).mean(0)
    level = np.abs(np.fft.ifft(mean * window_weights("hann", mean.size), 16 * mean.size))
    assert level[0] > 0.999 * level.max()
    assert 20 * np.log10(level[38:-38].max() / level[0]) == pytest.approx(-31.5, abs=1.0)


def test_echo_reports_its_filter(imaged):
    for pair in PAIRS:
        attrs = PairEcho.opened(imaged, "f01", pair).stage.attrs
        assert attrs["waveform"]["filter"] == "inverse"
        assert attrs["waveform"]["loss_db"] < 4.5
        assert attrs["code"]["carried"] is True
        assert attrs["flags"] == {}


@pytest.mark.slow
@pytest.mark.parametrize(("rate_error", "flagged"), [(0.0, False), (0.02, True)])
def test_pulse_file_with_another_chirp_rate_is_flagged(tmp_path, rate_error, flagged):
    """The chirp has a time-bandwidth product of 410: an error of 2 % has 6.4 rad at the edges of the band."""
    root = simulate(tmp_path / "campaign", preset("demo", pulses=150), waveform=PULSES["chirp"], targets=TARGETS)
    file = root / "raw/pulse.npy"
    pulse = np.load(file)
    time_s = (np.arange(len(pulse)) - (len(pulse) - 1) / 2) / 1.024e9
    np.save(file, (pulse * np.exp(1j * np.pi * rate_error * 409.6e12 * time_s**2)).astype(np.complex64))
    image = process(root, last="image").stage("image", "f01", "uav1-uav1")
    attrs = open_stage(image, "image").attrs["quality"]
    assert ("range_defocused" in attrs["flags"]) == flagged
    assert (attrs["focus"]["verdict"] == "focused") != flagged


@pytest.mark.slow
def test_planned_pair_agrees_with_the_formed_echo(tiny):
    campaign = Campaign.load(tiny)
    planned = [open_pair(campaign, "f01", pair) for pair in PAIRS]
    for node in ("uav1", "uav2"):
        ingest.ingest(campaign, "f01", node)
    for pair, before in zip(PAIRS, planned, strict=True):
        echo.echo(campaign, "f01", pair)
        formed = open_pair(campaign, "f01", pair)
        np.testing.assert_allclose(before.frequency_hz, formed.frequency_hz, rtol=1e-12)
        assert before.path_limit_m == pytest.approx(formed.path_limit_m, abs=0.05)
        offset_m = PairEcho.opened(campaign, "f01", pair).stage.attrs["stated_offset_m"]
        if pair == "uav1-uav1":
            assert formed.path_limit_m == pytest.approx(
                (0.5e-6 - offset_m / 299792458) * formed.wave_speed_m_s, abs=1e-6
            )


def test_stop_and_go_error_is_that_of_the_pulse_duration(imaged):
    """The error is that of half the pulse of 1 µs if the total path changes by a few decimetres per second."""
    lines = {line.cause: line for line in budget_of(imaged, open_pair(imaged, "f01", PAIRS[0]), open_scene(imaged))}
    assert 0 < lines["stop and go"].effect.shift_m < 1e-6


@pytest.mark.slow
def test_no_hypothesis_improves_a_correct_image(imaged):
    grid, places = targets(imaged)
    x, y = grid.map_at(*places[0])
    assert hypotheses(imaged, "f01", brightest=(float(x), float(y)), cell_m=0.3) == []


def test_campaign_of_a_pulse_passes_the_checks_with_little_memory(tiny):
    assert problems(tiny) == []
    resources = Resources(Campaign.load(tiny))["echo"]

    class Wildcards:
        flight, pair = "f01", "uav1-uav2"

    assert 400 < resources.mem_mb(Wildcards(), 1) < 1500


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"listen_s": 0.6e-6}, "or the sum of lead_s, pulse_s and listen_s"),
        ({"pulse_s": 0.9e-6}, "complex64 of shape (1024,)"),
        ({"pulse": "raw/other.npy"}, "no such file"),
        ({"band_hz": [400e6, 500e6]}, "of the pulse's energy"),
        ({"carrier_hz": 1.2e9}, "waveform.carrier_hz"),
        ({"listen_s": 0.02e-6}, "the limit set by waveform.listen_s"),
    ],
)
def test_waveform_inconsistent_with_the_recording_is_reported_by_check(tiny, changed, message):
    edit_config(tiny, lambda document: document["waveform"].update(changed))
    lines = [str(problem) for problem in problems(tiny)]
    assert any(message in line for line in lines), lines


def test_lines_of_a_matched_pulse_are_not_removed_as_interference(tmp_path):
    """Profiles of both pairs are those without removal of interference."""
    pulse = PulseSpecification("pn", bandwidth_hz=512e6, pulse_s=1e-6, filter="matched", **SIZES)
    root, profiles = tmp_path / "campaign", []
    simulate(root, preset("demo", pulses=60), waveform=pulse, targets=TARGETS)
    process(root, last="scene")
    for setting in ("none", "auto"):
        campaign = state(root, "processing", interference=setting, autofocus="off")
        process(campaign, first="echo", last="profile")
        stages = [open_stage(campaign.stage("profile", "f01", pair), "profile") for pair in PAIRS]
        assert not [flag for stage in stages for flag in stage.attrs["flags"] if flag.startswith("interference")]
        profiles.append([stage.profile.values for stage in stages])
    for unchanged, cleaned in zip(*profiles, strict=True):
        np.testing.assert_array_equal(cleaned, unchanged)


@pytest.mark.quick("2.5e-07-True")
@pytest.mark.parametrize(("late_s", "cut"), [(0.05e-6, False), (0.25e-6, True), (-0.6e-6, True)])
def test_captures_that_truncate_the_direct_pulse_are_flagged(tmp_path, late_s, cut):
    """A capture begins 0.1 µs minus the recorder delay before the pulse, and ends 0.5 µs after the pulse."""
    root, timing = tmp_path / "campaign", {"uav2": Impairments(timing=Timing(offset_s=late_s))}
    simulate(root, preset("demo", pulses=20), waveform=PULSES["pn"], targets=TARGETS, impairments=timing)
    campaign = Campaign.load(root)
    for node in ("uav1", "uav2"):
        ingest.ingest(campaign, "f01", node)
    echo.echo(campaign, "f01", "uav1-uav2")
    assert ("pulse_truncated" in PairEcho.opened(campaign, "f01", "uav1-uav2").stage.attrs["flags"]) is cut


def test_too_short_captures_are_refused_by_the_echo_step(tiny):
    for node in ("uav1", "uav2"):
        ingest.ingest(Campaign.load(tiny), "f01", node)
    edit_config(tiny, lambda document: document["waveform"].update(listen_s=0.7e-6))
    with pytest.raises(CampaignError, match="lead_s, pulse_s and listen_s"):
        echo.echo(Campaign.load(tiny), "f01", "uav1-uav2")


def test_lead_is_refused_for_a_continuous_recording(tmp_path):
    """Captures start at the trigger; a lead would be interpreted as part of the delay."""
    root = simulate(tmp_path / "campaign", preset("continuous", pulses=2))
    waveform = {"kind": "samples", "carrier_hz": 1.2e9, "sample_rate_hz": 64e6, "prf_hz": 1000.0}
    waveform |= {"pulse_s": 4e-6, "listen_s": 2e-6, "lead_s": 1e-6}
    edit_config(root, lambda document: document.update(waveform=waveform))
    with pytest.raises(CampaignError, match=r"waveform.lead_s is 1e-06, and uav1.sigmf-meta is a continuous recording"):
        ingest.ingest(Campaign.load(root), "f01", "uav1")


def test_pulse_specification_is_read_back_unchanged(tmp_path):
    whole = preset("demo", pulses=3)
    changed = type(whole)(**{**vars(whole), "waveform": PULSES["pn"]})
    (tmp_path / "spec.yaml").write_text(specification_text(changed))
    assert read_specification(tmp_path / "spec.yaml") == changed


@pytest.mark.parametrize(
    ("changed", "message"),
    [({"bandwidth_hz": 2e9}, "exceeds sample_rate_hz"), ({"pulse": "pn", "bandwidth_hz": 300e6}, "whole samples")],
)
def test_pulse_that_cannot_be_sampled_is_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        PulseSpecification(**({"pulse": "chirp", "bandwidth_hz": 400e6, "pulse_s": 1e-6, **SIZES} | changed))


def test_pulse_of_the_how_to_agrees_with_its_config(tmp_path, monkeypatch):
    text = (ROOT / "docs/howto/samples.md").read_text(encoding="utf-8")
    code, config = (re.findall(rf"```{name}\n(.*?)```", text, re.S) for name in ("python", "yaml"))
    assert (len(code), len(config)) == (1, 1)
    waveform = validated(
        {"campaign": "c", "nodes": {"a": {}}, **yaml.safe_load(config[0])}, where="samples.md"
    ).waveform
    assert waveform.kind == "samples"
    (tmp_path / "raw").mkdir()
    monkeypatch.chdir(tmp_path)
    exec(code[0], {})
    pulse = read_pulse(tmp_path / waveform.pulse, waveform)
    spectrum = np.abs(np.fft.fft(pulse, waveform.capture_samples)) ** 2
    frequency_hz = np.fft.fftfreq(waveform.capture_samples, 1 / waveform.sample_rate_hz)
    inside = (frequency_hz >= waveform.band_hz[0]) & (frequency_hz <= waveform.band_hz[1])
    assert spectrum[inside].sum() > 0.95 * spectrum.sum()
    stated_m = float(re.search(r"total paths up to (\d+) m", text)[1])
    assert stated_m == pytest.approx(299792458 * waveform.longest_delay_s, rel=0.01)
