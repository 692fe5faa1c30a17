"""Tree engine in random geometries of its envelope; benchmarks/geometries.csv lists 60 of them."""

import pytest
from drawn import draw
from geometries import measure
from scenes import compiled

pytestmark = compiled


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 9, 50, 58])
def test_random_geometry_meets_the_requested_error(seed):
    """Seeds include tiles inside a circular flight, tiles as large as the range (9), and a bend within a leaf (58)."""
    outcome = measure(draw(seed), nodes_db=-74)
    assert not outcome.failure, outcome
    assert outcome.by_tree == 1


@pytest.mark.slow
def test_all_random_geometries_meet_the_requested_error():
    outcomes = [measure(draw(seed), nodes_db=-74) for seed in range(30)]
    assert [outcome for outcome in outcomes if outcome.failure] == []
    assert sum(outcome.by_tree > 0.99 for outcome in outcomes) >= 25
