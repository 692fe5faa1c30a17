"""Simulated cases for the evaluation of track refinement have the requested properties."""

import numpy as np
import pytest
from apertura_research.autofocus.cases import PROBES_M, case, drawn_errors
from apertura_research.autofocus.outcomes import judge, peaks
from scenes import compiled

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.geometry.aperture import Aperture
from apertura.methods.autofocus.inputs import TrackErrors
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers

FREQUENCY_HZ = 1.2e9 + 3.2e6 * np.arange(128)


@pytest.mark.parametrize(
    ("gridded", "spreading", "error"),
    [(True, True, 3e-6), (True, False, 3e-6), (False, True, 1e-7), (False, False, 1e-7)],
)
def test_echoes_equal_the_direct_sum(gridded, spreading, error):
    generator = np.random.default_rng(1)
    points = generator.uniform((-9, 5, 0), (9, 25, 1), (30, 3))
    amplitude = generator.standard_normal(30) + 1j * generator.standard_normal(30)
    aperture = Aperture(*(generator.uniform((-15, -1, 9), (15, 1, 11), (2, 40, 3))))
    extra_path_m = generator.uniform(-5, 5, 40)
    exact = np.zeros((40, 128), complex)
    for point, value in zip(points, amplitude, strict=True):
        transmit_m, receive_m = (np.linalg.norm(point - leg, axis=1) for leg in aperture.legs)
        path = (transmit_m + receive_m + extra_path_m)[:, None]
        level = value / (transmit_m * receive_m) if spreading else value * np.ones(40)
        exact += level[:, None] * np.exp(-2j * np.pi * FREQUENCY_HZ * path / SPEED_OF_LIGHT_M_S)
    scatterers = Scatterers(points, amplitude)
    echo = transfer(scatterers, aperture, FREQUENCY_HZ, longer_m=extra_path_m, spreading=spreading, gridded=gridded)
    assert np.linalg.norm(echo - exact) < error * np.linalg.norm(exact)


def test_drawn_errors_have_the_deviation_and_correlation_of_the_prior():
    time_s, generator = np.arange(3000) / 100, np.random.default_rng(2)
    errors = TrackErrors((0.01, 0.02, 0.03), correlation_s=1.0)
    drawn = np.stack([drawn_errors(time_s, errors, generator) for _ in range(200)])
    assert np.allclose(drawn.std((0, 1)), errors.std_m, rtol=0.05)
    half = np.mean(drawn[:, 50:] * drawn[:, :-50], axis=(0, 1)) / np.square(errors.std_m)
    assert np.allclose(half, 0.5, atol=0.05)


@pytest.mark.slow
@compiled
@pytest.mark.parametrize("pairs", ["mono", "bi"])
def test_true_tracks_have_no_loss_and_logged_tracks_the_predicted_one(pairs):
    simulated = case("five", "straight", pairs, 0.01, None, 3)
    assert judge(simulated, simulated.truth).probe_loss_db == 0
    measured = peaks(simulated.probes, simulated.truth, PROBES_M, simulated.reach_m)
    assert np.abs(measured.place_m - PROBES_M).max() < 0.02
    losses = [judge(case("five", "straight", pairs, 0.01, None, seed)).probe_loss_db for seed in range(3, 6)]
    # 1 cm per axis causes an rms phase of k·|g|·σ with |g| ≈ 2; the loss is exp(-(2kσ)²), slightly less at the best
    # peak
    assert -2.2 < np.mean(losses) < -0.8


@pytest.mark.slow
@compiled
def test_seed_gives_same_tracks_and_noise_for_other_pairs_or_scenes():
    joint, mono = (case("five", "straight", pairs, 0.01, 10, 1) for pairs in ("joint", "mono"))
    other = case("forty", "straight", "mono", 0.02, 10, 1)
    assert np.array_equal(joint.records[0].profiles.samples, mono.records[0].profiles.samples)
    assert np.allclose(other.truth.moved_m["uav1"], 2 * joint.truth.moved_m["uav1"])
    assert not np.array_equal(
        case("five", "straight", "mono", 0.01, 10, 2).truth.moved_m["uav1"], mono.truth.moved_m["uav1"]
    )
