"""The scene of every study: the paper's five targets as arrays, with as few pulses and subcarriers as suffice."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from apertura.common.arrays import Complexes
from apertura.simulation.impairments import Impairments
from apertura.simulation.observation import Observation, observe
from apertura.simulation.presets import paper_scene, paper_waveform
from apertura.simulation.radar import TransmitWaveform, newman_codes, qpsk_codes
from apertura.simulation.recording import Geometry, digitize, full_scale
from apertura.simulation.scene import Scatterers
from apertura.simulation.synthesis import transfer_functions
from apertura_research.study.dft_window import demodulated, window_samples

LENGTH_M = 30.0
"""Aperture, flown at 1 m/s."""

RX_AHEAD_M = 4.7
"""Distance of the receiver ahead of the transmitter, along the track, in the bistatic studies."""


@dataclass(frozen=True)
class PaperScene:
    """What is transmitted, over which targets, from where as the logs say.

    In local Cartesian metres: along the track, across it, up.
    """

    waveform: TransmitWaveform
    scatterers: Scatterers
    geometry: Geometry


def reduced_scene(*, pulses: int, subcarriers: int, rx_ahead_m: float = 0.0, qpsk: bool = False) -> PaperScene:
    """Return the paper's simulated scene with fewer pulses and subcarriers over the same 30 m at 1 m/s and band.

    Parameters
    ----------
    pulses
        Along the aperture, at least 150: then no grating lobe of one target falls on another.
    subcarriers
        A divisor of 4096, at least 128: then the scene is shorter than the unambiguous path c/Δf.
    rx_ahead_m
        Distance of the receiver ahead of the transmitter; 0 for the monostatic pair.
    qpsk
        Random QPSK codes, whose leakage between subcarriers is like noise, instead of the flat quadratic-phase
        code, which turns part of it into a shift.

    Notes
    -----
    Source: docs/theory/study.md, "Fewer pulses and subcarriers".

    Examples
    --------
    >>> scene = reduced_scene(pulses=300, subcarriers=128)
    >>> float(scene.waveform.prf_hz), len(scene.waveform.codes) * scene.waveform.subcarrier_spacing_hz
    (10.0, 409600000.0)
    """
    waveform = paper_waveform(prf_hz=pulses / LENGTH_M)
    every = len(waveform.codes) // subcarriers
    codes = qpsk_codes(subcarriers, np.random.default_rng(3)) if qpsk else newman_codes(subcarriers)
    waveform = replace(waveform, codes=codes, subcarrier_spacing_hz=every * waveform.subcarrier_spacing_hz)
    return PaperScene(waveform, *paper_scene(pulses=pulses, rx_ahead_m=rx_ahead_m))


NO_IMPAIRMENTS = Impairments()


@dataclass(frozen=True)
class Disturbance:
    """What goes wrong in one observation.

    Attributes
    ----------
    sampled
        Go through samples (clock errors, Doppler, the converter) instead of transfer functions.
    quantised
        Pass the samples through the converter of the receiver.
    """

    receiver: Impairments = NO_IMPAIRMENTS
    transmitter: Impairments = NO_IMPAIRMENTS
    sampled: bool = False
    quantised: bool = False


UNDISTURBED = Disturbance()


def receive_pair(
    scene: PaperScene, disturbance: Disturbance, generator: Generator
) -> tuple[Complexes, Complexes, Observation]:
    """Return transfer functions of radar and sidelink, (pulse, subcarrier) complex64, and what was drawn.

    Examples
    --------
    >>> scene = reduced_scene(pulses=4, subcarriers=128, rx_ahead_m=4.7)
    >>> radar, sidelink, _ = receive_pair(scene, UNDISTURBED, np.random.default_rng(0))
    >>> radar.shape, sidelink.shape
    ((4, 128), (4, 128))
    """
    observation = observe(
        scene.waveform,
        scene.scatterers,
        scene.geometry,
        generator,
        receiver=disturbance.receiver,
        transmitter=disturbance.transmitter,
    )
    radar = _transfer(observation, "radar", disturbance)
    return radar, _transfer(observation, "sidelink", disturbance), observation


def receive_undisturbed(scene: PaperScene) -> Complexes:
    """Return the radar's transfer functions, (pulse, subcarrier) complex64, with nothing wrong and without noise."""
    return receive_pair(scene, UNDISTURBED, np.random.default_rng(0))[0]


def _transfer(observation: Observation, name: str, disturbance: Disturbance) -> Complexes:
    channel, noise = observation.channels[name], observation.noise[name]
    if not disturbance.sampled:
        return transfer_functions(channel, noise).astype(np.complex64)
    samples = window_samples(channel, noise)
    if disturbance.quantised:
        adc = disturbance.receiver.adc
        scale = full_scale(channel, adc)
        counts = digitize(samples, adc, scale)
        samples = (counts[..., 0] + 1j * counts[..., 1]) * (scale / 2 ** (adc.bits - 1))
    return demodulated(samples, channel.waveform)
