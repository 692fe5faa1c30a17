"""Structure of captures from the transmitted signal: period, band, order of I and Q, channels (recordings.md)."""

from dataclasses import replace

import numpy as np
import pytest

from apertura.core.echo.structure import capture_structure

N, PERIOD, LENGTH, CAPTURES = 96, 160, 230, 24


def codes(seed=1):
    return np.exp(0.5j * np.pi * np.random.default_rng(seed).integers(0, 4, N))


def captures(*, centre=False, delay=7, snr_db=20.0, seed=2, length=LENGTH, period=PERIOD):
    """Return echoes of a periodic symbol over one path, with noise relative to a subcarrier."""
    rng = np.random.default_rng(seed)
    numbers = np.arange(N) - (N // 2 if centre else 0)
    time = np.arange(length) - delay
    symbol = np.exp(2j * np.pi * np.outer(time, numbers) / period) @ codes() / np.sqrt(N)
    phases = np.exp(2j * np.pi * rng.random((CAPTURES, 1)))
    noise = rng.normal(size=(2, CAPTURES, length)) * np.sqrt(0.5 * period / N * 10 ** (-snr_db / 10))
    return phases * symbol + noise[0] + 1j * noise[1]


@pytest.mark.parametrize("snr_db", [20.0, 0.0])
@pytest.mark.parametrize("centre", [False, True])
def test_period_and_band_of_a_symbol_follow_from_captures_and_code(centre, snr_db):
    found = capture_structure(captures(centre=centre, snr_db=snr_db), codes())
    assert (found.dft_samples, found.carrier_is) == (PERIOD, "band_centre" if centre else "band_start")
    assert (found.channels, found.iq, found.sent_samples) == (1, "complex", N)


def test_compression_of_one_path_is_the_share_of_signal_in_the_energy():
    """The window has the energy S of N subcarriers plus noise S·D/N/SNR; one delay explains the signal only."""
    snr = 10.0
    found = capture_structure(captures(delay=10, snr_db=10 * np.log10(snr)), codes())  # on a cell of D/N samples
    assert found.compression == pytest.approx(1 / (1 + PERIOD / N / snr), rel=0.05)


def test_swapped_i_and_q_are_detected():
    assert capture_structure(captures().conj(), codes()).iq == "conjugate"


@pytest.mark.parametrize("weaker_db", [0.0, 40.0])
def test_interleaved_channels_are_counted(weaker_db):
    """Interleaved samples of two channels contain images of the band, so that one channel explains half the energy."""
    radar, sidelink = captures(delay=31, seed=3) * 10 ** (-weaker_db / 20), captures(delay=4, seed=4)
    both = np.stack([radar, sidelink], -1).reshape(CAPTURES, -1)
    found = capture_structure(both, codes())
    assert (found.channels, found.dft_samples) == (2, PERIOD)


def test_oversampled_single_channel_is_not_taken_for_two_channels():
    # half a cell of D/N samples off the delays of eq. 4, so that the odd samples alone are compressed better
    found = capture_structure(captures(length=900, period=640, delay=10 / 3, snr_db=60.0), codes())
    assert (found.channels, found.dft_samples) == (1, 640)


def test_captures_without_the_signal_have_no_structure():
    assert capture_structure(captures(), codes(seed=9)) is None
    noise = np.random.default_rng(5).normal(size=(2, CAPTURES, LENGTH))
    assert capture_structure(noise[0] + 1j * noise[1], codes()) is None
    assert capture_structure(np.zeros((CAPTURES, LENGTH), complex), codes()) is None


def test_silence_before_the_first_echo_is_not_a_period():
    """The largest lags compare silence with silence; their rounding errors must not exceed the true period."""
    samples = captures(snr_db=200.0, delay=40)
    samples[:, :40] = 0
    assert capture_structure(samples, codes()).dft_samples == PERIOD


def test_pulse_is_distinguished_from_a_symbol():
    chirp = np.exp(1j * np.pi * 0.7 * (np.arange(N) - N / 2) ** 2 / N)
    rng = np.random.default_rng(6)
    samples = 0.1 * (rng.normal(size=(CAPTURES, LENGTH)) + 1j * rng.normal(size=(CAPTURES, LENGTH)))
    samples[:, 50 : 50 + N] += chirp
    found = capture_structure(samples, chirp)
    assert (found.dft_samples, found.channels, found.iq) == (None, 1, "complex")
    assert capture_structure(samples.conj(), chirp) == replace(
        found, iq="conjugate", compression=pytest.approx(found.compression)
    )


def test_codes_that_change_are_found_by_the_rows_of_the_captures():
    """With the rows of other captures, nothing is found."""
    rng = np.random.default_rng(7)
    table = np.exp(0.5j * np.pi * rng.integers(0, 4, (CAPTURES, N)))
    time = np.arange(LENGTH) - 10  # on a cell of D/N samples
    both = np.exp(2j * np.pi * np.outer(time, np.arange(N)) / PERIOD) @ table.T / np.sqrt(N)
    found = capture_structure(both.T, table)
    assert (found.channels, found.dft_samples, found.carrier_is, found.sent_samples) == (1, PERIOD, "band_start", N)
    assert found.compression == pytest.approx(1, abs=0.05)
    interleaved = np.stack([both.T, np.roll(both.T, 5, axis=1)], -1).reshape(CAPTURES, -1)
    assert capture_structure(interleaved, table).channels == 2
    assert capture_structure(both.T, np.roll(table, 1, axis=0)) is None
