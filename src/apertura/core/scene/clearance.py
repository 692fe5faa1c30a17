"""Clearance of antennas above the ground, and errors for impossible heights."""

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError, number_of
from apertura.common.flags import Flags
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, Terrain

_BLOCKS = 33


def clearance(
    grid: SceneGrid, terrain: Terrain, antenna: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the height of each phase centre above the pixel under it, and the height of that pixel.

    Parameters
    ----------
    grid, terrain
        The scene and its ground.
    antenna
        (pulse, 3) float64 phase centres, metres, in the grid's processing frame.

    Returns
    -------
    tuple of ndarray
        (pulse,) float64 metres each. Beside the scene flat ground is continued; beside a DEM the height is unknown:
        NaN.

    Examples
    --------
    >>> grid = SceneGrid("local", 0.0, 10.0, 1.0, (10, 10))
    >>> clearance(grid, FlatGround(3.0), np.array([[5.0, 5.0, 7.0], [-20.0, 5.0, 7.0]]))
    (array([4., 4.]), array([3., 3.]))
    """
    row, column, height = np.moveaxis(grid.pixel_below(antenna), -1, 0)
    ground = terrain.heights_at(grid, np.rint(row), np.rint(column))
    return height - ground, ground


def check_antennas(grid: SceneGrid, terrain: Terrain, aperture: Aperture, *, where: str) -> dict[str, str]:
    """Refuse antennas that are not above the ground; return a flag for those that are lower than a DEM beside them.

    Parameters
    ----------
    grid, terrain
        The scene and its ground.
    aperture
        In the grid's processing frame.
    where
        Flight and pair.

    Returns
    -------
    dict
        Name of the flag → what was measured, in one line: from beside a DEM a radar may image a hillside above it.

    Raises
    ------
    CampaignError
        If an antenna is in or below the ground under it; it names the source of the ground's height.
    """
    flags = Flags()
    for antenna, which in zip(aperture.legs, ("transmitter", "receiver"), strict=True):
        above, ground = clearance(grid, terrain, antenna)
        if (above <= 0).any():
            raise _below_ground(
                above, ground, f"{where}: at {number_of(int((above <= 0).sum()), 'pulse')} the {which}", terrain
            )
        if not isinstance(terrain, FlatGround):
            flags = Flags.merged(flags, _below_scene(grid, terrain, antenna, which))
    return flags


def _below_ground(
    above: NDArray[np.float64], ground: NDArray[np.float64], which: str, terrain: Terrain
) -> CampaignError:
    flat, pulse = isinstance(terrain, FlatGround), int(np.nanargmin(above))
    keys = "scene.height_m and scene.height_datum" if flat else "scene.dem (metres, not feet) and scene.dem_datum"
    return CampaignError(
        f"{which} is in or below the ground of the scene, worst at pulse {pulse}: {above[pulse]:.2f} m above it, its "
        f"height {above[pulse] + ground[pulse]:.2f} m where {'the ground' if flat else 'the DEM'} has "
        f"{ground[pulse]:.2f} m",
        where="scene.height_m" if flat else "scene.dem",
        expected="an antenna above the ground",
        remedy=f"Check {keys}, and the heights in the flight log (logs may count from the geoid).",
    )


def _below_scene(grid: SceneGrid, terrain: Terrain, antenna: NDArray[np.float64], which: str) -> dict[str, str]:
    below_m = float(np.nanmin(terrain.heights(grid.coarse(_BLOCKS))) - grid.pixel_below(antenna)[:, 2].min())
    if not below_m >= 0:
        return {}
    return {
        "platform_below_scene": f"the {which} is {below_m:.1f} m below the lowest ground of the scene: check the unit "
        "and the datum of the DEM, unless the radar looks up a hillside"
    }
