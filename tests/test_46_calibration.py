"""Path offsets from a calibration flight over a known reflector, and their use by the imaging flights."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from folders import complaint, edit_config

from apertura.campaign.folder import Campaign
from apertura.simulation import ImageGrid, preset, simulate
from apertura.simulation.targets import PointTarget
from apertura.stages import calibration, echo, ingest
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of

PAIRS = ("uav1-uav1", "uav1-uav2")


def simulated(folder, *, reflector=True):
    """Return a campaign with a calibration and an imaging flight, whose configured offsets are wrong by decimetres."""
    plan = replace(preset("demo", pulses=60), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    stated = {"radar": 1.0, "sidelink": 0.5}
    nodes = {name: replace(node, stated_path_offset_m=stated) for name, node in plan.nodes.items()}
    if not reflector:
        quiet = replace(plan.nodes["uav1"].impairments, radar_snr_db=-60.0)
        nodes["uav1"] = replace(nodes["uav1"], impairments=quiet)
    target = PointTarget((0.0, 0.0, 0.0), 5.0)
    calibration_flight = replace(plan.flights[0], name="c01", kind="calibration", targets=(target,))
    image_flight = replace(plan.flights[0], start_utc="2025-05-14T10:00:00")
    root = simulate(
        folder / "campaign", replace(plan, nodes=nodes, flights=(calibration_flight, image_flight)), seed=21
    )
    truth = json.loads((root / "truth.json").read_text())["targets"][0]
    position_m = [truth["x"], truth["y"], truth["height_m"]]
    edit_config(root, lambda document: document.update(calibration={"flight": "c01", "reflector_m": position_m}))
    campaign = Campaign.load(root)
    for flight in ("c01", "f01"):
        for node in ("uav1", "uav2"):
            ingest.ingest(campaign, flight, node)
    for pair in PAIRS:
        echo.echo(campaign, "c01", pair)
    return campaign


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    campaign = simulated(tmp_path_factory.mktemp("calibration"))
    calibration.calibrate(campaign, "c01")
    return campaign


def report(campaign):
    return json.loads((campaign.results / "c01" / "calibration.json").read_text())["pairs"]


@pytest.mark.parametrize(("pair", "true_m"), [("uav1-uav1", 1.374), ("uav1-uav2", 0.911 - 0.402)])
def test_offset_is_estimated_within_its_standard_deviation(calibrated, pair, true_m):
    estimate = report(calibrated)[pair]
    assert estimate["std_m"] < 0.02
    assert abs(estimate["offset_m"] - true_m) < max(4 * estimate["std_m"], 0.01)


def test_single_reflector_is_coherent(calibrated):
    for pair in PAIRS:
        assert report(calibrated)[pair]["coherence_factor"] > 0.9
        assert len(report(calibrated)[pair]["phase_rad"]) == report(calibrated)[pair]["pulses"]


def test_imaging_flights_use_and_record_the_calibrated_offset(calibrated):
    echo.echo(calibrated, "f01", "uav1-uav2")
    dataset = PairEcho.opened(calibrated, "f01", "uav1-uav2").stage
    estimate = report(calibrated)["uav1-uav2"]
    assert dataset.attrs["calibration"] == {name: estimate.get(name, "c01") for name in ("flight", "offset_m", "std_m")}
    assert "raw/c01/uav2.sigmf-data" in dataset.attrs["inputs"]
    assert str(estimate["offset_m"]) in dataset.attrs["runspec"]
    limit = 299792458 * 7.8125e-7
    assert (np.abs(dataset.path_limit.values - limit) < 10).all()


def test_echo_of_an_imaging_flight_depends_on_the_calibration(calibrated):
    manifest = "results/c01/calibration.manifest.json"
    assert manifest in result_of(calibrated, "echo", "f01", "uav1-uav2").sources
    assert manifest not in result_of(calibrated, "echo", "c01", "uav1-uav2").sources


@pytest.mark.slow
def test_calibration_flight_without_visible_reflector_is_refused(tmp_path):
    campaign = simulated(tmp_path, reflector=False)
    message = complaint(lambda: calibration.calibrate(campaign, "c01"))
    assert "no reflector" in message
    assert "flight c01" in message
    assert not (campaign.results / "c01" / "calibration.json").exists()


def test_reflector_needs_a_crs(calibrated, tmp_path):
    document = yaml.safe_load((calibrated.root / "config" / "config.yaml").read_text())
    document["scene"]["crs"] = "auto"
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "config.yaml").write_text(yaml.safe_dump(document))
    assert "state the CRS" in complaint(lambda: Campaign.load(tmp_path))
