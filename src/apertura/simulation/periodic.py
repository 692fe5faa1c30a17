"""Captures of long flights, synthesised fast: every echo as if it had begun before the capture and did not end."""

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import fft

from apertura.core.echo.compression import phasors, rotated
from apertura.simulation.synthesis import Channel, sampling_rate


def periodic_samples(channel: Channel, generator: Generator | None, pulses: NDArray[np.intp]) -> NDArray[np.complex64]:
    """Return (pulse, sample) complex64 of some captures, before the ADC: the symbol is periodic, so one spectrum does.

    Parameters
    ----------
    channel
        Of a receiver whose clock samples true; nothing moves within a pulse.
    generator
        Draws the noise, pulse after pulse; None: without noise.
    pulses
        Which captures.

    Raises
    ------
    ValueError
        If the channel has a sampling clock that is off, or Doppler within the pulse.

    Notes
    -----
    Source: docs/theory/simulate.md, "Long flights". From the end of the prefix on equal to
    `apertura.simulation.synthesis.samples`, to the rounding of complex64, as long as echoes arrive inside the prefix;
    those that the window of the DFT would not hold whole are left out.

    Examples
    --------
    >>> from apertura.simulation.radar import Paths, TransmitWaveform
    >>> wave = TransmitWaveform(np.ones(4), 1e9, "band_start", 1e6, 1e-6, 0.5e-6, 8e6, 1.0)
    >>> path = Paths(np.array([[0.25e-6]]), np.array([[1.0 + 0j]]), np.zeros((1, 1)))
    >>> abs(periodic_samples(Channel(wave, path, np.ones(4), np.zeros(1), np.zeros(1)), None, np.arange(1))).round(2)
    array([[0.  , 1.08, 0.  , 1.08, 0.  , 2.61, 4.  , 2.61, 0.  , 1.08, 0.  , 1.08]], dtype=float32)
    """
    waveform = channel.waveform
    if channel.sfo_hz or channel.paths.delay_rate[pulses].any():
        raise ValueError("a sampling clock that is off, or Doppler within the pulse, needs exact synthesis")
    spectrum = _spectrum(channel, pulses) * (
        waveform.codes * channel.response * np.exp(-2j * np.pi * waveform.baseband_hz * waveform.cyclic_prefix_s)
    ).astype(np.complex64)
    bins = np.zeros((len(pulses), waveform.dft_samples), np.complex64)
    bins[:, waveform.first_subcarrier + np.arange(len(waveform.codes))] = spectrum
    period = fft.ifft(bins, axis=1, norm="forward")
    period *= rotated(np.ones(1), channel.phase_rad[pulses, None] / (2 * np.pi))
    captures = np.take(period, np.arange(waveform.capture_samples) % waveform.dft_samples, axis=1)
    if channel.cfo_hz:
        turns = -channel.cfo_hz / sampling_rate(channel) * np.arange(waveform.capture_samples)
        captures = captures * rotated(np.ones(1), np.asarray(turns, np.float64))
    if generator is not None and channel.noise_variance:
        parts = captures.view(np.float32)
        parts += generator.standard_normal(parts.shape, np.float32) * np.float32(np.sqrt(channel.noise_variance / 2))
    return np.asarray(captures, np.complex64)


def _spectrum(channel: Channel, pulses: NDArray[np.intp]) -> NDArray[np.complex64]:
    """Return Σ a·exp(-j2πf_nτ) over the paths that arrive inside the prefix, (pulse, subcarrier) complex64."""
    waveform = channel.waveform
    seen_s = channel.paths.delay_s[pulses] - channel.start_s[pulses, None]
    early_s = waveform.symbol_s - 1 / waveform.subcarrier_spacing_hz
    heard = (seen_s >= -early_s) & (seen_s < waveform.cyclic_prefix_s)
    amplitude = channel.paths.amplitude[pulses] * heard
    total = np.zeros((len(pulses), len(waveform.codes)), np.complex64)
    first = waveform.frequency_hz[0]
    for path in np.flatnonzero(heard.any(axis=0)):
        level = rotated(amplitude[:, path], -first * seen_s[:, path])
        total += level[:, None] * phasors(-waveform.subcarrier_spacing_hz * seen_s[:, path], total.shape[1])
    return total
