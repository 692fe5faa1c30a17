"""Campaign far from its scene: autofocus estimates one phase per pulse, and images are formed with these phases."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from folders import STAND_ON_ALL, copy_writable, edit_config, image_of, quality_of, state
from spoiling.logs import read_log, write_log
from spoiling.of_logs import noisy
from track_noise import declare_std

from apertura.campaign.config.processing import Processing
from apertura.campaign.store import open_stage
from apertura.core.imaging.range_profiles import profiles_of
from apertura.methods.autofocus.one_phase import METHODS, MOST_LOSS_DB, SpaceVariance
from apertura.methods.autofocus.patches import Candidates
from apertura.methods.autofocus.path_offsets import refine_one_phase
from apertura.run.process import process
from apertura.simulation import ImageGrid, PointTarget, SimulatedFlight, Straight, preset, simulate
from apertura.stages import refine
from apertura.stages.pair import open_pair
from apertura.stages.refine import ONE_PHASE, autofocus_of, clock_s, decide_method, open_refined, refinement_inputs
from apertura.stages.scene import open_scene
from apertura.views.score import score
from apertura.workflow.stale import stale_results

PAIRS = ("uav1-uav1", "uav1-uav2")
SUFFICIENT, INSUFFICIENT = SpaceVariance(0.2, -MOST_LOSS_DB + 0.01), SpaceVariance(0.3, -MOST_LOSS_DB - 0.01)
POINTS_M = ((-9, -8.5), (0, -10), (8, -6), (-5, -3), (4, -1), (-10, 2), (10, 4), (-1, 5.5), (5, 9.5), (-8, 10.5))


def far_away():
    """Return a specification: ten points on 24 m × 24 m at 300 m distance from a track of 60 m, flown in 15 s."""
    demo, pulses, speed_m_s = preset("demo"), 300, 4.0
    half_m = speed_m_s * (pulses - 1) / demo.waveform.prf_hz / 2
    tracks = {
        name: Straight((ahead_m - half_m, -290.0, 80.0), (speed_m_s, 0.0, 0.0))
        for name, ahead_m in (("uav1", -2.0), ("uav2", 3.0))
    }
    return replace(
        demo,
        waveform=replace(demo.waveform, cyclic_prefix_s=2.5e-6),
        targets=tuple(PointTarget((*place, 0.0)) for place in POINTS_M),
        flights=(SimulatedFlight("f01", "uav1", tracks, pulses),),
        scene=ImageGrid("EPSG:32632", half_width_m=12.0, spacing_m=0.1),
    )


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    """Return the far campaign with correct logs, and with log errors of 2 cm refined by `auto`."""
    folder = tmp_path_factory.mktemp("far")
    right = simulate(folder / "right", far_away(), seed=7)
    corrected = copy_writable(right, folder / "corrected")
    for path in sorted((corrected / "raw" / "f01").glob("*.track.*")):
        log = noisy(0.02, seed=3)(read_log(path))
        write_log(path, log if log.attitude_deg is not None else declare_std(0.02)(log))
    edit_config(corrected, lambda document: [node.update(position_std_m=0.02) for node in document["nodes"].values()])
    state(right, "processing", autofocus="off")
    return {root.name: process(root, last="" if root is corrected else "cube") for root in (right, corrected)}


def opened(campaign):
    """Return the pairs of the flight with their profiles, and the scene."""
    pairs = [open_pair(campaign, "f01", name) for name in PAIRS]
    stages = [open_stage(campaign.stage("profile", "f01", name), "profile") for name in PAIRS]
    return {pair: profiles_of(stage, lazy=True) for pair, stage in zip(pairs, stages, strict=True)}, open_scene(
        campaign
    )


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_one_phase_per_pulse_focuses_images_of_a_far_scene(campaigns, pair):
    right, corrected = (np.abs(image_of(campaign, pair)).max() for campaign in campaigns.values())
    quality = quality_of(campaigns["corrected"], pair)
    assert quality["autofocus"]["gain_held_out_db"] > 3
    assert 20 * np.log10(corrected / right) > -0.2
    assert quality["autofocus"]["accepted"]
    assert quality["autofocus"]["method"].startswith("minimum_entropy: auto: in uav1-uav1 one phase per pulse leaves")
    assert quality["models"]["autofocus_method"] == quality["autofocus"]["method"]
    assert 1 < quality["autofocus"]["extra_path_rms_cm"] < 5
    assert "rms_cm" not in quality["autofocus"]
    assert quality["focus"]["verdict"] == "focused"
    assert quality["focus"]["expected_db"] == pytest.approx(20 * np.log10(corrected / right), abs=0.2)


@pytest.mark.slow
def test_residual_displacement_is_that_of_the_budget(campaigns):
    """One phase per pulse leaves a displacement, which the budget attributes to the logs (1σ)."""
    (line,) = [line for line in quality_of(campaigns["corrected"], PAIRS[0])["budget"] if line["cause"] == "positions"]
    assert max(finding.error_m for finding in score(campaigns["corrected"])) < 2 * line["shift_m"]
    assert line["shift_m"] == pytest.approx(0.087, rel=0.05)


@pytest.mark.slow
def test_images_use_the_estimated_phases(campaigns):
    campaign = campaigns["corrected"]
    pairs, scene = opened(campaign)
    inputs, track = refinement_inputs(campaign, pairs, scene), open_refined(campaign, "f01")
    candidates = Candidates.of(inputs.records, scene.grid, scene.terrain, inputs.errors)
    refinement = refine_one_phase(inputs.records, candidates, inputs.errors, method=ONE_PHASE)
    assert track.stage.attrs["pairs"] == list(PAIRS)
    assert not track.stage.correction.values.any()
    for pair, profiles in pairs.items():
        extra_path_m = refinement.correction.longer_m(pair.name, clock_s(pair, inputs.began), pair.sidelink_m)
        imaged, moved = track.pair(pair), track.profiles(pair, profiles)
        assert np.std(extra_path_m) > 0.01
        np.testing.assert_allclose(moved.start_m - profiles.start_m, extra_path_m, atol=1e-8)
        delayed_s = imaged.history.reference_delay_s - pair.history.reference_delay_s
        np.testing.assert_allclose(pair.history.wave_speed_m_s * delayed_s, extra_path_m, atol=1e-8)
        np.testing.assert_array_equal(imaged.aperture.tx_m, pair.aperture.tx_m)


@pytest.mark.slow
def test_configured_method_is_used(campaigns, tmp_path):
    root = copy_writable(campaigns["corrected"].root, tmp_path / "campaign")
    campaign = state(root, "processing", autofocus_method="phase_gradient")
    refine.refine(campaign, "f01")
    attrs = open_refined(campaign, "f01").stage.attrs
    assert attrs["decisions"]["autofocus_method"] == {"value": "phase_gradient", "reason": "configured"}
    assert attrs["report"]["method"] == "phase_gradient"
    assert attrs["accepted"]


@pytest.mark.parametrize(
    ("configured", "second", "known_points", "value"),
    [
        ("auto", SUFFICIENT, False, "minimum_entropy"),
        ("auto", INSUFFICIENT, False, "tracks"),
        ("auto", SUFFICIENT, True, "tracks"),
        ("tracks", SUFFICIENT, False, "tracks"),
        ("phase_gradient", INSUFFICIENT, True, "phase_gradient"),
    ],
)
def test_one_phase_is_chosen_if_it_suffices_for_every_pair(configured, second, known_points, value):
    variances = {"a-a": SpaceVariance(0.1, -0.01), "a-b": second}
    decision = decide_method(configured, variances, known_points=known_points)
    assert decision.value == value
    assert ("in a-b one phase per pulse leaves" in decision.reason) is (configured == "auto" and not known_points)


@pytest.mark.slow
def test_near_scenes_need_tracks_and_far_ones_one_phase(campaigns, finished_tiny, tmp_path):
    near = state(copy_writable(finished_tiny.root, tmp_path / "near"), "processing", autofocus="on")
    for campaign, value in ((near, "tracks"), (campaigns["corrected"], ONE_PHASE)):
        pairs, scene = opened(campaign)
        autofocus, method = autofocus_of(campaign, list(pairs), scene)
        assert (autofocus.value, method.name, method.value) == ("on", "autofocus_method", value)
    pairs, scene = opened(campaigns["right"])
    assert len(autofocus_of(campaigns["right"], list(pairs), scene)) == 1


def test_every_method_is_configurable_and_outdates_dependent_results(finished_tiny, tmp_path):
    assert get_args(Processing.model_fields["autofocus_method"].annotation) == ("auto", "tracks", *METHODS)
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    campaign = state(root, "processing", autofocus_method="tracks")
    stale = {name.rsplit("/", 1)[1].split(".")[0] for name in stale_results(campaign)}
    assert stale == {"refined_track", "tracks", "image", "assessment", "export", "cube"} | STAND_ON_ALL
