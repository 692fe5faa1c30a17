"""The samples of the DFT window alone, for many pulses at once: what sweeps over clocks and converters need."""

from math import factorial

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import fft
from scipy.signal import CZT

from apertura.core.echo.demodulate import subcarrier_numbers
from apertura.simulation.radar import TransmitWaveform
from apertura.simulation.synthesis import Channel, noise, sampling_rate
from apertura.simulation.transfer import spectrum

_PULSES_AT_ONCE = 32
_DOPPLER_ORDER = 3


def window_samples(channel: Channel, generator: Generator | None) -> NDArray[np.complex128]:
    """Return the (pulse, sample) complex128 samples of every capture that the DFT takes.

    Equal to `apertura.simulation.synthesis.samples` from the end of the prefix on, as long as every path has
    arrived by then; twenty times faster, because no edge of any path has to be placed. Without generator, no noise.

    Notes
    -----
    Source: docs/theory/simulate.md, eqs. 3 and 4.
    """
    waveform, rate = channel.waveform, sampling_rate(channel)
    index = waveform.prefix_samples + np.arange(waveform.dft_samples)
    numbers = subcarrier_numbers(len(waveform.codes), carrier_is=waveform.carrier_is)
    turns = waveform.subcarrier_spacing_hz / rate
    lead = turns * waveform.prefix_samples - waveform.subcarrier_spacing_hz * waveform.cyclic_prefix_s
    factor = waveform.codes * channel.response * np.exp(2j * np.pi * lead * numbers)
    mixer = np.exp(2j * np.pi * (turns * numbers[0] * np.arange(index.size) - channel.cfo_hz / rate * index))
    zoom = CZT(len(factor), index.size, w=np.exp(2j * np.pi * turns))
    out = np.empty((len(channel.phase_rad), index.size), np.complex128)
    for first in range(0, len(out), _PULSES_AT_ONCE):
        pulses = slice(first, first + _PULSES_AT_ONCE)
        turned = mixer * np.exp(1j * channel.phase_rad[pulses, None])
        out[pulses] = _symbols(channel, pulses, zoom, factor, index / rate) * turned
    if generator is not None and channel.noise_variance:
        out += noise(generator, out.shape, channel.noise_variance)
    return out


def _symbols(
    channel: Channel, pulses: slice, zoom: CZT, factor: NDArray[np.complex128], time_s: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Return the window before the mixer: a Taylor series in t of the Doppler of each path."""
    waveform, paths = channel.waveform, channel.paths.at(pulses)
    middle_s = waveform.duration_s / 2
    seen = paths.delay_s + paths.delay_rate * middle_s - channel.start_s[pulses, None]
    total = np.zeros((len(seen), time_s.size), np.complex128)
    for order in range(_DOPPLER_ORDER + 1 if paths.delay_rate.any() else 1):
        of_paths = spectrum(seen, paths.amplitude * paths.delay_rate**order, waveform.frequency_hz)
        of_order = of_paths * factor * (-2j * np.pi * waveform.frequency_hz) ** order / factorial(order)
        since = time_s + channel.start_s[pulses, None] - middle_s
        total += since**order * zoom(of_order)
    return total


def demodulated(samples: NDArray[np.complexfloating], waveform: TransmitWaveform) -> NDArray[np.complex64]:
    """Return (pulse, subcarrier) complex64 transfer functions: the DFT of window samples, code removed.

    Examples
    --------
    >>> wave = TransmitWaveform(np.full(2, 2.0), 1e9, "band_start", 1e6, 1e-6, 0.0, 8e6, 1.0)
    >>> demodulated(2 * np.exp(2j * np.pi * np.arange(8) / 8)[None], wave).round(6) + 0
    array([[0.+0.j, 1.+0.j]], dtype=complex64)
    """
    numbers = subcarrier_numbers(len(waveform.codes), carrier_is=waveform.carrier_is)
    spectrum = fft.fft(samples, axis=1, norm="forward")[:, numbers % waveform.dft_samples]
    return np.asarray(spectrum / waveform.codes, np.complex64)
