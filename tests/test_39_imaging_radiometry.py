"""Radar cross-sections of points and σ⁰ of ground, from images of echoes whose truth is known."""

import numpy as np
import pytest
from scenes import side_beam, straight_track

import apertura as ap
from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.echo.compression import window_weights
from apertura.core.focus.engines import reference
from apertura.core.focus.inputs import PhaseHistory
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.sector import Sector
from apertura.core.imaging.radiometry import Calibration, Link, cell_constant, pointing_std_db
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, Plane
from apertura.core.scene.visibility import surface
from apertura.simulation.echoes import transfer
from apertura.simulation.scene import Scatterers

FREQUENCY = 1.3e9 + 1.6e6 * (np.arange(128) - 64)
GRID = SceneGrid("local", -3.0, 23.0, 0.125, (48, 48))
LEVEL = FlatGround(0.0)


def flown(pulses=96, *, apart=False):
    track = straight_track(pulses, length_m=14.0) + [0.0, 0.0, 12.0]
    return Aperture(track, track + ([5.0, 1.0, 2.0] if apart else 0.0))


def history(aperture, place, window, beams=None, amplitude=1.0):
    """The echo of one point of that amplitude, as both antennas see it."""
    echo = transfer(Scatterers(np.array([place]), np.array([amplitude + 0j])), aperture, FREQUENCY)
    if beams is not None:
        echo = echo * beams.antennas.weight(aperture, np.array([place]))
    return PhaseHistory(echo, FREQUENCY, window_weights(window, 128), np.zeros(len(aperture)), aperture)


def calibrated(aperture, beams=None, *, window="none", terrain=LEVEL, grid=GRID, **known):
    cell_m2 = cell_constant(FREQUENCY, window_weights(window, 128))
    return Calibration.of(grid, terrain, aperture, beams, constant=known.pop("constant", 1.0), cell_m2=cell_m2, **known)


def pattern(aperture):
    beam = side_beam((50.0, 40.0), pulses=len(aperture))
    return Beams(beam, beam, Sector.of(aperture, chord_m=1.0, centre=0.0, half=0.3))


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("place", [(0.0, 20.0, 0.0), (-2.5, 17.5, 0.0), (2.5, 22.5, 0.0)])
def test_the_cross_section_of_a_point_follows_from_its_peak(place, apart):
    """Eqs. 3 and 4: spreading, both patterns and the sector's weights, whatever number divides the image."""
    aperture = flown(apart=apart)
    beams = pattern(aperture)
    echo = history(aperture, place, "hann", beams, amplitude=np.sqrt(7.0 * 0.1))
    (peak,) = reference.form(echo, np.array([place]), beams=beams) / 60
    (per_m2,), _ = calibrated(aperture, beams, constant=7.0, count=60).at(np.array([place]))
    assert 10 * np.log10(abs(peak) ** 2 / per_m2 / 0.1) == pytest.approx(0, abs=1e-3)


def response_area_m2(aperture, window, up_slope):
    """∫|response|² over the surface, over that of its peak: what eq. 5 says, added up."""
    east, north = np.meshgrid(np.arange(-9, 9, 0.06), np.arange(11, 29, 0.06))
    height = up_slope * (north - 20.0)
    echo = history(aperture, (0.0, 20.0, 0.0), window)
    image = reference.form(echo, np.stack([east, north, height], -1))
    (peak,) = reference.form(echo, np.array([[0.0, 20.0, 0.0]]))
    return float((np.abs(image) ** 2).sum() / abs(peak) ** 2 * 0.06**2 * np.hypot(1, up_slope))


@pytest.mark.slow
@pytest.mark.parametrize("window", ["none", "hann"])
@pytest.mark.parametrize("slope", [0.0, -0.3])
@pytest.mark.parametrize("apart", [False, True])
def test_ground_of_known_sigma0_has_it_in_the_image(apart, slope, window):
    """Eqs. 5 and 6: the area of a cell is that of the response to a point, by Parseval; on a slope, too."""
    aperture = flown(apart=apart)
    terrain = LEVEL if not slope else Plane(0.0, 20.0, 0.0, 0.0, slope)
    found = calibrated(aperture, window=window, terrain=terrain)
    middle = (slice(24, 25), slice(24, 25))
    normal = np.array([[[0.0, -slope, 1.0]]]) / np.hypot(1, slope)
    area = found.power(middle, "sigma0", normal)[0, 0] / found.rcs_power(middle)[0, 0]
    added = response_area_m2(aperture, window, slope)
    assert 10 * np.log10(area / added) == pytest.approx(0, abs=0.2)


def test_between_nodes_gain_and_area_are_those_of_the_pixel():
    aperture, grid = flown(), SceneGrid("local", -3.0, 23.0, 0.05, (120, 120))
    beams = pattern(aperture)
    found, window = calibrated(aperture, beams, grid=grid), (slice(8, 9), slice(24, 25))
    (per_m2,), (noise,) = found.at(LEVEL.positions(grid[window])[0])
    assert found.rcs_power(window)[0, 0] == pytest.approx(per_m2, rel=0.02)
    assert found.pixel_noise(window)[0, 0] == pytest.approx(noise, rel=0.02)
    alone = calibrated(aperture, beams, grid=grid[window])
    assert found.cell(window)[0, 0] == pytest.approx(alone.cell((slice(0, 1), slice(0, 1)))[0, 0], rel=0.02)


def test_a_track_flown_twice_resolves_no_more_than_once():
    """Its azimuths meet: the sum over pulses of eq. 5 would halve the cell."""
    once = flown(200)
    twice = Aperture(np.concatenate([once.tx_m, once.tx_m[::-1]]), np.concatenate([once.rx_m, once.rx_m[::-1]]))
    window = (slice(24, 25), slice(24, 25))
    assert calibrated(twice).cell(window)[0, 0] == pytest.approx(calibrated(once).cell(window)[0, 0], rel=0.01)


def test_beta_sigma_and_gamma_differ_by_the_incidence():
    """Level ground seen by one antenna at broadside: σ⁰ = β⁰ sin θ and γ⁰ = σ⁰/cos θ."""
    found, window = calibrated(flown()), (slice(24, 25), slice(24, 25))
    incidence = np.arctan2(20.0, 12.0 + 10.0)
    power = {name: found.power(window, name)[0, 0] for name in ("sigma0", "beta0", "gamma0")}
    assert power["beta0"] / power["sigma0"] == pytest.approx(np.sin(incidence), rel=0.01)
    assert power["gamma0"] / power["sigma0"] == pytest.approx(np.cos(incidence), rel=0.02)


def test_the_link_is_the_radar_equation():
    """1 W by 10 dBi each way at 0.25 m: 1 m² at 1 m × 1 m returns 3.15 mW; 20 dB on, full scale is 30 dBm."""
    link = Link(30.0, 10.0, 10.0, 20.0, 30.0, 1000.0)
    received_w = 100 * 0.25**2 / (4 * np.pi) ** 3
    assert link.constant(wavelength_m=0.25, sent_power=64.0) == pytest.approx(received_w * 100 * 1000**2 / 64)
    noise = link.pulse_noise(3.0, spacing_hz=1e5, squares=1 / 64)
    assert noise == pytest.approx(1.380649e-23 * 290 * 10**0.3 * 1e5 * 1e8 / 64)


@pytest.mark.parametrize("terrain", [LEVEL, Plane(0.0, 20.0, 0.0, 0.0, -0.3)])
def test_a_calibrated_image_from_python_has_sigma0_and_cross_section_of_every_pixel(terrain):
    """A point of 0.1 m² at the corner of four pixels, K = 7; σ⁰ is the cross-section over the cell's area."""
    aperture = flown()
    height = float(terrain.heights_at(GRID, np.array([23.5]), np.array([23.5]))[0])
    x, y = GRID.map_at(np.array([23]), np.array([23]))[0]
    echo = history(aperture, (x, y, height), "hann", amplitude=np.sqrt(7.0 * 0.1))
    image = ap.backproject(echo, GRID, terrain=terrain, calibration=7.0, integration="all", tile_px=16)
    assert image.rcs.chunks == image.chunks
    found = image.compute()
    assert 10 * np.log10(float(found.rcs[23, 23]) / 0.1) == pytest.approx(0, abs=0.1)
    own = calibrated(aperture, window="hann", terrain=terrain, constant=7.0)
    whole = (slice(0, 48), slice(0, 48))
    normal = None if terrain is LEVEL else surface(GRID, terrain, whole)[1]
    np.testing.assert_allclose(found.sigma0, np.abs(found) ** 2 / own.power(whole, "sigma0", normal), rtol=1e-4)
    assert found.sigma0.attrs["standard_name"] == "surface_backwards_scattering_coefficient_of_radar_wave"
    assert (found.sigma0.attrs["units"], found.rcs.attrs["units"]) == ("1", "m2")
    assert "sigma0" not in ap.backproject(echo, GRID, terrain=terrain, certified_pixels=0).coords


def test_a_calibration_needs_a_constant_and_the_band():
    echo = history(flown(), (0.0, 20.0, 0.0), "hann")
    with pytest.raises(CampaignError, match=r"calibration: a constant of -1\.0; expected a positive number"):
        ap.backproject(echo, GRID, calibration=-1.0)
    with pytest.raises(CampaignError, match="expected a PhaseHistory, or a stage echo"):
        ap.backproject(ap.range_compress(echo, GRID, LEVEL), GRID, calibration=1.0)


def test_an_attitude_error_changes_the_power_of_a_point_by_the_slope_of_its_beam():
    """Eq. 9: a point 15° below the axis of a Gaussian beam of 40° in elevation, 2° of roll: 24·θ·δθ/w² per antenna."""
    aperture = Aperture(*2 * [np.tile([0.0, 0.0, 12.0], (8, 1))])
    beam = side_beam((50.0, 40.0), pulses=8)
    boresight = beam.axes[0, 0]
    below = np.arctan2(-boresight[2], boresight[1]) + np.radians(15.0)
    place = np.array([0.0, 12.0 / np.tan(below), 0.0])
    roll = np.radians(2.0) * np.array([1.0, 0.0, 0.0])
    slope_db = 24.08 * 15.0 * 2.0 / 40.0**2
    both, one = ((True, True), (True, False))
    for turned, expected in ((both, 2 * slope_db), (one, slope_db)):
        assert pointing_std_db(Beams(beam, beam), aperture, place, [(roll, turned)]) == pytest.approx(
            expected, rel=0.02
        )
    apart = pointing_std_db(Beams(beam, beam), aperture, place, [(roll, (True, False)), (roll, (False, True))])
    assert apart == pytest.approx(np.sqrt(2) * slope_db, rel=0.02)
    assert pointing_std_db(None, aperture, place, [(roll, both)]) == 0
    level = np.array([0.0, 12.0 / np.tan(below - np.radians(15.0)), 0.0])
    flat_db = pointing_std_db(Beams(beam, beam), aperture, level, [(roll, both)])
    assert flat_db == pytest.approx(2 * 12.04 * (2.0 / 40.0) ** 2, rel=0.02)  # on the axis the square is left
