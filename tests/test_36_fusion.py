"""What pairs add up to."""

import numpy as np
import pytest

from apertura.fusion.sums import coherent_sum, magnitude_sum, noncoherent_sum


def test_images_in_phase_keep_their_peak_and_images_out_of_phase_cancel():
    image = np.zeros((8, 8), np.complex64)
    image[3, 4] = 2j
    for turn, expected in ((1, 1.0), (-1, 0.0)):
        pairs = np.stack([image, 3 * turn * image])
        assert abs(coherent_sum(pairs, np.array([2.0, 6.0]))[3, 4]) == pytest.approx(expected, abs=1e-6)
        assert noncoherent_sum(pairs, np.array([2.0, 6.0]))[3, 4] == pytest.approx(1.0, abs=1e-6)


def test_spectra_side_by_side_add_up_to_a_narrower_peak():
    x = np.arange(256) - 128.0
    halves = [np.sinc(x / 8) * np.exp(2j * np.pi * shift * x / 16) for shift in (-1, 1)]
    fused = coherent_sum(np.array(halves, np.complex64)[:, None], np.ones(2))[0]
    width = [int((np.abs(one) ** 2 > 0.5 * np.abs(one[128]) ** 2).sum()) for one in (halves[0], fused)]
    assert width[1] < 0.7 * width[0]


def test_blocks_add_up_to_the_whole():
    generator = np.random.default_rng(1)
    images = (generator.normal(size=(3, 20, 30)) + 1j * generator.normal(size=(3, 20, 30))).astype(np.complex64)
    peaks = np.abs(images).max(axis=(1, 2))
    whole = coherent_sum(images, peaks)
    np.testing.assert_array_equal(whole[5:9, 7:20], coherent_sum(images[:, 5:9, 7:20], peaks))


def test_an_empty_image_is_refused():
    with pytest.raises(ValueError, match="empty image"):
        coherent_sum(np.zeros((2, 4, 4), np.complex64), np.array([1.0, 0.0]))


@pytest.mark.parametrize(("added", "alone"), [(coherent_sum, 0.5), (noncoherent_sum, 0.5), (magnitude_sum, 0.5)])
def test_a_pair_adds_nothing_where_it_sees_nothing_and_where_none_does_there_is_no_sum(added, alone):
    nothing = np.complex64(complex(np.nan, np.nan))
    images = np.array([[[1, 1, nothing]], [[1, nothing, nothing]]], np.complex64)
    np.testing.assert_allclose(np.abs(added(images, np.ones(2)))[0], [1, alone, np.nan])
