"""What a refinement of tracks is given, from an open flight: what each pair saw, how bright, how wrong the logs are."""

from collections.abc import Mapping
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
from apertura.quality.bright_points import bright_pixels
from apertura.quality.budget import LEAST_ACCURACY_DB
from apertura.refinement.inputs import ReferencePoint, Sighting, TrackErrors

ASSUMED_STD_M = 0.02
"""Error of positions in each axis where a refinement is asked for and nobody said: that of a fair RTK solution."""


MOST_PLACES = 512
_DEEPEST_DB = -40.0
_APART_PX = 8


@dataclass(frozen=True, eq=False)
class Seen:
    """What the images of a flight are refined from.

    Attributes
    ----------
    sightings
        One for each pair, by the flight's clock.
    places_m
        (place, 3) float64, metres in the frame of the phase centres: where images from the logs are bright, most so
        first.
    errors
        Node → what is known of the errors of its log.
    points
        Points of the scene whose places are known.
    began
        Zero of the clock, UTC.
    """

    sightings: tuple[Sighting, ...]
    places_m: NDArray[np.float64]
    errors: Mapping[str, TrackErrors]
    points: tuple[ReferencePoint, ...]
    began: np.datetime64


def seen(campaign: Campaign, pairs: Mapping[OpenPair, Profiles], scene: OpenScene, *, threads: int) -> Seen:
    """Return what the images of a flight are refined from; an image of each pair is formed for it, one after the other.

    Parameters
    ----------
    campaign
        Whose config asks.
    pairs
        Every pair of the flight, as the logs have it, and its range profiles.
    scene
        The campaign's.
    threads
        Tiles formed at once.
    """
    began, sightings = min(pair.began for pair in pairs), []
    power = np.zeros(scene.grid.shape, np.float32)
    for pair, profiles in pairs.items():
        formation = _formation(campaign, pair, profiles, scene, threads)
        own = _power(formation, campaign.settings.processing.scheduler, threads)
        power += own / max(float(np.median(own[own > 0])) if own.any() else 0.0, 1e-30)  # each against its own speckle
        sightings.append(Sighting(pair.name, profiles, clock_s(pair, began), pair.sidelink_m, formation.beams))
    errors = {
        node: TrackErrors(known.std_m or (ASSUMED_STD_M,) * 3, known.correlation_s)
        for node, known in positions_of(list(pairs)).items()
    }
    return Seen(tuple(sightings), bright_places(power, scene), errors, reference_points(campaign), began)


def bright_places(power: NDArray[np.float32], scene: OpenScene) -> NDArray[np.float64]:
    """Return the brightest places of a scene that stand apart, (place, 3) float64 metres, the brightest first.

    Parameters
    ----------
    power
        (y, x) float32.
    scene
        Whose grid it is.
    """
    magnitude, whole = np.sqrt(power), (slice(0, power.shape[0]), slice(0, power.shape[1]))
    found = bright_pixels(magnitude, [whole], apart_px=_APART_PX, most=MOST_PLACES, deepest_db=_DEEPEST_DB)
    return scene.terrain.positions_at(scene.grid, *found.T)


def reference_points(campaign: Campaign) -> tuple[ReferencePoint, ...]:
    """Return the points that the config knows the places of, in the frame of the phase centres."""
    asked = campaign.settings.scene
    found = []
    for point in asked.reference_points:
        x, y, z = frame_from_map(asked.crs, *point.position_m).tolist()
        found.append(ReferencePoint(point.name, (x, y, z), point.std_m))
    return tuple(found)


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


def _power(formation: Formation, scheduler: str, threads: int) -> NDArray[np.float32]:
    target: Any = _Power(formation.grid.shape)
    compute_tiles(formation.image, formation.windows, target, threads=threads, scheduler=scheduler)
    power: NDArray[np.float32] = target.values
    return power
