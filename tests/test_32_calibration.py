"""Path offset from a reflector at a known position, and the cases in which no offset is determined."""

import numpy as np
import pytest

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.common.errors import CampaignError
from apertura.core.echo.calibration import NEEDED_STD_M, estimate_path_offset, reflector_history

FREQUENCY = 1.2e9 + np.arange(256) * 1.6e6  # 409.6 MHz
ALONG = np.linspace(-3, 3, 96)
TX = np.stack([ALONG, 0 * ALONG, 0 * ALONG + 5], -1)
RX = TX + [4.7, 0.0, 0.3]
REFLECTOR = np.array([0.5, 11.0, 0.0])


def path(tx, rx, place):
    return np.linalg.norm(tx - place, axis=1) + np.linalg.norm(rx - place, axis=1)


def fly(rng, *, offset_m=1.374, snr_db=3.0, level=1.0, clutter=0.0, wobble_m=0.0, rival=0.0, rival_m=4.0):
    """Return transfer functions and the path to the reflector by the logged track."""
    error = np.convolve(rng.normal(size=(96 + 16)), np.ones(17) / np.sqrt(17), "valid") * wobble_m
    true = path(TX, RX, REFLECTOR) + error + offset_m
    scatterers = rng.uniform([-8, 4, 0], [8, 25, 0], (30, 3))
    transfer = level * np.exp(-2j * np.pi * FREQUENCY * true[:, None] / C)
    transfer = transfer + level * rival * np.exp(-2j * np.pi * FREQUENCY * (true[:, None] + rival_m) / C)
    for place in scatterers if clutter else []:
        clutter_path_m = (path(TX, RX, place) + error + offset_m)[:, None]
        transfer = transfer + clutter * np.exp(-2j * np.pi * FREQUENCY * clutter_path_m / C)
    noise = (rng.normal(size=transfer.shape) + 1j * rng.normal(size=transfer.shape)) / np.sqrt(2)
    return (transfer + noise * 10 ** (-snr_db / 20)).astype(np.complex64), path(TX, RX, REFLECTOR)


@pytest.mark.parametrize("offset_m", [-4.2, 0.0, 1.374, 9.5])
def test_path_offset_of_a_node_is_estimated_to_2_mm(offset_m):
    transfer, predicted = fly(np.random.default_rng(1), offset_m=offset_m, snr_db=20)
    estimate = estimate_path_offset(transfer, FREQUENCY, path_m=predicted)
    assert estimate.offset_m == pytest.approx(offset_m, abs=0.002)
    assert estimate.std_m < 0.001
    assert estimate.flags == {}


@pytest.mark.quick("10-0.0-0.01")
@pytest.mark.parametrize(("snr_db", "clutter", "wobble_m"), [(-15, 0.0, 0.0), (10, 0.05, 0.0), (10, 0.0, 0.01)])
def test_reported_std_matches_the_errors_of_many_flights(snr_db, clutter, wobble_m):
    flights = [
        estimate_path_offset(transfer, FREQUENCY, path_m=predicted)
        for transfer, predicted in (
            fly(np.random.default_rng(seed), snr_db=snr_db, clutter=clutter, wobble_m=wobble_m) for seed in range(16)
        )
    ]
    errors = np.array([flight.offset_m - 1.374 for flight in flights])
    reported_m = np.sqrt(np.mean([flight.std_m**2 for flight in flights]))
    # errors due to clutter have both signs; therefore, the reported deviation is too large
    assert reported_m / 4 < np.sqrt(np.mean(errors**2)) < reported_m * 2


def test_clutter_of_equal_power_does_not_bias_the_offset():
    transfer, predicted = fly(np.random.default_rng(3), clutter=0.1)
    estimate = estimate_path_offset(transfer, FREQUENCY, path_m=predicted)
    assert estimate.offset_m == pytest.approx(1.374, abs=0.03)


@pytest.mark.parametrize(("level", "visible"), [(0.0, False), (0.01, False), (0.06, True)])
def test_weak_reflector_is_rejected(level, visible):
    transfer, predicted = fly(np.random.default_rng(4), level=level)
    if visible:
        assert estimate_path_offset(transfer, FREQUENCY, path_m=predicted).offset_m == pytest.approx(1.374, abs=0.1)
        return
    with pytest.raises(CampaignError, match="f01: no reflector: the strongest echo within 10 m"):
        estimate_path_offset(transfer, FREQUENCY, path_m=predicted, where="f01")


@pytest.mark.slow
def test_noise_is_rarely_mistaken_for_a_reflector():
    detections = 0
    for seed in range(100):
        try:
            estimate_path_offset(*fly(np.random.default_rng(seed), level=0.0)[:1], FREQUENCY, path_m=np.full(96, 30.0))
        except CampaignError:
            continue
        detections += 1
    assert detections <= 1


@pytest.mark.parametrize(("search_m", "visible"), [(1.2, False), (1.7, True)])
def test_reflector_outside_the_search_is_rejected(search_m, visible):
    transfer, predicted = fly(np.random.default_rng(5), snr_db=20)
    if visible:
        estimate_path_offset(transfer, FREQUENCY, path_m=predicted, search_m=search_m)
        return
    with pytest.raises(CampaignError, match="edge of the search"):
        estimate_path_offset(transfer, FREQUENCY, path_m=predicted, search_m=search_m)


@pytest.mark.parametrize(("rival", "flagged"), [(0.45, False), (0.56, True)])
def test_second_reflector_of_similar_strength_is_flagged(rival, flagged):
    transfer, predicted = fly(np.random.default_rng(6), snr_db=20, rival=rival)
    estimate = estimate_path_offset(transfer, FREQUENCY, path_m=predicted)
    assert estimate.offset_m == pytest.approx(1.374, abs=0.01)
    assert ("calibration_ambiguous" in estimate.flags) == flagged


@pytest.mark.parametrize(("wobble_m", "flagged"), [(0.01, False), (0.2, True)])
def test_uncertain_offset_is_flagged(wobble_m, flagged):
    transfer, predicted = fly(np.random.default_rng(7), snr_db=20, wobble_m=wobble_m)
    estimate = estimate_path_offset(transfer, FREQUENCY, path_m=predicted)
    assert (estimate.std_m > NEEDED_STD_M) == flagged
    assert ("calibration_uncertain" in estimate.flags) == flagged


def test_single_pulse_gives_an_offset_without_std():
    transfer, predicted = fly(np.random.default_rng(8), snr_db=20)
    estimate = estimate_path_offset(transfer[:1], FREQUENCY, path_m=predicted[:1])
    assert estimate.offset_m == pytest.approx(1.374, abs=0.02)
    assert estimate.std_m == np.inf
    assert "calibration_uncertain" in estimate.flags


@pytest.mark.parametrize("offset_m", [0.0, 0.4])
def test_phase_of_a_static_recording_equals_the_clock_phase(offset_m):
    """The random phases of 200 stationary pulses are recovered, and the corrected pulses are coherent."""
    rng = np.random.default_rng(9)
    phase = rng.uniform(-np.pi, np.pi, 200)
    still = np.exp(-2j * np.pi * FREQUENCY * (31.0 + offset_m) / C)
    history = reflector_history(
        (still * np.exp(1j * phase[:, None])).astype(np.complex64), FREQUENCY, path_m=np.full(200, 31.0 + offset_m)
    )
    assert np.angle(history * np.exp(-1j * phase)) == pytest.approx(0, abs=1e-4)
    assert np.abs(history) == pytest.approx(1, abs=1e-4)
