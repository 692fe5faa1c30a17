"""Identification of one wrong constant by the peaks of points: log time offset, lever arm, terrain height."""

import numpy as np
import pytest
from apertura_research.autofocus.cases import GRID, wrong_case
from apertura_research.autofocus.outcomes import judge

from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.cause_fit import CausePrior, explained
from apertura.methods.autofocus.inputs import NodePrior, Prior, TrackErrors
from apertura.methods.autofocus.refine import TrackSearch, refine
from apertura.methods.causes import late_logs, other_height

GROUND = FlatGround(0.0)


def test_adjoint_of_a_cause_is_its_transpose():
    generator, knots_s = np.random.default_rng(4), np.arange(0, 5, 0.1)
    flight = Prior({node: NodePrior.of(TrackErrors((0.01,) * 3), knots_s, np.eye(3)) for node in "ab"})
    logs = {node: (np.arange(0, 5, 0.01), generator.standard_normal((500, 3))) for node in "ab"}
    for cause in (late_logs("ab", logs), other_height("ab", logs["a"][0], np.array([0.0, 0.6, 0.8]))):
        prior = CausePrior.of(cause, flight, knots_s)
        unknowns = generator.standard_normal(prior.size)
        gradient = {node: generator.standard_normal((50, 3)) for node in "ab"}
        forward = sum(float((track * gradient[node]).sum()) for node, track in prior.tracks(unknowns).items())
        assert prior.adjoint(gradient) @ unknowns == pytest.approx(forward, rel=1e-12)


def test_higher_terrain_is_equivalent_to_lower_tracks():
    """A target on the higher terrain is focused with its true path length."""
    up, height_m = np.array([0.0, 0.0, 1.0]), 0.7
    flight = Prior({"a": NodePrior.of(TrackErrors((0.01,) * 3), np.arange(10.0), np.eye(3))})
    cause = other_height(["a"], np.arange(10.0), up)
    displacement_m = CausePrior.of(cause, flight, np.arange(10.0)).tracks(np.array([height_m]) / cause.std)["a"]
    antenna, target = np.array([3.0, -20.0, 30.0]), np.array([1.0, 5.0, height_m])
    true_m = np.linalg.norm(antenna - target)
    assert np.linalg.norm(antenna + displacement_m[0] - target * [1, 1, 0]) == pytest.approx(true_m)


@pytest.mark.slow
def test_wrong_lever_arm_is_found_within_3_cm():
    """The lever-arm error is added to track errors of 3 mm on a pass of 7.5 s."""
    case, causes, (node, arm_m) = wrong_case("lever arm", "points-5", "short", 0.003, 2)
    search = TrackSearch.begin(case.records, GRID, GROUND, case.errors)
    fit = explained(search.problem, causes, search.axes, np.random.default_rng(0))
    assert fit is not None
    assert fit.cause.quantity.kind == "lever arm"
    assert list(fit.cause.moved_m) == [node]
    assert fit.values == pytest.approx(arm_m, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed", "tolerance"), [("time", 5, 0.005), ("lever arm", 6, 0.03), ("height", 6, 0.1)]
)
def test_single_wrong_constant_is_identified_and_corrected(kind, seed, tolerance):
    """Residuals are within 5 ms, 3 cm and 10 cm; that of a height error of 40 cm causes a loss of 0.2 dB."""
    case, causes, (node, values) = wrong_case(kind, "points-5", "wobble", 0.003, seed)
    refined = refine(case.records, GRID, GROUND, case.errors, causes=causes)
    before, after = judge(case), judge(case, refined.correction)
    assert before.probe_loss_db < -1  # the error is significant
    assert list(refined.flags) == ["cause_corrected"]
    assert refined.report["cause"]["kind"] == kind
    assert node == "all" or f" {node} " in refined.report["cause"]["what"]
    assert refined.report["cause"]["values"] == pytest.approx(values, abs=tolerance)
    assert after.probe_loss_db > -0.3
    assert after.probe_shift_cm < 6


@pytest.mark.slow
def test_random_track_errors_are_not_attributed_to_a_constant():
    """Track errors of 4 cm over 7.5 s would be explained well by a lever arm if only the peak gain were considered."""
    for seed in (0, 1, 3):
        case, causes, _ = wrong_case("nothing", "points-6", "short", 0.04, seed)
        refined = refine(case.records, GRID, GROUND, case.errors, causes=causes)
        assert refined.accepted, seed
        assert "cause" not in refined.report, seed
