"""Beat signals of an FMCW radar, from files to images: target positions, falling sweeps, mixers, motion."""

import functools
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from folders import ROOT, complaint, edit_config

from apertura.campaign.config import validated
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.check import problems
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.dechirp import FrequencySweep, transfer_of
from apertura.core.quality.point_targets import find_peak
from apertura.run.process import process
from apertura.simulation.fmcw import FmcwFlight, write_fmcw_campaign
from apertura.stages.scene import open_scene
from apertura.stages.transfer import recorded_echo

FAST = FrequencySweep(2.2e9, 400e6, 20e-6, 25e6)
"""Sweep of 400 MHz about 2.4 GHz in 20 µs: chirp rate 2e13 Hz/s, beat frequencies up to 12.5 MHz, 187 m of path."""

NEAR = ((0.0, 0.0, 0.0), (-2.0, 2.0, 0.0), (2.5, -1.5, 0.0))
FLIGHT = FmcwFlight(FAST, 100.0, 200, {"uav1": (0.0, -20.0, 10.0)}, NEAR, spacing_m=0.0625, half_width_m=3.5)


def write_campaign(tmp_path, flight=FLIGHT, **waveform):
    root = write_fmcw_campaign(tmp_path / "campaign", flight, waveform=waveform)
    edit_config(root, lambda document: document.update(processing={"autofocus": False}))
    return root


def image_of(root, pair="uav1-uav1"):
    return open_stage(Campaign.load(root).stage("image", "f01", pair), "image")


def peaks(root, flight, targets=None, pair="uav1-uav1"):
    """Return east, north (m, from the origin) and magnitude of the peak next to each target."""
    grid, pixels = open_scene(Campaign.load(root)).grid, image_of(root, pair).image.values
    positions = []
    for east, north, _ in targets or flight.targets:
        row, column = grid.pixel_of(flight.origin[0] + east, flight.origin[1] + north)
        peak = find_peak(pixels, round(float(row)), round(float(column)))
        positions.append(
            (
                east + (peak.column - float(column)) * flight.spacing_m,
                north - (peak.row - float(row)) * flight.spacing_m,
                abs(peak.value),
            )
        )
    return np.array(positions)


def error_and_magnitudes(root, flight, pair="uav1-uav1"):
    measured = peaks(root, flight, pair=pair)
    return np.abs(measured[:, :2] - np.array(flight.targets)[:, :2]).max(), measured[:, 2]


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "flagged"), [(1.2, False), (4.0, True)])
def test_gain_step_during_a_flight_is_flagged(tmp_path, gain, flagged):
    root = write_campaign(tmp_path)
    file = root / "raw/f01/uav1.npy"
    beats = np.load(file)
    beats[120:] *= gain
    np.save(file, beats)
    process(root, last="image")
    flags = image_of(root).attrs["flags"]
    assert ("gain_step" in flags) == flagged
    assert not flagged or flags["gain_step"].startswith("power +12.0 dB from pulse 121 of 200 on, 1.200 s after")


@pytest.mark.quick("complex")
@pytest.mark.parametrize(
    "sweep",
    [
        FAST,
        replace(FAST, iq="complex"),
        replace(FAST, iq="conjugate", bandwidth_hz=-400e6, start_hz=2.6e9, settle_s=1e-6, reference_path_m=6.0),
        replace(FAST, bandwidth_hz=-400e6, start_hz=2.6e9),
    ],
    ids=["real", "complex", "conjugate falling", "real falling"],
)
def test_target_position_errors_are_below_a_centimetre(tmp_path, sweep):
    flight = replace(FLIGHT, sweep=sweep)
    root = write_campaign(tmp_path, flight)
    assert problems(root) == []
    process(root, last="cube")
    error_m, heights = error_and_magnitudes(root, flight)
    assert error_m < 0.01
    assert heights == pytest.approx(1.0, abs=0.05)
    assert set(image_of(root).attrs["quality"]["flags"]) <= {"sub_apertures"}


@pytest.mark.parametrize("example", range(2))
def test_configs_of_the_how_to_are_valid(example):
    blocks = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs/howto/fmcw.md").read_text(encoding="utf-8"), re.S)
    assert len(blocks) == 2
    document = {"campaign": "c", "nodes": {"a": {}}, **yaml.safe_load(blocks[example])}
    assert validated(document, where="fmcw.md").waveform.kind == "fmcw"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bandwidth_hz": 0}, "not a band above 0 Hz"),
        ({"bandwidth_hz": -3e9}, "not a band above 0 Hz"),
        ({"settle_s": 21e-6}, "samples per sweep"),
        ({"prf_hz": 60e3}, "longer than 1/prf_hz"),
        ({"format": "afrl_mat"}, "choose beat_npy, beat_mat, beat_wav"),
        ({"iq": "imaginary"}, "waveform.*iq"),
    ],
)
def test_impossible_sweep_is_refused_by_its_key(tmp_path, changes, message):
    root = write_campaign(tmp_path, replace(FLIGHT, sweeps=2), **changes)
    assert re.search(message, complaint(lambda: Campaign.load(root)))


@pytest.mark.slow
def test_second_node_on_the_same_clock_images_the_same_targets(tmp_path):
    flight = replace(FLIGHT, nodes={"uav1": (0.0, -20.0, 10.0), "uav2": (3.0, -21.0, 11.0)})
    root = write_campaign(tmp_path, flight)
    process(root, last="cube")
    for pair in ("uav1-uav1", "uav1-uav2"):
        error_m, heights = error_and_magnitudes(root, flight, pair)
        assert error_m < 0.01
        assert heights == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_residual_video_phase_displaces_a_far_target_as_predicted(tmp_path, monkeypatch):
    """The frequency of the phase is lower by γτ, which reduces the along-track distance in the same proportion."""
    east = 12.0
    flight = replace(
        FLIGHT,
        nodes={"uav1": (0.0, -60.0, 10.0)},
        targets=((east, 4.0, 0.0),),
        middle=(east, 4.0),
        half_width_m=2.0,
    )
    root = write_campaign(tmp_path, flight)
    process(root, last="cube")
    assert error_and_magnitudes(root, flight)[0] < 0.01
    monkeypatch.setattr(
        "apertura.formats.phase_histories.fmcw.transfer_of", functools.partial(transfer_of, deskewed=False)
    )
    uncorrected = write_campaign(tmp_path / "uncorrected", flight)
    process(uncorrected, last="cube")
    delay_s = 2 * np.linalg.norm(np.subtract(flight.targets[0], (0.0, -60.0, 10.0))) / SPEED_OF_LIGHT_M_S
    displacement_m = east * FAST.slope_hz_s * delay_s / 2.4e9
    assert displacement_m > 0.04
    assert peaks(uncorrected, flight)[0, 0] == pytest.approx(east - displacement_m, abs=0.005)


@pytest.mark.slow
def test_mixer_of_opposite_sign_is_flagged(tmp_path):
    flight = replace(FLIGHT, sweep=replace(FAST, iq="complex"))
    root = write_campaign(tmp_path, flight, iq="conjugate")
    process(root, last="cube")
    flags = image_of(root).attrs["quality"]["flags"]
    assert {"echo_outside_scene", "defocused"} & set(flags)
    assert any("change waveform.iq from complex to conjugate or vice versa" in line for line in flags.values())


def test_antenna_motion_during_a_slow_sweep_is_flagged(tmp_path):
    slow = replace(FLIGHT, sweep=FrequencySweep(2.2e9, 400e6, 8e-3, 100e3), sweeps=120)
    campaign = Campaign.load(write_campaign(tmp_path, slow))
    flags = recorded_echo(campaign, "f01", "uav1-uav1").attrs["flags"]
    assert set(flags) == {"sweep_motion"}
    assert "0.64 wavelengths" in flags["sweep_motion"]


@pytest.mark.parametrize("sweeps", [1, 2, 3])
def test_fewer_than_three_sweeps_are_refused(tmp_path, sweeps):
    campaign = Campaign.load(write_campaign(tmp_path, replace(FLIGHT, sweeps=sweeps)))
    if sweeps < 3:
        message = complaint(lambda: recorded_echo(campaign, "f01", "uav1-uav1"))
        assert re.search(rf"{sweeps} pulses? with samples and positions; expected at least 3", message)
    else:
        assert recorded_echo(campaign, "f01", "uav1-uav1").sizes["pulse"] == sweeps


def test_sweep_of_few_samples_is_refused_with_their_number(tmp_path):
    root = write_campaign(tmp_path, replace(FLIGHT, sweeps=20), settle_s=19.6e-6)
    assert "10 subcarriers yield 20 range samples; expected more than the 64 samples" in complaint(
        lambda: process(root)
    )


def test_missing_sweeps_are_counted_and_flagged(tmp_path):
    root = write_campaign(tmp_path)
    beat = np.load(root / "raw/f01/uav1.npy")
    beat[60:100] = 0
    np.save(root / "raw/f01/uav1.npy", beat)
    attrs = recorded_echo(Campaign.load(root), "f01", "uav1-uav1").attrs
    assert attrs["pulses"] == {"used": 160, "dropped": 40, "reasons": {"all samples zero": 40}}
    assert set(attrs["flags"]) == {"pulses_missing"}
