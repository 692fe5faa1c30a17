"""Effect of missing pulses on an image, predicted before image formation."""

import numpy as np
import pytest

from apertura.core.echo.association import missing_flags, missing_pulses

SENT = np.arange(600) * 50_000_000


def response(kept):
    """Return the azimuth response of the used pulses, normalised by their number, at distances of one cell or more."""
    return np.abs(np.fft.rfft(kept, 4 * kept.size))[4:] / kept.sum()


@pytest.mark.parametrize("seed", range(4))
def test_missing_pulses_raise_sidelobes_as_predicted(seed):
    generator = np.random.default_rng(seed)
    kept = generator.random(600) > 0.1 * seed
    kept[200 : 200 + 40 * seed] = False
    kept[[0, -1]] = True
    missing, sidelobe = missing_pulses(SENT[kept] + generator.normal(0, 2e6, kept.sum()).astype(np.int64))
    whole = np.abs(np.fft.rfft(np.ones(600), 2400))[4:] / kept.sum()
    assert missing == (~kept).sum()
    assert np.abs(response(kept) - whole).max() <= sidelobe + 1e-12
    assert np.abs(response(kept) - whole).max() >= 0.5 * sidelobe


@pytest.mark.parametrize(("missing", "flagged"), [(50, False), (60, True)])
def test_gap_of_a_tenth_of_the_aperture_is_flagged(missing, flagged):
    remaining = np.delete(SENT, np.arange(200, 200 + missing))
    assert ("pulses_missing" in missing_flags(remaining)) is flagged
    assert missing_flags(SENT[missing:]) == {}  # a shorter aperture has no missing pulses


def test_scattered_loss_of_a_fifth_of_pulses_is_not_flagged():
    assert missing_flags(SENT[np.random.default_rng(1).random(600) > 0.2]) == {}


def test_regular_decimation_has_no_missing_pulses():
    assert missing_flags(SENT[::2]) == {}
    assert "60 of 600" in missing_flags(np.delete(SENT, np.arange(200, 260)))["pulses_missing"]
