"""Coherence and phase of two images: docs/theory/interferometry.md, section 1."""

import numpy as np
import pytest

from apertura.methods.interferometry.coherence import chance, coherence, common_band, unbiased, window_px

SIDE = 256
INSIDE = (slice(8, -8), slice(8, -8))


def random_scene(seed):
    """Draw a scene with one random scatterer per pixel."""
    generator = np.random.default_rng(seed)
    return (generator.normal(size=(SIDE, SIDE)) + 1j * generator.normal(size=(SIDE, SIDE))) / np.sqrt(2)


def imaged(scene, *, middle=(0.0, 0.0), width=0.5):
    """Return the image of a scene with a band of `width` cycles per pixel about a carrier."""
    cycles = np.fft.fftfreq(SIDE)
    down, across = (np.abs((cycles - carrier + 0.5) % 1 - 0.5) < width / 2 for carrier in middle)
    return np.fft.ifft2(np.fft.fft2(scene) * np.outer(down, across)).astype(np.complex64)


def test_images_with_different_carriers_have_a_uniform_phase():
    scene = random_scene(1)
    first, second = imaged(scene, middle=(0.1, 0.3)), imaged(scene, middle=(0.1, 0.4))
    magnitude, phase, _ = coherence(1j * first, second, window=9)
    assert magnitude[INSIDE].mean() == pytest.approx(0.8, abs=0.02)  # 0.4 of 0.5 cycles per pixel
    assert np.mean(np.exp(1j * phase[INSIDE])) == pytest.approx(1j, abs=0.05)
    slope = np.exp(-2j * np.pi * 0.1 * np.arange(SIDE))  # without the slope k₂ − k₁, there is no common band
    without_overlap, _, looks = coherence(1j * first * slope.astype(np.complex64), second, window=9)
    assert without_overlap[INSIDE].mean() < 1.3 * chance(looks)


def test_point_has_the_coherence_of_clutter_and_its_phase_at_the_peak():
    scene = np.zeros((SIDE, SIDE))
    scene[100, 120] = 1
    first, second = imaged(scene, middle=(0.1, 0.3)), imaged(scene, middle=(0.1, 0.4))
    magnitude, phase, _ = coherence(first * np.complex64(np.exp(0.7j)), second, window=15)
    assert magnitude[100, 120] == pytest.approx(0.8, abs=0.03)
    assert phase[100, 120] == pytest.approx(0.7, abs=1e-3)


def test_disjoint_bands_are_incoherent_for_an_unchanged_scene():
    scene = random_scene(2)
    first, second = (imaged(scene, middle=(0.0, carrier), width=0.3) for carrier in (-0.16, 0.16))
    magnitude, _, looks = coherence(first, second, window=9)
    assert magnitude[INSIDE].mean() == pytest.approx(chance(looks), rel=0.05)


@pytest.mark.parametrize("separation", [0.0, 0.1, 0.25, 0.4])
def test_coherence_of_an_unchanged_scene_equals_the_common_band(separation):
    first, second = imaged(random_scene(20)), imaged(random_scene(20), middle=(0.0, separation))
    shared, spectrum = 1 - separation / 0.5, np.eye(2) * 0.5**2 / 12
    assert coherence(first, second, window=15)[0][INSIDE].mean() == pytest.approx(shared, abs=0.02)
    assert common_band((np.zeros(2), np.array([0.0, separation])), (spectrum, spectrum)) == pytest.approx(
        shared, abs=0.09
    )


@pytest.mark.parametrize("width", [0.3, 0.6, 0.95])
def test_automatic_window_contains_the_requested_looks(width):
    side = window_px(np.eye(2) * width**2 / 12, 1.0, looks=16)
    looks = coherence(imaged(random_scene(21), width=width), imaged(random_scene(22), width=width), window=side)[2]
    assert 16 <= looks < 45
    assert window_px(np.zeros((2, 2)), 1.0, most=31) == 31


@pytest.mark.parametrize(("width", "window"), [(0.99, 9), (0.5, 9), (0.5, 15)])
def test_looks_equal_the_resolution_cells_of_a_window(width, window):
    looks = coherence(imaged(random_scene(3), width=width), imaged(random_scene(4), width=width), window=window)[2]
    lag = np.arange(1 - window, window)
    along = window**2 / ((window - abs(lag)) * np.sinc(width * lag) ** 2).sum()  # of the rectangular band
    assert looks == pytest.approx(along**2, rel=0.04)
    assert looks == pytest.approx((width * window) ** 2, rel=0.3)  # approximation without border effects


def autocorrelation(image, most):
    """Return the autocorrelation up to lag `most`, summed term by term in double precision."""
    padded = np.pad(image.astype(np.complex128), most)
    rows, columns = image.shape
    lags = range(-most, most + 1)
    correlation = [[(padded[most + d :, most + r :][:rows, :columns] * image.conj()).sum() for r in lags] for d in lags]
    return np.array(correlation) / (np.abs(image.astype(np.complex128)) ** 2).sum()


@pytest.mark.parametrize("scale", [1e-18, 1.0, 1e15])
@pytest.mark.parametrize("point", [0.0, 1e5])
def test_looks_are_accurate_to_1e_6_for_any_brightness(scale, point):
    first, second = (imaged(random_scene(seed), width=0.5)[:40, :33].copy() for seed in (7, 8))
    first[20, 11] += point
    looks = coherence(first * np.float32(scale), second, window=7)[2]
    lag = 7 - np.abs(np.arange(-6, 7))
    correlation = autocorrelation(first, 6) * autocorrelation(second, 6).conj() * np.multiply.outer(lag, lag)
    assert looks == pytest.approx(7**4 / correlation.sum().real, rel=1e-6)


@pytest.mark.parametrize(("window", "width"), [(5, 0.99), (7, 0.5), (9, 0.5)])
def test_coherence_of_unrelated_images_is_the_expected_bias(window, width):
    magnitude, phase, looks = coherence(
        imaged(random_scene(5), width=width), imaged(random_scene(6), width=width), window=window
    )
    assert magnitude[INSIDE].mean() == pytest.approx(chance(looks), rel=0.03)
    assert np.mean(magnitude[INSIDE].astype(float) ** 2) == pytest.approx(1 / looks, rel=0.06)
    assert abs(np.mean(np.exp(1j * phase[INSIDE]))) < 0.05


@pytest.mark.parametrize("common", [0.0, 0.4, 0.8, 1.0])
def test_unbiased_coherence_equals_the_simulated_one(common):
    first, second = (
        imaged(np.sqrt(common) * random_scene(7) + np.sqrt(1 - common) * random_scene(seed)) for seed in (8, 9)
    )
    magnitude, _, looks = coherence(first, second, window=7)
    square = (looks * magnitude[INSIDE].astype(float) ** 2 - 1) / (looks - 1)
    assert square.mean() == pytest.approx(common**2, abs=0.025)
    np.testing.assert_allclose(unbiased(magnitude[INSIDE], looks) ** 2, np.maximum(square, 0), atol=1e-6)


def test_block_with_margin_equals_the_whole():
    first, second = imaged(random_scene(10)), imaged(random_scene(11))
    whole, part = coherence(first, second, window=7), coherence(first[37:103, 47:113], second[37:103, 47:113], window=7)
    for whole_panel, part_panel in zip(whole[:2], part[:2], strict=True):
        np.testing.assert_array_equal(whole_panel[40:100, 50:110], part_panel[3:-3, 3:-3])


def test_bright_point_affects_only_windows_that_contain_it():
    first, second = imaged(random_scene(12)), imaged(random_scene(13))
    before = coherence(first, second, window=5)[0]
    first[50, 60], second[50, 60] = 1e9, 1e9
    after = coherence(first, second, window=5)[0]
    without = np.ones(first.shape, bool)
    without[48:53, 58:63] = False
    np.testing.assert_array_equal(before[without], after[without])
    assert after[50, 60] == 1


def test_undefined_pixels_are_excluded_from_every_window():
    first, second = imaged(random_scene(14)), imaged(random_scene(14))
    first[:, 100:] = np.nan
    first[30, 40] = np.nan
    magnitude, phase, _ = coherence(first, second, window=5)
    assert np.isnan(magnitude[:, 100:]).all()
    assert np.isnan(phase[30, 40])
    assert magnitude[30, 41] == pytest.approx(1, abs=1e-5)
    assert magnitude[:, 99] == pytest.approx(1, abs=1e-5)
    undefined = coherence(first[:, 100:], second[:, 100:], window=5)
    assert np.isnan(undefined[0]).all()
    assert np.isnan(undefined[2])


def test_window_of_even_size_is_refused():
    with pytest.raises(ValueError, match="window=4"):
        coherence(random_scene(1).astype(np.complex64), random_scene(2).astype(np.complex64), window=4)
    with pytest.raises(ValueError, match="wider window"):
        unbiased(np.ones((2, 2), np.float32), 1.0)
