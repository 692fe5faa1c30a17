"""How much of a flight is integrated: what is asked, what pixels carry, what was flown."""

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


def settled(aperture, *, spacing_m=0.05, requested="auto", antennas=None):
    return integrate(
        aperture, points(), spacing_m=spacing_m, wavelength_m=WAVELENGTH, requested=requested, antennas=antennas
    )


def test_what_the_pixels_carry_is_not_cut():
    """A third of the finest cell, the spacing of `auto`, carries all that was flown."""
    aperture = straight()
    cell_m = aperture.resolution_cell_m(points(), band_hz=(1.25e9, 1.25e9))
    whole = settled(aperture, spacing_m=cell_m / 3)
    assert whole.sector is None
    assert whole.count == len(aperture)
    assert settled(aperture, spacing_m=3 * cell_m, requested="all").sector is None


def test_a_coarse_grid_takes_what_it_carries():
    """The spectrum of a pixel fits into the inverse of the spacing, and would not if the sector were 5 % wider."""
    aperture = straight()
    chosen = settled(aperture, spacing_m=0.3)
    gradient = aperture.path_gradient(points().reshape(-1, 3))[..., 0]
    weight = chosen.sector.weight(aperture, points().reshape(-1, 3))
    for column, inside in zip(gradient.T, (weight > 0).T, strict=True):
        assert 0.95 / 0.3 < np.ptp(column[inside]) / WAVELENGTH <= 1 / 0.3
    assert chosen.report["pulses_per_pixel"]["most"] < 0.7 * len(aperture)
    assert chosen.share == pytest.approx((weight > 0).mean(), rel=0.02)


def test_degrees_are_the_angle_of_a_straight_pass():
    aperture = straight()
    sector = settled(aperture, requested={"degrees": 30.0}).sector
    place = np.array([[0.0, 40.0, 0.0]])
    seen = aperture.tx_m[sector.weight(aperture, place)[:, 0] >= 0.5]
    turn = np.degrees(np.arctan2(seen[:, 0], np.hypot(40.0, 20.0)))
    assert np.ptp(turn) == pytest.approx(30.0, abs=0.2)


@pytest.mark.slow
@compiled
@pytest.mark.parametrize("fixed", [False, True])
def test_the_width_of_a_target_is_the_resolution_that_was_asked(fixed):
    """Whether both antennas fly or one stands: -3 dB at 0.88 of the resolution, near and far."""
    flown = straight(240.0, 2400)
    if fixed:
        flown = Aperture(np.broadcast_to([10.0, -5.0, 15.0], flown.rx_m.shape).copy(), flown.rx_m)
    for north in (35.0, 70.0):
        target = np.array([[2.0, north, 0.0]])
        grid = SceneGrid("local", -6.0, north + 8.0, 0.1, (160, 160))
        image = backproject(strip_history(flown, target), grid, integration={"resolution_m": 0.6}, certified_pixels=0)
        pixels = image.values
        peak = find_peak(pixels, *np.unravel_index(np.abs(pixels).argmax(), pixels.shape))
        width = cut_through(pixels, peak, direction=(1, 0), spacing_m=0.1, reach_m=3.0).width_m
        assert width == pytest.approx(0.884 * 0.6, rel=0.06)


@pytest.mark.slow
@compiled
def test_a_target_inside_the_swath_has_the_amplitude_of_its_echo():
    """And the bound of the error holds with the sector: engine and double sum weigh alike."""
    flown, grid = straight(), SceneGrid("local", -10.0, 50.0, 0.25, (80, 80))
    history = strip_history(flown, np.array([[1.0, 49.0, 0.0]]))
    image = backproject(history, grid, integration={"degrees": 20.0})
    pixels = image.values
    peak = find_peak(pixels, *np.unravel_index(np.abs(pixels).argmax(), pixels.shape))
    assert abs(peak.value) == pytest.approx(1.0, abs=0.04)
    assert image.attrs["numerical_error_db"] <= -60
    assert json.loads(image.attrs["models"])["integration"].startswith("20°, ")
    whole = backproject(history, grid, integration="all", certified_pixels=0)
    assert not np.allclose(np.abs(image.values), np.abs(whole.values), atol=0.01)


def test_a_place_that_is_not_passed_is_integrated_where_it_was_nearest():
    """The flight ends 30 m before the scene: the sector of each place lies at the flight's end, as wide as asked."""
    ahead, places = straight(60.0, 800, east_m=-70.0), points().reshape(-1, 3)
    chosen = settled(ahead, requested={"degrees": 6.0})
    sector = chosen.sector
    last = replace(sector, ends=None)[-1:].place(ahead[-1:], places)[0]
    np.testing.assert_allclose(sector.centre_at(places), last + sector.outer, atol=0.02 * sector.half)
    assert (sector.weight(ahead, places) > 0.99).any(axis=0).all()
    least, most = (chosen.report["squint_deg"][part] for part in ("least", "most"))
    assert 0 < least < most
    assert settled(straight(), requested={"degrees": 6.0}).sector.ends is None


@pytest.mark.parametrize("east_m", [-60.0, -20.0, 0.0, 35.0])
@pytest.mark.parametrize("spacing_m", [0.1, 0.4, 1.5])
def test_a_place_whose_own_span_its_pixels_carry_takes_all_pulses(east_m, spacing_m):
    """Short passes, squinted and not: who spans more than fits takes what fits, nobody less."""
    short, places = straight(12.0, 200, east_m=east_m), points(30.0).reshape(-1, 3)
    chosen = integrate(short, points(30.0), spacing_m=spacing_m, wavelength_m=WAVELENGTH)
    if chosen.sector is None:
        assert spacing_m < 1
        return
    sector = chosen.sector
    place, summed = sector.place(short, places), sector.weight(short, places).sum(axis=0)
    span = np.ptp(place, axis=0)
    fits, wider = span <= 2 * sector.inner, span > 2.1 * sector.outer
    assert (summed[fits] > 0.999 * len(short)).all()
    assert (place[:, wider].min(axis=0) <= -0.97 * sector.outer).all()
    assert (place[:, wider].max(axis=0) >= 0.97 * sector.outer).all()
    assert "outside_swath" not in chosen.flags


def test_antennas_that_look_ahead_are_integrated_where_they_look():
    squint = np.radians(25.0)
    flown, angle = straight(), np.radians([-20.0, 0.0, 20.0])
    look = np.array([np.sin(squint), np.cos(squint), 0.0])
    axes = np.stack([look, [np.cos(squint), -np.sin(squint), 0.0], [0.0, 0.0, 1.0]])
    beam = Beam(np.broadcast_to(axes, (len(flown), 3, 3)), angle, np.ones(3), angle, np.ones(3))
    chosen = settled(flown, requested={"degrees": 10.0}, antennas=Beams(beam, beam))
    assert chosen.sector.centre == pytest.approx(np.sin(squint))
    assert chosen.report["squint_deg"]["median"] == pytest.approx(25.0)


def test_a_circle_about_the_scene_counts_as_a_whole_and_says_so():
    """As a circle has no closest approach, every pulse is at it; asked for an angle it gives more, and a flag."""
    turn = np.linspace(0, 2 * np.pi, 2000)
    circle = monostatic(np.stack([60 * np.cos(turn), 40 + 60 * np.sin(turn), np.full(2000, 40.0)], -1))
    near = points(2.0) + [0.0, 9.0, 0.0]
    requested = {"spacing_m": 0.3, "wavelength_m": WAVELENGTH}
    assert integrate(circle, near, **requested).sector is None
    chosen = integrate(circle, near, **requested, requested={"degrees": 10.0})
    assert chosen.report["pulses_per_pixel"]["median"] == 2000
    assert "track_turns" in chosen.flags
    assert "track_turns" not in settled(straight(), requested={"degrees": 10.0}).flags


def test_a_scene_beside_a_gap_of_the_flight_is_flagged_with_its_share():
    whole = straight(120.0).tx_m
    flown = monostatic(whole[np.abs(whole[:, 0]) > 25])
    chosen = integrate(flown, points(60.0), spacing_m=0.5, wavelength_m=WAVELENGTH, requested={"degrees": 8.0})
    assert 20 < float(chosen.flags["outside_swath"].split()[0]) < 80
    assert chosen.report["pulses_per_pixel"]["least"] == 0


@pytest.mark.parametrize("requested", [{"degrees": 0}, {"resolution_m": -1}, {"degrees": 4, "resolution_m": 1}, "some"])
def test_what_is_no_integration_is_refused(requested):
    with pytest.raises(ValueError, match="integration"):
        ImagingChoices(integration=requested)
    with pytest.raises(CampaignError, match="integration"):
        backproject(
            strip_history(straight(60.0, 64), np.zeros((1, 3))),
            SceneGrid("local", 0, 40, 1.0, (8, 8)),
            integration=requested,
        )
