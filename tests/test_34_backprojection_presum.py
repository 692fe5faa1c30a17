"""Presumming: used only for an oversampled aperture, with the predicted error."""

import numpy as np
import pytest
from campaigns import draw
from scenes import compiled, monostatic, plan, straight_track

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.common.errors import CampaignError
from apertura.core.backprojection.engines import native
from apertura.core.backprojection.presum import design, presum_error_db, presummed
from apertura.core.quality.measures import numerical_error_db


@pytest.mark.slow
@pytest.mark.parametrize(("step_m", "summed"), [(0.002, True), (0.1, False)])
def test_pulses_are_presummed_only_if_the_aperture_is_oversampled(step_m, summed):
    tx = straight_track(2000, length_m=2000 * step_m)
    job = {"aperture": monostatic(tx), "shape": (2000, 2000), "spacing_m": 0.005}
    planned = plan(overrides={"engine": "native"}, **job)
    assert (planned.presum is not None) == summed
    if summed:
        assert planned.presum.factor >= 4
        assert plan(overrides={"engine": "native", "presum": 1}, **job).presum is None
        # the tree reduces pulses tile by tile: it competes with the direct kernel on presummed pulses
        alternatives = ({"engine": "native"}, {"engine": "tree", "presum": 1})
        seconds = [plan(overrides=overrides, **job).predicted_seconds for overrides in alternatives]
        assert plan(**job).predicted_seconds <= min(seconds) / 0.9


def test_presum_beyond_the_doppler_bandwidth_is_refused():
    with pytest.raises(CampaignError, match="presum factor 32"):
        plan(overrides={"presum": 32}, aperture=monostatic(straight_track(length_m=30)))


def oversampled(noise: float = 1.0):
    """Draw a campaign with noise, a few targets and an aperture oversampled about ten times."""
    for seed in range(100):
        drawn = draw(np.random.default_rng(seed), pixels=40, pulses=400)
        _, widest = drawn.job.aperture.phase_rates(drawn.job.points_m, wavelength_m=C / drawn.job.band_hz[1])
        if 0.01 < widest < 0.03:
            return drawn, widest
    raise AssertionError("no campaign is oversampled")


@pytest.mark.slow
@compiled
def test_presummed_image_equals_that_of_all_pulses_unlike_a_decimated_one():
    drawn, widest = oversampled()
    presum = design(400, 4, widest_cycles=widest)
    points = drawn.job.points_m
    predicted = presum_error_db(presum, drawn.job.aperture, points, highest_hz=drawn.job.band_hz[1])
    fewer = presummed(drawn.profiles, presum, points[len(points) // 2])
    assert len(fewer) < 0.4 * 400
    images = [
        native.form(native.prepare(profiles, oversampling=16), drawn.grid.positions(0.0), tolerance_rad=1e-5)
        for profiles in (drawn.profiles, fewer, drawn.profiles[::4])
    ]
    error, decimation_error = (numerical_error_db(image.ravel(), images[0].ravel()) for image in images[1:])
    assert error <= predicted + 3 <= -65
    assert decimation_error > -45
