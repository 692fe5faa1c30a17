"""Radar cross-sections of points and σ⁰ of ground, from images of echoes whose truth is known."""

from pathlib import Path

import numpy as np
import pytest
from scenes import side_beam, straight_track

import apertura as ap
from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beam, Beams
from apertura.core.backprojection.engines import reference
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.compression import window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.sector import Sector
from apertura.core.imaging.radiometry import Calibration, Link, cell_constant, pointing_std_db
from apertura.core.scene.angles import surface
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, Plane
from apertura.simulation.scatterers import transfer
from apertura.simulation.targets import Scatterers

FREQUENCY = 1.3e9 + 1.6e6 * (np.arange(128) - 64)
GRID = SceneGrid("local", -3.0, 23.0, 0.125, (48, 48))
LEVEL = FlatGround(0.0)
MIDDLE = (slice(24, 25), slice(24, 25))


def flown(pulses=96, *, apart=False, length_m=14.0):
    track = straight_track(pulses, length_m=length_m) + [0.0, 0.0, 12.0]
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


SLOPES = [(0.0, 0.0), (0.0, 0.2), (0.0, -0.2), (0.0, 0.4), (0.0, -0.4), (0.2, 0.0), (-0.4, 0.0), (0.3, -0.3)]
"""Rise eastward, along the track, and northward, away from it."""


def normal_of(along, up):
    return np.array([[[-along, -up, 1.0]]]) / np.sqrt(1 + along**2 + up**2)


def response_area_m2(aperture, window, slope):
    """∫|response|² over the surface, over that of its peak: what eq. 5 says, added up."""
    east, north = np.meshgrid(np.arange(-9, 9, 0.08), np.arange(8, 32, 0.08))
    height = slope[0] * east + slope[1] * (north - 20.0)
    echo = history(aperture, (0.0, 20.0, 0.0), window)
    image = reference.form(echo, np.stack([east, north, height], -1))
    (peak,) = reference.form(echo, np.array([[0.0, 20.0, 0.0]]))
    return float((np.abs(image) ** 2).sum() / abs(peak) ** 2 * 0.08**2 * np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2))


@pytest.mark.slow
@pytest.mark.parametrize("slope", SLOPES)
@pytest.mark.parametrize(("apart", "window"), [(False, "none"), (True, "none"), (True, "hann")])
def test_ground_of_known_sigma0_has_it_in_the_image(apart, slope, window):
    """Eqs. 5 and 6: the area of a cell is that of the response to a point, by Parseval; on slopes, too."""
    aperture = flown(apart=apart)
    terrain = Plane(0.0, 20.0, 0.0, *slope) if any(slope) else LEVEL
    found = calibrated(aperture, window=window, terrain=terrain)
    area = found.power(MIDDLE, "sigma0", normal_of(*slope))[0, 0] / found.rcs_power(MIDDLE)[0, 0]
    added = response_area_m2(aperture, window, slope)
    assert 10 * np.log10(area / added) == pytest.approx(0, abs=0.15)


def clutter(aperture, slope, beams, seed, side_m=0.35):
    """Echo of ground of σ⁰ = 1: a random scatterer in each square, as both antennas see it."""
    generator = np.random.default_rng(seed)
    corners = np.stack(np.meshgrid(np.arange(-26, 26, side_m), np.arange(6, 75, side_m)), -1).reshape(-1, 2)
    x, y = (corners + side_m * generator.uniform(size=corners.shape)).T
    place = np.column_stack([x, y, slope[0] * x + slope[1] * (y - 35.0)])
    area_m2 = side_m**2 * np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    amplitude = np.sqrt(area_m2 / 2) * (generator.standard_normal((len(x), 2)) @ [1, 1j])

    def seen(part):
        gain = 1.0 if beams is None else beams[part].antennas.weight(aperture[part], place)[0]
        return transfer(Scatterers(place, amplitude * gain), aperture[part], FREQUENCY, gridded=True)

    parts = [slice(0, len(aperture))] if beams is None else [slice(at, at + 1) for at in range(len(aperture))]
    return np.concatenate([seen(part) for part in parts])


@pytest.mark.slow
@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize(
    ("slope", "beam"), [((0.0, 0.0), False), ((0.0, 0.2), False), ((0.0, -0.2), False), ((0.0, 0.0), True)]
)
def test_clutter_has_its_sigma0_over_the_swath(slope, beam, apart):
    """Within 0.2 dB over incidences of 30° to 70°, on slopes of 20 %, and on the far edge of a beam, 3 to 24 dB down.

    There without a window the sidelobes of brighter ground before it would add 1 dB.
    """
    window = "hann" if beam else "none"
    aperture, grid = flown(64, apart=apart, length_m=6.0), SceneGrid("local", -8.0, 62.0, 0.25, (196, 64))
    terrain = Plane(0.0, 35.0, 0.0, *slope) if any(slope) else LEVEL
    one = side_beam((70.0, 25.0), boresight_deg=(-90.0, -45.0), pulses=len(aperture))
    beams = Beams(one, one) if beam else None
    per_one = calibrated(aperture, beams, window=window, terrain=terrain, grid=grid).power(
        (slice(0, 196), slice(0, 64)), "sigma0", np.broadcast_to(normal_of(*slope), (196, 64, 3))
    )
    places, found = terrain.positions(grid), []
    for seed in range(6):
        echo = clutter(aperture, slope, beams, seed)
        given = PhaseHistory(echo, FREQUENCY, window_weights(window, 128), np.zeros(len(aperture)), aperture)
        found.append(np.abs(reference.form(given, places, beams=beams) / len(aperture)) ** 2 / per_one)
    incidence = np.degrees(np.arctan2(places[..., 1], 22.0 - places[..., 2]))
    swath = (incidence > 30) & (incidence < 70)
    if beam:  # 45° down, 25° wide, both ways
        swath = (incidence > 52) & (incidence < 70)
    assert 10 * np.log10(np.mean(found, axis=0)[swath].mean()) == pytest.approx(0, abs=0.2)


@pytest.mark.parametrize("slope", SLOPES)
def test_a_facet_seen_by_one_antenna_has_the_area_of_its_incidence(slope):
    """Eq. 9: a_s/a is the sine of the incidence in the plane of range, times the cosine of the tilt out of it."""
    aperture = flown(length_m=0.5)  # so short that all pulses look from one place
    found = calibrated(aperture, terrain=Plane(0.0, 20.0, 0.0, *slope))
    incidence, rise = np.arctan2(20.0, 22.0), np.arctan(slope[1])
    tilt = np.arctan(slope[0] * np.cos(rise))  # of the facet out of the plane of range
    ratio = found.power(MIDDLE, "beta0")[0, 0] / found.power(MIDDLE, "sigma0", normal_of(*slope))[0, 0]
    assert ratio == pytest.approx(np.sin(incidence - rise) * np.cos(tilt), rel=0.01)


@pytest.mark.parametrize("slope", SLOPES)
def test_a_facet_seen_by_two_antennas_has_the_area_of_range_and_doppler(slope):
    """Eq. 9: a facet between two ranges and two Doppler frequencies is 1/|∇r × ∇f| wide on its own plane."""
    aperture = flown(apart=True, length_m=0.5)
    found = calibrated(aperture, terrain=Plane(0.0, 20.0, 0.0, *slope))
    normal, place, step = normal_of(*slope)[0, 0], np.array([0.0625, 19.9375, 0.0]), 1e-3

    def path(point, pulse):
        one = aperture[pulse : pulse + 1]
        return np.linalg.norm(point - one.tx_m[0]) + np.linalg.norm(point - one.rx_m[0])

    def range_and_doppler(point):
        return np.array([path(point, 48), path(point, 60) - path(point, 36)])

    place[2] = slope[0] * place[0] + slope[1] * (place[1] - 20.0)
    gradients = np.stack([range_and_doppler(place + at) - range_and_doppler(place - at) for at in step * np.eye(3)], -1)
    across = np.cross(*gradients)
    ratio = found.power(MIDDLE, "beta0")[0, 0] / found.power(MIDDLE, "sigma0", normal_of(*slope))[0, 0]
    assert ratio == pytest.approx(abs(across @ normal) / np.linalg.norm(across), rel=0.01)


@pytest.mark.parametrize("apart", [False, True])
def test_no_sigma0_is_told_from_where_a_slope_is_nearly_laid_over(apart):
    """Layover begins where the slope is the incidence on level ground, 42°; its area has no bound, nor its error."""
    aperture, told = flown(apart=apart), {}
    for up in (0.0, 0.3, 0.6, 0.9, 1.0, 3.0):
        found = calibrated(aperture, terrain=Plane(0.0, 20.0, 0.0, 0.0, up))
        told[up] = found.power(MIDDLE, "sigma0", normal_of(0.0, up))[0, 0] / found.rcs_power(MIDDLE)[0, 0]
    assert 2 * told[0.0] < 1.5 * told[0.3] < told[0.6]
    assert np.isnan([told[up] for up in (0.9, 1.0, 3.0)]).all()
    assert np.isfinite(found.power(MIDDLE, "beta0", normal_of(0.0, 1.0))).all()
    steep = normal_of(0.0, -3.0)  # falls away behind its crest: shadow, which the mask says
    assert np.isnan(found.power(MIDDLE, "gamma0", steep)).all()


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
    assert calibrated(twice).cell(MIDDLE)[0, 0] == pytest.approx(calibrated(once).cell(MIDDLE)[0, 0], rel=0.01)


def test_beta_sigma_and_gamma_differ_by_the_incidence():
    """Level ground seen by one antenna at broadside: σ⁰ = β⁰ sin θ and γ⁰ = σ⁰/cos θ."""
    found, window = calibrated(flown()), MIDDLE
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


@pytest.mark.quick("terrain1")
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
    with pytest.raises(CampaignError, match="expected a PhaseHistory, or the dataset of stage echo"):
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


def test_the_example_of_the_how_to_has_the_cross_section_that_it_put():
    page = Path(__file__).parents[1] / "docs/howto/calibrate_radiometry.md"
    names = {}
    exec(page.read_text().split("```python\n")[1].split("```")[0], names)
    assert names["largest_m2"] == pytest.approx(2.0, rel=0.03)
    assert names["image"].sigma0.attrs["units"] == "1"
    assert names["image"].rcs.attrs["units"] == "m2"
    assert float(names["sigma0_db"].max()) > 10


def test_a_block_of_ground_that_no_beam_reaches_has_no_calibration_and_stops_nothing():
    """Of 300 pixels along the track the far ones lie in a block of their own, which the beam does not reach."""
    track = np.stack([np.linspace(-2, 2, 40), np.full(40, -20.0), np.full(40, 10.0)], -1)
    flown, width = Aperture(track, track), np.radians([-10.0, 0.0, 10.0])
    axes = np.tile(np.array([[0.0, 1, 0], [-1.0, 0, 0], [0.0, 0, 1]]), (40, 1, 1))
    beam = Beam(axes, width, np.array([0.5, 1, 0.5]), 6 * width, np.ones(3))
    grid = SceneGrid("local", -5.0, 5.0, 0.25, (20, 600))
    found = Calibration.of(grid, FlatGround(0.0), flown, Beams(beam, beam), constant=1.0, cell_m2=0.1)
    power = found.power((slice(0, 20), slice(0, 600)), "sigma0")
    assert np.isfinite(power[10, 20])
    assert np.isnan(power[:, 512:]).all()


def test_sigma0_of_level_ground_near_nadir_is_not_told():
    """Below the track the area of a cell by sin θ has no meaning: 3 dB off within 5° of it, NaN now."""
    track = straight_track(96, length_m=14.0)
    aperture = Aperture(track + [0.0, 0.0, 12.0], track + [0.0, 0.0, 12.0])
    grid = SceneGrid("local", -3.0, float(track[0, 1]) + 12.0, 0.25, (96, 24))
    found = calibrated(aperture, grid=grid)
    rows, column = slice(0, 96), slice(12, 13)
    power = found.power((rows, column), "sigma0")[:, 0]
    aside_m = np.abs(grid.positions_at(np.arange(96), np.full(96, 12), np.zeros(96))[:, 1] - track[0, 1])
    incidence_deg = np.degrees(np.arctan2(aside_m, track[0, 2] + 12.0))
    assert np.isnan(power[incidence_deg < 4.5]).all()
    assert np.isfinite(power[incidence_deg > 7.0]).all()
    assert np.isfinite(found.rcs_power((rows, column))).all()
    turn = np.linspace(0, 2 * np.pi, 256, endpoint=False)
    circle = np.stack([20 * np.cos(turn), 20 * np.sin(turn), np.full(256, 20.0)], -1)
    seen = calibrated(Aperture(circle, circle), grid=SceneGrid("local", -3.0, 3.0, 0.25, (24, 24)))
    assert np.isfinite(seen.power((slice(0, 24), slice(0, 24)), "sigma0")).all()
