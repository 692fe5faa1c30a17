"""The grid, the engines, tiles and what is measured in an image."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod, Transformer

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.compression import compress, range_step, window_weights
from apertura.errors import CampaignError
from apertura.focus.engines import ENGINES, load_engine, reference
from apertura.focus.engines.engine import Setting
from apertura.focus.inputs import PhaseHistory, Profiles
from apertura.focus.tiles import compute_tiles, image_array
from apertura.geometry.aperture import Aperture
from apertura.geometry.geodesy import ecef_from_projected, projected_from_ecef
from apertura.quality.error_check import Certificate, certified_pixels
from apertura.quality.measures import coherence_factor, numerical_error, survey
from apertura.quality.point_targets import Patch, cut_through, find_peak
from apertura.scene.auto_grid import auto_bounds, auto_spacing, utm_crs
from apertura.scene.grid import SceneGrid
from apertura.scene.pixel_positions import block
from apertura.scene.swath import swath
from apertura.scene.terrain import FlatGround

FREQUENCY = 1.2e9 + 1.6e6 * np.arange(256)
GRID = SceneGrid("local", -4.0, 14.0, 0.1, (80, 80))
TABLE_ENGINES = [name for name in ENGINES if load_engine(name).READS == "profiles" and load_engine(name).available()]


def history(targets, *, tx=None, rx=None, window="hann"):
    along = np.linspace(-4, 4, 64)
    tx = np.stack([along, 0.02 * np.sin(along), 5 + 0 * along], -1) if tx is None else tx
    rx = tx if rx is None else rx
    transfer = np.zeros((len(tx), len(FREQUENCY)), complex)
    for target in np.atleast_2d(targets):
        path = np.linalg.norm(tx - target, axis=1) + np.linalg.norm(rx - target, axis=1)
        transfer += np.exp(-2j * np.pi * FREQUENCY * path[:, None] / SPEED_OF_LIGHT_M_S)
    weight, zeros = window_weights(window, len(FREQUENCY)), np.zeros(len(tx))
    spectra = PhaseHistory(transfer.astype(np.complex64), FREQUENCY, weight, zeros, Aperture(tx, rx))
    step, _ = range_step(FREQUENCY, oversampling=2)
    near, far = swath(GRID, FlatGround(0.0), Aperture(tx, rx))
    start = near - 32 * step
    count = int((far - near).max() / step) + 66
    samples = compress(spectra.transfer, FREQUENCY, weight=weight, reference_delay_s=zeros, start_m=start, count=count)
    return spectra, Profiles(samples, start, step, FREQUENCY[128], 2.0, Aperture(tx, rx))


def formed(name, profiles, grid=GRID):
    engine = load_engine(name)
    return engine.form(engine.prepare(profiles), grid.positions(0.0))


@pytest.mark.parametrize("name", TABLE_ENGINES)
@pytest.mark.parametrize("window", ["hann", "none"])
@pytest.mark.parametrize("bistatic", [False, True])
def test_every_engine_agrees_with_the_double_sum(name, window, bistatic):
    tx = np.stack([np.linspace(-4, 4, 64), np.zeros(64), np.full(64, 5.0)], -1)
    rx = tx + [3.0, -1.0, 2.0] if bistatic else None
    spectra, profiles = history([(0.3, 10.0, 0.0), (-2.0, 12.0, 0.0)], tx=tx, rx=rx, window=window)
    exact = reference.form(spectra, GRID.positions(0.0))
    assert numerical_error(formed(name, profiles).ravel(), exact.ravel()).rms_db < -65


@pytest.mark.parametrize("name", TABLE_ENGINES)
def test_a_target_peaks_where_it_is_with_the_amplitude_of_its_echo(name):
    _, profiles = history((0.33, 10.07, 0.0))
    image = formed(name, profiles) / 64
    peak = find_peak(image, *np.unravel_index(np.abs(image).argmax(), image.shape))
    assert (peak.column + 0.5) * 0.1 - 4.0 == pytest.approx(0.33, abs=1e-3)
    assert 14.0 - (peak.row + 0.5) * 0.1 == pytest.approx(10.07, abs=2e-3)
    assert abs(peak.value) == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("name", TABLE_ENGINES)
def test_swapping_transmitter_and_receiver_changes_nothing(name):
    tx = np.stack([np.linspace(-4, 4, 64), np.zeros(64), np.full(64, 5.0)], -1)
    one, two = (
        formed(name, history((0, 10.0, 0), tx=a, rx=b)[1]) for a, b in ((tx, tx + [2.0, 1, 1]), (tx + [2.0, 1, 1], tx))
    )
    assert numerical_error(one.ravel(), two.ravel().astype(complex)).rms_db < -90


@pytest.mark.parametrize("name", TABLE_ENGINES)
def test_a_pair_of_coincident_platforms_is_monostatic(name):
    tx = np.stack([np.linspace(-4, 4, 64), np.zeros(64), np.full(64, 5.0)], -1)
    np.testing.assert_array_equal(
        formed(name, history((0, 10.0, 0), tx=tx, rx=tx.copy())[1]), formed(name, history((0, 10.0, 0), tx=tx)[1])
    )


@pytest.mark.parametrize("name", TABLE_ENGINES)
def test_tiles_change_nothing_to_the_bit(name):
    _, profiles = history((0.33, 10.07, 0.0))
    tiled = np.zeros(GRID.shape, np.complex64)
    image = image_array(profiles, Setting(name, {}, {}, -60.0, 1.0), GRID, FlatGround(0.0), side_px=32)
    compute_tiles(image, list(GRID.tiles(32))[::-1], tiled, threads=2)
    np.testing.assert_array_equal(tiled, formed(name, profiles) / np.float32(len(profiles)))


def test_a_raised_target_focuses_where_geometry_predicts():
    """Layover: at height z it appears where the flat ground has the same path at the middle of the aperture."""
    _, profiles = history((0.0, 10.0, 0.5))
    image = formed("numba", profiles)
    peak = find_peak(image, *np.unravel_index(np.abs(image).argmax(), image.shape))
    predicted = np.sqrt(10.0**2 + 4.5**2 - 5.0**2)
    assert 14.0 - (peak.row + 0.5) * 0.1 == pytest.approx(predicted, abs=0.03)


def test_an_error_says_how_far_it_hangs_on_the_choice_of_pixels():
    """The spread over draws of pixels is what leaving out pixels tells: on speckle, and on a few targets."""
    generator = np.random.default_rng(4)
    for targets, least, most in ((0, 0.3, 0.8), (300, 2.0, 8.0)):
        scene = generator.standard_normal(40_000) + 1j * generator.standard_normal(40_000)
        scene[:targets] *= 100
        noise = 1e-3 * (generator.standard_normal(40_000) + 1j * generator.standard_normal(40_000))
        draws = [generator.integers(0, scene.size, 256) for _ in range(200)]
        found = [numerical_error((scene + noise)[draw].astype(np.complex128), scene[draw]) for draw in draws]
        spread = np.std([one.rms_db for one in found])
        assert least < spread < most
        assert np.median([one.std_db for one in found]) == pytest.approx(spread, rel=0.4)


def test_the_grid_is_anchored_at_its_north_west_corner():
    grid = SceneGrid.from_bounds("EPSG:32632", (570656.9, 5363687.65, 570670.9, 5363701.65), spacing_m=0.05)
    assert grid.shape == (280, 280)
    np.testing.assert_allclose(grid.bounds_m, (570656.9, 5363687.65, 570670.9, 5363701.65), atol=1e-6)
    assert grid.x_m[0] == pytest.approx(570656.925)
    assert grid.y_m[0] == pytest.approx(5363701.625)


def test_tiles_cover_the_grid_once_and_slicing_keeps_the_places():
    grid = SceneGrid("EPSG:32632", 570656.9, 5363701.65, 0.05, (100, 70))
    count = np.zeros(grid.shape, int)
    whole = grid.positions(620.0)
    for window in grid.tiles(32):
        count[window] += 1
        np.testing.assert_array_equal(grid[window].positions(620.0), whole[window])
    assert (count == 1).all()


@given(
    crs=st.sampled_from(["local", "EPSG:32632"]),
    spacing_m=st.floats(0.01, 50.0),
    shape=st.tuples(st.integers(1, 600), st.integers(1, 600)),
    side=st.integers(40, 300),
    data=st.data(),
)
@settings(max_examples=40, deadline=None)
def test_map_frame_and_pixel_are_one_another_undone_and_windows_have_the_coordinates_of_the_whole(
    crs, spacing_m, shape, side, data
):
    grid = SceneGrid(crs, 570656.9, 5363701.65, spacing_m, shape)
    window = data.draw(st.sampled_from(list(grid.tiles(side))))
    part = grid[window]
    np.testing.assert_array_equal(part.x_m, grid.x_m[window[1]])
    np.testing.assert_array_equal(part.y_m, grid.y_m[window[0]])
    row, column, height_m = (data.draw(st.floats(-5.0, 700.0)) for _ in range(3))
    tolerance_px = 1e-8 / spacing_m + 1e-9  # coordinates of millions of metres hold a nanometre or so
    np.testing.assert_allclose(part.pixel_of(*part.map_at(row, column)), (row, column), atol=tolerance_px)
    place = part.pixel_below(part.positions_at(row, column, height_m))
    np.testing.assert_allclose(place, (row, column, height_m), rtol=0, atol=10 * tolerance_px + 1e-8)
    whole = grid.pixel_of(*part.map_at(row, column))
    np.testing.assert_allclose(whole, (row + window[0].start, column + window[1].start), atol=tolerance_px)


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:2056", "EPSG:3413", "EPSG:3857"])
@pytest.mark.parametrize("spacing_m", [0.002, 1.0, 30.0, 300.0])
def test_pixels_are_where_proj_puts_them_on_any_ground(crs, spacing_m):
    """To 10 nm, far below the wavelength; in between nodes, across blocks, on and high above the ellipsoid."""
    west_m, north_m = {"EPSG:32632": (330e3, 9.2e6), "EPSG:2056": (2.6e6, 1.2e6)}.get(crs, (1e6, -2e6))
    grid = SceneGrid(crs, west_m, north_m, spacing_m, (300, 270))[3:, 5:]
    height = np.random.default_rng(1).uniform(-400, 4000, grid.shape)
    for above in (620.0, height):
        exact = ecef_from_projected(crs, *np.meshgrid(grid.x_m, grid.y_m), np.broadcast_to(above, grid.shape))
        np.testing.assert_allclose(grid.positions(above), exact, rtol=0, atol=1e-8)


def test_blocks_too_wide_for_polynomials_are_placed_by_proj():
    options = ("EPSG:32632", (9.2e6, 330e3))
    assert block(*options, 1.0, (0, 0)).exact
    assert not block(*options, 300.0, (0, 0)).exact


def test_pixels_are_where_their_coordinates_say():
    grid = SceneGrid("EPSG:32632", 570656.9, 5363701.65, 0.05, (4, 4))
    np.testing.assert_allclose(
        projected_from_ecef("EPSG:32632", grid.positions(620.0))[1, 2], [570657.025, 5363701.575, 620.0], atol=1e-4
    )
    longitude, latitude = Transformer.from_crs(32632, 4326, always_xy=True).transform(grid.x_m[:2], grid.y_m[[0, 0]])
    ground = Geod(ellps="WGS84").inv(longitude[0], latitude[0], longitude[1], latitude[1])[2]
    ecef = np.linalg.norm(
        np.diff(ecef_from_projected("EPSG:32632", grid.x_m[:2], grid.y_m[[0, 0]], np.zeros(2)), axis=0)
    )
    assert ecef == pytest.approx(ground, rel=1e-6)


@pytest.mark.parametrize(("crs", "expected"), [("EPSG:4326", "not projected"), ("EPSG:99999", "unknown to PROJ")])
def test_a_crs_that_is_no_map_in_metres_is_refused(crs, expected):
    with pytest.raises(CampaignError, match=expected):
        SceneGrid.from_bounds(crs, (0, 0, 1, 1), spacing_m=1)


def test_the_swath_holds_every_pixel_and_little_more():
    tx = np.array([[0.0, 0.0, 5.0], [1.0, 11.0, 3.0]])
    rx = tx + [1.0, 2.0, 0.0]
    near, far = swath(GRID, FlatGround(0.0), Aperture(tx, rx))
    pixels = GRID.positions(0.0).reshape(-1, 3)
    path = np.linalg.norm(pixels - tx[:, None], axis=-1) + np.linalg.norm(pixels - rx[:, None], axis=-1)
    assert (near <= path.min(axis=1)).all()
    assert (far >= path.max(axis=1)).all()
    assert (far - near - np.ptp(path, axis=1)).max() < 1.5


def test_automatic_spacing_resolves_the_finest_cell():
    along = np.linspace(-4, 4, 64)
    tx = np.stack([along, 0 * along, 5 + 0 * along], -1)
    spacing = auto_spacing(Aperture(tx, tx), FREQUENCY, crs="local", bounds_m=(-4, 6, 4, 14), height_m=0.0)
    _, profiles = history((0.0, 10.0, 0.0))
    image = formed("numba", profiles)
    peak = find_peak(image, *np.unravel_index(np.abs(image).argmax(), image.shape))
    width = cut_through(image, peak, direction=(1, 0), spacing_m=0.1, reach_m=1.0).width_m
    assert width / 8 < spacing < width / 2


def test_automatic_bounds_hold_ground_on_both_sides_of_the_track():
    tx = np.stack([np.linspace(-4, 4, 5), np.zeros(5), np.full(5, 5.0)], -1)
    _, ymin, _, ymax = auto_bounds(Aperture(tx, tx), crs="local", height_m=0.0, path_limit_m=np.inf)
    assert ymax == -ymin == pytest.approx(5 / np.tan(np.radians(10)), abs=1)
    assert auto_bounds(Aperture(tx, tx), crs="local", height_m=0.0, path_limit_m=20.0)[3] == pytest.approx(
        np.sqrt(75), abs=1
    )
    assert utm_crs(ecef_from_projected("EPSG:32755", *map(np.array, (5e5, 6.1e6, 0.0)))) == "EPSG:32755"


def test_the_patch_is_exact_between_pixels_although_the_carrier_folds():
    y, x = np.mgrid[:64, :64].astype(float)

    def scene(y, x):
        return np.exp(-((y - 31.3) ** 2 + (x - 30.6) ** 2) / 18) * np.exp(1j * (2.8 * y - 2.6 * x))

    patch = Patch(scene(y, x).astype(np.complex64), 32, 32)
    rows, columns = np.array([31.37, 29.1]), np.array([30.52, 33.8])
    np.testing.assert_allclose(patch.at(rows, columns), scene(rows, columns), atol=1e-5)


def test_pslr_and_islr_of_an_unweighted_aperture():
    """Of a sinc: PSLR −13.26 dB, −3 dB width 0.886 cells, ISLR about −9.7 dB within ten cells."""
    x = np.arange(128) - 64.0
    image = np.outer(np.ones(128), np.sinc(x / 4)).astype(np.complex64)
    cut = cut_through(image, find_peak(image, 64, 64), direction=(1, 0), spacing_m=1.0, reach_m=31.0)
    assert cut.width_m == pytest.approx(0.886 * 4, rel=0.02)
    assert cut.pslr_db == pytest.approx(-13.26, abs=0.3)
    assert cut.islr_db == pytest.approx(-9.9, abs=0.5)


def test_coherence_is_one_in_phase_and_one_over_m_at_random():
    generator = np.random.default_rng(2)
    draws = [coherence_factor(np.exp(2j * np.pi * generator.random(200))) for _ in range(400)]
    assert np.mean(draws) == pytest.approx(1 / 200, rel=0.15)
    assert coherence_factor(np.full(200, 3 - 2j)) == 1.0


def test_a_survey_by_windows_is_the_survey_of_the_whole():
    generator = np.random.default_rng(5)
    image = (generator.standard_normal((60, 50)) + 1j * generator.standard_normal((60, 50))).astype(np.complex64)
    image[7, 8] = np.nan
    grid = SceneGrid("local", 0, 0, 1, (60, 50))
    whole, parts = (survey(image, list(grid.tiles(side))) for side in (64, 16))
    assert (whole.row, whole.column, whole.noise_floor_db) == (parts.row, parts.column, parts.noise_floor_db)
    assert whole.entropy == pytest.approx(parts.entropy, abs=1e-9)
    power = np.abs(image[np.isfinite(image)]).astype(float) ** 2
    assert whole.noise_floor_db == pytest.approx(10 * np.log10(np.median(power) / power.max()), abs=0.02)
    share = power / power.sum()
    assert whole.entropy == pytest.approx(-(share * np.log(share)).sum(), abs=1e-6)


def test_a_tile_that_misses_the_accuracy_is_found_and_the_others_are_not():
    generator = np.random.default_rng(6)
    image = (generator.standard_normal((64, 64)) + 1j * generator.standard_normal((64, 64))).astype(np.complex64)
    grid = SceneGrid("local", 0, 0, 1, (64, 64))
    windows = list(grid.tiles(32))
    pixels = certified_pixels(image, windows, 40, generator)
    certificate = Certificate(pixels, image[tuple(pixels.T)].astype(np.complex128), 40)
    assert certificate.failing(image, windows, -60) == ([], [])
    worse = image.copy()
    worse[windows[2]] *= 1.01
    assert certificate.failing(worse, windows, -60) == ([], [windows[2]])
    assert certificate.failing(worse, windows, -30) == ([], [])
    assert -60 < certificate.error(worse).rms_db < -40
