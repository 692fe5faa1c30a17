"""Tracks refined by the image itself."""

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


def flown(ahead_m=0.0):
    return np.stack([TIME_S - 15 + ahead_m, np.zeros(300), np.full(300, 10.0)], -1)


def echo(true, logged, sidelink):
    """Echo of the target as it was flown, given back the sidelink's length that the logs have."""
    path = true.path(TARGET_M)
    if sidelink:
        length = [np.linalg.norm(one.tx_m - one.rx_m, axis=1)[:, None] for one in (true, logged)]
        path = path - length[0] + length[1]
    transfer = np.exp(-2j * np.pi * FREQUENCY_HZ * path / SPEED_OF_LIGHT_M_S).astype(np.complex64)
    return PhaseHistory(transfer, FREQUENCY_HZ, np.full(128, 1 / 128), np.zeros(300), logged)


@pytest.mark.parametrize(("pair", "ahead_m"), [("a-a", 0.0), ("a-b", 4.7)])
def test_a_corrected_track_focuses_as_the_true_one(pair, ahead_m):
    knots = np.linspace(0, 30, 31)
    generator = np.random.default_rng(1)
    correction = TrackCorrection(knots, {node: 0.02 * generator.standard_normal((31, 3)) for node in "ab"})
    logged = Aperture(flown(), flown(ahead_m))
    true = correction.aperture(logged, pair, TIME_S)
    history = echo(true, logged, sidelink=pair == "a-b")
    assert abs(reference.form(history, TARGET_M)[0]) / 300 < 0.8
    between = logged.tx_m - logged.rx_m
    further = correction.longer_m(pair, TIME_S, between if pair == "a-b" else None)
    corrected = history.moved(true, further)
    assert abs(reference.form(corrected, TARGET_M)[0] / 300 - 1) < 1e-5


@pytest.fixture(scope="module")
def two_centimetres():
    return case("five", "straight", "joint", 0.02, 10.0, 1)


def searched(one):
    return TrackSearch.begin(one.records, GRID, FlatGround(0.0), one.errors)


@pytest.fixture(scope="module")
def search(two_centimetres):
    return searched(two_centimetres)


@pytest.mark.slow
def test_points_are_found_where_they_are_whatever_blurs_them():
    one = case("five", "straight", "joint", 0.03, 10.0, 2)
    places, ratio = bright_places(
        one.records, GRID, FlatGround(0.0), looks=looks_of(one.records, one.errors, one.targets_m[0])[0]
    )
    found = places[ratio > LEAST_RATIO]
    apart = np.linalg.norm(found[:, None] - one.targets_m, axis=2)
    assert apart.shape == (5, 5)
    assert apart.min(axis=1).max() < 0.3


def test_parts_of_a_longer_flight_hold_no_more_pulses_and_pixels_sample_what_they_show():
    """Eq. 10b: what a place is seen from is cut, not the flight; memory stays flat with its length."""
    pulses, places = [], np.zeros(3)
    for times in (1, 4):
        time_s = np.arange(0, 60.0 * times, 0.1)
        track = np.stack([2 * (time_s - 30 * times), np.full(len(time_s), -30.0), np.full(len(time_s), 10.0)], -1)
        flown = Aperture(track, track)
        silent = np.broadcast_to(np.zeros(1, np.complex64), (len(time_s), 200))
        profiles = Profiles(silent, np.full(len(time_s), 40.0), 0.366, 1.4e9, 2.0, flown)
        beams = Beams.within(Sector.of(flown, chord_m=2.0, centre=0.0, half=0.5), None)
        record = PairRecord("a-a", profiles, time_s, beams=beams)
        scene = SceneGrid("local", -5.0, 5.0, 0.1, (100, 100))
        errors = {"a": TrackErrors((0.02,) * 3)}
        counts = [looks_of([record], errors, places)[0], sampled_looks([record], scene, FlatGround(0.0))]
        share = (beams.weight(flown, places[None]) > 0).mean()
        pulses.append([2 * len(time_s) * share / count for count in counts])
        lasts_s = time_s[-1] * share / counts[1]
        turned = 2 * 2.0 / np.hypot(30, 10) * 2 * lasts_s * 1.4e9 / SPEED_OF_LIGHT_M_S  # of both halves, cycles/m
        assert turned * scene.spacing_m < 1.05
    assert pulses[1] == pytest.approx(pulses[0], rel=0.15)


def test_blocks_add_what_their_pulses_do(search):
    blocks, echo = search.problem.pairs[1], search.problem.echoes[1][0]
    still = blocks.moves({node: np.zeros((len(search.problem.knots_s), 3)) for node in ("uav1", "uav2")})
    summed = blocks.contribution(echo, still).values
    whole = block_contributions(blocks.record.profiles, echo.patch.pixels_m, edges=blocks.edges)
    # Blocks keep each pulse's carrier at the patch's middle, and that of their mean place beside it.
    phase = np.exp(1j * np.angle((summed.conj() * whole).sum(axis=0)))
    error = np.linalg.norm(summed * phase - whole) / np.linalg.norm(whole)
    assert error < 0.03
    assert np.abs(np.angle(phase)).max() < 0.1


def test_the_prior_has_the_variance_and_the_lasting_that_the_log_states():
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
    for lag, known in lags.items():  # the budget and the prior take the same errors
        assert known == pytest.approx(np.full(3, autocorrelation(np.array(0.1 * lag), 2.0)), abs=0.04)


def test_position_correlation_s_is_described_as_it_is_taken():
    """A user who knows when errors have fallen to 1/e finds the length to state: 1/0.63 of that."""
    described = Node.model_fields["position_correlation_s"].description
    share = 1 - 1 / np.e
    assert float(re.search(r"to zero there, to 1/e at ([0-9.]+) of it", described)[1]) == pytest.approx(
        share, abs=0.005
    )
    assert autocorrelation(np.array([share, 1.0]), 1.0) == pytest.approx([1 / np.e, 0.0])


@pytest.mark.parametrize("drift_m", [0.0, 0.05])
def test_the_adjoint_of_the_prior_is_its_transpose(drift_m):
    generator, knots = np.random.default_rng(4), np.arange(0, 5, 0.1)
    prior = Prior({node: NodePrior.of(TrackErrors((0.01,) * 3, 1.0, drift_m), knots, np.eye(3)) for node in "ab"})
    unknowns, gradient = generator.standard_normal(prior.size), {n: generator.standard_normal((50, 3)) for n in "ab"}
    forward = sum(float((track * gradient[node]).sum()) for node, track in prior.tracks(unknowns).items())
    assert prior.adjoint(gradient) @ unknowns == pytest.approx(forward, rel=1e-12)


def test_the_gradient_of_sharpness_is_its_finite_difference(search):
    problem, begun = search.problem, search.initial
    sharpness = Sharpness(
        problem.pairs, begun.cached, begun.tracks, begun.statistics, np.ones(len(problem.patches), bool)
    )
    generator = np.random.default_rng(5)
    at = 0.3 * generator.standard_normal(problem.prior.size)
    gradient = problem.prior.adjoint(sharpness(problem.prior.tracks(at))[1])
    along = gradient / np.linalg.norm(gradient) + generator.standard_normal(gradient.size) / np.sqrt(gradient.size)
    ahead, behind = (sharpness(problem.prior.tracks(at + step * along))[0] for step in (5e-3, -5e-3))
    assert gradient @ along == pytest.approx((ahead - behind) / 1e-2, rel=2e-3)


def test_a_shift_of_all_tracks_moves_points_and_blurs_none(search):
    problem = search.problem
    for axis in np.eye(3):
        tracks = {node: np.ones((1, len(problem.knots_s), 3)) * axis for node in problem.prior.nodes}
        for blocks, patches in zip(problem.pairs, search.initial.cached, strict=True):
            moved = {node: blocks.average_of(tracks[node]) for node in blocks.record.nodes}
            for patch in patches:
                blur_rad, shift_m = effects(patch, moved, np.eye(3))
                assert np.sqrt((blur_rad**2).sum()) < 0.01 * patch.wavenumber
                assert shift_m[:, 0] == pytest.approx(axis[:2] if axis[2] == 0 else shift_m[:, 0], abs=0.01)


@pytest.fixture(scope="module")
def refined(two_centimetres):
    return refine(two_centimetres.records, GRID, FlatGround(0.0), two_centimetres.errors)


@pytest.mark.slow
def test_two_centimetres_are_mended_at_places_that_no_fit_saw(two_centimetres, refined):
    before, after = judge(two_centimetres), judge(two_centimetres, refined.correction)
    assert before.probe_loss_db < -5
    assert after.probe_loss_db > -0.4
    assert refined.accepted
    assert not refined.flags


@pytest.mark.slow
def test_refinement_does_not_move_the_image(two_centimetres, refined, search):
    before, after = judge(two_centimetres), judge(two_centimetres, refined.correction)
    assert after.target_shift_cm < before.target_shift_cm + 0.3
    # What is held would move it, and nothing would tell: all motions that it holds, from the true tracks on.
    problem = search.problem
    truth = {node: two_centimetres.truth.at(node, problem.knots_s) for node in ("uav1", "uav2")}
    held = problem.prior.tracks(problem.gauge.modes[-3:].sum(axis=0))
    moved = TrackCorrection(problem.knots_s, {node: truth[node] + held[node] for node in truth})
    here, there = (judge(two_centimetres, one) for one in (TrackCorrection(problem.knots_s, truth), moved))
    assert there.target_shift_cm > here.target_shift_cm + 1.5
    assert there.probe_loss_db > here.probe_loss_db - 0.05


@pytest.mark.slow
def test_reference_points_put_the_image_where_it_belongs(two_centimetres, refined):
    known = [ReferencePoint(f"corner {number}", tuple(two_centimetres.targets_m[number]), 0.005) for number in range(4)]
    tied = refine(two_centimetres.records, GRID, FlatGround(0.0), two_centimetres.errors, reference_points=known)
    before, after = (judge(two_centimetres, one.correction) for one in (refined, tied))
    assert after.target_shift_cm < 0.6 * before.target_shift_cm  # a pair's path is known to no better
    assert after.target_shift_cm < 1.5
    assert after.probe_loss_db > before.probe_loss_db - 0.1
    assert {one["name"] for one in tied.report["reference_points"]} == {one.name for one in known}


@pytest.mark.slow
def test_a_log_that_states_four_times_its_errors_is_flagged(two_centimetres, refined):
    stated = {node: TrackErrors((0.08,) * 3) for node in two_centimetres.errors}
    found = refine(two_centimetres.records, GRID, FlatGround(0.0), stated)
    assert "position_error_overstated" in found.flags
    assert not {"position_error_overstated", "position_error_understated"} & refined.flags.keys()
    assert judge(two_centimetres, found.correction).probe_loss_db > -0.5  # and yet focused


def test_a_wavelength_of_path_over_a_part_of_the_aperture_is_told(two_centimetres, search):
    problem, wavelength_m = search.problem, search.wavelength_m
    truth = {node: two_centimetres.truth.at(node, problem.knots_s) for node in ("uav1", "uav2")}
    slip = np.zeros((len(problem.knots_s), 3))
    slip[75:115, 1] = -0.8 * wavelength_m  # away from the scene: a bit more than half a wavelength there and back

    def slipped(tracks):
        state = problem.at(tracks)
        return range_shifts(problem, state, search.axes).slipped(wavelength_m)

    assert not slipped(truth).any()
    assert slipped({"uav1": truth["uav1"] + slip, "uav2": truth["uav2"]})[0, 2]


@pytest.mark.slow
def test_speckle_is_refused(two_centimetres):
    generator = np.random.default_rng(6)
    noisy = []
    for one in two_centimetres.records:
        shape = one.profiles.samples.shape
        noise = generator.standard_normal((*shape, 2)).astype(np.float32).view(np.complex64)[..., 0]
        noisy.append(replace(one, profiles=replace(one.profiles, samples=noise)))
    rejected = refine(noisy, GRID, FlatGround(0.0), two_centimetres.errors)
    assert not rejected.accepted
    assert "refinement_no_bright_point" in rejected.flags
    assert not any(moved.any() for moved in rejected.correction.moved_m.values())


@pytest.mark.slow
@pytest.mark.parametrize(("points", "pairs", "sigma_m"), [(1, "mono", 0.02), (2, "bi", 0.02), (3, "joint", 0.04)])
def test_a_first_flight_past_few_points_is_mended(points, pairs, sigma_m):
    """150 pulses in 7.5 s: places are judged by others, or, where there are none, by steady amplitudes."""
    one = case(f"points-{points}", "short", pairs, sigma_m, 10.0, 0)
    found = refine(one.records, GRID, FlatGround(0.0), one.errors)
    before, after = judge(one), judge(one, found.correction)
    assert found.accepted, found.why
    assert before.target_loss_db < -2
    assert after.target_loss_db > -0.5
    assert after.target_shift_cm < before.target_shift_cm + 1  # what no image tells stays with the log


def test_right_logs_are_left_alone():
    one = case("points-4", "short", "mono", 0.0, 10.0, 3, stated_m=0.02)
    found = refine(one.records, GRID, FlatGround(0.0), one.errors)
    assert not found.accepted
    assert not found.flags.keys() - {"position_error_overstated"}  # which is true of logs that state 2 cm and have none
    assert "no improvement over the logs" in found.why


def test_a_slip_of_the_tracks_is_found_by_delays_and_taken_back():
    """4 cm in 7.5 s: the sharpest tracks are a wavelength off over parts of the flight until delays are compared."""
    one = case("points-4", "short", "mono", 0.04, 10.0, 13)
    found = refine(one.records, GRID, FlatGround(0.0), one.errors)
    assert found.accepted, found.why
    assert judge(one, found.correction).target_shift_cm < 8
    assert judge(one).target_shift_cm > 20


def test_speckle_has_no_steady_amplitude_whatever_phases_are_fitted():
    generator = np.random.default_rng(8)
    for _ in range(20):
        speckle = generator.standard_normal((150, 2)).view(complex)[:, 0]
        assert steadiness(np.abs(speckle) + 0j) > MOST_INTERFERENCE or steadiness(speckle) > MOST_INTERFERENCE
    noisy = np.exp(1j * np.linspace(0, 3, 150)) + 0.2 * generator.standard_normal((150, 2)).view(complex)[:, 0]
    assert steadiness(noisy) < MOST_INTERFERENCE
