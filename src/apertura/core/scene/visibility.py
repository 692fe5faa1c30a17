"""How the scene is seen: incidence, bistatic angle, and where terrain casts shadow or is laid over."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.sightlines import BLOCK, mark_layover, mark_shadow
from apertura.core.scene.terrain import Terrain

EARTH_RADIUS_M = 6371e3

_STRIP = 256  # rows of heights read at once

Floats = NDArray[np.float64]


def surface_normals(position: Floats) -> Floats:
    """Return the unit normals, upward, of a surface given at pixels.

    Parameters
    ----------
    position
        (row, column, 3) float64 metres, rows southward and columns eastward, at least 2 × 2.

    Returns
    -------
    ndarray
        (row, column, 3) float64; central differences, one-sided at the edges.

    Examples
    --------
    >>> east, north = np.meshgrid(np.arange(3.0), -np.arange(3.0))
    >>> surface_normals(np.stack([east, north, east], -1))[1, 1].round(4)
    array([-0.7071,  0.    ,  0.7071])
    """
    normal = np.cross(np.gradient(position, axis=0), np.gradient(position, axis=1))
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def incidence_deg(position: Floats, normal: Floats, antenna: Floats) -> Floats:
    """Return the angle between the way to an antenna and the surface normal.

    Parameters
    ----------
    position, normal
        (..., 3) float64, metres and unit vectors, of one frame.
    antenna
        (3,) float64, metres.

    Returns
    -------
    ndarray
        (...) float64 degrees, above 90 where the surface faces away.

    Examples
    --------
    >>> incidence_deg(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([5.0, 0.0, 5.0])).round(6).item()
    45.0
    """
    return np.degrees(_angle(antenna - position, normal))


def bistatic_angle_deg(position: Floats, tx: Floats, rx: Floats) -> Floats:
    """Return the angle (degrees) at each position (..., 3) between the ways to two antennas (3,), metres.

    Examples
    --------
    >>> bistatic_angle_deg(np.zeros(3), np.array([1.0, 0.0, 1.0]), np.array([-2.0, 0.0, 2.0])).round(6).item()
    90.0
    """
    return np.degrees(_angle(tx - position, rx - position))


def _angle(one: Floats, other: Floats) -> Floats:
    across = np.linalg.norm(np.cross(one, other), axis=-1)
    return np.asarray(np.arctan2(across, (one * other).sum(-1)))


@dataclass(frozen=True)
class Relief:
    """The heights of a whole scene, ready to be walked over.

    Attributes
    ----------
    grid, base_m
        The scene, and the height that the others count from.
    height_m
        (row, column) float32, metres above `base_m`.
    highest_m
        (block row, block column) float32: highest ground of each block of 16 × 16 pixels and one pixel around it.
    lowest_m
        Lowest ground.
    """

    grid: SceneGrid
    base_m: float
    height_m: NDArray[np.float32]
    highest_m: NDArray[np.float32]
    lowest_m: float

    @classmethod
    def of(cls, grid: SceneGrid, terrain: Terrain, base_m: float) -> "Relief":
        """Return the relief of a scene above a height (m) amid its ground: float32 then holds it to micrometres."""
        relative = np.empty(grid.shape, np.float32)
        for row in range(0, grid.shape[0], _STRIP):
            strip = (slice(row, min(row + _STRIP, grid.shape[0])), slice(0, grid.shape[1]))
            relative[strip] = terrain.heights(grid[strip]) - base_m
        rows, columns = (-(-size // BLOCK) for size in grid.shape)
        highest = np.empty((rows, columns), np.float32)
        for row in range(rows):
            strip_top = relative[max(0, row * BLOCK - 1) : (row + 1) * BLOCK + 1].max(axis=0)
            for column in range(columns):
                highest[row, column] = strip_top[max(0, column * BLOCK - 1) : (column + 1) * BLOCK + 1].max()
        return cls(grid, base_m, relative, highest, float(relative.min()))

    @property
    def curvature_per_m(self) -> float:
        """1/2R: how fast the ground falls below a horizontal line, times distance squared; 0 in a local frame."""
        return 0.0 if self.grid.crs == LOCAL else 0.5 / EARTH_RADIUS_M

    def above(self, antenna: Floats) -> Floats:
        """Return (pulse, 3) float64 row, column (fractional) and height above `base_m` (m) of phase centres.

        Parameters
        ----------
        antenna
            (pulse, 3) float64 metres, in the grid's processing frame.
        """
        return self.grid.pixel_below(antenna) - [0.0, 0.0, self.base_m]


def visibility(relief: Relief, tx: Floats, rx: Floats, window: Window) -> NDArray[np.uint8]:
    """Return where one pair sees the ground of a window in shadow or in layover.

    Shadow: at more than half of the pulses given the straight line to the transmitter or to the receiver runs through
    ground of the scene. Layover: at the pulse with the shortest total path, the path does not grow along the line of
    sight from all ground before the pixel to all behind, so that another place shares its range. Ground outside the
    scene hides nothing and is not laid over.

    Parameters
    ----------
    relief
        Of the whole scene.
    tx, rx
        (pulse, 3) float64 from `Relief.above`: some pulses, evenly spread over the aperture.
    window
        Rows and columns asked for.

    Returns
    -------
    ndarray
        (row, column) uint8, sums of 1 (shadow) and 2 (layover).

    Notes
    -----
    Source: docs/theory/terrain.md, sections 3 and 4.

    Examples
    --------
    >>> from apertura.core.scene.terrain import GridHeights
    >>> grid = SceneGrid("local", 0.0, 8.0, 1.0, (8, 32))
    >>> ground = np.zeros(grid.shape)
    >>> ground[:, 10] = 4.0
    >>> relief = Relief.of(grid, GridHeights(grid, ground), 0.0)
    >>> antenna = relief.above(np.array([[-30.0, 4.0, 20.0]]))
    >>> visibility(relief, antenna, antenna, (slice(4, 5), slice(0, 32)))[0, 7:22]
    array([0, 0, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0], dtype=uint8)
    """
    first = np.array([part.start for part in window])
    mask = np.zeros([part.stop - part.start for part in window], np.uint8)
    legs = np.stack([tx, rx], axis=1)
    ground = (relief.height_m, relief.grid.spacing_m, relief.curvature_per_m)
    mark_shadow(mask, first, legs if (tx != rx).any() else legs[:, :1].copy(), relief.highest_m, ground)
    mark_layover(mask, first, legs, (relief.lowest_m, float(relief.highest_m.max())), ground)
    return mask
