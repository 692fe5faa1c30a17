"""Radiometric calibration from the configured radio: cross-sections and σ⁰ compared with the simulation."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
import rasterio.transform
from folders import complaint, copy_writable, edit_config, state
from scenes import straight_track

from apertura.campaign.folder import Campaign
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import projected_from_ecef
from apertura.core.imaging.radiometry import Calibration
from apertura.core.quality.bright_points import BrightPoint
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.looks import Looks
from apertura.core.scene.terrain import Plane
from apertura.formats.export import product_files
from apertura.run.process import process
from apertura.simulation import GaussianBeam, ImageGrid, PointTarget, Radio, preset, simulate
from apertura.simulation.presets import DEMO_ORIGIN
from apertura.stages.export import export_fused
from apertura.stages.layers import GroundPower, gamma0_layers, layers
from apertura.stages.mosaic import mosaic
from apertura.stages.pair import open_pair
from apertura.stages.radiometry import calibrated_pair
from apertura.stages.scene import open_scene
from apertura.stages.stac import stac
from apertura.views.score import score
from apertura.views.verify.chain import verify
from apertura.views.webmap.document import webmap
from apertura.workflow.lineage import result_of

RCS_M2 = (0.1, 1.0, 10.0)
POSITIONS = ((-2.0, -1.5, 0.0), (0.0, 1.2, 0.0), (2.0, -0.5, 0.0))
RADIO = Radio(10.0, 8.0, 9.0, full_scale_dbm=4.0, gain_db=40.0, noise_figure_db=6.0, amplitude_std_db=0.5)
PAIRS = ("uav1-uav1", "uav1-uav2")


def plan(radio=RADIO, **grid):
    """Return a specification: two nodes with beams to the right, towards a scene with three points."""
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
    targets = tuple(PointTarget(place, rcs**0.5) for place, rcs in zip(POSITIONS, RCS_M2, strict=True))
    return replace(base, nodes=nodes, targets=targets, scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.05))


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Image and export the flight."""
    campaign = process(simulate(tmp_path_factory.mktemp("radio") / "campaign", plan(), seed=3), last="cube")
    process(campaign, first="layers", last="export_fused")
    return campaign


def report_of(campaign, pair, name="radiometry.json"):
    return json.loads(campaign.result("f01", pair, name).read_text())


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_measured_cross_sections_are_those_of_the_targets(flown, pair):
    """The flight has samples of a 14-bit converter, two beams, and configured power, gains and receiver."""
    findings = [finding for finding in score(flown) if finding.image == pair]
    assert [finding.rcs_put_dbsm for finding in findings] == pytest.approx([-10, 0, 10])
    for finding in findings:
        assert abs(finding.rcs_dbsm - finding.rcs_put_dbsm) < max(0.3, finding.rcs_std_db)
    listed = report_of(flown, pair, "image.json")["cross_sections"]["points_listed"]
    assert listed == {"most": 50, "below_brightest_db": -12.0, "above_surroundings_db": 12.2}
    brightest = report_of(flown, pair, "image.json")["cross_sections"]["points"][0]
    assert brightest["rcs_dbsm"] == pytest.approx(10, abs=0.3)
    *_, pointing, amplitude = report_of(flown, pair, "image.json")["budget"]
    assert (pointing["cause"], amplitude["cause"]) == ("pointing", "amplitude")
    assert 0 < report_of(flown, pair)["pointing_std_db"] < 2


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_noise_of_a_calibrated_image_agrees_with_the_noise_figure(flown, pair):
    """Eqs. 7 to 8b: the measured noise figure is 6 dB after subtraction of the sidelink noise."""
    noise = report_of(flown, pair)["noise"]
    assert abs(noise["noise_figure_measured_db"] - 6) < 3 * noise["std_db"] < 1.0
    assert (noise["sidelink"] is None) is (pair == "uav1-uav1")
    with rasterio.open(str(flown.result("f01", pair, "nesz.tif"))) as raster:
        assert raster.descriptions == ("noise-equivalent sigma0",)
        assert -70 < np.nanmedian(raster.read(1)) < -50


@pytest.mark.slow
@pytest.mark.parametrize("symbol_filter", ["reciprocal", "wiener"])
def test_noise_figure_of_symbols_of_varying_modulus_is_that_of_the_receiver(tmp_path, symbol_filter):
    """The gain of the filter multiplies the noise of 64-QAM by 2.7 (reciprocal), which the noise figure must not."""
    base = plan()
    changing = replace(base, waveform=replace(base.waveform, code="64qam", frames=120))
    root = simulate(tmp_path / "campaign", changing, seed=3)
    edit_config(root, lambda document: document.update(processing={"symbol_filter": symbol_filter}))
    campaign = process(root, last="cube")
    for pair in PAIRS:
        layers(campaign, "f01", pair)
        noise = report_of(campaign, pair)["noise"]
        assert abs(noise["noise_figure_measured_db"] - 6) < 3 * noise["std_db"] < 1.5
        assert ("symbols" in noise) is (symbol_filter == "wiener")
        assert "noise_disagrees" not in report_of(campaign, pair)["flags"]


@pytest.mark.slow
@pytest.mark.parametrize("symbol_filter", ["reciprocal", "matched"])
def test_noise_figure_of_a_scene_of_noise_does_not_contain_the_gain_of_the_filter(tmp_path, symbol_filter):
    """Without echoes, the noise of 64-QAM is that of the receiver, times 2.7 (reciprocal) or 1 (matched)."""
    base = plan()
    weak = tuple(replace(target, amplitude=1e-3 * target.amplitude) for target in base.targets)
    changing = replace(base, targets=weak, waveform=replace(base.waveform, code="64qam", frames=120))
    root = simulate(tmp_path / "campaign", changing, seed=3)
    edit_config(root, lambda document: document.update(processing={"symbol_filter": symbol_filter}))
    campaign = process(root, last="cube")
    layers(campaign, "f01", "uav1-uav1")
    noise = report_of(campaign, "uav1-uav1")["noise"]
    assert abs(noise["noise_figure_measured_db"] - 6) < 1
    assert noise["std_db"] < 0.5


@pytest.mark.slow
def test_receiver_gain_error_of_6_db_is_flagged_from_noise(flown, tmp_path):
    """By eq. 8b, noise is compared with the configured noise figure or, if not configured, with 0 dB."""
    assert not any("noise_disagrees" in report_of(flown, pair)["flags"] for pair in PAIRS)
    root = copy_writable(flown.root, tmp_path / "campaign")
    for wrong_db, figure_db, flagged in ((6.0, 6.0, True), (-6.0, 6.0, True), (6.0, None, False), (12.0, None, True)):

        def change(document, wrong_db=wrong_db, figure_db=figure_db):
            for node in document["nodes"].values():
                node["receiver"] |= {"gain_db": 40.0 + wrong_db, "noise_figure_db": figure_db}

        edit_config(root, change)
        campaign = Campaign.load(root)
        for pair in PAIRS:
            layers(campaign, "f01", pair)
            assert ("noise_disagrees" in report_of(campaign, pair)["flags"]) is flagged, (pair, wrong_db, figure_db)


@pytest.mark.slow
def test_sigma0_states_its_quantity_and_scales_with_the_image(flown):
    with rasterio.open(str(flown.result("f01", "uav1-uav1", "sigma0_db.tif"))) as raster:
        means, sigma0_db = json.loads(raster.tags()["APERTURA_RADIOMETRY"]), raster.read(1)
        assert raster.units == ("dB",)
    assert means["standard_name"] == "surface_backwards_scattering_coefficient_of_radar_wave"
    assert means["calibration_std_db"] == 0.5
    with rasterio.open(str(flown.result("f01", "uav1-uav1", "db.tif"))) as raster:
        ratio_db = sigma0_db - raster.read(1)
    assert np.nanmax(ratio_db) - np.nanmin(ratio_db) < 10  # spreading loss and beams over six metres, without speckle
    assert flown.result("f01", "uav1-uav1", "sigma0_db.qml").is_file()
    assert not flown.result("f01", "uav1-uav1", "gamma0_db.tif").exists()


def test_no_calibrated_products_without_a_configured_radio(finished_tiny):
    folder = finished_tiny.result("f01", "uav1-uav1")
    assert not list(folder.glob("*0_db.tif"))
    assert not (folder / "radiometry.json").exists()
    with rasterio.open(str(folder / "nesz.tif")) as raster:
        assert "relative" in raster.descriptions[0]


def with_radio(root, *, omitted=()):
    """Configure the radio of both nodes of a campaign, except omitted keys."""

    def change(document):
        for node in document["nodes"].values():
            gains = {"radar_tx_gain_dbi": 8.0, "radar_rx_gain_dbi": 9.0}
            receiver = {"full_scale_counts": 8192, "full_scale_v": 0.5, "gain_db": 40.0}
            stated = {"antennas": gains, "transmit_power_dbm": 10.0, "receiver": receiver}
            node.update({key: value for key, value in stated.items() if key not in omitted})

    edit_config(root, change)
    return Campaign


def test_radiometric_coefficients_are_products():
    files = set(product_files({"f01": ["a-b"]}, ["gamma0"]))
    assert {"f01/a-b/gamma0_db.tif", "f01/a-b/gamma0_db.qml", "mosaic/a-b/gamma0_db.vrt"} <= files
    assert not any("sigma0" in name for name in files)


@pytest.mark.parametrize("rise_deg", [0.0, -20.0, 15.0])
def test_area_ratios_relate_the_coefficients(rise_deg):
    """On a facet with local incidence θ in the range plane, γ⁰ = β⁰ tan θ and σ⁰ = γ⁰ cos θ (eqs. 6a and 9)."""
    track = straight_track(96, length_m=0.5) + [0.0, 0.0, 12.0]
    grid, terrain = SceneGrid("local", -3.0, 23.0, 0.125, (48, 48)), Plane(0, 20, 0, 0, np.tan(np.radians(rise_deg)))
    calibration = Calibration.of(grid, terrain, Aperture(track, track), None, constant=1.0, cell_m2=0.2)
    scene = SimpleNamespace(grid=grid, terrain=terrain)
    looks = Looks.of(grid, terrain, Aperture(track, track), None, threads=1)
    power = GroundPower(scene, None, SimpleNamespace(calibration=calibration))
    ratios = gamma0_layers(power, looks, threads=1)
    window = slice(24, 25), slice(24, 25)
    local = np.arctan2(20.0, 22.0) - np.radians(rise_deg)
    assert ratios["scattering_area"][window][0, 0] == pytest.approx(1 / np.tan(local), rel=0.01)
    assert ratios["gamma_sigma_ratio"][window][0, 0] == pytest.approx(np.cos(local), rel=0.01)
    vertical_deg = np.degrees(np.arctan2(20.0, 22.0))  # does not depend on the slope
    assert ratios["ellipsoidal_incidence"][window][0, 0] == pytest.approx(vertical_deg, abs=0.5)


def test_gamma0_writes_the_products_of_ceos_ard(tiny):
    campaign = state(tiny, "processing", radiometry=["gamma0"])
    assert campaign.coefficients == ()  # not calibrated
    files = set(product_files({"f01": ["a-b"]}, ["gamma0", "scattering_area", "ellipsoidal_incidence"]))
    for name in ("gamma0_power.tif", "gamma0_slc.tif", "scattering_area.tif", "ellipsoidal_incidence.tif"):
        assert f"f01/a-b/{name}" in files
    assert not [name for name in files if name.startswith("mosaic") and "slc" in name]


def test_incomplete_radio_is_one_message(tiny):
    message = complaint(lambda: with_radio(tiny, omitted=["receiver"]).load(tiny))
    assert "nodes.uav1.receiver, nodes.uav2.receiver are not configured" in message
    assert "of every pair, or none of these" in message


def test_receiver_has_a_single_full_scale(tiny):
    with_radio(tiny).load(tiny)
    edit_config(tiny, lambda document: document["nodes"]["uav1"]["receiver"].update(full_scale_dbm=4.0))
    assert "either full_scale_dbm or full_scale_v" in complaint(lambda: Campaign.load(tiny))


def test_configuring_a_radio_does_not_outdate_images(tiny):
    """A radio changes the settings of layers and reports only."""
    results = ("echo", "profile", "image", "layers")
    before = {name: result_of(Campaign.load(tiny), name, "f01", "uav1-uav2") for name in results}
    after = {name: result_of(with_radio(tiny).load(tiny), name, "f01", "uav1-uav2") for name in results}
    changed = {name for name in results if before[name].settings != after[name].settings}
    assert changed == {"layers"}
    assert "results/f01/uav1-uav2/image.manifest.json" in after["layers"].sources


@pytest.mark.slow
def test_noise_peak_has_no_cross_section(flown):
    scene = open_scene(flown)
    calibrated = calibrated_pair(flown, open_pair(flown, "f01", "uav1-uav1"), scene)
    points = [BrightPoint(60.0, 60.0, amplitude=1.0, background=share) for share in (0.05, 0.2)]
    detected, undetected = calibrated.points(points, scene, 1e-9)
    assert detected["std_db"] > 1
    assert undetected["rcs_m2"] is None


@pytest.mark.slow
def test_mean_power_without_coefficients_is_echo_power(flown, tmp_path):
    root = copy_writable(flown.root, tmp_path / "campaign")
    campaign = state(root, "processing", radiometry=[], multilook={"spacing_m": 100.0})
    assert campaign.coefficients == ("multilook", "multilook_coherent", "multilook_noncoherent")
    layers(campaign, "f01", "uav1-uav1")
    folder = campaign.result("f01", "uav1-uav1")
    assert not list(folder.glob("*sigma0*"))
    with rasterio.open(str(folder / "multilook_power.tif")) as raster:
        assert (raster.shape, raster.descriptions[0][:15]) == ((1, 1), "mean echo power")


@pytest.mark.slow
def test_coefficient_no_longer_configured_is_removed(flown, tmp_path):
    """A leftover file would belong to an earlier radio."""
    root = copy_writable(flown.root, tmp_path / "campaign")
    edit_config(root, lambda document: document.setdefault("processing", {}).update(radiometry=["gamma0"]))
    campaign = Campaign.load(root)
    layers(campaign, "f01", "uav1-uav1")
    folder = campaign.result("f01", "uav1-uav1")
    assert [path.name for path in sorted(folder.glob("*0_db.*"))] == ["gamma0_db.qml", "gamma0_db.tif"]


@pytest.mark.slow
def test_mean_power_is_on_a_coarser_grid_and_states_its_quantity(flown, tmp_path):
    """Linear and dB files of all coefficients: mean preserved, noise subtracted, speckle filtered."""
    root = copy_writable(flown.root, tmp_path / "campaign")
    products = {f"multilook_sigma0{end}" for end in ("_power.tif", "_power.qml", "_db.tif", "_db.qml")}
    means = {}
    for subtract in (False, True):
        multilook = {"spacing_m": 0.31, "subtract_noise": subtract, "speckle_filter": "lee"}
        edit_config(
            root,
            lambda document, multilook=multilook: document.setdefault("processing", {}).update(multilook=multilook),
        )
        campaign = Campaign.load(root)
        folder = campaign.result("f01", "uav1-uav1")
        assert products <= {path.name for path in layers(campaign, "f01", "uav1-uav1")}
        with rasterio.open(str(folder / "multilook_sigma0_power.tif")) as raster:
            assert (raster.res, raster.shape) == ((pytest.approx(0.3), pytest.approx(0.3)), (20, 20))
            mean, radiometry = raster.read(1), json.loads(raster.tags()["APERTURA_RADIOMETRY"])
            assert raster.descriptions[0].startswith("mean sigma0, radar cross-section per ground area of 6 x 6 pix")
        with rasterio.open(str(folder / "multilook_sigma0_db.tif")) as raster:
            decibels = raster.read(1)
            assert raster.units == ("dB",)
        assert (radiometry["speckle_filter"], radiometry["noise"]) == ("Lee", "subtracted" if subtract else "in it")
        assert 1 < radiometry["equivalent_looks"] < 36
        positive = mean > 0
        np.testing.assert_allclose(decibels[positive], 10 * np.log10(mean[positive]), atol=1e-3)
        assert np.isnan(decibels[~positive]).all()
        means[subtract] = mean
    with rasterio.open(str(folder / "sigma0_db.tif")) as raster:
        sigma0 = 10 ** (raster.read(1) / 10)
    with rasterio.open(str(folder / "nesz.tif")) as raster:
        noise = (10 ** (raster.read(1).astype(np.float64) / 10)).reshape(20, 6, 20, 6).mean(axis=(1, 3))
    dim = means[False] < np.median(means[False])  # in bright pixels, the noise is below the precision of float32
    np.testing.assert_allclose((means[False] - means[True])[dim], noise[dim], rtol=0.01)
    assert means[False].mean() == pytest.approx(np.nanmean(sigma0), rel=0.05)
    edit_config(root, lambda document: document["processing"].pop("multilook"))
    layers(Campaign.load(root), "f01", "uav1-uav1")
    assert not list(folder.glob("multilook*"))


@pytest.mark.slow
def test_mean_power_of_a_relative_image_is_its_pixel_mean(finished_tiny, tmp_path):
    """The mean is that of the pixels of power.tif, also in blocks at the edge; the image remains up to date."""
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    campaign = state(root, "processing", multilook={"spacing_m": 0.4})
    settings = [result_of(which, "image", "f01", "uav1-uav1").settings for which in (finished_tiny, campaign)]
    assert settings[0] == settings[1]
    for pair in PAIRS:
        layers(campaign, "f01", pair)
    folder = campaign.result("f01", "uav1-uav1")
    pixels, squares = (rasterio.open(str(folder / f"{name}.tif")).read(1) for name in ("power", "multilook_power"))
    assert squares[1, 2] == pytest.approx(pixels[4:8, 8:12].mean(), rel=1e-5)
    assert squares.shape == tuple(-(-size // 4) for size in pixels.shape)
    assert {link.state for link in verify(folder / "multilook_db.tif").links} == {"same"}


@pytest.mark.slow
def test_mean_power_of_sums_subtracts_the_noise_of_their_pairs(finished_tiny, tmp_path):
    """Eq. 6 of docs/theory/speckle.md, from Σw² of the pairs and the noise of their pulses."""
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    results = Campaign.load(root).results / "f01"

    def read(name):
        with rasterio.open(str(results / name)) as raster:
            return raster.read(1).astype(np.float64), json.loads(raster.tags()["APERTURA_RADIOMETRY"]), raster.tags()

    noise = {"coherent": 0.0, "noncoherent": 0.0}
    for subtracted in (False, True):
        campaign = state(root, "processing", multilook={"spacing_m": 0.4, "subtract_noise": subtracted})
        assert "f01/fused/multilook_coherent_db.tif" in set(
            product_files({"f01": (*PAIRS, "fused")}, campaign.coefficients)
        )
        for pair in PAIRS:
            layers(campaign, "f01", pair)
        export_fused(campaign, "f01")
        for source in ("coherent", "noncoherent"):
            pixels = read(f"fused/{source}_power.tif")[0]
            squares, radiometry, _ = read(f"fused/multilook_{source}_power.tif")
            if subtracted:
                peaks, n = read(f"fused/{source}_power.tif")[1]["divided_by"], 2
                for pair, peak in peaks.items():
                    looks, _, tags = read(f"{pair}/looks.tif")  # every pulse contributes: Σw² and M
                    noise[source] += float(tags["APERTURA_PULSE_NOISE"]) / looks[5, 9] / peak**2
                noise[source] /= n**2 if source == "coherent" else n
            assert squares[1, 2] == pytest.approx(pixels[4:8, 8:12].mean() - noise[source], rel=1e-3)
            assert radiometry["noise"] == ("subtracted" if subtracted else "in it")
    campaign = state(root, "processing", multilook=None)
    export_fused(campaign, "f01")
    assert not list((results / "fused").glob("multilook*"))


@pytest.mark.slow
def test_mean_power_is_in_the_mosaic_and_the_catalog(finished_tiny, tmp_path):
    """The map omits it, because its layers share one grid."""
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    campaign = state(root, "processing", multilook={"spacing_m": 0.4})
    files = {f"uav1-uav1/multilook_{name}" for name in ("power.tif", "power.qml", "db.tif", "db.qml")}
    named = set(product_files({"f01": (*PAIRS, "fused")}, campaign.coefficients))
    assert {f"f01/{name}" for name in files} | {"mosaic/uav1-uav1/multilook_db.vrt"} <= named
    for pair in PAIRS:
        layers(campaign, "f01", pair)
    export_fused(campaign, "f01")
    mosaic(campaign)
    stac(campaign)
    webmap(campaign)
    folder, about = campaign.results, json.loads((campaign.results / "stac/images/f01/uav1-uav1.json").read_text())
    with rasterio.open(str(folder / "f01/uav1-uav1/multilook_db.tif")) as raster:
        assert rasterio.open(str(folder / "mosaic/uav1-uav1/multilook_db.vrt")).transform == raster.transform
        asset = about["assets"]["multilook_db"]
        assert (asset["proj:shape"], asset["proj:transform"]) == ([*raster.shape], [*raster.transform][:6])
    assert "proj:shape" not in about["assets"]["db"]
    assert "multilook" not in (folder / "map/map.json").read_text()


@pytest.mark.slow
def test_sigma0_is_nan_in_layover_and_shadow(flown, tmp_path):
    """A ridge causes layover in front of it and shadow behind it (eq. 10)."""
    root = copy_writable(flown.root, tmp_path / "campaign")
    east, north, _ = projected_from_ecef("EPSG:32632", DEMO_ORIGIN.ecef(np.zeros(3)))
    west, top = np.floor(east) - 10, np.ceil(north) + 10
    x, y = np.meshgrid(west + 0.1 * (0.5 + np.arange(200)), top - 0.1 * (0.5 + np.arange(200)))
    away = (x - east) * np.cos(np.radians(40)) - (y - north) * np.sin(np.radians(40))  # from the track
    ridge = 620.0 + np.maximum(0, 1.5 - 4 * np.abs(away))
    georeference = {"crs": "EPSG:32632", "transform": rasterio.transform.from_origin(west, top, 0.1, 0.1)}
    with rasterio.open(str(root / "dem.tif"), "w", "GTiff", 200, 200, 1, dtype="float64", **georeference) as raster:
        raster.write(ridge, 1)
    state(root, "processing", radiometry=["sigma0", "beta0"], multilook={"spacing_m": 0.2})
    state(root, "scene", dem="dem.tif", dem_datum="ellipsoid")
    campaign = process(root, last="cube")
    layers(campaign, "f01", "uav1-uav1")
    folder = campaign.result("f01", "uav1-uav1")
    names = ("mask", "sigma0_db", "beta0_db", "multilook_sigma0_power")
    mask, sigma0, beta0, squares = (rasterio.open(str(folder / f"{name}.tif")).read(1) for name in names)
    assert min((mask == 1).sum(), (mask == 2).sum(), (mask == 0).sum()) > 100
    assert np.isnan(sigma0[mask != 0]).all()
    assert np.isnan(beta0[mask != 0]).all()
    assert np.isfinite(beta0[mask == 0]).all()
    assert np.isfinite(sigma0[mask == 0]).mean() > 0.95  # except slopes close to layover
    nesz = rasterio.open(str(folder / "nesz.tif")).read(1)  # per facet, as for σ⁰
    assert np.array_equal(np.isfinite(nesz)[mask == 0], np.isfinite(sigma0)[mask == 0])
    assert np.isnan(squares[(np.isnan(sigma0).reshape(30, 4, 30, 4).sum(axis=(1, 3)) > 8)]).all()
