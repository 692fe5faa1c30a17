"""The certificate of an image: tiles that miss the accuracy are formed again, and what is still missed is flagged."""

from dataclasses import replace

import numpy as np
import pytest
from campaigns import compressed, draw
from scenes import TARGET, TARGET_GRID, point_history

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.imaging.certify import certified, measures
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.job import imaging_job
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.planning.planner import make_plan
from apertura.core.quality.measures import numerical_error_db
from apertura.core.scene.terrain import GroundModels

SIDE_PX = 32


@pytest.fixture(scope="module")
def speckle() -> Formation:
    """An image of noise alone, nine tiles of the same brightness."""
    drawn = draw(np.random.default_rng(4), pixels=80, pulses=60)
    noise = np.random.default_rng(6).standard_normal((2, *drawn.history.transfer.shape))
    history = replace(drawn.history, transfer=(noise[0] + 1j * noise[1]).astype(np.complex64))
    profiles = compressed(history, drawn.grid, "none")
    history = replace(history, weight=np.full(history.frequency_hz.shape, 1 / len(history.frequency_hz)))
    plan = make_plan(drawn.job, accuracy_db=-60.0)
    return Formation(history, profiles, drawn.grid, plan, SIDE_PX)


def certify(formation, target, accuracy_db=-60.0):
    return certified(formation, target, accuracy_db=accuracy_db, threads=1)


def test_an_image_as_exact_as_asked_is_left_as_it_is(speckle):
    target = speckle.image.compute()
    before = target.copy()
    report = certify(speckle, target)
    assert report["recomputed"] == []
    assert report["flags"] == {}
    assert report["numerical_error_db"] < -60
    np.testing.assert_array_equal(target, before)


def test_the_error_reported_is_an_upper_bound_of_that_of_all_pixels(speckle):
    target = speckle.image.compute()
    every = np.argwhere(np.ones(target.shape, bool))
    true_db = numerical_error_db(target.ravel(), speckle.exact(every))
    report = certify(speckle, target)
    assert report["numerical_error_estimate_db"] == pytest.approx(true_db, abs=1.0)
    assert true_db < report["numerical_error_db"] < true_db + 2
    assert report["numerical_error_confidence"] == 0.95


def test_a_tile_that_misses_is_formed_again_with_the_first_fallback_and_no_other_tile(speckle):
    good = speckle.image.compute()
    spoilt, window = good.copy(), speckle.windows[4]
    spoilt[window] *= 1.01
    report = certify(speckle, spoilt)
    fallback = speckle.plan.fallbacks[0]
    assert report["recomputed"] == [{"tiles": 1, "with": f"{fallback.line}, every pulse"}]
    assert report["numerical_error_db"] < -60
    assert report["flags"] == {}
    np.testing.assert_array_equal(spoilt[window], speckle.image_by(fallback)[window].compute())
    spoilt[window] = good[window]
    np.testing.assert_array_equal(spoilt, good)


def test_tiles_fall_back_until_they_are_exact_enough_and_a_rest_is_flagged(speckle):
    """At -125 dB only the double sum in float64, kept as complex64, is left; at -200 dB not even that suffices."""
    target = speckle.image.compute()
    report = certify(speckle, target, accuracy_db=-125.0)
    assert report["recomputed"][-1]["with"] == "reference, every pulse"
    assert report["numerical_error_db"] < -125
    assert len(report["recomputed"]) == len(speckle.plan.fallbacks)
    report = certify(speckle, target, accuracy_db=-200.0)
    bound = f"numerical error up to {report['numerical_error_db']:.1f} dB (95% confidence)"
    assert report["flags"] == {"accuracy_not_met": f"{bound}, -200.0 dB requested"}


def test_what_no_tile_misses_for_itself_but_the_bound_does_is_formed_again(speckle):
    """Every pixel errs by as much, a little less than asked: not sure enough."""
    exact = speckle.exact(np.argwhere(np.ones(speckle.grid.shape, bool))).reshape(speckle.grid.shape)
    turned = np.exp(2j * np.pi * np.random.default_rng(3).random(exact.shape))
    target = (exact + 1e-3 * np.sqrt(np.mean(np.abs(exact) ** 2)) * turned).astype(np.complex64)
    stated = certify(speckle, target, accuracy_db=np.inf)
    between_db = (stated["numerical_error_db"] + stated["numerical_error_estimate_db"]) / 2
    report = certify(speckle, target, accuracy_db=between_db)
    assert [one["tiles"] for one in report["recomputed"]] == [len(speckle.windows)]
    assert report["flags"] == {}
    assert report["numerical_error_db"] < between_db


def test_the_brightest_target_is_measured_where_it_stands_with_its_amplitude_and_width():
    history, ground = point_history(), GroundModels.flat(0.0)
    aperture, frequency = history.aperture, history.frequency_hz
    job = imaging_job(aperture, frequency, history.weight, TARGET_GRID, ground)
    plan = make_plan(job, accuracy_db=-60.0)
    formation = Formation(history, range_compress(history, TARGET_GRID, ground.full), TARGET_GRID, plan, SIDE_PX)
    brightest = measures(formation, formation.image.compute())["brightest"]
    assert (brightest["x_m"], brightest["y_m"]) == pytest.approx(TARGET[0, :2], abs=0.003)
    assert brightest["amplitude"] == pytest.approx(1.0, abs=0.005)
    assert brightest["coherence_factor"] == pytest.approx(1.0, abs=1e-4)
    half_angle = np.arctan2(4.0, np.hypot(20.0 + TARGET[0, 1], 10.0))  # 8 m of track
    cell_m = C / frequency.mean() / (4 * np.sin(half_angle))
    assert brightest["cross_range_width_m"] == pytest.approx(0.886 * cell_m, rel=0.03)
