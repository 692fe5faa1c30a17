"""One wrong constant of the config, found by what points gain: times of logs, lever arms, height of the ground."""

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


def test_the_adjoint_of_a_cause_is_its_transpose():
    generator, knots_s = np.random.default_rng(4), np.arange(0, 5, 0.1)
    flight = Prior({node: NodePrior.of(TrackErrors((0.01,) * 3), knots_s, np.eye(3)) for node in "ab"})
    flown = {node: (np.arange(0, 5, 0.01), generator.standard_normal((500, 3))) for node in "ab"}
    for cause in (late_logs("ab", flown), other_height("ab", flown["a"][0], np.array([0.0, 0.6, 0.8]))):
        prior = CausePrior.of(cause, flight, knots_s)
        unknowns = generator.standard_normal(prior.size)
        gradient = {node: generator.standard_normal((50, 3)) for node in "ab"}
        forward = sum(float((track * gradient[node]).sum()) for node, track in prior.tracks(unknowns).items())
        assert prior.adjoint(gradient) @ unknowns == pytest.approx(forward, rel=1e-12)


def test_ground_that_lies_higher_is_as_if_all_flew_lower():
    """A target on it is focused by the paths that it has."""
    up, height_m = np.array([0.0, 0.0, 1.0]), 0.7
    flight = Prior({"a": NodePrior.of(TrackErrors((0.01,) * 3), np.arange(10.0), np.eye(3))})
    cause = other_height(["a"], np.arange(10.0), up)
    moved = CausePrior.of(cause, flight, np.arange(10.0)).tracks(np.array([height_m]) / cause.std)["a"]
    flown, target = np.array([3.0, -20.0, 30.0]), np.array([1.0, 5.0, height_m])
    true_m = np.linalg.norm(flown - target)
    assert np.linalg.norm(flown + moved[0] - target * [1, 1, 0]) == pytest.approx(true_m)


@pytest.mark.slow
def test_the_arm_that_is_wrong_is_found_to_centimetres():
    """Beside errors of the logs of 3 mm, on a pass of 7.5 s."""
    made, causes, (node, arm_m) = wrong_case("lever arm", "points-5", "short", 0.003, 2)
    search = TrackSearch.begin(made.records, GRID, GROUND, made.errors)
    found = explained(search.problem, causes, search.axes, np.random.default_rng(0))
    assert found is not None
    assert found.cause.quantity.kind == "lever arm"
    assert list(found.cause.moved_m) == [node]
    assert found.values == pytest.approx(arm_m, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seeds", "within"), [("time", (5,), 0.005), ("lever arm", (6,), 0.03), ("height", (0, 6), 0.1)]
)
def test_one_wrong_constant_is_named_and_taken_back(kind, seeds, within):
    """Within 5 ms, 3 cm, 10 cm: what is left of a height of 40 cm costs 0.2 dB."""
    for seed in seeds:
        made, causes, (node, values) = wrong_case(kind, "points-5", "wobble", 0.003, seed)
        found = refine(made.records, GRID, GROUND, made.errors, causes=causes)
        before, after = judge(made), judge(made, found.correction)
        assert before.probe_loss_db < -1, seed  # there is something to explain
        assert list(found.flags) == ["cause_corrected"], seed
        assert found.report["cause"]["kind"] == kind
        assert node == "all" or f" {node} " in found.report["cause"]["what"]
        assert found.report["cause"]["values"] == pytest.approx(values, abs=within)
        assert after.probe_loss_db > -0.3
        assert after.probe_shift_cm < 6


@pytest.mark.slow
def test_errors_of_the_logs_are_no_cause():
    """4 cm over 7.5 s; by what points gain alone, a lever arm explains these well."""
    for seed in (0, 1, 3):
        made, causes, _ = wrong_case("nothing", "points-6", "short", 0.04, seed)
        found = refine(made.records, GRID, GROUND, made.errors, causes=causes)
        assert found.accepted, seed
        assert "cause" not in found.report, seed
