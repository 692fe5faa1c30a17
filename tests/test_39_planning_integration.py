"""Integrated part of a flight: requested sector, pixel sampling and actual flight."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scenes import C, compiled, monostatic, strip_history

from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beam, Beams
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.backproject import backproject
from apertura.core.imaging.options import ImagingChoices
from apertura.core.planning.decisions import integrate
from apertura.core.quality.point_targets import cut_through, find_peak
from apertura.core.scene.grid import SceneGrid

WAVELENGTH = C / 1.25e9


def straight(length_m: float = 120.0, pulses: int = 1500, east_m: float = 0.0) -> Aperture:
    along = np.linspace(-length_m / 2, length_m / 2, pulses) + east_m
    return monostatic(np.stack([along, 0 * along, np.full(pulses, 20.0)], -1))


def points(size_m: float = 20.0) -> np.ndarray:
    east, north = np.meshgrid(np.linspace(-size_m / 2, size_m / 2, 5), 30 + np.linspace(size_m, 0, 5))
    return np.stack([east, north, 0 * east], -1)


def integration_of(aperture, *, spacing_m=0.05, requested="auto", antennas=None):
    return integrate(
        aperture, points(), spacing_m=spacing_m, wavelength_m=WAVELENGTH, requested=requested, antennas=antennas
    )


def test_pulses_within_the_pixel_bandwidth_are_all_integrated():
    """The automatic spacing, a third of the finest cell, permits the integration of the whole flight."""
    aperture = straight()
    cell_m = aperture.resolution_cell_m(points(), band_hz=(1.25e9, 1.25e9))
    whole = integration_of(aperture, spacing_m=cell_m / 3)
    assert whole.sector is None
    assert whole.count == len(aperture)
    assert integration_of(aperture, spacing_m=3 * cell_m, requested="all").sector is None


def test_coarse_grid_integrates_the_sector_it_can_sample():
    """The spectrum of a pixel fits into the inverse spacing, and would exceed it for a 5 % wider sector."""
    aperture = straight()
    chosen = integration_of(aperture, spacing_m=0.3)
    gradient = aperture.path_gradient(points().reshape(-1, 3))[..., 0]
    weight = chosen.sector.weight(aperture, points().reshape(-1, 3))
    for column, inside in zip(gradient.T, (weight > 0).T, strict=True):
        assert 0.95 / 0.3 < np.ptp(column[inside]) / WAVELENGTH <= 1 / 0.3
    assert chosen.report["pulses_per_pixel"]["most"] < 0.7 * len(aperture)
    assert chosen.share == pytest.approx((weight > 0).mean(), rel=0.02)


def test_degrees_are_the_angle_over_a_straight_pass():
    aperture = straight()
    sector = integration_of(aperture, requested={"degrees": 30.0}).sector
    point = np.array([[0.0, 40.0, 0.0]])
    used = aperture.tx_m[sector.weight(aperture, point)[:, 0] >= 0.5]
    angle_deg = np.degrees(np.arctan2(used[:, 0], np.hypot(40.0, 20.0)))
    assert np.ptp(angle_deg) == pytest.approx(30.0, abs=0.2)


@pytest.mark.slow
@compiled
@pytest.mark.parametrize("fixed", [False, True])
def test_width_of_a_target_is_the_requested_resolution(fixed):
    """The -3 dB width is 0.88 of the resolution, near and far, with moving antennas and with one stationary antenna."""
    aperture = straight(240.0, 2400)
    if fixed:
        aperture = Aperture(np.broadcast_to([10.0, -5.0, 15.0], aperture.rx_m.shape).copy(), aperture.rx_m)
    for north in (35.0, 70.0):
        target = np.array([[2.0, north, 0.0]])
        grid = SceneGrid("local", -6.0, north + 8.0, 0.1, (160, 160))
        image = backproject(
            strip_history(aperture, target), grid, integration={"resolution_m": 0.6}, certified_pixels=0
        )
        pixels = image.values
        peak = find_peak(pixels, *np.unravel_index(np.abs(pixels).argmax(), pixels.shape))
        width = cut_through(pixels, peak, direction=(1, 0), spacing_m=0.1, reach_m=3.0).width_m
        assert width == pytest.approx(0.884 * 0.6, rel=0.06)


@pytest.mark.slow
@compiled
def test_target_inside_the_swath_has_its_echo_amplitude():
    """The error bound also holds with a sector: engine and double sum use equal weights."""
    aperture, grid = straight(), SceneGrid("local", -10.0, 50.0, 0.25, (80, 80))
    history = strip_history(aperture, np.array([[1.0, 49.0, 0.0]]))
    image = backproject(history, grid, integration={"degrees": 20.0})
    pixels = image.values
    peak = find_peak(pixels, *np.unravel_index(np.abs(pixels).argmax(), pixels.shape))
    assert abs(peak.value) == pytest.approx(1.0, abs=0.04)
    assert image.attrs["numerical_error_db"] <= -60
    assert json.loads(image.attrs["models"])["integration"].startswith("20°, ")
    whole = backproject(history, grid, integration="all", certified_pixels=0)
    assert not np.allclose(np.abs(image.values), np.abs(whole.values), atol=0.01)


def test_point_not_passed_is_integrated_at_the_nearest_pulses():
    """The flight ends 30 m before the scene: the sector lies at its end, with the requested width."""
    aperture, scene_points = straight(60.0, 800, east_m=-70.0), points().reshape(-1, 3)
    chosen = integration_of(aperture, requested={"degrees": 6.0})
    sector = chosen.sector
    last = replace(sector, ends=None)[-1:].place(aperture[-1:], scene_points)[0]
    np.testing.assert_allclose(sector.centre_at(scene_points), last + sector.outer, atol=0.02 * sector.half)
    assert (sector.weight(aperture, scene_points) > 0.99).any(axis=0).all()
    least, most = (chosen.report["squint_deg"][part] for part in ("least", "most"))
    assert 0 < least < most
    assert integration_of(straight(), requested={"degrees": 6.0}).sector.ends is None


@pytest.mark.parametrize("east_m", [-60.0, -20.0, 0.0, 35.0])
@pytest.mark.parametrize("spacing_m", [0.1, 0.4, 1.5])
def test_point_with_a_sampled_angular_span_uses_all_pulses(east_m, spacing_m):
    """In short passes, also squinted, points with a wider span use the sampled part, all other points every pulse."""
    short, scene_points = straight(12.0, 200, east_m=east_m), points(30.0).reshape(-1, 3)
    chosen = integrate(short, points(30.0), spacing_m=spacing_m, wavelength_m=WAVELENGTH)
    if chosen.sector is None:
        assert spacing_m < 1
        return
    sector = chosen.sector
    coordinate, summed = sector.place(short, scene_points), sector.weight(short, scene_points).sum(axis=0)
    span = np.ptp(coordinate, axis=0)
    fits, wider = span <= 2 * sector.inner, span > 2.1 * sector.outer
    assert (summed[fits] > 0.999 * len(short)).all()
    assert (coordinate[:, wider].min(axis=0) <= -0.97 * sector.outer).all()
    assert (coordinate[:, wider].max(axis=0) >= 0.97 * sector.outer).all()
    assert "outside_swath" not in chosen.flags


def test_squinted_antennas_are_integrated_about_their_squint():
    squint = np.radians(25.0)
    aperture, angle = straight(), np.radians([-20.0, 0.0, 20.0])
    look = np.array([np.sin(squint), np.cos(squint), 0.0])
    axes = np.stack([look, [np.cos(squint), -np.sin(squint), 0.0], [0.0, 0.0, 1.0]])
    beam = Beam(np.broadcast_to(axes, (len(aperture), 3, 3)), angle, np.ones(3), angle, np.ones(3))
    chosen = integration_of(aperture, requested={"degrees": 10.0}, antennas=Beams(beam, beam))
    assert chosen.sector.centre == pytest.approx(np.sin(squint))
    assert chosen.report["squint_deg"]["median"] == pytest.approx(25.0)


def test_circle_around_the_scene_is_integrated_entirely_and_flagged():
    """All pulses of a circle are at the closest approach, so that a requested angle is exceeded and flagged."""
    angle = np.linspace(0, 2 * np.pi, 2000)
    circle = monostatic(np.stack([60 * np.cos(angle), 40 + 60 * np.sin(angle), np.full(2000, 40.0)], -1))
    near = points(2.0) + [0.0, 9.0, 0.0]
    requested = {"spacing_m": 0.3, "wavelength_m": WAVELENGTH}
    assert integrate(circle, near, **requested).sector is None
    chosen = integrate(circle, near, **requested, requested={"degrees": 10.0})
    assert chosen.report["pulses_per_pixel"]["median"] == 2000
    assert "track_turns" in chosen.flags
    assert "track_turns" not in integration_of(straight(), requested={"degrees": 10.0}).flags


def test_scene_next_to_a_flight_gap_is_flagged_with_its_share():
    whole = straight(120.0).tx_m
    aperture = monostatic(whole[np.abs(whole[:, 0]) > 25])
    chosen = integrate(aperture, points(60.0), spacing_m=0.5, wavelength_m=WAVELENGTH, requested={"degrees": 8.0})
    assert 20 < float(chosen.flags["outside_swath"].split()[0]) < 80
    assert chosen.report["pulses_per_pixel"]["least"] == 0


@pytest.mark.parametrize("requested", [{"degrees": 0}, {"resolution_m": -1}, {"degrees": 4, "resolution_m": 1}, "some"])
def test_invalid_integration_is_refused(requested):
    with pytest.raises(ValueError, match="integration"):
        ImagingChoices(integration=requested)
    with pytest.raises(CampaignError, match="integration"):
        backproject(
            strip_history(straight(60.0, 64), np.zeros((1, 3))),
            SceneGrid("local", 0, 40, 1.0, (8, 8)),
            integration=requested,
        )
