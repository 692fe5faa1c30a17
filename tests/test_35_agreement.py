"""Track refinement by the speckle coherence of two pairs with a common transmitter."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.compression import window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.ground_coherence import SpeckleTiles, refined_by_speckle, tiles
from apertura.methods.autofocus.inputs import NodePrior, PairRecord, Prior, TrackErrors
from apertura.methods.autofocus.objective import Blocks
from apertura.methods.autofocus.solve import Gauge, minimise
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers

FREQUENCY_HZ = 1.2e9 + 3.2e6 * np.arange(128)
TIME_S = 0.05 * np.arange(600)
KNOTS_S = 0.05 + 0.1 * np.arange(300)
GRID, GROUND = SceneGrid("local", -9.0, 25.0, 0.1, (200, 180)), FlatGround(0.0)
ERRORS = TrackErrors((0.01, 0.01, 0.01))
PRIOR = Prior({node: NodePrior.of(ERRORS, KNOTS_S, np.eye(3)) for node in ("a", "b")})


def track(ahead_m):
    return np.stack([TIME_S - 15 + ahead_m, 0 * TIME_S, np.full(600, 10.0)], -1)


def speckle(generator):
    """Draw about one scatterer per resolution cell over an area larger than the grid."""
    points = np.concatenate([generator.uniform((-14, 2), (14, 32), (30_000, 2)), np.zeros((30_000, 1))], axis=1)
    amplitude = generator.standard_normal((2, 30_000)).T @ [1, 1j]
    return Scatterers(points, amplitude)


@cache
def records_of(seed, ahead_m=4.7):
    """Return records of pairs a-a and a-b over speckle with track errors of 1 cm per axis, and the true unknowns."""
    track_generator, scene_generator = np.random.default_rng(seed).spawn(2)
    unknowns = track_generator.standard_normal(PRIOR.size)
    truth, scene = TrackCorrection(KNOTS_S, PRIOR.tracks(unknowns)), speckle(scene_generator)
    records = []
    for pair in ("a-a", "a-b"):
        logged = Aperture(track(0.0), track(ahead_m if pair == "a-b" else 0.0))
        between_m = logged.tx_m - logged.rx_m if pair == "a-b" else None
        longer_m = -truth.longer_m(pair, TIME_S, between_m)
        echo = transfer(scene, truth.aperture(logged, pair, TIME_S), FREQUENCY_HZ, longer_m=longer_m, gridded=True)
        history = PhaseHistory(echo, FREQUENCY_HZ, window_weights("hann", 128), np.zeros(600), logged)
        records.append(PairRecord(pair, range_compress(history, GRID, GROUND), TIME_S, between_m))
    return records, unknowns


def speckle_tiles(records):
    return SpeckleTiles.of(
        [Blocks.of(record, KNOTS_S) for record in records], tiles(records, GRID, GROUND, correlation_s=1.0)
    )


@pytest.mark.slow
def test_tiles_partition_the_scene():
    records, _ = records_of(1)
    scene_tiles = tiles(records, GRID, GROUND, correlation_s=1.0)
    area = sum(np.linalg.norm(np.cross(*tile.sides_m)) for tile in scene_tiles)
    assert area == pytest.approx(360.0)
    pixels = np.concatenate([tile.patch.pixels_m for tile in scene_tiles])
    assert (np.abs(pixels[:, :2] - (0, 15)) < (9, 10)).all()
    assert len(np.unique(pixels.round(6), axis=0)) == len(pixels)


@pytest.mark.slow
def test_speckle_of_two_pairs_agrees_only_on_the_true_tracks():
    records, unknowns = records_of(1)
    ground = speckle_tiles(records)
    coherence = [
        np.abs(ground.agreements(tracks)[0].coherence(tracks)).mean()
        for tracks in (PRIOR.tracks(0 * unknowns), PRIOR.tracks(unknowns))
    ]
    assert coherence[0] < 0.75 * coherence[1]
    assert coherence[1] > 0.75


@pytest.mark.slow
def test_gradient_equals_the_finite_difference_of_the_value():
    records, unknowns = records_of(1)
    tracks = PRIOR.tracks(0.3 * unknowns)
    [agreement] = speckle_tiles(records).agreements(PRIOR.tracks(0 * unknowns))
    _, gradient = agreement(tracks)
    generator = np.random.default_rng(3)
    for direction in (PRIOR.tracks(unknowns), PRIOR.tracks(generator.standard_normal(PRIOR.size))):
        values = [agreement({n: tracks[n] + step * direction[n] for n in direction})[0] for step in (-0.01, 0.01)]
        slope = sum(float((gradient[node] * direction[node]).sum()) for node in direction)
        assert (values[1] - values[0]) / 0.02 == pytest.approx(slope, rel=3e-3)


@pytest.mark.slow
def test_agreement_reduces_the_path_error_that_blurs_speckle():
    """Path errors of the monostatic pair, without the mere displacement of the image, fall by eq. 23."""
    residual_ratios = []
    for seed in (1, 2):
        records, unknowns = records_of(seed)
        ground, estimate = speckle_tiles(records), np.zeros(PRIOR.size)
        for _ in range(2):
            [agreement] = ground.agreements(PRIOR.tracks(estimate))
            estimate = minimise(agreement, PRIOR, Gauge.none(PRIOR.size), estimate, iterations=15)
        residual_ratios.append(blur_m(PRIOR.tracks(estimate - unknowns)["a"]) / blur_m(PRIOR.tracks(unknowns)["a"]))
    assert max(residual_ratios) < 0.75, residual_ratios


def blur_m(error_m):
    """Return the RMS path error at the scene centre, without the component that only displaces the image."""
    centre = np.array([0.0, 15, 0])
    along = np.stack([np.interp(KNOTS_S, TIME_S, axis) for axis in track(0.0).T], -1) - centre
    unit = along / np.linalg.norm(along, axis=1, keepdims=True)
    path = 2 * np.einsum("ki,ki->k", unit, error_m)
    shift = np.concatenate([np.ones((len(unit), 1)), unit[:, :2]], axis=1)
    return float(np.std(path - shift @ np.linalg.lstsq(shift, path)[0]))


@pytest.mark.slow
def test_single_pair_has_no_agreement():
    records, unknowns = records_of(1)
    ground = speckle_tiles(records[:1])
    assert ground.agreements(PRIOR.tracks(unknowns)) == []
    refined = refined_by_speckle(ground, PRIOR, KNOTS_S)
    assert not refined.accepted
    assert "requires two pairs" in refined.flags["refinement_no_bright_point"]


@pytest.mark.slow
def test_speckle_refinement_is_accepted_by_coherence_of_tiles_not_fitted():
    records, _ = records_of(1)
    refined = refined_by_speckle(speckle_tiles(records), PRIOR, KNOTS_S)
    assert refined.accepted, refined.reason
    unrelated = [records[0], replace(records[1], profiles=records_of(2)[0][1].profiles)]
    rejected = refined_by_speckle(speckle_tiles(unrelated), PRIOR, KNOTS_S)
    assert not rejected.accepted
    assert not np.any(rejected.correction.moved_m["a"])
    assert "held-out tiles" in rejected.flags["refinement_rejected"]
