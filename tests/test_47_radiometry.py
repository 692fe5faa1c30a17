"""A flight whose radio is stated: cross-sections and σ⁰ of its images against what was simulated."""

import json
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from folders import complaint, copy_writable, edit_config, export_flight, run_steps

from apertura.core.quality.bright_points import BrightPoint
from apertura.formats.export import product_files
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.pair import open_pair
from apertura.pipeline.opening.radiometry import calibrated_pair
from apertura.pipeline.opening.scene import open_scene
from apertura.pipeline.steps.layers import layers
from apertura.simulation import GaussianBeam, ImageGrid, PointTarget, Radio, preset, simulate
from apertura.views.score import score

RCS_M2 = (0.1, 1.0, 10.0)
PLACES = ((-2.0, -1.5, 0.0), (0.0, 1.2, 0.0), (2.0, -0.5, 0.0))
RADIO = Radio(10.0, 8.0, 9.0, full_scale_dbm=4.0, gain_db=40.0, noise_figure_db=6.0, amplitude_std_db=0.5)
PAIRS = ("uav1-uav1", "uav1-uav2")


def plan(radio=RADIO, **grid):
    """The demo's two nodes over three points; beams look to the right, where the scene is."""
    base = preset("demo", pulses=120)
    beams = {name: GaussianBeam((90.0, -22.0), (70.0, 50.0)) for name in ("radar_tx", "radar_rx")}
    nodes = {
        name: replace(
            node,
            radio=replace(radio) if radio else None,
            antennas=beams,
            attitude="log",
            log_format="csv",
            impairments=replace(node.impairments, radar_snr_db=None),
        )
        for name, node in base.nodes.items()
    }
    targets = tuple(PointTarget(place, rcs**0.5) for place, rcs in zip(PLACES, RCS_M2, strict=True))
    return replace(base, nodes=nodes, targets=targets, scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.05))


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """The flight, imaged and exported."""
    campaign = run_steps(simulate(tmp_path_factory.mktemp("radio") / "campaign", plan(), seed=3), exports=False)
    export_flight(campaign, "f01")
    return campaign


def said(campaign, pair, name="radiometry.json"):
    return json.loads(campaign.result("f01", pair, name).read_text())


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_cross_sections_of_a_simulated_flight_are_those_of_its_targets(flown, pair):
    """From samples of a 14-bit converter, by two beams, from power, gains and receiver that the config states."""
    found = [one for one in score(flown) if one.image == pair]
    assert [one.rcs_put_dbsm for one in found] == pytest.approx([-10, 0, 10])
    for one in found:
        assert abs(one.rcs_dbsm - one.rcs_put_dbsm) < max(0.3, one.rcs_std_db)
    brightest = said(flown, pair, "image.json")["cross_sections"]["points"][0]
    assert brightest["rcs_dbsm"] == pytest.approx(10, abs=0.3)
    *_, pointing, amplitude = said(flown, pair, "image.json")["budget"]
    assert (pointing["cause"], amplitude["cause"]) == ("pointing", "amplitude")
    assert 0 < said(flown, pair)["pointing_std_db"] < 2


@pytest.mark.slow
def test_the_noise_of_a_calibrated_image_is_that_of_the_noise_figure(flown):
    """Eqs. 7 and 8: the receiver's 6 dB are what a recording of its own pulses has."""
    assert said(flown, "uav1-uav1")["noise"]["noise_figure_measured_db"] == pytest.approx(6, abs=0.4)
    with rasterio.open(flown.result("f01", "uav1-uav1", "nesz.tif")) as raster:
        assert raster.descriptions == ("noise-equivalent sigma0",)
        assert -70 < np.nanmedian(raster.read(1)) < -50


@pytest.mark.slow
def test_sigma0_says_what_it_is_and_times_its_cell_is_the_image(flown):
    with rasterio.open(flown.result("f01", "uav1-uav1", "sigma0_db.tif")) as raster:
        means, sigma0_db = json.loads(raster.tags()["APERTURA_RADIOMETRY"]), raster.read(1)
        assert raster.units == ("dB",)
    assert means["standard_name"] == "surface_backwards_scattering_coefficient_of_radar_wave"
    assert means["calibration_std_db"] == 0.5
    with rasterio.open(flown.result("f01", "uav1-uav1", "db.tif")) as raster:
        ratio_db = sigma0_db - raster.read(1)
    assert np.nanmax(ratio_db) - np.nanmin(ratio_db) < 10  # spreading and beams over six metres, and no speckle
    assert flown.result("f01", "uav1-uav1", "sigma0_db.qml").is_file()
    assert not flown.result("f01", "uav1-uav1", "gamma0_db.tif").exists()


def test_nothing_is_calibrated_of_a_radio_that_nobody_states(finished_tiny):
    folder = finished_tiny.result("f01", "uav1-uav1")
    assert not list(folder.glob("*0_db.tif"))
    assert not (folder / "radiometry.json").exists()
    with rasterio.open(folder / "nesz.tif") as raster:
        assert "relative" in raster.descriptions[0]


def with_radio(root, *, left_out=()):
    """State the radio of both nodes in the config of a campaign."""

    def change(document):
        for node in document["nodes"].values():
            gains = {"radar_tx_gain_dbi": 8.0, "radar_rx_gain_dbi": 9.0}
            receiver = {"full_scale_counts": 8192, "full_scale_v": 0.5, "gain_db": 40.0}
            stated = {"antennas": gains, "transmit_power_dbm": 10.0, "receiver": receiver}
            node.update({key: value for key, value in stated.items() if key not in left_out})

    edit_config(root, change)
    return Campaign


def test_coefficients_are_products_where_they_are_written():
    files = set(product_files({"f01": ["a-b"]}, ["gamma0"]))
    assert {"f01/a-b/gamma0_db.tif", "f01/a-b/gamma0_db.qml", "mosaic/a-b/gamma0_db.vrt"} <= files
    assert not any("sigma0" in name for name in files)


def test_a_radio_stated_in_parts_is_one_message(tiny):
    message = complaint(lambda: with_radio(tiny, left_out=["receiver"]).load(tiny))
    assert "nodes.uav1.receiver, nodes.uav2.receiver are not stated" in message
    assert "of every pair, or of none" in message


def test_a_receiver_states_its_full_scale_once(tiny):
    with_radio(tiny).load(tiny)
    edit_config(tiny, lambda document: document["nodes"]["uav1"]["receiver"].update(full_scale_dbm=4.0))
    assert "either full_scale_dbm or full_scale_v" in complaint(lambda: Campaign.load(tiny))


def test_a_radio_forms_no_image_again(tiny):
    """It matters to layers and reports alone: the settings of all that is before them stay as they were."""
    made = ("echo", "profile", "image", "layers")
    before = {name: result_of(Campaign.load(tiny), name, "f01", "uav1-uav2") for name in made}
    after = {name: result_of(with_radio(tiny).load(tiny), name, "f01", "uav1-uav2") for name in made}
    changed = {name for name in made if before[name].settings != after[name].settings}
    assert changed == {"layers"}
    assert "results/f01/uav1-uav2/image.manifest.json" in after["layers"].sources


@pytest.mark.slow
def test_a_peak_of_noise_has_no_cross_section(flown):
    scene = open_scene(flown)
    calibrated = calibrated_pair(flown, open_pair(flown, "f01", "uav1-uav1"), scene)
    points = [BrightPoint(60.0, 60.0, amplitude=1.0, background=share) for share in (0.05, 0.2)]
    told, untold = calibrated.points(points, scene, 1e-9)
    assert told["std_db"] > 1
    assert untold["rcs_m2"] is None


@pytest.mark.slow
def test_a_coefficient_that_is_no_longer_asked_for_goes(flown, tmp_path):
    """Of an old radio it would lie beside an image of the new one."""
    root = copy_writable(flown.root, tmp_path / "campaign")
    edit_config(root, lambda document: document.setdefault("processing", {}).update(radiometry=["gamma0"]))
    campaign = Campaign.load(root)
    layers(campaign, "f01", "uav1-uav1")
    folder = campaign.result("f01", "uav1-uav1")
    assert [path.name for path in sorted(folder.glob("*0_db.*"))] == ["gamma0_db.qml", "gamma0_db.tif"]
