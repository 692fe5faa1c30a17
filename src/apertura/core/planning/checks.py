"""Limits of imaging: what a job may not do, and what it may but a person should be told about."""

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.focus.job import Job
from apertura.core.geometry.aperture import Aperture


def check_geometry(job: Job) -> dict[str, str]:
    """Return flags: limit of imaging that the job exceeds → what was found, in one line.

    Parameters
    ----------
    job
        What is to be imaged.

    Raises
    ------
    CampaignError
        If there is no pulse, a position is not finite, or no echo of the scene arrives inside the prefix.
    """
    aperture, ground_m = job.aperture, job.ground_m
    check_positions(aperture)
    up = vertical(ground_m)
    flags: dict[str, str] = {}
    over = np.zeros(len(aperture), bool)
    for leg in aperture.legs:
        over |= _over(leg, ground_m, up, job.spacing_m)
    if over.any():
        flags["platform_inside_scene"] = (
            f"{int(over.sum())} of {len(aperture)} pulses are sent or received above the scene: echoes from both sides "
            "mix"
        )
    weigh = None if job.sector is None else job.sector.over(aperture)
    cell_m = aperture.resolution_cell_m(ground_m, band_hz=job.band_hz, weigh=weigh)
    if job.spacing_m > cell_m:
        flags["spacing_coarse"] = (
            f"spacing {job.spacing_m:g} m, finest resolution cell {cell_m:.3g} m: targets fall between"
        )
    spread, _ = aperture.phase_rates(job.points_m, wavelength_m=SPEED_OF_LIGHT_M_S / job.band_hz[1])
    if spread > 1:
        flags["pulses_sparse"] = f"phase rates over the scene spread {spread:.2f} cycles per pulse, 1 is unambiguous"
    unseen = _unseen(aperture, job.points_m, job.path_limit_m)
    if unseen:
        flags["beyond_cyclic_prefix"] = (
            f"{100 * unseen:.0f} % of the scene arrives too late for all captures: after the cyclic prefix, or listen_s"
        )
    return flags


def check_positions(aperture: Aperture) -> None:
    """Raise CampaignError unless there is a pulse and each has finite phase centres."""
    if len(aperture) == 0:
        raise CampaignError(
            "zero pulses", where="echo", expected="at least one", remedy="Check the triggers and the sidelink."
        )
    lost = np.asarray(~np.isfinite(np.hstack(aperture.legs)).all(axis=1))
    if lost.any():
        raise CampaignError(
            f"{int(lost.sum())} of {len(lost)} phase centres are not finite, first at pulse {int(lost.argmax())}",
            where="track",
            expected="a position for every pulse",
            remedy="Correct the flight log.",
        )


def _over(
    position_m: NDArray[np.float64], ground_m: NDArray[np.float64], up: NDArray[np.float64], spacing_m: float
) -> NDArray[np.bool_]:
    """Return which pulses are above the scene."""
    corner, over = ground_m[0, 0], np.ones(len(position_m), bool)
    right, down = ground_m[0, -1] - corner, ground_m[-1, 0] - corner
    lengths = [float(np.linalg.norm(side)) for side in (right, down)]
    if not lengths[1]:  # one row or column is as wide as a pixel
        down = np.cross(right if lengths[0] else np.eye(3)[np.abs(up).argmin()], up)
    if not lengths[0]:
        right = np.cross(down, up)
    for side, length in zip((right, down), lengths, strict=True):
        along = (position_m - corner) @ side / np.linalg.norm(side)
        over &= np.abs(along - length / 2) <= (length + spacing_m) / 2
    return over


def _unseen(aperture: Aperture, points_m: NDArray[np.float64], path_limit_m: float) -> float:
    if not np.isfinite(path_limit_m):
        return 0.0
    shortest = aperture[aperture.sample(256)].path(points_m).min(axis=0)
    beyond = shortest > path_limit_m
    if beyond.all():
        raise CampaignError(
            f"zero pulses see the scene: the shortest total path is {shortest.min():.1f} m",
            where="scene.bounds_m",
            expected=f"at most {path_limit_m:.1f} m, the cyclic prefix",
            remedy="Correct scene.bounds_m (easting before northing), scene.crs, or the height of the ground: "
            "scene.height_m, or unit and datum of scene.dem.",
        )
    return float(beyond.mean())


def vertical(ground_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit normal of ground points (row, column, 3) whose rows go south and columns east.

    Examples
    --------
    >>> east, south = np.meshgrid(np.arange(3.0), np.arange(2.0))
    >>> vertical(np.stack([east, -south, 0 * east], -1))
    array([0., 0., 1.])
    """
    if min(ground_m.shape[:2]) < 2:
        first = ground_m[0, 0]
        return np.asarray(first / np.linalg.norm(first)) if np.linalg.norm(first) > 6e6 else np.array([0.0, 0.0, 1.0])
    normal = np.cross(ground_m[0, -1] - ground_m[0, 0], ground_m[0, 0] - ground_m[-1, 0])
    return np.asarray(normal / np.linalg.norm(normal))
