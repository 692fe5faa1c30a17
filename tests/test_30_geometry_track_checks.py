"""Checks of a flight log by its epochs: faults are found, and correct logs raise none."""

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
    """Return positions of a flight, (epoch, 3) metres."""
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
def test_good_log_has_no_fault_and_no_hole(kind, rate_hz):
    """No fault is raised for any noise, resolution and jitter; coarse positions at 100 Hz repeat legitimately."""
    for seed, noise_m in enumerate((0.0, 0.001, 0.01, 0.03)):
        for grain_m, unequal in ((0.0, 0.0), (1e-4, 0.2), (0.01, 0.0), (0.01, 0.2)):
            parameters = {"rate_hz": rate_hz, "noise_m": noise_m, "grain_m": grain_m, "unequal": unequal, "seed": seed}
            result = checked(*logged(kind, **parameters))
            assert result.kept.all(), parameters
            assert result.holes == (), parameters
            assert result.faults == {}, parameters


@pytest.mark.parametrize("kind", ["hover", "straight", "circle", "legs"])
@pytest.mark.parametrize("epochs", [1, 3])
def test_outlying_epochs_are_found_and_excluded(kind, epochs):
    time_s, place = logged(kind, seed=4)
    place[200 : 200 + epochs] += [0.2, 0.3, -0.3]
    result = checked(time_s, place)
    assert np.flatnonzero(~result.kept).tolist() == list(range(200, 200 + epochs))
    assert result.faults["track_outlier"][0] == pytest.approx((20.0, 0.47), abs=0.25)
    assert len(result.faults["track_outlier"]) == epochs


@pytest.mark.parametrize(("size_m", "found"), [(0.02, False), (0.08, True)])
def test_outlier_threshold_is_ten_times_the_scatter_of_the_log(size_m, found):
    """Noise of 3 mm per axis causes a misfit scatter of 4.2 mm."""
    time_s, place = logged("straight", noise_m=0.003)
    assert scatter_m(misfits(time_s, place)) == pytest.approx(0.0042, rel=0.1)
    place[200, 2] += size_m
    assert bool(find_spikes(time_s, place)) is found


@pytest.mark.parametrize(("size_m", "found"), [(0.004, False), (0.007, True)])
def test_outlier_threshold_of_a_noiseless_log_is_5_mm(size_m, found):
    time_s, place = logged("circle", noise_m=1e-5)
    place[200, 2] += size_m
    assert bool(find_spikes(time_s, place)) is found


@pytest.mark.parametrize("kind", ["straight", "circle", "legs"])
@pytest.mark.parametrize(("size_m", "found"), [(0.025, False), (0.3, True)])
def test_step_of_positions_is_located(kind, size_m, found):
    time_s, place = logged(kind, seed=4)
    place[200:, 1] += size_m
    steps = find_steps(time_s, place)
    assert bool(steps) is found
    if found:
        assert (steps[0].first, steps[0].last, len(steps)) == (199, 200, 1)
        assert steps[0].size_m == pytest.approx(size_m, rel=0.1)
        hole = checked(time_s, place).holes[0]
        assert (hole.start_s, hole.end_s) == pytest.approx((19.8, 20.1))


def test_braking_within_an_epoch_is_no_outlier():
    """The speed drops from 5 m/s to 0 in a log of 1 Hz: the spline has an error, but every epoch is correct."""
    time_s = np.arange(120.0)
    for when in np.arange(60.0, 61.0, 0.1):
        place = np.stack([5 * np.minimum(time_s, when), 0 * time_s, 0 * time_s], -1)
        place += np.random.default_rng(1).normal(0, 0.005, place.shape)
        assert checked(time_s, place).faults == {}


@pytest.mark.parametrize(("missing", "excluded"), [(2, False), (30, True)])
def test_gap_excludes_pulses_where_the_spline_is_inaccurate(missing, excluded):
    """On the legs of a mission, gaps of 0.3 s are interpolated accurately, and gaps of 3.1 s are not."""
    time_s, place = logged("legs", seed=4, noise_m=0.001)
    rest = np.delete(np.arange(400), np.arange(200, 200 + missing))
    result = checked(time_s[rest], place[rest])
    assert [hole.cause for hole in result.holes] == ["track_gap"] * excluded
    if excluded:
        spline_m = result.holes[0].size_m
        assert (result.holes[0].start_s, result.holes[0].end_s) == pytest.approx((19.9, 23.0))
        assert 0.1 < spline_m < 30
        at_s = np.array([19.9, 19.95, 22.9, 23.0, 23.1])
        assert result.excluded(at_s)["track_gap"].tolist() == [False, True, True, False, False]


def test_long_gap_of_a_straight_flight_excludes_nothing():
    """On a line at constant speed, the spline error is below λ/16 at 1 GHz."""
    time_s, place = logged("straight", noise_m=0.0)
    rest = np.delete(np.arange(400), np.arange(200, 210))
    assert checked(time_s[rest], place[rest], tolerated_m=0.019).holes == ()


def test_any_poor_fix_excludes_pulses():
    time_s, place = logged()
    poor = np.zeros(400, bool)
    poor[[0, 1, 100, 399]] = True
    holes = checked(time_s, place, poor=poor).holes
    assert {hole.cause for hole in holes} == {"fix_quality_low"}
    edges = np.array(sorted(hole[:2] for hole in holes))
    np.testing.assert_allclose(edges, [(-np.inf, 0.2), (9.9, 10.1), (39.8, np.inf)])
    assert checked(time_s, place, poor=np.ones(400, bool)).excluded(time_s)["fix_quality_low"].all()


def test_frozen_epochs_before_a_jump_are_excluded():
    time_s, place = logged("legs", seed=4, noise_m=0.001)
    place[200:230] = place[200]
    result = checked(time_s, place)
    assert np.flatnonzero(~result.kept).tolist() == list(range(201, 230))
    assert {hole.cause for hole in result.holes} == {"track_frozen"}
    assert len(result.faults["track_frozen"]) == 29


def test_repeated_positions_are_used_once():
    time_s, place = logged("circle")
    twice = np.repeat(place[::2], 2, axis=0)
    assert np.flatnonzero(find_frozen(time_s, twice)).tolist() == list(range(1, 400, 2))
    assert [hole[1:3] for hole in checked(time_s, twice).holes] == [(np.inf, "track_frozen")]  # after the last epoch


@pytest.mark.parametrize(("grain_s", "found"), [(0.1, True), (0.001, False)])
def test_rounded_times_are_found_with_their_position_error(grain_s, found):
    """The expected position error is 8 m/s · 0.1 s/√12 = 0.23 m."""
    true_s, place = np.arange(300) * 0.137, logged("straight", rate_hz=1 / 0.137, epochs=300)[1]
    size_m = rounded_time_m(np.round(true_s / grain_s) * grain_s, place)
    assert size_m == pytest.approx(0.23 if found else 0.0, abs=0.01)
    assert ("track_times" in checked(np.round(true_s / grain_s) * grain_s, place).faults) is found


RADIUS_M = 6_371_000 * np.pi / 180


@pytest.mark.parametrize(
    ("grain_deg", "expected_m"),
    [
        (1e-4 / 60, 0.0644),  # four decimals of an arc minute: 0.185 m and 0.124 m, over √12
        (1e-5 / 60, 0.00535),  # 1.9 cm of latitude; the 1.2 cm of longitude are negligible
        (1e-4, 3.87),  # six significant digits, as in a spreadsheet
        (1e-9, 0.0),
    ],
)
@pytest.mark.parametrize("kind", ["circle", "legs", "straight"])
@pytest.mark.parametrize("speed", [0.1, 1.0])
def test_rounded_positions_are_found_with_their_error(grain_deg, expected_m, kind, speed):
    time_s, place = logged(kind, epochs=600, noise_m=0.003, seed=2)
    rotated = speed * place @ np.array([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]])  # not aligned with the grid
    latitude, longitude = 48 + rotated[:, 0] / RADIUS_M, 9 + rotated[:, 1] / RADIUS_M / np.cos(np.radians(48))
    rounded = [np.round(angle / grain_deg) * grain_deg for angle in (latitude, longitude)]
    ecef = ecef_from_geodetic(*rounded, 600 + rotated[:, 2])
    error_m = rounded_position_m(time_s, ecef, least_m=X_BAND_M)
    few = grain_deg == 1e-4 and speed * np.ptp(place[:, :2], axis=0).min() < 100  # too few values for a grid
    assert few or error_m == pytest.approx(expected_m, rel=0.01)
    faults = checked(time_s, ecef).faults
    assert few or ("track_positions" in faults) is (expected_m > 0)


def test_degrees_in_single_precision_are_a_grid():
    """The grid has steps of 4·10⁻⁶° of latitude (0.42 m) and 10⁻⁶° of longitude (0.07 m) at 48° north and 9° east."""
    time_s, place = logged("circle", epochs=600, noise_m=0.003, seed=2)
    latitude, longitude = 48.4 + place[:, 0] / RADIUS_M, 9.9 + place[:, 1] / RADIUS_M / np.cos(np.radians(48.4))
    single = [angle.astype(np.float32).astype(np.float64) for angle in (latitude, longitude)]
    error_m = rounded_position_m(time_s, ecef_from_geodetic(*single, 600 + place[:, 2]), least_m=X_BAND_M)
    assert error_m == pytest.approx(np.hypot(0.424, 0.0704) / np.sqrt(12), rel=0.02)


def test_positions_of_uniform_motion_are_no_grid():
    """A speed of 5 m/s at 10 Hz displaces the positions by 0.5 m per epoch."""
    time_s, place = logged("straight", epochs=300)
    assert rounded_position_m(time_s, place, least_m=X_BAND_M) == 0.0
    assert rounded_position_m(time_s, place + [4e6, 1e6, 4e6], least_m=X_BAND_M) == 0.0


def test_spline_error_between_epochs_is_estimated():
    """For a wave of 1 m and 1 s, the estimate is never below the true error, and closer to it at 10 Hz than at 5 Hz."""
    for rate_hz, most in ((5.0, 4.0), (10.0, 2.5)):
        time_s = np.arange(0, 40, 1 / rate_hz)
        wave = np.stack([np.sin(2 * np.pi * time_s), 0 * time_s, 0 * time_s], -1)
        between_s = np.linspace(5, 35, 4001)
        true_m = np.std(position_spline(time_s, wave)(between_s)[:, 0] - np.sin(2 * np.pi * between_s)) / np.sqrt(3)
        assert 0.9 < checked(time_s, wave).interpolation_m / true_m < most


def test_gap_above_the_configured_limit_is_always_a_hole():
    time_s = np.delete(np.arange(200) * 0.1, [100, 101, 102])
    straight = np.stack([5 * time_s, 0 * time_s, 0 * time_s], -1)
    sound = np.zeros(len(time_s), bool)
    for longest_s, holes in ((np.inf, 0), (0.5, 0), (0.3, 1)):
        checked = check_track(time_s, straight, poor_fix=sound, tolerated_m=0.01, longest_gap_s=longest_s)
        assert len(checked.holes) == holes


WIND_M_S, AIR_M_S = np.array([2.0, -1.0]), 7.0


def attitude(place_m, policy, generator):
    """Return roll, pitch and yaw (deg) of a multirotor tilted along its flight; positions are north, east, down."""
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
    """Return positions (north, east, down) at ten epochs per second along legs at 7 m/s, one leg for each course."""
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
def test_correct_attitude_raises_no_fault_with_any_yaw_policy(flown, policy):
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
def test_yaw_in_radians_is_detected(flown, policy, certain):
    degrees = attitude(FLOWN[flown], policy, np.random.default_rng(1))
    fault = check_yaw(FLOWN[flown], np.radians(np.radians(degrees)), np.eye(3))
    assert fault is not None
    assert (fault.convention, fault.certain) == ("in radians", certain)
    assert fault.otherwise_deg < 20
    assert fault.as_logged_deg > 40


def test_anticlockwise_yaw_is_detected_on_a_round_course():
    """Yaw counts from north or from east; a single corner is ambiguous, because the node may turn towards the scene."""
    degrees = attitude(ROUND, "ahead", np.random.default_rng(1))
    for zero in (0.0, 90.0):
        anticlockwise = np.radians(degrees * [1, 1, -1] + [0, 0, zero])
        assert check_yaw(ROUND, anticlockwise, np.eye(3)).convention == "anticlockwise"
    corner = FLOWN["corner"]
    other = np.radians(attitude(corner, "ahead", np.random.default_rng(1)) * [1, 1, -1])
    assert check_yaw(corner, other, np.eye(3)) is None


def test_angle_above_2_pi_rules_out_radians():
    """Both sides of the limit are tested: one epoch of a lawnmower flight has a yaw of 2π or of 6.5."""
    radians = np.radians(attitude(FLOWN["lawnmower"], "ahead", np.random.default_rng(1)))
    for largest, found in ((2 * np.pi, True), (6.5, False)):
        radians[7, 2] = largest
        assert (check_yaw(FLOWN["lawnmower"], np.radians(radians), np.eye(3)) is not None) is found


def courses(kind, generator):
    """Return courses (deg), each flown for four seconds."""
    first = generator.uniform(0, 360)
    return {
        "legs": generator.uniform(0, 360, generator.integers(2, 12)),
        "circle": first + np.arange(0, 361, 15) * generator.choice([-1, 1]),
        "lawnmower": first + np.array([0, 90, 180, 90] * 4),
        "wandering": np.cumsum(generator.normal(0, 30, 30)),
        "straight": np.array([first]),
    }[kind]


@pytest.mark.slow
def test_random_flights_have_no_false_and_few_missed_yaw_faults():
    """Of 4000 flights, radians are detected in 9 of 10 with yaw along their turns and 7 of 10 straight flights."""
    generator, detections = np.random.default_rng(0), {}
    for _ in range(4000):
        kind = generator.choice(["legs", "circle", "lawnmower", "straight", "wandering"])
        policy = generator.choice(["ahead", "sideways", "backwards", "held", "at a target"])
        place_m = mapped(courses(kind, generator), 4.0)
        degrees = attitude(place_m, policy, generator)
        if policy == "held":
            degrees[:, 2] += generator.uniform(-5, 5) - degrees[0, 2] * (generator.random() < 0.5)
        assert check_yaw(place_m, np.radians(degrees), np.eye(3)) is None
        fault = check_yaw(place_m, np.radians(np.radians(degrees)), np.eye(3))
        group = "turned" if kind != "straight" and policy in {"ahead", "sideways", "backwards"} else f"{kind} {policy}"
        detections.setdefault(group, []).append(fault is not None and fault.convention == "in radians")
    assert np.mean(detections["turned"]) > 0.9
    assert np.mean(detections["straight ahead"]) > 0.7


# Hovers


def _flown(*parts: tuple[float, float], interval_s: float = 0.05):
    """Return times and positions for flight parts (duration, speed), with log noise of 1 cm."""
    speed = np.concatenate([np.full(round(duration_s / interval_s), speed) for duration_s, speed in parts])
    east = np.cumsum(speed) * interval_s
    noise = 0.01 * np.random.default_rng(1).standard_normal((len(east), 3))
    return interval_s * np.arange(len(east)), np.stack([east, 0 * east, 0 * east], -1) + noise


def test_hover_inside_a_flight_is_found_to_a_second():
    time_s, leg = _flown((30, 0.5), (30, 0.0), (30, 0.5))
    is_hovering = hovering(time_s, (leg, leg))
    assert abs(time_s[is_hovering].min() - 30) < 1
    assert abs(time_s[is_hovering].max() - 60) < 1
    assert is_hovering[(time_s > 31) & (time_s < 59)].all()


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
def test_pulses_outside_hovers_are_kept(parts):
    time_s, leg = _flown(*parts)
    assert not hovering(time_s, (leg, leg)).any()


def test_pair_with_one_flying_node_does_not_hover():
    time_s, leg = _flown((60, 0.5))
    still = np.zeros_like(leg)
    assert not hovering(time_s, (still, leg)).any()
