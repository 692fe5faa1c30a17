"""Tracks refined by the image itself."""

import numpy as np
import pytest

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.focus.engines import reference
from apertura.focus.inputs import PhaseHistory
from apertura.geometry.aperture import Aperture
from apertura.geometry.track_correction import TrackCorrection

FREQUENCY_HZ = 1.2e9 + 3.2e6 * np.arange(128)
TIME_S = np.linspace(0, 30, 300)
TARGET_M = np.array([[1.0, 12.0, 0.0]])


def flown(ahead_m=0.0):
    along = np.stack([TIME_S - 15 + ahead_m, np.zeros(300), np.full(300, 10.0)], -1)
    return along


def echo(true, logged, sidelink):
    """Echo of the target as it was flown, given back the sidelink's length that the logs have."""
    path = true.path(TARGET_M)
    if sidelink:
        length = [np.linalg.norm(one.tx_m - one.rx_m, axis=1)[:, None] for one in (true, logged)]
        path = path - length[0] + length[1]
    transfer = np.exp(-2j * np.pi * FREQUENCY_HZ * path / SPEED_OF_LIGHT_M_S).astype(np.complex64)
    return PhaseHistory(transfer, FREQUENCY_HZ, np.full(128, 1 / 128), np.zeros(300), logged)


@pytest.mark.parametrize(("pair", "ahead_m"), [("a-a", 0.0), ("a-b", 4.7)])
def test_a_corrected_track_focuses_as_the_true_one(pair, ahead_m):
    knots = np.linspace(0, 30, 31)
    generator = np.random.default_rng(1)
    correction = TrackCorrection(knots, {node: 0.02 * generator.standard_normal((31, 3)) for node in "ab"})
    logged = Aperture(flown(), flown(ahead_m))
    true = correction.aperture(logged, pair, TIME_S)
    history = echo(true, logged, sidelink=pair == "a-b")
    assert abs(reference.form(history, TARGET_M)[0]) / 300 < 0.8
    between = logged.tx_m - logged.rx_m
    further = correction.sidelink_m(between, pair, TIME_S) if pair == "a-b" else np.zeros(300)
    mended = history.moved(true, further)
    assert abs(reference.form(mended, TARGET_M)[0] / 300 - 1) < 1e-5
