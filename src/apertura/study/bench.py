"""The scene every study looks at: the paper's five targets as arrays, thinned to what a question needs."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from apertura.simulation.impairments import Impairments
from apertura.simulation.observation import Observation, observe
from apertura.simulation.presets import paper_scene, paper_waveform
from apertura.simulation.radar import TransmitWaveform, newman_codes, qpsk_codes
from apertura.simulation.recording import Geometry, digitize, full_scale
from apertura.simulation.scene import Scatterers
from apertura.simulation.synthesis import transfer_functions
from apertura.study.window import demodulated, window_samples

Complexes = NDArray[np.complex64]


@dataclass(frozen=True)
class Bench:
    """What is transmitted, over which targets, from where.

    Attributes
    ----------
    waveform
        The paper's, with as many subcarriers over the same band as the question needs.
    scatterers
        Targets on the ground, in local Cartesian metres: along the track, across it, up.
    geometry
        Phase centres as the logs say.
    """

    waveform: TransmitWaveform
    scatterers: Scatterers
    geometry: Geometry

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """(subcarrier,) float64, RF."""
        return self.waveform.frequency_hz

    @property
    def sidelink_m(self) -> NDArray[np.float64]:
        """(pulse,) float64, length of the direct path as the logs say."""
        return np.asarray(np.linalg.norm(self.geometry.sidelink_tx - self.geometry.sidelink_rx, axis=1))


def paper_bench(
    *,
    pulses: int,
    subcarriers: int,
    rx_ahead_m: float = 0.0,
    length_m: float = 30.0,
    speed_m_s: float = 1.0,
    qpsk: bool = False,
) -> Bench:
    """Return the paper's simulated scene with fewer pulses and subcarriers over the same aperture and band.

    Parameters
    ----------
    pulses
        Along the aperture, at least 150: then no grating lobe of one target falls on another.
    subcarriers
        A divisor of 4096, at least 128: then the scene is shorter than the unambiguous path c/Δf.
    rx_ahead_m
        Distance of the receiver ahead of the transmitter; 0 for the monostatic pair.
    length_m, speed_m_s
        Aperture and ground speed, which give the repetition frequency.
    qpsk
        Random QPSK codes, whose leakage between subcarriers is like noise, instead of the flat quadratic-phase
        code, which turns part of it into a shift.

    Notes
    -----
    Source: docs/theory/study.md, "Thinning".

    Examples
    --------
    >>> bench = paper_bench(pulses=300, subcarriers=128)
    >>> float(bench.waveform.prf_hz), float(bench.frequency_hz[-1] - bench.frequency_hz[0])
    (10.0, 406400000.0)
    """
    waveform = paper_waveform(prf_hz=pulses * speed_m_s / length_m)
    every = len(waveform.codes) // subcarriers
    codes = qpsk_codes(subcarriers, np.random.default_rng(3)) if qpsk else newman_codes(subcarriers)
    waveform = replace(waveform, codes=codes, subcarrier_spacing_hz=every * waveform.subcarrier_spacing_hz)
    scatterers, geometry = paper_scene(pulses=pulses, length_m=length_m, rx_ahead_m=rx_ahead_m)
    return Bench(waveform, scatterers, geometry)


PERFECT = Impairments()


@dataclass(frozen=True)
class Case:
    """What goes wrong in one observation.

    Attributes
    ----------
    receiver
        Impairments of the receiving node.
    transmitter
        Of the transmitting node; None: one node does both.
    sampled
        Go through samples (clock errors, Doppler, the converter) instead of transfer functions.
    quantised
        Pass the samples through the converter of the receiver.
    """

    receiver: Impairments = PERFECT
    transmitter: Impairments | None = None
    sampled: bool = False
    quantised: bool = False


def receive_pair(bench: Bench, case: Case, generator: Generator) -> tuple[Complexes, Complexes, Observation]:
    """Return transfer functions of radar and sidelink, (pulse, subcarrier) complex64, and what was drawn.

    Examples
    --------
    >>> bench = paper_bench(pulses=4, subcarriers=128, rx_ahead_m=4.7)
    >>> radar, sidelink, _ = receive_pair(bench, Case(transmitter=Impairments()), np.random.default_rng(0))
    >>> radar.shape, sidelink.shape
    ((4, 128), (4, 128))
    """
    seen = observe(
        bench.waveform,
        bench.scatterers,
        bench.geometry,
        generator,
        receiver=case.receiver,
        transmitter=case.transmitter,
    )
    both = [_channel(seen, name, case) for name in ("radar", "sidelink")]
    return both[0], both[1], seen


def _channel(seen: Observation, name: str, case: Case) -> Complexes:
    channel, noise = seen.channels[name], seen.noise[name]
    if not case.sampled:
        return transfer_functions(channel, noise).astype(np.complex64)
    samples = window_samples(channel, noise)
    if case.quantised:
        adc = case.receiver.adc
        scale = full_scale(channel, adc)
        counts = digitize(samples, adc, scale)
        samples = (counts[..., 0] + 1j * counts[..., 1]) * (scale / 2 ** (adc.bits - 1))
    return demodulated(samples, channel.waveform)
