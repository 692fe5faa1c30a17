"""Write a campaign of a radar flown along a PX4 log, with simulated samples and the real flight log.

python examples/px4_flight/replay.py LOG.ulg CAMPAIGN
"""

import shutil
import sys
from pathlib import Path

import numpy as np

from apertura.core.geometry.geodesy import geodetic_from_ecef, ned_axes
from apertura.formats.reading import read_track
from apertura.simulation import simulate
from apertura.simulation.specification import (
    CampaignSpecification,
    ImageGrid,
    SimulatedFlight,
    SimulatedNode,
)
from apertura.simulation.targets import Origin, PointTarget, Waypoints
from apertura.simulation.waveform import WaveformSpecification

FIRST_S, LAST_S = 5.6, 11.6
"""Start and end of the imaged part of the flight, seconds after the first epoch of the log."""

SCENE_OFFSET_M = -8.0, -14.0, -8.0
"""Offset of the scene centre from the mean position of the flight, metres north, east and up."""


def replay(log: Path, campaign: Path) -> None:
    """Write a campaign with the real flight log and simulated samples."""
    track = read_track(log, node="uav1")
    position, time = track.position.values, track.time.values
    start = time[0] + np.timedelta64(round(FIRST_S * 1e9), "ns")
    mean = position.mean(axis=0)
    north, east, up = SCENE_OFFSET_M
    origin = Origin(*geodetic_from_ecef(mean + ned_axes(mean) @ [north, east, -up]))
    centre = origin.ecef(np.zeros(3))
    north, east, down = ((position - centre) @ ned_axes(centre)).T
    positions = tuple(map(tuple, np.stack([east, north, -down], axis=-1).tolist()))
    trajectory = Waypoints(tuple(((time - start) / np.timedelta64(1, "s")).tolist()), positions)
    waveform = WaveformSpecification(512, 1.2e9, 400e3, 3.125e-6, 0.625e-6, 409.6e6, 100.0)
    pulses = round((LAST_S - FIRST_S) * waveform.prf_hz)
    flight = SimulatedFlight("f01", "uav1", {"uav1": trajectory}, pulses, start_utc=str(start))
    targets = tuple(PointTarget(position) for position in ((0.0, 0.0, 0.0), (-2.0, 3.0, 0.0), (3.0, -2.0, 0.0)))
    grid = ImageGrid("EPSG:32632", half_width_m=5.0, spacing_m=0.05)
    node = {"uav1": SimulatedNode(attitude="none")}
    specification = CampaignSpecification("px4 flight, replayed", origin, waveform, targets, node, (flight,), grid)
    simulate(campaign, specification, seed=1)
    (campaign / "raw/f01/uav1.track.csv").unlink()
    shutil.copyfile(log, campaign / "raw/f01/uav1.track.ulg")


if __name__ == "__main__":
    replay(Path(sys.argv[1]), Path(sys.argv[2]))
