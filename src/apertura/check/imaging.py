"""Whether steps will image the pairs: what they refuse once there are echoes, asked of the pulses that logs place."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

from apertura.campaign.config import Flight
from apertura.check.examination import Examination
from apertura.check.times import expected_pulses
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError

if TYPE_CHECKING:
    from apertura.stages.pair import OpenPair
    from apertura.stages.scene import OpenScene

_MOST_PAIRS = 16  # 0.2 s each; what is wrong with others, their own steps say
_MOST_PIXELS = 1_000_000  # of a scene whose heights are read here, 0.5 s; of a larger one by step `terrain`


def check_imaging(examined: Examination) -> Iterator[CampaignError]:
    """Yield what steps `echo`, `scene`, `profile` and `image` will refuse of the first pairs, in their words."""
    from apertura.stages.planning import job_of, ranges_of

    campaign, problems = examined.campaign, list[CampaignError]()
    pairs, scene = _opened(examined, problems)
    yield from problems
    if scene is None:
        return
    # A calibration flight may find paths to be longer than the config says by as much as it searches for.
    search_m = campaign.settings.calibration.search_m if campaign.settings.calibration else 0.0
    for pair in pairs:
        try:
            ranges_of(campaign, replace(pair, path_limits_m=pair.path_limits_m + search_m), scene)
            if pair.beams is not None:
                job_of(campaign, pair, scene)
        except CampaignError as problem:
            yield problem


def check_plan(examined: Examination) -> Iterator[CampaignError]:
    """Yield choices of the config that overrule the planner where it cannot follow: engines, models, sums of pulses."""
    from apertura.stages.planning import accuracy_of, job_of, plan_job

    campaign, problems = examined.campaign, list[CampaignError]()
    if all(value in (None, "auto", {}) for value in campaign.settings.processing.planned.values()):
        return
    pairs, scene = _opened(examined, problems)
    yield from problems
    if scene is not None:  # asked of one pair: the config is one for all
        job, accuracy = job_of(campaign, pairs[0], scene), accuracy_of(campaign, pairs[0], scene)
        plan_job(campaign, job, accuracy_db=float(accuracy.value))


def _opened(examined: Examination, problems: list[CampaignError]) -> tuple[list["OpenPair"], "OpenScene | None"]:
    """Return the first pairs as logs and headers have them, and the scene; add why others are not open.

    Of phase history what is small. No scene where it hangs on a flight of which nothing is open, or on a large DEM.
    """
    from apertura.core.scene.terrain import GridHeights
    from apertura.stages.pair import open_pair
    from apertura.stages.scene import Flown, expected_scene
    from apertura.workflow.stale import without_outdated

    flights = examined.campaign.image_flights
    pairs = ((flight, pair) for flight in flights for pair in flight.pairs if examined.opens(flight.name, pair))
    opened = []
    for flight, pair in islice(pairs, _MOST_PAIRS):
        try:
            opened.append(open_pair(examined.campaign, flight.name, pair, recorded=_recorded(examined, flight, pair)))
        except CampaignError as problem:
            problems.append(problem)
    first = [pair.flown for pair in opened if pair.flight == flights[0].name]
    if not first:
        return opened, None
    scene = expected_scene(without_outdated(examined.campaign), lambda: Flown.together(first))
    if examined.campaign.settings.scene.dem is None:
        return opened, scene
    if scene.grid.shape[0] * scene.grid.shape[1] > _MOST_PIXELS:
        return opened, None
    return opened, replace(scene, terrain=GridHeights(scene.grid, scene.terrain.heights(scene.grid)))


def _recorded(examined: Examination, flight: Flight, pair: str) -> Times | None:
    """Return the tags of pulses that surely found a partner; None of phase history, whose pulses are its own."""
    if examined.waveform is None:
        return None
    tx, rx = (examined.recordings[flight.name, node] for node in pair.split("-"))
    return expected_pulses(tx, rx, examined.waveform.prf_hz)
