"""What a node records of a flight, as arrays: scene and geometry, passed through what is wrong with the node."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.simulation.draw import ImpairmentDraw
from apertura.simulation.impairments import Adc, ChannelName, Floats, Impairments, Ripple
from apertura.simulation.radar import Paths, TransmitWaveform, direct_path, echo_paths
from apertura.simulation.scene import Scatterers
from apertura.simulation.synthesis import Channel, Complex
from apertura.simulation.transfer import spectrum

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
    """

    radar_tx: Floats
    radar_rx: Floats
    sidelink_tx: Floats
    sidelink_rx: Floats
    tx_velocity: Floats | float = 0.0
    rx_velocity: Floats | float = 0.0
    gain: Floats | float = 1.0


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
        tx_velocity_m_s=velocity[0],
        rx_velocity_m_s=velocity[1],
    )
    echoes = replace(echoes, amplitude=echoes.amplitude * geometry.gain)
    direct = direct_path(
        geometry.sidelink_tx,
        geometry.sidelink_rx,
        path_offset_m=path_offset_m.get("sidelink", 0.0),
        relative_velocity_m_s=np.subtract(*velocity),
    )
    power = spectral_power(waveform, echoes)
    leaked = _with_leakage(echoes, geometry, impairments, path_offset_m.get("radar", 0.0), power)
    heard = {"radar": (leaked, power, impairments.radar_ripple, impairments.radar_snr_db)}
    if sidelink:
        power = spectral_power(waveform, direct)
        paths = _sidelink(direct, impairments, draw)
        heard["sidelink"] = (paths, power, impairments.sidelink_ripple, impairments.sidelink_snr_db)
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
        for name, (paths, power, ripple, snr_db) in heard.items()
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

    The RMS of I and of Q over all pulses, with noise and all that leaks in, lies `adc.backoff_db` under it.
    """
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
    direct = direct_path(geometry.radar_tx, geometry.radar_rx, path_offset_m=offset_m + leakage.path_m)
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
