"""Geometry of an aperture: paths, their gradients and rates, the resolution cell, blocks of pulses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from properties import tried
from scenes import WAVELENGTH, ground_points, monostatic, straight_track

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.geometry.aperture import Aperture

COORDINATES = st.floats(-1e4, 1e4, allow_subnormal=False)
LEGS = st.integers(1, 6).flatmap(lambda pulses: st.tuples(*[arrays(np.float64, (pulses, 3), elements=COORDINATES)] * 2))
POINTS = arrays(np.float64, (4, 3), elements=COORDINATES)
NANOMETRES = 1e-9 * 50


def at(places):
    return np.array(places, np.float64)


# Paths


@tried(100, derandomize=False)
@given(legs=LEGS, points=POINTS)
def test_path_is_symmetric_in_transmitter_and_receiver(legs, points):
    np.testing.assert_array_equal(Aperture(*legs).path(points), Aperture(*reversed(legs)).path(points))


@tried(100, derandomize=False)
@given(legs=LEGS, points=POINTS)
def test_path_obeys_the_triangle_inequality(legs, points):
    path = Aperture(*legs).path(points)
    baseline = np.linalg.norm(legs[0] - legs[1], axis=1)
    assert (path >= baseline[:, None] - NANOMETRES).all()
    distance = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert (np.abs(np.diff(path, axis=1)) <= 2 * distance + NANOMETRES).all()


@tried(100, derandomize=False)
@given(legs=LEGS, points=POINTS, shift=arrays(np.float64, 3, elements=COORDINATES), seed=st.integers(0, 2**32 - 1))
def test_paths_are_invariant_to_rigid_motion(legs, points, shift, seed):
    rotation = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    transformed = [part @ rotation.T + shift for part in (*legs, points)]
    np.testing.assert_allclose(
        Aperture(*transformed[:2]).path(transformed[2]), Aperture(*legs).path(points), atol=NANOMETRES
    )


def test_path_of_points_on_the_baseline_is_its_length():
    flown = Aperture(at([[0, 0, 0]]), at([[6, 8, 0]]))
    np.testing.assert_allclose(flown.path(at([[0, 0, 0], [3, 4, 0], [6, 8, 0]])), [[10, 10, 10]])


def test_pulse_axis_precedes_axes_of_points():
    flown = Aperture(straight_track(7), straight_track(7) + [1.0, 0, 0])
    points = ground_points(count=3)
    assert flown.path(points).shape == (7, 3, 3)
    assert flown.path_gradient(points).shape == (7, 3, 3, 3)
    np.testing.assert_array_equal(flown.path(points)[4, 1, 2], flown[4:5].path(points[1, 2])[0])


def test_path_gradient_matches_finite_differences():
    flown = Aperture(straight_track(20, wobble_m=0.3), straight_track(20) + [3.0, -2.0, 1.0])
    points, step = ground_points().reshape(-1, 3), 1e-4
    shifted = [flown.path(points + side * step * axis) for axis in np.eye(3) for side in (1, -1)]
    differences = np.stack(
        [(after - before) / (2 * step) for after, before in zip(shifted[::2], shifted[1::2], strict=True)], -1
    )
    gradient = flown.path_gradient(points)
    np.testing.assert_allclose(gradient, differences, atol=1e-8)
    assert np.abs(gradient).max() > 0.5


def test_phase_centres_of_different_shapes_are_rejected():
    for tx, rx in (
        (np.zeros((4, 3)), np.zeros((5, 3))),
        (np.zeros((4, 2)), np.zeros((4, 2))),
        (np.zeros(3), np.zeros(3)),
    ):
        with pytest.raises(ValueError, match=r"expected phase centres of the same number of pulses, \(pulse, 3\) each"):
            Aperture(tx, rx)


# Pulses


@tried(100, derandomize=False)
@given(pulses=st.integers(0, 400), count=st.integers(1, 60))
def test_blocks_partition_the_pulses_evenly(pulses, count):
    track = np.zeros((pulses, 3))
    blocks = Aperture(track, track).blocks(count)
    assert len(blocks) == count
    assert [pulse for block in blocks for pulse in range(pulses)[block]] == list(range(pulses))
    lengths = [block.stop - block.start for block in blocks]
    assert max(lengths) - min(lengths) <= 1


@tried(100, derandomize=False)
@given(pulses=st.integers(1, 2000), most=st.integers(1, 300))
def test_sample_is_spread_evenly_over_the_aperture(pulses, most):
    track = straight_track(pulses)
    flown = monostatic(track)
    sample = flown[flown.sample(most)]
    assert min(pulses, most) <= len(sample) < 2 * most
    np.testing.assert_array_equal(sample.tx_m[0], track[0])
    assert len(set(np.diff(np.arange(pulses)[flown.sample(most)]))) <= 1


def test_subaperture_has_the_paths_of_its_pulses():
    flown = Aperture(straight_track(9), straight_track(9) + [1.0, 0, 0])
    points, odd = ground_points(count=2), np.arange(9) % 2 == 1
    for part in (slice(2, 7, 2), odd, np.array([8, 0])):
        np.testing.assert_array_equal(flown[part].path(points), flown.path(points)[part])
    assert np.shares_memory(flown[2:5].tx_m, flown.tx_m)


# Phase rates


def test_phase_rates_match_a_passing_antenna():
    """The rates of two points at ±θ from broadside differ by 2·2·sin θ·step/λ cycles per pulse."""
    step, angle = 0.02, np.radians(20)
    antenna = np.array([[-step / 2, 0.0, 0.0], [step / 2, 0.0, 0.0]])
    places = 50 * np.array([[np.sin(a), np.cos(a), 0] for a in (-angle, 0, angle)])
    spread, widest = monostatic(antenna).phase_rates(places, wavelength_m=WAVELENGTH)
    assert spread == pytest.approx(4 * np.sin(angle) * step / WAVELENGTH, rel=1e-4)
    assert widest == pytest.approx(spread / 2, rel=1e-4)


@pytest.mark.parametrize("fast", [0, 230, 520])
def test_fastest_part_determines_the_rate_spread(fast):
    steps = np.full(600, 0.01)
    steps[fast : fast + 70] = 0.1
    track = np.stack([np.cumsum(steps), np.zeros(600), np.full(600, 10.0)], -1)
    points = ground_points().reshape(-1, 3)
    spread, _ = monostatic(track).phase_rates(points, wavelength_m=WAVELENGTH)
    rate = np.ptp(np.diff(monostatic(track).path(points), axis=0), axis=1) / WAVELENGTH
    assert spread == pytest.approx(rate.max(), rel=0.05)
    assert spread > 5 * np.median(rate)


@pytest.mark.parametrize("jump", [0, 100, 255, 256, 257, 598])
def test_largest_rate_is_found_anywhere_in_a_long_aperture(jump):
    """The track has a jump between any two pulses, also at the boundary between blocks of pulses."""
    track = straight_track(600)
    track[jump + 1 :, 0] += 1.0
    points = ground_points().reshape(-1, 3)
    _, widest = monostatic(track).phase_rates(points, wavelength_m=WAVELENGTH)
    rate = np.diff(monostatic(track).path(points), axis=0) / WAVELENGTH
    assert widest == pytest.approx(np.abs(rate - rate[:, [12]]).max(), rel=1e-12)
    assert np.ptp(rate, axis=1).argmax() == jump


# Resolution


@pytest.mark.parametrize("apart_m", [0.0, 2.0])
def test_azimuth_resolution_follows_the_integration_angle(apart_m):
    """δ = λ/(4 sin(θ/2)) with sin(θ/2) = (L/2)/√((L/2)² + R²); antennas in a line have nearly equal angles."""
    length, height, north = 6.0, 10.0, 20.0
    track = straight_track(64, length_m=length, height_m=height)
    ground = ground_points(1e-3, north_m=north)
    half = length / 2 / np.hypot(length / 2, np.hypot(height, north))
    shift = np.array([apart_m / 2, 0, 0])
    cell = Aperture(track - shift, track + shift).resolution_cell_m(ground, band_hz=(1.2e9, 1.2e9))
    assert cell == pytest.approx(WAVELENGTH / (4 * half), rel=1e-3 if apart_m == 0 else 2e-2)


def test_resolution_of_a_stationary_antenna_is_its_ground_range_cell():
    """The resolution is δ = c/(2B)·R/r_g."""
    track = np.tile([0.0, 0.0, 10.0], (64, 1))
    ground = ground_points(1e-3, north_m=20.0)
    cell = monostatic(track).resolution_cell_m(ground, band_hz=(1.0e9, 1.4e9))
    assert cell == pytest.approx(C / 800e6 * np.hypot(10, 20) / 20, rel=1e-3)


def test_doubled_aperture_halves_the_resolution_cell():
    ground = ground_points(1e-3)
    cells = [
        monostatic(straight_track(64, length_m=length)).resolution_cell_m(ground, band_hz=(1.19e9, 1.21e9))
        for length in (0.5, 1.0, 2.0)
    ]
    np.testing.assert_allclose(np.divide(cells[:-1], cells[1:]), 2, rtol=0.01)


# Straightness


@tried(100, derandomize=False)
@given(start=arrays(np.float64, 3, elements=COORDINATES), heading=st.floats(0, 6.28), climb=st.floats(-1, 1))
def test_straight_flight_has_no_wobble(start, heading, climb):
    along = np.linspace(0, 30, 50)[:, None] * [np.cos(heading), np.sin(heading), climb]
    assert monostatic(start + along).wobble_m < 1e-9


def test_wobble_is_that_of_the_midpoints():
    """If the antennas move in opposite directions, their midpoint remains on the line."""
    track, sway = straight_track(100), np.zeros((100, 3))
    sway[:, 1] = np.sin(np.arange(100))
    assert Aperture(track + sway, track - sway).wobble_m == pytest.approx(0, abs=1e-12)
    assert Aperture(track + sway, track + sway).wobble_m == pytest.approx(np.sqrt(0.5), rel=0.01)
