"""Checks of a node's own pulses: presence of the configured code, and phase stability."""

import numpy as np
import pytest

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.echo.own_pulses import own_code, phase_stability

PULSES, CELLS, PREFIX = 200, 256, 80


def echoes(rng, targets=5, *, image_snr_db=60.0, step_m=0.025, phase_rad=0.0):
    """Return (pulse, subcarrier) transfer functions of a flight past targets; image SNR of a target of mean power."""
    frequency = 1.2e9 + 409.6e6 * np.arange(CELLS) / CELLS
    along = (np.arange(PULSES) - PULSES / 2) * step_m
    track = np.stack([along, 0 * along, 0 * along + 5], -1)
    places = np.stack([rng.uniform(-6, 6, targets), 11.5 + rng.uniform(-6, 6, targets), np.zeros(targets)], -1)
    path = 2 * np.linalg.norm(track[:, None] - places, axis=-1)
    gains = rng.normal(size=targets) + 1j * rng.normal(size=targets)
    sums = sum(
        gain * np.exp(-2j * np.pi * frequency * target_path[:, None] / C)
        for gain, target_path in zip(gains, path.T, strict=True)
    )
    sums = sums / np.sqrt(np.mean(np.abs(sums) ** 2)) * np.exp(1j * phase_rad * rng.normal(size=(PULSES, 1)))
    return (sums + noise(rng) * 10 ** (-image_snr_db / 20) * np.sqrt(PULSES * CELLS)).astype(np.complex64)


def noise(rng):
    return (rng.normal(size=(PULSES, CELLS)) + 1j * rng.normal(size=(PULSES, CELLS))) / np.sqrt(2)


def wrong(rng):
    return np.exp(2j * np.pi * rng.random(CELLS)).astype(np.complex64)


@pytest.mark.parametrize("image_snr_db", [30.0, 40.0, 70.0])
@pytest.mark.parametrize("targets", [1, 5])
def test_correct_code_is_confirmed(image_snr_db, targets):
    for seed in range(4):
        found = own_code(echoes(np.random.default_rng(seed), targets, image_snr_db=image_snr_db), prefix_cells=PREFIX)
        assert found.carried, found.evidence
        assert found.flags == {}


@pytest.mark.parametrize("image_snr_db", [15.0, 20.0])
def test_weak_echoes_raise_no_flag(image_snr_db):
    for seed in range(4):
        found = own_code(echoes(np.random.default_rng(seed), image_snr_db=image_snr_db), prefix_cells=PREFIX)
        assert found.carried is not False
        assert found.flags == {}


@pytest.mark.quick("20.0", "80.0")
@pytest.mark.parametrize("image_snr_db", [20.0, 40.0, 50.0, 80.0])
def test_wrong_code_is_not_confirmed_and_flagged_if_strong(image_snr_db):
    for seed in range(12):
        rng = np.random.default_rng(seed)
        found = own_code(echoes(rng, 1 + seed % 6, image_snr_db=image_snr_db) * wrong(rng), prefix_cells=PREFIX)
        assert not found.carried, found.evidence
        if image_snr_db >= 50:
            assert "code is wrong" in found.flags["code_unconfirmed"]


def test_noise_neither_confirms_nor_rejects_a_code():
    verdicts = [own_code(noise(np.random.default_rng(s)).astype(np.complex64), prefix_cells=PREFIX) for s in range(30)]
    assert {verdict.carried for verdict in verdicts} == {None}


def test_prefix_as_long_as_the_period_gives_no_decision():
    found = own_code(echoes(np.random.default_rng(1)), prefix_cells=CELLS - 30)
    assert found.carried is None
    assert "too few cells remain to measure the floor" in found.evidence


def stability(transfer, time_s=None):
    return phase_stability(transfer, np.arange(PULSES) / 20 if time_s is None else time_s, prefix_cells=PREFIX)


@pytest.mark.quick("*-1", "*-5")
@pytest.mark.parametrize("targets", [1, 5, 60])
@pytest.mark.parametrize(("phase_rad", "flagged"), [(0.0, False), (0.3, False), (1.0, True), (30.0, True)])
def test_random_phase_is_detected_on_points_and_clutter(targets, phase_rad, flagged):
    for seed in range(4):
        found = stability(echoes(np.random.default_rng(seed), targets, phase_rad=phase_rad))
        assert ("phase_unstable" in found.flags) is flagged
        if phase_rad == 0.3:  # second differences of white phase noise have √6 times its deviation
            assert found.rms_rad == pytest.approx(np.sqrt(6) * 0.3, rel=0.2)


@pytest.mark.quick("3-*")
@pytest.mark.parametrize("step_m", [0.06, 0.15, 0.3])
@pytest.mark.parametrize("targets", [3, 60])
def test_sparse_sampling_is_not_mistaken_for_unstable_phase(step_m, targets):
    for seed in range(4):
        found = stability(echoes(np.random.default_rng(seed), targets, step_m=step_m))
        assert found is None or found.flags == {}


def test_noise_gives_no_phase_stability():
    assert stability(noise(np.random.default_rng(1)).astype(np.complex64)) is None
    assert stability(echoes(np.random.default_rng(1), image_snr_db=20.0)) is None


def test_missed_pulses_are_no_phase_jumps():
    rng = np.random.default_rng(2)
    kept = np.sort(rng.choice(PULSES, 150, replace=False))
    transfer = echoes(rng, 3, step_m=0.1)[kept]
    assert stability(transfer, kept / 20).coherence > 0.9
    assert stability(transfer, np.arange(150.0)).coherence < 0.7
