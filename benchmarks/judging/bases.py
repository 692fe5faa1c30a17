"""The right campaigns that mistakes are made in: the sample, and one along a strongly curved track."""

from dataclasses import replace
from pathlib import Path

import numpy as np

import apertura as ap
from apertura.simulation import (
    CampaignSpecification,
    Impairments,
    SimulatedFlight,
    Waypoints,
    Wobble,
    preset,
)
from apertura.simulation.impairments import TimeTag
from judging.run import copy_writable

SHARED = Path(__file__).parents[2].parent / "shared" / "data"
_PULSES, _RADIUS_M, _HEIGHT_M = 140, 11.5, 4.8


def sample(target: Path) -> Path:
    """Copy the sample campaign, made by a model independent of this project: nearly straight tracks, four targets."""
    return copy_writable(SHARED / "campaign-sample", target)


def curved(target: Path) -> Path:
    """Simulate two nodes on an arc of 45° about five targets, one 4 m behind the other and 0.4 m higher."""
    return ap.simulate(target, curved_specification(), seed=9)


def curved_specification() -> CampaignSpecification:
    """Return what `curved` simulates; nodes, logs, waveform and grid are those of the demo."""
    demo = preset("demo")
    primary, secondary = demo.nodes["uav1"], demo.nodes["uav2"]
    tag = TimeTag(offset_s=0.5e-3, jitter_s=0.1e-3)
    nodes = {
        "uav1": replace(primary, impairments=Impairments(radar_snr_db=25.0)),
        "uav2": replace(secondary, impairments=replace(secondary.impairments, time_tag=tag, missed_fraction=0.0)),
    }
    tracks = {"uav1": arc(-12.0, _HEIGHT_M), "uav2": arc(-32.0, _HEIGHT_M + 0.4)}
    flight = SimulatedFlight("f01", "uav1", tracks, _PULSES)
    return replace(demo, campaign="curved", nodes=nodes, flights=(flight,))


def arc(first_deg: float, up_m: float) -> Waypoints:
    """Return a counter-clockwise flight of 45° in 7 s about the origin, from an angle; it begins 5 s earlier."""
    time_s = np.arange(-5.0, 12.5, 0.5)
    angle = np.radians(first_deg + 6.4 * time_s)
    position = np.column_stack([_RADIUS_M * np.cos(angle), _RADIUS_M * np.sin(angle), np.full(angle.size, up_m)])
    return Waypoints(tuple(time_s.tolist()), tuple(map(tuple, position.tolist())), wobble=Wobble())


BASES = {"sample": sample, "curved": curved}
