"""What a refinement of tracks is given, from an open flight: what each pair saw, how bright, how wrong the logs are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign import Campaign
from apertura.contracts import Window
from apertura.focus.inputs import Profiles
from apertura.focus.tiles import compute_tiles
from apertura.geometry.geodesy import frame_from_map
from apertura.imaging.choices import ImagingChoices
from apertura.imaging.formation import Formation
from apertura.load.pair import OpenPair
from apertura.load.plan import job_of
from apertura.load.refined import clock_s, positions_of
from apertura.load.scene import OpenScene
from apertura.planning.planner import make_plan
from apertura.quality.budget import LEAST_ACCURACY_DB
from apertura.refinement.inputs import ReferencePoint, Sighting, TrackErrors

ASSUMED_STD_M = 0.02
"""Error of positions in each axis where a refinement is asked for and nobody said: that of a fair RTK solution."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What the images of a flight are refined from.

    Attributes
    ----------
    sightings
        One for each pair, by the flight's clock.
    powers
        (y, x) float32, |I|² of each pair's image as the logs have it; 0 where no pulse sees the ground.
    errors
        Node → what is known of the errors of its log.
    points
        Points of the scene whose places are known.
    began
        Zero of the clock, UTC.
    """

    sightings: tuple[Sighting, ...]
    powers: tuple[NDArray[np.float32], ...]
    errors: Mapping[str, TrackErrors]
    points: tuple[ReferencePoint, ...]
    began: np.datetime64


def seen(
    campaign: Campaign,
    pairs: Mapping[OpenPair, Profiles],
    scene: OpenScene,
    *,
    threads: int,
    scheduler: str,
) -> Seen:
    """Return what the images of a flight are refined from; an image of each pair is formed for it.

    Parameters
    ----------
    campaign
        Whose config asks.
    pairs
        Every pair of the flight, as the logs have it, and its range profiles.
    scene
        The campaign's.
    threads, scheduler
        As of `compute_tiles`.
    """
    began = min(pair.began for pair in pairs)
    formations = [_formation(campaign, pair, profiles, scene, threads) for pair, profiles in pairs.items()]
    sightings = [
        Sighting(pair.name, profiles, clock_s(pair, began), pair.sidelink_m, formation.beams)
        for (pair, profiles), formation in zip(pairs.items(), formations, strict=True)
    ]
    powers = [_power(formation, threads, scheduler) for formation in formations]
    points = reference_points(campaign)
    return Seen(tuple(sightings), tuple(powers), stated_errors(list(pairs)), points, began)


def reference_points(campaign: Campaign) -> tuple[ReferencePoint, ...]:
    """Return the points that the config knows the places of, in the frame of the phase centres."""
    asked = campaign.settings.scene
    found = []
    for point in asked.reference_points:
        x, y, z = frame_from_map(asked.crs, *point.position_m).tolist()
        found.append(ReferencePoint(point.name, (x, y, z), point.std_m))
    return tuple(found)


def stated_errors(pairs: Sequence[OpenPair]) -> dict[str, TrackErrors]:
    """Return node → what is known of the errors of its log, or what is taken for it where nobody said."""
    return {
        node: TrackErrors(known.std_m or (ASSUMED_STD_M,) * 3, known.correlation_s)
        for node, known in positions_of(pairs).items()
    }


def _formation(campaign: Campaign, pair: OpenPair, profiles: Profiles, scene: OpenScene, threads: int) -> Formation:
    """Return what forms the image of a pair as cheaply as brightness allows, whatever is asked of the image itself."""
    job = job_of(campaign, replace(pair, history=None), scene, threads=threads)
    plan = make_plan(
        job, accuracy_db=LEAST_ACCURACY_DB, overrides=ImagingChoices().planned, where=f"{pair.flight}/{pair.name}"
    )
    return Formation(pair.history, profiles, scene.grid, plan, campaign.settings.processing.tile_px)


class _Power:
    """Takes the tiles of an image, keeps their power."""

    def __init__(self, shape: tuple[int, int]):
        self.values = np.zeros(shape, np.float32)

    def __setitem__(self, window: Window, tile: NDArray[np.complex64]) -> None:
        """Keep the power of a tile."""
        self.values[window] = np.nan_to_num(tile.real**2 + tile.imag**2)


def _power(formation: Formation, threads: int, scheduler: str) -> NDArray[np.float32]:
    target: Any = _Power(formation.grid.shape)
    compute_tiles(formation.image, formation.windows, target, threads=threads, scheduler=scheduler)
    power: NDArray[np.float32] = target.values
    return power
