"""Autofocus by one phase per pulse: applicability, correction and residual."""

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


def straight_flight(range_m, *, height_m, length_m, seconds, pulses=1000):
    """Return times and track of a straight eastward flight south of the origin."""
    time_s = np.linspace(0, seconds, pulses)
    along = np.linspace(-length_m / 2, length_m / 2, pulses)
    return time_s, np.stack([along, np.full(pulses, -range_m), np.full(pulses, height_m)], -1)


FAR = straight_flight(1936.0, height_m=500.0, length_m=200.0, seconds=10.0)
NEAR = straight_flight(15.0, height_m=10.0, length_m=30.0, seconds=30.0)


def track_errors(time_s, generator, std_m=0.02):
    """Draw track errors with a correlation time of one second."""
    width = round(1 / (time_s[1] - time_s[0]))
    total = np.cumsum(generator.standard_normal((len(time_s) + width, 3)), axis=0)
    return std_m * (total[width:] - total[:-width]) / np.sqrt(width)


def paths_of(flight, *, behind_m=0.0, hz=1.4e9):
    time_s, track = flight
    aperture = Aperture(track, track - [behind_m, 0, 0])
    return PointPaths.of(aperture, time_s, point_m=np.zeros(3), axes=np.eye(3), wavelength_m=SPEED_OF_LIGHT_M_S / hz)


def test_method_is_tracks_for_near_and_one_phase_for_far_scenes():
    assert space_variance(paths_of(NEAR), CORNERS_M * [9, 10, 0], [SIGMA]).method == "tracks"
    assert space_variance(paths_of(NEAR, behind_m=4.7), CORNERS_M * [9, 10, 0], [SIGMA, SIGMA]).method == "tracks"
    assert space_variance(paths_of(FAR), CORNERS_M * [20, 20, 0], [SIGMA]).method == "one_phase"
    assert space_variance(paths_of(FAR, hz=10e9), CORNERS_M * [20, 20, 0], [SIGMA]).method == "one_phase"
    assert space_variance(paths_of(FAR, hz=10e9), CORNERS_M * [80, 80, 0], [SIGMA]).method == "tracks"


def test_constant_track_offset_causes_no_loss():
    offset = TrackErrors((0.0, 0.0, 0.0), drift_std_m=0.05)
    variance = space_variance(paths_of(FAR), CORNERS_M * [20, 20, 0], [offset])
    assert variance.residual_rad > 0.01
    assert variance.loss_db > -0.001


@pytest.mark.parametrize("behind_m", [0.0, 4.7])
def test_predicted_residual_of_one_phase_equals_monte_carlo_residual(behind_m):
    """For a near scene and errors of 1 cm: path errors of the corners relative to the centre, without displacement."""
    generator, errors = np.random.default_rng(3), TrackErrors((0.01, 0.01, 0.01))
    paths = paths_of(NEAR, behind_m=behind_m)
    corners = CORNERS_M * [9, 10, 0]
    nodes = [errors] * (2 if behind_m else 1)
    losses, powers = [], []
    for _ in range(60):
        errors_m = [track_errors(NEAR[0], generator, 0.01)[:: 1000 // 200] for _ in nodes]
        errors_m = errors_m if behind_m else errors_m * 2
        true = Aperture(paths.aperture.tx_m + errors_m[0], paths.aperture.rx_m + errors_m[1])
        path_errors_m = true.path(np.vstack([corners, np.zeros(3)])) - paths.aperture.path(
            np.vstack([corners, np.zeros(3)])
        )
        corner_paths = [replace(paths, point_m=corner) for corner in corners]
        residuals_m = path_errors_m[:, :-1] - path_errors_m[:, -1:]
        losses += [
            corner_path.of_offset(residual).loss_db
            for corner_path, residual in zip(corner_paths, residuals_m.T, strict=True)
        ]
        powers.append((residuals_m**2).mean())
    predicted = space_variance(paths, corners, nodes)
    assert predicted.loss_db == pytest.approx(np.mean(losses), rel=0.1)
    assert predicted.residual_rad == pytest.approx(WAVENUMBER * np.sqrt(np.mean(powers)), rel=0.05)


def test_gradient_of_entropy_equals_its_finite_difference():
    generator = np.random.default_rng(5)
    lines = generator.standard_normal((3, 40)) + 1j * generator.standard_normal((3, 40))
    phase = generator.standard_normal(40)
    steps = 1e-5 * np.eye(40)
    differences = [(entropy(lines, phase + step)[0] - entropy(lines, phase - step)[0]) / 2e-5 for step in steps]
    np.testing.assert_allclose(entropy(lines, phase)[1], differences, rtol=1e-6, atol=1e-9)


def record_of(flight, points_m, *, pair="a-a", seed=1, snr_db=None):
    """Return the sidelink-corrected record of a pair whose tracks have errors of 2 cm, and its true profiles."""
    time_s, track = flight
    generator = np.random.default_rng(seed)
    logged = Aperture(track, track - [4.7 * (pair != "a-a"), 0, 0])
    errors_m = [track_errors(time_s, generator), track_errors(time_s, generator)]
    true = Aperture(logged.tx_m + errors_m[0], logged.rx_m + errors_m[pair != "a-a"])
    between = np.linalg.norm(true.tx_m - true.rx_m, axis=1) - np.linalg.norm(logged.tx_m - logged.rx_m, axis=1)
    path = true.path(points_m) - between[:, None]
    echo = sum(np.exp(-2j * np.pi * np.outer(point_path, FREQUENCY_HZ) / SPEED_OF_LIGHT_M_S) for point_path in path.T)
    if snr_db is not None:
        noise = generator.standard_normal((*echo.shape, 2)) @ [1, 1j]
        echo = echo + noise * np.sqrt(len(FREQUENCY_HZ) / 2 / 10 ** (snr_db / 10))
    history = PhaseHistory(echo.astype(np.complex64), FREQUENCY_HZ, WEIGHT, np.zeros(len(path)), logged)
    profiles = range_compress(history, SceneGrid("local", -21.0, 21.0, 1.0, (42, 42)), FlatGround(0.0))
    sidelink_m = None if pair == "a-a" else logged.tx_m - logged.rx_m
    return PairRecord(pair, profiles, time_s, sidelink_m), profiles.moved(true, between)


def patch_pixels(centre_m, east_m, north_m, count=13):
    east, north = np.meshgrid(np.linspace(-east_m, east_m, count), np.linspace(-north_m, north_m, count))
    return centre_m + np.stack([east.ravel(), north.ravel(), 0 * east.ravel()], -1)


def patches_at(points_m, east_m, north_m):
    patches = [Patch(point, patch_pixels(point, east_m, north_m)) for point in points_m]
    return Candidates(patches, len(patches), np.eye(3), 5.0)


def peak(profiles, point_m, east_m, north_m):
    """Return magnitude and position of the highest peak near a point."""
    for zoom in (1.0, 0.15, 0.02):
        points = patch_pixels(point_m, zoom * east_m, zoom * north_m, 21)
        image = np.abs(block_contributions(profiles, points, edges=np.array([0, len(profiles)]))[:, 0])
        point_m = points[image.argmax()]
    return image.max() / len(profiles), point_m


def losses(profiles, true, points_m, cell_m):
    """Return (point,) peak losses in dB and (point, 3) displacements in metres."""
    peaks = [(peak(profiles, point, 2 * cell_m, 0.6), peak(true, point, 2 * cell_m, 0.6)) for point in points_m]
    loss_db = np.array([20 * np.log10(magnitude / best) for (magnitude, _), (best, _) in peaks])
    return loss_db, np.array([position - true_position for (_, position), (_, true_position) in peaks])


def expected_shifts(record, true, points_m):
    """Return (point, 2) displacement of points of a far scene to the east and north due to track errors, metres."""
    logged = record.profiles.aperture
    path_errors = (
        true.aperture.path(points_m) - logged.path(points_m) - (true.start_m - record.profiles.start_m)[:, None]
    )
    east, north = (logged.path_gradient(points_m.mean(axis=0))[:, axis] for axis in (0, 1))
    modes = np.stack([east, np.full_like(north, north.mean())], -1)
    return (np.linalg.pinv(modes) @ path_errors).T


FAR_POINTS_M = np.array(
    [(-15, -18, 0), (-2, -13, 0), (11, -9, 0), (-8, -4, 0), (17, 1, 0), (3, 5, 0), (-17, 10, 0), (8, 15, 0)], float
)
PROBES_M = np.array([(15, -16, 0), (0, 1, 0), (-13, 17.5, 0)], float)
FAR_ERRORS = {"a": SIGMA, "b": SIGMA}


@pytest.mark.quick("phase_gradient-a-b")
@pytest.mark.parametrize("pair", ["a-a", "a-b"])
@pytest.mark.parametrize("method", METHODS)
def test_one_phase_focuses_a_far_scene_without_displacing_it(method, pair):
    record, true = record_of(FAR, np.vstack([FAR_POINTS_M, PROBES_M]), pair=pair, snr_db=10)
    refined = refine_one_phase([record], patches_at(FAR_POINTS_M, 5.0, 0.8), FAR_ERRORS, method=method)
    before_db, _ = losses(record.profiles, true, PROBES_M, 1.0)
    after_db, displacements_m = losses(record.moved(refined.correction), true, PROBES_M, 1.0)
    assert refined.accepted, refined.reason
    assert before_db.mean() < -2
    assert after_db.min() > -0.2
    np.testing.assert_allclose(displacements_m[:, :2], expected_shifts(record, true, PROBES_M), atol=0.01)


def test_path_offsets_contain_no_constant_and_no_along_track_shift():
    record, _ = record_of(FAR, FAR_POINTS_M)
    refined = refine_one_phase([record], patches_at(FAR_POINTS_M, 5.0, 0.8), FAR_ERRORS, method="minimum_entropy")
    extra_path_m = refined.correction.extra_path_m["a-a"]
    along = np.interp(refined.correction.time_s, FAR[0], record.profiles.aperture.path_gradient(np.zeros(3))[:, 0])
    assert np.std(extra_path_m) > 0.01
    assert abs(extra_path_m.mean()) < 1e-9
    assert abs(np.corrcoef(along, extra_path_m)[0, 1]) < 1e-3


def test_one_phase_leaves_a_near_scene_defocused():
    points = np.array([(0, -8, 0), (-4, -4, 0), (0, 0, 0), (4, 4, 0), (0, 8, 0)], float)
    corners = CORNERS_M * [9, 10, 0]
    record, true = record_of(NEAR, np.vstack([points, corners]))
    refined = refine_one_phase([record], patches_at(points, 0.6, 0.8), FAR_ERRORS, method="phase_gradient")
    before_db, _ = losses(record.profiles, true, corners, 0.1)
    after_db, _ = losses(record.moved(refined.correction), true, corners, 0.1)
    assert before_db.mean() < after_db.mean() < -0.5


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_phases_fitted_to_noise_are_rejected(method):
    """Three points at the same range share their noise: a phase that sharpens one point sharpens the others."""
    points = np.array([(east, north, 0.0) for north in (-12, -4, 4, 12) for east in (-12, 0, 12)])
    gains_db = []
    for seed in (0, 2):
        record, _ = record_of(FAR, points, seed=seed, snr_db=-10)
        refined = refine_one_phase([record], patches_at(points, 5.0, 0.8), FAR_ERRORS, method=method)
        assert refined.flags["refinement_rejected"] == refined.reason
        gains_db.append(refined.report["gain_held_out_db"])
    assert max(gains_db) < 0


def test_patches_at_the_same_range_are_not_independent():
    points = np.array([(east, 0, 0) for east in (-15, -9, -3, 3, 9, 15)], float)
    record, _ = record_of(FAR, points)
    refined = refine_one_phase([record], patches_at(points, 2.0, 0.8), FAR_ERRORS, method="phase_gradient")
    assert refined.report["gain_held_out_db"] == 0
    assert not refined.accepted


def test_three_patches_are_accepted_by_their_gain():
    record, _ = record_of(FAR, FAR_POINTS_M[:3])
    refined = refine_one_phase([record], patches_at(FAR_POINTS_M[:3], 5.0, 0.8), FAR_ERRORS, method="phase_gradient")
    assert refined.accepted
    assert refined.report["gain_held_out_db"] - 2 * refined.report["gain_std_db"] > 0.1


def test_missing_bright_points_are_flagged():
    record, _ = record_of(FAR, FAR_POINTS_M[:3])
    refined = refine_one_phase([record], Candidates([], 0, np.eye(3), 20.0), FAR_ERRORS, method="phase_gradient")
    assert list(refined.flags) == ["refinement_no_bright_point"]
    assert "exceeds its background by 13 dB" in refined.flags["refinement_no_bright_point"]  # a factor of 20
    assert not refined.correction.extra_path_m
