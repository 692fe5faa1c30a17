"""Whether the nodes fly above the ground of the scene, and near it."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.core.scene.clearance import clearance
from apertura.core.scene.terrain import FlatGround, Terrain
from apertura.pipeline.check.inspected import Inspected
from apertura.pipeline.check.places import pair_aperture
from apertura.pipeline.config import CONFIG

HIGHEST_M = 30e3
"""Above the ground of the scene no node flies higher."""


def check_ground(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield image flights of which a node is below the ground at most of its pulses, or higher than 30 km above it."""
    waveform, grid, ground = inspected.waveform, inspected.grid, inspected.ground
    if waveform is None or grid is None or ground is None:
        return
    terrain: Terrain = ground.dem or FlatGround(inspected.level_m)
    for flight in inspected.campaign.image_flights:
        places: dict[str, NDArray[np.float64]] = {}
        for node in flight.nodes:
            aperture = pair_aperture(inspected, flight, node, waveform)
            places |= dict(zip((flight.transmitter, node), aperture.legs, strict=True)) if aperture else {}
        wrong = {}
        for node, positions in places.items():
            above, below = clearance(grid, terrain, positions)
            known = np.isfinite(above)
            arms = inspected.campaign.settings.nodes[node].lever_arms_m
            arm_m = float(np.linalg.norm([arms.radar_tx, arms.radar_rx, arms.sidelink], axis=1).max())
            if known.any() and not -arm_m < np.median(above[known]) <= HIGHEST_M:
                wrong[node] = (float(np.median(above[known])), float(np.median(below[known])))
        if wrong:
            yield _problem(flight.name, wrong, dem=ground.dem is not None)


def _problem(flight: str, wrong: dict[str, tuple[float, float]], *, dem: bool) -> CampaignError:
    key, said = ("scene.dem", "DEM") if dem else ("scene.height_m", "ground")
    check = "scene.dem (metres, not feet) and scene.dem_datum" if dem else "scene.height_m and scene.height_datum"
    above_m, ground_m = next(iter(wrong.values()))
    return CampaignError(
        f"flight {flight}, {', '.join(wrong)}: {above_m:.1f} m above the ground of the scene at the median of its "
        f"pulses, the log has {above_m + ground_m:.1f} m where the {said} has {ground_m:.1f} m",
        where=f"{CONFIG}: {key}",
        expected=f"a node above the ground, by at most {HIGHEST_M / 1e3:.0f} km",
        remedy=f"Check {check}, and the heights in the flight log (logs may count from the geoid).",
    )
