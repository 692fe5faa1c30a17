"""Tones of other transmitters in captures: subtraction between two subcarriers, and signals that are no tones."""

import numpy as np
import pytest

from apertura.core.echo.demodulate import Numerology, demodulate
from apertura.core.echo.tones import Tones

WINDOW, COUNT, PREFIX, PULSES = 1024, 512, 256, 40
SPACING_HZ, CARRIER_HZ = 0.4e6, 1.2e9
NUMEROLOGY = Numerology(CARRIER_HZ, WINDOW * SPACING_HZ, np.arange(COUNT), PREFIX, WINDOW)
CODE = np.exp(2j * np.pi * np.random.default_rng(3).integers(0, 4, COUNT) / 4)
NOISE = 0.1  # of a subcarrier relative to the echo, amplitude


def echoes(seed=1, noise=NOISE):
    """Return received symbols of 20 scatterers within half the prefix, with unit mean power, and noise."""
    rng = np.random.default_rng(seed)
    delay = rng.uniform(0, PREFIX / 2, 20) / WINDOW
    amplitude = rng.normal(size=(20, 2)) @ [1, 1j]
    transfer = amplitude @ np.exp(-2j * np.pi * np.outer(delay, np.arange(COUNT)))
    transfer /= np.sqrt(np.mean(np.abs(transfer) ** 2))
    received = np.tile(transfer * CODE, (PULSES, 1))
    return received + noise * (rng.normal(size=(*received.shape, 2)) @ [1, 1j]) / np.sqrt(2)


INVERSE = (1 / CODE).astype(np.complex64)[None]


def spectrum(samples):
    """Return the symbols of captures (pulse, sample) from the start of the prefix."""
    return demodulate(samples.astype(np.complex64), NUMEROLOGY)


def tone(at, level_db, seed=2):
    """Return the symbols of a tone with random phases; its power is relative to that of the echoes in a capture."""
    phase = np.random.default_rng(seed).random((PULSES, 1))
    time = np.arange(PREFIX + WINDOW) / WINDOW
    return spectrum(np.sqrt(COUNT * 10 ** (level_db / 10)) * np.exp(2j * np.pi * (at * time + phase)))


def removal(lines=()):
    return Tones(NUMEROLOGY, lines)


def left_db(symbols, wanted):
    """Return the power of the difference relative to that of the echoes, dB."""
    return 10 * np.log10(np.mean(np.abs(symbols - wanted) ** 2) / np.mean(np.abs(wanted) ** 2))


def test_spectrum_of_a_tone_leaks_with_one_over_its_distance():
    """A tone between two subcarriers, 40 dB above the echoes, is 17 dB stronger a hundred subcarriers away."""
    power_db = 10 * np.log10(np.mean(np.abs(tone(200.5, 40.0)) ** 2, axis=0))
    assert power_db[300] == pytest.approx(40 + 10 * np.log10(COUNT) - 20 * np.log10(np.pi * 99.5), abs=0.2)


@pytest.mark.parametrize("level_db", [0.0, 20.0, 60.0])
@pytest.mark.parametrize(
    ("at", "most_db"), [(200.0, -36), (200.02, -36), (200.3, -36), (200.5, -36), (0.4, -30), (COUNT - 1.3, -30)]
)
def test_tone_of_any_level_leaves_far_less_than_the_echoes(at, most_db, level_db):
    wanted = echoes()
    tones = removal()
    cleaned = tones.removed((wanted + tone(at, level_db)).astype(np.complex64), INVERSE)
    assert left_db(cleaned, wanted) < most_db
    assert tones.affected == PULSES


def test_echo_near_the_tone_is_not_subtracted():
    """Without noise, the echo in the subcarriers around the tone keeps its amplitude within 2 %."""
    wanted = echoes(noise=1e-4)
    cleaned = removal().removed((wanted + tone(200.4, 20.0)).astype(np.complex64), INVERSE)
    near = slice(195, 206)
    echo = np.mean(np.abs(wanted[:, near]) ** 2)
    assert np.sqrt(np.mean(np.abs(cleaned - wanted)[:, near] ** 2) / echo) < 0.02


@pytest.mark.parametrize("noise", [0.0, 0.1, 3.0])
@pytest.mark.parametrize("seed", range(5))
def test_captures_without_a_tone_are_unchanged(noise, seed):
    symbols = echoes(seed, noise).astype(np.complex64)
    tones = removal()
    np.testing.assert_array_equal(tones.removed(symbols, INVERSE), symbols)
    assert tones.flags("interference") == {}


def test_noise_alone_is_unchanged():
    rng = np.random.default_rng(5)
    symbols = (rng.normal(size=(5000, COUNT, 2)) @ [1, 1j]).astype(np.complex64)
    tones = removal()
    np.testing.assert_array_equal(tones.removed(symbols, INVERSE), symbols)


def test_swept_and_pulsed_signals_are_not_subtracted():
    time = np.arange(PREFIX + WINDOW) / WINDOW
    level = np.sqrt(COUNT * 1e2)
    swept = np.exp(2j * np.pi * (150 * time + 20 * time**2))
    pulsed = np.exp(2j * np.pi * 200.3 * time) * (np.abs(time - 0.7) < 0.1)
    rising = np.exp(2j * np.pi * 200.3 * time) * np.sin(np.pi * (time + 0.4) / 2.24) ** 2  # 97 % of it is a tone
    for signal in (swept, pulsed, rising):
        symbols = (echoes() + spectrum(np.tile(level * signal, (PULSES, 1)))).astype(np.complex64)
        tones = removal()
        np.testing.assert_array_equal(tones.removed(symbols, INVERSE), symbols)


def test_several_tones_are_subtracted():
    wanted = echoes()
    several = sum(tone(at, level_db, seed) for at, level_db, seed in ((60.3, 40, 1), (250.5, 20, 2), (400.1, 10, 3)))
    tones = removal()
    cleaned = tones.removed((wanted + several).astype(np.complex64), INVERSE)
    assert left_db(cleaned, wanted) < -27
    assert "strongest at 1224.00 MHz" in tones.flags("interference")["interference"]


def test_weak_tone_is_subtracted_at_a_known_line_only():
    """15 dB below the echoes, a tone is 12 dB above them in its subcarrier: too weak for the test of one capture."""
    wanted = echoes()
    symbols = (wanted + tone(200.3, -15.0)).astype(np.complex64)
    assert left_db(removal().removed(symbols, INVERSE), wanted) == pytest.approx(-15, abs=0.2)
    assert left_db(removal((200,)).removed(symbols, INVERSE), wanted) < -36


def test_power_of_the_tone_is_stated_relative_to_the_rest_of_the_capture():
    tones = removal()
    tones.removed((echoes() + tone(200.3, 30.0)).astype(np.complex64), INVERSE)
    stated = tones.flags("interference")["interference"]
    assert "tone in 100% of captures, strongest at 1280.00 MHz (GNSS L2/E6, air surveillance radar)" in stated
    assert float(stated.split("): ")[1].split(" dB")[0]) == pytest.approx(30, abs=0.3)


def test_code_with_weak_subcarriers_is_not_taken_for_a_tone():
    code = CODE * np.where(np.arange(COUNT) % 64 == 0, 6.0, 1.0)
    symbols = (echoes() / CODE * code).astype(np.complex64)
    inverse = (1 / code).astype(np.complex64)
    inverse[5] = 0
    np.testing.assert_array_equal(removal().removed(symbols, inverse[None]), symbols)
