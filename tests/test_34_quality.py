"""What is measured in an image, and how exactly it was computed."""

import numpy as np
import pytest

from apertura.quality.error_check import Certificate, certified_pixels
from apertura.quality.measures import coherence_factor, numerical_error, survey
from apertura.quality.point_targets import Patch, cut_through, find_peak
from apertura.scene.grid import SceneGrid


def test_an_error_says_how_much_it_depends_on_the_choice_of_pixels():
    """The spread over draws of pixels is what leaving out pixels tells: on speckle, and on a few targets."""
    generator = np.random.default_rng(4)
    for targets, least, most in ((0, 0.3, 0.8), (300, 2.0, 8.0)):
        scene = generator.standard_normal(40_000) + 1j * generator.standard_normal(40_000)
        scene[:targets] *= 100
        noise = 1e-3 * (generator.standard_normal(40_000) + 1j * generator.standard_normal(40_000))
        draws = [generator.integers(0, scene.size, 256) for _ in range(200)]
        errors = [numerical_error((scene + noise)[draw].astype(np.complex128), scene[draw]) for draw in draws]
        spread = np.std([one.rms_db for one in errors])
        assert least < spread < most
        assert np.median([one.std_db for one in errors]) == pytest.approx(spread, rel=0.4)


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


def test_only_the_tile_that_misses_the_accuracy_is_named():
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
