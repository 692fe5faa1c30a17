"""What a flight log's own epochs say of it: faults are found, and good logs have none."""

import numpy as np
import pytest

from apertura.core.geometry.geodesy import ecef_from_geodetic
from apertura.core.geometry.lever_arms import position_spline
from apertura.core.geometry.track_checks import (
    check_track,
    check_yaw,
    find_frozen,
    find_spikes,
    find_steps,
    hovering,
    misfits,
    rounded_position_m,
    rounded_time_m,
    scatter_m,
)

X_BAND_M = 0.0316 / 16


def flight(kind, time_s, generator):
    """Positions of a flight, (epoch, 3) metres."""
    if kind == "hover":
        return 0.03 * np.stack([np.sin(0.5 * time_s + phase) for phase in range(3)], -1)
    if kind == "straight":
        return np.stack([8 * time_s, 0 * time_s, 0 * time_s + 10], -1)
    if kind == "circle":
        return np.stack([20 * np.cos(0.4 * time_s), 20 * np.sin(0.4 * time_s), 10 + 0 * time_s], -1)
    fine = np.arange(time_s[0], time_s[-1] + 0.02, 0.01)  # legs of constant speed, changed at 4 m/s²
    velocity, wanted = np.zeros((len(fine), 3)), np.zeros(3)
    for step in range(1, len(fine)):
        if generator.random() < 0.002:
            wanted = generator.normal(0, 5, 3) * [1, 1, 0.2]
        change = wanted - velocity[step - 1]
        velocity[step] = velocity[step - 1] + change * min(1, 0.04 / max(np.linalg.norm(change), 1e-9))
    place = np.cumsum(velocity, axis=0) * 0.01
    return np.stack([np.interp(time_s, fine, axis) for axis in place.T], -1)


def logged(kind="straight", *, rate_hz=10.0, noise_m=0.003, grain_m=0.0, epochs=400, seed=0, unequal=0.0):
    generator = np.random.default_rng(seed)
    time_s = (np.arange(epochs) + unequal * generator.uniform(-0.5, 0.5, epochs)) / rate_hz
    place = flight(kind, time_s, generator) + generator.normal(0, noise_m, (epochs, 3))
    return time_s, np.round(place / grain_m) * grain_m if grain_m else place


def checked(time_s, place, *, poor=None, tolerated_m=X_BAND_M):
    nothing = np.zeros(len(time_s), bool)
    return check_track(time_s, place, poor_fix=nothing if poor is None else poor, tolerated_m=tolerated_m)


@pytest.mark.quick("*-hover", "*-straight", "*-circle", "10.0-legs", "50.0-legs", "100.0-legs")
@pytest.mark.parametrize("kind", ["hover", "straight", "circle", "legs"])
@pytest.mark.parametrize("rate_hz", [1.0, 2.0, 5.0, 10.0, 50.0, 100.0])
def test_a_good_log_has_no_fault_and_no_hole(kind, rate_hz):
    """Whatever its noise, its grain and its jitter; at 100 Hz coarse positions repeat by right."""
    for seed, noise_m in enumerate((0.0, 0.001, 0.01, 0.03)):
        for grain_m, unequal in ((0.0, 0.0), (1e-4, 0.2), (0.01, 0.0), (0.01, 0.2)):
            given = {"rate_hz": rate_hz, "noise_m": noise_m, "grain_m": grain_m, "unequal": unequal, "seed": seed}
            result = checked(*logged(kind, **given))
            assert result.kept.all(), given
            assert result.holes == (), given
            assert result.faults == {}, given


@pytest.mark.parametrize("kind", ["hover", "straight", "circle", "legs"])
@pytest.mark.parametrize("epochs", [1, 3])
def test_epochs_that_stand_out_are_found_and_left_out(kind, epochs):
    time_s, place = logged(kind, seed=4)
    place[200 : 200 + epochs] += [0.2, 0.3, -0.3]
    result = checked(time_s, place)
    assert np.flatnonzero(~result.kept).tolist() == list(range(200, 200 + epochs))
    assert result.faults["track_outlier"][0] == pytest.approx((20.0, 0.47), abs=0.25)
    assert len(result.faults["track_outlier"]) == epochs


@pytest.mark.parametrize(("size_m", "found"), [(0.02, False), (0.08, True)])
def test_an_outlier_counts_from_ten_times_the_logs_own_scatter(size_m, found):
    """3 mm per axis is a scatter of the misfit of 4.2 mm."""
    time_s, place = logged("straight", noise_m=0.003)
    assert scatter_m(misfits(time_s, place)) == pytest.approx(0.0042, rel=0.1)
    place[200, 2] += size_m
    assert bool(find_spikes(time_s, place)) is found


@pytest.mark.parametrize(("size_m", "found"), [(0.004, False), (0.007, True)])
def test_an_outlier_of_a_noiseless_log_counts_from_five_millimetres(size_m, found):
    time_s, place = logged("circle", noise_m=1e-5)
    place[200, 2] += size_m
    assert bool(find_spikes(time_s, place)) is found


@pytest.mark.parametrize("kind", ["straight", "circle", "legs"])
@pytest.mark.parametrize(("size_m", "found"), [(0.025, False), (0.3, True)])
def test_a_step_of_all_later_positions_is_found_where_it_is(kind, size_m, found):
    time_s, place = logged(kind, seed=4)
    place[200:, 1] += size_m
    steps = find_steps(time_s, place)
    assert bool(steps) is found
    if found:
        assert (steps[0].first, steps[0].last, len(steps)) == (199, 200, 1)
        assert steps[0].size_m == pytest.approx(size_m, rel=0.1)
        hole = checked(time_s, place).holes[0]
        assert (hole.start_s, hole.end_s) == pytest.approx((19.8, 20.1))


def test_a_node_that_brakes_within_an_epoch_is_no_outlier():
    """5 m/s to 0 at once, in a log of 1 Hz: the spline errs, but no epoch is wrong."""
    time_s = np.arange(120.0)
    for when in np.arange(60.0, 61.0, 0.1):
        place = np.stack([5 * np.minimum(time_s, when), 0 * time_s, 0 * time_s], -1)
        place += np.random.default_rng(1).normal(0, 0.005, place.shape)
        assert checked(time_s, place).faults == {}


@pytest.mark.parametrize(("missing", "barred"), [(2, False), (30, True)])
def test_a_gap_bars_pulses_where_the_spline_through_it_would_err(missing, barred):
    """Legs of a mission: 0.3 s are bridged well, 3.1 s are not."""
    time_s, place = logged("legs", seed=4, noise_m=0.001)
    rest = np.delete(np.arange(400), np.arange(200, 200 + missing))
    result = checked(time_s[rest], place[rest])
    assert [hole.cause for hole in result.holes] == ["track_gap"] * barred
    if barred:
        spline_m = result.holes[0].size_m
        assert (result.holes[0].start_s, result.holes[0].end_s) == pytest.approx((19.9, 23.0))
        assert 0.1 < spline_m < 30
        at_s = np.array([19.9, 19.95, 22.9, 23.0, 23.1])
        assert result.excluded(at_s)["track_gap"].tolist() == [False, True, True, False, False]


def test_a_long_gap_in_a_flight_that_the_spline_follows_bars_nothing():
    """On a line at constant speed, to which it errs less than λ/16 of 1 GHz."""
    time_s, place = logged("straight", noise_m=0.0)
    rest = np.delete(np.arange(400), np.arange(200, 210))
    assert checked(time_s[rest], place[rest], tolerated_m=0.019).holes == ()


def test_pulses_of_a_poor_fix_are_barred_however_short_it_is():
    time_s, place = logged()
    poor = np.zeros(400, bool)
    poor[[0, 1, 100, 399]] = True
    holes = checked(time_s, place, poor=poor).holes
    assert {hole.cause for hole in holes} == {"fix_quality_low"}
    edges = np.array(sorted(hole[:2] for hole in holes))
    np.testing.assert_allclose(edges, [(-np.inf, 0.2), (9.9, 10.1), (39.8, np.inf)])
    assert checked(time_s, place, poor=np.ones(400, bool)).excluded(time_s)["fix_quality_low"].all()


def test_a_log_that_freezes_and_jumps_is_not_splined_through_the_frozen_epochs():
    time_s, place = logged("legs", seed=4, noise_m=0.001)
    place[200:230] = place[200]
    result = checked(time_s, place)
    assert np.flatnonzero(~result.kept).tolist() == list(range(201, 230))
    assert {hole.cause for hole in result.holes} == {"track_frozen"}
    assert len(result.faults["track_frozen"]) == 29


def test_a_log_that_writes_every_position_twice_uses_the_first_of_each():
    time_s, place = logged("circle")
    twice = np.repeat(place[::2], 2, axis=0)
    assert np.flatnonzero(find_frozen(time_s, twice)).tolist() == list(range(1, 400, 2))
    assert [hole[1:3] for hole in checked(time_s, twice).holes] == [(np.inf, "track_frozen")]  # after the last


@pytest.mark.parametrize(("grain_s", "found"), [(0.1, True), (0.001, False)])
def test_times_rounded_against_the_motion_are_found_with_what_they_cost(grain_s, found):
    """8 m/s · 0.1 s/√12 = 0.23 m."""
    true_s, place = np.arange(300) * 0.137, logged("straight", rate_hz=1 / 0.137, epochs=300)[1]
    size_m = rounded_time_m(np.round(true_s / grain_s) * grain_s, place)
    assert size_m == pytest.approx(0.23 if found else 0.0, abs=0.01)
    assert ("track_times" in checked(np.round(true_s / grain_s) * grain_s, place).faults) is found


RADIUS_M = 6_371_000 * np.pi / 180


@pytest.mark.parametrize(
    ("grain_deg", "expected_m"),
    [
        (1e-4 / 60, 0.0644),  # four decimals of a minute: 0.185 m and 0.124 m, over √12
        (1e-5 / 60, 0.00535),  # 1.9 cm of latitude; 1.2 cm of longitude count as fine
        (1e-4, 3.87),  # six digits of a spreadsheet
        (1e-9, 0.0),
    ],
)
@pytest.mark.parametrize("kind", ["circle", "legs", "straight"])
@pytest.mark.parametrize("speed", [0.1, 1.0])
def test_positions_rounded_to_a_grid_are_found_with_what_they_err_by(grain_deg, expected_m, kind, speed):
    time_s, place = logged(kind, epochs=600, noise_m=0.003, seed=2)
    turned = speed * place @ np.array([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]])  # along no axis of the grid
    latitude, longitude = 48 + turned[:, 0] / RADIUS_M, 9 + turned[:, 1] / RADIUS_M / np.cos(np.radians(48))
    rounded = [np.round(angle / grain_deg) * grain_deg for angle in (latitude, longitude)]
    ecef = ecef_from_geodetic(*rounded, 600 + turned[:, 2])
    found = rounded_position_m(time_s, ecef, least_m=X_BAND_M)
    few = grain_deg == 1e-4 and speed * np.ptp(place[:, :2], axis=0).min() < 100  # too few values for a grid
    assert few or found == pytest.approx(expected_m, rel=0.01)
    faults = checked(time_s, ecef).faults
    assert few or ("track_positions" in faults) is (expected_m > 0)


def test_degrees_in_single_precision_are_a_grid():
    """4·10⁻⁶ degrees of latitude, 0.42 m, and 10⁻⁶ of longitude, 0.07 m, from 48° north and 9° east on."""
    time_s, place = logged("circle", epochs=600, noise_m=0.003, seed=2)
    latitude, longitude = 48.4 + place[:, 0] / RADIUS_M, 9.9 + place[:, 1] / RADIUS_M / np.cos(np.radians(48.4))
    single = [angle.astype(np.float32).astype(np.float64) for angle in (latitude, longitude)]
    error_m = rounded_position_m(time_s, ecef_from_geodetic(*single, 600 + place[:, 2]), least_m=X_BAND_M)
    assert error_m == pytest.approx(np.hypot(0.424, 0.0704) / np.sqrt(12), rel=0.02)


def test_positions_of_uniform_motion_are_no_grid():
    """5 m/s at 10 Hz moves by 0.5 m from epoch to epoch."""
    time_s, place = logged("straight", epochs=300)
    assert rounded_position_m(time_s, place, least_m=X_BAND_M) == 0.0
    assert rounded_position_m(time_s, place + [4e6, 1e6, 4e6], least_m=X_BAND_M) == 0.0


def test_the_error_of_the_spline_between_epochs_is_estimated_from_the_epochs():
    """A wave of 1 m and 1 s, at 5 and 10 Hz: never less than the true error, the closer the finer it is logged."""
    for rate_hz, most in ((5.0, 4.0), (10.0, 2.5)):
        time_s = np.arange(0, 40, 1 / rate_hz)
        wave = np.stack([np.sin(2 * np.pi * time_s), 0 * time_s, 0 * time_s], -1)
        between_s = np.linspace(5, 35, 4001)
        true_m = np.std(position_spline(time_s, wave)(between_s)[:, 0] - np.sin(2 * np.pi * between_s)) / np.sqrt(3)
        assert 0.9 < checked(time_s, wave).interpolation_m / true_m < most


def test_a_gap_longer_than_asked_is_a_hole_however_well_a_spline_bridges_it():
    time_s = np.delete(np.arange(200) * 0.1, [100, 101, 102])
    straight = np.stack([5 * time_s, 0 * time_s, 0 * time_s], -1)
    sound = np.zeros(len(time_s), bool)
    for longest_s, holes in ((np.inf, 0), (0.5, 0), (0.3, 1)):
        checked = check_track(time_s, straight, poor_fix=sound, tolerated_m=0.01, longest_gap_s=longest_s)
        assert len(checked.holes) == holes


WIND_M_S, AIR_M_S = np.array([2.0, -1.0]), 7.0


def attitude(place_m, policy, generator):
    """Roll, pitch and yaw (deg) of a multirotor that leans into its flight; positions are north, east, down."""
    velocity = np.gradient(place_m[:, :2], 0.1, axis=0)
    course = np.degrees(np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0])))
    across = (velocity[:, 0] * WIND_M_S[1] - velocity[:, 1] * WIND_M_S[0]) / np.hypot(*velocity.T)
    crab = -np.degrees(np.arcsin(across / AIR_M_S))
    yaw = {
        "ahead": course + crab,
        "sideways": course + crab - 90,
        "backwards": course + 180,
        "held": np.full(len(course), generator.choice([0.5, 2.0, 90.0, 213.0])),
        "at a target": np.degrees(np.arctan2(200 - place_m[:, 1], 150 - place_m[:, 0])),
    }[policy]
    wobble = 1.5 * np.cumsum(generator.standard_normal((len(course), 3)), axis=0) / np.sqrt(len(course))
    return wobble + np.column_stack([2 * np.sin(course / 20), np.full(len(course), -4.0), (yaw + 180) % 360 - 180])


def mapped(course_deg, seconds=10.0):
    """Legs of 7 m/s at ten epochs a second, one for each course; north, east, down."""
    course = np.radians(np.repeat(course_deg, round(10 * seconds)))
    return np.cumsum(0.1 * AIR_M_S * np.column_stack([np.cos(course), np.sin(course), 0 * course]), axis=0)


ROUND = mapped(np.arange(0, 361, 15), 2.0)
FLOWN = {
    "round": ROUND,
    "lawnmower": mapped([90, 180, 270, 180] * 4),
    "straight east": mapped([90]),
    "straight north": mapped([0]),
    "corner": mapped([0, 90]),
    "hover": 0.03 * np.random.default_rng(3).standard_normal((600, 3)),
}


@pytest.mark.parametrize("flown", FLOWN)
@pytest.mark.parametrize("policy", ["ahead", "sideways", "backwards", "held", "at a target"])
def test_however_a_node_turns_its_right_attitude_is_not_accused(flown, policy):
    for seed in range(5):
        degrees = attitude(FLOWN[flown], policy, np.random.default_rng(seed))
        assert check_yaw(FLOWN[flown], np.radians(degrees), np.eye(3)) is None


@pytest.mark.parametrize(
    ("flown", "policy", "certain"),
    [
        ("round", "ahead", True),
        ("round", "sideways", True),
        ("lawnmower", "ahead", False),
        ("straight east", "ahead", False),
        ("corner", "backwards", False),
    ],
)
def test_radians_are_told_by_a_yaw_that_follows_the_course_as_radians_alone(flown, policy, certain):
    degrees = attitude(FLOWN[flown], policy, np.random.default_rng(1))
    fault = check_yaw(FLOWN[flown], np.radians(np.radians(degrees)), np.eye(3))
    assert fault is not None
    assert (fault.convention, fault.certain) == ("in radians", certain)
    assert fault.otherwise_deg < 20
    assert fault.as_logged_deg > 40


def test_yaw_that_is_counted_anticlockwise_is_told_by_a_course_through_most_directions():
    """From north or from east; a corner could also be flown by a node that turns towards the scene."""
    degrees = attitude(ROUND, "ahead", np.random.default_rng(1))
    for zero in (0.0, 90.0):
        turned = np.radians(degrees * [1, 1, -1] + [0, 0, zero])
        assert check_yaw(ROUND, turned, np.eye(3)).convention == "anticlockwise"
    corner = FLOWN["corner"]
    other = np.radians(attitude(corner, "ahead", np.random.default_rng(1)) * [1, 1, -1])
    assert check_yaw(corner, other, np.eye(3)) is None


def test_no_angle_beyond_a_whole_turn_is_in_radians():
    """On both sides of the limit: of a lawnmower, one epoch of 2π and one of 6.5."""
    radians = np.radians(attitude(FLOWN["lawnmower"], "ahead", np.random.default_rng(1)))
    for largest, found in ((2 * np.pi, True), (6.5, False)):
        radians[7, 2] = largest
        assert (check_yaw(FLOWN["lawnmower"], np.radians(radians), np.eye(3)) is not None) is found


def courses(kind, generator):
    """Courses (deg) of four seconds each."""
    first = generator.uniform(0, 360)
    return {
        "legs": generator.uniform(0, 360, generator.integers(2, 12)),
        "circle": first + np.arange(0, 361, 15) * generator.choice([-1, 1]),
        "lawnmower": first + np.array([0, 90, 180, 90] * 4),
        "wandering": np.cumsum(generator.normal(0, 30, 30)),
        "straight": np.array([first]),
    }[kind]


@pytest.mark.slow
def test_of_drawn_flights_none_is_accused_and_radians_are_told():
    """4000 flights; those that turn as they fly in 9 of 10 cases, straight ones ahead in 7."""
    generator, told = np.random.default_rng(0), {}
    for _ in range(4000):
        kind = generator.choice(["legs", "circle", "lawnmower", "straight", "wandering"])
        policy = generator.choice(["ahead", "sideways", "backwards", "held", "at a target"])
        place_m = mapped(courses(kind, generator), 4.0)
        degrees = attitude(place_m, policy, generator)
        if policy == "held":
            degrees[:, 2] += generator.uniform(-5, 5) - degrees[0, 2] * (generator.random() < 0.5)
        assert check_yaw(place_m, np.radians(degrees), np.eye(3)) is None
        found = check_yaw(place_m, np.radians(np.radians(degrees)), np.eye(3))
        group = "turned" if kind != "straight" and policy in {"ahead", "sideways", "backwards"} else f"{kind} {policy}"
        told.setdefault(group, []).append(found is not None and found.convention == "in radians")
    assert np.mean(told["turned"]) > 0.9
    assert np.mean(told["straight ahead"]) > 0.7


# Hovers


def _flown(*parts: tuple[float, float], interval_s: float = 0.05):
    """Return times and positions of parts of a flight: how long, and at which speed, with 1 cm of noise in the log."""
    speed = np.concatenate([np.full(round(lasts / interval_s), speed) for lasts, speed in parts])
    east = np.cumsum(speed) * interval_s
    noise = 0.01 * np.random.default_rng(1).standard_normal((len(east), 3))
    return interval_s * np.arange(len(east)), np.stack([east, 0 * east, 0 * east], -1) + noise


def test_a_hover_inside_a_flight_is_found_to_a_second():
    time_s, leg = _flown((30, 0.5), (30, 0.0), (30, 0.5))
    out = hovering(time_s, (leg, leg))
    assert abs(time_s[out].min() - 30) < 1
    assert abs(time_s[out].max() - 60) < 1
    assert out[(time_s > 31) & (time_s < 59)].all()


@pytest.mark.parametrize(
    "parts",
    [
        ((60, 0.5),),
        ((60, 0.0),),
        ((30, 0.5), (4, 0.0), (30, 0.5)),
        ((60, 0.5), (30, 0.2)),
        ((200, 5.0), (6, 0.0), (200, 5.0)),
    ],
    ids=["no hover", "never moved", "shorter than 5 s", "slower, no hover", "3 % of the pulses"],
)
def test_what_is_no_hover_is_left_in(parts):
    time_s, leg = _flown(*parts)
    assert not hovering(time_s, (leg, leg)).any()


def test_a_pair_of_which_one_node_flies_does_not_hover():
    time_s, leg = _flown((60, 0.5))
    still = np.zeros_like(leg)
    assert not hovering(time_s, (still, leg)).any()
