"""The simplest model of the ground that keeps focus and place: a plane, a tilted plane, or the DEM."""

import numpy as np
from numpy.typing import NDArray

from apertura.errors import CampaignError
from apertura.focus.job import Job
from apertura.planning.checks import vertical
from apertura.planning.plan import Decision

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
    if job.heights_m is None:
        raise CampaignError(
            f"terrain is {asked}",
            where=f"{where}.terrain",
            expected="plane or auto: the scene has no DEM",
            remedy="Name a DEM in scene.dem, or leave terrain to the planner.",
        )
    return Decision("terrain", asked, f"asked for in the config; the rule says {chosen.value}: {chosen.reason}")


def _by_rule(job: Job) -> Decision:
    limit_m, rule = _tolerance(job)
    if job.heights_m is None:
        return Decision("terrain", "plane", f"no DEM; height may be wrong by {limit_m:.3g} m: {rule}")
    relief_m = float(np.abs(job.heights_m).max())
    if relief_m < limit_m:
        return Decision("terrain", "plane", f"relief {relief_m:.3g} m; {rule}")
    rest_m = float(np.abs(job.heights_m - plane_through(job.heights_m)).max())
    value = "tilted_plane" if rest_m < limit_m else "dem"
    return Decision("terrain", value, f"relief {relief_m:.3g} m, {rest_m:.3g} m off a tilted plane; {rule}")


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


def plane_through(heights_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the least-squares plane through heights (row, column), metres, at the same points.

    Examples
    --------
    >>> tilted = np.arange(4.0)[:, None] + 2 * np.arange(3.0)
    >>> bool(np.allclose(plane_through(tilted), tilted))
    True
    """
    row, column = np.indices(heights_m.shape)
    basis = np.stack([np.ones(heights_m.size), row.ravel(), column.ravel()], -1)
    fitted = basis @ np.linalg.lstsq(basis, heights_m.ravel(), rcond=None)[0]
    return np.asarray(fitted.reshape(heights_m.shape))


def tilt(heights_m: NDArray[np.float64], step_px: int) -> tuple[float, float, float]:
    """Return the plane through heights of blocks of pixels: height at pixel (0, 0), per row and per column, metres."""
    plane = plane_through(heights_m)
    down, right = (
        float(np.diff(plane[:2, :2], axis=axis)[0, 0]) / step_px if plane.shape[axis] > 1 else 0.0 for axis in (0, 1)
    )
    return (float(plane[0, 0]) - (down + right) * (step_px - 1) / 2, down, right)
