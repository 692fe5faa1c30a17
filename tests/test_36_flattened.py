"""Phase of backprojected images: flattened at scatterers, with the spatial carrier within their response.

The images are the double sum of docs/theory.md, eq. 5, over echoes from the same equations, without product code.
"""

import numpy as np
import pytest

LIGHT_M_S = 299_792_458.0
BAND_HZ = 1.2e9 + 1.6e6 * np.arange(128)
CENTRE_HZ = BAND_HZ.mean()
PULSES = 81
PLACES = np.stack(np.meshgrid(np.arange(-9.0, 9.1, 4.5), np.arange(-8.0, 8.1, 4.0)), axis=-1).reshape(-1, 2)


def relief_m(east, north):
    """Return terrain heights with 2 m of relief."""
    return np.sin(east / 4.0) + np.cos(north / 5.0)


def on_terrain(places, rise_m=0.0):
    """Return positions on the terrain."""
    return np.column_stack([places, relief_m(*places.T) + rise_m])


def track(north_m, up_m):
    """Return the antenna positions of a pass."""
    return np.column_stack([np.linspace(-4.0, 4.0, PULSES), np.full(PULSES, north_m), np.full(PULSES, up_m)])


FIRST, SECOND = track(-25.0, 25.0), track(-24.0, 26.0)


def paths_m(points, antennas):
    """Return total paths, (pulse, point)."""
    return 2 * np.linalg.norm(antennas[:, None] - points[None], axis=-1)


def image_at(points, antennas, scatterers, phases_rad):
    """Return the double sum at points, for unit scatterers of given phases."""
    pixels = np.zeros(len(points), complex)
    for antenna in antennas:
        path, echo_path = paths_m(points, antenna[None])[0], paths_m(scatterers, antenna[None])[0]
        wavenumbers = 2 * np.pi * BAND_HZ / LIGHT_M_S
        echo = np.exp(-1j * np.multiply.outer(wavenumbers, echo_path)) @ np.exp(1j * phases_rad)
        pixels += (echo[:, None] * np.exp(1j * np.multiply.outer(wavenumbers, path))).sum(axis=0)
    return pixels / (len(antennas) * len(BAND_HZ))


@pytest.fixture(scope="module")
def scene():
    phases = np.random.default_rng(0).uniform(-np.pi, np.pi, len(PLACES))
    return on_terrain(PLACES), phases


def test_phase_at_scatterers_is_their_own_without_flat_earth_and_terrain_phase(scene):
    scatterers, phases = scene
    for antennas in (FIRST, SECOND):
        error = np.angle(image_at(scatterers, antennas, scatterers, phases) * np.exp(-1j * phases))
        assert np.abs(error).max() < 0.15  # sidelobes of the other scatterers
    # the phases of the paths, which an image that is not flattened would have, differ by many cycles
    topographic = 2 * np.pi * CENTRE_HZ / LIGHT_M_S * (paths_m(scatterers, FIRST) - paths_m(scatterers, SECOND)).mean(0)
    assert np.ptp(topographic) > 4 * np.pi


def test_phase_between_tracks_is_zero_on_the_terrain_and_has_fringes_on_a_wrong_one(scene):
    scatterers, phases = scene
    right, wrong = (
        [image_at(on_terrain(PLACES, rise_m), antennas, scatterers, phases) for antennas in (FIRST, SECOND)]
        for rise_m in (0.0, 0.05)
    )
    assert np.abs(np.angle(right[0] * right[1].conj())).max() < 0.15
    # eq. 9 of interferometry.md: the phase of a rise h is that of the path difference
    between = np.angle(wrong[0] * wrong[1].conj())
    raised = on_terrain(PLACES, 0.05)
    expected = (paths_m(raised, FIRST) - paths_m(raised, SECOND) - paths_m(scatterers, FIRST)).mean(0)
    expected = 2 * np.pi * CENTRE_HZ / LIGHT_M_S * (expected + paths_m(scatterers, SECOND).mean(0))
    assert np.abs(expected).min() > 0.02
    assert np.abs(np.angle(np.exp(1j * (between - expected)))).max() < 0.15


def test_phase_within_the_response_of_a_point_has_the_spatial_carrier():
    point = on_terrain(np.zeros((1, 2)))
    around = point + np.array([0.0, 1.0, 0.0]) * np.linspace(-0.1, 0.1, 21)[:, None]
    phase = np.unwrap(np.angle(image_at(around, FIRST, point, np.zeros(1))))
    growth = 2 * np.pi * CENTRE_HZ / LIGHT_M_S * np.diff(paths_m(around, FIRST).mean(0))
    assert np.diff(phase) == pytest.approx(growth, rel=0.03)
    assert np.ptp(phase) > 2 * np.pi  # in 20 cm of ground range: not at baseband
