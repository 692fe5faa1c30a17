"""Observations of nodes, as channels before sampling: of a drawn flight, or of a pair of nodes given as arrays."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator

from apertura.common.arrays import Floats
from apertura.common.constants import BOLTZMANN_J_K, REFERENCE_K, SPEED_OF_LIGHT_M_S
from apertura.core.echo.compression import centre_frequency
from apertura.simulation.impairments import (
    AntennaPoint,
    ImpairmentDraw,
    Impairments,
    RadarPoint,
    Radio,
    draw_impairments,
    independent_streams,
)
from apertura.simulation.specification import DrawnCampaign, SimulatedFlight
from apertura.simulation.synthesis import Channel, Geometry, receive
from apertura.simulation.targets import Scatterers, body_rotation, logged_velocity, phase_centre
from apertura.simulation.waveform import TransmitWaveform

_Node = tuple[Impairments, ImpairmentDraw]


@dataclass(frozen=True)
class Observation:
    """Channels of a node in a flight, with its drawn impairments and the true antenna positions.

    Attributes
    ----------
    channels
        `radar` and, for a node without the transmitter's clock, `sidelink`: input of `samples` or
        `transfer_functions`.
    noise
        Noise generator of each channel; only for nodes given as arrays.
    """

    channels: Mapping[str, Channel]
    draw: ImpairmentDraw
    truth: Geometry
    noise: Mapping[str, Generator] = field(default_factory=dict)


def fly(
    campaign: DrawnCampaign, flight: SimulatedFlight, scatterers: Scatterers, generator: Generator
) -> dict[str, Observation]:
    """Simulate the observation of scatterers in ECEF by each node of a flight; each node has its own random stream."""
    nodes, time_s = campaign.specification.nodes, campaign.pulse_times(flight)
    sender, draws = flight.transmitter, {}
    for name, stream in zip(flight.tracks, independent_streams(generator, len(flight.tracks)), strict=True):
        possible = _possible(nodes[name].impairments, flight)
        draws[name] = draw_impairments(possible, time_s, campaign.waveform.sample_rate_hz, stream)
    observations = {}
    for name in flight.tracks:
        own, transmitter = nodes[name].impairments, nodes[sender].impairments
        geometry = _true(_logged(campaign, flight, name), (transmitter, draws[sender]), (own, draws[name]))
        geometry = replace(geometry, gain=_gain(campaign, flight, name, geometry, scatterers))
        channels = receive(
            campaign.waveform,
            scatterers,
            geometry,
            impairments=own,
            draw=draws[name],
            transmitter=transmitter,
            path_offset_m=nodes[name].path_offset_m,
            sidelink=name != sender,
        )
        first_frame = flight.first_frame if flight.framing else 0
        channels = {key: replace(channel, first_frame=first_frame) for key, channel in channels.items()}
        radios = nodes[sender].radio, nodes[name].radio
        if radios[0] is not None and radios[1] is not None:
            channels["radar"] = physical(channels["radar"], transmitter=radios[0], receiver=radios[1])
        observations[name] = Observation(channels, draws[name], geometry)
    return observations


def physical(channel: Channel, *, transmitter: Radio, receiver: Radio) -> Channel:
    """Scale a radar channel to √W at the ADC input, with the thermal noise and the full scale of the receiver.

    Parameters
    ----------
    channel
        Channel whose amplitudes are square roots of cross-sections in m² over R_tx·R_rx.
    transmitter, receiver
        Radios of both nodes.

    Notes
    -----
    Source: docs/theory/simulate.md, "Radio".
    """
    waveform = channel.waveform
    wavelength_m = SPEED_OF_LIGHT_M_S / centre_frequency(waveform.frequency_hz)
    gains_db = transmitter.transmit_power_dbm - 30 + transmitter.transmit_gain_dbi + receiver.receive_gain_dbi
    received = 10 ** ((gains_db + receiver.gain_db) / 10) * wavelength_m**2 / (4 * np.pi) ** 3
    level = np.sqrt(received / waveform.mean_power)
    noise = 0.0
    if receiver.noise_figure_db is not None:
        amplified = 10 ** ((receiver.noise_figure_db + receiver.gain_db) / 10)
        noise = BOLTZMANN_J_K * REFERENCE_K * amplified * waveform.sample_rate_hz
    paths = replace(channel.paths, amplitude=channel.paths.amplitude * level)
    full_scale = float(10 ** ((receiver.full_scale_dbm - 30) / 20))
    return replace(channel, paths=paths, noise_variance=noise, full_scale=full_scale)


def _possible(impairments: Impairments, flight: SimulatedFlight) -> Impairments:
    """Remove impairments that do not apply to a continuous recorder: missed triggers, and a phase per trigger."""
    if not flight.continuous:
        return impairments
    return replace(impairments, missed_fraction=0.0, clock=replace(impairments.clock, continuous_phase=False))


def _logged(campaign: DrawnCampaign, flight: SimulatedFlight, receiver: str) -> Geometry:
    origin, nodes, time_s = campaign.specification.origin, campaign.specification.nodes, campaign.pulse_times(flight)

    def place(name: str, point: AntennaPoint) -> Floats:
        arm = nodes[name].lever_arms_m.get(point, (0.0, 0.0, 0.0))
        return phase_centre(origin, campaign.trajectories[flight.name, name], time_s, arm)

    def velocity(name: str) -> Floats:
        return logged_velocity(origin, campaign.trajectories[flight.name, name], time_s)

    sender = flight.transmitter
    return Geometry(
        radar_tx=place(sender, "radar_tx"),
        radar_rx=place(receiver, "radar_rx"),
        sidelink_tx=place(sender, "sidelink"),
        sidelink_rx=place(receiver, "sidelink"),
        tx_velocity=velocity(sender),
        rx_velocity=velocity(receiver),
        air=campaign.specification.air,
    )


def _gain(
    campaign: DrawnCampaign, flight: SimulatedFlight, receiver: str, geometry: Geometry, scatterers: Scatterers
) -> Floats:
    """Return the two-way field of the radar antennas relative to their boresights, (pulse, point) float64."""
    gain = np.ones((1, 1))
    ends: tuple[tuple[str, RadarPoint, Floats], ...] = (
        (flight.transmitter, "radar_tx", geometry.radar_tx),
        (receiver, "radar_rx", geometry.radar_rx),
    )
    for name, point, antenna_m in ends:
        beam = campaign.specification.nodes[name].antennas.get(point)
        if beam is not None:
            path, time_s = campaign.trajectories[flight.name, name], campaign.pulse_times(flight)
            rotation = body_rotation(campaign.specification.origin, path, time_s)
            gain = gain * beam.gain(rotation, antenna_m, scatterers.position_m)
    return gain


def observe(
    waveform: TransmitWaveform,
    scatterers: Scatterers,
    logged: Geometry,
    generator: Generator,
    *,
    receiver: Impairments,
    transmitter: Impairments | None = None,
    sidelink: bool = True,
) -> Observation:
    """Simulate the observation of a scene by a receiver, with random impairments.

    Parameters
    ----------
    waveform
        Transmitted waveform; its repetition frequency determines the pulse times.
    scatterers, logged
        The scene and the logged antenna positions, in one frame; localization errors displace the true positions.
    receiver, transmitter
        Impairments of each node. If `transmitter` is None, the receiver transmits, with a common position error.
    sidelink
        True if the second channel is recorded.

    Examples
    --------
    >>> from apertura.simulation.presets import paper_scene, paper_waveform
    >>> from apertura.simulation.synthesis import transfer_functions
    >>> observed = observe(paper_waveform(), *paper_scene(pulses=3), np.random.default_rng(0),
    ...                    receiver=Impairments(radar_snr_db=20.0))
    >>> transfer_functions(observed.channels["radar"], observed.noise["radar"]).shape
    (3, 4096)
    """
    time_s = np.arange(len(logged.radar_tx)) / waveform.prf_hz
    streams = independent_streams(generator, 4)
    drawn = draw_impairments(receiver, time_s, waveform.sample_rate_hz, streams[0])
    sender, sender_draw = receiver, drawn
    if transmitter is not None:
        sender, sender_draw = transmitter, draw_impairments(transmitter, time_s, waveform.sample_rate_hz, streams[1])
    truth = _true(logged, (sender, sender_draw), (receiver, drawn))
    channels = receive(
        waveform, scatterers, truth, impairments=receiver, draw=drawn, transmitter=sender, sidelink=sidelink
    )
    return Observation(channels, drawn, truth, {"radar": streams[2], "sidelink": streams[3]})


def _true(logged: Geometry, sender: _Node, receiver: _Node) -> Geometry:
    """Return the true antenna positions: the logged positions minus the localization error of each node."""

    def true(logged_m: Floats, point: AntennaPoint, node: _Node) -> Floats:
        localization, error_m = node[0].localization, node[1].position_error_m
        return logged_m - error_m if localization and point in localization.points else logged_m

    return replace(
        logged,
        radar_tx=true(logged.radar_tx, "radar_tx", sender),
        radar_rx=true(logged.radar_rx, "radar_rx", receiver),
        sidelink_tx=true(logged.sidelink_tx, "sidelink", sender),
        sidelink_rx=true(logged.sidelink_rx, "sidelink", receiver),
    )
