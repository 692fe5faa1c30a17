"""Flight design from a mission file: `apertura design`, `init --from` and `compare`."""

import copy
import json
import sys

import numpy as np
import pytest
import rasterio
import yaml
from folders import copy_writable

from apertura import cli
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.documents import read_json
from apertura.core.quality.point_targets import cut_through, find_peak
from apertura.run.process import process
from apertura.simulation.targets import PointTarget
from apertura.stages.scene import open_scene
from apertura.tools.design import designed
from apertura.tools.design.expected_images import rehearse
from apertura.tools.design.flight_plan import FlightPlan, read_flight_plan
from apertura.tools.design.view import _measured

EAST, NORTH = 570661.0, 5363707.0
PLAN = {
    "campaign": "dike",
    "waveform": {
        "kind": "ofdm",
        "subcarriers": 256,
        "subcarrier_spacing_hz": 4e5,
        "symbol_s": 2.5e-6,
        "cyclic_prefix_s": 6e-7,
        "carrier_hz": 1.3e9,
        "sample_rate_hz": 1.28e8,
        "prf_hz": 16.0,
    },
    "nodes": {
        "uav1": {
            "transmit_power_dbm": 10.0,
            "antennas": {"radar_tx_gain_dbi": 6.0, "radar_rx_gain_dbi": 6.0},
            "receiver": {"full_scale_counts": 8192, "full_scale_dbm": 0.0, "gain_db": 30.0, "noise_figure_db": 6.0},
            "attitude": "log",
        }
    },
    "scene": {
        "crs": "EPSG:32632",
        "bounds_m": [EAST - 5, NORTH - 5, EAST + 5, NORTH + 5],
        "spacing_m": 0.125,
        "height_m": 500.0,
    },
    "processing": {"autofocus": "off"},
    "flights": {
        "f01": {
            "transmitter": "uav1",
            "receivers": ["uav1"],
            "tracks": {"uav1": {"kind": "mission", "file": "dike.plan", "speed_m_s": 1.0}},
        }
    },
    "require": {"coverage": 0.95},
}
LINE = {
    "kind": "line",
    "start_m": [EAST - 8, NORTH - 30],
    "end_m": [EAST + 8, NORTH - 30],
    "height_m": 30.0,
    "speed_m_s": 1.0,
}
# 30 m south of the scene, from west to east.
WAYPOINTS = ((48.42228, 9.95497), (48.42228, 9.95519))


@pytest.fixture
def folder(tmp_path):
    items = [
        {"type": "SimpleItem", "command": 16, "frame": 3, "params": [0, 0, 0, None, *place, 30]} for place in WAYPOINTS
    ]
    mission = {"vehicleType": 2, "hoverSpeed": 5, "plannedHomePosition": [*WAYPOINTS[0], 0], "items": items}
    (tmp_path / "dike.plan").write_text(json.dumps({"fileType": "Plan", "mission": mission}))
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    return tmp_path


def run_command(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["apertura", *map(str, words)])
    with pytest.raises(SystemExit) as exit_info:
        cli.main()
    printed = capsys.readouterr()
    return exit_info.value.code or 0, printed.out, printed.err


def test_flight_time_includes_take_off_transit_and_landing(folder):
    """The flight adds climb and descent of 30 m at 2 m/s and a return of 15.6 m at 1 m/s to the mission of 15.6 s."""
    design = designed(read_flight_plan(folder / "plan.yaml"), folder)
    back_m = np.radians(WAYPOINTS[1][1] - WAYPOINTS[0][1]) * 6.378e6 * np.cos(np.radians(WAYPOINTS[0][0]))
    assert design.recording.transfer_s["f01"] == pytest.approx(2 * 30 / 2 + back_m, rel=0.01)
    assert design.recording.flight_s["f01"] == pytest.approx(2 * 30 / 2 + 2 * back_m, rel=0.01)


@pytest.mark.slow
def test_mission_yields_report_layers_and_config(folder, monkeypatch, capsys):
    status, out, err = run_command(monkeypatch, capsys, "design", folder / "plan.yaml", folder / "out")
    assert (status, err) == (0, "")
    table = [line.split() for line in out.splitlines()]
    assert ["coverage", "0.95", "1", "yes"] in [words[:4] for words in table]
    assert any("uav1" in line and "100.0" in line for line in out.splitlines())  # fraction of the scene, %
    page = (folder / "out" / "design.html").read_text()
    assert page.count("data:image/png") == 2
    assert "GO: all requirements met (1 of 1)" in page
    assert out.startswith("GO: all requirements met (1 of 1)\n")
    with rasterio.open(folder / "out/f01/uav1-uav1/nesz.tif") as raster:
        assert raster.shape == (80, 80)
        assert raster.tags()["APERTURA_PLANNED"] == "true"
        assert np.isfinite(raster.read(1)).all()
    assert len(json.loads((folder / "out/tracks.geojson").read_text())["features"]) == 2
    assert "LineString" in (folder / "out/tracks.kml").read_text()
    status, _, err = run_command(monkeypatch, capsys, "init", folder / "campaign", "--from", folder / "plan.yaml")
    assert (status, err) == (0, "")
    campaign = Campaign.load(folder / "campaign")
    assert campaign.flights[0].pairs == ("uav1-uav1",)
    assert campaign.settings.scene.spacing_m == 0.125


def test_missing_mission_file_is_one_message(folder, monkeypatch, capsys):
    (folder / "dike.plan").unlink()
    status, out, err = run_command(monkeypatch, capsys, "design", folder / "plan.yaml")
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert "dike.plan: no such file" in err


def test_unknown_argument_of_optimise_is_one_message(folder, monkeypatch, capsys):
    status, _, err = run_command(monkeypatch, capsys, "design", folder / "plan.yaml", "--optimise", "speed")
    assert status == 2
    assert "expected one or more of height,offset,spacing,heading" in err


def test_scene_outside_the_dem_is_one_message(folder, monkeypatch, capsys):
    profile = {"transform": rasterio.Affine(1, 0, EAST, 0, -1, NORTH), "crs": "EPSG:32632", "height": 9, "width": 9}
    with rasterio.open(folder / "dem.tif", "w", driver="GTiff", count=1, dtype="float32", **profile) as raster:
        raster.write(np.full((9, 9), 500.0, np.float32), 1)
    scene = PLAN["scene"] | {"dem": "dem.tif", "dem_datum": "ellipsoid"}
    (folder / "plan.yaml").write_text(yaml.safe_dump(PLAN | {"scene": scene}))
    status, out, err = run_command(monkeypatch, capsys, "design", folder / "plan.yaml")
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert "dem.tif" in err


def test_comparison_contains_the_nesz_of_calibrated_images_only(finished_tiny, tmp_path):
    campaign = Campaign.load(copy_writable(finished_tiny.root, tmp_path / "flown"))
    path = campaign.result("f01", "uav1-uav1", "nesz.tif")
    with rasterio.open(str(path)) as raster:
        values, tags, profile = raster.read(1), raster.tags(), raster.profile
    measured = _measured(campaign, "f01", "uav1-uav1")
    assert measured.pop("nesz, dB") == pytest.approx(np.nanmedian(values))
    del tags["APERTURA_RADIOMETRY"]  # as for an image without a configured radio: relative dB
    with rasterio.open(str(path), "w", **profile) as raster:
        raster.write(values, 1)
        raster.update_tags(**tags)
    assert _measured(campaign, "f01", "uav1-uav1") == measured


@pytest.mark.slow
def test_predicted_image_quality_is_measured_in_the_simulated_flight(tmp_path, monkeypatch, capsys):
    """Widths agree within 5 %, NESZ and RCS within 1 dB; the noise of 256 pulses is measured to 0.4 dB."""
    document = copy.deepcopy(PLAN) | {"flights": {"f01": PLAN["flights"]["f01"] | {"tracks": {"uav1": LINE}}}}
    design = designed(FlightPlan.model_validate(document), tmp_path)
    campaign = process(rehearse(design.opened, [PointTarget((0.0, 0.0, 0.0))], tmp_path / "flown"), last="cube")
    planned, grid = design.images["f01/uav1-uav1"].layers, open_scene(campaign).grid
    pixels = open_stage(campaign.stage("image", "f01", "uav1-uav1"), "image").image.values
    peak = find_peak(pixels, 40, 40)
    for direction, name in (((1, 0), "resolution_fine"), ((0, 1), "resolution")):
        cut = cut_through(pixels, peak, direction=direction, spacing_m=grid.spacing_m, reach_m=3.8)
        assert cut.width_m == pytest.approx(planned[name][40, 40], rel=0.05)
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(document))
    status, out, err = run_command(monkeypatch, capsys, "compare", tmp_path / "plan.yaml", tmp_path / "flown")
    assert (status, err) == (0, "")
    assert "measured in the image" in out
    assert "different radar" not in out
    (width,) = (line.split() for line in out.splitlines() if "resolution_fine" in line)
    assert float(width[-1]) == pytest.approx(
        float(width[-2]), rel=0.1
    )  # the only target, compared with the prediction from the logs
    document["waveform"]["carrier_hz"] = 1.2e9
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(document))
    _, out, _ = run_command(monkeypatch, capsys, "compare", tmp_path / "plan.yaml", tmp_path / "flown")
    assert "different radar: waveform.carrier_hz: 1.2e+09 planned, 1.3e+09 in the campaign" in out
    from apertura.stages.layers import layers

    layers(campaign, "f01", "uav1-uav1")
    with rasterio.open(str(campaign.result("f01", "uav1-uav1", "nesz.tif"))) as raster:
        assert raster.read(1)[40, 40] == pytest.approx(planned["nesz"][40, 40], abs=1.0)
    (point,) = read_json(campaign.result("f01", "uav1-uav1", "radiometry.json"), expected="", remedy="")["points"][:1]
    assert point["rcs_dbsm"] == pytest.approx(0.0, abs=1.0)
