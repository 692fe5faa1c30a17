"""Calibration constants measured at reflectors in one campaign and used by another of the same radar."""

import hashlib
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from folders import complaint, copy_writable, edit_config, state

from apertura.campaign.folder import Campaign
from apertura.check import as_line, problems
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.imaging.reflectors import Reflector
from apertura.run.process import process
from apertura.simulation import GaussianBeam, ImageGrid, PointTarget, Radio, preset, simulate
from apertura.stages import cphd, export, layers
from apertura.stages.pair import open_pair
from apertura.stages.radiometry import Constants, PairConstant, Radar, calibrated_pair, read_constants
from apertura.stages.scene import open_scene
from apertura.tools.reflectors import measured_constants, write_constants
from apertura.views.score import score
from apertura.views.verify.chain import verify
from apertura.workflow.lineage import result_of
from apertura.workflow.stale import stale_results

RADIO = Radio(10.0, 8.0, 9.0, full_scale_dbm=4.0, gain_db=37.3, noise_figure_db=6.0, amplitude_std_db=0.5)
PAIRS = ("uav1-uav1", "uav1-uav2")
WAVELENGTH_M = SPEED_OF_LIGHT_M_S / 1.4046e9  # at the centre of the demo's band
BACK = np.array([-0.705, 0.592, 0.39]) / np.linalg.norm([-0.705, 0.592, 0.39])  # east, north, up: towards the track
LEG_M, RADIUS_M = 0.25, 0.13  # cross-sections of both pairs agree to 0.1 dB
CORNER, BALL = (-1.5, 0.8, 0.0), (1.5, -0.7, 0.3)  # the ball is on a stand
LOOKS = {"azimuth_deg": 310.0, "elevation_deg": 23.0}
RCS_M2 = (0.2, 1.0)


def plan(name, targets, flights, radio=RADIO):
    """Return a specification: the demo's nodes with beams to the right, towards the scene."""
    base = preset("demo", pulses=120)
    beams = {name: GaussianBeam((90.0, -22.0), (70.0, 50.0)) for name in ("radar_tx", "radar_rx")}
    nodes = {
        name: replace(
            node,
            radio=replace(radio),
            antennas=beams,
            attitude="log",
            log_format="csv",
            impairments=replace(node.impairments, radar_snr_db=None),
        )
        for name, node in base.nodes.items()
    }
    scene = ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.05)
    flown = tuple(
        replace(
            base.flights[0],
            name=flight,
            tracks={
                node: replace(track, start_m=tuple(np.add(track.start_m, moved)))
                for node, track in base.flights[0].tracks.items()
            },
            start_utc=f"2025-05-14T{9 + number:02d}:30:00",
        )
        for number, (flight, moved) in enumerate(flights.items())
    )
    return replace(base, campaign=name, nodes=nodes, targets=targets, scene=scene, flights=flown)


def remove_radio(root):
    """Remove the radio from a config."""

    def change(document):
        for node in document["nodes"].values():
            for key in ("transmit_power_dbm", "receiver", "amplitude_std_db"):
                node.pop(key, None)
            for key in ("radar_tx_gain_dbi", "radar_rx_gain_dbi"):
                node["antennas"].pop(key)

    edit_config(root, change)
    return root


def ball_m2():
    """Return the monostatic cross-section of the sphere at the centre of the band."""
    ahead = np.eye(3)[:1]
    (rcs_m2,), _ = Reflector("sphere", (RADIUS_M,), np.eye(3)).cross_section(ahead, ahead, wavelength_m=WAVELENGTH_M)
    return rcs_m2


def corner_m2():
    """Return the mean cross-section of the trihedral over f01: simulated points are isotropic."""
    track = preset("demo", pulses=120).flights[0].tracks["uav1"]
    position_m = np.array(track.start_m) + np.outer(np.arange(120) / 20, track.velocity_m_s)
    away = position_m - CORNER
    range_m = np.linalg.norm(away, axis=1)
    azimuth, elevation = np.radians([LOOKS["azimuth_deg"], LOOKS["elevation_deg"]])
    level = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
    ahead = np.cos(elevation) * level + [0, 0, np.sin(elevation)]
    right = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    axes = np.array([right, np.cross(right, ahead), ahead])
    rcs_m2, _ = Reflector("trihedral", (LEG_M,), axes).cross_section(
        *[away / range_m[:, None]] * 2, wavelength_m=WAVELENGTH_M
    )
    return float(np.average(rcs_m2**0.5, weights=range_m**-2) ** 2)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Image two flights over a trihedral and a sphere, without a configured radio."""
    skin = tuple(np.array(BALL) + RADIUS_M * BACK)  # the specular point of the sphere
    targets = PointTarget(CORNER, corner_m2() ** 0.5), PointTarget(skin, ball_m2() ** 0.5)
    spec = plan("over_reflectors", targets, {"f01": (0.0, 0.0, 0.0), "f02": (-1.0, 0.8, 1.0)})
    root = remove_radio(simulate(tmp_path_factory.mktemp("reflectors") / "campaign", spec, seed=3))
    truth = json.loads((root / "truth.json").read_text())["targets"]
    positions_m = [[target[name] for name in ("x", "y", "height_m")] for target in truth]
    positions_m[1] = np.subtract(positions_m[1], RADIUS_M * BACK).tolist()
    reflectors = [
        {
            "name": "corner",
            "kind": "trihedral",
            "size_m": [LEG_M],
            "position_m": positions_m[0],
            "std_m": 0.02,
            **LOOKS,
        },
        {"name": "ball", "kind": "sphere", "size_m": [RADIUS_M], "position_m": positions_m[1], "std_m": 0.02},
    ]
    state(root, "scene", reflectors=reflectors)
    return process(root, last="export_fused")


@pytest.fixture(scope="module")
def later(measured, tmp_path_factory):
    """Image another campaign of the same radar, with other tracks and targets, calibrated by the file."""
    targets = tuple(
        PointTarget(at, rcs**0.5) for at, rcs in zip(((-1.0, -1.2, 0.0), (0.5, 1.2, 0.0)), RCS_M2, strict=True)
    )
    spec = plan("later", targets, {"f01": (-2.0, 1.5, 1.5)})
    root = remove_radio(simulate(tmp_path_factory.mktemp("later") / "campaign", spec, seed=5))
    shutil.copy(str(write_constants(measured)), root / "calibration.json")
    state(root, "processing", radiometric_calibration="calibration.json")
    campaign = process(root, last="cube")
    process(campaign, first="layers", last="export_fused")
    return campaign


def true_constant_db(campaign, pair):
    """Return K of the simulated radio from the radar equation."""
    sent = Radar.of(campaign, open_pair(campaign, "f01", pair)).sent_power
    received = 10 ** ((10.0 - 30 + 8.0 + 9.0 + 37.3 - (4.0 - 30)) / 10) * WAVELENGTH_M**2 / (4 * np.pi) ** 3
    return 10 * np.log10(received * 8192**2 / sent)


@pytest.mark.slow
def test_each_reflector_yields_the_constant_of_the_simulated_radio(measured):
    """The error is below the stated deviation, because simulated points have the theoretical cross-sections."""
    constants, excluded = measured_constants(measured)
    by_reflector = {(one["flight"], one["pair"], one["reflector"]): one for one in constants.measurements}
    assert set(by_reflector) == {
        *((flight, "uav1-uav1", name) for flight in ("f01", "f02") for name in ("corner", "ball")),
        *((flight, "uav1-uav2", "ball") for flight in ("f01", "f02")),
    }
    for (_, pair, _), one in by_reflector.items():
        assert one["constant_db"] == pytest.approx(true_constant_db(measured, pair), abs=0.3), one
        assert one["off_m"] < 0.03
    assert [line.split(":")[0] for line in excluded] == [f"{flight} uav1-uav2 corner" for flight in ("f01", "f02")]


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_constant_is_within_its_deviation(measured, pair):
    constants, _ = measured_constants(measured)
    constant = constants.pairs[pair]
    assert abs(constant.constant_db - true_constant_db(measured, pair)) < constant.std_db < 0.7
    assert (constant.flights, constant.flags) == (2, {})
    if pair != constants.reference:  # path offsets are configured: no phase between the channels
        assert abs(constant.phase_rad) < 2 * constant.phase_std_rad < 0.5


@pytest.mark.slow
def test_cross_sections_of_another_flight_are_calibrated(later):
    """A flight with another track and other targets, without a configured radio, is calibrated by the file alone."""
    findings = [finding for finding in score(later) if finding.image in PAIRS]
    assert len(findings) == 4
    for finding in findings:
        assert abs(finding.rcs_dbsm - finding.rcs_put_dbsm) < finding.rcs_std_db < 0.8
    report = json.loads(later.result("f01", "uav1-uav1", "radiometry.json").read_text())
    assert report["calibrated_by"] == "reflectors of campaign over_reflectors, 2025-05-14"
    assert report["link"] is None
    assert report["flags"] == {}


@pytest.mark.slow
def test_budget_contains_the_deviation_of_the_file(later):
    image = json.loads(later.result("f01", "uav1-uav2", "image.json").read_text())
    std_db = read_constants(later.root / "calibration.json").pairs["uav1-uav2"].std_db
    assert (image["budget"][-1]["cause"], image["budget"][-1]["stated"]) == ("amplitude", f"{std_db:.2g} dB")


@pytest.mark.slow
def test_calibrated_product_is_verified_down_to_the_file_and_samples(later):
    chain = verify(later.result("f01", "uav1-uav1", "sigma0_db.tif"))
    assert {link.state for link in chain.links} == {"same"}
    assert {"calibration.json", "raw/f01/uav1.sigmf-data"} <= {link.name for link in chain.links}


@pytest.mark.slow
def test_changed_calibration_file_outdates_the_layers(later, tmp_path):
    root = copy_writable(later.root, tmp_path / "campaign")
    campaign = Campaign.load(root)
    assert "calibration.json" in result_of(campaign, "layers", "f01", "uav1-uav1").sources
    assert "calibration.json" not in result_of(campaign, "image", "f01", "uav1-uav1").sources
    before = stale_results(campaign)
    change_file(root, lambda document: document["pairs"]["uav1-uav1"].update(constant_db=50.0))
    assert "results/f01/uav1-uav1/layers.manifest.json" in stale_results(campaign).keys() - before.keys()


@pytest.mark.slow
def test_wrongly_configured_radio_is_flagged_and_not_used(later, tmp_path):
    """The receiver gain is wrong by 4 dB, eight configured standard deviations."""
    root = copy_writable(later.root, tmp_path / "campaign")
    pair, scene = open_pair(later, "f01", "uav1-uav1"), open_scene(later)
    by_gain = {}
    for gain_db in (37.3, 41.3):
        configure_radio(root, gain_db)
        by_gain[gain_db] = calibrated_pair(Campaign.load(root), pair, scene)
    right, wrong = by_gain.values()
    assert wrong.calibration.constant == right.calibration.constant
    assert (list(right.flags), list(wrong.flags)) == ([], ["constant_disagrees"])
    assert float(wrong.flags["constant_disagrees"].split(" dB")[0].split()[-1]) == pytest.approx(4, abs=0.4)
    layers.layers(campaign := Campaign.load(root), "f01", "uav1-uav1")
    export.export(campaign, "f01", "uav1-uav1")
    image = json.loads(campaign.result("f01", "uav1-uav1", "image.json").read_text())
    assert "constant_disagrees" in image["flags"]


@pytest.mark.slow
def test_gain_loss_between_flights_is_flagged_in_its_pair(measured, tmp_path):
    """Samples of uav1 are lower by a fifth (1.94 dB) in f02; samples of uav2 are unchanged."""
    root = copy_writable(measured.root, tmp_path / "campaign")
    shutil.rmtree(root / "results")
    path = root / "raw/f02/uav1.sigmf-data"
    (np.fromfile(path, "<i2") * 0.8).round().astype("<i2").tofile(path)
    meta = json.loads(path.with_suffix(".sigmf-meta").read_text())
    meta["global"]["core:sha512"] = hashlib.sha512(path.read_bytes()).hexdigest()
    path.with_suffix(".sigmf-meta").write_text(json.dumps(meta))
    campaign = process(root, last="cube")
    for flight in campaign.image_flights:
        for pair in flight.pairs:
            layers.layers(campaign, flight.name, pair)
    flags = {pair: one.flags for pair, one in measured_constants(campaign)[0].pairs.items()}
    assert list(flags["uav1-uav1"]) == ["constant_drifts"]
    line = flags["uav1-uav1"]["constant_drifts"]
    assert float(line.split()[0]) == pytest.approx(20 * np.log10(0.8), abs=0.1)
    assert line.endswith("dB from f01 to f02")
    assert flags["uav1-uav2"] == {}


@pytest.mark.slow
def test_constant_that_differs_from_an_earlier_one_is_flagged(measured, tmp_path):
    root = copy_writable(measured.root, tmp_path / "campaign")
    write_constants(measured, root / "earlier.json")
    change_file(root, lambda document: document["pairs"]["uav1-uav2"].update(constant_db=50.0), "earlier.json")
    campaign = state(root, "processing", radiometric_calibration="earlier.json")
    flags = {pair: one.flags for pair, one in measured_constants(campaign)[0].pairs.items()}
    assert flags["uav1-uav1"] == {}
    assert "since reflectors of campaign over_reflectors" in flags["uav1-uav2"]["constant_drifts"]
    message = complaint(lambda: write_constants(campaign, root / "earlier.json"))
    assert "the file used by processing.radiometric_calibration" in message


@pytest.mark.slow
def test_outdated_images_are_refused_for_calibration(measured, tmp_path):
    root = copy_writable(measured.root, tmp_path / "campaign")
    campaign = state(root, "processing", window="none")
    assert "4 of 4 images out of date" in complaint(lambda: write_constants(campaign, root / "new.json"))
    assert not (root / "new.json").exists()


@pytest.mark.slow
def test_reflectors_outside_the_image_are_excluded_with_a_dem(measured, tmp_path):
    """The terrain is 0.5 m below both reflectors; each is measured at its imaged position, with the loss of focus."""
    root = copy_writable(measured.root, tmp_path / "campaign")
    shutil.rmtree(root / "results")
    scene = measured.settings.scene
    west, south, east, north = scene.bounds_m
    ground = np.full((20, 20), measured.settings.scene.reflectors[0].position_m[2] - 0.5, np.float32)
    transform = rasterio.transform.from_bounds(west - 7, south - 7, east + 7, north + 7, 20, 20)
    with rasterio.open(
        root / "dem.tif",
        "w",
        driver="GTiff",
        width=20,
        height=20,
        count=1,
        dtype="float32",
        crs=scene.crs,
        transform=transform,
    ) as raster:
        raster.write(ground, 1)
    far = measured.values["scene"]["reflectors"][1] | {"name": "far", "position_m": [east + 5, north + 5, 620.0]}
    stated = {"dem": "dem.tif", "dem_datum": "ellipsoid", "reflectors": [*measured.values["scene"]["reflectors"], far]}
    table = root / "config/flights.tsv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:2]))
    state(root, "scene", **stated)
    campaign = process(root, last="cube")
    layers.layers(campaign, "f01", "uav1-uav1")
    layers.layers(campaign, "f01", "uav1-uav2")
    constants, excluded = measured_constants(campaign)
    for one in constants.measurements:
        assert one["constant_db"] == pytest.approx(true_constant_db(measured, one["pair"]), abs=0.3), one
        assert one["off_m"] < 0.03
    assert "f01 uav1-uav1 far: outside the image" in excluded


@pytest.mark.slow
def test_phase_history_is_calibrated_from_its_images(measured, tmp_path):
    """The CPHD has neither amplitude scale nor beams; the constant includes the gain towards the reflectors."""
    (tmp_path / "config").mkdir()
    scene = measured.values["scene"]
    waveform = {"kind": "phase_history", "format": "cphd"}
    config = {"campaign": "histories", "waveform": waveform, "nodes": {"uav1": {}}, "scene": scene}
    (tmp_path / "config/config.yaml").write_text(json.dumps(config))
    (tmp_path / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\tuav1\n")
    written = cphd.cphd(measured, "f01", "uav1-uav1")
    (tmp_path / "raw/f01").mkdir(parents=True)
    shutil.copy(str(written), tmp_path / "raw/f01/uav1.cphd")
    campaign = process(tmp_path, last="cube")
    layers.layers(campaign, "f01", "uav1-uav1")
    constant = read_constants(write_constants(campaign)).pairs["uav1-uav1"]
    assert constant.radar.sent_power is None
    assert -3 < constant.constant_db - true_constant_db(measured, "uav1-uav1") < 0  # beam gain relative to boresight
    campaign = state(tmp_path, "processing", radiometric_calibration="calibration.json")
    layers.layers(campaign, "f01", "uav1-uav1")
    points = json.loads(campaign.result("f01", "uav1-uav1", "radiometry.json").read_text())["points"]
    assert points[0]["rcs_dbsm"] == pytest.approx(10 * np.log10(corner_m2()), abs=0.4)


@pytest.mark.slow
def test_constants_of_another_radar_are_refused(later, tmp_path):
    root = copy_writable(later.root, tmp_path / "campaign")
    pair, scene = open_pair(later, "f01", "uav1-uav1"), open_scene(later)
    change_file(root, lambda document: document["pairs"]["uav1-uav1"]["radar"].update(centre_hz=1.3e9))
    message = complaint(lambda: calibrated_pair(Campaign.load(root), pair, scene))
    assert "centre_hz is 1.4048e+09 and was 1.3e+09" in message
    change_file(root, lambda document: document["pairs"].pop("uav1-uav1"))
    assert calibrated_pair(Campaign.load(root), pair, scene) is None


@pytest.mark.slow
def test_pair_without_a_constant_is_flagged(later, tmp_path):
    """A trihedral calibrates only the monostatic pair: the run continues, and the bistatic pair has no σ⁰."""
    root = copy_writable(later.root, tmp_path / "campaign")
    change_file(root, lambda document: document["pairs"].pop("uav1-uav2"))
    campaign = Campaign.load(root)
    for pair in ("uav1-uav1", "uav1-uav2"):
        layers.layers(campaign, "f01", pair)
        export.export(campaign, "f01", pair)
    reports = {
        pair: json.loads(campaign.result("f01", pair, "image.json").read_text()) for pair in campaign.images["f01"][:2]
    }
    assert "pair_uncalibrated" not in reports["uav1-uav1"]["flags"]
    assert reports["uav1-uav2"]["flags"]["pair_uncalibrated"].startswith(
        "calibration.json has no constant for uav1-uav2"
    )
    for pair, has_values in (("uav1-uav1", True), ("uav1-uav2", False)):
        with rasterio.open(str(campaign.result("f01", pair, "sigma0_db.tif"))) as raster:
            assert np.isfinite(raster.read(1, masked=True).filled(np.nan)).any() == has_values


# ---- Without recordings ---------------------------------------------------------------------------------------------


def change_file(root, change, name="calibration.json"):
    document = json.loads((root / name).read_text())
    change(document)
    (root / name).write_text(json.dumps(document))


def configure_radio(root, gain_db):
    """Configure the simulated radio with a receiver gain in dB."""

    def change(document):
        for node in document["nodes"].values():
            receiver = {"full_scale_counts": 8192, "full_scale_dbm": 4.0, "gain_db": gain_db}
            node["antennas"].update(radar_tx_gain_dbi=8.0, radar_rx_gain_dbi=9.0)
            node.update(transmit_power_dbm=10.0, amplitude_std_db=0.5, receiver=receiver)

    edit_config(root, change)


def constants_of(*pairs):
    radar = Radar(centre_hz=1.4e9, bandwidth_hz=4e8, subcarriers=1024, sent_power=1024.0, antennas={})
    one = PairConstant(
        radar=radar,
        constant_db=60.0,
        std_db=0.3,
        chance=1.0,
        reflectors=1,
        flights=1,
        phase_rad=None,
        phase_std_rad=None,
        flags={},
    )
    return Constants(
        software="0",
        campaign="past",
        flights={"f01": "2025-05-14T09:30:00Z"},
        reference="a-a",
        pairs=dict.fromkeys(pairs, one),
        measurements=(),
        images={},
    )


def test_measured_constant_outdates_only_the_layers(tiny):
    (tiny / "calibration.json").write_text(constants_of("uav1-uav1", "uav1-uav2").model_dump_json())
    results = ("echo", "profile", "image", "layers", "export")
    before = {name: result_of(Campaign.load(tiny), name, "f01", "uav1-uav2") for name in results}
    campaign = state(tiny, "processing", radiometric_calibration="calibration.json")
    after = {name: result_of(campaign, name, "f01", "uav1-uav2") for name in results}
    assert campaign.calibrated
    assert {name for name in results if before[name].settings != after[name].settings} == {"layers"}
    assert "calibration.json" in after["layers"].sources


def test_reflectors_do_not_outdate_results(tiny):
    results = ("scene", "echo", "profile", "refined_track", "image", "layers", "export", "map")
    places = {"scene": (), "map": (), "refined_track": ("f01",)}
    before = {name: result_of(Campaign.load(tiny), name, *places.get(name, ("f01", "uav1-uav2"))) for name in results}
    ball = {"name": "ball", "position_m": [0.0, 0.0, 0.0], "std_m": 0.01, "kind": "sphere", "size_m": [0.2]}
    campaign = state(tiny, "scene", reflectors=[ball])
    for name in results:
        assert result_of(campaign, name, *places.get(name, ("f01", "uav1-uav2"))) == before[name]


def test_calibration_file_is_checked_before_a_run(tiny):
    state(tiny, "processing", radiometric_calibration="calibration.json")
    (line,) = map(as_line, problems(tiny))
    assert "calibration.json: no such file" in line
    (tiny / "calibration.json").write_text(constants_of("uav3-uav3").model_dump_json())
    (line,) = map(as_line, problems(tiny))
    assert "constants of uav3-uav3 only, none of uav1-uav1, uav1-uav2" in line
    (tiny / "calibration.json").write_text(constants_of("uav1-uav1").model_dump_json())
    assert problems(tiny) == []
    change_file(tiny, lambda document: document.update(schema_version=2))
    (line,) = map(as_line, problems(tiny))
    assert "schema_version" in line


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"kind": "sphere", "size_m": [0.2], "azimuth_deg": 3.0}, "a sphere has no boresight"),
        (
            {"kind": "trihedral", "size_m": [0.2], "azimuth_deg": 3.0},
            "a trihedral requires azimuth_deg and elevation_deg",
        ),
        (
            {"kind": "dihedral", "size_m": [0.2], "azimuth_deg": 3.0, "elevation_deg": 0.0},
            "[across the seam, along it]",
        ),
    ],
)
def test_incomplete_reflector_is_refused(tiny, keys, message):
    reflector = {"name": "r", "position_m": [0.0, 0.0, 0.0], "std_m": 0.01, **keys}
    assert message in complaint(lambda: state(tiny, "scene", reflectors=[reflector]))


def test_calibration_without_configured_reflectors_is_refused(tiny):
    assert "no reflectors" in complaint(lambda: measured_constants(Campaign.load(tiny)))


@pytest.mark.slow
def test_reflector_is_refused_for_a_polarisation_it_does_not_return(measured, tmp_path):
    """Trihedrals and spheres return H as H; HV contains only leakage, from which no constant is derived."""
    root = copy_writable(measured.root, tmp_path / "campaign")

    def with_receive_polarisation(letter):
        def change(document):
            for node in document["nodes"].values():
                node["antennas"] |= {"radar_tx_polarisation": "H", "radar_rx_polarisation": letter}

        edit_config(root, change)
        return Campaign.load(root)

    assert "returns no echo in polarisation HV" in complaint(lambda: measured_constants(with_receive_polarisation("V")))
    constants, _ = measured_constants(with_receive_polarisation("H"))
    own = constants.pairs["uav1-uav1"].radar
    assert own.polarisation == "HH"
    assert own.differs(own.model_copy(update={"polarisation": "VV"})) == "polarisation is VV and was HH"
    assert own.differs(own.model_copy(update={"polarisation": None})) is None


@pytest.mark.slow
def test_receiver_gain_change_is_flagged_from_noise(later, tmp_path):
    """The file was measured with a gain higher or lower by 6 dB, so that all cross-sections are wrong by 6 dB."""
    for factor, flagged in ((1.0, False), (4.0, True), (0.25, True)):
        root = copy_writable(later.root, tmp_path / f"{factor:g}")
        change_file(
            root,
            lambda document, factor=factor: document["pairs"]["uav1-uav1"].update(
                profile_noise=document["pairs"]["uav1-uav1"]["profile_noise"] * factor
            ),
        )
        campaign = Campaign.load(root)
        layers.layers(campaign, "f01", "uav1-uav1")
        report = json.loads(campaign.result("f01", "uav1-uav1", "radiometry.json").read_text())
        assert ("noise_disagrees" in report["flags"]) is flagged
