"""Cross-sections of reflectors against closed forms, and calibration constants from several reflectors."""

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
    (sigma_m2,), (std_db,) = Reflector(shape, size_m, AXES).cross_section(
        tx, tx if rx is None else rx, wavelength_m=WAVELENGTH_M
    )
    return sigma_m2, std_db


def test_corners_have_textbook_cross_sections_on_the_boresight():
    """By Skolnik and by Knott, Shaeffer and Tuley: 4πa⁴/3λ² for triangles, 8πa²b²/λ² for rectangles."""
    assert rcs("trihedral", (0.7,))[0] == pytest.approx(4 * np.pi * 0.7**4 / (3 * WAVELENGTH_M**2))
    assert rcs("dihedral", (0.5, 0.8))[0] == pytest.approx(8 * np.pi * 0.5**2 * 0.8**2 / WAVELENGTH_M**2)


def test_trihedral_is_3_db_down_at_20_degrees_and_zero_along_a_plate():
    """By Robertson (1947), the half-power width of the triangular corner is 40°; there is no return along a plate."""
    edges = [
        10 * np.log10(rcs("trihedral", (1.0,), towards(side))[0] / rcs("trihedral", (1.0,))[0]) for side in (-20, 20)
    ]
    assert edges == pytest.approx([-3, -3], abs=0.6)
    assert rcs("trihedral", (1.0,), towards(0, -36))[0] == 0  # below the plate, which is 35.26° down
    assert rcs("trihedral", (1.0,), towards(0, -35))[0] < 0.01 * rcs("trihedral", (1.0,))[0]


def effective_area(direction, leg_m=1.0, count=400):
    """Return the area common to the aperture of a triangular corner and its reflection in the vertex, by counting."""
    cosines = np.abs(direction)
    seams = np.eye(3) * leg_m
    first = np.cross(cosines, [0.3, -0.5, 0.9])
    first /= np.linalg.norm(first)
    plane = np.stack([first, np.cross(cosines, first)])
    corners = seams @ plane.T
    x, y = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-1.2, 1.2, count) * leg_m] * 2))

    def inside(x, y):
        cross_products = [
            (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
            for a, b in ((corners[i], corners[(i + 1) % 3]) for i in range(3))
        ]
        return np.all(np.array(cross_products) >= 0, axis=0) | np.all(np.array(cross_products) <= 0, axis=0)

    return (inside(x, y) & inside(-x, -y)).mean() * (2.4 * leg_m) ** 2


@pytest.mark.parametrize("cosines", [(1, 1, 1), (1, 2, 3), (0.5, 1, 4), (1, 1.4, 1.2)])
def test_trihedral_cross_section_follows_from_its_effective_aperture(cosines):
    """Both cases of the closed form equal the area common to aperture and reflection, counted on a lattice."""
    cosines = np.array(cosines) / np.linalg.norm(cosines)
    seams = np.array([[3**0.5, -1, 2**0.5], [-(3**0.5), -1, 2**0.5], [0, 2, 2**0.5]]) / 6**0.5
    sigma_m2, _ = rcs("trihedral", (1.0,), (cosines @ seams)[None])
    area = np.sqrt(sigma_m2 * WAVELENGTH_M**2 / (4 * np.pi))
    assert area == pytest.approx(effective_area(cosines), rel=0.02)


def test_bistatic_trihedral_loss_equals_the_aperture_diffraction_loss():
    """The second-order model agrees with the diffraction of the hexagonal aperture; it is undefined beyond 1 dB."""
    leg_m, half_deg = 0.6, 2.4
    bistatic, std_db = rcs("trihedral", (leg_m,), towards(-half_deg), towards(half_deg))
    monostatic, monostatic_std_db = rcs("trihedral", (leg_m,))
    side_m = leg_m * np.sqrt(2) / 3
    x, y = np.meshgrid(*[np.linspace(-side_m, side_m, 401)] * 2)
    hexagon = (np.abs(x) <= side_m * np.sqrt(3) / 2) & (np.abs(y) <= side_m - np.abs(x) / np.sqrt(3))
    shift = 2 * np.pi / WAVELENGTH_M * 2 * np.sin(np.radians(half_deg))
    loss_db = -20 * np.log10(np.exp(1j * shift * x)[hexagon].mean().real)
    assert 0.3 < loss_db < 1
    assert 10 * np.log10(monostatic / bistatic) == pytest.approx(loss_db, rel=0.1)
    assert std_db > np.hypot(loss_db, 0.9 * monostatic_std_db)
    assert np.isnan(rcs("trihedral", (leg_m,), towards(-2 * half_deg), towards(2 * half_deg))[0])


def test_dihedral_pattern_is_narrow_along_its_seam_and_wide_across():
    """The first null along the seam is at asin(λ/2b); across, the amplitude falls as sin(45° - angle)."""
    size_m = (0.5, 1.0)
    best, null_deg = rcs("dihedral", size_m)[0], np.degrees(np.arcsin(WAVELENGTH_M / 2))
    assert rcs("dihedral", size_m, towards(null_deg))[0] < 1e-6 * best
    half_deg = np.degrees(np.arcsin(WAVELENGTH_M / 4))
    assert rcs("dihedral", size_m, towards(half_deg))[0] / best == pytest.approx((2 / np.pi) ** 2, rel=0.01)
    assert rcs("dihedral", size_m, towards(0, 15))[0] / best == pytest.approx(2 * np.sin(np.radians(30)) ** 2)
    assert rcs("dihedral", size_m, towards(0, 46))[0] == 0


def test_bistatic_dihedral_loss_occurs_across_but_not_along_the_seam():
    """Across, the loss is that of a sinc to second order; along, it is zero (specular) for symmetric antennas."""
    size_m, best = (0.3, 1.0), rcs("dihedral", (0.3, 1.0))[0]
    shift = np.pi / WAVELENGTH_M * 2 * np.sin(np.radians(3)) * 2 * 0.3 * np.sin(np.pi / 4)
    across, _ = rcs("dihedral", size_m, towards(0, -3), towards(0, 3))
    assert np.sqrt(across / best) == pytest.approx(np.sin(shift) / shift, rel=5e-3)
    assert np.sqrt(across / best) < 0.95
    assert rcs("dihedral", size_m, towards(-4), towards(4))[0] == pytest.approx(best)


def test_sphere_matches_rayleigh_resonance_and_optical_limits():
    """Relative to πa², Ruck (fig. 3-2) states 9(ka)⁴ for small ka, 3.65 at ka = 1, and 1 for large ka."""
    radius = np.array([0.05, 1.03, 60.0]) * WAVELENGTH_M / (2 * np.pi)
    shares = [rcs("sphere", (a,))[0] / (np.pi * a**2) for a in radius]
    assert shares[0] == pytest.approx(9 * 0.05**4, rel=0.01)
    assert shares[1] == pytest.approx(3.65, abs=0.02)
    assert shares[2] == pytest.approx(1, abs=0.01)


def test_bistatic_sphere_depends_on_polarisation():
    back, bistatic = rcs("sphere", (0.2,)), rcs("sphere", (0.2,), AHEAD, towards(40))
    assert back[1] == pytest.approx(0, abs=1e-9)
    assert bistatic[1] > 0.2


def test_small_corners_have_a_larger_uncertainty():
    """An edge at normal incidence returns L²/π at any wavelength."""
    large, small = (rcs("trihedral", (leg,))[1] for leg in (2.0, 0.4))
    assert small == pytest.approx(5 * large)
    assert small == pytest.approx(20 / np.log(10) * np.sqrt(2 * 0.4**2 / np.pi / rcs("trihedral", (0.4,))[0] / 2))


def test_cross_section_over_pulses_is_the_mean_amplitude_squared():
    off_boresight = towards(0, 20)
    directions = np.concatenate([AHEAD, off_boresight])
    mean_m2, _ = Reflector("trihedral", (1.0,), AXES).seen(
        directions, directions, np.array([3.0, 1.0]), np.array([1.49896229e9] * 2)
    )
    roots = [np.sqrt(rcs("trihedral", (1.0,), direction)[0]) for direction in (AHEAD, off_boresight)]
    assert mean_m2 == pytest.approx(((3 * roots[0] + roots[1]) / 4) ** 2, rel=1e-6)


def test_pulses_of_zero_weight_do_not_exclude_a_reflector():
    """Outside the beam, the bistatic angle is not limited."""
    tx, rx = np.concatenate([AHEAD, towards(-9)]), np.concatenate([AHEAD, towards(9)])
    corner, frequency = Reflector("trihedral", (1.0,), AXES), np.array([1.49896229e9] * 2)
    assert corner.seen(tx, rx, np.array([1.0, 0.0]), frequency)[0] == pytest.approx(rcs("trihedral", (1.0,))[0])
    assert np.isnan(corner.seen(tx, rx, np.array([1.0, 0.1]), frequency)[0])


def test_flights_over_one_reflector_do_not_reduce_its_own_error():
    mean = together(np.full(8, 60.0), np.full(8, 0.2), np.full(8, 0.5), ["r"] * 8, [f"f{n}" for n in range(8)])
    assert mean.std == pytest.approx(np.hypot(0.5, 0.2 / 8**0.5))
    assert (mean.value, mean.freedom, mean.chance) == (60.0, 0, 1.0)


def test_several_reflectors_reduce_the_error_unless_they_disagree():
    """The deviation grows by the Birge ratio, the root of chi square per degree of freedom."""
    names, flights = ["a", "b", "c", "d"], ["f01"] * 4
    agreed = together(np.array([59.7, 60.1, 60.3, 59.9]), np.full(4, 0.3), np.full(4, 0.4), names, flights)
    assert agreed.std == pytest.approx(0.25)
    assert agreed.chance > 0.5
    disagreeing = together(np.array([57.0, 63.0, 57.0, 63.0]), np.full(4, 0.3), np.full(4, 0.4), names, flights)
    assert disagreeing.chi2 == pytest.approx(4 * 9 / 0.25)
    assert disagreeing.std == pytest.approx(0.25 * np.sqrt(disagreeing.chi2 / 3))
    assert disagreeing.chance < 1e-6


def test_mean_has_the_stated_deviation():
    """Of 400 drawn calibrations with three reflectors in two flights, 95 % are within 1.96 deviations."""
    draw, normalised = np.random.default_rng(1), []
    names, flights = ["a", "a", "b", "b", "c", "c"], ["f01", "f02"] * 3
    for _ in range(400):
        own = np.repeat(draw.normal(0, 0.5, 3), 2)
        mean = together(own + draw.normal(0, 0.2, 6), np.full(6, 0.2), np.full(6, 0.5), names, flights)
        normalised.append(abs(mean.value) / mean.std)
    assert 0.93 < np.mean(np.array(normalised) < 1.96) <= 1


@pytest.mark.parametrize(("change_db", "drifts"), [(0.59, False), (0.61, True)])
def test_drift_is_reported_beyond_three_deviations_of_the_scatter(change_db, drifts):
    """With two reflectors, flight differences scatter by 0.2 dB·√2/√2; reflector errors of 2 dB cancel."""
    value = np.array([61.0, 59.0, 61.0, 59.0]) + np.array([0, 0, change_db, change_db])
    mean = together(value, np.full(4, 0.2), np.full(4, 2.0), ["a", "b", "a", "b"], ["f01", "f01", "f02", "f02"])
    assert mean.drift[:2] == ("f01", "f02")
    assert mean.drift[3] == pytest.approx(0.2)
    assert mean.drifts is drifts


def test_flights_without_a_common_reflector_are_not_compared():
    mean = together(np.array([60.0, 70.0]), np.full(2, 0.1), np.full(2, 0.1), ["a", "b"], ["f01", "f02"])
    assert mean.drift is None
    assert mean.chance < 1e-6
