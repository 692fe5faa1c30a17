"""What missing pulses do to an image is predicted before it is formed."""

import numpy as np
import pytest

from apertura.core.echo.association import missing_flags, missing_pulses

SENT = np.arange(600) * 50_000_000


def response(kept):
    """The response along the track of pulses that see a target, normalised by their number, a cell apart and finer."""
    return np.abs(np.fft.rfft(kept, 4 * kept.size))[4:] / kept.sum()


@pytest.mark.parametrize("seed", range(4))
def test_missing_pulses_raise_the_sidelobes_that_are_predicted(seed):
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
def test_a_tenth_of_the_aperture_in_a_row_is_flagged(missing, flagged):
    left = np.delete(SENT, np.arange(200, 200 + missing))
    assert ("pulses_missing" in missing_flags(left)) is flagged
    assert missing_flags(SENT[missing:]) == {}  # a shorter aperture misses nothing


def test_a_fifth_of_the_pulses_missed_here_and_there_is_no_flag():
    assert missing_flags(SENT[np.random.default_rng(1).random(600) > 0.2]) == {}


def test_every_second_pulse_of_a_flight_is_not_missing_from_it():
    assert missing_flags(SENT[::2]) == {}
    assert "60 of 600" in missing_flags(np.delete(SENT, np.arange(200, 260)))["pulses_missing"]
