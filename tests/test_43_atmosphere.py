"""Atmosphere of a campaign, from the config to the image: refractivity, wave speed, target positions."""

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from folders import complaint, copy_writable, image_of, state

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.geometry.atmosphere import Atmosphere, standard_weather
from apertura.core.geometry.geodesy import geodetic_from_ecef
from apertura.core.quality.point_targets import find_peak
from apertura.run.process import process
from apertura.simulation import PointTarget, SimulatedNode, Straight, WaveformSpecification, preset, simulate
from apertura.simulation.impairments import Impairments
from apertura.stages.node_log import raw_log
from apertura.stages.pair import open_pair
from apertura.stages.planning import air_decision
from apertura.stages.positions import in_air, scene_air

C = SPEED_OF_LIGHT_M_S


@pytest.mark.parametrize(
    ("atmosphere", "message"),
    [
        ("space", "auto"),
        ({"refractivity_n": 1000.0}, "less than or equal to 500"),
        (
            {"refractivity_n": 290.0, "temperature_c": 10.0},
            "1 of temperature_c, pressure_hpa and relative_humidity are stated in addition to",
        ),
        ({"temperature_c": 10.0, "pressure_hpa": 950.0}, "state all three"),
        ({"temperature_c": 10.0, "pressure_hpa": 95000.0, "relative_humidity": 50.0}, "pressure_hpa"),
        ({"temperature_k": 283.0}, "did you mean 'temperature_c'"),
        ({}, "state all three"),
        (290, "atmosphere"),
    ],
)
def test_invalid_atmosphere_is_one_message_with_the_key(tiny, atmosphere, message):
    printed = complaint(lambda: state(tiny, "scene", atmosphere=atmosphere))
    assert "scene.atmosphere" in printed
    assert message in printed


def positions(campaign):
    return raw_log(campaign, "f01", "uav1", 0.2).track.position.values


def test_atmosphere_is_that_of_the_config_at_terrain_height(tiny):
    """For terrain at 620 m and antennas 4.8 m above, N is smaller along the path by the factor exp(−2.4/7350)."""
    weather = {"temperature_c": 25.0, "pressure_hpa": 930.0, "relative_humidity": 70.0}
    for configured, expected in (
        ("auto", Atmosphere.standard(620.0)),
        (weather, Atmosphere.of_weather(25.0, 930.0, 70.0, ground_m=620.0)),
        ({"refractivity_n": 333.0}, Atmosphere.stated(333.0, ground_m=620.0)),
        ("vacuum", Atmosphere.vacuum()),
    ):
        campaign = state(tiny, "scene", atmosphere=configured)
        assert scene_air(campaign, positions(campaign)).atmosphere == expected
        opened = open_pair(campaign, "f01", "uav1-uav2")
        along_path = np.exp(-2.4 / 7350)
        assert opened.air["refractivity_n"] == pytest.approx(along_path * expected.refractivity_n, rel=1e-4)
        assert opened.wave_speed_m_s == pytest.approx(C / (1 + 1e-6 * opened.air["refractivity_n"]), rel=1e-9)
        assert expected.source in air_decision(opened).reason
    assert opened.wave_speed_m_s == C


def test_atmosphere_is_unchanged_by_a_focus_height_of_one_metre(tiny):
    campaign = state(tiny, "scene", height_m=621.0)
    assert scene_air(campaign, positions(campaign)).atmosphere == Atmosphere.standard(620.0)


def test_electrical_length_of_the_sidelink_depends_on_its_height(tiny):
    campaign = state(tiny, "scene", atmosphere={"refractivity_n": 300.0})
    air = scene_air(campaign, positions(campaign))
    start = positions(campaign)[:5]
    up = start / np.linalg.norm(start, axis=1, keepdims=True)
    high, other = start + 2000 * up, start + 2000 * up + np.array([0.0, 30.0, 0.0])
    height_m = geodetic_from_ecef(high)[:, 2]
    np.testing.assert_allclose(
        air.electrical_m(high, other), 30 + 30 * 300e-6 * np.exp((620 - height_m) / 7350), rtol=1e-7
    )


def test_product_reports_its_atmosphere_and_the_shift_in_vacuum(finished_tiny):
    report = json.loads((finished_tiny.results / "f01/uav1-uav2/image.json").read_text())
    air = report["atmosphere"]
    assert air["source"] == "standard atmosphere, terrain height 620 m, humidity 50 %"
    assert air["vacuum_shift_m"] == pytest.approx(air["refractivity_n"] * 1e-6 * 12.2, rel=0.15)
    assert report["models"]["atmosphere"].startswith(f"N = {air['refractivity_n']:.1f}: standard atmosphere")
    (line,) = (line for line in report["budget"] if line["cause"] == "atmosphere")
    assert line["stated"].startswith("not configured; assumed standard atmosphere")
    assert 1e-4 < line["shift_m"] < 1e-3  # 25 N over a path of 12 m
    assert 0 < line["phase_rad"] < 0.02
    stage = open_stage(finished_tiny.stage("profile", "f01", "uav1-uav2"), "profile")
    assert stage.attrs["wave_speed_m_s"] == pytest.approx(C / (1 + 1e-6 * air["refractivity_n"]), rel=1e-9)


# ---- Phase histories --------------------------------------------------------------------------------------------


MEAN_INDEX = 1 + 300e-6 * (1 - np.exp(-400 / 7350)) / (400 / 7350)
"""Mean refractive index between the terrain, where N is 300, and a height of 400 m."""


def phase_history(reference):
    position = np.array([[0.0, -500.0, 400.0], [5.0, -500.0, 400.0]])
    return xr.Dataset(
        {
            "tx_position": (("pulse", "axis"), position),
            "rx_position": (("pulse", "axis"), position),
            "reference_delay": ("pulse", np.full(2, 1000.0 / C)),
        },
        attrs={"reference": reference},
    )


@pytest.mark.parametrize(
    ("configured", "reference", "path_m", "slower"),
    [
        ("auto", "point", 1000.0, True),
        ("auto", "delay", 1000.0 / MEAN_INDEX, True),
        ("point", "delay", 1000.0, True),
        ("measured", "point", 1000.0 / MEAN_INDEX, True),
        ("corrected", "point", 1000.0, False),
    ],
)
def test_phase_history_is_referenced_to_a_point_or_a_delay(tmp_path, configured, reference, path_m, slower):
    (tmp_path / "config").mkdir()
    (tmp_path / "config/config.yaml").write_text(
        "campaign: c\nwaveform: {kind: phase_history, format: hdf5, air: " + configured + "}\nnodes: {radar: {}}\n"
        "scene: {crs: local, bounds_m: [-5, -5, 5, 5], spacing_m: 0.5, atmosphere: {refractivity_n: 300}}\n"
    )
    (tmp_path / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\tradar\tradar\n")
    history = in_air(Campaign.load(tmp_path), phase_history(reference))
    speed = history.attrs["wave_speed_m_s"]
    np.testing.assert_allclose(history.reference_delay * speed, path_m, rtol=1e-12)
    assert (speed < C) == slower


# ---- A flight in the atmosphere -------------------------------------------------------------------------------------

HEIGHT_M = 300.0


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Write a flight at 300 m height past a target at 300 m, in air 10 K and 20 hPa above the standard atmosphere."""
    base = preset("demo")
    range_m, pulses = HEIGHT_M * np.sqrt(2), 120
    waveform = WaveformSpecification(200, 1.3e9, 1e6, 1e-6, 4e-6, 256e6, 20.0)
    long_m = range_m / 3
    tracks = {
        name: Straight((ahead - long_m / 2, -HEIGHT_M, HEIGHT_M), (long_m * 20 / pulses, 0.0, 0.0))
        for name, ahead in (("uav1", 0.0), ("uav2", 12.0))
    }
    celsius, hpa, _ = standard_weather(base.origin.height_m)
    warm = Atmosphere.of_weather(celsius + 10, hpa + 20, 50.0, ground_m=0.0).refractivity_n
    specification = replace(
        base,
        waveform=waveform,
        targets=(PointTarget((0.0, 0.0, 0.0)),),
        nodes=dict.fromkeys(tracks, SimulatedNode(impairments=Impairments(radar_snr_db=25.0, doppler=False))),
        flights=(replace(base.flights[0], tracks=tracks, pulses=pulses),),
        scene=replace(base.scene, half_width_m=4.0, spacing_m=0.1),
        atmosphere=warm,
    )
    return simulate(tmp_path_factory.mktemp("air") / "campaign", specification, seed=1), warm


def north_error_m(campaign, pair):
    """Return the northward displacement of the target in the image."""
    image = image_of(campaign, pair)
    row, column = np.unravel_index(int(np.abs(image).argmax()), image.shape)
    peak = find_peak(image, int(row), int(column))
    truth = json.loads((campaign.root / "truth.json").read_text())["targets"][0]
    grid = json.loads((campaign.results / "scene.json").read_text())["grid"]
    return truth["y"] - (grid["north_m"] - (peak.row + 0.5) * grid["spacing_m"])


@pytest.mark.slow
def test_configured_atmosphere_puts_targets_at_their_positions(flown, tmp_path):
    """Errors are 1 cm (cells of 75 cm) in configured air, within the budget for `auto`, and as in eq. 5 for vacuum."""
    root, warm = flown
    pairs, expected_m = ("uav1-uav1", "uav1-uav2"), 1e-6 * warm * HEIGHT_M * np.sqrt(2) * np.sqrt(2)
    results = {}
    for name, air in (("stated", {"refractivity_n": warm}), ("auto", "auto"), ("vacuum", "vacuum")):
        copy = copy_writable(root, tmp_path / name)
        state(copy, "scene", atmosphere=air)
        campaign = process(copy)
        reports = {pair: json.loads((campaign.results / f"f01/{pair}/image.json").read_text()) for pair in pairs}
        budget = next(line for line in reports["uav1-uav1"]["budget"] if line["cause"] == "atmosphere")
        fused = json.loads((campaign.results / "f01/fused/image.json").read_text())
        results[name] = (
            {pair: north_error_m(campaign, pair) for pair in pairs},
            budget["shift_m"],
            fused["coherence"]["mean"],
        )
        assert fused["coherence"]["mean"] > 0.98
    assert max(map(abs, results["stated"][0].values())) < 0.01
    auto, shift_m = results["auto"][0], results["auto"][1]
    assert 0.003 < max(map(abs, auto.values())) < 2 * shift_m < 0.04
    for error_m in results["vacuum"][0].values():
        assert -error_m == pytest.approx(expected_m, rel=0.08)
        assert abs(error_m) < 1.2 * results["vacuum"][1]  # the budget assumes N = 300
