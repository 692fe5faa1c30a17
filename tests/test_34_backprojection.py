"""Backprojection engines, tiles and grid spacing, compared with the double sum over pulses and subcarriers."""

import numpy as np
import pytest

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.backprojection.engines import ENGINES, load_engine, reference
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.tiles import compute_tiles, image_array
from apertura.core.echo.compression import compress, range_step, window_weights
from apertura.core.geometry.aperture import Aperture
from apertura.core.quality.measures import numerical_error_db
from apertura.core.quality.point_targets import cut_through, find_peak
from apertura.core.scene.auto_grid import auto_spacing
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import swath
from apertura.core.scene.terrain import FlatGround

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


def formed(name, profiles, grid=GRID, **options):
    engine = load_engine(name)
    return engine.form(engine.prepare(profiles), grid.positions(0.0), **options)


@pytest.mark.quick("False-hann-*", "True-none-*")
@pytest.mark.parametrize("name", TABLE_ENGINES)
@pytest.mark.parametrize("window", ["hann", "none"])
@pytest.mark.parametrize("bistatic", [False, True])
def test_every_engine_agrees_with_the_double_sum(name, window, bistatic):
    tx = np.stack([np.linspace(-4, 4, 64), np.zeros(64), np.full(64, 5.0)], -1)
    rx = tx + [3.0, -1.0, 2.0] if bistatic else None
    spectra, profiles = history([(0.3, 10.0, 0.0), (-2.0, 12.0, 0.0)], tx=tx, rx=rx, window=window)
    exact = reference.form(spectra, GRID.positions(0.0))
    assert numerical_error_db(formed(name, profiles).ravel(), exact.ravel()) < -65


@pytest.mark.parametrize("name", TABLE_ENGINES)
def test_target_peaks_at_its_position_with_the_amplitude_of_its_echo(name):
    _, profiles = history((0.33, 10.07, 0.0))
    image = formed(name, profiles) / 64
    peak = find_peak(image, *np.unravel_index(np.abs(image).argmax(), image.shape))
    assert (peak.column + 0.5) * 0.1 - 4.0 == pytest.approx(0.33, abs=1e-3)
    assert 14.0 - (peak.row + 0.5) * 0.1 == pytest.approx(10.07, abs=2e-3)
    assert abs(peak.value) == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("name", TABLE_ENGINES)
def test_swapping_transmitter_and_receiver_leaves_the_image_unchanged(name):
    tx = np.stack([np.linspace(-4, 4, 64), np.zeros(64), np.full(64, 5.0)], -1)
    image, swapped = (
        formed(name, history((0, 10.0, 0), tx=a, rx=b)[1]) for a, b in ((tx, tx + [2.0, 1, 1]), (tx + [2.0, 1, 1], tx))
    )
    assert numerical_error_db(image.ravel(), swapped.ravel().astype(complex)) < -90


@pytest.mark.parametrize("name", TABLE_ENGINES)
def test_coincident_platforms_give_the_monostatic_image(name):
    tx = np.stack([np.linspace(-4, 4, 64), np.zeros(64), np.full(64, 5.0)], -1)
    np.testing.assert_array_equal(
        formed(name, history((0, 10.0, 0), tx=tx, rx=tx.copy())[1]), formed(name, history((0, 10.0, 0), tx=tx)[1])
    )


def test_raised_target_is_laid_over_as_geometry_predicts():
    """Layover: the target appears where flat terrain has the same path length at the aperture centre."""
    _, profiles = history((0.0, 10.0, 0.5))
    image = formed("numba", profiles)
    peak = find_peak(image, *np.unravel_index(np.abs(image).argmax(), image.shape))
    predicted = np.sqrt(10.0**2 + 4.5**2 - 5.0**2)
    assert 14.0 - (peak.row + 0.5) * 0.1 == pytest.approx(predicted, abs=0.03)


def test_automatic_spacing_samples_the_finest_resolution_cell():
    along = np.linspace(-4, 4, 64)
    tx = np.stack([along, 0 * along, 5 + 0 * along], -1)
    spacing = auto_spacing(Aperture(tx, tx), FREQUENCY, crs="local", bounds_m=(-4, 6, 4, 14), height_m=0.0)
    _, profiles = history((0.0, 10.0, 0.0))
    image = formed("numba", profiles)
    peak = find_peak(image, *np.unravel_index(np.abs(image).argmax(), image.shape))
    width = cut_through(image, peak, direction=(1, 0), spacing_m=0.1, reach_m=1.0).width_m
    assert width / 8 < spacing < width / 2


@pytest.mark.parametrize("name", TABLE_ENGINES)
def test_tiled_image_is_bit_identical(name):
    grid = GRID[:64, :64]  # the tree divides a block of pixels into pieces of equal size
    _, profiles = history((0.33, 10.07, 0.0))
    tiled, options = np.zeros(grid.shape, np.complex64), {"side_px": 32} if name == "tree" else {}
    image = image_array(profiles, Setting(name, {}, options, -60.0, 1.0), grid, FlatGround(0.0), side_px=32)
    compute_tiles(image, list(grid.tiles(32))[::-1], tiled, threads=2)
    np.testing.assert_array_equal(tiled, formed(name, profiles, grid, **options) / np.float32(len(profiles)))
