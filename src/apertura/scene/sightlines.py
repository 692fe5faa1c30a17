"""Walks over a relief along lines of sight: what is hidden, and what shares its range with other ground.

Kernels. `legs` is (look, leg, 3): row, column and height of each phase centre; `ground` is heights (row, column)
float32, spacing of the pixels and 1/2R of the Earth (metres, 1/m). Every step goes one pixel along one index, so that
ground is interpolated between two pixels only.
"""

import numba
import numpy as np

SHADOW, LAYOVER = 1, 2
"""Bits of the mask."""

BLOCK = 16
"""Side of the blocks of pixels whose highest ground is known beforehand."""

TOLERANCE_M = 1e-3
STRAIGHT_BELOW = 0.05


@numba.njit(cache=True, nogil=True)
def _interpolated(height, row, column):  # type: ignore[no-untyped-def]
    """Height at a place of which at least one index is whole; NaN outside."""
    rows, columns = height.shape
    r, c = int(np.floor(row)), int(np.floor(column))
    if row < 0 or column < 0 or row > rows - 1 or column > columns - 1:
        return np.nan
    down, right = row - r, column - c
    low = height[r, c]
    if right > 0:
        low = (1 - right) * low + right * height[r, c + 1]
    if down == 0:
        return low
    high = height[r + 1, c]
    if right > 0:
        high = (1 - right) * high + right * height[r + 1, c + 1]
    return (1 - down) * low + down * high


@numba.njit(cache=True, nogil=True)
def _steps_left(place, step):  # type: ignore[no-untyped-def]
    """How many whole steps stay inside the block that `place` is in, along one axis."""
    if step == 0:
        return 1 << 30
    block = np.floor(place / BLOCK) * BLOCK
    room = block + BLOCK - place if step > 0 else place - block
    return int(room / abs(step))


@numba.njit(cache=True, nogil=True)
def _hidden(antenna, row, column, highest, top, ground):  # type: ignore[no-untyped-def]
    """Whether ground rises above the straight line from a pixel to an antenna."""
    height, spacing, curvature = ground
    own = height[row, column]
    down, right, up = antenna[0] - row, antenna[1] - column, antenna[2] - own
    steps = max(abs(down), abs(right))
    if steps < 1:
        return False
    dr, dc = down / steps, right / steps
    sag = curvature * spacing * spacing * (dr * dr + dc * dc)
    t = 1
    while t < steps:
        r, c = row + t * dr, column + t * dc
        there = _interpolated(height, r, c)
        if np.isnan(there):
            return False
        line = own + up * t / steps - sag * t * (steps - t)
        if there > line + TOLERANCE_M:
            return True
        room, least = 1, line - sag * steps  # the line does not come lower than that any more
        if up > 0 and least > top:
            return False
        if up > 0 and least > highest[int(r) // BLOCK, int(c) // BLOCK]:
            room = max(1, min(_steps_left(r, dr), _steps_left(c, dc)))
        t += room
    return False


@numba.njit(cache=True, nogil=True)
def mark_shadow(mask, first, legs, highest, ground):  # type: ignore[no-untyped-def]
    """Set `SHADOW` in `mask`, (row, column) uint8 whose pixel (0, 0) is `first`."""
    looks, top = legs.shape[0], highest.max()
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            hidden = 0
            for look in range(looks):
                if 2 * hidden > looks or 2 * (look - hidden) >= looks:
                    break  # decided
                for leg in range(legs.shape[1]):
                    if _hidden(legs[look, leg], first[0] + i, first[1] + j, highest, top, ground):
                        hidden += 1
                        break
            if 2 * hidden > looks:
                mask[i, j] |= SHADOW


@numba.njit(cache=True, nogil=True)
def _total_path(legs, place, up_m, ground):  # type: ignore[no-untyped-def]
    """Length of the way from one antenna to a place (row, column) at a height and on to the other antenna."""
    _, spacing, curvature = ground
    path = 0.0
    for leg in range(2):
        south, east = (place[0] - legs[leg, 0]) * spacing, (place[1] - legs[leg, 1]) * spacing
        flat = south * south + east * east
        up = legs[leg, 2] - up_m + curvature * flat
        path += np.sqrt(flat + up * up)
    return path


@numba.njit(cache=True, nogil=True)
def _folds(way, legs, place, edge, ground):  # type: ignore[no-untyped-def]
    """Whether ground along `way` (rows and columns per step, sign) has the path of the pixel or is on its wrong side.

    `edge` is the height that could: the highest behind the pixel (sign +1), the lowest before it (−1).
    """
    height, sign = ground[0], way[2]
    own = _total_path(legs, place, height[place[0], place[1]], ground)
    t = 1
    while True:
        there = (place[0] + t * way[0] * sign, place[1] + t * way[1] * sign)
        up = _interpolated(height, there[0], there[1])
        if np.isnan(up):
            return False
        if sign * (_total_path(legs, there, edge, ground) - own) > 0:
            return False
        if sign * (_total_path(legs, there, up, ground) - own) <= 0:
            return True
        t += 1


@numba.njit(cache=True, nogil=True)
def _look_direction(legs, place, up_m, spacing):  # type: ignore[no-untyped-def]
    """Horizontal gradient of the total path, along rows and columns."""
    down, right = 0.0, 0.0
    for leg in range(2):
        south, east = (place[0] - legs[leg, 0]) * spacing, (place[1] - legs[leg, 1]) * spacing
        up = legs[leg, 2] - up_m
        distance = np.sqrt(south * south + east * east + up * up)
        down, right = down + south / distance, right + east / distance
    return down, right


@numba.njit(cache=True, nogil=True)
def mark_layover(mask, first, legs, edges, ground):  # type: ignore[no-untyped-def]
    """Set `LAYOVER` in `mask`, whose pixel (0, 0) is `first`; `edges`: lowest and highest ground."""
    height, spacing = ground[0], ground[1]
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            place = (first[0] + i, first[1] + j)
            own = height[place]
            nearest, least = 0, np.inf
            for look in range(legs.shape[0]):
                path = _total_path(legs[look], place, own, ground)
                if path < least:
                    nearest, least = look, path
            down, right = _look_direction(legs[nearest], place, own, spacing)
            steep = max(abs(down), abs(right))
            if steep < STRAIGHT_BELOW:  # every way leads away
                continue
            dr, dc = down / steep, right / steep
            if _folds((dr, dc, 1), legs[nearest], place, edges[1], ground) or _folds(
                (dr, dc, -1), legs[nearest], place, edges[0], ground
            ):
                mask[i, j] |= LAYOVER
