"""Constellations: mean power, Gray mapping, decisions, noise gain and symbol error rate."""

import numpy as np
import pytest

from apertura.common.errors import CampaignError
from apertura.core.echo.constellation import CONSTELLATIONS, constellation


@pytest.mark.parametrize("name", CONSTELLATIONS)
def test_constellation_has_unit_power_and_neighbours_differ_in_one_bit(name: str) -> None:
    """The mean power is 1, and labels of points at the minimum distance differ in one bit."""
    qam = constellation(name)
    assert np.mean(np.abs(qam.points) ** 2) == pytest.approx(1, abs=1e-6)
    distance = np.abs(qam.points[:, None] - qam.points)
    near = np.isclose(distance, 2 * qam.half_distance, rtol=1e-4)
    assert near.sum() == 4 * qam.side * (qam.side - 1)
    assert distance[distance > 1e-6].min() == pytest.approx(2 * qam.half_distance, rel=1e-5)
    labels = np.arange(len(qam.points))
    assert np.all(np.bitwise_count((labels[:, None] ^ labels)[near]) == 1)


@pytest.mark.parametrize("name", CONSTELLATIONS)
def test_decisions_choose_the_nearest_point_and_bits_return_to_symbols(name: str) -> None:
    """Decisions agree with a search over all points; bits, labels and symbols are inverse to each other."""
    qam, random = constellation(name), np.random.default_rng(1)
    received = random.normal(size=(30, 40, 2)) @ [1, 1j]
    nearest = np.abs(received[..., None] - qam.points).argmin(-1)
    assert np.array_equal(qam.decide(received), nearest)
    assert np.array_equal(qam.decide(received.astype(np.complex64)), nearest)
    bits = random.integers(0, 2, (5, 24 * qam.bits_per_symbol))
    assert np.array_equal(qam.bits(qam.decide(qam.symbols(bits))), bits)


@pytest.mark.parametrize(("name", "gain"), [("qpsk", 1.0), ("16qam", 17 / 9), ("64qam", 2.6854), ("256qam", 3.4380)])
def test_division_by_symbols_amplifies_noise_by_the_noise_gain(name: str, gain: float) -> None:
    """The noise gain is E[1/|c|²], 17/9 for 16-QAM."""
    assert constellation(name).noise_gain == pytest.approx(gain, abs=1e-3)


@pytest.mark.parametrize("name", CONSTELLATIONS)
@pytest.mark.parametrize("errors", [0.3, 0.03])
def test_symbol_error_rate_in_noise_equals_theory(name: str, errors: float) -> None:
    """Measured symbol error rates equal eq. 3 within four standard deviations."""
    qam, random, count = constellation(name), np.random.default_rng(2), 60_000
    snr = np.logspace(-1, 4, 2001)
    snr = snr[np.argmin(np.abs(qam.symbol_error_rate(snr) - errors))]
    sent = random.integers(0, len(qam.points), count)
    noise = random.normal(scale=np.sqrt(0.5 / snr), size=(count, 2)) @ [1, 1j]
    expected = float(qam.symbol_error_rate(snr))
    measured = np.mean(qam.decide(qam.points[sent] + noise) != sent)
    assert measured == pytest.approx(expected, abs=4 * np.sqrt(expected / count))


def test_unknown_constellation_is_refused() -> None:
    """The error lists the constellations."""
    with pytest.raises(CampaignError, match="16qam"):
        constellation("8psk")
