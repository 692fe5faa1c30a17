"""Surface normals of the terrain, incidence angles and bistatic angles."""

from dataclasses import replace

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.contracts import Window
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, Terrain


def surface_normals(position: Floats) -> Floats:
    """Return the upward unit normals of a surface that is given by the positions of pixels.

    Parameters
    ----------
    position
        (row, column, 3) float64, metres, rows southward and columns eastward, at least 2 × 2 pixels.

    Returns
    -------
    ndarray
        (row, column, 3) float64, from central differences inside and one-sided differences at the edges.

    Examples
    --------
    >>> east, north = np.meshgrid(np.arange(3.0), -np.arange(3.0))
    >>> surface_normals(np.stack([east, north, east], -1))[1, 1].round(4)
    array([-0.7071,  0.    ,  0.7071])
    """
    normal = np.cross(np.gradient(position, axis=0), np.gradient(position, axis=1))
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def surface(grid: SceneGrid, terrain: Terrain, window: Window) -> tuple[Floats, Floats]:
    """Return positions and unit normals of the terrain in a window, continuous across adjacent windows.

    Parameters
    ----------
    grid, terrain
        The scene.
    window
        Rows and columns of the grid.

    Returns
    -------
    tuple of ndarray
        (row, column, 3) float64 each: positions in the processing frame of the grid, metres; and upward normals.
    """
    if isinstance(terrain, FlatGround):
        position = terrain.positions(grid[window])
        return position, unit(grid[window].positions(terrain.height_m + 1.0) - position)
    # One pixel more on each side, so that the normals at the edges do not depend on the window.
    extended = [
        np.arange(max(0, part.start - 1), max(2, min(size, part.stop + 1)))
        for part, size in zip(window, grid.shape, strict=True)
    ]
    rows, columns = extended
    wider = replace(grid, first=(grid.first[0] + rows[0], grid.first[1] + columns[0]), shape=(rows.size, columns.size))
    heights = terrain.heights(grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])
    padding = [(0, axis.size - size) for axis, size in zip(extended, heights.shape, strict=True)]
    position = wider.positions(np.pad(heights, padding, mode="edge"))  # extends a grid with a single row or column
    inner = tuple(slice(part.start - axis[0], part.stop - axis[0]) for part, axis in zip(window, extended, strict=True))
    return position[inner], surface_normals(position)[inner]


def incidence_deg(position: Floats, normal: Floats, antenna: Floats) -> Floats:
    """Return the angle between the direction to an antenna and the surface normal.

    Parameters
    ----------
    position, normal
        (..., 3) float64, positions in metres and unit vectors, in the same frame.
    antenna
        (3,) float64, metres.

    Returns
    -------
    ndarray
        (...) float64, degrees; above 90 where the surface faces away from the antenna.

    Examples
    --------
    >>> incidence_deg(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([5.0, 0.0, 5.0])).round(6).item()
    45.0
    """
    return np.degrees(_angle(antenna - position, normal))


def bistatic_angle_deg(position: Floats, tx: Floats, rx: Floats) -> Floats:
    """Return the angle, degrees, at each position (..., 3) between the directions to two antennas (3,), metres.

    Examples
    --------
    >>> bistatic_angle_deg(np.zeros(3), np.array([1.0, 0.0, 1.0]), np.array([-2.0, 0.0, 2.0])).round(6).item()
    90.0
    """
    return np.degrees(_angle(tx - position, rx - position))


def _angle(first: Floats, second: Floats) -> Floats:
    chord = unit(first) - unit(second)  # accurate for small angles, unlike the arc cosine
    return np.asarray(2 * np.arcsin(np.minimum(1.0, np.sqrt(np.einsum("...i,...i", chord, chord)) / 2)))


def unit(vector: Floats) -> Floats:
    """Return vectors, (..., 3), divided by their lengths."""
    return np.asarray(vector / np.sqrt(np.einsum("...i,...i", vector, vector))[..., None])
