"""Synthesis of recordings: paths, impairments of a node, samples on its own clock, and digitisation.

A delay is a phase of each subcarrier, so that all echoes are summed in one spectrum. The spectrum is transformed to the
receiver's time grid by an inverse DFT, or by a chirp-z transform if the sampling rate has an offset. The edges of
echoes are exact: an echo is absent before its arrival and after its end. Captures of long flights are synthesised
faster, with periodic echoes that have no edges.
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
from apertura.core.echo.compression import centre_frequency, unit_phasor
from apertura.simulation.impairments import Adc, ChannelName, ImpairmentDraw, Impairments, Interferer, Ripple
from apertura.simulation.scatterers import Paths, TrueAir, direct_path, echo_paths, spectrum
from apertura.simulation.targets import Scatterers
from apertura.simulation.waveform import TransmitWaveform

Complex = NDArray[np.complex128]

_SHORT = 64  # longest interval that is summed directly, samples; longer intervals are computed by a transform
_DOPPLER_ORDER = 3  # order of the Taylor series of exp(-j2πf·rate·t); the next term is below -150 dB (100 m/s, 1.6 GHz)


@dataclass(frozen=True)
class Channel:
    """Receiving channel over a flight with all drawn random values, which determines the samples.

    Attributes
    ----------
    response
        (subcarrier,) complex128, ripple of transmitter and receiver.
    phase_rad
        (pulse,) float64, carrier phase relative to the transmitter.
    start_s
        (pulse,) float64, start of the capture minus start of the pulse, seconds.
    cfo_hz, sfo_hz
        The receiver's local oscillator and sampling rate minus their nominal frequencies, Hz.
    noise_variance
        E|n|² of a complex sample.
    full_scale
        Full-scale amplitude of I + jQ if a radio is specified; None: derived from the backoff of the converter.
    interference
        Interferers with the mean power of their samples during transmission.
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
    interference: tuple[tuple[Interferer, float], ...] = ()


def transfer_functions(channel: Channel, generator: Generator | None) -> Complex:
    """Return the transfer functions that an ideal demodulator measures, (pulse, subcarrier), without sampling.

    They equal the DFT of `samples` divided by the code if there are no clock offsets, no motion within the pulse and no
    echoes beyond the prefix, and are computed many times faster. There is no noise if `generator` is None.
    """
    waveform, paths = channel.waveform, channel.paths
    delay_s = paths.delay_s - channel.start_s[:, None]
    transfer = spectrum(delay_s, paths.amplitude, waveform.frequency_hz) * channel.response
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
    """Synthesise the samples of captures before the ADC, (pulse, sample) complex128.

    Parameters
    ----------
    generator
        Generator of the noise, pulse by pulse; None: no noise.
    pulses, count
        Selected captures, and number of samples of each; None: prefix and symbol.

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
    if generator is not None:
        clean += _interference(channel, clean.shape, generator)
    return np.asarray(clean)


def _capture(channel: Channel, pulse: int, count: int) -> Complex:
    """Synthesise a capture without noise from intervals with a constant set of paths, each with its own spectrum."""
    waveform, rate = channel.waveform, sampling_rate(channel)
    order = np.argsort(channel.paths.delay_s[pulse])
    arrival = (channel.paths.delay_s[pulse, order] - channel.start_s[pulse]) * rate
    first, end = waveform.presence(arrival, rate)
    differs = np.diff(first) + np.diff(end) > 0
    spectra = _cumulative_spectra(channel, pulse, order, np.flatnonzero(differs) + 1)
    # number of complete groups among the first paths
    groups = np.concatenate([[0], np.cumsum(np.append(order.size > 0, differs))])
    capture = np.zeros(count, np.complex128)
    edges = np.unique(np.clip(np.concatenate([first, end]), 0, count))
    for start, stop in pairwise(edges):
        # Present paths: paths that have arrived minus paths that have ended, both in the order of delays.
        arrived, ended = np.searchsorted(first, start, "right"), np.searchsorted(end, start, "right")
        if arrived > ended:
            present = spectra[:, groups[arrived]] - spectra[:, groups[ended]]
            capture[start:stop] = _interval(channel, pulse, present, start, stop, count)
    return capture


def _cumulative_spectra(channel: Channel, pulse: int, order: NDArray[np.intp], splits: NDArray[np.intp]) -> Complex:
    """Return cumulative spectra over groups of paths of equal edges, per Taylor term, (term, group + 1, subcarrier)."""
    waveform, paths = channel.waveform, channel.paths
    delay, rate = paths.delay_s[pulse, order], paths.delay_rate[pulse, order]
    middle_s = waveform.duration_s / 2
    terms = _DOPPLER_ORDER + 1 if rate.any() else 1
    # delays at the midpoint of the pulse relative to the start of the capture; these also determine the carrier phase
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


def _interval(channel: Channel, pulse: int, spectra: Complex, start: int, stop: int, count: int) -> Complex:
    """Evaluate Σ_q t^q Σ_n S_qn exp(j2πnΔf·m/f_s') for start ≤ m < stop; t is relative to the midpoint of the pulse."""
    waveform = channel.waveform
    cycles = waveform.subcarrier_spacing_hz / sampling_rate(channel)  # per sample and subcarrier
    index = np.arange(start, stop)
    time_s = index / sampling_rate(channel) + channel.start_s[pulse] - waveform.duration_s / 2
    numbers = waveform.first_subcarrier + np.arange(spectra.shape[1])
    if stop - start <= _SHORT:
        table = _rotations(cycles, waveform.first_subcarrier, len(numbers))[: stop - start]
        terms = (spectra * np.exp(2j * np.pi * cycles * start * numbers)) @ table.T
    elif channel.sfo_hz:
        terms = _chirp_z(len(numbers), count, cycles)(spectra)[:, start:stop]
        terms = terms * np.exp(2j * np.pi * cycles * waveform.first_subcarrier * index)
    else:
        bins = np.zeros((len(spectra), waveform.dft_samples), np.complex128)
        bins[:, numbers] = spectra
        terms = fft.ifft(bins, norm="forward")[:, index % waveform.dft_samples]
    total = terms[-1]  # Horner's rule in t
    for term in terms[-2::-1]:
        total = total * time_s + term
    return np.asarray(total)


@lru_cache(maxsize=4)
def _rotations(cycles: float, first: int, count: int) -> Complex:
    return np.asarray(np.exp(2j * np.pi * cycles * np.outer(np.arange(_SHORT), first + np.arange(count))))


@lru_cache(maxsize=8)
def _chirp_z(size: int, count: int, cycles: float) -> Callable[[Complex], Complex]:
    from scipy.signal import CZT  # slow to import, and only required for a sampling frequency offset

    transform: Callable[[Complex], Complex] = CZT(size, count, w=np.exp(2j * np.pi * cycles))
    return transform


def sampling_rate(channel: Channel) -> float:
    """Return the true sampling rate of the receiver, Hz."""
    return channel.waveform.sample_rate_hz + channel.sfo_hz


def noise(generator: Generator, shape: tuple[int, ...], variance: float) -> Complex:
    """Draw circular Gaussian samples with E|n|² = variance, complex128."""
    parts = generator.standard_normal((*shape, 2)) * np.sqrt(variance / 2)
    return np.asarray(parts.view(np.complex128)[..., 0])


def periodic_samples(channel: Channel, generator: Generator | None, pulses: NDArray[np.intp]) -> NDArray[np.complex64]:
    """Synthesise captures before the ADC with one spectrum of periodic echoes per pulse, (pulse, sample) complex64.

    Parameters
    ----------
    channel
        Channel without sampling frequency offset and without motion within a pulse.
    generator
        Generator of the noise, pulse by pulse; None: no noise.
    pulses
        Selected captures.

    Raises
    ------
    ValueError
        If the channel has a sampling frequency offset, or Doppler within the pulse.

    Notes
    -----
    Source: docs/theory/simulate.md, "Long flights". After the prefix, the samples of echoes within the prefix
    are those of `apertura.simulation.synthesis.samples` up to the rounding of complex64; echoes that are not complete
    within the window of the DFT are omitted.

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
        raise ValueError("a sampling frequency offset, or Doppler within the pulse, requires exact synthesis")
    echoes = _prefixed_echoes(channel, pulses) * (
        waveform.codes * channel.response * np.exp(-2j * np.pi * waveform.baseband_hz * waveform.cyclic_prefix_s)
    ).astype(np.complex64)
    bins = np.zeros((len(pulses), waveform.dft_samples), np.complex64)
    bins[:, waveform.first_subcarrier + np.arange(len(waveform.codes))] = echoes
    period = fft.ifft(bins, axis=1, norm="forward")
    period *= unit_phasor(channel.phase_rad[pulses, None] / (2 * np.pi))
    captures = np.take(period, np.arange(waveform.capture_samples) % waveform.dft_samples, axis=1)
    if channel.cfo_hz:
        cycles = -channel.cfo_hz / sampling_rate(channel) * np.arange(waveform.capture_samples)
        captures = captures * unit_phasor(np.asarray(cycles, np.float64))
    if generator is not None and channel.noise_variance:
        parts = captures.view(np.float32)
        parts += generator.standard_normal(parts.shape, np.float32) * np.float32(np.sqrt(channel.noise_variance / 2))
    if generator is not None:
        captures = captures + _interference(channel, captures.shape, generator)
    return np.asarray(captures, np.complex64)


def _interference(channel: Channel, shape: tuple[int, int], generator: Generator) -> Complex | float:
    """Draw the interference in captures, (pulse, sample); docs/theory/simulate.md, eq. 8."""
    if not channel.interference:
        return 0.0
    (generator,) = generator.spawn(1)  # the noise is the same with and without interference
    rate = sampling_rate(channel)
    time_s, total = np.arange(shape[1]) / rate, np.zeros(shape, np.complex128)
    for source, power in channel.interference:
        duration_s = source.duration_s or np.inf
        # Pulses that overlap a capture start at any time from one duration before the capture to its end.
        expected = 1.0 if source.duration_s is None else source.rate_hz * (shape[1] / rate + duration_s)
        counts = np.ones(shape[0], int) if source.duration_s is None else generator.poisson(expected, shape[0])
        for capture in np.repeat(np.arange(shape[0]), counts):
            start_s = 0.0 if source.duration_s is None else generator.uniform(-duration_s, time_s[-1])
            since_s = time_s - start_s
            cycles = (
                source.frequency_hz - channel.waveform.carrier_hz
            ) * time_s + source.sweep_hz_per_s / 2 * since_s**2
            signal = np.exp(2j * np.pi * (cycles + generator.random()))
            if source.bandwidth_hz:
                signal *= _band_limited(generator, shape[1], source.bandwidth_hz / rate)
            if source.envelope == "hann" and source.duration_s:
                signal *= np.sin(np.pi * since_s / duration_s) ** 2
            total[capture] += np.sqrt(power) * signal * ((since_s >= 0) & (since_s < duration_s))
    return total


def _band_limited(generator: Generator, count: int, share: float) -> Complex:
    """Draw Gaussian noise of unit mean power in a share of the sampling rate around zero frequency, complex128."""
    bins = noise(generator, (count,), 1.0)
    inside = np.abs(fft.fftfreq(count)) <= max(share / 2, 0.5 / count)
    return np.asarray(fft.ifft(bins * inside, norm="ortho") * np.sqrt(count / inside.sum()))


def _prefixed_echoes(channel: Channel, pulses: NDArray[np.intp]) -> NDArray[np.complex64]:
    """Return the spectrum of the paths that arrive within the prefix, (pulse, subcarrier) complex64."""
    waveform = channel.waveform
    delay_s = channel.paths.delay_s[pulses] - channel.start_s[pulses, None]
    early_s = waveform.symbol_s - 1 / waveform.subcarrier_spacing_hz
    inside = (delay_s >= -early_s) & (delay_s < waveform.cyclic_prefix_s)
    amplitude = channel.paths.amplitude[pulses] * inside
    # pulse by pulse, because the exponentials of all pulses and thousands of paths do not fit the cache
    of_pulses = [spectrum(*one, waveform.frequency_hz) for one in zip(delay_s, amplitude, strict=True)]
    return np.array(of_pulses, np.complex64)


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
        (pulse, 3) float64, m/s, velocities of transmitter and receiver, for Doppler within the pulse.
    gain
        (pulse, point) float64, two-way field of the radar antennas towards each scatterer, relative to boresight.
    air
        Atmosphere along all paths; None: vacuum.
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
    """Return two nodes on a straight track above the first axis, at (pulse,) positions along it, one point per node."""
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
    """Return the received channels: `radar` and, for a node without the transmitter's clock, `sidelink`.

    Parameters
    ----------
    scatterers, geometry
        The scene, and the true antenna positions.
    impairments, draw, transmitter
        Impairments of the receiving node, their draw, and impairments of the transmitting node.
    path_offset_m
        Channel → electrical path in addition to the geometric path, metres; zero if missing.
    sidelink
        True if the second channel is recorded.
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
        paths = _sidelink(direct, impairments, draw, centre_frequency(waveform.frequency_hz))
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
            interference=tuple(
                (source, power * waveform.mean_power * 10 ** (source.level_db / 10))
                for source in impairments.interference
                if source.channel == name
            ),
        )
        for name, (paths, power, ripple, snr_db) in received.items()
    }


def _response(waveform: TransmitWaveform, ripple: Ripple | None) -> Complex:
    return ripple.response(waveform.frequency_hz) if ripple else np.ones(len(waveform.codes), np.complex128)


def spectral_power(waveform: TransmitWaveform, paths: Paths, response: Complex | float = 1.0) -> float:
    """Return the mean of |Σ a·exp(-j2πfτ)|² over subcarriers and pulses (of a long flight, evenly spaced pulses)."""
    every = -(-len(paths.delay_s) // _MOST_PULSES)
    paths = paths.at(slice(None, None, every))
    starts = range(0, len(paths.delay_s), _PULSES_AT_ONCE)
    blocks = (paths.at(slice(start, start + _PULSES_AT_ONCE)) for start in starts)
    spectra = (spectrum(block.delay_s, block.amplitude, waveform.frequency_hz) for block in blocks)
    total = sum(float((np.abs(echo * response) ** 2).sum()) for echo in spectra)
    return total / (len(paths.delay_s) * len(waveform.codes))


def full_scale(channel: Channel, adc: Adc) -> float:
    """Return the full-scale amplitude of I or Q of the converter, which is constant during a flight.

    It is `adc.backoff_db` above the RMS of I and of Q over all pulses, including noise and leakage, unless the channel
    specifies its full scale.
    """
    if channel.full_scale is not None:
        return channel.full_scale
    power = spectral_power(channel.waveform, channel.paths, channel.response) * channel.waveform.mean_power
    rms = np.sqrt((power + channel.noise_variance) / 2)
    return float(rms * 10 ** (adc.backoff_db / 20))


def digitize(samples: NDArray[np.complexfloating], adc: Adc, full_scale_amplitude: float) -> NDArray[np.int16]:
    """Digitise samples to counts of I and Q, (..., 2) int16, rounded and clipped to ±2^(bits-1).

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


def _sidelink(direct: Paths, impairments: Impairments, draw: ImpairmentDraw, middle_hz: float) -> Paths:
    paths = replace(direct, amplitude=direct.amplitude * draw.direct[:, None])
    for reflection in impairments.sidelink_multipath:
        later_s = direct.delay_s + reflection.excess_m / SPEED_OF_LIGHT_M_S
        paths = paths.and_also(Paths(later_s, direct.amplitude * reflection.amplitude, direct.delay_rate))
    for moving, echo in ((impairments.sidelink_spikes, draw.spike_echo), (impairments.sidelink_rotor, draw.rotor_echo)):
        if moving is not None and echo.any():
            excess_s = moving.excess_m / SPEED_OF_LIGHT_M_S
            level = echo * np.exp(2j * np.pi * middle_hz * excess_s)  # phases of the draw are those at mid-band
            paths = paths.and_also(
                Paths(direct.delay_s + excess_s, direct.amplitude * level[:, None], direct.delay_rate)
            )
    shadow_db = impairments.sidelink_blockage.attenuation_db if impairments.sidelink_blockage else 0.0
    gain = 10 ** ((impairments.sidelink_gain_db - shadow_db * draw.blocked) / 20)
    return replace(paths, amplitude=paths.amplitude * gain[:, None])
