"""Visibility of the scene: masks of shadow and layover."""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.contracts import Window
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain

# ---- Shadow and layover along lines of sight
#
# Kernels (docs/theory/terrain.md, sections 3 and 4). `legs` is (pulse, antenna, 3): row, column and height of each
# phase centre. `ground` contains heights (row, column) float32, the pixel spacing (m) and 1/2R of the Earth (1/m). Each
# step along a line is one pixel along one index, so that the terrain is interpolated between two pixels only.

SHADOW, LAYOVER = 1, 2
"""Bits of the mask."""

BLOCK = 16
"""Side of the blocks for which the highest terrain is precomputed, pixels."""

TOLERANCE_M = 1e-3
"""Height up to which terrain above a line of sight does not block the line, metres: float32 rounding of a relief."""

STRAIGHT_BELOW = 0.05
"""Horizontal gradient of the path, m/m, below which the antenna is above the pixel and layover is undefined."""


@numba.njit(cache=True, nogil=True)
def _interpolated(height, row, column):  # type: ignore[no-untyped-def]
    """Interpolate the height at a point with at least one integer index; NaN outside the scene."""
    rows, columns = height.shape
    r, c = int(np.floor(row)), int(np.floor(column))
    if row < 0 or column < 0 or row > rows - 1 or column > columns - 1:
        return np.nan
    down, right = row - r, column - c
    # Between two pixels of the row above the point; the next column is read only if its weight is not zero.
    low = height[r, c]
    if right > 0:
        low = (1 - right) * low + right * height[r, c + 1]
    if down == 0:
        return low
    # Between two pixels of the row below the point.
    high = height[r + 1, c]
    if right > 0:
        high = (1 - right) * high + right * height[r + 1, c + 1]
    return (1 - down) * low + down * high


@numba.njit(cache=True, nogil=True)
def _steps_left(index, step):  # type: ignore[no-untyped-def]
    """Return the number of whole steps to the edge of the block that contains `index`, along one axis."""
    if step == 0:
        return 1 << 30
    block = np.floor(index / BLOCK) * BLOCK
    to_edge = block + BLOCK - index if step > 0 else index - block
    return int(to_edge / abs(step))


@numba.njit(cache=True, nogil=True)
def _blocked(antenna, row, column, highest, top, ground):  # type: ignore[no-untyped-def]
    """Return True if terrain rises above the straight line from a pixel to an antenna."""
    height, spacing, curvature = ground
    own = height[row, column]
    down, right, up = antenna[0] - row, antenna[1] - column, antenna[2] - own
    # One step is one pixel along the axis of the larger difference: the line crosses the other axis between two pixels.
    steps = max(abs(down), abs(right))
    if steps < 1:
        return False
    dr, dc = down / steps, right / steps
    # On the curved Earth, a line of length d is s(1 − s)d²/2R below the linear rise between its ends, with s = t/steps.
    bend = curvature * spacing * spacing * (dr * dr + dc * dc)
    t = 1
    while t < steps:
        r, c = row + t * dr, column + t * dc
        terrain = _interpolated(height, r, c)
        if np.isnan(terrain):  # the line has left the scene: terrain outside the scene is ignored
            return False
        line = own + up * t / steps - bend * t * (steps - t)
        if terrain > line + TOLERANCE_M:
            return True
        # `least` is a lower bound of the rest of a rising line. If this bound is above all terrain of the scene, the
        # line is not blocked. If it is above all terrain of this block and of one pixel around the block, the search
        # skips to the last step inside the block.
        leap, least = 1, line - bend * steps
        if up > 0 and least > top:
            return False
        if up > 0 and least > highest[int(r) // BLOCK, int(c) // BLOCK]:
            leap = max(1, min(_steps_left(r, dr), _steps_left(c, dc)))
        t += leap
    return False


@numba.njit(cache=True, nogil=True)
def mark_shadow(mask, first, legs, highest, ground):  # type: ignore[no-untyped-def]
    """Set `SHADOW` in `mask`, (row, column) uint8 with first pixel `first`, where most pulses are blocked.

    A pulse is blocked at a pixel if terrain blocks the line of sight to the transmitter or to the receiver. A pixel is
    in shadow if more than half of the pulses are blocked.
    """
    pulses, top = legs.shape[0], highest.max()
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            blocked = 0
            for pulse in range(pulses):
                # Stop if more than half of the pulses are already blocked, or if this is no longer possible.
                if 2 * blocked > pulses or 2 * (pulse - blocked) >= pulses:
                    break
                for leg in range(legs.shape[1]):
                    if _blocked(legs[pulse, leg], first[0] + i, first[1] + j, highest, top, ground):
                        blocked += 1
                        break
            if 2 * blocked > pulses:
                mask[i, j] |= SHADOW


@numba.njit(cache=True, nogil=True)
def _total_path(legs, pixel, height_m, ground):  # type: ignore[no-untyped-def]
    """Return the total path from one antenna via a pixel (row, column) at a height to the other antenna."""
    _, spacing, curvature = ground
    path = 0.0
    for leg in range(2):
        south, east = (pixel[0] - legs[leg, 0]) * spacing, (pixel[1] - legs[leg, 1]) * spacing
        flat = south * south + east * east
        # The curved Earth lies d²/2R below the horizontal plane of the antenna.
        up = legs[leg, 2] - height_m + curvature * flat
        path += np.sqrt(flat + up * up)
    return path


@numba.njit(cache=True, nogil=True)
def _in_layover(direction, legs, pixel, extreme, ground):  # type: ignore[no-untyped-def]
    """Return True if terrain along `direction` (rows and columns per step, sign) has the same total path as the pixel.

    Without layover, paths are longer behind the pixel (sign +1) and shorter in front of the pixel (sign −1). `extreme`
    is the height that violates this condition at the largest distance: the highest terrain behind the pixel, or the
    lowest terrain in front of the pixel.
    """
    height, sign = ground[0], direction[2]
    own = _total_path(legs, pixel, height[pixel[0], pixel[1]], ground)
    t = 1
    while True:
        point = (pixel[0] + t * direction[0] * sign, pixel[1] + t * direction[1] * sign)
        height_m = _interpolated(height, point[0], point[1])
        if np.isnan(height_m):  # outside the scene
            return False
        # Beyond this distance, not even the most extreme terrain of the scene can have the same path.
        if sign * (_total_path(legs, point, extreme, ground) - own) > 0:
            return False
        if sign * (_total_path(legs, point, height_m, ground) - own) <= 0:
            return True
        t += 1


@numba.njit(cache=True, nogil=True)
def _path_gradient(legs, pixel, height_m, spacing):  # type: ignore[no-untyped-def]
    """Return the gradient of the total path along rows and columns: the horizontal line-of-sight direction."""
    down, right = 0.0, 0.0
    for leg in range(2):
        south, east = (pixel[0] - legs[leg, 0]) * spacing, (pixel[1] - legs[leg, 1]) * spacing
        up = legs[leg, 2] - height_m
        distance = np.sqrt(south * south + east * east + up * up)
        down, right = down + south / distance, right + east / distance
    return down, right


@numba.njit(cache=True, nogil=True)
def mark_layover(mask, first, legs, extremes, ground):  # type: ignore[no-untyped-def]
    """Set `LAYOVER` in `mask` with first pixel `first`; `extremes` are the lowest and highest terrain."""
    height, spacing = ground[0], ground[1]
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            pixel = (first[0] + i, first[1] + j)
            own = height[pixel]
            # Find the pulse with the shortest path, at which the gradient is perpendicular to the track.
            nearest, least = 0, np.inf
            for pulse in range(legs.shape[0]):
                path = _total_path(legs[pulse], pixel, own, ground)
                if path < least:
                    nearest, least = pulse, path
            down, right = _path_gradient(legs[nearest], pixel, own, spacing)
            steep = max(abs(down), abs(right))
            if steep < STRAIGHT_BELOW:  # antenna directly above the pixel
                continue
            # Search away from the antenna, then towards the antenna, with one pixel per step along the steeper axis.
            dr, dc = down / steep, right / steep
            if _in_layover((dr, dc, 1), legs[nearest], pixel, extremes[1], ground) or _in_layover(
                (dr, dc, -1), legs[nearest], pixel, extremes[0], ground
            ):
                mask[i, j] |= LAYOVER


# ---- Visibility of a window

EARTH_RADIUS_M = 6371e3

_STRIP = 256  # rows of heights read at once


@dataclass(frozen=True)
class Relief:
    """Heights of a whole scene, with block maxima for the search along lines of sight.

    Attributes
    ----------
    grid, base_m
        Grid of the scene; and reference level of the following heights, metres.
    height_m
        (row, column) float32, metres above `base_m`.
    highest_m
        (block row, block column) float32: highest terrain of each block of 16 × 16 pixels and of one pixel around the
        block, metres above `base_m`.
    lowest_m
        Lowest terrain, metres above `base_m`.
    """

    grid: SceneGrid
    base_m: float
    height_m: NDArray[np.float32]
    highest_m: NDArray[np.float32]
    lowest_m: float

    @classmethod
    def of(cls, grid: SceneGrid, terrain: Terrain, base_m: float) -> "Relief":
        """Return the relief relative to a height (m) near the terrain, so that float32 resolves micrometres."""
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
        """1/2R, 1/m: depth of the Earth below a horizontal line per squared distance; 0 in a local frame."""
        return 0.0 if self.grid.crs == LOCAL else 0.5 / EARTH_RADIUS_M

    def above(self, antenna: Floats) -> Floats:
        """Return (pulse, 3) float64: fractional row and column, and height above `base_m` (m), of phase centres.

        Parameters
        ----------
        antenna
            (pulse, 3) float64, metres, in the processing frame of the grid.
        """
        return self.grid.pixel_below(antenna) - [0.0, 0.0, self.base_m]


def visibility(relief: Relief, tx: Floats, rx: Floats, window: Window) -> NDArray[np.uint8]:
    """Compute the mask of shadow and layover of a window for one pair.

    A pixel is in shadow if terrain of the scene blocks the line of sight to the transmitter or to the receiver at more
    than half of the given pulses. A pixel is in layover if, at the pulse with the shortest total path, another point
    along the line of sight has the same total path. Terrain outside the scene is ignored.

    Parameters
    ----------
    relief
        Relief of the whole scene.
    tx, rx
        (pulse, 3) float64 from `Relief.above`, for a selection of pulses that are evenly spread over the aperture.
    window
        Rows and columns of the mask.

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
