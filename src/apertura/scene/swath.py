"""Total paths from each pulse to the scene, bounded by blocks of pixels."""

import numpy as np
from numpy.typing import NDArray

from apertura.geometry.aperture import Aperture
from apertura.scene.grid import SceneGrid
from apertura.scene.terrain import Terrain

_BLOCKS = 33
_PULSES_AT_ONCE = 256


def swath(grid: SceneGrid, terrain: Terrain, aperture: Aperture) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the shortest and longest total path from each pulse to the scene.

    At most 33 × 33 blocks of pixels, each a point and a radius that holds its pixels at all their heights; the
    total path changes by at most twice the radius.

    Parameters
    ----------
    grid, terrain
        The scene and its ground.
    aperture
        In the grid's processing frame.

    Returns
    -------
    tuple of ndarray
        (pulse,) float64 metres each; never longer, never shorter than any pixel's path.

    Examples
    --------
    >>> from apertura.scene.terrain import FlatGround
    >>> grid = SceneGrid("local", 0.0, 10.0, 1.0, (10, 10))
    >>> near, far = swath(grid, FlatGround(0.0), Aperture(*2 * [np.array([[-20.0, 5.0, 0.0]])]))
    >>> bool(near[0] <= 41.02), bool(far[0] >= 59.0)
    (True, True)
    """
    middle_m, radius_m = _balls(grid, terrain)
    nearest, farthest = np.empty((2, len(aperture)))
    for first in range(0, len(aperture), _PULSES_AT_ONCE):
        pulses = slice(first, first + _PULSES_AT_ONCE)
        path = aperture[pulses].path(middle_m)
        nearest[pulses], farthest[pulses] = (path - 2 * radius_m).min(axis=1), (path + 2 * radius_m).max(axis=1)
    return nearest, farthest


def _balls(grid: SceneGrid, terrain: Terrain) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return middles (block, 3) and radii (block,), metres, of balls that hold the pixels of the scene."""
    blocks = list(grid.tiles(-(-max(grid.shape) // _BLOCKS)))
    centre = np.array([[(part.start + part.stop - 1) / 2 for part in block] for block in blocks])
    half_m = np.array([[(part.stop - part.start - 1) / 2 * grid.spacing_m for part in block] for block in blocks])
    low, high = np.array([[(height := terrain.heights(grid[block])).min(), height.max()] for block in blocks]).T
    middle_m = grid.positions_at(centre[:, 0], centre[:, 1], (low + high) / 2)
    return middle_m, np.sqrt((half_m**2).sum(axis=1) + ((high - low) / 2) ** 2)
