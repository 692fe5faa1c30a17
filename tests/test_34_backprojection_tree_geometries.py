"""The tree in random geometries of the envelope; benchmarks/geometries.csv has 60 of them."""

import pytest
from drawn import draw
from geometries import measure
from scenes import compiled

pytestmark = compiled


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 9, 50, 58])
def test_a_random_geometry_is_certified_as_asked(seed):
    """Among them tiles inside a circle, tiles as large as the range (9), a track that wobbles within a leaf (58)."""
    found = measure(draw(seed), nodes_db=-74)
    assert not found.failure, found
    assert found.by_tree == 1


@pytest.mark.slow
def test_every_random_geometry_is_certified_as_asked():
    outcomes = [measure(draw(seed), nodes_db=-74) for seed in range(30)]
    assert [found for found in outcomes if found.failure] == []
    assert sum(found.by_tree > 0.99 for found in outcomes) >= 25
