"""Radar cross-section of points and σ⁰ of terrain, from images of simulated echoes."""

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


def straight_aperture(pulses=96, *, bistatic=False, length_m=14.0):
    track = straight_track(pulses, length_m=length_m) + [0.0, 0.0, 12.0]
    return Aperture(track, track + ([5.0, 1.0, 2.0] if bistatic else 0.0))


def history(aperture, point, window, beams=None, amplitude=1.0):
    """Return the echo of one point of given amplitude, weighted by both antenna patterns."""
    echo = transfer(Scatterers(np.array([point]), np.array([amplitude + 0j])), aperture, FREQUENCY)
    if beams is not None:
        echo = echo * beams.antennas.weight(aperture, np.array([point]))
    return PhaseHistory(echo, FREQUENCY, window_weights(window, 128), np.zeros(len(aperture)), aperture)


def calibrated(aperture, beams=None, *, window="none", terrain=LEVEL, grid=GRID, **options):
    cell_m2 = cell_constant(FREQUENCY, window_weights(window, 128))
    return Calibration.of(
        grid, terrain, aperture, beams, constant=options.pop("constant", 1.0), cell_m2=cell_m2, **options
    )


def pattern(aperture):
    beam = side_beam((50.0, 40.0), pulses=len(aperture))
    return Beams(beam, beam, Sector.of(aperture, chord_m=1.0, centre=0.0, half=0.3))


@pytest.mark.parametrize("bistatic", [False, True])
@pytest.mark.parametrize("point", [(0.0, 20.0, 0.0), (-2.5, 17.5, 0.0), (2.5, 22.5, 0.0)])
def test_cross_section_of_a_point_follows_from_its_peak(point, bistatic):
    """Eqs. 3 and 4 include spreading loss, patterns and sector weights, for any normalisation of the image."""
    aperture = straight_aperture(bistatic=bistatic)
    beams = pattern(aperture)
    echo = history(aperture, point, "hann", beams, amplitude=np.sqrt(7.0 * 0.1))
    (peak,) = reference.form(echo, np.array([point]), beams=beams) / 60
    (per_m2,), _ = calibrated(aperture, beams, constant=7.0, count=60).at(np.array([point]))
    assert 10 * np.log10(abs(peak) ** 2 / per_m2 / 0.1) == pytest.approx(0, abs=1e-3)


SLOPES = [(0.0, 0.0), (0.0, 0.2), (0.0, -0.2), (0.0, 0.4), (0.0, -0.4), (0.2, 0.0), (-0.4, 0.0), (0.3, -0.3)]
"""Slope eastward (along the track) and northward (away from it)."""


def normal_of(along, up):
    return np.array([[[-along, -up, 1.0]]]) / np.sqrt(1 + along**2 + up**2)


def response_area_m2(aperture, window, slope):
    """Return ∫|response|² over the surface divided by its peak, as eq. 5, by summation."""
    east, north = np.meshgrid(np.arange(-9, 9, 0.08), np.arange(8, 32, 0.08))
    height = slope[0] * east + slope[1] * (north - 20.0)
    echo = history(aperture, (0.0, 20.0, 0.0), window)
    image = reference.form(echo, np.stack([east, north, height], -1))
    (peak,) = reference.form(echo, np.array([[0.0, 20.0, 0.0]]))
    return float((np.abs(image) ** 2).sum() / abs(peak) ** 2 * 0.08**2 * np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2))


@pytest.mark.slow
@pytest.mark.parametrize("slope", SLOPES)
@pytest.mark.parametrize(("bistatic", "window"), [(False, "none"), (True, "none"), (True, "hann")])
def test_cell_area_equals_that_of_the_point_response(bistatic, slope, window):
    """Eqs. 5 and 6: by Parseval, the cell area is that of the point response, also on slopes."""
    aperture = straight_aperture(bistatic=bistatic)
    terrain = Plane(0.0, 20.0, 0.0, *slope) if any(slope) else LEVEL
    calibration = calibrated(aperture, window=window, terrain=terrain)
    area = calibration.power(MIDDLE, "sigma0", normal_of(*slope))[0, 0] / calibration.rcs_power(MIDDLE)[0, 0]
    summed_area = response_area_m2(aperture, window, slope)
    assert 10 * np.log10(area / summed_area) == pytest.approx(0, abs=0.15)


def clutter(aperture, slope, beams, seed, side_m=0.35):
    """Return the echo of terrain of σ⁰ = 1: a random scatterer per square, weighted by both patterns."""
    generator = np.random.default_rng(seed)
    corners = np.stack(np.meshgrid(np.arange(-26, 26, side_m), np.arange(6, 75, side_m)), -1).reshape(-1, 2)
    x, y = (corners + side_m * generator.uniform(size=corners.shape)).T
    points = np.column_stack([x, y, slope[0] * x + slope[1] * (y - 35.0)])
    area_m2 = side_m**2 * np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    amplitude = np.sqrt(area_m2 / 2) * (generator.standard_normal((len(x), 2)) @ [1, 1j])

    def pulse_echo(part):
        gain = 1.0 if beams is None else beams[part].antennas.weight(aperture[part], points)[0]
        return transfer(Scatterers(points, amplitude * gain), aperture[part], FREQUENCY, gridded=True)

    parts = [slice(0, len(aperture))] if beams is None else [slice(pulse, pulse + 1) for pulse in range(len(aperture))]
    return np.concatenate([pulse_echo(part) for part in parts])


@pytest.mark.slow
@pytest.mark.parametrize("bistatic", [False, True])
@pytest.mark.parametrize(
    ("slope", "beam"), [((0.0, 0.0), False), ((0.0, 0.2), False), ((0.0, -0.2), False), ((0.0, 0.0), True)]
)
def test_simulated_clutter_has_its_sigma0_over_the_swath(slope, beam, bistatic):
    """Errors are within 0.2 dB for incidences of 30° to 70°, slopes of 20 %, and the far beam edge, 3 to 24 dB down.

    At the beam edge, without a window, sidelobes of the brighter near terrain would add 1 dB.
    """
    window = "hann" if beam else "none"
    aperture, grid = (
        straight_aperture(64, bistatic=bistatic, length_m=6.0),
        SceneGrid("local", -8.0, 62.0, 0.25, (196, 64)),
    )
    terrain = Plane(0.0, 35.0, 0.0, *slope) if any(slope) else LEVEL
    beam_pattern = side_beam((70.0, 25.0), boresight_deg=(-90.0, -45.0), pulses=len(aperture))
    beams = Beams(beam_pattern, beam_pattern) if beam else None
    power_per_sigma0 = calibrated(aperture, beams, window=window, terrain=terrain, grid=grid).power(
        (slice(0, 196), slice(0, 64)), "sigma0", np.broadcast_to(normal_of(*slope), (196, 64, 3))
    )
    points, ratios = terrain.positions(grid), []
    for seed in range(6):
        echo = clutter(aperture, slope, beams, seed)
        echo_history = PhaseHistory(echo, FREQUENCY, window_weights(window, 128), np.zeros(len(aperture)), aperture)
        ratios.append(np.abs(reference.form(echo_history, points, beams=beams) / len(aperture)) ** 2 / power_per_sigma0)
    incidence = np.degrees(np.arctan2(points[..., 1], 22.0 - points[..., 2]))
    swath = (incidence > 30) & (incidence < 70)
    if beam:  # boresight 45° down, 25° wide, transmit and receive
        swath = (incidence > 52) & (incidence < 70)
    assert 10 * np.log10(np.mean(ratios, axis=0)[swath].mean()) == pytest.approx(0, abs=0.2)


@pytest.mark.parametrize("slope", SLOPES)
def test_monostatic_facet_area_follows_from_the_incidence(slope):
    """Eq. 9: a_s/a is the sine of the incidence in the range plane times the cosine of the tilt out of it."""
    aperture = straight_aperture(length_m=0.5)  # short enough for a single viewing position
    calibration = calibrated(aperture, terrain=Plane(0.0, 20.0, 0.0, *slope))
    incidence, rise = np.arctan2(20.0, 22.0), np.arctan(slope[1])
    tilt = np.arctan(slope[0] * np.cos(rise))  # of the facet out of the range plane
    ratio = calibration.power(MIDDLE, "beta0")[0, 0] / calibration.power(MIDDLE, "sigma0", normal_of(*slope))[0, 0]
    assert ratio == pytest.approx(np.sin(incidence - rise) * np.cos(tilt), rel=0.01)


@pytest.mark.parametrize("slope", SLOPES)
def test_bistatic_facet_area_follows_from_range_and_doppler_gradients(slope):
    """Eq. 9: a facet between two ranges and two Doppler frequencies has an area of 1/|∇r × ∇f| on its plane."""
    aperture = straight_aperture(bistatic=True, length_m=0.5)
    calibration = calibrated(aperture, terrain=Plane(0.0, 20.0, 0.0, *slope))
    normal, point, step = normal_of(*slope)[0, 0], np.array([0.0625, 19.9375, 0.0]), 1e-3

    def path(point, pulse):
        single = aperture[pulse : pulse + 1]
        return np.linalg.norm(point - single.tx_m[0]) + np.linalg.norm(point - single.rx_m[0])

    def range_and_doppler(point):
        return np.array([path(point, 48), path(point, 60) - path(point, 36)])

    point[2] = slope[0] * point[0] + slope[1] * (point[1] - 20.0)
    gradients = np.stack(
        [range_and_doppler(point + offset) - range_and_doppler(point - offset) for offset in step * np.eye(3)], -1
    )
    across = np.cross(*gradients)
    ratio = calibration.power(MIDDLE, "beta0")[0, 0] / calibration.power(MIDDLE, "sigma0", normal_of(*slope))[0, 0]
    assert ratio == pytest.approx(abs(across @ normal) / np.linalg.norm(across), rel=0.01)


@pytest.mark.parametrize("bistatic", [False, True])
def test_sigma0_is_undefined_near_layover(bistatic):
    """Layover starts where the slope equals the incidence on level terrain, 42°; area and error diverge there."""
    aperture, area_ratio = straight_aperture(bistatic=bistatic), {}
    for up in (0.0, 0.3, 0.6, 0.9, 1.0, 3.0):
        calibration = calibrated(aperture, terrain=Plane(0.0, 20.0, 0.0, 0.0, up))
        area_ratio[up] = (
            calibration.power(MIDDLE, "sigma0", normal_of(0.0, up))[0, 0] / calibration.rcs_power(MIDDLE)[0, 0]
        )
    assert 2 * area_ratio[0.0] < 1.5 * area_ratio[0.3] < area_ratio[0.6]
    assert np.isnan([area_ratio[up] for up in (0.9, 1.0, 3.0)]).all()
    assert np.isfinite(calibration.power(MIDDLE, "beta0", normal_of(0.0, 1.0))).all()
    steep = normal_of(0.0, -3.0)  # steep back slope: shadow, reported by the mask
    assert np.isnan(calibration.power(MIDDLE, "gamma0", steep)).all()


def test_gain_and_area_are_accurate_between_lattice_nodes():
    aperture, grid = straight_aperture(), SceneGrid("local", -3.0, 23.0, 0.05, (120, 120))
    beams = pattern(aperture)
    calibration, window = calibrated(aperture, beams, grid=grid), (slice(8, 9), slice(24, 25))
    (per_m2,), (noise,) = calibration.at(LEVEL.positions(grid[window])[0])
    assert calibration.rcs_power(window)[0, 0] == pytest.approx(per_m2, rel=0.02)
    assert calibration.pixel_noise(window)[0, 0] == pytest.approx(noise, rel=0.02)
    local_calibration = calibrated(aperture, beams, grid=grid[window])
    assert calibration.cell(window)[0, 0] == pytest.approx(
        local_calibration.cell((slice(0, 1), slice(0, 1)))[0, 0], rel=0.02
    )


def test_track_flown_twice_has_the_same_resolution():
    """The azimuths repeat; a plain sum over pulses in eq. 5 would halve the cell."""
    once = straight_aperture(200)
    twice = Aperture(np.concatenate([once.tx_m, once.tx_m[::-1]]), np.concatenate([once.rx_m, once.rx_m[::-1]]))
    assert calibrated(twice).cell(MIDDLE)[0, 0] == pytest.approx(calibrated(once).cell(MIDDLE)[0, 0], rel=0.01)


def test_beta_sigma_and_gamma_differ_by_the_incidence():
    """For level terrain in a monostatic broadside image, σ⁰ = β⁰ sin θ and γ⁰ = σ⁰/cos θ."""
    calibration, window = calibrated(straight_aperture()), MIDDLE
    incidence = np.arctan2(20.0, 12.0 + 10.0)
    power = {name: calibration.power(window, name)[0, 0] for name in ("sigma0", "beta0", "gamma0")}
    assert power["beta0"] / power["sigma0"] == pytest.approx(np.sin(incidence), rel=0.01)
    assert power["gamma0"] / power["sigma0"] == pytest.approx(np.cos(incidence), rel=0.02)


def test_link_constant_follows_from_the_radar_equation():
    """With 1 W, two gains of 10 dBi and 0.25 m, 1 m² at 1 m returns 3.15 mW; gain 20 dB, full scale 30 dBm."""
    link = Link(30.0, 10.0, 10.0, 20.0, 30.0, 1000.0)
    received_w = 100 * 0.25**2 / (4 * np.pi) ** 3
    assert link.constant(wavelength_m=0.25, sent_power=64.0) == pytest.approx(received_w * 100 * 1000**2 / 64)
    noise = link.pulse_noise(3.0, spacing_hz=1e5, squares=1 / 64)
    assert noise == pytest.approx(1.380649e-23 * 290 * 10**0.3 * 1e5 * 1e8 / 64)


@pytest.mark.quick("terrain1")
@pytest.mark.parametrize("terrain", [LEVEL, Plane(0.0, 20.0, 0.0, 0.0, -0.3)])
def test_calibrated_image_has_sigma0_and_cross_section(terrain):
    """A point of 0.1 m² lies at the corner of four pixels, with K = 7; σ⁰ is the cross-section over the cell area."""
    aperture = straight_aperture()
    height = float(terrain.heights_at(GRID, np.array([23.5]), np.array([23.5]))[0])
    x, y = GRID.map_at(np.array([23]), np.array([23]))[0]
    echo = history(aperture, (x, y, height), "hann", amplitude=np.sqrt(7.0 * 0.1))
    image = ap.backproject(echo, GRID, terrain=terrain, calibration=7.0, integration="all", tile_px=16)
    assert image.rcs.chunks == image.chunks
    computed = image.compute()
    assert 10 * np.log10(float(computed.rcs[23, 23]) / 0.1) == pytest.approx(0, abs=0.1)
    calibration = calibrated(aperture, window="hann", terrain=terrain, constant=7.0)
    whole = (slice(0, 48), slice(0, 48))
    normal = None if terrain is LEVEL else surface(GRID, terrain, whole)[1]
    np.testing.assert_allclose(
        computed.sigma0, np.abs(computed) ** 2 / calibration.power(whole, "sigma0", normal), rtol=1e-4
    )
    assert computed.sigma0.attrs["standard_name"] == "surface_backwards_scattering_coefficient_of_radar_wave"
    assert (computed.sigma0.attrs["units"], computed.rcs.attrs["units"]) == ("1", "m2")
    assert "sigma0" not in ap.backproject(echo, GRID, terrain=terrain, certified_pixels=0).coords


def test_calibration_requires_a_positive_constant_and_the_band():
    echo = history(straight_aperture(), (0.0, 20.0, 0.0), "hann")
    with pytest.raises(CampaignError, match=r"calibration: a constant of -1\.0; expected a positive number"):
        ap.backproject(echo, GRID, calibration=-1.0)
    with pytest.raises(CampaignError, match="expected a PhaseHistory, or the dataset of stage echo"):
        ap.backproject(ap.range_compress(echo, GRID, LEVEL), GRID, calibration=1.0)


def test_attitude_error_changes_the_power_by_the_slope_of_the_pattern():
    """Eq. 9: for a point 15° below the axis of a Gaussian beam of 40° and 2° of roll, 24·θ·δθ/w² per antenna."""
    aperture = Aperture(*2 * [np.tile([0.0, 0.0, 12.0], (8, 1))])
    beam = side_beam((50.0, 40.0), pulses=8)
    boresight = beam.axes[0, 0]
    below = np.arctan2(-boresight[2], boresight[1]) + np.radians(15.0)
    point = np.array([0.0, 12.0 / np.tan(below), 0.0])
    roll = np.radians(2.0) * np.array([1.0, 0.0, 0.0])
    slope_db = 24.08 * 15.0 * 2.0 / 40.0**2
    both_antennas, one_antenna = ((True, True), (True, False))
    for antennas, expected in ((both_antennas, 2 * slope_db), (one_antenna, slope_db)):
        assert pointing_std_db(Beams(beam, beam), aperture, point, [(roll, antennas)]) == pytest.approx(
            expected, rel=0.02
        )
    independent = pointing_std_db(Beams(beam, beam), aperture, point, [(roll, (True, False)), (roll, (False, True))])
    assert independent == pytest.approx(np.sqrt(2) * slope_db, rel=0.02)
    assert pointing_std_db(None, aperture, point, [(roll, both_antennas)]) == 0
    level = np.array([0.0, 12.0 / np.tan(below - np.radians(15.0)), 0.0])
    flat_db = pointing_std_db(Beams(beam, beam), aperture, level, [(roll, both_antennas)])
    # On the axis, only the quadratic term remains.
    assert flat_db == pytest.approx(2 * 12.04 * (2.0 / 40.0) ** 2, rel=0.02)


def test_how_to_example_gives_the_simulated_cross_section():
    page = Path(__file__).parents[1] / "docs/howto/calibrate_radiometry.md"
    names = {}
    exec(page.read_text().split("```python\n")[1].split("```")[0], names)
    assert names["largest_m2"] == pytest.approx(2.0, rel=0.03)
    assert names["image"].sigma0.attrs["units"] == "1"
    assert names["image"].rcs.attrs["units"] == "m2"
    assert float(names["sigma0_db"].max()) > 10


def test_terrain_outside_every_beam_has_no_calibration():
    """The far pixels along the track form a separate block outside the beam."""
    track = np.stack([np.linspace(-2, 2, 40), np.full(40, -20.0), np.full(40, 10.0)], -1)
    aperture, width = Aperture(track, track), np.radians([-10.0, 0.0, 10.0])
    axes = np.tile(np.array([[0.0, 1, 0], [-1.0, 0, 0], [0.0, 0, 1]]), (40, 1, 1))
    beam = Beam(axes, width, np.array([0.5, 1, 0.5]), 6 * width, np.ones(3))
    grid = SceneGrid("local", -5.0, 5.0, 0.25, (20, 600))
    calibration = Calibration.of(grid, FlatGround(0.0), aperture, Beams(beam, beam), constant=1.0, cell_m2=0.1)
    power = calibration.power((slice(0, 20), slice(0, 600)), "sigma0")
    assert np.isfinite(power[10, 20])
    assert np.isnan(power[:, 512:]).all()


def test_sigma0_of_level_terrain_near_nadir_is_undefined():
    """The cell area diverges below the track; its error reaches 3 dB within 5°, where σ⁰ is NaN."""
    track = straight_track(96, length_m=14.0)
    aperture = Aperture(track + [0.0, 0.0, 12.0], track + [0.0, 0.0, 12.0])
    grid = SceneGrid("local", -3.0, float(track[0, 1]) + 12.0, 0.25, (96, 24))
    calibration = calibrated(aperture, grid=grid)
    rows, column = slice(0, 96), slice(12, 13)
    power = calibration.power((rows, column), "sigma0")[:, 0]
    ground_range_m = np.abs(grid.positions_at(np.arange(96), np.full(96, 12), np.zeros(96))[:, 1] - track[0, 1])
    incidence_deg = np.degrees(np.arctan2(ground_range_m, track[0, 2] + 12.0))
    assert np.isnan(power[incidence_deg < 4.5]).all()
    assert np.isfinite(power[incidence_deg > 7.0]).all()
    assert np.isfinite(calibration.rcs_power((rows, column))).all()
    angle = np.linspace(0, 2 * np.pi, 256, endpoint=False)
    circle = np.stack([20 * np.cos(angle), 20 * np.sin(angle), np.full(256, 20.0)], -1)
    circular = calibrated(Aperture(circle, circle), grid=SceneGrid("local", -3.0, 3.0, 0.25, (24, 24)))
    assert np.isfinite(circular.power((slice(0, 24), slice(0, 24)), "sigma0")).all()
