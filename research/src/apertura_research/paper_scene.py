"""The scene of every study: the paper's five targets as arrays, and their transfer functions at a receiver."""

from dataclasses import dataclass, replace
from math import factorial

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import fft
from scipy.signal import CZT

from apertura.common.arrays import Complexes
from apertura.core.echo.demodulate import subcarrier_numbers
from apertura.simulation.impairments import Impairments
from apertura.simulation.observation import Observation, observe
from apertura.simulation.presets import paper_scene, paper_waveform
from apertura.simulation.scatterers import spectrum
from apertura.simulation.synthesis import (
    Channel,
    Geometry,
    digitize,
    full_scale,
    noise,
    sampling_rate,
    transfer_functions,
)
from apertura.simulation.targets import Scatterers
from apertura.simulation.waveform import TransmitWaveform, newman_codes, qpsk_codes

LENGTH_M = 30.0
"""Length of the aperture, flown at 1 m/s."""

RX_AHEAD_M = 4.7
"""Distance of the receiver ahead of the transmitter, along the track, in the bistatic studies."""


@dataclass(frozen=True)
class PaperScene:
    """Waveform, targets and logged positions of the paper's scene.

    Coordinates are local Cartesian metres: along track, across track, up.
    """

    waveform: TransmitWaveform
    scatterers: Scatterers
    geometry: Geometry


def reduced_scene(*, pulses: int, subcarriers: int, rx_ahead_m: float = 0.0, qpsk: bool = False) -> PaperScene:
    """Return the paper's simulated scene with fewer pulses and subcarriers over the same track and band.

    Parameters
    ----------
    pulses
        Pulses along the aperture; at least 150, so that no grating lobe of one target falls on another.
    subcarriers
        A divisor of 4096; at least 128, so that the scene is shorter than the unambiguous path c/Δf.
    rx_ahead_m
        Distance of the receiver ahead of the transmitter; 0 for the monostatic pair.
    qpsk
        Random QPSK codes, whose leakage between subcarriers is noise-like, instead of the flat quadratic-phase code,
        where part of the leakage is a displacement.

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
    """Errors of one observation.

    Attributes
    ----------
    sampled
        True: simulate samples (with clock errors, Doppler and converter) instead of transfer functions.
    quantised
        True: quantise the samples by the receiver's converter.
    """

    receiver: Impairments = NO_IMPAIRMENTS
    transmitter: Impairments = NO_IMPAIRMENTS
    sampled: bool = False
    quantised: bool = False


UNDISTURBED = Disturbance()


def receive_pair(
    scene: PaperScene, disturbance: Disturbance, generator: Generator
) -> tuple[Complexes, Complexes, Observation]:
    """Simulate the transfer functions of radar and sidelink, (pulse, subcarrier) complex64, with the observation.

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
    """Simulate the radar's transfer functions, (pulse, subcarrier) complex64, without errors or noise."""
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


_PULSES_AT_ONCE = 32
_DOPPLER_ORDER = 3


def window_samples(channel: Channel, generator: Generator | None) -> NDArray[np.complex128]:
    """Simulate the samples of every capture in the DFT window, (pulse, sample) complex128.

    Equal to `apertura.simulation.synthesis.samples` from the end of the prefix on if every path arrives within the
    prefix; this function is twenty times faster, because the edges of paths are not computed. Without a generator, no
    noise is added.

    Notes
    -----
    Source: docs/theory/simulate.md, eqs. 3 and 4.
    """
    waveform, rate = channel.waveform, sampling_rate(channel)
    index = waveform.prefix_samples + np.arange(waveform.dft_samples)
    numbers = subcarrier_numbers(len(waveform.codes), carrier_is=waveform.carrier_is)
    cycles = waveform.subcarrier_spacing_hz / rate
    lead = cycles * waveform.prefix_samples - waveform.subcarrier_spacing_hz * waveform.cyclic_prefix_s
    factor = waveform.codes * channel.response * np.exp(2j * np.pi * lead * numbers)
    mixer = np.exp(2j * np.pi * (cycles * numbers[0] * np.arange(index.size) - channel.cfo_hz / rate * index))
    zoom = CZT(len(factor), index.size, w=np.exp(2j * np.pi * cycles))
    out = np.empty((len(channel.phase_rad), index.size), np.complex128)
    for first in range(0, len(out), _PULSES_AT_ONCE):
        pulses = slice(first, first + _PULSES_AT_ONCE)
        pulse_mixer = mixer * np.exp(1j * channel.phase_rad[pulses, None])
        out[pulses] = _symbols(channel, pulses, zoom, factor, index / rate) * pulse_mixer
    if generator is not None and channel.noise_variance:
        out += noise(generator, out.shape, channel.noise_variance)
    return out


def _symbols(
    channel: Channel, pulses: slice, zoom: CZT, factor: NDArray[np.complex128], time_s: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Return the DFT window before the mixer, with the Doppler of each path as a Taylor series in t."""
    waveform, paths = channel.waveform, channel.paths.at(pulses)
    middle_s = waveform.duration_s / 2
    late_s = paths.delay_s + paths.delay_rate * middle_s - channel.start_s[pulses, None]
    total = np.zeros((len(late_s), time_s.size), np.complex128)
    for order in range(_DOPPLER_ORDER + 1 if paths.delay_rate.any() else 1):
        of_paths = spectrum(late_s, paths.amplitude * paths.delay_rate**order, waveform.frequency_hz)
        of_order = of_paths * factor * (-2j * np.pi * waveform.frequency_hz) ** order / factorial(order)
        since = time_s + channel.start_s[pulses, None] - middle_s
        total += since**order * zoom(of_order)
    return total


def demodulated(samples: NDArray[np.complexfloating], waveform: TransmitWaveform) -> NDArray[np.complex64]:
    """Demodulate window samples into transfer functions, (pulse, subcarrier) complex64: DFT and code removal.

    Examples
    --------
    >>> wave = TransmitWaveform(np.full(2, 2.0), 1e9, "band_start", 1e6, 1e-6, 0.0, 8e6, 1.0)
    >>> demodulated(2 * np.exp(2j * np.pi * np.arange(8) / 8)[None], wave).round(6) + 0
    array([[0.+0.j, 1.+0.j]], dtype=complex64)
    """
    numbers = subcarrier_numbers(len(waveform.codes), carrier_is=waveform.carrier_is)
    spectrum = fft.fft(samples, axis=1, norm="forward")[:, numbers % waveform.dft_samples]
    return np.asarray(spectrum / waveform.codes, np.complex64)
