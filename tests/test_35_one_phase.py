"""One phase per pulse: where it suffices, what it mends, what it leaves in place."""

from dataclasses import replace

import numpy as np
import pytest

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.backprojection.contributions import block_contributions
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.quality.path_errors import PointPaths
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.inputs import PairRecord, TrackErrors
from apertura.methods.autofocus.one_phase import METHODS, entropy, space_variance
from apertura.methods.autofocus.patches import Candidates, Patch
from apertura.methods.autofocus.path_offsets import refine_one_phase

FREQUENCY_HZ = 1.2e9 + 1.6e6 * np.arange(256)
WEIGHT = np.hanning(258)[1:-1] / np.hanning(258).sum()
WAVENUMBER = 2 * np.pi * FREQUENCY_HZ.mean() / SPEED_OF_LIGHT_M_S
SIGMA = TrackErrors((0.02, 0.02, 0.02))
CORNERS_M = np.array([(east, north, 0.0) for east in (-1, 1) for north in (-1, 1)])


def past(range_m, *, height_m, length_m, seconds, pulses=1000):
    """A straight flight along east, south of the origin."""
    time_s = np.linspace(0, seconds, pulses)
    along = np.linspace(-length_m / 2, length_m / 2, pulses)
    return time_s, np.stack([along, np.full(pulses, -range_m), np.full(pulses, height_m)], -1)


FAR = past(1936.0, height_m=500.0, length_m=200.0, seconds=10.0)
NEAR = past(15.0, height_m=10.0, length_m=30.0, seconds=30.0)


def drawn(time_s, generator, std_m=0.02):
    """Errors that last a second."""
    width = round(1 / (time_s[1] - time_s[0]))
    total = np.cumsum(generator.standard_normal((len(time_s) + width, 3)), axis=0)
    return std_m * (total[width:] - total[:-width]) / np.sqrt(width)


def paths_of(flight, *, behind_m=0.0, hz=1.4e9):
    time_s, track = flight
    aperture = Aperture(track, track - [behind_m, 0, 0])
    return PointPaths.of(aperture, time_s, point_m=np.zeros(3), axes=np.eye(3), wavelength_m=SPEED_OF_LIGHT_M_S / hz)


def test_the_rule_changes_sides_between_near_and_far():
    assert space_variance(paths_of(NEAR), CORNERS_M * [9, 10, 0], [SIGMA]).method == "tracks"
    assert space_variance(paths_of(NEAR, behind_m=4.7), CORNERS_M * [9, 10, 0], [SIGMA, SIGMA]).method == "tracks"
    assert space_variance(paths_of(FAR), CORNERS_M * [20, 20, 0], [SIGMA]).method == "one_phase"
    assert space_variance(paths_of(FAR, hz=10e9), CORNERS_M * [20, 20, 0], [SIGMA]).method == "one_phase"
    assert space_variance(paths_of(FAR, hz=10e9), CORNERS_M * [80, 80, 0], [SIGMA]).method == "tracks"


def test_a_lasting_offset_of_a_track_needs_no_phase_at_all():
    offset = TrackErrors((0.0, 0.0, 0.0), drift_std_m=0.05)
    found = space_variance(paths_of(FAR), CORNERS_M * [20, 20, 0], [offset])
    assert found.residual_rad > 0.01
    assert found.loss_db > -0.001


@pytest.mark.parametrize("behind_m", [0.0, 4.7])
def test_what_one_phase_leaves_is_what_draws_leave(behind_m):
    """The near scene at 1 cm: path errors of its corners less those of its middle, less what moves the corners."""
    generator, errors = np.random.default_rng(3), TrackErrors((0.01, 0.01, 0.01))
    paths = paths_of(NEAR, behind_m=behind_m)
    corners = CORNERS_M * [9, 10, 0]
    nodes = [errors] * (2 if behind_m else 1)
    losses, powers = [], []
    for _ in range(60):
        moved = [drawn(NEAR[0], generator, 0.01)[:: 1000 // 200] for _ in nodes]
        moved = moved if behind_m else moved * 2
        true = Aperture(paths.aperture.tx_m + moved[0], paths.aperture.rx_m + moved[1])
        longer = true.path(np.vstack([corners, np.zeros(3)])) - paths.aperture.path(np.vstack([corners, np.zeros(3)]))
        at = [replace(paths, point_m=corner) for corner in corners]
        left = longer[:, :-1] - longer[:, -1:]
        losses += [one.of_offset(rest).loss_db for one, rest in zip(at, left.T, strict=True)]
        powers.append((left**2).mean())
    told = space_variance(paths, corners, nodes)
    assert told.loss_db == pytest.approx(np.mean(losses), rel=0.1)
    assert told.residual_rad == pytest.approx(WAVENUMBER * np.sqrt(np.mean(powers)), rel=0.05)


def test_the_gradient_of_entropy_is_its_finite_difference():
    generator = np.random.default_rng(5)
    lines = generator.standard_normal((3, 40)) + 1j * generator.standard_normal((3, 40))
    phase = generator.standard_normal(40)
    steps = 1e-5 * np.eye(40)
    differences = [(entropy(lines, phase + step)[0] - entropy(lines, phase - step)[0]) / 2e-5 for step in steps]
    np.testing.assert_allclose(entropy(lines, phase)[1], differences, rtol=1e-6, atol=1e-9)


def seen(flight, points_m, *, pair="a-a", seed=1, snr_db=None):
    """What a pair sees of points from logs 2 cm wrong, given back the logs' sidelink; and the same from the truth."""
    time_s, track = flight
    generator = np.random.default_rng(seed)
    logged = Aperture(track, track - [4.7 * (pair != "a-a"), 0, 0])
    moved = [drawn(time_s, generator), drawn(time_s, generator)]
    true = Aperture(logged.tx_m + moved[0], logged.rx_m + moved[pair != "a-a"])
    between = np.linalg.norm(true.tx_m - true.rx_m, axis=1) - np.linalg.norm(logged.tx_m - logged.rx_m, axis=1)
    path = true.path(points_m) - between[:, None]
    echo = sum(np.exp(-2j * np.pi * np.outer(one, FREQUENCY_HZ) / SPEED_OF_LIGHT_M_S) for one in path.T)
    if snr_db is not None:
        noise = generator.standard_normal((*echo.shape, 2)) @ [1, 1j]
        echo = echo + noise * np.sqrt(len(FREQUENCY_HZ) / 2 / 10 ** (snr_db / 10))
    history = PhaseHistory(echo.astype(np.complex64), FREQUENCY_HZ, WEIGHT, np.zeros(len(path)), logged)
    profiles = range_compress(history, SceneGrid("local", -21.0, 21.0, 1.0, (42, 42)), FlatGround(0.0))
    sidelink_m = None if pair == "a-a" else logged.tx_m - logged.rx_m
    return PairRecord(pair, profiles, time_s, sidelink_m), profiles.moved(true, between)


def about(place_m, east_m, north_m, count=13):
    east, north = np.meshgrid(np.linspace(-east_m, east_m, count), np.linspace(-north_m, north_m, count))
    return place_m + np.stack([east.ravel(), north.ravel(), 0 * east.ravel()], -1)


def patches_at(points_m, east_m, north_m):
    patches = [Patch(point, about(point, east_m, north_m)) for point in points_m]
    return Candidates(patches, len(patches), np.eye(3))


def peak(profiles, point_m, east_m, north_m):
    """Return magnitude and place of the highest peak near a point."""
    for zoom in (1.0, 0.15, 0.02):
        places = about(point_m, zoom * east_m, zoom * north_m, 21)
        image = np.abs(block_contributions(profiles, places, edges=np.array([0, len(profiles)]))[:, 0])
        point_m = places[image.argmax()]
    return image.max() / len(profiles), point_m


def lost(profiles, true, points_m, cell_m):
    """Return (point,) loss of peaks, dB, and (point, 3) how far off they are, metres."""
    both = [(peak(profiles, point, 2 * cell_m, 0.6), peak(true, point, 2 * cell_m, 0.6)) for point in points_m]
    loss_db = np.array([20 * np.log10(now / best) for (now, _), (best, _) in both])
    return loss_db, np.array([here - there for (_, here), (_, there) in both])


def shifts_by(record, true, points_m):
    """Return (point, 2) metres east and north by which the errors of the logs alone shift points of a far scene."""
    logged = record.profiles.aperture
    longer = true.aperture.path(points_m) - logged.path(points_m) - (true.start_m - record.profiles.start_m)[:, None]
    east, north = (logged.path_gradient(points_m.mean(axis=0))[:, axis] for axis in (0, 1))
    known = np.stack([east, np.full_like(north, north.mean())], -1)
    return (np.linalg.pinv(known) @ longer).T


FAR_POINTS_M = np.array(
    [(-15, -18, 0), (-2, -13, 0), (11, -9, 0), (-8, -4, 0), (17, 1, 0), (3, 5, 0), (-17, 10, 0), (8, 15, 0)], float
)
PROBES_M = np.array([(15, -16, 0), (0, 1, 0), (-13, 17.5, 0)], float)
FAR_ERRORS = {"a": SIGMA, "b": SIGMA}


@pytest.mark.quick("phase_gradient-a-b")
@pytest.mark.parametrize("pair", ["a-a", "a-b"])
@pytest.mark.parametrize("method", METHODS)
def test_one_phase_mends_a_far_scene_and_leaves_it_in_place(method, pair):
    record, true = seen(FAR, np.vstack([FAR_POINTS_M, PROBES_M]), pair=pair, snr_db=10)
    found = refine_one_phase([record], patches_at(FAR_POINTS_M, 5.0, 0.8), FAR_ERRORS, method=method)
    before_db, _ = lost(record.profiles, true, PROBES_M, 1.0)
    after_db, off_m = lost(record.moved(found.correction), true, PROBES_M, 1.0)
    assert found.accepted, found.why
    assert before_db.mean() < -2
    assert after_db.min() > -0.2
    np.testing.assert_allclose(off_m[:, :2], shifts_by(record, true, PROBES_M), atol=0.01)


def test_offsets_hold_neither_a_constant_nor_a_shift_along_the_track():
    record, _ = seen(FAR, FAR_POINTS_M)
    found = refine_one_phase([record], patches_at(FAR_POINTS_M, 5.0, 0.8), FAR_ERRORS, method="minimum_entropy")
    extra_path_m = found.correction.extra_path_m["a-a"]
    along = np.interp(found.correction.time_s, FAR[0], record.profiles.aperture.path_gradient(np.zeros(3))[:, 0])
    assert np.std(extra_path_m) > 0.01
    assert abs(extra_path_m.mean()) < 1e-9
    assert abs(np.corrcoef(along, extra_path_m)[0, 1]) < 1e-3


def test_one_phase_does_not_mend_a_near_scene():
    points = np.array([(0, -8, 0), (-4, -4, 0), (0, 0, 0), (4, 4, 0), (0, 8, 0)], float)
    corners = CORNERS_M * [9, 10, 0]
    record, true = seen(NEAR, np.vstack([points, corners]))
    found = refine_one_phase([record], patches_at(points, 0.6, 0.8), FAR_ERRORS, method="phase_gradient")
    before_db, _ = lost(record.profiles, true, corners, 0.1)
    after_db, _ = lost(record.moved(found.correction), true, corners, 0.1)
    assert before_db.mean() < after_db.mean() < -0.5


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_phases_of_noise_are_not_believed(method):
    """Three points to a range, whose noise is the same: what sharpens it for one sharpens it for the others."""
    points = np.array([(east, north, 0.0) for north in (-12, -4, 4, 12) for east in (-12, 0, 12)])
    gains_db = []
    for seed in (0, 2):
        record, _ = seen(FAR, points, seed=seed, snr_db=-10)
        found = refine_one_phase([record], patches_at(points, 5.0, 0.8), FAR_ERRORS, method=method)
        assert found.flags["refinement_rejected"] == found.why
        gains_db.append(found.report["gain_held_out_db"])
    assert max(gains_db) < 0


def test_patches_of_one_range_do_not_speak_for_each_other():
    beside = np.array([(east, 0, 0) for east in (-15, -9, -3, 3, 9, 15)], float)
    record, _ = seen(FAR, beside)
    found = refine_one_phase([record], patches_at(beside, 2.0, 0.8), FAR_ERRORS, method="phase_gradient")
    assert found.report["gain_held_out_db"] == 0
    assert not found.accepted


def test_three_patches_are_judged_by_what_they_gain():
    record, _ = seen(FAR, FAR_POINTS_M[:3])
    found = refine_one_phase([record], patches_at(FAR_POINTS_M[:3], 5.0, 0.8), FAR_ERRORS, method="phase_gradient")
    assert found.accepted
    assert found.report["gain_held_out_db"] - 2 * found.report["gain_std_db"] > 0.1


def test_without_a_bright_place_there_is_nothing_to_judge_by():
    record, _ = seen(FAR, FAR_POINTS_M[:3])
    found = refine_one_phase([record], Candidates([], 0, np.eye(3)), FAR_ERRORS, method="phase_gradient")
    assert list(found.flags) == ["refinement_no_bright_point"]
    assert not found.correction.extra_path_m
