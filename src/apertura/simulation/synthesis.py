"""From paths to samples: exact synthesis of what a receiver with its own clock digitises.

A delay acts on each subcarrier, so all echoes are summed as one spectrum and brought to the receiver's own
time grid by an inverse DFT, or by a chirp-z transform where its sampling rate is off. Edges are true: an
echo is absent before it arrives and after it has ended.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from apertura.simulation.impairments import Floats
from apertura.simulation.radar import Paths, TransmitWaveform
from apertura.simulation.transfer import spectrum

Complex = NDArray[np.complex128]

_SHORT = 64  # samples; shorter stretches are summed directly, longer ones cut out of a transform
_DOPPLER_ORDER = 3  # terms of exp(-j2πf·rate·t); at 100 m/s and 1.6 GHz the next one is below -150 dB


@dataclass(frozen=True)
class Channel:
    """One receiving channel over a flight: everything that decides its samples, drawn already.

    Attributes
    ----------
    response
        (subcarrier,) complex128, ripple of transmitter and receiver.
    phase_rad
        (pulse,) float64, phase of the carrier against the transmitter's.
    start_s
        (pulse,) float64, start of the capture less start of the pulse, seconds.
    cfo_hz, sfo_hz
        The receiver's local oscillator and sampling rate less their nominal frequencies, Hz.
    noise_variance
        E|n|² of a complex sample.
    """

    waveform: TransmitWaveform
    paths: Paths
    response: Complex
    phase_rad: Floats
    start_s: Floats
    cfo_hz: float = 0.0
    sfo_hz: float = 0.0
    noise_variance: float = 0.0


def transfer_functions(channel: Channel, generator: Generator | None) -> Complex:
    """Return (pulse, subcarrier) transfer functions as an ideal demodulator would measure them, without samples.

    Equal to the DFT of `samples` divided by the code while clocks run true, nothing moves within the pulse and
    all echoes stay inside the prefix; many times faster. Without generator, without noise.
    """
    waveform, paths = channel.waveform, channel.paths
    early = paths.delay_s - channel.start_s[:, None]
    transfer = spectrum(early, paths.amplitude, waveform.frequency_hz) * channel.response
    transfer *= np.exp(1j * channel.phase_rad[:, None])
    if generator is not None and channel.noise_variance:
        transfer += noise(generator, transfer.shape, channel.noise_variance / waveform.dft_samples)
    return np.asarray(transfer)


def samples(
    channel: Channel,
    generator: Generator | None,
    pulses: slice | NDArray[np.intp] = slice(None),
    *,
    count: int | None = None,
) -> Complex:
    """Return (pulse, sample) complex128 of the captures, before the ADC.

    Parameters
    ----------
    generator
        Draws the noise, pulse after pulse; None: without noise.
    pulses, count
        Which captures, and samples of each; prefix and symbol if None.

    Notes
    -----
    Source: docs/theory/simulate.md, eqs. 3 to 5.

    Examples
    --------
    >>> wave = TransmitWaveform(np.ones(4), 1e9, "band_start", 1e6, 1e-6, 0.5e-6, 8e6, 1.0)
    >>> path = Paths(np.array([[0.25e-6]]), np.array([[1.0 + 0j]]), np.zeros((1, 1)))
    >>> abs(samples(Channel(wave, path, np.ones(4), np.zeros(1), np.zeros(1)), None)).round(2)
    array([[0.  , 0.  , 0.  , 1.08, 0.  , 2.61, 4.  , 2.61, 0.  , 1.08, 0.  , 1.08]])
    """
    count = channel.waveform.capture_samples if count is None else count
    numbers = np.arange(len(channel.phase_rad))[pulses]
    clean = np.stack([_capture(channel, pulse, count) for pulse in numbers])
    if channel.cfo_hz:
        clean *= np.exp(-2j * np.pi * channel.cfo_hz / sampling_rate(channel) * np.arange(count))
    clean *= np.exp(1j * channel.phase_rad[pulses, None])
    if generator is not None and channel.noise_variance:
        clean += noise(generator, clean.shape, channel.noise_variance)
    return np.asarray(clean)


def _capture(channel: Channel, pulse: int, count: int) -> Complex:
    """One capture without noise: stretches of constant set of paths, each from its own spectrum."""
    waveform, rate = channel.waveform, sampling_rate(channel)
    order = np.argsort(channel.paths.delay_s[pulse])
    arrival = (channel.paths.delay_s[pulse, order] - channel.start_s[pulse]) * rate
    first, end = waveform.presence(arrival, rate)
    differs = np.diff(first) + np.diff(end) > 0
    spectra = _cumulative_spectra(channel, pulse, order, np.flatnonzero(differs) + 1)
    groups = np.concatenate([[0], np.cumsum(np.append(order.size > 0, differs))])  # complete among the first paths
    capture = np.zeros(count, np.complex128)
    edges = np.unique(np.clip(np.concatenate([first, end]), 0, count))
    for start, stop in pairwise(edges):
        begun, over = np.searchsorted(first, start, "right"), np.searchsorted(end, start, "right")
        if begun > over:
            present = spectra[:, groups[begun]] - spectra[:, groups[over]]
            capture[start:stop] = _stretch(channel, pulse, present, start, stop, count)
    return capture


def _cumulative_spectra(channel: Channel, pulse: int, order: NDArray[np.intp], splits: NDArray[np.intp]) -> Complex:
    """(term, group + 1, subcarrier): spectra of the paths up to each group of equal edges, per Taylor term in t."""
    waveform, paths = channel.waveform, channel.paths
    delay, rate = paths.delay_s[pulse, order], paths.delay_rate[pulse, order]
    middle_s = waveform.duration_s / 2
    terms = _DOPPLER_ORDER + 1 if rate.any() else 1
    # delays at the middle of the pulse, seen from the receiver's start; the carrier turns with the whole delay
    seen = delay + rate * middle_s - channel.start_s[pulse]
    level = paths.amplitude[pulse, order]
    factor = waveform.codes * channel.response * np.exp(-2j * np.pi * waveform.baseband_hz * waveform.cyclic_prefix_s)
    out = np.zeros((terms, len(splits) + 2, len(factor)), np.complex128)
    for term in range(terms):
        for group, part in enumerate(np.split(np.arange(len(order)), splits)):
            out[term, group + 1] = spectrum(seen[part], level[part], waveform.frequency_hz)
        out[term] = np.cumsum(out[term], axis=0) * factor
        factor = factor * (-2j * np.pi * waveform.frequency_hz / (term + 1))
        level = level * rate
    return out


def _stretch(channel: Channel, pulse: int, spectra: Complex, start: int, stop: int, count: int) -> Complex:
    """Σ_q t^q Σ_n S_qn exp(j2πnΔf·m/f_s') for start ≤ m < stop, t counted from the middle of the pulse."""
    waveform = channel.waveform
    turns = waveform.subcarrier_spacing_hz / sampling_rate(channel)
    index = np.arange(start, stop)
    time_s = index / sampling_rate(channel) + channel.start_s[pulse] - waveform.duration_s / 2
    numbers = waveform.first_subcarrier + np.arange(spectra.shape[1])
    total = np.zeros(stop - start, np.complex128)
    for term, one in enumerate(spectra):
        if stop - start <= _SHORT:
            table = _rotations(turns, waveform.first_subcarrier, len(one))[: stop - start]
            part = table @ (one * np.exp(2j * np.pi * turns * numbers * start))
        elif channel.sfo_hz:
            part = _zoom(len(one), count, turns)(one)[start:stop]
            part = part * np.exp(2j * np.pi * turns * waveform.first_subcarrier * index)
        else:
            bins = np.zeros(waveform.dft_samples, np.complex128)
            bins[numbers] = one
            part = np.fft.ifft(bins, norm="forward")[index % waveform.dft_samples]
        total += time_s**term * part
    return total


@lru_cache(maxsize=4)
def _rotations(turns: float, first: int, count: int) -> Complex:
    return np.asarray(np.exp(2j * np.pi * turns * np.outer(np.arange(_SHORT), first + np.arange(count))))


@lru_cache(maxsize=8)
def _zoom(size: int, count: int, turns: float) -> Callable[[Complex], Complex]:
    from scipy.signal import CZT  # slow to import, and only a sampling clock that is off needs it

    transform: Callable[[Complex], Complex] = CZT(size, count, w=np.exp(2j * np.pi * turns))
    return transform


def sampling_rate(channel: Channel) -> float:
    """Return the rate at which the receiver truly samples, Hz."""
    return channel.waveform.sample_rate_hz + channel.sfo_hz


def noise(generator: Generator, shape: tuple[int, ...], variance: float) -> Complex:
    """Return circular Gaussian samples of E|n|² = variance, complex128."""
    parts = generator.standard_normal((*shape, 2)) * np.sqrt(variance / 2)
    return np.asarray(parts.view(np.complex128)[..., 0])
