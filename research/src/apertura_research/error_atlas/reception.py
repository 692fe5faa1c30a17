"""Signals that are received besides the echoes, and their removal as in steps `echo` and `profile`.

Levels are relative to the mean power of the echoes of the pair (docs/theory/study.md, "Atlas of error sources").
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.flags import Flags
from apertura.core.echo.background import GroupMeans, background_excess_db
from apertura.core.echo.captures import runs, sampled_pulses
from apertura.core.echo.compression import window_weights
from apertura.core.echo.demodulate import Numerology, subcarrier_numbers
from apertura.core.echo.interference import Interference, PulsedInterference
from apertura.core.echo.tones import Tones
from apertura.core.imaging.background import BackgroundScene, decide_removal
from apertura.core.scene.terrain import FlatGround
from apertura_research.error_atlas.flight import GRID, Received, TrueFlight

Receive = Callable[[TrueFlight, str, Received, float, Generator], Received]

_TONE_AT = 90.3  # subcarriers from the carrier, between two of them
_PULSED_SHARE = 0.1
_COUPLING_M = 1.0  # total path between the antennas of node a


def echoes_alone(flown: TrueFlight, pair: str, received: Received, size: float, generator: Generator) -> Received:  # noqa: ARG001
    """Return the echoes unchanged."""
    return received


def with_tone(flown: TrueFlight, pair: str, received: Received, level_db: float, generator: Generator) -> Received:
    """Add a continuous tone, whose phase at the trigger is random, and process the pair."""
    count = len(received.transfer)
    return _with(flown, pair, received, level_db, _tones(flown, np.full(count, _TONE_AT), generator))


def with_pulses(flown: TrueFlight, pair: str, received: Received, level_db: float, generator: Generator) -> Received:
    """Add pulses of a quarter of a DFT window at random frequencies to a tenth of the pulses, and process the pair."""
    count, subcarriers = received.transfer.shape
    hit = np.less(generator.random(count), _PULSED_SHARE)
    tones = _tones(flown, generator.uniform(0, subcarriers - 1, count), generator, share=0.25)
    return _with(flown, pair, received, level_db, hit[:, None] * tones)


def with_coupling(flown: TrueFlight, pair: str, received: Received, level_db: float, generator: Generator) -> Received:  # noqa: ARG001
    """Add the coupling between the antennas of the monostatic pair, at a constant delay, and process the pair."""
    coupling = np.exp(-2j * np.pi * flown.frequency_hz * _COUPLING_M / SPEED_OF_LIGHT_M_S)
    return _with(flown, pair, received, level_db, coupling[None])


def _with(
    flown: TrueFlight, pair: str, received: Received, level_db: float, signal: NDArray[np.complex128]
) -> Received:
    """Add a signal of unit power per subcarrier to the monostatic pair, and process the pair."""
    if received.sidelink_m is not None:
        return received
    amplitude = np.sqrt(np.mean(np.abs(received.transfer) ** 2) * 10 ** (level_db / 10))
    transfer = received.transfer + np.asarray(amplitude * signal, np.complex64)
    return processed(flown, pair, replace(received, transfer=transfer))


def _tones(flown: TrueFlight, at: Floats, generator: Generator, share: float = 1.0) -> NDArray[np.complex128]:
    """Return the transfer functions of tones in each pulse, at frequencies in subcarriers, in a share of the window."""
    numerology, count = _numerology(flown), len(flown.frequency_hz)
    time = np.arange(numerology.dft_samples) / numerology.dft_samples
    phase = generator.random((len(at), 1))
    samples = (
        np.sqrt(count) * np.exp(2j * np.pi * (at[:, None] * time + phase)) * (np.abs(time - 0.5) < share / 2 + 1e-9)
    )
    symbols = np.fft.fft(samples, axis=1, norm="forward")[:, numerology.numbers % numerology.dft_samples]
    return np.asarray(symbols / flown.scene.waveform.codes)


def _numerology(flown: TrueFlight) -> Numerology:
    waveform = flown.scene.waveform
    numbers = subcarrier_numbers(len(waveform.codes), carrier_is=waveform.carrier_is)
    sizes = waveform.prefix_samples, waveform.dft_samples
    return Numerology(waveform.carrier_hz, waveform.sample_rate_hz, numbers, *sizes)


def processed(flown: TrueFlight, pair: str, received: Received) -> Received:
    """Remove tones, other interference and background as steps `echo` and `profile` do; return the raised flags."""
    transfer, frequency_hz, codes = received.transfer, flown.frequency_hz, flown.scene.waveform.codes
    weight, pulses = window_weights("hann", len(frequency_hz)), sampled_pulses(len(transfer))
    tones = Tones(_numerology(flown), tuple(_interference(transfer, frequency_hz, weight).lines))
    inverse = (1 / codes).astype(np.complex64)[None]
    transfer = np.asarray(tones.removed((transfer * codes).astype(np.complex64), inverse) / codes, np.complex64)
    interference = _interference(transfer, frequency_hz, weight)
    flags = Flags.merged(tones.flags("interference"), interference.flags)
    if interference.is_removed:
        transfer, weight = transfer * interference.gain, weight * interference.gain
    if background_excess_db([transfer[some] for some in pulses]) >= 0:
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


def _interference(transfer: Complexes, frequency_hz: Floats, weight: Floats) -> Interference:
    pulses = sampled_pulses(len(transfer))
    return Interference.measured(runs(pulses, [transfer[some] for some in pulses]), frequency_hz, weight)
