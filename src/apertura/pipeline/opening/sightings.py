"""What a refinement of tracks is given, from an open flight: what each pair saw, and how wrong the logs are."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from apertura.core.focus.inputs import Profiles
from apertura.core.geometry.geodesy import frame_from_map
from apertura.methods.autofocus.inputs import ReferencePoint, Sighting, TrackErrors
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.opening.autofocus import clock_s, errors_of
from apertura.pipeline.opening.pair import OpenPair
from apertura.pipeline.opening.plan import weighing
from apertura.pipeline.opening.scene import OpenScene


@dataclass(frozen=True, eq=False)
class RefinementInputs:
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


def seen(campaign: Campaign, pairs: Mapping[OpenPair, Profiles], scene: OpenScene) -> RefinementInputs:
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
    return RefinementInputs(tuple(sightings), errors_of(list(pairs)), reference_points(campaign), began)


def reference_points(campaign: Campaign) -> tuple[ReferencePoint, ...]:
    """Return the points that the config knows the places of, in the frame of the phase centres."""
    asked, found = campaign.settings.scene, []
    for point in asked.reference_points:
        x, y, z = frame_from_map(asked.crs, *point.position_m).tolist()
        found.append(ReferencePoint(point.name, (x, y, z), point.std_m))
    return tuple(found)
