"""Coherence and phase of two images: physics of docs/theory/interferometry.md, section 1."""

import numpy as np
import pytest

from apertura.methods.interferometry.coherence import chance, coherence, common_band, unbiased, window_px

SIDE = 256
INSIDE = (slice(8, -8), slice(8, -8))


def ground(seed):
    """Reflectivity of many scatterers, one a pixel."""
    generator = np.random.default_rng(seed)
    return (generator.normal(size=(SIDE, SIDE)) + 1j * generator.normal(size=(SIDE, SIDE))) / np.sqrt(2)


def imaged(scene, *, middle=(0.0, 0.0), width=0.5):
    """The scene as an image with a band of `width` cycles per pixel about a carrier."""
    cycles = np.fft.fftfreq(SIDE)
    down, across = (np.abs((cycles - one + 0.5) % 1 - 0.5) < width / 2 for one in middle)
    return np.fft.ifft2(np.fft.fft2(scene) * np.outer(down, across)).astype(np.complex64)


def test_images_with_other_carriers_have_one_phase_all_over():
    scene = ground(1)
    first, second = imaged(scene, middle=(0.1, 0.3)), imaged(scene, middle=(0.1, 0.4))
    magnitude, phase, _ = coherence(1j * first, second, window=9)
    assert magnitude[INSIDE].mean() == pytest.approx(0.8, abs=0.02)  # of 0.5 cycles per pixel, 0.4 are common
    assert np.mean(np.exp(1j * phase[INSIDE])) == pytest.approx(1j, abs=0.05)
    slope = np.exp(-2j * np.pi * 0.1 * np.arange(SIDE))  # k₂ − k₁, taken off: nothing left
    turned, _, looks = coherence(1j * first * slope.astype(np.complex64), second, window=9)
    assert turned[INSIDE].mean() < 1.3 * chance(looks)


def test_a_point_is_as_coherent_as_ground_and_has_its_phase_at_the_peak():
    scene = np.zeros((SIDE, SIDE))
    scene[100, 120] = 1
    first, second = imaged(scene, middle=(0.1, 0.3)), imaged(scene, middle=(0.1, 0.4))
    magnitude, phase, _ = coherence(first * np.complex64(np.exp(0.7j)), second, window=15)
    assert magnitude[100, 120] == pytest.approx(0.8, abs=0.03)
    assert phase[100, 120] == pytest.approx(0.7, abs=1e-3)


def test_bands_without_a_common_part_are_incoherent_however_still_the_ground():
    scene = ground(2)
    first, second = (imaged(scene, middle=(0.0, at), width=0.3) for at in (-0.16, 0.16))
    magnitude, _, looks = coherence(first, second, window=9)
    assert magnitude[INSIDE].mean() == pytest.approx(chance(looks), rel=0.05)


@pytest.mark.parametrize("apart", [0.0, 0.1, 0.25, 0.4])
def test_the_common_band_is_what_still_ground_shows(apart):
    first, second = imaged(ground(20)), imaged(ground(20), middle=(0.0, apart))
    shared, spectrum = 1 - apart / 0.5, np.eye(2) * 0.5**2 / 12
    assert coherence(first, second, window=15)[0][INSIDE].mean() == pytest.approx(shared, abs=0.02)
    assert common_band((np.zeros(2), np.array([0.0, apart])), (spectrum, spectrum)) == pytest.approx(shared, abs=0.09)


@pytest.mark.parametrize("width", [0.3, 0.6, 0.95])
def test_the_window_that_is_chosen_holds_the_looks_asked_for(width):
    side = window_px(np.eye(2) * width**2 / 12, 1.0, looks=16)
    looks = coherence(imaged(ground(21), width=width), imaged(ground(22), width=width), window=side)[2]
    assert 16 <= looks < 45
    assert window_px(np.zeros((2, 2)), 1.0, most=31) == 31


@pytest.mark.parametrize(("width", "window"), [(0.99, 9), (0.5, 9), (0.5, 15)])
def test_looks_are_the_resolution_cells_of_a_window(width, window):
    looks = coherence(imaged(ground(3), width=width), imaged(ground(4), width=width), window=window)[2]
    lag = np.arange(1 - window, window)
    along = window**2 / ((window - abs(lag)) * np.sinc(width * lag) ** 2).sum()  # of the band, not of its image
    assert looks == pytest.approx(along**2, rel=0.04)
    assert looks == pytest.approx((width * window) ** 2, rel=0.3)  # and what the border cuts


def autocorrelation(image, most):
    """At lags up to `most`, term by term in double precision."""
    padded = np.pad(image.astype(np.complex128), most)
    rows, columns = image.shape
    lags = range(-most, most + 1)
    alike = [[(padded[most + d :, most + r :][:rows, :columns] * image.conj()).sum() for r in lags] for d in lags]
    return np.array(alike) / (np.abs(image.astype(np.complex128)) ** 2).sum()


@pytest.mark.parametrize("scale", [1e-18, 1.0, 1e15])
@pytest.mark.parametrize("point", [0.0, 1e5])
def test_looks_are_right_to_a_millionth_however_bright_the_image(scale, point):
    first, second = (imaged(ground(seed), width=0.5)[:40, :33].copy() for seed in (7, 8))
    first[20, 11] += point
    looks = coherence(first * np.float32(scale), second, window=7)[2]
    lag = 7 - np.abs(np.arange(-6, 7))
    alike = autocorrelation(first, 6) * autocorrelation(second, 6).conj() * np.multiply.outer(lag, lag)
    assert looks == pytest.approx(7**4 / alike.sum().real, rel=1e-6)


@pytest.mark.parametrize(("window", "width"), [(5, 0.99), (7, 0.5), (9, 0.5)])
def test_coherence_of_nothing_in_common_is_that_of_chance(window, width):
    magnitude, phase, looks = coherence(imaged(ground(5), width=width), imaged(ground(6), width=width), window=window)
    assert magnitude[INSIDE].mean() == pytest.approx(chance(looks), rel=0.03)
    assert np.mean(magnitude[INSIDE].astype(float) ** 2) == pytest.approx(1 / looks, rel=0.06)
    assert abs(np.mean(np.exp(1j * phase[INSIDE]))) < 0.05


@pytest.mark.parametrize("common", [0.0, 0.4, 0.8, 1.0])
def test_without_its_bias_coherence_is_what_went_in(common):
    first, second = (imaged(np.sqrt(common) * ground(7) + np.sqrt(1 - common) * ground(seed)) for seed in (8, 9))
    magnitude, _, looks = coherence(first, second, window=7)
    square = (looks * magnitude[INSIDE].astype(float) ** 2 - 1) / (looks - 1)
    assert square.mean() == pytest.approx(common**2, abs=0.025)
    np.testing.assert_allclose(unbiased(magnitude[INSIDE], looks) ** 2, np.maximum(square, 0), atol=1e-6)


def test_a_block_with_its_margin_gives_what_the_whole_gives():
    first, second = imaged(ground(10)), imaged(ground(11))
    whole, part = coherence(first, second, window=7), coherence(first[37:103, 47:113], second[37:103, 47:113], window=7)
    for one, other in zip(whole[:2], part[:2], strict=True):
        np.testing.assert_array_equal(one[40:100, 50:110], other[3:-3, 3:-3])


def test_a_bright_point_leaves_nothing_in_the_windows_that_do_not_hold_it():
    first, second = imaged(ground(12)), imaged(ground(13))
    before = coherence(first, second, window=5)[0]
    first[50, 60], second[50, 60] = 1e9, 1e9
    after = coherence(first, second, window=5)[0]
    without = np.ones(first.shape, bool)
    without[48:53, 58:63] = False
    np.testing.assert_array_equal(before[without], after[without])
    assert after[50, 60] == 1


def test_what_one_image_does_not_show_counts_in_no_window():
    first, second = imaged(ground(14)), imaged(ground(14))
    first[:, 100:] = np.nan
    first[30, 40] = np.nan
    magnitude, phase, _ = coherence(first, second, window=5)
    assert np.isnan(magnitude[:, 100:]).all()
    assert np.isnan(phase[30, 40])
    assert magnitude[30, 41] == pytest.approx(1, abs=1e-5)
    assert magnitude[:, 99] == pytest.approx(1, abs=1e-5)
    nothing = coherence(first[:, 100:], second[:, 100:], window=5)
    assert np.isnan(nothing[0]).all()
    assert np.isnan(nothing[2])


def test_a_window_without_a_middle_is_refused():
    with pytest.raises(ValueError, match="window=4"):
        coherence(ground(1).astype(np.complex64), ground(2).astype(np.complex64), window=4)
    with pytest.raises(ValueError, match="wider window"):
        unbiased(np.ones((2, 2), np.float32), 1.0)
