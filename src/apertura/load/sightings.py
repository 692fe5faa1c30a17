"""What a refinement of tracks is given, from an open flight: what each pair saw, and how wrong the logs are."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from apertura.campaign import Campaign
from apertura.focus.inputs import Profiles
from apertura.geometry.geodesy import frame_from_map
from apertura.load.pair import OpenPair
from apertura.load.plan import weighing
from apertura.load.refined import clock_s, positions_of
from apertura.load.scene import OpenScene
from apertura.refinement.inputs import ReferencePoint, Sighting, TrackErrors

ASSUMED_STD_M = 0.02
"""Error of positions in each axis where a refinement is asked for and nobody said: that of a fair RTK solution."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What the tracks of a flight are refined from.

    Attributes
    ----------
    sightings
        One for each pair, by the flight's clock.
    errors
        Node → what is known of the errors of its log.
    points
        Points of the scene whose places are known.
    began
        Zero of the clock, UTC.
    """

    sightings: tuple[Sighting, ...]
    errors: Mapping[str, TrackErrors]
    points: tuple[ReferencePoint, ...]
    began: np.datetime64


def seen(campaign: Campaign, pairs: Mapping[OpenPair, Profiles], scene: OpenScene) -> Seen:
    """Return what the tracks of a flight are refined from.

    Parameters
    ----------
    campaign
        Whose config asks.
    pairs
        Every pair of the flight, as the logs have it, and its range profiles.
    scene
        The campaign's.
    """
    began = min(pair.began for pair in pairs)
    sightings = [
        Sighting(pair.name, profiles, clock_s(pair, began), pair.sidelink_m, weighing(campaign, pair, scene))
        for pair, profiles in pairs.items()
    ]
    errors = {
        node: TrackErrors(known.std_m or (ASSUMED_STD_M,) * 3, known.correlation_s, known.drift_m)
        for node, known in positions_of(list(pairs)).items()
    }
    return Seen(tuple(sightings), errors, reference_points(campaign), began)


def reference_points(campaign: Campaign) -> tuple[ReferencePoint, ...]:
    """Return the points that the config knows the places of, in the frame of the phase centres."""
    asked, found = campaign.settings.scene, []
    for point in asked.reference_points:
        x, y, z = frame_from_map(asked.crs, *point.position_m).tolist()
        found.append(ReferencePoint(point.name, (x, y, z), point.std_m))
    return tuple(found)
