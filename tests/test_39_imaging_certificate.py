"""Certificate of an image: tiles that do not meet the accuracy are recomputed, and a residual excess is flagged."""

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
    """Plan an image of noise: nine tiles of equal brightness."""
    drawn = draw(np.random.default_rng(4), pixels=80, pulses=60)
    noise = np.random.default_rng(6).standard_normal((2, *drawn.history.transfer.shape))
    history = replace(drawn.history, transfer=(noise[0] + 1j * noise[1]).astype(np.complex64))
    profiles = compressed(history, drawn.grid, "none")
    history = replace(history, weight=np.full(history.frequency_hz.shape, 1 / len(history.frequency_hz)))
    plan = make_plan(drawn.job, accuracy_db=-60.0)
    return Formation(history, profiles, drawn.grid, plan, SIDE_PX)


def certify(formation, target, accuracy_db=-60.0):
    return certified(formation, target, accuracy_db=accuracy_db, threads=1)


def test_image_that_meets_the_accuracy_is_unchanged(speckle):
    target = speckle.image.compute()
    before = target.copy()
    report = certify(speckle, target)
    assert report["recomputed"] == []
    assert report["flags"] == {}
    assert report["numerical_error_db"] < -60
    np.testing.assert_array_equal(target, before)


def test_reported_error_is_an_upper_bound_over_all_pixels(speckle):
    target = speckle.image.compute()
    pixels = np.argwhere(np.ones(target.shape, bool))
    true_db = numerical_error_db(target.ravel(), speckle.exact(pixels))
    report = certify(speckle, target)
    assert report["numerical_error_estimate_db"] == pytest.approx(true_db, abs=1.0)
    assert true_db < report["numerical_error_db"] < true_db + 2
    assert report["numerical_error_confidence"] == 0.95


def test_only_a_tile_that_misses_is_recomputed_with_the_first_fallback(speckle):
    accurate = speckle.image.compute()
    target, window = accurate.copy(), speckle.windows[4]
    target[window] *= 1.01
    report = certify(speckle, target)
    fallback = speckle.plan.fallbacks[0]
    assert report["recomputed"] == [{"tiles": 1, "with": f"{fallback.line}, every pulse"}]
    assert report["numerical_error_db"] < -60
    assert report["flags"] == {}
    np.testing.assert_array_equal(target[window], speckle.image_by(fallback)[window].compute())
    target[window] = accurate[window]
    np.testing.assert_array_equal(target, accurate)


def test_tiles_fall_back_until_accurate_and_the_rest_is_flagged(speckle):
    """An accuracy of -125 dB requires the float64 double sum, stored as complex64; no engine meets -200 dB."""
    target = speckle.image.compute()
    report = certify(speckle, target, accuracy_db=-125.0)
    assert report["recomputed"][-1]["with"] == "reference, every pulse"
    assert report["numerical_error_db"] < -125
    assert len(report["recomputed"]) == len(speckle.plan.fallbacks)
    report = certify(speckle, target, accuracy_db=-200.0)
    bound = f"numerical error up to {report['numerical_error_db']:.1f} dB (95% confidence)"
    assert report["flags"] == {"accuracy_not_met": f"{bound}, -200.0 dB requested"}


def test_all_tiles_are_recomputed_if_only_the_bound_misses(speckle):
    """The uniform error is slightly below the requested error; the confidence bound exceeds the requested error."""
    exact = speckle.exact(np.argwhere(np.ones(speckle.grid.shape, bool))).reshape(speckle.grid.shape)
    phasors = np.exp(2j * np.pi * np.random.default_rng(3).random(exact.shape))
    target = (exact + 1e-3 * np.sqrt(np.mean(np.abs(exact) ** 2)) * phasors).astype(np.complex64)
    stated = certify(speckle, target, accuracy_db=np.inf)
    between_db = (stated["numerical_error_db"] + stated["numerical_error_estimate_db"]) / 2
    report = certify(speckle, target, accuracy_db=between_db)
    assert [entry["tiles"] for entry in report["recomputed"]] == [len(speckle.windows)]
    assert report["flags"] == {}
    assert report["numerical_error_db"] < between_db


def test_brightest_target_is_measured_with_position_amplitude_and_width():
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
