"""Cross-sections of reflectors against closed forms, and constants of several of them together."""

import numpy as np
import pytest

from apertura.core.imaging.reflectors import Reflector, together

WAVELENGTH_M = 0.2
AXES = np.eye(3)
AHEAD = np.array([[0.0, 0.0, 1.0]])


def towards(azimuth_deg, elevation_deg=0.0):
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    level = np.cos(elevation)
    return np.array([[level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)]])


def rcs(shape, size_m, tx=AHEAD, rx=None):
    (found,), (std_db,) = Reflector(shape, size_m, AXES).cross_section(
        tx, tx if rx is None else rx, wavelength_m=WAVELENGTH_M
    )
    return found, std_db


def test_on_the_boresight_corners_have_their_textbook_cross_sections():
    """Skolnik; Knott, Shaeffer and Tuley: 4πa⁴/3λ² of triangles, 8πa²b²/λ² of rectangles."""
    assert rcs("trihedral", (0.7,))[0] == pytest.approx(4 * np.pi * 0.7**4 / (3 * WAVELENGTH_M**2))
    assert rcs("dihedral", (0.5, 0.8))[0] == pytest.approx(8 * np.pi * 0.5**2 * 0.8**2 / WAVELENGTH_M**2)


def test_a_trihedral_is_half_as_strong_20_degrees_off_and_wider_towards_a_plate():
    """Robertson 1947: 40° between half powers of the triangular corner; seen along a plate it returns nothing."""
    edges = [
        10 * np.log10(rcs("trihedral", (1.0,), towards(side))[0] / rcs("trihedral", (1.0,))[0]) for side in (-20, 20)
    ]
    assert edges == pytest.approx([-3, -3], abs=0.6)
    assert rcs("trihedral", (1.0,), towards(0, -36))[0] == 0  # below the plate that lies 35.26° down
    assert rcs("trihedral", (1.0,), towards(0, -35))[0] < 0.01 * rcs("trihedral", (1.0,))[0]


def flat_area(direction, leg_m=1.0, count=400):
    """Area of a triangular corner's aperture that is inside after reflection in its vertex too, by counting."""
    cosines = np.abs(direction)
    seams = np.eye(3) * leg_m
    first = np.cross(cosines, [0.3, -0.5, 0.9])
    first /= np.linalg.norm(first)
    plane = np.stack([first, np.cross(cosines, first)])
    corners = seams @ plane.T
    x, y = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-1.2, 1.2, count) * leg_m] * 2))

    def inside(x, y):
        turns = [
            (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
            for a, b in ((corners[i], corners[(i + 1) % 3]) for i in range(3))
        ]
        return np.all(np.array(turns) >= 0, axis=0) | np.all(np.array(turns) <= 0, axis=0)

    return (inside(x, y) & inside(-x, -y)).mean() * (2.4 * leg_m) ** 2


@pytest.mark.parametrize("cosines", [(1, 1, 1), (1, 2, 3), (0.5, 1, 4), (1, 1.4, 1.2)])
def test_a_trihedral_returns_what_enters_and_leaves_its_aperture(cosines):
    """Both cases of the closed form: the aperture and its image in the vertex, counted on a lattice."""
    cosines = np.array(cosines) / np.linalg.norm(cosines)
    seams = np.array([[3**0.5, -1, 2**0.5], [-(3**0.5), -1, 2**0.5], [0, 2, 2**0.5]]) / 6**0.5
    found, _ = rcs("trihedral", (1.0,), (cosines @ seams)[None])
    area = np.sqrt(found * WAVELENGTH_M**2 / (4 * np.pi))
    assert area == pytest.approx(flat_area(cosines), rel=0.02)


def test_a_second_antenna_beside_the_first_loses_what_the_aperture_does():
    """Second order against the diffraction of the hexagon on the boresight; beyond 1 dB nothing is said."""
    leg_m, half_deg = 0.6, 2.4
    found, std_db = rcs("trihedral", (leg_m,), towards(-half_deg), towards(half_deg))
    alone, alone_db = rcs("trihedral", (leg_m,))
    side_m = leg_m * np.sqrt(2) / 3
    x, y = np.meshgrid(*[np.linspace(-side_m, side_m, 401)] * 2)
    hexagon = (np.abs(x) <= side_m * np.sqrt(3) / 2) & (np.abs(y) <= side_m - np.abs(x) / np.sqrt(3))
    shift = 2 * np.pi / WAVELENGTH_M * 2 * np.sin(np.radians(half_deg))
    lost_db = -20 * np.log10(np.exp(1j * shift * x)[hexagon].mean().real)
    assert 0.3 < lost_db < 1
    assert 10 * np.log10(alone / found) == pytest.approx(lost_db, rel=0.1)
    assert std_db > np.hypot(lost_db, 0.9 * alone_db)
    assert np.isnan(rcs("trihedral", (leg_m,), towards(-2 * half_deg), towards(2 * half_deg))[0])


def test_a_dihedral_is_narrow_along_its_seam_and_wide_across():
    """First null along the seam at asin(λ/2b); across it falls as the sine of what is left of 45°."""
    size_m = (0.5, 1.0)
    best, null_deg = rcs("dihedral", size_m)[0], np.degrees(np.arcsin(WAVELENGTH_M / 2))
    assert rcs("dihedral", size_m, towards(null_deg))[0] < 1e-6 * best
    half_deg = np.degrees(np.arcsin(WAVELENGTH_M / 4))
    assert rcs("dihedral", size_m, towards(half_deg))[0] / best == pytest.approx((2 / np.pi) ** 2, rel=0.01)
    assert rcs("dihedral", size_m, towards(0, 15))[0] / best == pytest.approx(2 * np.sin(np.radians(30)) ** 2)
    assert rcs("dihedral", size_m, towards(0, 46))[0] == 0


def test_antennas_apart_lose_across_a_dihedral_and_along_its_seam_are_what_its_length_makes_of_them():
    """Across: the second order of the sinc of its width; along: specular, so nothing where both lie alike aside."""
    size_m, best = (0.3, 1.0), rcs("dihedral", (0.3, 1.0))[0]
    shift = np.pi / WAVELENGTH_M * 2 * np.sin(np.radians(3)) * 2 * 0.3 * np.sin(np.pi / 4)
    across, _ = rcs("dihedral", size_m, towards(0, -3), towards(0, 3))
    assert np.sqrt(across / best) == pytest.approx(np.sin(shift) / shift, rel=5e-3)
    assert np.sqrt(across / best) < 0.95
    assert rcs("dihedral", size_m, towards(-4), towards(4))[0] == pytest.approx(best)


def test_spheres_are_those_of_rayleigh_of_resonance_and_of_optics():
    """9(ka)⁴ where small, 3.65 where ka is 1, 1 where large, of πa²: Ruck, fig. 3-2."""
    radius = np.array([0.05, 1.03, 60.0]) * WAVELENGTH_M / (2 * np.pi)
    shares = [rcs("sphere", (one,))[0] / (np.pi * one**2) for one in radius]
    assert shares[0] == pytest.approx(9 * 0.05**4, rel=0.01)
    assert shares[1] == pytest.approx(3.65, abs=0.02)
    assert shares[2] == pytest.approx(1, abs=0.01)


def test_a_sphere_beside_the_wave_depends_on_polarisation():
    back, aside = rcs("sphere", (0.2,)), rcs("sphere", (0.2,), AHEAD, towards(40))
    assert back[1] == pytest.approx(0, abs=1e-9)
    assert aside[1] > 0.2


def test_small_corners_are_less_certain():
    """An edge at normal incidence returns L²/π, whatever the wavelength."""
    large, small = (rcs("trihedral", (leg,))[1] for leg in (2.0, 0.4))
    assert small == pytest.approx(5 * large)
    assert small == pytest.approx(20 / np.log(10) * np.sqrt(2 * 0.4**2 / np.pi / rcs("trihedral", (0.4,))[0] / 2))


def test_what_pulses_see_is_the_mean_of_amplitudes():
    aside = towards(0, 20)
    both = np.concatenate([AHEAD, aside])
    seen, _ = Reflector("trihedral", (1.0,), AXES).seen(both, both, np.array([3.0, 1.0]), np.array([1.49896229e9] * 2))
    roots = [np.sqrt(rcs("trihedral", (1.0,), one)[0]) for one in (AHEAD, aside)]
    assert seen == pytest.approx(((3 * roots[0] + roots[1]) / 4) ** 2, rel=1e-6)


def test_pulses_that_do_not_count_do_not_forbid_a_reflector():
    """Out of the beam the antennas may be as far apart as they like."""
    tx, rx = np.concatenate([AHEAD, towards(-9)]), np.concatenate([AHEAD, towards(9)])
    corner, frequency = Reflector("trihedral", (1.0,), AXES), np.array([1.49896229e9] * 2)
    assert corner.seen(tx, rx, np.array([1.0, 0.0]), frequency)[0] == pytest.approx(rcs("trihedral", (1.0,))[0])
    assert np.isnan(corner.seen(tx, rx, np.array([1.0, 0.1]), frequency)[0])


def test_flights_over_one_reflector_do_not_lessen_its_own_error():
    mean = together(np.full(8, 60.0), np.full(8, 0.2), np.full(8, 0.5), ["r"] * 8, [f"f{n}" for n in range(8)])
    assert mean.std == pytest.approx(np.hypot(0.5, 0.2 / 8**0.5))
    assert (mean.value, mean.freedom, mean.chance) == (60.0, 0, 1.0)


def test_reflectors_lessen_each_others_errors_and_those_that_disagree_widen_them():
    """Birge: the deviation grows by the root of chi square per degree of freedom."""
    names, one = ["a", "b", "c", "d"], ["f01"] * 4
    agreed = together(np.array([59.7, 60.1, 60.3, 59.9]), np.full(4, 0.3), np.full(4, 0.4), names, one)
    assert agreed.std == pytest.approx(0.25)
    assert agreed.chance > 0.5
    apart = together(np.array([57.0, 63.0, 57.0, 63.0]), np.full(4, 0.3), np.full(4, 0.4), names, one)
    assert apart.chi2 == pytest.approx(4 * 9 / 0.25)
    assert apart.std == pytest.approx(0.25 * np.sqrt(apart.chi2 / 3))
    assert apart.chance < 1e-6


def test_the_mean_has_the_scatter_that_it_states():
    """Drawn: 400 calibrations with three reflectors in two flights; 95 % lie within 1.96 deviations."""
    draw, off = np.random.default_rng(1), []
    names, flights = ["a", "a", "b", "b", "c", "c"], ["f01", "f02"] * 3
    for _ in range(400):
        own = np.repeat(draw.normal(0, 0.5, 3), 2)
        found = together(own + draw.normal(0, 0.2, 6), np.full(6, 0.2), np.full(6, 0.5), names, flights)
        off.append(abs(found.value) / found.std)
    assert 0.93 < np.mean(np.array(off) < 1.96) <= 1


@pytest.mark.parametrize(("moved", "drifts"), [(0.59, False), (0.61, True)])
def test_a_drift_is_more_than_three_deviations_of_the_scatter_alone(moved, drifts):
    """Two reflectors, 0.2 dB of scatter: a difference of flights scatters by 0.2 dB·√2/√2; 2 dB of each cancel."""
    value = np.array([61.0, 59.0, 61.0, 59.0]) + np.array([0, 0, moved, moved])
    found = together(value, np.full(4, 0.2), np.full(4, 2.0), ["a", "b", "a", "b"], ["f01", "f01", "f02", "f02"])
    assert found.drift[:2] == ("f01", "f02")
    assert found.drift[3] == pytest.approx(0.2)
    assert found.drifts is drifts


def test_flights_without_a_reflector_in_common_are_not_compared():
    found = together(np.array([60.0, 70.0]), np.full(2, 0.1), np.full(2, 0.1), ["a", "b"], ["f01", "f02"])
    assert found.drift is None
    assert found.chance < 1e-6
