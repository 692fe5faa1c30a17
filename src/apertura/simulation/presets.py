"""Campaigns worth flying again: the demo, and the scene of the paper."""

from pathlib import Path

import numpy as np
from numpy.random import Generator

from apertura.simulation.campaign import write_campaign
from apertura.simulation.flight import Sampled, Straight, wobble
from apertura.simulation.hidden import independent_streams
from apertura.simulation.impairments import Impairments, TimeTag, Timing, UniformPhase
from apertura.simulation.plan import Flight, Node, Simulation, grid_around
from apertura.simulation.radar import Waveform, newman_codes, qpsk_codes
from apertura.simulation.recording import Geometry
from apertura.simulation.scene import Origin, PointTarget, Scatterers, Scene

DEMO_ORIGIN = Origin(48.42255, 9.95509, 620.0)
"""Middle of the demo's scene, on flat ground by the Danube."""


def tandem_demo(directory: str | Path, generator: Generator, *, pulses: int = 300) -> Path:
    """Write the campaign of `make demo`: two UAVs, one transmits, both receive, five targets on 12 m × 12 m.

    The secondary has its own clock: tags off by milliseconds, random phase and start of every capture. Both
    miss some triggers, both digitise 14 bits with noise.

    Parameters
    ----------
    directory
        The folder to make.
    generator
        Everything random.
    pulses
        Pulses at 20 Hz; 300 fly 7.5 m and make about 14 MB.
    """
    return write_campaign(directory, tandem(generator, pulses=pulses), generator)


def tandem(generator: Generator, *, pulses: int = 300) -> Simulation:
    """Return the demo before it is flown; the flight is along azimuth 40°, the scene to its right."""
    codes, first, second = independent_streams(generator, 3)
    waveform = Waveform(qpsk_codes(1024, codes), 1.2e9, "band_start", 400e3, 3.125e-6, 0.78125e-6, 1.024e9, 20.0)
    along = np.array([np.sin(np.radians(40.0)), np.cos(np.radians(40.0)), 0.0])
    right = np.array([along[1], -along[0], 0.0])
    duration_s = (pulses - 1) / waveform.prf_hz

    def pass_by(middle_m: float, stream: Generator) -> Sampled:
        start = along * (middle_m - 0.25 * duration_s) - right * 11.5 + [0.0, 0.0, 4.8]
        velocity = 0.5 * along
        straight = Straight((start[0], start[1], start[2]), (velocity[0], velocity[1], 0.0))
        return wobble(straight, duration_s, stream)

    uav1 = Node(
        "uav1",
        {"radar_tx": (0.1, 0.25, 0.12), "radar_rx": (0.1, 0.15, 0.12), "sidelink": (-0.2, 0.0, 0.05)},
        {"radar": 1.374, "sidelink": 0.655},
        impairments=Impairments(radar_snr_db=25.0, missed_fraction=0.02),
    )
    uav2 = Node(
        "uav2",
        path_offset_m={"radar": 0.911, "sidelink": 0.402},
        attitude="none",
        log_format="pos",
        impairments=Impairments(
            carrier_phase=UniformPhase(),
            timing=Timing(offset_s=12e-9, half_width_s=40e-9),
            missed_fraction=0.03,
            time_tag=TimeTag(offset_s=3.7e-3, jitter_s=0.2e-3),
            radar_snr_db=25.0,
            sidelink_snr_db=30.0,
        ),
    )
    flight = Flight("f01", "uav1", {"uav1": pass_by(-1.9, first), "uav2": pass_by(2.8, second)}, pulses)
    grid = grid_around(DEMO_ORIGIN, "EPSG:32632", 6.0, spacing_m=0.05)
    return Simulation("tandem_demo", waveform, demo_scene(), (uav1, uav2), (flight,), grid)


def demo_scene() -> Scene:
    """Return five point targets on the ground about `DEMO_ORIGIN`."""
    targets = (
        PointTarget((0.0, 0.0, 0.0)),
        PointTarget((-1.9, -0.7, 0.0), 0.8),
        PointTarget((2.1, 0.9, 0.0), 0.9),
        PointTarget((-1.0, 1.7, 0.0), 0.6),
        PointTarget((1.3, -3.2, 0.0), 0.7),
    )
    return Scene(DEMO_ORIGIN, targets)


def paper_waveform(*, prf_hz: float = 100.0) -> Waveform:
    """Return the paper's waveform: 4096 subcarriers of 100 kHz at 1.2 GHz, 3.125 µs + 12.5 µs at 1.024 GS/s.

    Examples
    --------
    >>> wave = paper_waveform()
    >>> len(wave.codes) * wave.subcarrier_spacing_hz
    409600000.0
    """
    return Waveform(newman_codes(4096), 1.2e9, "band_start", 100e3, 12.5e-6, 3.125e-6, 1.024e9, prf_hz)


def paper_scene(*, pulses: int = 3000, length_m: float = 30.0, rx_ahead_m: float = 0.0) -> tuple[Scatterers, Geometry]:
    """Return the paper's simulated scene as arrays: five targets, straight track at 10 m, antennas at one place.

    Parameters
    ----------
    pulses
        Along `length_m` of track; 3000 at 1 m/s and 100 Hz in the paper.
    length_m
        Aperture, centred on cross-range zero.
    rx_ahead_m
        The receiver flies this far ahead of the transmitter (4.7 m in the localization study).

    Returns
    -------
    Scatterers, Geometry
        In local Cartesian metres: cross-range (along track), ground range, up.

    Notes
    -----
    Source: the paper's simulation table; ../shared/DESIGN.md section 4.

    Examples
    --------
    >>> scatterers, geometry = paper_scene(pulses=3)
    >>> geometry.radar_tx[:, 0], scatterers.position_m[:, 1]
    (array([-15.,   0.,  15.]), array([ 5., 10., 15., 20., 25.]))
    """
    cross_ground = np.array([(0, 5), (-4, 10), (0, 15), (4, 20), (0, 25)], np.float64)
    scatterers = Scatterers(np.column_stack([cross_ground, np.zeros(5)]), np.ones(5, np.complex128))
    along = np.linspace(-length_m / 2, length_m / 2, pulses)
    sender = np.column_stack([along, np.zeros(pulses), np.full(pulses, 10.0)])
    receiver = sender + np.array([rx_ahead_m, 0.0, 0.0])
    return scatterers, Geometry(sender, receiver, sender, receiver)
