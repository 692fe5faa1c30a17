"""Ripple of the transmitter and an echo of the sidelink: what one channel tells apart, and what it says where not."""

import re

import numpy as np
import pytest

from apertura.core.echo.sidelink import measure
from apertura.core.echo.sidelink_state import second_path_flags

NUMBER, CELL_M = np.arange(512), 0.732


def sidelink(*, ripple_db=0.0, echo=0.0, cells=0.68, turns=0.0, snr_db=25.0, pulses=120, seed=1):
    """Pulses of random phase and delay; an echo whose phase goes through so many turns over the flight."""
    rng = np.random.default_rng(seed)
    swing = 10 ** (ripple_db / 20)
    common = 1 + (swing - 1) / (swing + 1) * np.cos(2 * np.pi * NUMBER * 5 / 512)
    turned = np.exp(2j * np.pi * turns * np.linspace(0, 1, pulses))[:, None]
    echoes = 1 + echo * turned * np.exp(-2j * np.pi * NUMBER * cells / 512)
    late = np.exp(-2j * np.pi * np.outer(rng.uniform(0, 20, pulses), NUMBER) / 512)
    noise = rng.normal(size=(2, pulses, 512)) / np.sqrt(2) * 10 ** (-snr_db / 20)
    phase = np.exp(2j * np.pi * rng.random((pulses, 1)))
    return (common * echoes * late * phase + noise[0] + 1j * noise[1]).astype(np.complex64)


def line(**flaws):
    return second_path_flags(measure(sidelink(**flaws)), cell_m=CELL_M).get("sidelink_ripple_or_echo", "")


@pytest.mark.parametrize(("ripple_db", "flagged"), [(0.0, False), (1.0, False), (1.5, False), (2.0, True), (6.0, True)])
def test_ripple_that_would_be_a_ghost_of_minus_20_db_is_flagged_as_ripple_or_echo(ripple_db, flagged):
    said = line(ripple_db=ripple_db)
    assert bool(said) is flagged
    if flagged:
        assert f"ripple of {ripple_db:.1f} dB" in said
        assert "ghosts of" in said


def test_an_unresolved_echo_that_stays_says_how_wrong_paths_and_phases_are_if_it_is_one():
    """-6 dB, half a metre later: 5.4 cm of range (10.8 cm of path) and 0.33 rad were measured."""
    said = line(echo=0.5)
    path_cm, phase_rad = (float(one) for one in re.search(r"about (\d+) cm.*about (\d\.\d+) rad", said).groups())
    assert 8 < path_cm < 40
    assert 0.2 < phase_rad < 0.5


@pytest.mark.parametrize(("echo", "flagged"), [(0.0, False), (0.1, False), (0.3, True), (0.5, True)])
@pytest.mark.parametrize("snr_db", [12.0, 30.0])
def test_an_unresolved_echo_that_changes_over_the_flight_is_known_as_one(echo, flagged, snr_db):
    said = line(echo=echo, turns=3.0, snr_db=snr_db)
    assert ("varies during the flight and is therefore an echo" in said) is flagged
    assert bool(said) is flagged


@pytest.mark.parametrize(("turns", "flagged"), [(0.0, True), (2.0, False)])
def test_a_resolved_arrival_that_stays_may_be_either_and_one_that_turns_is_an_echo(turns, flagged):
    assert ("an echo or transmit ripple" in line(echo=0.15, cells=6.0, turns=turns)) is flagged
    assert line(echo=0.08, cells=6.0, turns=turns) == ""


@pytest.mark.parametrize("snr_db", [-10.0, 0.0, 30.0])
def test_a_clean_sidelink_raises_nothing_at_any_snr(snr_db):
    assert not any(line(snr_db=snr_db, seed=seed) for seed in range(10))
