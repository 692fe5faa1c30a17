"""What is flown: nodes, flights and the grid of a campaign, and the channels that come of one flight."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.random import Generator

from apertura.geometry.geodesy import projected_from_ecef
from apertura.simulation.antenna import Antenna
from apertura.simulation.flight import Trajectory, body_turn, phase_centre, phase_centre_velocity
from apertura.simulation.frame import Framing
from apertura.simulation.hidden import Hidden, draw, independent_streams
from apertura.simulation.impairments import Impairments
from apertura.simulation.radar import Floats, Waveform
from apertura.simulation.recording import Geometry, receive
from apertura.simulation.scene import Origin, Scatterers, Scene, Target, Vector
from apertura.simulation.synthesis import Channel


@dataclass(frozen=True)
class Node:
    """One UAV.

    Attributes
    ----------
    name
        As in config and file names.
    lever_arms_m
        `radar_tx`, `radar_rx`, `sidelink`: forward, right, down from the logged point; missing: zero.
    path_offset_m
        True electrical path beyond geometry as receiver: `radar`, `sidelink`.
    stated_path_offset_m
        What the config says instead; the true ones if None.
    attitude
        What the config says: `log`, `course` or `none`.
    log_format, log_rate_hz
        csv (with attitude), pos (RTKLIB in GPST) or pos_utc, and epochs per second.
    impairments
        What is wrong with it.
    antennas
        Beams of `radar_tx`, `radar_rx`; missing: alike in all directions.
    """

    name: str
    lever_arms_m: Mapping[str, Vector] = field(default_factory=dict)
    path_offset_m: Mapping[str, float] = field(default_factory=dict)
    stated_path_offset_m: Mapping[str, float] | None = None
    attitude: Literal["log", "course", "none"] = "log"
    log_format: Literal["csv", "pos", "pos_utc"] = "csv"
    log_rate_hz: float = 10.0
    impairments: Impairments = field(default_factory=Impairments)
    antennas: Mapping[str, Antenna] = field(default_factory=dict)


@dataclass(frozen=True)
class Flight:
    """One line of flights.tsv.

    Attributes
    ----------
    name, kind, transmitter
        As in flights.tsv.
    paths
        Trajectory of each node that records, by name.
    pulses
        Number of pulses sent.
    start_utc
        Time of the first pulse, ISO 8601.
    framing, first_frame
        Preamble and payload before each symbol, and the number of the first frame; None: no frame numbers.
    continuous
        The recorders run through instead of being triggered: one capture segment with everything in it.
    targets
        What stands there in this flight only, instead of the scene's targets.
    """

    name: str
    transmitter: str
    paths: Mapping[str, Trajectory]
    pulses: int
    start_utc: str = "2025-05-14T09:30:00"
    kind: Literal["image", "calibration"] = "image"
    framing: Framing | None = None
    first_frame: int = 0
    continuous: bool = False
    targets: tuple[Target, ...] | None = None


@dataclass(frozen=True)
class Grid:
    """The scene section of the config: CRS, outer pixel edges (m), spacing (m), ellipsoidal height (m)."""

    crs: str
    bounds_m: tuple[float, float, float, float] | Literal["auto"]
    spacing_m: float | Literal["auto"]
    height_m: float


@dataclass(frozen=True)
class Simulation:
    """A whole campaign before it is flown."""

    name: str
    waveform: Waveform
    scene: Scene
    nodes: tuple[Node, ...]
    flights: tuple[Flight, ...]
    grid: Grid

    def node(self, name: str) -> Node:
        """Return the node called `name`."""
        return next(node for node in self.nodes if node.name == name)


@dataclass(frozen=True)
class Recorded:
    """What one node records in one flight, and what nobody tells the processor.

    Attributes
    ----------
    channels
        Name → channel, ready to be sampled.
    hidden
        What was drawn.
    geometry
        True phase centres, ECEF.
    """

    channels: Mapping[str, Channel]
    hidden: Hidden
    geometry: Geometry


def grid_around(
    origin: Origin, crs: str, half_width_m: float, *, spacing_m: float, height_m: float | None = None
) -> Grid:
    """Return a square grid about `origin`, anchored at a multiple of the spacing.

    Examples
    --------
    >>> grid_around(Origin(48.0, 9.0, 500.0), "EPSG:32632", 1.0, spacing_m=0.05).bounds_m
    (499999.0, 5316299.2, 500001.0, 5316301.2)
    """
    centre = projected_from_ecef(crs, origin.ecef(np.zeros(3)))
    x, y = (round(float(value) / spacing_m) * spacing_m for value in centre[:2])
    low_x, low_y, high_x, high_y = (
        round(value, 6) for value in (x - half_width_m, y - half_width_m, x + half_width_m, y + half_width_m)
    )
    return Grid(crs, (low_x, low_y, high_x, high_y), spacing_m, origin.height_m if height_m is None else height_m)


def pulse_times(simulation: Simulation, flight: Flight) -> Floats:
    """Return (pulse,) float64, seconds from the first pulse."""
    return np.arange(flight.pulses) / simulation.waveform.prf_hz


def fly(simulation: Simulation, flight: Flight, scatterers: Scatterers, generator: Generator) -> dict[str, Recorded]:
    """Return what each node of a flight records, as channels without samples yet.

    Parameters
    ----------
    simulation, flight
        Who flies what.
    scatterers
        What stands there, ECEF.
    generator
        Draws what is random about the nodes; each has its own stream.
    """
    time_s = pulse_times(simulation, flight)
    streams = dict(zip(flight.paths, independent_streams(generator, len(flight.paths)), strict=True))
    rate_hz = simulation.waveform.sample_rate_hz
    hidden = {
        name: draw(_drawable(simulation.node(name).impairments, flight), time_s, rate_hz, streams[name])
        for name in flight.paths
    }
    recorded = {}
    for name in flight.paths:
        node = simulation.node(name)
        geometry = _geometry(simulation, flight, name, hidden)
        geometry = replace(geometry, gain=_gain(simulation, flight, name, geometry, scatterers))
        channels = receive(
            simulation.waveform,
            scatterers,
            geometry,
            impairments=node.impairments,
            hidden=hidden[name],
            transmitter=simulation.node(flight.transmitter).impairments,
            path_offset_m=node.path_offset_m,
            sidelink=name != flight.transmitter,
        )
        recorded[name] = Recorded(channels, hidden[name], geometry)
    return recorded


def _drawable(impairments: Impairments, flight: Flight) -> Impairments:
    """Leave out what a recorder that runs through cannot suffer: missed triggers, and phase counted per trigger."""
    if not flight.continuous:
        return impairments
    return replace(impairments, missed_fraction=0.0, clock=replace(impairments.clock, continuous_phase=False))


def _geometry(simulation: Simulation, flight: Flight, receiver: str, hidden: Mapping[str, Hidden]) -> Geometry:
    time_s = pulse_times(simulation, flight)

    def place(name: str, point: str) -> Floats:
        node = simulation.node(name)
        arm = node.lever_arms_m.get(point, (0.0, 0.0, 0.0))
        position = phase_centre(simulation.scene.origin, flight.paths[name], time_s, arm)
        wrong = node.impairments.localization
        return position - hidden[name].position_error_m if wrong and point in wrong.points else position

    def velocity(name: str) -> Floats:
        return phase_centre_velocity(simulation.scene.origin, flight.paths[name], time_s)

    sender = flight.transmitter
    return Geometry(
        radar_tx=place(sender, "radar_tx"),
        radar_rx=place(receiver, "radar_rx"),
        sidelink_tx=place(sender, "sidelink"),
        sidelink_rx=place(receiver, "sidelink"),
        tx_velocity=velocity(sender),
        rx_velocity=velocity(receiver),
    )


def _gain(simulation: Simulation, flight: Flight, receiver: str, geometry: Geometry, scatterers: Scatterers) -> Floats:
    time_s, gain = pulse_times(simulation, flight), np.ones((1, 1))
    for name, point in ((flight.transmitter, "radar_tx"), (receiver, "radar_rx")):
        antenna = simulation.node(name).antennas.get(point)
        if antenna is not None:
            turn = body_turn(simulation.scene.origin, flight.paths[name], time_s)
            gain = gain * antenna.gain(turn, getattr(geometry, point), scatterers.position_m)
    return gain
