"""Signals that are received besides the echoes, and their removal as in step `profile`.

Levels are relative to the mean power of the echoes of the pair (docs/theory/study.md, "Atlas of error sources").
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.flags import Flags
from apertura.core.echo.background import GroupMeans, background_excess_db
from apertura.core.echo.captures import runs, sampled_pulses
from apertura.core.echo.compression import window_weights
from apertura.core.echo.interference import Interference, PulsedInterference
from apertura.core.imaging.background import BackgroundScene, decide_removal
from apertura.core.scene.terrain import FlatGround
from apertura_research.error_atlas.flight import GRID, Received, TrueFlight

Receive = Callable[[TrueFlight, str, Received, float, Generator], Received]

_TONE_AT, _OFF_BIN = 90, 0.3  # subcarrier of the tone, and its distance from the centre of the subcarrier
_PULSED_SHARE = 0.1
_COUPLING_M = 1.0  # total path between the antennas of node a


def echoes_alone(flown: TrueFlight, pair: str, received: Received, size: float, generator: Generator) -> Received:  # noqa: ARG001
    """Return the echoes unchanged."""
    return received


def with_tone(flown: TrueFlight, pair: str, received: Received, level_db: float, generator: Generator) -> Received:
    """Add a continuous tone, whose phase at the trigger is random, and process the pair."""
    count = len(received.transfer)
    line = _line(received, _TONE_AT + _OFF_BIN, level_db) * _phases(generator, count)
    return processed(flown, pair, replace(received, transfer=received.transfer + line.astype(np.complex64)))


def with_pulses(flown: TrueFlight, pair: str, received: Received, level_db: float, generator: Generator) -> Received:
    """Add pulsed tones at random frequencies to a tenth of the pulses, and process the pair."""
    count, subcarriers = received.transfer.shape
    hit = np.less(generator.random(count), _PULSED_SHARE)
    lines = np.stack([_line(received, at, level_db) for at in generator.uniform(0, subcarriers - 1, count)])
    signal = hit[:, None] * lines * _phases(generator, count)
    return processed(flown, pair, replace(received, transfer=received.transfer + signal.astype(np.complex64)))


def with_coupling(flown: TrueFlight, pair: str, received: Received, level_db: float, generator: Generator) -> Received:  # noqa: ARG001
    """Add the coupling between the antennas of the monostatic pair, at a constant delay, and process the pair."""
    if received.sidelink_m is None:
        turn = np.exp(-2j * np.pi * flown.frequency_hz * _COUPLING_M / SPEED_OF_LIGHT_M_S)
        coupling = np.sqrt(_mean_power(received) * 10 ** (level_db / 10)) * turn
        received = replace(received, transfer=received.transfer + coupling.astype(np.complex64))
    return processed(flown, pair, received)


def processed(flown: TrueFlight, pair: str, received: Received) -> Received:
    """Remove interference and, from a monostatic pair, background, as decided by step `profile`; return the flags."""
    transfer, frequency_hz = received.transfer, flown.frequency_hz
    weight, pulses = window_weights("hann", len(frequency_hz)), sampled_pulses(len(transfer))
    interference = Interference.measured(runs(pulses, [transfer[some] for some in pulses]), frequency_hz, weight)
    flags = interference.flags
    if interference.is_removed:
        transfer, weight = transfer * interference.gain, weight * interference.gain
    if received.sidelink_m is None and background_excess_db([transfer[some] for some in pulses]) >= 0:
        nowhere_s = np.zeros(len(transfer))
        history = flown.truth.history(pair, replace(received, transfer=transfer), frequency_hz)
        scene = BackgroundScene(history, nowhere_s, nowhere_s, flown.time_s, GRID, FlatGround(0.0))
        means = GroupMeans.of(transfer.__getitem__, flown.time_s)
        removal = decide_removal(means, scene, method="auto", generator=np.random.default_rng(0))
        if removal.background:
            transfer = transfer - removal.background.at(flown.time_s, frequency_hz, nowhere_s)
        flags = Flags.merged(flags, removal.flags)
    pulsed = PulsedInterference.measured([transfer[some] for some in pulses], frequency_hz, weight)
    if pulsed:
        transfer, flags = pulsed.removed(transfer), Flags.merged(flags, pulsed.flags)
    return replace(received, transfer=transfer, flags=flags)


def _mean_power(received: Received) -> float:
    return float(np.mean(np.abs(received.transfer) ** 2))


def _line(received: Received, at: float, level_db: float) -> Floats:
    """Return the magnitude of a tone of one DFT window in each subcarrier, its frequency in subcarriers from the first.

    The power of the tone is that of all subcarriers of an echo, and leaks by the Dirichlet kernel of the window.
    """
    count = received.transfer.shape[1]
    kernel = np.sinc(np.arange(count) - at) / np.sinc((np.arange(count) - at) / count)
    return np.asarray(np.sqrt(count * _mean_power(received) * 10 ** (level_db / 10)) * kernel)


def _phases(generator: Generator, count: int) -> NDArray[np.complex128]:
    return np.asarray(np.exp(2j * np.pi * generator.random((count, 1))))
