"""Whether what was recorded belongs to the scene asked for, before anything is planned."""

import numpy as np

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.focus.inputs import PhaseHistory, Profiles
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.planning.checks import check_positions
from apertura.core.scene.clearance import check_antennas
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.map_crs import check_crs
from apertura.core.scene.terrain import Terrain

_POINTS = 9
_PULSES = 256


def check_inputs(inputs: PhaseHistory | Profiles, grid: SceneGrid, terrain: Terrain) -> dict[str, str]:
    """Return flags: limit that the inputs exceed on a scene → what was found, in one line.

    Parameters
    ----------
    inputs
        Phase history or profiles, their phase centres in the frame of the pixels.
    grid, terrain
        The scene.

    Raises
    ------
    CampaignError
        If the grid's CRS is not one for a scene, a position, sample or height is not finite, an antenna is in the
        ground, all samples are zero, or the scene lies where the inputs hold no echo.
    """
    if grid.crs != LOCAL:
        check_crs(grid.crs, grid.bounds_m)
    check_positions(inputs.aperture)
    _check_samples(inputs)
    points = terrain.positions_at(grid, *grid.sample_pixels(_POINTS)).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise CampaignError(
            "heights of the terrain are not finite",
            where="backproject: terrain",
            expected="a height in metres at every pixel",
            remedy="Fill its voids, or make the grid smaller.",
        )
    outside = _outside(inputs, points)
    if outside == 1:
        raise CampaignError(
            "no echo of the scene is in the samples: its total paths lie beyond them at every pulse",
            where="backproject: grid",
            expected="phase centres and pixels in one frame, in metres, within the range that was recorded",
            remedy="Check the grid's CRS and corner, the terrain's height, and the frame of the positions.",
        )
    flags = check_antennas(grid, terrain, inputs.aperture, where="backproject")
    if outside:
        flags["scene_beyond_samples"] = f"{100 * outside:.1f} % of the scene's total paths lie beyond the samples"
    return flags


def _check_samples(inputs: PhaseHistory | Profiles) -> None:
    samples = inputs.transfer if isinstance(inputs, PhaseHistory) else inputs.samples
    lost = np.array([not np.isfinite(row).all() for row in samples])
    if lost.any() or not any(row.any() for row in samples):
        raise CampaignError(
            f"samples of {int(lost.sum())} of {len(lost)} pulses are not finite, first at pulse {int(lost.argmax())}"
            if lost.any()
            else "all samples are zero",
            where="backproject",
            expected="finite samples that hold an echo",
            remedy="Leave such pulses out.",
        )


def _outside(inputs: PhaseHistory | Profiles, points: np.ndarray) -> float:
    """Return the share of total paths, from some pulses to some points, that lie beyond the samples.

    A phase history repeats itself every c/Δf; beyond that to either side of its reference a scene is taken for wrong.
    """
    some = inputs[inputs.aperture.sample(_PULSES)]
    path = some.aperture.path(points)
    if isinstance(some, PhaseHistory):
        unambiguous_m = SPEED_OF_LIGHT_M_S / float(np.abs(np.diff(some.frequency_hz)).mean())
        return float((np.abs(path - SPEED_OF_LIGHT_M_S * some.reference_delay_s[:, None]) > unambiguous_m).mean())
    place = (path - some.start_m[:, None]) / some.step_m
    return float(((place < 0) | (place > some.samples.shape[1] - 1)).mean())
