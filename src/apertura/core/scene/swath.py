"""Bounds of the total path from each pulse to the scene, by blocks of pixels."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import illumination_mask
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain

_BLOCKS = 33
_PULSES_AT_ONCE = 256
_PIXELS_AT_ONCE = 2**20  # number of heights read together, because opening a DEM and reading small parts is slow
_MOST_PULSES = 4096  # largest number of pulses for which paths are computed; for the other pulses, bounds are derived


def swath(
    grid: SceneGrid, terrain: Terrain, aperture: Aperture, *, beams: Beams | None = None, together: int = 1
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a lower and an upper bound of the total paths from each pulse to the scene.

    The scene is divided into about 33 × 33 blocks of pixels, each of which is contained in a sphere. From the centre of
    a sphere, the total path changes by at most twice the radius. In a long flight, bounds are derived from a sample of
    the pulses: between two pulses, a path changes by at most the sum of the displacements of both antennas.

    Parameters
    ----------
    grid, terrain
        Grid and terrain of the scene.
    aperture
        Aperture in the processing frame of the grid.
    beams
        Weights of pulses: blocks of pixels that a pulse cannot illuminate are excluded.
    together
        Minimum number of consecutive pulses for which bounds are derived from the path of one of these pulses.

    Returns
    -------
    tuple of ndarray
        (pulse,) float64 each, metres. For a pulse that illuminates no pixel, the lower bound is +inf and the upper
        bound is -inf.

    Examples
    --------
    >>> from apertura.core.scene.terrain import FlatGround
    >>> grid = SceneGrid("local", 0.0, 10.0, 1.0, (10, 10))
    >>> near, far = swath(grid, FlatGround(0.0), Aperture(*2 * [np.array([[-20.0, 5.0, 0.0]])]))
    >>> bool(near[0] <= 41.02), bool(far[0] >= 59.0)
    (True, True)
    """
    side = (
        -(-max(grid.shape) // _BLOCKS) if beams is None else math.isqrt(grid.shape[0] * grid.shape[1] // _BLOCKS**2) + 1
    )
    middle_m, radius_m = balls(grid, terrain, list(grid.tiles(side)))
    every = max(together, 1 + (len(aperture) - 1) // _MOST_PULSES)
    nearest, farthest = np.empty((2, len(aperture)))
    for first in range(0, len(aperture), every * _PULSES_AT_ONCE):
        pulses = slice(first, first + every * _PULSES_AT_ONCE)
        near, far = _spans(aperture[pulses], beams and beams[pulses], middle_m, radius_m, every)
        nearest[pulses], farthest[pulses] = near, far
    return nearest, farthest


def _spans(
    aperture: Aperture,
    beams: Beams | None,
    middle_m: NDArray[np.float64],
    radius_m: NDArray[np.float64],
    every: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the swath of pulses, with bounds derived from the middle pulse of each group of `every` pulses."""
    block = np.arange(len(aperture)) // every
    middle = aperture[np.minimum(np.arange(0, len(aperture), every) + every // 2, len(aperture) - 1)]
    displacement = sum(
        np.linalg.norm(position_m - middle_position_m[block], axis=1)
        for position_m, middle_position_m in zip(aperture.legs, middle.legs, strict=True)
    )
    path = middle.path(middle_m)
    near, far = path - 2 * radius_m, path + 2 * radius_m
    if beams is not None:
        dark = ~illumination_mask(beams, aperture, middle_m, radius_m, pulses=every)
        near[dark], far[dark] = np.inf, -np.inf
    return near.min(axis=1)[block] - displacement, far.max(axis=1)[block] + displacement


def balls(
    grid: SceneGrid, terrain: Terrain, windows: Sequence[Window]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centres (window, 3) and radii (window,), metres, of spheres that contain the pixels of windows."""
    centre = np.array([[(part.start + part.stop - 1) / 2 for part in window] for window in windows])
    half_m = np.array([[(part.stop - part.start - 1) / 2 * grid.spacing_m for part in window] for window in windows])
    low, high = np.array([ends for strip in _strips(windows) for ends in _height_ranges(grid, terrain, strip)]).T
    middle_m = grid.positions_at(centre[:, 0], centre[:, 1], (low + high) / 2)
    return middle_m, np.sqrt((half_m**2).sum(axis=1) + ((high - low) / 2) ** 2)


def _strips(windows: Sequence[Window]) -> Iterator[list[Window]]:
    """Yield runs of adjacent windows with the same rows; each run has at most `_PIXELS_AT_ONCE` pixels if possible."""
    strip: list[Window] = []
    for rows, columns in windows:
        if strip:
            (last_rows, last_columns), width = strip[-1], columns.stop - strip[0][1].start
            is_adjacent = rows == last_rows and columns.start == last_columns.stop
            if not is_adjacent or width * (rows.stop - rows.start) > _PIXELS_AT_ONCE:
                yield strip
                strip = []
        strip.append((rows, columns))
    if strip:
        yield strip


def _height_ranges(grid: SceneGrid, terrain: Terrain, strip: list[Window]) -> Iterator[tuple[float, float]]:
    """Yield the lowest and highest height in each window of a strip."""
    rows, (left, right) = strip[0][0], (strip[0][1].start, strip[-1][1].stop)
    heights = terrain.heights(grid[rows, slice(left, right)])
    starts = [columns.start - left for _, columns in strip]
    lowest, highest = np.minimum.reduceat(heights.min(axis=0), starts), np.maximum.reduceat(heights.max(axis=0), starts)
    yield from zip(lowest.tolist(), highest.tolist(), strict=True)
