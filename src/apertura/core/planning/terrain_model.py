"""The simplest model of the ground that keeps focus and place: a plane, a tilted plane, or the DEM."""

import numpy as np

from apertura.common.errors import CampaignError
from apertura.core.focus.job import Job
from apertura.core.planning.checks import vertical
from apertura.core.planning.plan import Decision
from apertura.core.scene.terrain import FlatGround

FOCUS_RAD = 0.4
SHIFT_PIXELS = 0.5


def decide_terrain(job: Job, *, asked: str | None = None, where: str = "processing") -> Decision:
    """Decide whether a plane, a tilted plane or the DEM stands for the ground.

    Parameters
    ----------
    job
        What is to be imaged.
    asked
        What a person asks for; None: the rule decides.
    where
        Section of the config that asks, for messages.

    Raises
    ------
    CampaignError
        If a DEM's model is asked for and there is none.

    Notes
    -----
    Source: docs/theory/planner.md, "Terrain": a height that is wrong by δh turns the look angle by δh over the ground
    range and shifts the pixel by δh·H over it.
    """
    chosen = _by_rule(job)
    if asked is None or asked == chosen.value:
        return chosen
    if isinstance(job.terrain.full, FlatGround):
        raise CampaignError(
            f"terrain is {asked}",
            where=f"{where}.terrain",
            expected="plane or auto: the scene has no DEM",
            remedy="Name a DEM in scene.dem, or leave terrain to the planner.",
        )
    return Decision("terrain", asked, f"asked for; the rule says {chosen.value}: {chosen.reason}")


def _by_rule(job: Job) -> Decision:
    (limit_m, rule), ground = _tolerance(job), job.terrain
    if isinstance(ground.full, FlatGround):
        return Decision("terrain", "plane", f"no DEM; height may be wrong by {limit_m:.3g} m: {rule}")
    if ground.relief_m < limit_m:
        return Decision("terrain", "plane", f"relief {ground.relief_m:.3g} m; {rule}")
    off_plane = f"relief {ground.relief_m:.3g} m, {ground.off_plane_m:.3g} m off a tilted plane; {rule}"
    return Decision("terrain", "tilted_plane" if ground.off_plane_m < limit_m else "dem", off_plane)


def _tolerance(job: Job) -> tuple[float, str]:
    """Return how far heights may be wrong, metres, and why."""
    apart = job.aperture.middle_m[job.aperture.sample(64)][:, None] - job.points_m
    above = apart @ vertical(job.ground_m)
    ground = np.sqrt(np.maximum((apart**2).sum(-1) - above**2, 1e-6))
    nearest, steepest = float(ground.min()), float((np.abs(above) / ground).max())
    wobble_m = job.aperture.wobble_m
    focus_m = FOCUS_RAD * job.wavelength_m * nearest / (4 * np.pi * max(wobble_m, 1e-9))
    shift_m = SHIFT_PIXELS * job.spacing_m / max(steepest, 1e-9)
    return min(focus_m, shift_m), (
        f"wobble {wobble_m:.3f} m rms and ground range from {nearest:.1f} m bear {focus_m:.3g} m (0.4 rad), "
        f"half a pixel of shift {shift_m:.3g} m"
    )
