"""Antennas from the config to the image: a flight whose antennas have beams, imaged with and without knowing it."""

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


def fly(folder, antennas, snr_db):
    """Straight along azimuth 40°, the one target abeam of the middle."""
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
    looking = GaussianBeam((90.0, -DEPRESSION_DEG), (15.0, 60.0))
    return fly(tmp_path_factory.mktemp("beams"), {"radar_tx": looking, "radar_rx": looking}, -10.0)


@pytest.fixture(scope="module")
def _even(tmp_path_factory):
    return fly(tmp_path_factory.mktemp("even"), {}, 20.0)


@pytest.fixture
def beamed(_beamed, tmp_path):
    """Both antennas have beams of 15° × 60°; noise lies far above the echo of a pulse."""
    return copy_writable(_beamed, tmp_path / "campaign")


@pytest.fixture
def even(_even, tmp_path):
    """Isotropic antennas."""
    return copy_writable(_even, tmp_path / "campaign")


def stated(root, antenna, **processing):
    """Say in the config what both antennas are, None for nothing."""

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
    """Field of both antennas towards the target at each pulse, in closed form: the elevation hardly changes."""
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
    apart = np.hypot(row - middle[0], column - middle[1])
    ring = (apart > 25) & (apart < 45)
    peak = np.abs(pixels[apart < 6]).max() ** 2
    return 10 * np.log10(peak / (np.abs(pixels[ring]) ** 2).mean())


@pytest.fixture(scope="module")
def both(_beamed, tmp_path_factory):
    """The same recording imaged without and with its beams: pixels and image.json."""
    root = copy_writable(_beamed, tmp_path_factory.mktemp("both") / "campaign")
    return [imaged(stated(root, antenna)) for antenna in (None, BEAM)]


@pytest.mark.slow
def test_knowing_the_beam_gains_what_a_matched_filter_gains(both):
    (plain, without), (weighed, report) = both
    w = weights()
    gain_db = 10 * np.log10(PULSES * (w**2).sum() / w.sum() ** 2)
    assert gain_db > 2
    assert signal_to_noise(weighed) - signal_to_noise(plain) == pytest.approx(gain_db, abs=0.7)
    assert "antennas" not in without
    assert report["numerical_error_db"] <= -60
    assert report["flags"] == without["flags"]


@pytest.mark.slow
def test_an_image_is_the_mean_over_all_pulses_of_weight_times_echo(both):
    (plain, _), (weighed, _) = both
    w = weights()
    ratio = np.abs(weighed).max() / np.abs(plain).max()
    assert ratio == pytest.approx((w**2).sum() / w.sum(), rel=0.05)  # a·w is the echo: Σw·aw/M over Σaw/M


def pattern(root, azimuth, elevation=((-80, 0), (0, 0), (80, 0)), *, phase_deg=None):
    """Write a pattern, with a phase by azimuth if given, and return the antenna that has it."""
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
def test_a_target_out_of_the_beam_for_half_the_track_is_twice_as_wide(even):
    whole, _ = cross_range_m(stated(even, None))
    behind = pattern(even, [(0, 7), (40, 7), (80, 7)])  # only what lies behind abeam, and 7 dB are all the same
    half, report = cross_range_m(stated(even, behind))
    assert half / whole == pytest.approx(2, rel=0.05)
    seeing = report["antennas"]["illuminating_pulses"]
    assert seeing["of"] == PULSES
    assert seeing["median"] == pytest.approx(PULSES / 2, abs=3)
    assert report["numerical_error_db"] <= -60


@pytest.mark.slow
def test_a_sampled_gaussian_is_the_gaussian(beamed):
    by_width, _ = imaged(stated(beamed, BEAM | {"cutoff_db": -30}))
    angle = np.arange(-60, 60.1, 0.25)
    cuts = [list(zip(angle, 12 - 40 * np.log10(2) * (angle / width) ** 2, strict=True)) for width in (15, 60)]
    sampled, _ = imaged(stated(beamed, pattern(beamed, *cuts) | {"cutoff_db": -30}))
    assert np.abs(sampled - by_width).max() < 2e-3 * np.abs(by_width).max()
    inputs = open_stage(beamed / "results/f01/uav1-uav1/image.zarr", "image").attrs["inputs"]
    assert {name for name in inputs if "pattern" in name} == {
        f"nodes.uav1.antennas.radar_{end}.pattern" for end in ("tx", "rx")
    }


def test_the_beam_turns_with_the_yaw_that_was_logged(beamed):
    """Nose to tail, the beam points to the other side; the target is least far off at the ends of the track."""
    log = beamed / "raw" / "f01" / "uav1.track.csv"
    head, *lines = log.read_text().splitlines()
    turned = [",".join([*line.split(",")[:-1], str(float(line.split(",")[-1]) - 180)]) for line in lines]
    log.write_text("\n".join([head, *turned]) + "\n")
    campaign = stated(beamed, BEAM)
    message = complaint(lambda: expected_plan(campaign, "f01", "uav1-uav1"))
    slant = np.radians(DEPRESSION_DEG)
    towards = np.array([STEP_M * (PULSES - 1) / 2, BACK_M, UP_M])
    off_deg = np.degrees(np.arccos(towards @ [0, -np.cos(slant), np.sin(slant)] / np.linalg.norm(towards)))
    assert f"its centre is at least {off_deg:.0f}° from the boresight of uav1's radar_tx" in message


def test_a_boresight_to_the_wrong_side_is_refused_before_and_after_the_echo(beamed):
    campaign = stated(beamed, BEAM | {"boresight_deg": [-90.0, -DEPRESSION_DEG]})
    before = complaint(lambda: expected_plan(campaign, "f01", "uav1-uav1"))
    for part in ("uav1's radar_tx", "uav1's radar_rx", "right is +90", "yaw (clockwise from north)", "pattern ends at"):
        assert part in before
    assert complaint(lambda: imaged(campaign)) == before
    assert not (beamed / "results/f01/uav1-uav1/image.manifest.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("turn_deg", "misses"), [(0.0, False), (28.0, True)])
def test_a_scene_partly_outside_the_beam_is_flagged_with_its_share(beamed, turn_deg, misses):
    turned = BEAM | {"boresight_deg": [90.0 + turn_deg, -DEPRESSION_DEG]}
    campaign = stated(beamed, turned)
    pixels, report = imaged(campaign)
    dark = float(np.isnan(pixels).mean())
    assert ("outside_beam" in report["flags"]) is misses
    assert (dark > 0) is misses
    if misses:
        assert float(report["flags"]["outside_beam"].split()[0]) / 100 == pytest.approx(dark, abs=0.02)
        assert report["antennas"]["illuminating_pulses"]["least"] == 0
        layers.layers(campaign, "f01", "uav1-uav1")
        with rasterio.open(str(campaign.result("f01", "uav1-uav1", "mask.tif"))) as mask:
            np.testing.assert_array_equal(np.isnan(pixels), mask.read(1) == OUTSIDE)


def test_only_the_image_depends_on_what_the_beam_is(beamed):
    wide, narrow, none = (stated(beamed, b) for b in (BEAM | {"beamwidth_deg": [30.0, 60.0]}, BEAM, None))

    def settings(campaign, stage):
        return result_of(campaign, stage, "f01", "uav1-uav1").settings

    assert settings(wide, "echo") == settings(narrow, "echo") != settings(none, "echo")
    assert settings(wide, "image") != settings(narrow, "image")
    assert "antennas" not in settings(none, "image")
    assert "antennas" not in yaml.safe_dump(settings(none, "echo"))


@pytest.mark.slow
def test_the_echo_carries_the_body_s_axes_only_where_a_beam_needs_them(beamed):
    def axes(campaign):
        ingest.ingest(campaign, "f01", "uav1")
        echo.echo(campaign, "f01", "uav1-uav1")
        stored = PairEcho.opened(campaign, "f01", "uav1-uav1").stage
        return {name: stored[name].values for name in ("tx_axes", "rx_axes") if name in stored}

    assert axes(stated(beamed, None)) == {}
    stored = axes(stated(beamed, BEAM))
    assert stored.keys() == {"tx_axes", "rx_axes"}
    east_north_up = DEMO_ORIGIN.enu(DEMO_ORIGIN.ecef(np.zeros(3)) + stored["tx_axes"][0].T)
    np.testing.assert_allclose(east_north_up, [AHEAD, RIGHT, [0, 0, -1]], atol=1e-4)


def test_what_beams_forbid_is_refused_when_asked_for_and_not_chosen_otherwise(beamed):
    message = complaint(lambda: expected_plan(stated(beamed, BEAM, presum=4), "f01", "uav1-uav1"))
    assert "config/config.yaml: processing.presum" in message
    reasons = expected_plan(stated(beamed, BEAM), "f01", "uav1-uav1").reasons
    assert "the weights of the antennas differ" in reasons["presum"]
    assert reasons["antenna"].startswith("transmit, receive: each point of the scene is illuminated by ")
    assert " of 80 pulses (median " in reasons["antenna"]
    assert "antenna" not in expected_plan(stated(beamed, None), "f01", "uav1-uav1").reasons


@pytest.mark.slow
def test_the_phase_of_a_pattern_is_in_the_budget_and_flagged_where_it_costs_more_than_images_tell(beamed):
    """A parabola of 120° at 10° off boresight in each antenna, and none."""
    azimuth = [(angle, -12.04 * (angle / 15) ** 2) for angle in range(-20, 21, 2)]
    for turn_deg, flagged in ((0.0, False), (120.0, True)):
        antenna = pattern(beamed, azimuth, phase_deg=lambda angle, turn=turn_deg: turn * (angle / 10) ** 2)
        campaign = stated(beamed, antenna)
        _, report = imaged(campaign)
        line = next(one for one in report["budget"] if one["cause"] == "antenna")
        assert ("antenna_phase" in report["flags"]) is flagged
        assert (line["loss_db"] < -0.2) is flagged
        assert "whose phase varies by" in line["stated"]
