"""Clearance of antennas above the terrain, and errors for impossible heights."""

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
    """Return the height of each phase centre above the pixel below it, and the terrain height of this pixel.

    Parameters
    ----------
    grid, terrain
        Grid and terrain of the scene.
    antenna
        (pulse, 3) float64, phase centres, metres, in the processing frame of the grid.

    Returns
    -------
    tuple of ndarray
        (pulse,) float64 each, metres. Outside the scene, a flat terrain is extrapolated, and heights over a DEM are
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
    """Reject antennas that are not above the terrain; return a flag for antennas below the lowest terrain of a DEM.

    Parameters
    ----------
    grid, terrain
        Grid and terrain of the scene.
    aperture
        Aperture in the processing frame of the grid.
    where
        Flight and pair, for error messages.

    Returns
    -------
    dict
        Flag → measured values, one line. An antenna below the scene is not an error, because a radar outside the scene
        may image a hillside above the radar.

    Raises
    ------
    CampaignError
        If an antenna is not above the terrain at its map position; the message contains the source of the terrain
        height.
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
        f"{which} is at or below the terrain of the scene, worst at pulse {pulse}: clearance {above[pulse]:.2f} m, "
        f"antenna height {above[pulse] + ground[pulse]:.2f} m, {'terrain' if flat else 'DEM'} height "
        f"{ground[pulse]:.2f} m",
        where="scene.height_m" if flat else "scene.dem",
        expected="an antenna above the terrain",
        remedy=f"Check {keys}, and the heights in the flight log, which may refer to the geoid.",
    )


def _below_scene(grid: SceneGrid, terrain: Terrain, antenna: NDArray[np.float64], which: str) -> dict[str, str]:
    below_m = float(np.nanmin(terrain.heights(grid.coarse(_BLOCKS))) - grid.pixel_below(antenna)[:, 2].min())
    if not below_m >= 0:
        return {}
    return {
        "platform_below_scene": f"the {which} is {below_m:.1f} m below the lowest terrain of the scene: check the unit "
        "and the datum of the DEM, unless the radar images a hillside above the radar"
    }
