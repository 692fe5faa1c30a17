"""Number of looks, by speckle correlation and measured, and a speckle filter that keeps means, edges and points."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from apertura.core.imaging.multilook import Multilook, Speckle, block_means, found_looks, lee

SIZE, SIDE = 384, 4


def speckle(band, seed=1, *, window="none", size=SIZE, sigma0=1.0):
    """Draw developed speckle of given σ⁰ with a band in cycles per pixel, flat or with a Hann window."""
    generator = np.random.default_rng(seed)
    frequency = np.abs(np.fft.fftfreq(size))
    weight = np.where(frequency < band / 2, np.cos(np.pi * frequency / band) ** 2 if window == "hann" else 1.0, 0.0)
    white = np.sqrt(sigma0) * (generator.standard_normal((size, size, 2)) @ [1, 1j])
    field = np.fft.ifft2(np.fft.fft2(white) * np.outer(weight, weight))
    return field / np.sqrt((weight**2).mean() ** 2 * 2)


def blocks(image, side=128):
    starts = product(range(0, SIZE, side), repeat=2)
    return [image[row : row + side, column : column + side] for row, column in starts]


def whole(multilook):
    return multilook.mean((slice(0, multilook.shape[0]), slice(0, multilook.shape[1])))


def measured_looks(power):
    return power.mean() ** 2 / power.var()


@pytest.mark.parametrize(("window", "squares"), [("none", 1.0), ("hann", 35 / 128 / (3 / 8) ** 2)])
def test_correlated_pixels_follow_from_the_band(window, squares):
    """∫|ρ|² = ∫|U|⁴/(∫|U|²)²: 1/B for a flat band, 1.94/B with a Hann window, in either direction."""
    measured = Speckle.of(blocks(speckle(0.4, window=window)))
    assert measured.area_px == pytest.approx((squares / 0.4) ** 2, rel=0.08)


@pytest.mark.parametrize("side", [2, 4, 8])
def test_looks_by_correlation_equal_those_of_the_mean_power(side):
    """By eq. 3, the looks equal neither the number of pixels nor the number of cells per square."""
    image = speckle(0.4)
    measured = Multilook.of(image.__getitem__, image.shape, side)
    scatter = np.sqrt(2 / (SIZE / side) ** 2 * measured.looks + 4 / (SIZE / 2.5) ** 2)
    assert measured.looks == pytest.approx(measured_looks(whole(measured)), rel=max(0.05, 4 * scatter))
    assert measured.found == pytest.approx(measured.looks, rel=0.15)


def test_looks_are_measured_for_squares_smaller_than_cells():
    """Eq. 4: a window of 49 squares has only eleven independent looks, which lowers its variance by a tenth."""
    measured = Multilook.of((image := speckle(0.1)).__getitem__, image.shape, SIDE)
    assert measured.within == pytest.approx(11.1, rel=0.1)
    assert measured.found == pytest.approx(measured.looks, rel=0.15)


def test_correlation_is_unchanged_by_a_varying_carrier():
    """The carrier varies across a block by half of the band, which would halve the correlation."""
    flat = speckle(0.3)
    row, column = np.mgrid[:SIZE, :SIZE] / 128
    with_varying_carrier = flat * np.exp(2j * np.pi * 128 * (0.1 * row**2 / 2 + 0.07 * row * column + 0.31 * column))
    assert Speckle.of(blocks(with_varying_carrier)).area_px == pytest.approx(Speckle.of(blocks(flat)).area_px, rel=0.05)


def test_looks_are_measured_on_the_homogeneous_part_of_a_scene():
    """Texture in half of the scene, an edge and points would lower a mean or median of local looks."""
    generator = np.random.default_rng(4)
    sigma0 = np.where(np.arange(SIZE) < SIZE // 3, 8.0, 1.0) * np.ones((SIZE, 1))
    sigma0[: SIZE // 2] *= generator.gamma(1.0, 1.0, (SIZE // 8, SIZE // 8)).repeat(8, 0).repeat(8, 1)[: SIZE // 2]
    sigma0[tuple(generator.integers(0, SIZE, (2, 10)))] = 3e3
    measured = Multilook.of((image := speckle(0.4, sigma0=sigma0)).__getitem__, image.shape, SIDE)
    assert measured.found == pytest.approx(measured.looks, rel=0.15)
    assert measured_looks(whole(measured)) < measured.looks / 2


def test_filter_keeps_the_mean_of_speckle_and_raises_its_looks():
    plain = Multilook.of((image := speckle(0.4)).__getitem__, image.shape, SIDE)
    before, after = whole(plain), whole(replace(plain, filtered=True))
    assert 10 * np.log10(after.mean() / before.mean()) == pytest.approx(0, abs=0.05)
    assert 10 * np.log10(np.median(after) / np.median(before)) > 0.2  # the filter keeps the mean, not the median
    assert measured_looks(after) > 8 * measured_looks(before)


def test_filter_keeps_an_edge_and_a_point():
    """Next to a step of 10 dB, a plain window mean would be 7 dB too high."""
    generator = np.random.default_rng(2)
    ground = np.where(np.arange(200) < 100, 1.0, 10.0) * np.ones((200, 1))
    power = ground * generator.gamma(10.0, 0.1, ground.shape)
    power[50, 30] = 1000.0
    smooth = lee(power, looks=10.0, within=490.0)
    across_db = 10 * np.log10(np.delete(smooth, slice(40, 60), 0).mean(axis=0))
    assert across_db[98:102] == pytest.approx([0, 0, 10, 10], abs=1.6)
    assert smooth[50, 30] == pytest.approx(1000, rel=0.02)


def test_noise_subtraction_leaves_the_mean_power_of_the_terrain():
    """The noise is as strong as the terrain echo; with noise only, half of the squares are negative."""
    noise = 1.0
    ground = np.where(np.arange(SIZE) < SIZE // 2, 1.0, 0.0) * np.ones((SIZE, 1))
    image = speckle(0.4, sigma0=ground + noise)
    for filtered in (False, True):
        power = whole(
            Multilook.of(
                image.__getitem__,
                image.shape,
                SIDE,
                noise=lambda window: np.full(image[window].shape, noise),
                filtered=filtered,
            )
        )
        inner = SIZE // SIDE // 2
        assert power[:, 8 : inner - 8].mean() == pytest.approx(1, abs=0.08)
        assert power[:, inner + 8 : -8].mean() == pytest.approx(0, abs=0.05)
        assert (power[:, inner:] < 0).mean() > 0.4


def test_mean_power_by_windows_has_no_seams():
    image = speckle(0.4, size=150)[:, :130].astype(np.complex64)
    image[20:40, 30:60] = np.nan
    multilook = Multilook.of(
        image.__getitem__, image.shape, 4, noise=lambda window: np.ones(image[window].shape), filtered=True
    )
    assert (multilook.filtered, multilook.shape) == (True, (38, 33))
    part = (slice(7, 30), slice(11, 33))
    np.testing.assert_array_equal(multilook.mean(part), whole(multilook)[part])
    assert np.isnan(multilook.mean((slice(5, 10), slice(8, 15)))).all()


def test_square_with_less_than_half_valid_pixels_is_undefined():
    values = np.arange(12.0).reshape(3, 4)
    values[0, :2] = np.nan
    np.testing.assert_array_equal(block_means(values, 2), [[4.5, 4.5], [8.5, 10.5]])
    values[1, 1] = np.nan
    assert np.isnan(block_means(values, 2)[0, 0])


def test_mostly_undefined_image_has_no_looks_and_no_filter():
    image = np.full((64, 64), np.nan, np.complex64)
    image[:8] = 1
    multilook = Multilook.of(image.__getitem__, image.shape, 2, filtered=True)
    assert (multilook.filtered, np.isnan(multilook.looks)) == (False, True)
    assert np.isnan(found_looks([], 10.0))


def test_pixels_without_power_stay_zero_and_are_excluded_from_looks():
    """Such pixels occur next to targets in simulations without noise."""
    image = speckle(0.4) * (np.arange(SIZE) < SIZE // 2)
    multilook = Multilook.of(image.__getitem__, image.shape, SIDE, filtered=True)
    assert (whole(multilook)[:, -20:] == 0).all()
    assert multilook.found == pytest.approx(Multilook.of(speckle(0.4).__getitem__, image.shape, SIDE).looks, rel=0.2)


@pytest.mark.parametrize(("shape", "side"), [((1, 1), 1), ((3, 40), 2), ((40, 30), 100)])
def test_image_smaller_than_a_window_has_its_mean(shape, side):
    image = np.ones(shape, np.complex64)
    multilook = Multilook.of(image.__getitem__, shape, side, filtered=True)
    values = whole(multilook)
    assert values.shape == tuple(-(-size // side) for size in shape)
    assert np.isnan(multilook.found)
    valid = values[np.isfinite(values)]
    assert valid == pytest.approx(1)
