"""Sums of images of pairs, and the clutter reduction of a sum."""

import numpy as np
import pytest

from apertura.core.combination import clutter_reduction_db, coherent_sum, magnitude_sum, noncoherent_sum


def test_images_in_phase_keep_their_peak_and_others_cancel():
    image = np.zeros((8, 8), np.complex64)
    image[3, 4] = 2j
    for sign, expected in ((1, 1.0), (-1, 0.0)):
        pairs = np.stack([image, 3 * sign * image])
        assert abs(coherent_sum(pairs, np.array([2.0, 6.0]))[3, 4]) == pytest.approx(expected, abs=1e-6)
        assert noncoherent_sum(pairs, np.array([2.0, 6.0]))[3, 4] == pytest.approx(1.0, abs=1e-6)


def test_adjacent_spectra_sum_to_a_narrower_peak():
    x = np.arange(256) - 128.0
    halves = [np.sinc(x / 8) * np.exp(2j * np.pi * shift * x / 16) for shift in (-1, 1)]
    fused = coherent_sum(np.array(halves, np.complex64)[:, None], np.ones(2))[0]
    width = [int((np.abs(response) ** 2 > 0.5 * np.abs(response[128]) ** 2).sum()) for response in (halves[0], fused)]
    assert width[1] < 0.7 * width[0]


def test_sum_of_a_block_equals_that_of_the_whole():
    generator = np.random.default_rng(1)
    images = (generator.normal(size=(3, 20, 30)) + 1j * generator.normal(size=(3, 20, 30))).astype(np.complex64)
    peaks = np.abs(images).max(axis=(1, 2))
    whole = coherent_sum(images, peaks)
    np.testing.assert_array_equal(whole[5:9, 7:20], coherent_sum(images[:, 5:9, 7:20], peaks))


def test_amplitudes_are_divided_in_double_precision():
    generator = np.random.default_rng(2)
    images = generator.normal(size=(2, 40, 50, 2)).astype(np.float32).view(np.complex64)[..., 0]
    peaks = generator.uniform(1e-3, 1e3, 2)
    divided = (images.astype(np.complex128) / peaks[:, None, None]).astype(np.complex64)
    np.testing.assert_array_equal(magnitude_sum(images, peaks), np.abs(divided).mean(axis=0))


def test_empty_image_is_refused():
    with pytest.raises(ValueError, match="exclude pairs whose image is empty"):
        coherent_sum(np.zeros((2, 4, 4), np.complex64), np.array([1.0, 0.0]))


@pytest.mark.parametrize(("sum_of", "single"), [(coherent_sum, 0.5), (noncoherent_sum, 0.5), (magnitude_sum, 0.5)])
def test_undefined_pixels_are_omitted_and_the_sum_of_none_is_undefined(sum_of, single):
    undefined = np.complex64(complex(np.nan, np.nan))
    images = np.array([[[1, 1, undefined]], [[1, undefined, undefined]]], np.complex64)
    np.testing.assert_allclose(np.abs(sum_of(images, np.ones(2)))[0], [1, single, np.nan])


def with_a_target(clutter, phase_rad=0.0):
    """Return images of a target in clutter 30 dB below it."""
    images = (0.0316 * clutter).astype(np.complex64)
    images[:, 30, 30] = np.exp(1j * phase_rad * np.arange(len(images)))
    return images


def reduced_db(images):
    """Return the clutter reduction by the coherent sum of images, dB."""
    peaks = np.abs(images).max(axis=(1, 2))
    floor_db = [10 * np.log10(np.median(np.abs(image) ** 2) / (np.abs(image) ** 2).max()) for image in images]
    total = np.abs(coherent_sum(images, peaks)) ** 2
    return clutter_reduction_db(floor_db, 10 * np.log10(np.median(total) / total.max()))


def speckle(pairs):
    generator = np.random.default_rng(3)
    return (generator.normal(size=(pairs, 128, 128)) + 1j * generator.normal(size=(pairs, 128, 128))) / np.sqrt(2)


@pytest.mark.parametrize("pairs", [2, 3, 6])
def test_coherent_sum_lowers_clutter_by_the_number_of_images(pairs):
    assert reduced_db(with_a_target(speckle(pairs))) == pytest.approx(10 * np.log10(pairs), abs=0.15)


def test_clutter_common_to_all_images_is_not_reduced():
    assert reduced_db(with_a_target(np.repeat(speckle(1), 3, axis=0))) == pytest.approx(0.0, abs=0.01)


def test_clutter_reduction_falls_by_the_peak_loss():
    peak_loss_db = 20 * np.log10(np.cos(0.6))
    assert reduced_db(with_a_target(speckle(2), phase_rad=1.2)) == pytest.approx(3.01 + peak_loss_db, abs=0.15)


def test_sum_of_no_images_is_refused():
    with pytest.raises(ValueError, match="no image"):
        clutter_reduction_db([], -40.0)
