"""Image measurements, and estimation of the numerical error of an image."""

import numpy as np
import pytest

from apertura.core.quality.error_check import Brightness, Certificate, error_bound, random_pixels
from apertura.core.quality.measures import coherence_factor, held, image_statistics, numerical_error_db
from apertura.core.quality.point_targets import BandLimitedPatch, cut_through, find_peak
from apertura.core.scene.grid import SceneGrid


def image_with_errors(generator, kind):
    """Return (image, exact), 96 x 96: speckle or targets (40 dB above), with uniform or proportional errors."""
    noise = generator.standard_normal((4, 96, 96))
    exact = noise[0] + 1j * noise[1]
    if kind != "speckle":
        exact[tuple(generator.integers(0, 96, (2, 12)))] *= 100
    level = np.abs(exact) if kind == "errors of bright targets" else 1.0
    return (exact + 1e-3 * level * (noise[2] + 1j * noise[3])).astype(np.complex64), exact


def certify(image, exact, seed, *, random=160, bright=112):
    """Return the certified error of an image and its true error in dB."""
    windows = list(SceneGrid("local", 0, 0, 1, image.shape).tiles(32))
    generator = np.random.default_rng(seed)
    pixels = random_pixels(windows, random, generator)
    brightness = Brightness.of(image, windows)
    bright_pixels = brightness.draw(image, windows, bright, generator)
    certificate = Certificate(windows, pixels, exact[tuple(pixels.T)])
    error = certificate.error(image, brightness, bright_pixels, exact[tuple(bright_pixels.T)])
    return error, numerical_error_db(image.ravel(), exact.ravel())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["speckle", "targets", "errors of bright targets"])
def test_error_bound_holds_with_95_percent_confidence_and_is_tight(kind):
    generator, margins_db = np.random.default_rng(4), []
    for seed in range(200):
        error, true_db = certify(*image_with_errors(generator, kind), seed)
        margins_db.append(error.bound_db - true_db)
        assert error.estimate_db == pytest.approx(true_db, abs=2.5)
    assert np.mean(np.array(margins_db) >= 0) >= 0.95
    assert 0.2 < np.median(margins_db) < 3


def test_errors_of_few_bright_pixels_are_detected():
    """One target contains almost all power and error; random pixels alone would certify only its surroundings."""
    generator = np.random.default_rng(5)
    exact = generator.standard_normal((96, 96)) + 0j
    exact[40, 50] = 1e4
    image = exact.astype(np.complex64)
    image[40:42, 50] += [0, 30]
    image[41, 50] *= 40
    error, true_db = certify(image, exact, 0)
    assert true_db > -30
    assert error.bound_db > true_db
    assert certify(image, exact, 0, random=272, bright=0)[0].bound_db < true_db - 20


def test_bound_from_uniform_draws_uses_only_their_power():
    """The bound from uniform draws without the total power holds, and is wider if few targets contain the power."""
    generator, margins_db = np.random.default_rng(6), {}
    for kind in ("speckle", "targets"):
        images = [image_with_errors(generator, kind) for _ in range(200)]
        draws = [generator.integers(0, image.size, 64) for image, _ in images]
        bounds = [
            error_bound(i.flat[d], e.flat[d], np.ones(64), power=np.abs(i.flat[d]) ** 2).bound_db
            for (i, e), d in zip(images, draws, strict=True)
        ]
        margins_db[kind] = np.array(bounds) - [numerical_error_db(i.ravel(), e.ravel()) for i, e in images]
        assert np.mean(margins_db[kind] >= 0) >= 0.95
    assert np.median(margins_db["speckle"]) < 3 < np.median(margins_db["targets"])


def test_exact_image_and_all_error_image_are_certified_correctly():
    exact = np.full(64, 2 + 1j)
    assert error_bound(exact, exact, np.ones(64), power=320.0).bound_db < -300
    assert error_bound(0 * exact, exact, np.ones(64), power=0.0).bound_db == 0
    signs = np.resize([1, -1], 64)
    assert error_bound(signs * exact, exact, np.ones(64), power=320.0).bound_db == pytest.approx(0, abs=0.01)


def test_patch_interpolation_is_exact_for_an_aliased_carrier():
    y, x = np.mgrid[:64, :64].astype(float)

    def scene(y, x):
        return np.exp(-((y - 31.3) ** 2 + (x - 30.6) ** 2) / 18) * np.exp(1j * (2.8 * y - 2.6 * x))

    patch = BandLimitedPatch(scene(y, x).astype(np.complex64), 32, 32)
    rows, columns = np.array([31.37, 29.1]), np.array([30.52, 33.8])
    np.testing.assert_allclose(patch.at(rows, columns), scene(rows, columns), atol=1e-5)


def test_pslr_and_islr_of_an_unweighted_aperture():
    """A sinc response has a PSLR of −13.26 dB, a width of 0.886 cells and an ISLR of −9.7 dB within ten cells."""
    x = np.arange(128) - 64.0
    image = np.outer(np.ones(128), np.sinc(x / 4)).astype(np.complex64)
    cut = cut_through(image, find_peak(image, 64, 64), direction=(1, 0), spacing_m=1.0, reach_m=31.0)
    assert cut.width_m == pytest.approx(0.886 * 4, rel=0.02)
    assert cut.pslr_db == pytest.approx(-13.26, abs=0.3)
    assert cut.islr_db == pytest.approx(-9.9, abs=0.5)


def test_coherence_factor_is_1_in_phase_and_1_over_m_at_random():
    generator = np.random.default_rng(2)
    draws = [coherence_factor(np.exp(2j * np.pi * generator.random(200))) for _ in range(400)]
    assert np.mean(draws) == pytest.approx(1 / 200, rel=0.15)
    assert coherence_factor(np.full(200, 3 - 2j)) == 1.0


def test_statistics_by_windows_equal_those_of_the_whole_image():
    generator = np.random.default_rng(5)
    image = (generator.standard_normal((60, 50)) + 1j * generator.standard_normal((60, 50))).astype(np.complex64)
    image[7, 8] = np.nan
    grid = SceneGrid("local", 0, 0, 1, (60, 50))
    whole, parts = (image_statistics(image, list(grid.tiles(side))) for side in (64, 16))
    assert (whole.row, whole.column, whole.noise_floor_db) == (parts.row, parts.column, parts.noise_floor_db)
    assert whole.entropy == pytest.approx(parts.entropy, abs=1e-9)
    power = np.abs(image[np.isfinite(image)]).astype(float) ** 2
    assert whole.noise_floor_db == pytest.approx(10 * np.log10(np.median(power) / power.max()), abs=0.02)
    share = power / power.sum()
    assert whole.entropy == pytest.approx(-(share * np.log(share)).sum(), abs=1e-6)


def test_only_tiles_that_miss_the_accuracy_are_listed():
    generator = np.random.default_rng(6)
    image = (generator.standard_normal((64, 64)) + 1j * generator.standard_normal((64, 64))).astype(np.complex64)
    grid = SceneGrid("local", 0, 0, 1, (64, 64))
    windows = list(grid.tiles(32))
    pixels = random_pixels(windows, 40, generator)
    certificate = Certificate(windows, pixels, image[tuple(pixels.T)].astype(np.complex128))
    assert certificate.failing(image, -60, power=2.0) == ([], [])
    worse = image.copy()
    worse[windows[2]] *= 1.01
    assert certificate.failing(worse, -60, power=2.0) == ([], [windows[2]])
    assert certificate.failing(worse, -30, power=2.0) == ([], [])


def test_tile_with_a_single_bright_pixel_is_judged_relative_to_that_pixel():
    """The error of a pixel 36 dB above the mean is relative to the power of this pixel, not to the mean power."""
    image = np.full((64, 64), 1e-3, np.complex64)
    image[5, 5] = 1.0
    windows, pixels = list(SceneGrid("local", 0, 0, 1, (64, 64)).tiles(32)), np.array([[5, 5], [40, 40]])
    power = float((np.abs(image) ** 2).mean())
    for error_db, failing in ((-50, []), (-30, [windows[0]])):
        exact = image[tuple(pixels.T)] * (1 + 10 ** (error_db / 20) * np.array([1.0, 0.0]))
        assert Certificate(windows, pixels, exact).failing(image, -40, power=power)[1] == failing


@pytest.mark.parametrize(("count", "covered_tiles"), [(9, 9), (40, 9), (4, 4)])
def test_random_pixels_cover_every_tile_if_there_are_enough(count, covered_tiles):
    windows = list(SceneGrid("local", 0, 0, 1, (70, 90)).tiles(32))
    pixels = random_pixels(windows, count, np.random.default_rng(1))
    assert len(pixels) == count
    assert len(np.unique(pixels // 32, axis=0)) == covered_tiles


@pytest.mark.slow
def test_draws_have_the_stated_density():
    """Pixels are drawn half by power, half by magnitude, plus uniformly; frequencies equal the stated density."""
    generator = np.random.default_rng(8)
    image = (generator.standard_normal((6, 7)) + 1j * generator.standard_normal((6, 7))).astype(np.complex64)
    image[2, 3] *= 8
    windows = list(SceneGrid("local", 0, 0, 1, image.shape).tiles(4))
    brightness, frequency = Brightness.of(image, windows), np.zeros(image.shape)
    for _ in range(4000):
        drawn = np.concatenate([random_pixels(windows, 6, generator), brightness.draw(image, windows, 5, generator)])
        np.add.at(frequency, tuple(drawn.T), 1 / 4000)
    pixels = np.argwhere(np.ones(image.shape, bool))
    for pixel in pixels:
        copies = np.repeat(pixel[None], 11, 0)
        density = brightness.density(copies, image[tuple(copies.T)], windows, random=6)[0]
        assert frequency[tuple(pixel)] == pytest.approx(density, abs=0.05)


def test_zero_image_has_no_bright_pixels_to_draw():
    dark, windows = np.zeros((8, 8), np.complex64), [(slice(0, 8), slice(0, 8))]
    assert Brightness.of(dark, windows).draw(dark, windows, 5, np.random.default_rng(0)).shape == (0, 2)


class CountingRaster:
    """Raster that counts the reads of each pixel."""

    def __init__(self, shape):
        self.shape, self.read = shape, np.zeros(shape, np.int16)

    def __getitem__(self, block):
        self.read[block] += 1
        return np.ones(self.shape, np.complex64)[block]


def test_small_raster_is_read_once_and_a_large_one_is_not_loaded():
    small = CountingRaster((30, 40))
    np.testing.assert_array_equal(held(small), np.ones((30, 40)))
    assert (small.read[1:, 1:] == 1).all()
    large = CountingRaster((4096, 4097))
    assert held(large) is large
