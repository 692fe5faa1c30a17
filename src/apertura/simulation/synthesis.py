"""From geometry to counts: paths through what is wrong with a node, to samples on its own clock, digitised.

A delay acts on each subcarrier, so all echoes are summed as one spectrum and brought to the receiver's own
time grid by an inverse DFT, or by a chirp-z transform where its sampling rate is off. Edges are true: an
echo is absent before it arrives and after it has ended. Captures of long flights are synthesised faster, as if echoes
neither began nor ended.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from types import MappingProxyType

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import fft

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.compression import unit_phasor
from apertura.simulation.impairments import Adc, ChannelName, ImpairmentDraw, Impairments, Ripple
from apertura.simulation.scatterers import Paths, TrueAir, direct_path, echo_paths, spectrum
from apertura.simulation.targets import Scatterers
from apertura.simulation.waveform import TransmitWaveform

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
    full_scale
        Amplitude of I + jQ that the converter takes as full scale, where a radio is stated; None: by its backoff.
    """

    waveform: TransmitWaveform
    paths: Paths
    response: Complex
    phase_rad: Floats
    start_s: Floats
    cfo_hz: float = 0.0
    sfo_hz: float = 0.0
    noise_variance: float = 0.0
    full_scale: float | None = None


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
        # Paths that have arrived less those that have ended, both in the order of their delays.
        arrived, ended = np.searchsorted(first, start, "right"), np.searchsorted(end, start, "right")
        if arrived > ended:
            present = spectra[:, groups[arrived]] - spectra[:, groups[ended]]
            capture[start:stop] = _stretch(channel, pulse, present, start, stop, count)
    return capture


def _cumulative_spectra(channel: Channel, pulse: int, order: NDArray[np.intp], splits: NDArray[np.intp]) -> Complex:
    """(term, group + 1, subcarrier): spectra of the paths up to each group of equal edges, per Taylor term in t."""
    waveform, paths = channel.waveform, channel.paths
    delay, rate = paths.delay_s[pulse, order], paths.delay_rate[pulse, order]
    middle_s = waveform.duration_s / 2
    terms = _DOPPLER_ORDER + 1 if rate.any() else 1
    # delays at the middle of the pulse from the receiver's start; the carrier turns with the whole delay
    late = delay + rate * middle_s - channel.start_s[pulse]
    level = paths.amplitude[pulse, order]
    factor = waveform.codes * channel.response * np.exp(-2j * np.pi * waveform.baseband_hz * waveform.cyclic_prefix_s)
    out = np.zeros((terms, len(splits) + 2, len(factor)), np.complex128)
    for term in range(terms):
        for group, part in enumerate(np.split(np.arange(len(order)), splits)):
            out[term, group + 1] = spectrum(late[part], level[part], waveform.frequency_hz)
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
    if stop - start <= _SHORT:
        table = _rotations(turns, waveform.first_subcarrier, len(numbers))[: stop - start]
        parts = (spectra * np.exp(2j * np.pi * turns * start * numbers)) @ table.T
    elif channel.sfo_hz:
        parts = _zoom(len(numbers), count, turns)(spectra)[:, start:stop]
        parts = parts * np.exp(2j * np.pi * turns * waveform.first_subcarrier * index)
    else:
        bins = np.zeros((len(spectra), waveform.dft_samples), np.complex128)
        bins[:, numbers] = spectra
        parts = fft.ifft(bins, norm="forward")[:, index % waveform.dft_samples]
    total = parts[-1]  # Horner's rule in t
    for part in parts[-2::-1]:
        total = total * time_s + part
    return np.asarray(total)


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
    >>> from apertura.simulation.scatterers import Paths
    >>> from apertura.simulation.waveform import TransmitWaveform
    >>> wave = TransmitWaveform(np.ones(4), 1e9, "band_start", 1e6, 1e-6, 0.5e-6, 8e6, 1.0)
    >>> path = Paths(np.array([[0.25e-6]]), np.array([[1.0 + 0j]]), np.zeros((1, 1)))
    >>> abs(periodic_samples(Channel(wave, path, np.ones(4), np.zeros(1), np.zeros(1)), None, np.arange(1))).round(2)
    array([[0.  , 1.08, 0.  , 1.08, 0.  , 2.61, 4.  , 2.61, 0.  , 1.08, 0.  , 1.08]], dtype=float32)
    """
    waveform = channel.waveform
    if channel.sfo_hz or channel.paths.delay_rate[pulses].any():
        raise ValueError("a sampling clock that is off, or Doppler within the pulse, needs exact synthesis")
    echoes = _prefixed_echoes(channel, pulses) * (
        waveform.codes * channel.response * np.exp(-2j * np.pi * waveform.baseband_hz * waveform.cyclic_prefix_s)
    ).astype(np.complex64)
    bins = np.zeros((len(pulses), waveform.dft_samples), np.complex64)
    bins[:, waveform.first_subcarrier + np.arange(len(waveform.codes))] = echoes
    period = fft.ifft(bins, axis=1, norm="forward")
    period *= unit_phasor(channel.phase_rad[pulses, None] / (2 * np.pi))
    captures = np.take(period, np.arange(waveform.capture_samples) % waveform.dft_samples, axis=1)
    if channel.cfo_hz:
        turns = -channel.cfo_hz / sampling_rate(channel) * np.arange(waveform.capture_samples)
        captures = captures * unit_phasor(np.asarray(turns, np.float64))
    if generator is not None and channel.noise_variance:
        parts = captures.view(np.float32)
        parts += generator.standard_normal(parts.shape, np.float32) * np.float32(np.sqrt(channel.noise_variance / 2))
    return np.asarray(captures, np.complex64)


def _prefixed_echoes(channel: Channel, pulses: NDArray[np.intp]) -> NDArray[np.complex64]:
    """Return the spectrum of the paths that arrive inside the prefix, (pulse, subcarrier) complex64."""
    waveform = channel.waveform
    delay_s = channel.paths.delay_s[pulses] - channel.start_s[pulses, None]
    early_s = waveform.symbol_s - 1 / waveform.subcarrier_spacing_hz
    inside = (delay_s >= -early_s) & (delay_s < waveform.cyclic_prefix_s)
    return spectrum(delay_s, channel.paths.amplitude[pulses] * inside, waveform.frequency_hz).astype(np.complex64)


_PULSES_AT_ONCE = 64
_MOST_PULSES = 8192


@dataclass(frozen=True)
class Geometry:
    """True phase centres at the start of each pulse.

    Attributes
    ----------
    radar_tx, radar_rx, sidelink_tx, sidelink_rx
        (pulse, 3) float64, metres, Cartesian, in the frame of the scatterers; `sidelink`: ends of the direct path.
    tx_velocity, rx_velocity
        (pulse, 3) float64, m/s, of transmitter and receiver, for Doppler within the pulse.
    gain
        (pulse, point) float64, field of both radar antennas towards each scatterer, relative to their boresights.
    air
        What all paths fly through; None: vacuum.
    """

    radar_tx: Floats
    radar_rx: Floats
    sidelink_tx: Floats
    sidelink_rx: Floats
    tx_velocity: Floats | float = 0.0
    rx_velocity: Floats | float = 0.0
    gain: Floats | float = 1.0
    air: TrueAir | None = None


def straight_pair(along_m: Floats, height_m: float, *, rx_ahead_m: float = 0.0) -> Geometry:
    """Return two nodes with their antennas at one place each, above the first axis at (pulse,) places along it."""
    sender = np.column_stack([along_m, np.zeros(len(along_m)), np.full(len(along_m), height_m)])
    receiver = sender + np.array([rx_ahead_m, 0.0, 0.0])
    return Geometry(sender, receiver, sender, receiver)


def receive(
    waveform: TransmitWaveform,
    scatterers: Scatterers,
    geometry: Geometry,
    *,
    impairments: Impairments,
    draw: ImpairmentDraw,
    transmitter: Impairments,
    path_offset_m: Mapping[ChannelName, float] = MappingProxyType({}),
    sidelink: bool = True,
) -> dict[str, Channel]:
    """Return the channels `radar` and, of a node without the transmitter's clock, `sidelink`.

    Parameters
    ----------
    scatterers, geometry
        The scene, and where the antennas truly are.
    impairments, draw, transmitter
        What is wrong with the receiving node, what was drawn of it, and what is wrong with the transmitting one.
    path_offset_m
        Electrical path beyond geometry per channel, metres; zero where missing.
    sidelink
        Whether the second channel is recorded.
    """
    velocity = (geometry.tx_velocity, geometry.rx_velocity) if impairments.doppler else (0.0, 0.0)
    echoes = echo_paths(
        geometry.radar_tx,
        geometry.radar_rx,
        scatterers,
        path_offset_m=path_offset_m.get("radar", 0.0),
        air=geometry.air,
        tx_velocity_m_s=velocity[0],
        rx_velocity_m_s=velocity[1],
    )
    echoes = replace(echoes, amplitude=echoes.amplitude * geometry.gain)
    direct = direct_path(
        geometry.sidelink_tx,
        geometry.sidelink_rx,
        path_offset_m=path_offset_m.get("sidelink", 0.0),
        air=geometry.air,
        relative_velocity_m_s=np.subtract(*velocity),
    )
    power = spectral_power(waveform, echoes)
    leaked = _with_leakage(echoes, geometry, impairments, path_offset_m.get("radar", 0.0), power)
    received = {"radar": (leaked, power, impairments.radar_ripple, impairments.radar_snr_db)}
    if sidelink:
        power = spectral_power(waveform, direct)
        paths = _sidelink(direct, impairments, draw)
        received["sidelink"] = (paths, power, impairments.sidelink_ripple, impairments.sidelink_snr_db)
    return {
        name: Channel(
            waveform,
            paths,
            _response(waveform, transmitter.transmit_ripple) * _response(waveform, ripple),
            draw.phase_rad,
            draw.start_s,
            cfo_hz=impairments.clock.cfo_hz,
            sfo_hz=impairments.clock.sfo_hz,
            noise_variance=0.0 if snr_db is None else waveform.noise_at_unit_snr * power / 10 ** (snr_db / 10),
        )
        for name, (paths, power, ripple, snr_db) in received.items()
    }


def _response(waveform: TransmitWaveform, ripple: Ripple | None) -> Complex:
    return ripple.response(waveform.frequency_hz) if ripple else np.ones(len(waveform.codes), np.complex128)


def spectral_power(waveform: TransmitWaveform, paths: Paths, response: Complex | float = 1.0) -> float:
    """Return the mean of |Σ a·exp(-j2πfτ)|² over subcarriers and pulses; of a long flight over some, evenly spread."""
    every = -(-len(paths.delay_s) // _MOST_PULSES)
    paths = paths.at(slice(None, None, every))
    starts = range(0, len(paths.delay_s), _PULSES_AT_ONCE)
    parts = (paths.at(slice(start, start + _PULSES_AT_ONCE)) for start in starts)
    spectra = (spectrum(part.delay_s, part.amplitude, waveform.frequency_hz) for part in parts)
    total = sum(float((np.abs(one * response) ** 2).sum()) for one in spectra)
    return total / (len(paths.delay_s) * len(waveform.codes))


def full_scale(channel: Channel, adc: Adc) -> float:
    """Return the amplitude of I or Q that the converter takes as full scale, set once per flight.

    The RMS of I and of Q over all pulses, with noise and all that leaks in, lies `adc.backoff_db` under it, unless
    the channel has a full scale of its own.
    """
    if channel.full_scale is not None:
        return channel.full_scale
    power = spectral_power(channel.waveform, channel.paths, channel.response) * channel.waveform.mean_power
    rms = np.sqrt((power + channel.noise_variance) / 2)
    return float(rms * 10 ** (adc.backoff_db / 20))


def digitize(samples: NDArray[np.complexfloating], adc: Adc, full_scale_amplitude: float) -> NDArray[np.int16]:
    """Return (..., 2) int16 counts of I and Q, rounded and clipped to ±2^(bits-1).

    Examples
    --------
    >>> digitize(np.array([0.5 - 2.0j]), Adc(bits=4), 1.0)
    array([[ 4, -8]], dtype=int16)
    """
    limit = 2 ** (adc.bits - 1)
    parts = np.ascontiguousarray(samples)[..., None].view(samples.real.dtype)
    counts = parts * parts.dtype.type(limit / full_scale_amplitude)
    np.clip(np.rint(counts, out=counts), -limit, limit - 1, out=counts)
    return np.asarray(counts, np.int16)


def _with_leakage(echoes: Paths, geometry: Geometry, impairments: Impairments, offset_m: float, power: float) -> Paths:
    leakage = impairments.leakage
    if leakage is None:
        return echoes
    direct = direct_path(
        geometry.radar_tx, geometry.radar_rx, path_offset_m=offset_m + leakage.path_m, air=geometry.air
    )
    level = np.full(direct.amplitude.shape, np.sqrt(power) * 10 ** (leakage.level_db / 20), np.complex128)
    return echoes.and_also(Paths(direct.delay_s, level, direct.delay_rate))


def _sidelink(direct: Paths, impairments: Impairments, draw: ImpairmentDraw) -> Paths:
    paths = direct
    for reflection in impairments.sidelink_multipath:
        later_s = direct.delay_s + reflection.excess_m / SPEED_OF_LIGHT_M_S
        paths = paths.and_also(Paths(later_s, direct.amplitude * reflection.amplitude, direct.delay_rate))
    shadow_db = impairments.sidelink_blockage.attenuation_db if impairments.sidelink_blockage else 0.0
    gain = 10 ** ((impairments.sidelink_gain_db - shadow_db * draw.blocked) / 20)
    return replace(paths, amplitude=paths.amplitude * gain[:, None])
