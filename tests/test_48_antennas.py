"""Antenna beams, from the config to the image: one flight imaged with and without its configured beams."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
import yaml
from folders import complaint, copy_writable, edit_config, expected_plan, quality_of

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.core.quality.point_targets import cut_through, find_peak
from apertura.formats.export.layers import OUTSIDE
from apertura.simulation import (
    GaussianBeam,
    ImageGrid,
    Impairments,
    PointTarget,
    SimulatedFlight,
    SimulatedNode,
    Straight,
    preset,
    simulate,
)
from apertura.simulation.presets import DEMO_ORIGIN
from apertura.stages import echo, image, ingest, layers, profile, refine, scene
from apertura.stages.transfer import PairEcho
from apertura.workflow.lineage import result_of

PULSES, STEP_M, BACK_M, UP_M = 80, 0.1, 11.5, 4.8
DEPRESSION_DEG = float(np.degrees(np.arctan2(UP_M, BACK_M)))
AHEAD = np.array([np.sin(np.radians(40.0)), np.cos(np.radians(40.0)), 0.0])
RIGHT = np.array([AHEAD[1], -AHEAD[0], 0.0])
BEAM = {"boresight_deg": [90.0, -DEPRESSION_DEG], "beamwidth_deg": [15.0, 60.0]}


def simulated(folder, antennas, snr_db):
    """Simulate a straight track along azimuth 40° with one target abeam of the midpoint."""
    plan = preset("demo", pulses=PULSES)
    speed = STEP_M * plan.waveform.prf_hz
    start = -RIGHT * BACK_M - AHEAD * STEP_M * (PULSES - 1) / 2 + [0, 0, UP_M]
    plan = replace(
        plan,
        targets=(PointTarget((0, 0, 0)),),
        nodes={"uav1": SimulatedNode(impairments=Impairments(radar_snr_db=snr_db), antennas=antennas)},
        flights=(SimulatedFlight("f01", "uav1", {"uav1": Straight(tuple(start), tuple(AHEAD * speed))}, PULSES),),
        scene=ImageGrid("EPSG:32632", half_width_m=3.2, spacing_m=0.05),
    )
    return simulate(folder / "campaign", plan, seed=5)


@pytest.fixture(scope="module")
def _beamed(tmp_path_factory):
    beam = GaussianBeam((90.0, -DEPRESSION_DEG), (15.0, 60.0))
    return simulated(tmp_path_factory.mktemp("beams"), {"radar_tx": beam, "radar_rx": beam}, -10.0)


@pytest.fixture(scope="module")
def _isotropic(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("isotropic"), {}, 20.0)


@pytest.fixture
def beamed(_beamed, tmp_path):
    """Return a campaign with beams of 15° × 60° at both antennas and noise far above the echo of a pulse."""
    return copy_writable(_beamed, tmp_path / "campaign")


@pytest.fixture
def isotropic(_isotropic, tmp_path):
    """Return a campaign with isotropic antennas."""
    return copy_writable(_isotropic, tmp_path / "campaign")


def with_antennas(root, antenna, **processing):
    """Configure both antennas, or none if `antenna` is None."""

    def change(document):
        document["nodes"]["uav1"]["antennas"] = {"radar_tx": antenna, "radar_rx": antenna} if antenna else {}
        document["processing"] = processing

    edit_config(root, change)
    return Campaign.load(root)


def imaged(campaign):
    ingest.ingest(campaign, "f01", "uav1")
    echo.echo(campaign, "f01", "uav1-uav1")
    scene.scene(campaign)
    profile.profile(campaign, "f01", "uav1-uav1")
    refine.refine(campaign, "f01")
    image.image(campaign, "f01", "uav1-uav1", threads=2)
    folder = campaign.results / "f01" / "uav1-uav1"
    report = quality_of(campaign, "uav1-uav1")
    return open_stage(folder / "image.zarr", "image").image.values, report


def weights(width_deg=15.0):
    """Return the two-way field of both antennas towards the target at each pulse, in closed form."""
    along = STEP_M * (np.arange(PULSES) - (PULSES - 1) / 2)
    away = np.stack([-along, np.full(PULSES, BACK_M), np.full(PULSES, -UP_M)], -1)
    slant = np.radians(DEPRESSION_DEG)
    ahead = away[:, 1] * np.cos(slant) - away[:, 2] * np.sin(slant)
    above = away[:, 1] * np.sin(slant) + away[:, 2] * np.cos(slant)
    azimuth, elevation = np.arctan2(away[:, 0], ahead), np.arctan2(above, np.hypot(ahead, away[:, 0]))
    return 2.0 ** (-4 * (np.degrees(azimuth) / width_deg) ** 2 - 4 * (np.degrees(elevation) / 60) ** 2)


def signal_to_noise(pixels):
    middle = np.array(pixels.shape) // 2
    row, column = np.indices(pixels.shape)
    distance_px = np.hypot(row - middle[0], column - middle[1])
    ring = (distance_px > 25) & (distance_px < 45)
    peak = np.abs(pixels[distance_px < 6]).max() ** 2
    return 10 * np.log10(peak / (np.abs(pixels[ring]) ** 2).mean())


@pytest.fixture(scope="module")
def both(_beamed, tmp_path_factory):
    """Image the same recording without and with its beams: pixels and image.json."""
    root = copy_writable(_beamed, tmp_path_factory.mktemp("both") / "campaign")
    return [imaged(with_antennas(root, antenna)) for antenna in (None, BEAM)]


@pytest.mark.slow
def test_configured_beam_gains_as_a_matched_filter(both):
    (plain, without), (weighed, report) = both
    w = weights()
    gain_db = 10 * np.log10(PULSES * (w**2).sum() / w.sum() ** 2)
    assert gain_db > 2
    assert signal_to_noise(weighed) - signal_to_noise(plain) == pytest.approx(gain_db, abs=0.7)
    assert "antennas" not in without
    assert report["numerical_error_db"] <= -60
    assert report["flags"] == without["flags"]


@pytest.mark.slow
def test_image_is_the_mean_of_weighted_echoes(both):
    (plain, _), (weighed, _) = both
    w = weights()
    ratio = np.abs(weighed).max() / np.abs(plain).max()
    assert ratio == pytest.approx((w**2).sum() / w.sum(), rel=0.05)  # with echoes a·w: Σw·aw/M over Σaw/M


def pattern(root, azimuth, elevation=((-80, 0), (0, 0), (80, 0)), *, phase_deg=None):
    """Write a pattern, optionally with a phase by azimuth, and return the antenna that uses it."""
    rows = [("azimuth", *sample) for sample in azimuth] + [("elevation", *sample) for sample in elevation]
    lines = ["cut,angle_deg,gain_db", *(f"{cut},{angle},{gain}" for cut, angle, gain in rows)]
    if phase_deg is not None:
        phases = ["phase_deg", *(phase_deg(angle) if cut == "azimuth" else 0 for cut, angle, _ in rows)]
        lines = [f"{line},{phase}" for line, phase in zip(lines, phases, strict=True)]
    (root / "config" / "pattern.csv").write_text("\n".join(lines) + "\n")
    return {"boresight_deg": BEAM["boresight_deg"], "pattern": "config/pattern.csv"}


def cross_range_m(campaign):
    pixels, report = imaged(campaign)
    peak = find_peak(pixels, *(size // 2 for size in pixels.shape))
    cut = cut_through(pixels, peak, direction=(AHEAD[0], AHEAD[1]), spacing_m=0.05, reach_m=2.5)
    return cut.width_m, report


@pytest.mark.slow
def test_half_the_aperture_doubles_the_width(isotropic):
    whole, _ = cross_range_m(with_antennas(isotropic, None))
    behind = pattern(
        isotropic, [(0, 7), (40, 7), (80, 7)]
    )  # only directions behind abeam, with a constant gain of 7 dB
    half, report = cross_range_m(with_antennas(isotropic, behind))
    assert half / whole == pytest.approx(2, rel=0.05)
    pulses = report["antennas"]["illuminating_pulses"]
    assert pulses["of"] == PULSES
    assert pulses["median"] == pytest.approx(PULSES / 2, abs=3)
    assert report["numerical_error_db"] <= -60


@pytest.mark.slow
def test_sampled_gaussian_pattern_equals_the_analytic_beam(beamed):
    by_width, _ = imaged(with_antennas(beamed, BEAM | {"cutoff_db": -30}))
    angle = np.arange(-60, 60.1, 0.25)
    cuts = [list(zip(angle, 12 - 40 * np.log10(2) * (angle / width) ** 2, strict=True)) for width in (15, 60)]
    sampled, _ = imaged(with_antennas(beamed, pattern(beamed, *cuts) | {"cutoff_db": -30}))
    assert np.abs(sampled - by_width).max() < 2e-3 * np.abs(by_width).max()
    inputs = open_stage(beamed / "results/f01/uav1-uav1/image.zarr", "image").attrs["inputs"]
    assert {name for name in inputs if "pattern" in name} == {
        f"nodes.uav1.antennas.radar_{end}.pattern" for end in ("tx", "rx")
    }


def test_beam_rotates_with_the_logged_yaw(beamed):
    """With reversed yaw, the beam points to the other side; the off-boresight angle is smallest at the track ends."""
    log = beamed / "raw" / "f01" / "uav1.track.csv"
    head, *lines = log.read_text().splitlines()
    reversed_yaw = [",".join([*line.split(",")[:-1], str(float(line.split(",")[-1]) - 180)]) for line in lines]
    log.write_text("\n".join([head, *reversed_yaw]) + "\n")
    campaign = with_antennas(beamed, BEAM)
    message = complaint(lambda: expected_plan(campaign, "f01", "uav1-uav1"))
    slant = np.radians(DEPRESSION_DEG)
    towards = np.array([STEP_M * (PULSES - 1) / 2, BACK_M, UP_M])
    off_deg = np.degrees(np.arccos(towards @ [0, -np.cos(slant), np.sin(slant)] / np.linalg.norm(towards)))
    assert f"its centre is at least {off_deg:.0f}° from the boresight of uav1's radar_tx" in message


@pytest.mark.slow
def test_boresight_to_the_wrong_side_is_refused(beamed):
    campaign = with_antennas(beamed, BEAM | {"boresight_deg": [-90.0, -DEPRESSION_DEG]})
    before = complaint(lambda: expected_plan(campaign, "f01", "uav1-uav1"))
    for part in ("uav1's radar_tx", "uav1's radar_rx", "right is +90", "yaw (clockwise from north)", "pattern ends at"):
        assert part in before
    assert complaint(lambda: imaged(campaign)) == before
    assert not (beamed / "results/f01/uav1-uav1/image.manifest.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("offset_deg", "is_partial"), [(0.0, False), (28.0, True)])
def test_scene_partly_outside_the_beam_is_flagged(beamed, offset_deg, is_partial):
    rotated = BEAM | {"boresight_deg": [90.0 + offset_deg, -DEPRESSION_DEG]}
    campaign = with_antennas(beamed, rotated)
    pixels, report = imaged(campaign)
    dark = float(np.isnan(pixels).mean())
    assert ("outside_beam" in report["flags"]) is is_partial
    assert (dark > 0) is is_partial
    if is_partial:
        assert float(report["flags"]["outside_beam"].split("illuminates ")[1].split()[0]) / 100 == pytest.approx(
            dark, abs=0.02
        )
        assert report["antennas"]["illuminating_pulses"]["least"] == 0
        layers.layers(campaign, "f01", "uav1-uav1")
        with rasterio.open(str(campaign.result("f01", "uav1-uav1", "mask.tif"))) as mask:
            np.testing.assert_array_equal(np.isnan(pixels), mask.read(1) == OUTSIDE)


def test_beam_changes_only_the_image(beamed):
    wide, narrow, none = (with_antennas(beamed, b) for b in (BEAM | {"beamwidth_deg": [30.0, 60.0]}, BEAM, None))

    def settings(campaign, stage):
        return result_of(campaign, stage, "f01", "uav1-uav1").settings

    assert settings(wide, "echo") == settings(narrow, "echo") != settings(none, "echo")
    assert settings(wide, "image") != settings(narrow, "image")
    assert "antennas" not in settings(none, "image")
    assert "antennas" not in yaml.safe_dump(settings(none, "echo"))


@pytest.mark.slow
def test_echo_contains_body_axes_only_with_beams(beamed):
    def axes(campaign):
        ingest.ingest(campaign, "f01", "uav1")
        echo.echo(campaign, "f01", "uav1-uav1")
        stored = PairEcho.opened(campaign, "f01", "uav1-uav1").stage
        return {name: stored[name].values for name in ("tx_axes", "rx_axes") if name in stored}

    assert axes(with_antennas(beamed, None)) == {}
    stored = axes(with_antennas(beamed, BEAM))
    assert stored.keys() == {"tx_axes", "rx_axes"}
    east_north_up = DEMO_ORIGIN.enu(DEMO_ORIGIN.ecef(np.zeros(3)) + stored["tx_axes"][0].T)
    np.testing.assert_allclose(east_north_up, [AHEAD, RIGHT, [0, 0, -1]], atol=1e-4)


@pytest.mark.slow
def test_presumming_is_refused_with_beams(beamed):
    message = complaint(lambda: expected_plan(with_antennas(beamed, BEAM, presum=4), "f01", "uav1-uav1"))
    assert "config/config.yaml: processing.presum" in message
    reasons = expected_plan(with_antennas(beamed, BEAM), "f01", "uav1-uav1").reasons
    assert "the weights of the antennas differ" in reasons["presum"]
    assert reasons["antenna"].startswith("transmit, receive: each point of the scene is illuminated by ")
    assert " of 80 pulses (median " in reasons["antenna"]
    assert "antenna" not in expected_plan(with_antennas(beamed, None), "f01", "uav1-uav1").reasons


@pytest.mark.slow
def test_phase_of_a_pattern_is_in_the_budget_and_flagged(beamed):
    """Each antenna has a quadratic phase of 120° at 10° off boresight, compared with zero phase."""
    azimuth = [(angle, -12.04 * (angle / 15) ** 2) for angle in range(-20, 21, 2)]
    for phase_deg, flagged in ((0.0, False), (120.0, True)):
        antenna = pattern(beamed, azimuth, phase_deg=lambda angle, at_10_deg=phase_deg: at_10_deg * (angle / 10) ** 2)
        campaign = with_antennas(beamed, antenna)
        _, report = imaged(campaign)
        line = next(line for line in report["budget"] if line["cause"] == "antenna")
        assert ("antenna_phase" in report["flags"]) is flagged
        assert (line["loss_db"] < -0.2) is flagged
        assert "whose phase varies by" in line["stated"]
