"""Inputs of a refinement of tracks from an open flight: profiles of each pair, errors of the logs."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from apertura.core.focus.inputs import Profiles
from apertura.core.geometry.geodesy import frame_from_map
from apertura.methods.autofocus.inputs import PairRecord, ReferencePoint, TrackErrors
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.opening.autofocus import clock_s, errors_of
from apertura.pipeline.opening.pair import OpenPair
from apertura.pipeline.opening.plan import weighing
from apertura.pipeline.opening.scene import OpenScene


@dataclass(frozen=True, eq=False)
class RefinementInputs:
    """Inputs of the refinement of a flight's tracks.

    Attributes
    ----------
    records
        One for each pair, by the flight's clock.
    errors
        Node → error statistics of its log.
    points
        Points of the scene whose places are known.
    began
        Zero of the clock, UTC.
    """

    records: tuple[PairRecord, ...]
    errors: Mapping[str, TrackErrors]
    points: tuple[ReferencePoint, ...]
    began: np.datetime64


def refinement_inputs(campaign: Campaign, pairs: Mapping[OpenPair, Profiles], scene: OpenScene) -> RefinementInputs:
    """Return the inputs of the refinement of a flight's tracks.

    Parameters
    ----------
    campaign
        With its settings.
    pairs
        Every pair of the flight, as the logs have it, and its range profiles.
    scene
        The campaign's.
    """
    began = min(pair.began for pair in pairs)
    records = [
        PairRecord(pair.name, profiles, clock_s(pair, began), pair.sidelink_m, weighing(campaign, pair, scene))
        for pair, profiles in pairs.items()
    ]
    return RefinementInputs(tuple(records), errors_of(list(pairs)), reference_points(campaign), began)


def reference_points(campaign: Campaign) -> tuple[ReferencePoint, ...]:
    """Return the reference points of the config, in the frame of the phase centres."""
    requested, points = campaign.settings.scene, []
    for point in requested.reference_points:
        x, y, z = frame_from_map(requested.crs, *point.position_m).tolist()
        points.append(ReferencePoint(point.name, (x, y, z), point.std_m))
    return tuple(points)
