"""What nodes observe, as channels without samples yet: of a drawn flight, or of one pair of nodes given as arrays."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator

from apertura.simulation.draw import ImpairmentDraw, draw_impairments, independent_streams
from apertura.simulation.impairments import AntennaPoint, Impairments, RadarPoint
from apertura.simulation.radar import Floats, TransmitWaveform
from apertura.simulation.recording import Geometry, receive
from apertura.simulation.scene import Scatterers
from apertura.simulation.specification import DrawnCampaign, SimulatedFlight
from apertura.simulation.synthesis import Channel
from apertura.simulation.trajectory import body_turn, phase_centre, phase_centre_velocity


@dataclass(frozen=True)
class Observation:
    """A node's channels in one flight, and what the processor is not told.

    Attributes
    ----------
    channels
        `radar` and, of a node without the transmitter's clock, `sidelink`: for `samples` or `transfer_functions`.
    draw
        What was drawn of the receiver's impairments.
    truth
        Where the antennas truly were.
    noise
        A generator per channel, for their noise; only where arrays were given.
    """

    channels: Mapping[str, Channel]
    draw: ImpairmentDraw
    truth: Geometry
    noise: Mapping[str, Generator] = field(default_factory=dict)


def fly(
    campaign: DrawnCampaign, flight: SimulatedFlight, scatterers: Scatterers, generator: Generator
) -> dict[str, Observation]:
    """Return what each node of a flight records.

    Parameters
    ----------
    campaign, flight
        Who flies what.
    scatterers
        What stands there, ECEF.
    generator
        Draws what is random about the nodes; each has its own stream.
    """
    nodes, time_s = campaign.specification.nodes, campaign.pulse_times(flight)
    streams = dict(zip(flight.tracks, independent_streams(generator, len(flight.tracks)), strict=True))
    draws = {
        name: draw_impairments(
            _possible(nodes[name].impairments, flight), time_s, campaign.waveform.sample_rate_hz, streams[name]
        )
        for name in flight.tracks
    }
    observations = {}
    for name in flight.tracks:
        geometry = _geometry(campaign, flight, name, draws)
        geometry = replace(geometry, gain=_gain(campaign, flight, name, geometry, scatterers))
        channels = receive(
            campaign.waveform,
            scatterers,
            geometry,
            impairments=nodes[name].impairments,
            draw=draws[name],
            transmitter=nodes[flight.transmitter].impairments,
            path_offset_m=nodes[name].path_offset_m,
            sidelink=name != flight.transmitter,
        )
        observations[name] = Observation(channels, draws[name], geometry)
    return observations


def _possible(impairments: Impairments, flight: SimulatedFlight) -> Impairments:
    """Leave out what a recorder that runs through cannot suffer: missed triggers, and phase counted per trigger."""
    if not flight.continuous:
        return impairments
    return replace(impairments, missed_fraction=0.0, clock=replace(impairments.clock, continuous_phase=False))


def _geometry(
    campaign: DrawnCampaign, flight: SimulatedFlight, receiver: str, draws: Mapping[str, ImpairmentDraw]
) -> Geometry:
    origin, nodes, time_s = campaign.specification.origin, campaign.specification.nodes, campaign.pulse_times(flight)

    def place(name: str, point: AntennaPoint) -> Floats:
        arm = nodes[name].lever_arms_m.get(point, (0.0, 0.0, 0.0))
        logged = phase_centre(origin, campaign.trajectories[flight.name, name], time_s, arm)
        return _true(logged, point, nodes[name].impairments, draws[name])

    def velocity(name: str) -> Floats:
        return phase_centre_velocity(origin, campaign.trajectories[flight.name, name], time_s)

    sender = flight.transmitter
    return Geometry(
        radar_tx=place(sender, "radar_tx"),
        radar_rx=place(receiver, "radar_rx"),
        sidelink_tx=place(sender, "sidelink"),
        sidelink_rx=place(receiver, "sidelink"),
        tx_velocity=velocity(sender),
        rx_velocity=velocity(receiver),
    )


def _gain(
    campaign: DrawnCampaign, flight: SimulatedFlight, receiver: str, geometry: Geometry, scatterers: Scatterers
) -> Floats:
    """Return (pulse, point) float64: the field of both radar antennas, relative to their boresights."""
    gain = np.ones((1, 1))
    ends: tuple[tuple[str, RadarPoint, Floats], ...] = (
        (flight.transmitter, "radar_tx", geometry.radar_tx),
        (receiver, "radar_rx", geometry.radar_rx),
    )
    for name, point, antenna_m in ends:
        beam = campaign.specification.nodes[name].antennas.get(point)
        if beam is not None:
            path, time_s = campaign.trajectories[flight.name, name], campaign.pulse_times(flight)
            turn = body_turn(campaign.specification.origin, path, time_s)
            gain = gain * beam.gain(turn, antenna_m, scatterers.position_m)
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
    """Return what a receiver observes, with its impairments drawn.

    Parameters
    ----------
    waveform
        What is transmitted; its repetition frequency gives the times.
    scatterers
        The scene, in the frame of `logged`.
    logged
        Where the logs say the antennas are; localization errors move the true ones.
    generator
        Everything random.
    receiver
        What is wrong with the receiving node.
    transmitter
        What is wrong with the transmitting node (localization, ripple). None: transmitter and receiver are one
        node, with one position error.
    sidelink
        Whether the second channel is recorded.

    Examples
    --------
    >>> from apertura.simulation.presets import paper_scene, paper_waveform
    >>> from apertura.simulation.synthesis import transfer_functions
    >>> seen = observe(paper_waveform(), *paper_scene(pulses=3), np.random.default_rng(0),
    ...                receiver=Impairments(radar_snr_db=20.0))
    >>> transfer_functions(seen.channels["radar"], seen.noise["radar"]).shape
    (3, 4096)
    """
    time_s = np.arange(len(logged.radar_tx)) / waveform.prf_hz
    streams = independent_streams(generator, 4)
    drawn = draw_impairments(receiver, time_s, waveform.sample_rate_hz, streams[0])
    sender, sender_draw = receiver, drawn
    if transmitter is not None:
        sender, sender_draw = transmitter, draw_impairments(transmitter, time_s, waveform.sample_rate_hz, streams[1])
    truth = replace(
        logged,
        radar_tx=_true(logged.radar_tx, "radar_tx", sender, sender_draw),
        radar_rx=_true(logged.radar_rx, "radar_rx", receiver, drawn),
        sidelink_tx=_true(logged.sidelink_tx, "sidelink", sender, sender_draw),
        sidelink_rx=_true(logged.sidelink_rx, "sidelink", receiver, drawn),
    )
    channels = receive(
        waveform,
        scatterers,
        truth,
        impairments=receiver,
        draw=drawn,
        transmitter=sender,
        sidelink=sidelink,
    )
    return Observation(channels, drawn, truth, {"radar": streams[2], "sidelink": streams[3]})


def _true(logged_m: Floats, point: str, impairments: Impairments, draw: ImpairmentDraw) -> Floats:
    wrong = impairments.localization
    return logged_m - draw.position_error_m if wrong and point in wrong.points else logged_m
