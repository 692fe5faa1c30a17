"""Make a campaign of a radar flown along a PX4 log: samples are simulated, the flight log is the real one.

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
"""The leg of the flight that is imaged, from the log's first epoch."""

BESIDE_M = -8.0, -14.0, -8.0
"""From the middle of the flight to the middle of the scene: north, east, up."""


def replay(log: Path, campaign: Path) -> None:
    """Write the campaign."""
    track = read_track(log, node="uav1")
    position, time = track.position.values, track.time.values
    began = time[0] + np.timedelta64(round(FIRST_S * 1e9), "ns")
    middle = position.mean(axis=0)
    north, east, up = BESIDE_M
    origin = Origin(*geodetic_from_ecef(middle + ned_axes(middle) @ [north, east, -up]))
    centre = origin.ecef(np.zeros(3))
    north, east, down = ((position - centre) @ ned_axes(centre)).T
    places = tuple(map(tuple, np.stack([east, north, -down], axis=-1).tolist()))
    flown = Waypoints(tuple(((time - began) / np.timedelta64(1, "s")).tolist()), places)
    waveform = WaveformSpecification(512, 1.2e9, 400e3, 3.125e-6, 0.625e-6, 409.6e6, 100.0)
    pulses = round((LAST_S - FIRST_S) * waveform.prf_hz)
    flight = SimulatedFlight("f01", "uav1", {"uav1": flown}, pulses, start_utc=str(began))
    targets = tuple(PointTarget(place) for place in ((0.0, 0.0, 0.0), (-2.0, 3.0, 0.0), (3.0, -2.0, 0.0)))
    grid = ImageGrid("EPSG:32632", half_width_m=5.0, spacing_m=0.05)
    node = {"uav1": SimulatedNode(attitude="none")}
    made = CampaignSpecification("px4 flight, replayed", origin, waveform, targets, node, (flight,), grid)
    simulate(campaign, made, seed=1)
    (campaign / "raw/f01/uav1.track.csv").unlink()
    shutil.copyfile(log, campaign / "raw/f01/uav1.track.ulg")


if __name__ == "__main__":
    replay(Path(sys.argv[1]), Path(sys.argv[2]))
