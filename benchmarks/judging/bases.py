"""Error-free base campaigns into which mistakes are introduced: sample and strongly curved track."""

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


def sample(target: Path) -> Path:
    """Copy the sample campaign of an independent simulator: nearly straight tracks, four targets."""
    return copy_writable(SHARED / "campaign-sample", target)


def curved(target: Path) -> Path:
    """Simulate two nodes on arcs of 36° about five targets, one node 4 m behind the other and 0.4 m higher."""
    return ap.simulate(target, curved_specification(), seed=9)


def curved_specification() -> CampaignSpecification:
    """Return the specification of `curved`; nodes, logs, waveform and grid are those of the demo."""
    demo = preset("demo")
    primary, secondary = demo.nodes["uav1"], demo.nodes["uav2"]
    tag = TimeTag(offset_s=0.5e-3, jitter_s=0.1e-3)
    nodes = {
        "uav1": replace(primary, impairments=Impairments(radar_snr_db=25.0)),
        "uav2": replace(secondary, impairments=replace(secondary.impairments, time_tag=tag, missed_fraction=0.0)),
    }
    tracks = {"uav1": bow(-8.0, 4.8), "uav2": bow(-28.0, 5.2)}
    return replace(demo, campaign="curved", nodes=nodes, flights=(SimulatedFlight("f01", "uav1", tracks, 140),))


def bow(first_deg: float, up_m: float) -> Waypoints:
    """Return an arc of 36° about the origin in 7 s, typical of manual control, with varying speed, distance and height.

    On a uniform circle, a time offset only rotates the image; on this arc it distorts the image.
    """
    time_s = np.arange(-5.0, 12.5, 0.5)
    phase_rad = 2 * np.pi * time_s / 7.0
    angle = np.radians(first_deg + 5.2 * time_s + 1.5 * np.sin(phase_rad))
    distance, up = 11.5 + 0.7 * np.cos(phase_rad), up_m + 0.3 * np.sin(phase_rad)
    position = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), up])
    return Waypoints(tuple(time_s.tolist()), tuple(map(tuple, position.tolist())), wobble=Wobble())


BASES = {"sample": sample, "curved": curved}
