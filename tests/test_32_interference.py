"""Narrow-band interference: detection, exclusion of subcarriers, and its cost."""

import numpy as np
import pytest

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.echo.captures import runs, sampled_pulses
from apertura.core.echo.compression import compress, window_weights
from apertura.core.echo.interference import EXCESS_DB, Interference
from apertura.simulation.scatterers import spectrum

FREQUENCY = 1.15e9 + 0.4e6 * np.arange(512)
WEIGHT = window_weights("hann", 512)
TARGETS_M = np.array([60.0, 75.0, 92.0])
TONE = 300


def received(*, tone_db=None, noise=1.0, pulses=400, seed=1):
    """Return echoes of three targets from a moving platform, noise, and a tone relative to the power of one echo."""
    rng = np.random.default_rng(seed)
    paths_m = TARGETS_M + 0.002 * np.arange(pulses)[:, None] * np.array([1.0, -0.5, 0.2])
    echo = spectrum(paths_m / C, np.ones(paths_m.shape, complex), FREQUENCY)
    total = echo + rng.normal(size=(*echo.shape, 2)).view(complex)[..., 0] * noise / np.sqrt(2)
    if tone_db is not None:  # relative to one echo, summed over the subcarriers
        total[:, TONE] += np.sqrt(512) * 10 ** (tone_db / 20) * np.exp(2j * np.pi * rng.random(pulses))
    return total.astype(np.complex64)


def measured(transfer):
    groups = sampled_pulses(len(transfer))
    return Interference.measured(runs(groups, [transfer[group] for group in groups]), FREQUENCY, WEIGHT)


def profiles(transfer):
    zero = np.zeros(len(transfer))
    return compress(
        transfer, FREQUENCY, weight=WEIGHT, reference_delay_s=zero, start_m=zero + 40.0, count=200, oversampling=2.0
    )


def noise_floor_db(transfer):
    """Return the mean power of the profiles beyond the targets, dB."""
    return 10 * np.log10(np.mean(np.abs(profiles(transfer)[:, 100:]) ** 2))


@pytest.mark.parametrize("tone_db", [-20, 0, 20, 40])
def test_tone_is_detected_at_its_frequency(tone_db):
    found = measured(received(tone_db=tone_db))
    assert np.flatnonzero(found.excluded).tolist() == [TONE]
    assert f"{1e-6 * FREQUENCY[TONE]:.2f} MHz" in found.flags["interference"]
    assert "GNSS" in found.flags["interference"]


@pytest.mark.parametrize("pulses", [20, 60, 100, 600, 2000])
def test_tone_is_detected_in_flights_of_any_length(pulses):
    assert np.flatnonzero(measured(received(tone_db=10, pulses=pulses)).excluded).tolist() == [TONE]
    assert not measured(received(pulses=pulses)).is_removed


@pytest.mark.parametrize("noise", [0.05, 1.0, 10.0])
@pytest.mark.parametrize("seed", range(4))
def test_no_interference_is_found_in_noise_and_echoes(noise, seed):
    found = measured(received(noise=noise, seed=seed))
    assert found.excess.max() < 10 ** (EXCESS_DB / 10) / 2
    assert not found.is_removed
    assert found.flags == {}


@pytest.mark.parametrize("tone_db", [0, 20, 40])
def test_exclusion_restores_the_noise_floor(tone_db):
    clean, disturbed = received(), received(tone_db=tone_db)
    found = measured(disturbed)
    assert found.is_removed
    assert noise_floor_db(disturbed * found.gain) == pytest.approx(noise_floor_db(clean), abs=0.1)
    raised_db = noise_floor_db(disturbed) - noise_floor_db(clean)
    assert found.gain_db == pytest.approx(raised_db, abs=0.3)


@pytest.mark.parametrize(("excess_db", "excluded"), [(4.0, 0), (8.0, 1)])
def test_tone_is_excluded_from_the_limit_on(excess_db, excluded):
    tone_db = 10 * np.log10((10 ** (excess_db / 10) - 1) / 512)
    assert measured(received(tone_db=tone_db)).excluded.sum() == excluded


def test_echo_keeps_its_amplitude():
    clean = received(noise=0.0)
    found = measured(received(tone_db=20))
    peaks = [np.abs(profiles(transfer)).max() for transfer in (clean, clean * found.gain)]
    assert peaks[1] == pytest.approx(peaks[0], rel=2 * found.lost_share)


def test_sidelobes_stay_below_the_stated_bound():
    found = measured(received(tone_db=20))
    flat = np.ones((1, 512), np.complex64)
    change = np.abs(profiles(flat * found.gain) - profiles(flat))
    assert 20 * np.log10(change.max()) < found.sidelobe_db + 0.1
    assert found.sidelobe_db < -40
