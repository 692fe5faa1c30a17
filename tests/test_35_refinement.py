"""Refinement of tracks by autofocus."""

import re
from dataclasses import replace

import numpy as np
import pytest
from apertura_research.autofocus.cases import GRID, case
from apertura_research.autofocus.outcomes import judge

from apertura.campaign.config import Node
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.contributions import block_contributions
from apertura.core.backprojection.engines import reference
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.geometry.sector import Sector
from apertura.core.quality.focus import MOST_INTERFERENCE
from apertura.core.quality.path_errors import autocorrelation
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.evidence import range_shifts, steadiness
from apertura.methods.autofocus.inputs import NodePrior, PairRecord, Prior, ReferencePoint, TrackErrors
from apertura.methods.autofocus.objective import Sharpness
from apertura.methods.autofocus.patches import LEAST_RATIO, bright_places, looks_of, sampled_looks
from apertura.methods.autofocus.refine import TrackSearch, refine
from apertura.methods.autofocus.solve import effects

FREQUENCY_HZ = 1.2e9 + 3.2e6 * np.arange(128)
TIME_S = np.linspace(0, 30, 300)
TARGET_M = np.array([[1.0, 12.0, 0.0]])


def track(ahead_m=0.0):
    return np.stack([TIME_S - 15 + ahead_m, np.zeros(300), np.full(300, 10.0)], -1)


def echo(true, logged, sidelink):
    """Return the echo of the target on the true track, with the sidelink length of the logged track."""
    path = true.path(TARGET_M)
    if sidelink:
        length = [np.linalg.norm(aperture.tx_m - aperture.rx_m, axis=1)[:, None] for aperture in (true, logged)]
        path = path - length[0] + length[1]
    transfer = np.exp(-2j * np.pi * FREQUENCY_HZ * path / SPEED_OF_LIGHT_M_S).astype(np.complex64)
    return PhaseHistory(transfer, FREQUENCY_HZ, np.full(128, 1 / 128), np.zeros(300), logged)


@pytest.mark.parametrize(("pair", "ahead_m"), [("a-a", 0.0), ("a-b", 4.7)])
def test_corrected_track_focuses_like_the_true_track(pair, ahead_m):
    knots = np.linspace(0, 30, 31)
    generator = np.random.default_rng(1)
    correction = TrackCorrection(knots, {node: 0.02 * generator.standard_normal((31, 3)) for node in "ab"})
    logged = Aperture(track(), track(ahead_m))
    true = correction.aperture(logged, pair, TIME_S)
    history = echo(true, logged, sidelink=pair == "a-b")
    assert abs(reference.form(history, TARGET_M)[0]) / 300 < 0.8
    between = logged.tx_m - logged.rx_m
    extra_path_m = correction.longer_m(pair, TIME_S, between if pair == "a-b" else None)
    corrected = history.moved(true, extra_path_m)
    assert abs(reference.form(corrected, TARGET_M)[0] / 300 - 1) < 1e-5


@pytest.fixture(scope="module")
def two_centimetres():
    return case("five", "straight", "joint", 0.02, 10.0, 1)


def search_of(simulated):
    return TrackSearch.begin(simulated.records, GRID, FlatGround(0.0), simulated.errors)


@pytest.fixture(scope="module")
def search(two_centimetres):
    return search_of(two_centimetres)


@pytest.mark.slow
def test_defocused_points_are_found_at_their_positions():
    simulated = case("five", "straight", "joint", 0.03, 10.0, 2)
    points, ratio = bright_places(
        simulated.records,
        GRID,
        FlatGround(0.0),
        looks=looks_of(simulated.records, simulated.errors, simulated.targets_m[0])[0],
    )
    found = points[ratio > LEAST_RATIO]
    distances_m = np.linalg.norm(found[:, None] - simulated.targets_m, axis=2)
    assert distances_m.shape == (5, 5)
    assert distances_m.min(axis=1).max() < 0.3


def test_subapertures_of_a_longer_flight_contain_no_more_pulses():
    """Eq. 10b: the aperture of a point is divided, not the flight; memory is independent of its length."""
    pulses, point = [], np.zeros(3)
    for times in (1, 4):
        time_s = np.arange(0, 60.0 * times, 0.1)
        track = np.stack([2 * (time_s - 30 * times), np.full(len(time_s), -30.0), np.full(len(time_s), 10.0)], -1)
        aperture = Aperture(track, track)
        silent = np.broadcast_to(np.zeros(1, np.complex64), (len(time_s), 200))
        profiles = Profiles(silent, np.full(len(time_s), 40.0), 0.366, 1.4e9, 2.0, aperture)
        beams = Beams.within(Sector.of(aperture, chord_m=2.0, centre=0.0, half=0.5), None)
        record = PairRecord("a-a", profiles, time_s, beams=beams)
        scene = SceneGrid("local", -5.0, 5.0, 0.1, (100, 100))
        errors = {"a": TrackErrors((0.02,) * 3)}
        counts = [looks_of([record], errors, point)[0], sampled_looks([record], scene, FlatGround(0.0))]
        share = (beams.weight(aperture, point[None]) > 0).mean()
        pulses.append([2 * len(time_s) * share / count for count in counts])
        duration_s = time_s[-1] * share / counts[1]
        # Change of the carrier over a subaperture, transmit and receive path.
        cycles_per_m = 2 * 2.0 / np.hypot(30, 10) * 2 * duration_s * 1.4e9 / SPEED_OF_LIGHT_M_S
        assert cycles_per_m * scene.spacing_m < 1.05
    assert pulses[1] == pytest.approx(pulses[0], rel=0.15)


@pytest.mark.slow
def test_blocks_contribute_the_sum_of_their_pulses(search):
    blocks, echo = search.problem.pairs[1], search.problem.echoes[1][0]
    no_motion = blocks.moves({node: np.zeros((len(search.problem.knots_s), 3)) for node in ("uav1", "uav2")})
    summed = blocks.contribution(echo, no_motion).values
    whole = block_contributions(blocks.record.profiles, echo.patch.pixels_m, edges=blocks.edges)
    # Blocks have the exact carrier of each pulse at the patch centre, and elsewhere the carrier of their mean position.
    phase = np.exp(1j * np.angle((summed.conj() * whole).sum(axis=0)))
    error = np.linalg.norm(summed * phase - whole) / np.linalg.norm(whole)
    assert error < 0.03
    assert np.abs(np.angle(phase)).max() < 0.1


def test_prior_has_the_stated_variance_and_correlation_time():
    knots = np.arange(0, 400, 0.1)
    axes = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    prior = NodePrior.of(TrackErrors((0.01, 0.02, 0.03), correlation_s=2.0), knots, axes)
    tracks = prior.tracks(np.random.default_rng(3).standard_normal((40, prior.size))) @ axes.T
    assert tracks.std(axis=(0, 1)) == pytest.approx([0.01, 0.02, 0.03], rel=0.03)
    lags = {
        lag: (tracks[:, :-lag] * tracks[:, lag:]).mean(axis=(0, 1)) / tracks.var(axis=(0, 1)) for lag in (10, 13, 20)
    }
    assert lags[10] == pytest.approx(np.full(3, 0.5), abs=0.04)
    assert lags[20] == pytest.approx(np.zeros(3), abs=0.04)
    for lag, measured in lags.items():  # error budget and prior assume the same errors
        assert measured == pytest.approx(np.full(3, autocorrelation(np.array(0.1 * lag), 2.0)), abs=0.04)


def test_description_of_position_correlation_s_matches_its_use():
    """The description states the factor 1/0.63 from a correlation time at 1/e to the configured correlation time."""
    description = Node.model_fields["position_correlation_s"].description
    share = 1 - 1 / np.e
    stated = re.search(r"to zero at this time, and to 1/e at ([0-9.]+) times this time", description)[1]
    assert float(stated) == pytest.approx(share, abs=0.005)
    assert autocorrelation(np.array([share, 1.0]), 1.0) == pytest.approx([1 / np.e, 0.0])


@pytest.mark.parametrize("drift_m", [0.0, 0.05])
def test_adjoint_of_the_prior_is_its_transpose(drift_m):
    generator, knots = np.random.default_rng(4), np.arange(0, 5, 0.1)
    prior = Prior({node: NodePrior.of(TrackErrors((0.01,) * 3, 1.0, drift_m), knots, np.eye(3)) for node in "ab"})
    unknowns, gradient = generator.standard_normal(prior.size), {n: generator.standard_normal((50, 3)) for n in "ab"}
    forward = sum(float((track * gradient[node]).sum()) for node, track in prior.tracks(unknowns).items())
    assert prior.adjoint(gradient) @ unknowns == pytest.approx(forward, rel=1e-12)


def test_gradient_of_sharpness_equals_its_finite_difference(search):
    problem, start = search.problem, search.initial
    sharpness = Sharpness(
        problem.pairs, start.cached, start.tracks, start.statistics, np.ones(len(problem.patches), bool)
    )
    generator = np.random.default_rng(5)
    unknowns = 0.3 * generator.standard_normal(problem.prior.size)
    gradient = problem.prior.adjoint(sharpness(problem.prior.tracks(unknowns))[1])
    direction = gradient / np.linalg.norm(gradient) + generator.standard_normal(gradient.size) / np.sqrt(gradient.size)
    ahead, behind = (sharpness(problem.prior.tracks(unknowns + step * direction))[0] for step in (5e-3, -5e-3))
    assert gradient @ direction == pytest.approx((ahead - behind) / 1e-2, rel=2e-3)


def test_common_shift_of_all_tracks_displaces_points_without_blur(search):
    problem = search.problem
    for axis in np.eye(3):
        tracks = {node: np.ones((1, len(problem.knots_s), 3)) * axis for node in problem.prior.nodes}
        for blocks, patches in zip(problem.pairs, search.initial.cached, strict=True):
            displacement = {node: blocks.average_of(tracks[node]) for node in blocks.record.nodes}
            for patch in patches:
                blur_rad, shift_m = effects(patch, displacement, np.eye(3))
                assert np.sqrt((blur_rad**2).sum()) < 0.01 * patch.wavenumber
                assert shift_m[:, 0] == pytest.approx(axis[:2] if axis[2] == 0 else shift_m[:, 0], abs=0.01)


@pytest.fixture(scope="module")
def refined(two_centimetres):
    return refine(two_centimetres.records, GRID, FlatGround(0.0), two_centimetres.errors)


@pytest.mark.slow
def test_track_errors_of_2_cm_are_corrected_at_points_not_fitted(two_centimetres, refined):
    before, after = judge(two_centimetres), judge(two_centimetres, refined.correction)
    assert before.probe_loss_db < -5
    assert after.probe_loss_db > -0.4
    assert refined.accepted
    assert not refined.flags


@pytest.mark.slow
def test_refinement_does_not_displace_the_image(two_centimetres, refined, search):
    before, after = judge(two_centimetres), judge(two_centimetres, refined.correction)
    assert after.target_shift_cm < before.target_shift_cm + 0.3
    # All constrained modes, which displace the image without a measurable loss of focus, are applied to the true
    # tracks.
    problem = search.problem
    truth = {node: two_centimetres.truth.at(node, problem.knots_s) for node in ("uav1", "uav2")}
    constrained = problem.prior.tracks(problem.gauge.modes[-3:].sum(axis=0))
    displaced = TrackCorrection(problem.knots_s, {node: truth[node] + constrained[node] for node in truth})
    true_result, displaced_result = (
        judge(two_centimetres, correction) for correction in (TrackCorrection(problem.knots_s, truth), displaced)
    )
    assert displaced_result.target_shift_cm > true_result.target_shift_cm + 1.5
    assert displaced_result.probe_loss_db > true_result.probe_loss_db - 0.05


@pytest.mark.slow
def test_reference_points_correct_the_image_position(two_centimetres, refined):
    known = [ReferencePoint(f"corner {number}", tuple(two_centimetres.targets_m[number]), 0.005) for number in range(4)]
    tied = refine(two_centimetres.records, GRID, FlatGround(0.0), two_centimetres.errors, reference_points=known)
    before, after = (judge(two_centimetres, result.correction) for result in (refined, tied))
    assert after.target_shift_cm < 0.6 * before.target_shift_cm  # limited by the path accuracy of a pair
    assert after.target_shift_cm < 1.5
    assert after.probe_loss_db > before.probe_loss_db - 0.1
    assert {point["name"] for point in tied.report["reference_points"]} == {point.name for point in known}


@pytest.mark.slow
def test_overstated_position_error_is_flagged(two_centimetres, refined):
    stated = {node: TrackErrors((0.08,) * 3) for node in two_centimetres.errors}
    result = refine(two_centimetres.records, GRID, FlatGround(0.0), stated)
    assert "position_error_overstated" in result.flags
    assert not {"position_error_overstated", "position_error_understated"} & refined.flags.keys()
    assert judge(two_centimetres, result.correction).probe_loss_db > -0.5  # the image is nevertheless focused


def test_path_slip_over_part_of_the_aperture_is_detected(two_centimetres, search):
    problem, wavelength_m = search.problem, search.wavelength_m
    truth = {node: two_centimetres.truth.at(node, problem.knots_s) for node in ("uav1", "uav2")}
    slip = np.zeros((len(problem.knots_s), 3))
    slip[75:115, 1] = -0.8 * wavelength_m  # away from the scene; slightly more than half a wavelength of two-way path

    def slipped(tracks):
        state = problem.at(tracks)
        return range_shifts(problem, state, search.axes).slipped(wavelength_m)

    assert not slipped(truth).any()
    assert slipped({"uav1": truth["uav1"] + slip, "uav2": truth["uav2"]})[0, 2]


@pytest.mark.slow
def test_refinement_of_speckle_is_rejected(two_centimetres):
    generator = np.random.default_rng(6)
    noisy = []
    for record in two_centimetres.records:
        shape = record.profiles.samples.shape
        noise = generator.standard_normal((*shape, 2)).astype(np.float32).view(np.complex64)[..., 0]
        noisy.append(replace(record, profiles=replace(record.profiles, samples=noise)))
    rejected = refine(noisy, GRID, FlatGround(0.0), two_centimetres.errors)
    assert not rejected.accepted
    assert "refinement_no_bright_point" in rejected.flags
    assert not any(displacement.any() for displacement in rejected.correction.moved_m.values())


@pytest.mark.slow
@pytest.mark.parametrize(("points", "pairs", "sigma_m"), [(1, "mono", 0.02), (2, "bi", 0.02), (3, "joint", 0.04)])
def test_short_flight_past_few_points_is_corrected(points, pairs, sigma_m):
    """With 150 pulses in 7.5 s, points are validated by other points or, without others, by steady amplitudes."""
    simulated = case(f"points-{points}", "short", pairs, sigma_m, 10.0, 0)
    result = refine(simulated.records, GRID, FlatGround(0.0), simulated.errors)
    before, after = judge(simulated), judge(simulated, result.correction)
    assert result.accepted, result.reason
    assert before.target_loss_db < -2
    assert after.target_loss_db > -0.5
    assert after.target_shift_cm < before.target_shift_cm + 1  # unobservable modes keep the logged values


def test_exact_tracks_are_left_unchanged():
    simulated = case("points-4", "short", "mono", 0.0, 10.0, 3, stated_m=0.02)
    result = refine(simulated.records, GRID, FlatGround(0.0), simulated.errors)
    assert not result.accepted
    assert not result.flags.keys() - {"position_error_overstated"}  # correct, because 2 cm are stated for exact tracks
    assert "no improvement over the logs" in result.reason


@pytest.mark.slow
def test_track_slip_is_found_by_delays_and_corrected():
    """For 4 cm in 7.5 s, the sharpest tracks have one-wavelength slips, which are resolved by comparison of delays."""
    simulated = case("points-4", "short", "mono", 0.04, 10.0, 13)
    result = refine(simulated.records, GRID, FlatGround(0.0), simulated.errors)
    assert result.accepted, result.reason
    assert judge(simulated, result.correction).target_shift_cm < 8
    assert judge(simulated).target_shift_cm > 20


def test_speckle_has_no_steady_amplitude_for_any_phase_fit():
    generator = np.random.default_rng(8)
    for _ in range(20):
        speckle = generator.standard_normal((150, 2)).view(complex)[:, 0]
        assert steadiness(np.abs(speckle) + 0j) > MOST_INTERFERENCE or steadiness(speckle) > MOST_INTERFERENCE
    noisy = np.exp(1j * np.linspace(0, 3, 150)) + 0.2 * generator.standard_normal((150, 2)).view(complex)[:, 0]
    assert steadiness(noisy) < MOST_INTERFERENCE
