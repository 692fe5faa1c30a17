"""Flight logs by themselves: whether they can be read, and whether a node can have flown so."""

from collections.abc import Iterator

import numpy as np

from apertura.common.errors import CampaignError
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.check.inspected import Inspected
from apertura.pipeline.config import CONFIG

FASTEST_M_S = 340.0
"""No node flies faster than sound: times or positions are in another unit."""


def check_tracks(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield logs that cannot be read, logs of two frames, no heights, speeds beyond sound."""
    yield from inspected.unread
    for key, track in inspected.tracks.items():
        seconds = np.diff(track.time.values) / np.timedelta64(1, "s")
        steps_m = np.linalg.norm(np.diff(track.position.values, axis=0), axis=1)
        speed = float(np.median(steps_m / seconds))
        expected, remedy = "positions of a flight", "Drop those lines, or export the log again."
        found = ""
        if track.attrs["frame"] != inspected.frame:
            found, expected = f"positions in frame {track.attrs['frame']}", f"{inspected.frame}, as the other logs"
            remedy = "Give logs of one frame."
        elif key in inspected.geodetic and np.abs(inspected.geodetic[key][:, 2]).max() < 1e-3:
            found, expected = "height 0 at every epoch", "metres above the ellipsoid"
            remedy = "Export the log with its heights."
        elif speed > FASTEST_M_S:
            found, expected = f"a median speed of {speed:.0f} m/s", f"less than {FASTEST_M_S:.0f} m/s"
            remedy = "Check the units of times (seconds) and positions (decimal degrees)."
        if found:
            yield CampaignError(found, where=inspected.campaign.track_file(*key), expected=expected, remedy=remedy)


def check_attitude(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield nodes whose attitude the config takes from a log that holds none, where an arm or a beam needs it."""
    campaign = inspected.campaign
    for (flight, node), track in inspected.tracks.items():
        stated = campaign.settings.nodes[node].attitude == "log"
        if stated and _turned(campaign, flight, node) and not np.isfinite(track.attitude.values).any():
            yield CampaignError(
                "no roll, pitch and yaw",
                where=campaign.track_file(flight, node),
                expected=f"an attitude at every epoch, as {CONFIG}: nodes.{node}.attitude is log",
                remedy="Log attitude, set the node's attitude to course, or its lever arms to zero and antennas to "
                "null.",
            )


def _turned(campaign: Campaign, flight: str, node: str) -> bool:
    """Return whether a node has an antenna in this flight that its attitude moves or turns."""
    arms = campaign.settings.nodes[node].lever_arms_m
    for pair in campaign.flight(flight).pairs:
        legs = dict(zip(("radar_tx", "radar_rx"), pair.split("-"), strict=True))
        used = [point for point, name in legs.items() if name == node]
        beams = [point for point, (name, _) in campaign.antennas(pair).items() if name == node]
        used += ["sidelink"] if used and len(set(legs.values())) > 1 else []
        if beams or any(any(getattr(arms, point)) for point in used):
            return True
    return False
