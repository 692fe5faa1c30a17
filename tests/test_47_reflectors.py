"""Constants measured at reflectors in one campaign, taken up by another of the same radar whose radio nobody states."""

import hashlib
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from folders import complaint, copy_writable, edit_config, export_flight, run_steps, state

from apertura.campaign.folder import Campaign
from apertura.check import as_line, problems
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.imaging.reflectors import Reflector
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
WAVELENGTH_M = SPEED_OF_LIGHT_M_S / 1.4046e9  # of the middle of the demo's band
BACK = np.array([-0.705, 0.592, 0.39]) / np.linalg.norm([-0.705, 0.592, 0.39])  # east, north, up: to the track
LEG_M, RADIUS_M = 0.25, 0.13  # a radius at which both pairs see the same to 0.1 dB
CORNER, BALL = (-1.5, 0.8, 0.0), (1.5, -0.7, 0.3)  # the latter on a stand
LOOKS = {"azimuth_deg": 310.0, "elevation_deg": 23.0}
FOUND_M2 = (0.2, 1.0)


def plan(name, targets, flights, radio=RADIO):
    """The demo's nodes; beams look to the right, where the scene is."""
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


def unknown_radio(root):
    """Take the radio out of a config: nobody has measured it."""

    def change(document):
        for node in document["nodes"].values():
            for key in ("transmit_power_dbm", "receiver", "amplitude_std_db"):
                node.pop(key, None)
            for key in ("radar_tx_gain_dbi", "radar_rx_gain_dbi"):
                node["antennas"].pop(key)

    edit_config(root, change)
    return root


def ball_m2():
    """The sphere straight back, at the middle of the band."""
    ahead = np.eye(3)[:1]
    (rcs_m2,), _ = Reflector("sphere", (RADIUS_M,), np.eye(3)).cross_section(ahead, ahead, wavelength_m=WAVELENGTH_M)
    return rcs_m2


def corner_m2():
    """The trihedral as the pass of f01 sees it on the mean: a simulated point is the same from everywhere."""
    track = preset("demo", pulses=120).flights[0].tracks["uav1"]
    flown = np.array(track.start_m) + np.outer(np.arange(120) / 20, track.velocity_m_s)
    away = flown - CORNER
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
    """A campaign of two flights over a trihedral and a sphere, imaged, of a radio that its config does not state."""
    skin = tuple(np.array(BALL) + RADIUS_M * BACK)  # where a sphere shines
    targets = PointTarget(CORNER, corner_m2() ** 0.5), PointTarget(skin, ball_m2() ** 0.5)
    spec = plan("over_reflectors", targets, {"f01": (0.0, 0.0, 0.0), "f02": (-1.0, 0.8, 1.0)})
    root = unknown_radio(simulate(tmp_path_factory.mktemp("reflectors") / "campaign", spec, seed=3))
    known = json.loads((root / "truth.json").read_text())["targets"]
    places = [[one[name] for name in ("x", "y", "height_m")] for one in known]
    places[1] = np.subtract(places[1], RADIUS_M * BACK).tolist()
    reflectors = [
        {"name": "corner", "kind": "trihedral", "size_m": [LEG_M], "position_m": places[0], "std_m": 0.02, **LOOKS},
        {"name": "ball", "kind": "sphere", "size_m": [RADIUS_M], "position_m": places[1], "std_m": 0.02},
    ]
    state(root, "scene", reflectors=reflectors)
    campaign = run_steps(root, exports=False)
    for flight in ("f01", "f02"):
        export_flight(campaign, flight)
    return campaign


@pytest.fixture(scope="module")
def later(measured, tmp_path_factory):
    """Another campaign of the same radar, other tracks and targets, which takes up the file."""
    targets = tuple(
        PointTarget(at, rcs**0.5) for at, rcs in zip(((-1.0, -1.2, 0.0), (0.5, 1.2, 0.0)), FOUND_M2, strict=True)
    )
    spec = plan("later", targets, {"f01": (-2.0, 1.5, 1.5)})
    root = unknown_radio(simulate(tmp_path_factory.mktemp("later") / "campaign", spec, seed=5))
    shutil.copy(str(write_constants(measured)), root / "calibration.json")
    state(root, "processing", radiometric_calibration="calibration.json")
    campaign = run_steps(root, exports=False)
    export_flight(campaign, "f01")
    return campaign


def true_constant_db(campaign, pair):
    """K by the radar equation from the radio that was simulated."""
    sent = Radar.of(campaign, open_pair(campaign, "f01", pair)).sent_power
    received = 10 ** ((10.0 - 30 + 8.0 + 9.0 + 37.3 - (4.0 - 30)) / 10) * WAVELENGTH_M**2 / (4 * np.pi) ** 3
    return 10 * np.log10(received * 8192**2 / sent)


@pytest.mark.slow
def test_each_reflector_says_the_constant_of_the_radio_that_was_simulated(measured):
    """Within its deviation, and closer than that: the points put have the cross-sections of the formulas."""
    constants, left_out = measured_constants(measured)
    at = {(one["flight"], one["pair"], one["reflector"]): one for one in constants.measurements}
    assert set(at) == {
        *((flight, "uav1-uav1", name) for flight in ("f01", "f02") for name in ("corner", "ball")),
        *((flight, "uav1-uav2", "ball") for flight in ("f01", "f02")),
    }
    for (_, pair, _), one in at.items():
        assert one["constant_db"] == pytest.approx(true_constant_db(measured, pair), abs=0.3), one
        assert one["off_m"] < 0.03
    assert [line.split(":")[0] for line in left_out] == [f"{flight} uav1-uav2 corner" for flight in ("f01", "f02")]


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_a_constant_lies_within_its_deviation(measured, pair):
    constants, _ = measured_constants(measured)
    found = constants.pairs[pair]
    assert abs(found.constant_db - true_constant_db(measured, pair)) < found.std_db < 0.7
    assert (found.flights, found.flags) == (2, {})
    if pair != constants.reference:  # path offsets are stated: nothing is left between the channels
        assert abs(found.phase_rad) < 2 * found.phase_std_rad < 0.5


@pytest.mark.slow
def test_another_flight_has_the_cross_sections_of_its_targets(later):
    """Another track, other targets, no radio stated: calibrated by the file alone."""
    found = [one for one in score(later) if one.image in PAIRS]
    assert len(found) == 4
    for one in found:
        assert abs(one.rcs_dbsm - one.rcs_put_dbsm) < one.rcs_std_db < 0.8
    said = json.loads(later.result("f01", "uav1-uav1", "radiometry.json").read_text())
    assert said["calibrated_by"] == "reflectors of campaign over_reflectors, 2025-05-14"
    assert said["link"] is None
    assert said["flags"] == {}


@pytest.mark.slow
def test_the_budget_has_the_deviation_of_the_file(later):
    image = json.loads(later.result("f01", "uav1-uav2", "image.json").read_text())
    std_db = read_constants(later.root / "calibration.json").pairs["uav1-uav2"].std_db
    assert (image["budget"][-1]["cause"], image["budget"][-1]["stated"]) == ("amplitude", f"{std_db:.2g} dB")


@pytest.mark.slow
def test_a_calibrated_product_is_followed_to_the_file_and_to_the_raw_samples(later):
    chain = verify(later.result("f01", "uav1-uav1", "sigma0_db.tif"))
    assert {link.state for link in chain.links} == {"same"}
    assert {"calibration.json", "raw/f01/uav1.sigmf-data"} <= {link.name for link in chain.links}


@pytest.mark.slow
def test_the_file_is_a_source_of_the_layers_and_another_makes_them_again(later, tmp_path):
    root = copy_writable(later.root, tmp_path / "campaign")
    campaign = Campaign.load(root)
    assert "calibration.json" in result_of(campaign, "layers", "f01", "uav1-uav1").sources
    assert "calibration.json" not in result_of(campaign, "image", "f01", "uav1-uav1").sources
    before = stale_results(campaign)
    change_file(root, lambda document: document["pairs"]["uav1-uav1"].update(constant_db=50.0))
    assert "results/f01/uav1-uav1/layers.manifest.json" in stale_results(campaign).keys() - before.keys()


@pytest.mark.slow
def test_a_radio_that_is_stated_wrong_is_flagged_and_not_used(later, tmp_path):
    """Receiver gain 4 dB off: eight standard deviations of what the config says of it."""
    root = copy_writable(later.root, tmp_path / "campaign")
    pair, scene = open_pair(later, "f01", "uav1-uav1"), open_scene(later)
    found = {}
    for gain_db in (37.3, 41.3):
        state_radio(root, gain_db)
        found[gain_db] = calibrated_pair(Campaign.load(root), pair, scene)
    right, wrong = found.values()
    assert wrong.calibration.constant == right.calibration.constant
    assert (list(right.flags), list(wrong.flags)) == ([], ["constant_disagrees"])
    assert float(wrong.flags["constant_disagrees"].split(" dB")[0].split()[-1]) == pytest.approx(4, abs=0.4)
    layers.layers(campaign := Campaign.load(root), "f01", "uav1-uav1")
    export.export(campaign, "f01", "uav1-uav1")
    image = json.loads(campaign.result("f01", "uav1-uav1", "image.json").read_text())
    assert "constant_disagrees" in image["flags"]


@pytest.mark.slow
def test_a_receiver_that_loses_gain_between_flights_is_flagged_in_its_own_pair(measured, tmp_path):
    """Samples of uav1 are a fifth lower in f02, 1.94 dB; uav2 divides by its sidelink, and records as before."""
    root = copy_writable(measured.root, tmp_path / "campaign")
    shutil.rmtree(root / "results")
    path = root / "raw/f02/uav1.sigmf-data"
    (np.fromfile(path, "<i2") * 0.8).round().astype("<i2").tofile(path)
    meta = json.loads(path.with_suffix(".sigmf-meta").read_text())
    meta["global"]["core:sha512"] = hashlib.sha512(path.read_bytes()).hexdigest()
    path.with_suffix(".sigmf-meta").write_text(json.dumps(meta))
    campaign = run_steps(root, exports=False)
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
def test_a_constant_that_is_not_the_earlier_one_has_drifted(measured, tmp_path):
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
def test_nothing_is_measured_in_images_of_other_settings(measured, tmp_path):
    root = copy_writable(measured.root, tmp_path / "campaign")
    campaign = state(root, "processing", window="none")
    assert "4 of 4 images out of date" in complaint(lambda: write_constants(campaign, root / "new.json"))
    assert not (root / "new.json").exists()


@pytest.mark.slow
def test_reflectors_stand_on_a_dem_or_are_left_out_beside_it(measured, tmp_path):
    """The ground 0.5 m below both: they are looked for where they are imaged, and lose to focus what that costs."""
    root = copy_writable(measured.root, tmp_path / "campaign")
    shutil.rmtree(root / "results")
    scene = measured.settings.scene
    west, south, east, north = scene.bounds_m
    ground = np.full((20, 20), measured.settings.scene.reflectors[0].position_m[2] - 0.5, np.float32)
    placed = rasterio.transform.from_bounds(west - 7, south - 7, east + 7, north + 7, 20, 20)
    with rasterio.open(
        root / "dem.tif",
        "w",
        driver="GTiff",
        width=20,
        height=20,
        count=1,
        dtype="float32",
        crs=scene.crs,
        transform=placed,
    ) as raster:
        raster.write(ground, 1)
    far = measured.values["scene"]["reflectors"][1] | {"name": "far", "position_m": [east + 5, north + 5, 620.0]}
    stated = {"dem": "dem.tif", "dem_datum": "ellipsoid", "reflectors": [*measured.values["scene"]["reflectors"], far]}
    table = root / "config/flights.tsv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:2]))
    state(root, "scene", **stated)
    campaign = run_steps(root, exports=False)
    layers.layers(campaign, "f01", "uav1-uav1")
    layers.layers(campaign, "f01", "uav1-uav2")
    constants, left_out = measured_constants(campaign)
    for one in constants.measurements:
        assert one["constant_db"] == pytest.approx(true_constant_db(measured, one["pair"]), abs=0.3), one
        assert one["off_m"] < 0.03
    assert "f01 uav1-uav1 far: outside the image" in left_out


@pytest.mark.slow
def test_a_phase_history_is_calibrated_by_its_own_images(measured, tmp_path):
    """As CPHD, without a scale and without beams: the constant is that towards the reflectors."""
    (tmp_path / "config").mkdir()
    scene = measured.values["scene"]
    waveform = {"kind": "phase_history", "format": "cphd"}
    config = {"campaign": "histories", "waveform": waveform, "nodes": {"uav1": {}}, "scene": scene}
    (tmp_path / "config/config.yaml").write_text(json.dumps(config))
    (tmp_path / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\tuav1\n")
    written = cphd.cphd(measured, "f01", "uav1-uav1")
    (tmp_path / "raw/f01").mkdir(parents=True)
    shutil.copy(str(written), tmp_path / "raw/f01/uav1.cphd")
    campaign = run_steps(tmp_path, exports=False)
    layers.layers(campaign, "f01", "uav1-uav1")
    found = read_constants(write_constants(campaign)).pairs["uav1-uav1"]
    assert found.radar.sent_power is None
    assert -3 < found.constant_db - true_constant_db(measured, "uav1-uav1") < 0  # what the beams lack there
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
def test_a_pair_without_a_constant_is_flagged_and_the_other_one_calibrated(later, tmp_path):
    """A trihedral serves the monostatic pair alone: the run goes on, the bistatic pair holds no σ⁰ and says why."""
    root = copy_writable(later.root, tmp_path / "campaign")
    change_file(root, lambda document: document["pairs"].pop("uav1-uav2"))
    campaign = Campaign.load(root)
    for pair in ("uav1-uav1", "uav1-uav2"):
        layers.layers(campaign, "f01", pair)
        export.export(campaign, "f01", pair)
    told = {
        pair: json.loads(campaign.result("f01", pair, "image.json").read_text()) for pair in campaign.images["f01"][:2]
    }
    assert "pair_uncalibrated" not in told["uav1-uav1"]["flags"]
    assert told["uav1-uav2"]["flags"]["pair_uncalibrated"].startswith("calibration.json has no constant for uav1-uav2")
    for pair, some in (("uav1-uav1", True), ("uav1-uav2", False)):
        with rasterio.open(str(campaign.result("f01", pair, "sigma0_db.tif"))) as raster:
            assert np.isfinite(raster.read(1, masked=True).filled(np.nan)).any() == some


# ---- Without recordings ---------------------------------------------------------------------------------------------


def change_file(root, change, name="calibration.json"):
    document = json.loads((root / name).read_text())
    change(document)
    (root / name).write_text(json.dumps(document))


def state_radio(root, gain_db):
    """State the simulated radio in a config, but for the receivers' gain."""

    def change(document):
        for node in document["nodes"].values():
            receiver = {"full_scale_counts": 8192, "full_scale_dbm": 4.0, "gain_db": gain_db}
            node["antennas"].update(radar_tx_gain_dbi=8.0, radar_rx_gain_dbi=9.0)
            node.update(transmit_power_dbm=10.0, amplitude_std_db=0.5, receiver=receiver)

    edit_config(root, change)


def some_constants(*pairs):
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


def test_a_measured_constant_needs_no_radio_and_forms_no_image_again(tiny):
    (tiny / "calibration.json").write_text(some_constants("uav1-uav1", "uav1-uav2").model_dump_json())
    made = ("echo", "profile", "image", "layers", "export")
    before = {name: result_of(Campaign.load(tiny), name, "f01", "uav1-uav2") for name in made}
    campaign = state(tiny, "processing", radiometric_calibration="calibration.json")
    after = {name: result_of(campaign, name, "f01", "uav1-uav2") for name in made}
    assert campaign.calibrated
    assert {name for name in made if before[name].settings != after[name].settings} == {"layers"}
    assert "calibration.json" in after["layers"].sources


def test_a_reflector_makes_nothing_again(tiny):
    made = ("scene", "echo", "profile", "refined_track", "image", "layers", "export", "map")
    places = {"scene": (), "map": (), "refined_track": ("f01",)}
    before = {name: result_of(Campaign.load(tiny), name, *places.get(name, ("f01", "uav1-uav2"))) for name in made}
    ball = {"name": "ball", "position_m": [0.0, 0.0, 0.0], "std_m": 0.01, "kind": "sphere", "size_m": [0.2]}
    campaign = state(tiny, "scene", reflectors=[ball])
    for name in made:
        assert result_of(campaign, name, *places.get(name, ("f01", "uav1-uav2"))) == before[name]


def test_a_file_of_constants_is_checked_before_anything_runs(tiny):
    state(tiny, "processing", radiometric_calibration="calibration.json")
    (line,) = map(as_line, problems(tiny))
    assert "calibration.json: no such file" in line
    (tiny / "calibration.json").write_text(some_constants("uav3-uav3").model_dump_json())
    (line,) = map(as_line, problems(tiny))
    assert "constants of uav3-uav3 only, none of uav1-uav1, uav1-uav2" in line
    (tiny / "calibration.json").write_text(some_constants("uav1-uav1").model_dump_json())
    assert problems(tiny) == []
    change_file(tiny, lambda document: document.update(schema_version=2))
    (line,) = map(as_line, problems(tiny))
    assert "schema_version" in line


@pytest.mark.parametrize(
    ("keys", "told"),
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
def test_a_reflector_is_stated_whole(tiny, keys, told):
    one = {"name": "r", "position_m": [0.0, 0.0, 0.0], "std_m": 0.01, **keys}
    assert told in complaint(lambda: state(tiny, "scene", reflectors=[one]))


def test_reflectors_are_stated_before_they_are_measured(tiny):
    assert "no reflectors" in complaint(lambda: measured_constants(Campaign.load(tiny)))


@pytest.mark.slow
def test_a_reflector_measures_no_polarisation_that_it_does_not_return(measured, tmp_path):
    """What a trihedral or sphere sends back of H is H: in HV only leaks are seen, and no constant follows."""
    root = copy_writable(measured.root, tmp_path / "campaign")

    def received(letter):
        def change(document):
            for node in document["nodes"].values():
                node["antennas"] |= {"radar_tx_polarisation": "H", "radar_rx_polarisation": letter}

        edit_config(root, change)
        return Campaign.load(root)

    assert "returns no echo in polarisation HV" in complaint(lambda: measured_constants(received("V")))
    constants, _ = measured_constants(received("H"))
    own = constants.pairs["uav1-uav1"].radar
    assert own.polarisation == "HH"
    assert own.differs(own.model_copy(update={"polarisation": "VV"})) == "polarisation is VV and was HH"
    assert own.differs(own.model_copy(update={"polarisation": None})) is None


@pytest.mark.slow
def test_a_receiver_whose_gain_was_changed_since_is_told_by_its_noise(later, tmp_path):
    """The file is of a gain 6 dB higher or lower: every cross-section would be wrong by as much."""
    for wrong, flagged in ((1.0, False), (4.0, True), (0.25, True)):
        root = copy_writable(later.root, tmp_path / f"{wrong:g}")
        change_file(
            root,
            lambda document, wrong=wrong: document["pairs"]["uav1-uav1"].update(
                profile_noise=document["pairs"]["uav1-uav1"]["profile_noise"] * wrong
            ),
        )
        campaign = Campaign.load(root)
        layers.layers(campaign, "f01", "uav1-uav1")
        said = json.loads(campaign.result("f01", "uav1-uav1", "radiometry.json").read_text())
        assert ("noise_disagrees" in said["flags"]) is flagged
