"""Residual track between two flights: phases from the paths themselves, estimate, robustness, wraps and limits."""

from dataclasses import replace

import numpy as np
import pytest

from apertura.common.flag_table import FLAGS
from apertura.methods.autofocus.inputs import TrackErrors
from apertura.methods.stack.limits import (
    EXCLUDED_RESIDUAL_RAD,
    LEAST_COHERENT,
    LEAST_STABLE,
    MOST_LOSS,
    MOST_RESIDUAL_RAD,
    MOST_SPREAD_RAD,
    FlightFit,
)
from apertura.methods.stack.residual_motion import (
    LEAST_WINDOWS,
    ResidualTracks,
    SeenAntenna,
    WindowPhases,
    estimate_motion,
)

WAVENUMBER = 2 * np.pi * 1.4e9 / 299_792_458
MM = 1e3 / (2 * WAVENUMBER)  # displacement towards the antenna per phase, mm/rad
TIME_S = np.linspace(0.0, 10.0, 65)
EAST, NORTH = (side.ravel() for side in np.meshgrid(np.arange(-10.0, 10.1, 1.0), np.arange(-10.0, 10.1, 1.0)))
PLACES = np.column_stack([EAST, NORTH, np.zeros(len(EAST))])
SLOPE = (np.abs(EAST - 5) < 2.6) & (np.abs(NORTH - 4) < 2.6)
CHANGES = {
    "none": lambda time: 0 * time,
    "constant": lambda time: 1 + 0 * time,
    "slope": lambda time: time / 5,
    "slow": lambda time: np.sin(time / 3),
}


def antenna_m(ahead_m=0.0):
    """Return the logged positions of an antenna at the pulses, (pulse, 3)."""
    along = np.linspace(-3.0, 3.0, len(TIME_S)) + ahead_m
    return np.column_stack([along, np.full(len(TIME_S), -25.0), np.full(len(TIME_S), 25.0)])


def seen(node, logged_m):
    """Return an antenna that is seen by all places over the whole flight."""
    shape = (len(PLACES), len(TIME_S))
    return SeenAntenna(node, np.broadcast_to(logged_m, (*shape, 3)), np.broadcast_to(TIME_S, shape))


def true_phase(legs, error_m):
    """Return k times the mean of logged minus true path, from the lengths of the paths themselves."""
    change = 0.0
    for logged_m in legs:
        lengths = [np.linalg.norm(PLACES[:, None] - positions, axis=-1) for positions in (logged_m, logged_m - error_m)]
        change = change + lengths[0] - lengths[1]
    return WAVENUMBER * change.mean(axis=1)


def error_of(change, direction=(0.4, -0.6, 0.7), size_m=0.014):
    """Return logged minus true positions, (pulse, 3)."""
    return size_m * np.outer(CHANGES[change](TIME_S), direction)


def tracks_of(legs, std_m=0.014):
    """Return antennas and residual tracks of a monostatic or bistatic pair."""
    nodes = ["uav1", "uav2"][: len(legs)]
    antennas = [seen(nodes[min(number, len(nodes) - 1)], leg) for number, leg in enumerate(legs)]
    errors = {node: TrackErrors((std_m,) * 3, 3.0) for node in nodes}
    return ResidualTracks.of(errors, np.eye(3), antennas, WAVENUMBER), antennas


def estimated(phase_rad, *, std_m=0.014, noise_rad=0.05, seed=0, radius_m=0.05):
    """Return the estimate from noisy phases of monostatic windows, and the phases minus the model."""
    leg = antenna_m()
    tracks, _ = tracks_of([leg], std_m)
    antennas = [seen("uav1", leg)] * 2
    noise = np.random.default_rng(seed).normal(size=len(PLACES)) * noise_rad
    phases = WindowPhases(np.exp(1j * (phase_rad + noise)), NORTH, EAST, np.full(len(PLACES), noise_rad))
    design, constants = tracks.phase(PLACES, antennas), tracks.constant_phase(PLACES, antennas)
    motion = estimate_motion(phases, design, constants, radius_m=radius_m)
    model = design @ motion.unknowns + motion.constant_rad
    return motion, np.angle(np.exp(1j * (phase_rad - model)))


@pytest.mark.parametrize("bistatic", [False, True])
def test_phase_of_a_residual_track_is_that_of_the_mean_path_change(bistatic):
    legs = [antenna_m(), antenna_m(4.0)] if bistatic else [antenna_m()]
    tracks, antennas = tracks_of(legs)
    unknowns = np.random.default_rng(1).normal(size=tracks.prior.size)
    moved = tracks.prior.tracks(unknowns)
    expected = 0.0
    for antenna, leg in zip(antennas, legs, strict=True):
        error_m = np.stack([np.interp(TIME_S, tracks.knots_s, axis) for axis in moved[antenna.node].T], axis=-1)
        expected = expected + true_phase([leg], error_m)
    assert tracks.phase(PLACES, antennas) @ unknowns == pytest.approx(expected, abs=0.01)
    assert np.ptp(expected) > 0.1  # far above the tolerance


@pytest.mark.parametrize("change", CHANGES)
def test_residual_track_is_removed(change):
    phase = true_phase([antenna_m()] * 2, error_of(change)) + 0.7
    motion, left = estimated(phase)
    assert motion.stable_fraction > 0.98
    assert np.abs(left).max() < 0.06
    assert motion.std_rad == pytest.approx(0.05, rel=0.15)
    assert (np.ptp(phase) > 0.1) == (change != "none")


@pytest.mark.parametrize("motion_mm", [0.0, 1.0, 3.0, 12.0])
def test_slope_that_moves_is_not_absorbed(motion_mm):
    phase = true_phase([antenna_m()] * 2, error_of("slow")) + SLOPE * motion_mm / MM
    motion, left = estimated(phase)
    assert np.abs(left[~SLOPE]).max() * MM < 1.0
    assert left[SLOPE].mean() * MM == pytest.approx(motion_mm, abs=0.5)
    assert motion.stable[~SLOPE].mean() > 0.98
    assert motion.stable[SLOPE].any() == (motion_mm < 5)


def test_residual_track_of_several_cycles_is_found():
    phase = true_phase([antenna_m()] * 2, error_of("constant", size_m=0.5))
    assert np.ptp(phase) > 2 * np.pi
    motion, left = estimated(phase, std_m=0.3, radius_m=0.8)
    assert motion.stable_fraction > 0.98
    assert np.abs(left).max() < 0.06


def test_prior_is_widened_if_the_logs_are_worse_than_stated():
    phase = true_phase([antenna_m()] * 2, error_of("constant", size_m=0.05))
    worse, left = estimated(phase, std_m=0.003, radius_m=0.05)
    assert worse.scale > 3
    assert np.abs(left).max() < 0.1
    assert estimated(phase, std_m=0.05)[0].scale < 3


def test_too_few_windows_are_refused():
    few = WindowPhases(*(np.ones(LEAST_WINDOWS - 1) for _ in range(4)))
    with pytest.raises(ValueError, match="11 coherent windows; at least 12"):
        estimate_motion(few, np.ones((11, 3)), np.ones((11, 3)), radius_m=0.1)


def test_window_of_a_bright_point_is_placed_at_the_point():
    generator = np.random.default_rng(3)
    image = (generator.normal(size=(32, 32)) + 1j * generator.normal(size=(32, 32))).astype(np.complex64)
    image[3, 12] = 200.0
    phases = WindowPhases.of(image, image, np.ones((32, 32), bool), window=16, looks=60.0)
    assert (phases.row[0], phases.column[0]) == pytest.approx((3, 12), abs=0.2)
    assert (phases.row[3], phases.column[3]) == pytest.approx((23.5, 23.5), abs=1.0)


def test_incoherent_windows_are_left_out():
    generator = np.random.default_rng(4)
    first, second = (
        (generator.normal(size=(32, 32)) + 1j * generator.normal(size=(32, 32))).astype(np.complex64) for _ in range(2)
    )
    second[:16, :16] = first[:16, :16]
    phases = WindowPhases.of(first, second, np.ones((32, 32), bool), window=16, looks=60.0)
    assert len(phases) == 1
    assert phases.row[0] < 16


FITTING = FlightFit(0.1, 0.1, 0.9, 0.95, 1.0, 1.0, 200)


@pytest.mark.parametrize(
    ("flag", "field", "limit", "sign"),
    [
        ("stack_residual_phase", "residual_rad", MOST_RESIDUAL_RAD, 1),
        ("stack_flight_excluded", "residual_rad", EXCLUDED_RESIDUAL_RAD, 1),
        ("stack_motion_defocuses", "spread_rad", MOST_SPREAD_RAD, 1),
        ("stack_decorrelated", "coherence", FITTING.expected - MOST_LOSS, -1),
        ("stack_flight_excluded", "coherent", LEAST_COHERENT, -1),
        ("stack_flight_excluded", "stable", LEAST_STABLE, -1),
    ],
)
def test_flags_are_raised_beyond_their_limits_only(flag, field, limit, sign):
    assert flag in FLAGS
    assert flag not in replace(FITTING, **{field: limit - sign * 0.01}).flags
    beyond = replace(FITTING, **{field: limit + sign * 0.01})
    assert flag in beyond.flags
    assert (beyond.reason is not None) == (flag == "stack_flight_excluded")


def test_flight_without_an_estimate_is_left_out_with_its_reason():
    failed = replace(FITTING, residual_rad=np.inf, failure="3 windows of significant coherence, less than 12")
    assert failed.flags == {"stack_flight_excluded": failed.failure}
