"""Transmit ripple and sidelink echo: separated if possible with one channel, otherwise flagged as ambiguous."""

import re

import numpy as np
import pytest

from apertura.core.echo.sidelink import measure
from apertura.core.echo.sidelink_state import second_path_flags

NUMBER, CELL_M = np.arange(512), 0.732


def sidelink(*, ripple_db=0.0, echo=0.0, cells=0.68, cycles=0.0, snr_db=25.0, pulses=120, seed=1):
    """Return pulses of random phase and delay, with an echo whose phase rotates by a number of cycles."""
    rng = np.random.default_rng(seed)
    swing = 10 ** (ripple_db / 20)
    common = 1 + (swing - 1) / (swing + 1) * np.cos(2 * np.pi * NUMBER * 5 / 512)
    rotation = np.exp(2j * np.pi * cycles * np.linspace(0, 1, pulses))[:, None]
    echoes = 1 + echo * rotation * np.exp(-2j * np.pi * NUMBER * cells / 512)
    delayed = np.exp(-2j * np.pi * np.outer(rng.uniform(0, 20, pulses), NUMBER) / 512)
    noise = rng.normal(size=(2, pulses, 512)) / np.sqrt(2) * 10 ** (-snr_db / 20)
    phase = np.exp(2j * np.pi * rng.random((pulses, 1)))
    return (common * echoes * delayed * phase + noise[0] + 1j * noise[1]).astype(np.complex64)


def flag_text(**flaws):
    return second_path_flags(measure(sidelink(**flaws)), cell_m=CELL_M).get("sidelink_ripple_or_echo", "")


@pytest.mark.parametrize(("ripple_db", "flagged"), [(0.0, False), (1.0, False), (1.5, False), (2.0, True), (6.0, True)])
def test_ripple_above_a_ghost_level_of_minus_20_db_is_flagged(ripple_db, flagged):
    text = flag_text(ripple_db=ripple_db)
    assert bool(text) is flagged
    if flagged:
        assert f"ripple of {ripple_db:.1f} dB" in text
        assert "ghosts of" in text


def test_constant_unresolved_echo_reports_path_and_phase_errors():
    """An echo of -6 dB delayed by half a metre causes errors of 5.4 cm in range (10.8 cm in path) and 0.33 rad."""
    text = flag_text(echo=0.5)
    path_cm, phase_rad = (float(number) for number in re.search(r"about (\d+) cm.*about (\d\.\d+) rad", text).groups())
    assert 8 < path_cm < 40
    assert 0.2 < phase_rad < 0.5


@pytest.mark.parametrize(("echo", "flagged"), [(0.0, False), (0.1, False), (0.3, True), (0.5, True)])
@pytest.mark.parametrize("snr_db", [12.0, 30.0])
def test_varying_unresolved_echo_is_identified(echo, flagged, snr_db):
    text = flag_text(echo=echo, cycles=3.0, snr_db=snr_db)
    assert ("varies during the flight and is therefore an echo" in text) is flagged
    assert bool(text) is flagged


@pytest.mark.parametrize(("cycles", "flagged"), [(0.0, True), (2.0, False)])
def test_constant_resolved_arrival_is_ambiguous_and_rotating_is_not(cycles, flagged):
    assert ("an echo or transmit ripple" in flag_text(echo=0.15, cells=6.0, cycles=cycles)) is flagged
    assert flag_text(echo=0.08, cells=6.0, cycles=cycles) == ""


@pytest.mark.parametrize("snr_db", [-10.0, 0.0, 30.0])
def test_clean_sidelink_raises_no_flag_at_any_snr(snr_db):
    assert not any(flag_text(snr_db=snr_db, seed=seed) for seed in range(10))
