"""The paper's three experiments as campaigns: nodes wired in a lab, standing outdoors, and flying.

What the paper does not print (targets, clutter, noise, which parts of the track) is chosen here, plainly, and not so
that a result of the paper comes out: docs/theory/study.md, "Experiments".
"""

from collections.abc import Mapping
from dataclasses import replace

from apertura.simulation.impairments import Clock, Impairments, TimeTag, Timing, UniformPhase
from apertura.simulation.scene import Clutter, Line, Origin, PointTarget, Target, Vector
from apertura.simulation.specification import (
    CampaignSpecification,
    ImageGrid,
    SimulatedFlight,
    SimulatedNode,
)
from apertura.simulation.trajectory import Straight, Wobble
from apertura.simulation.waveforms import WaveformSpecification

PAPER_WAVEFORM = WaveformSpecification(4096, 1.2e9, 100e3, 12.5e-6, 3.125e-6, 1.024e9, 100.0, code="newman")
EXPERIMENT_ORIGIN = Origin(48.42255, 9.95509, 620.0)
STATIC_PULSES = 200
CABLE_M = 10.0
"""Electrical length of the cable that carries the sidelink in the lab."""

SEPARATION_M = 4.7
"""Between the two nodes outdoors and in flight."""

SEGMENT_M, GAP_M, SPEED_M_S, FLIGHT_PRF_HZ = 3.4, 2.4, 0.5, 20.0
"""Each image's part of the track, and how far the two parts lie apart, both counted at the pair's midpoint."""


def paper_lab(*, pulses: int = STATIC_PULSES) -> CampaignSpecification:
    """Return two nodes 0.6 m apart on a table, wired by a cable, before two cylinders on a bare floor.

    The points of the sidelink coincide: nothing but the cable, `CABLE_M` of electrical length, is between them.
    """
    targets = (
        Line((0.0, 0.0, 0.0), (0.0, 0.0, 1.5), 30, 1.0),
        Line((0.9, 1.6, 0.0), (0.9, 1.6, 1.5), 30, 0.5),
        Clutter((-3.0, -2.5, 3.0, 3.0), 5e-4, 6.0),
    )
    wired = SimulatedNode(
        {"sidelink": (0.0, -0.6, 0.0)}, {"radar": 0.911, "sidelink": CABLE_M}, impairments=_own_clock(10.0, 40.0)
    )
    nodes = {"uav1": SimulatedNode(impairments=Impairments(radar_snr_db=10.0)), "uav2": wired}
    places = {"uav1": (-0.3, -4.0, 0.75), "uav2": (0.3, -4.0, 0.75)}
    return _standing("paper-lab", targets, nodes, places, pulses)


def paper_static(*, pulses: int = STATIC_PULSES) -> CampaignSpecification:
    """Return two nodes standing 4.7 m apart outdoors, before a strong and a weak reflector and clutter."""
    targets = (
        PointTarget((0.0, 0.0, 0.0)),
        PointTarget((1.0, 2.2, 0.0), 0.25),
        Clutter((-4.0, -4.0, 4.0, 6.0), 1e-3, 4.0),
    )
    secondary = SimulatedNode({}, {"radar": 0.911, "sidelink": 0.402}, impairments=_own_clock(0.0, 30.0))
    nodes = {"uav1": SimulatedNode(impairments=Impairments(radar_snr_db=0.0)), "uav2": secondary}
    places = {"uav1": (-SEPARATION_M / 2, -14.0, 1.5), "uav2": (SEPARATION_M / 2, -14.0, 1.5)}
    return _standing("paper-static", targets, nodes, places, pulses)


def paper_uav(*, pulses: int = 275) -> CampaignSpecification:
    """Return the flight: 20 Hz, 0.5 m/s, 4.8 m high, 11.5 m from the scene, 4.7 m apart, a segment for each image.

    The monostatic pair takes the first 3.4 m of the track, the bistatic pair the last; 275 pulses make 53 MB.
    """
    targets = (
        PointTarget((0.0, 0.0, 0.0)),
        PointTarget((-2.0, 1.2, 0.0), 0.7),
        PointTarget((1.8, -1.6, 0.0), 0.7),
        PointTarget((1.2, 2.2, 0.0), 0.5),  # the foot of a cylinder, where it and the ground are a dihedral
        Clutter((-5.0, -5.0, 5.0, 5.0), 0.02, 15.0),
    )
    secondary = SimulatedNode(
        {}, {"radar": 0.911, "sidelink": 0.402}, attitude="none", log_format="pos", impairments=_own_clock(0.0, 30.0)
    )
    primary = SimulatedNode({"radar_tx": (0.1, 0.25, 0.12), "radar_rx": (0.1, 0.15, 0.12)}, {"radar": 1.374},
                            impairments=Impairments(radar_snr_db=0.0))  # fmt: skip
    start_m = -SEGMENT_M - GAP_M / 2
    velocity = (SPEED_M_S, 0.0, 0.0)
    tracks = {
        "uav1": Straight((start_m, -11.5, 4.8), velocity, Wobble()),
        "uav2": Straight((start_m + SEPARATION_M, -11.5, 4.8), velocity, Wobble()),
    }
    long_s = SEGMENT_M / SPEED_M_S
    later_s = (GAP_M / 2 - SEPARATION_M / 2 - start_m) / SPEED_M_S  # its midpoint is half the separation ahead
    segments = {"uav1-uav1": ((0.0, long_s),), "uav1-uav2": ((later_s, later_s + long_s),)}
    flight = SimulatedFlight("f01", "uav1", tracks, pulses, segments=segments)
    grid = ImageGrid("EPSG:32632", half_width_m=4.0, spacing_m=0.05)
    waveform = replace(PAPER_WAVEFORM, prf_hz=FLIGHT_PRF_HZ)
    return CampaignSpecification(
        "paper-uav", EXPERIMENT_ORIGIN, waveform, targets, {"uav1": primary, "uav2": secondary}, (flight,), grid
    )


def _own_clock(radar_snr_db: float, sidelink_snr_db: float) -> Impairments:
    """Return a secondary whose clock is 10 ppb off and which starts and turns anew with every pulse."""
    return Impairments(
        clock=Clock(cfo_hz=12.0),
        carrier_phase=UniformPhase(),
        timing=Timing(offset_s=12e-9, half_width_s=40e-9),
        time_tag=TimeTag(offset_s=3.7e-3, jitter_s=0.2e-3),
        radar_snr_db=radar_snr_db,
        sidelink_snr_db=sidelink_snr_db,
    )


def _standing(
    name: str,
    targets: tuple[Target, ...],
    nodes: Mapping[str, SimulatedNode],
    places: Mapping[str, Vector],
    pulses: int,
) -> CampaignSpecification:
    tracks = {node: Straight(place, (0.0, 0.0, 0.0)) for node, place in places.items()}
    flight = SimulatedFlight("f01", "uav1", tracks, pulses)
    grid = ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1)
    return CampaignSpecification(name, EXPERIMENT_ORIGIN, PAPER_WAVEFORM, targets, nodes, (flight,), grid)
