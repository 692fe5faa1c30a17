"""What two pairs of one transmitter see alike of ground without points, and what that tells of the tracks."""

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


def flown(ahead_m):
    return np.stack([TIME_S - 15 + ahead_m, 0 * TIME_S, np.full(600, 10.0)], -1)


def speckle(generator):
    """A scatterer to a resolution cell, beyond the grid on all sides."""
    places = np.concatenate([generator.uniform((-14, 2), (14, 32), (30_000, 2)), np.zeros((30_000, 1))], axis=1)
    amplitude = generator.standard_normal((2, 30_000)).T @ [1, 1j]
    return Scatterers(places, amplitude)


@cache
def seen(seed, ahead_m=4.7):
    """Pairs a-a and a-b over speckle, 1 cm wrong in each axis, and the unknowns of the truth."""
    of_tracks, of_scene = np.random.default_rng(seed).spawn(2)
    unknowns = of_tracks.standard_normal(PRIOR.size)
    truth, ground = TrackCorrection(KNOTS_S, PRIOR.tracks(unknowns)), speckle(of_scene)
    records = []
    for pair in ("a-a", "a-b"):
        logged = Aperture(flown(0.0), flown(ahead_m if pair == "a-b" else 0.0))
        between_m = logged.tx_m - logged.rx_m if pair == "a-b" else None
        longer_m = -truth.longer_m(pair, TIME_S, between_m)
        echo = transfer(ground, truth.aperture(logged, pair, TIME_S), FREQUENCY_HZ, longer_m=longer_m, gridded=True)
        history = PhaseHistory(echo, FREQUENCY_HZ, window_weights("hann", 128), np.zeros(600), logged)
        records.append(PairRecord(pair, range_compress(history, GRID, GROUND), TIME_S, between_m))
    return records, unknowns


def ground_of(records):
    return SpeckleTiles.of(
        [Blocks.of(one, KNOTS_S) for one in records], tiles(records, GRID, GROUND, correlation_s=1.0)
    )


@pytest.mark.slow
def test_tiles_share_out_the_scene():
    records, _ = seen(1)
    found = tiles(records, GRID, GROUND, correlation_s=1.0)
    area = sum(np.linalg.norm(np.cross(*tile.sides_m)) for tile in found)
    assert area == pytest.approx(360.0)
    pixels = np.concatenate([tile.patch.pixels_m for tile in found])
    assert (np.abs(pixels[:, :2] - (0, 15)) < (9, 10)).all()
    assert len(np.unique(pixels.round(6), axis=0)) == len(pixels)


@pytest.mark.slow
def test_speckle_of_two_pairs_agrees_from_the_true_tracks_only():
    records, unknowns = seen(1)
    ground = ground_of(records)
    coherence = [
        np.abs(ground.agreements(tracks)[0].coherence(tracks)).mean()
        for tracks in (PRIOR.tracks(0 * unknowns), PRIOR.tracks(unknowns))
    ]
    assert coherence[0] < 0.75 * coherence[1]
    assert coherence[1] > 0.75


@pytest.mark.slow
def test_the_gradient_is_that_of_the_value():
    records, unknowns = seen(1)
    tracks = PRIOR.tracks(0.3 * unknowns)
    [agreement] = ground_of(records).agreements(PRIOR.tracks(0 * unknowns))
    _, gradient = agreement(tracks)
    generator = np.random.default_rng(3)
    for way in (PRIOR.tracks(unknowns), PRIOR.tracks(generator.standard_normal(PRIOR.size))):
        values = [agreement({n: tracks[n] + step * way[n] for n in way})[0] for step in (-0.01, 0.01)]
        slope = sum(float((gradient[node] * way[node]).sum()) for node in way)
        assert (values[1] - values[0]) / 0.02 == pytest.approx(slope, rel=3e-3)


@pytest.mark.slow
def test_agreement_mends_what_blurs_speckle():
    """Path errors of the pair that sends and receives, less what only moves the image, fall as eq. 23 says."""
    left = []
    for seed in (1, 2):
        records, unknowns = seen(seed)
        ground, found = ground_of(records), np.zeros(PRIOR.size)
        for _ in range(2):
            [agreement] = ground.agreements(PRIOR.tracks(found))
            found = minimise(agreement, PRIOR, Gauge.none(PRIOR.size), found, iterations=15)
        left.append(blur_m(PRIOR.tracks(found - unknowns)["a"]) / blur_m(PRIOR.tracks(unknowns)["a"]))
    assert max(left) < 0.75, left


def blur_m(moved_m):
    """RMS of the path error at the middle of the scene that is no shift of it."""
    place = np.array([0.0, 15, 0])
    along = np.stack([np.interp(KNOTS_S, TIME_S, axis) for axis in flown(0.0).T], -1) - place
    unit = along / np.linalg.norm(along, axis=1, keepdims=True)
    path = 2 * np.einsum("ki,ki->k", unit, moved_m)
    shift = np.concatenate([np.ones((len(unit), 1)), unit[:, :2]], axis=1)
    return float(np.std(path - shift @ np.linalg.lstsq(shift, path)[0]))


@pytest.mark.slow
def test_one_pair_has_nothing_to_agree_with():
    records, unknowns = seen(1)
    ground = ground_of(records[:1])
    assert ground.agreements(PRIOR.tracks(unknowns)) == []
    found = refined_by_speckle(ground, PRIOR, KNOTS_S)
    assert not found.accepted
    assert "one pair" in found.flags["refinement_no_bright_point"]


@pytest.mark.slow
def test_speckle_is_believed_by_the_coherence_of_tiles_that_were_not_fitted():
    records, _ = seen(1)
    found = refined_by_speckle(ground_of(records), PRIOR, KNOTS_S)
    assert found.accepted, found.why
    unlike = [records[0], replace(records[1], profiles=seen(2)[0][1].profiles)]
    rejected = refined_by_speckle(ground_of(unlike), PRIOR, KNOTS_S)
    assert not rejected.accepted
    assert not np.any(rejected.correction.moved_m["a"])
    assert "not fitted" in rejected.flags["refinement_rejected"]
