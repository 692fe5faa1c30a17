"""Where `auto` puts the scene: UTM zone, bounds and spacing from the flight and the waveform."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.contracts import Window
from apertura.geometry.geodesy import geodetic_from_ecef, projected_from_ecef
from apertura.scene.grid import LOCAL, SceneGrid

GRAZING_LIMIT_DEG = 10.0
"""Ground seen at a lower grazing angle than this is left out of automatic bounds."""

_PULSES_AT_ONCE = 256

CELLS_PER_PIXEL = 3.0
"""Pixels per finest resolution cell; 2 would be Nyquist for a band-limited magnitude."""


def utm_crs(position: NDArray[np.float64]) -> str:
    """Return the EPSG code of the WGS 84 UTM zone at an ECEF position.

    Examples
    --------
    >>> from apertura.geometry.geodesy import ecef_from_geodetic
    >>> utm_crs(ecef_from_geodetic(*map(np.array, (48.4, 9.95, 600.0))))
    'EPSG:32632'
    """
    latitude, longitude, _ = geodetic_from_ecef(position)
    found = query_utm_crs_info("WGS 84", AreaOfInterest(longitude, latitude, longitude, latitude))
    return f"EPSG:{found[0].code}"


def auto_bounds(
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    *,
    crs: str,
    height_m: float,
    path_limit_m: float,
) -> tuple[float, float, float, float]:
    """Return bounds of the ground that every pulse sees inside the prefix and above the grazing limit.

    Parameters
    ----------
    tx, rx
        (pulse, 3) float64 phase centres, metres, ECEF or the local frame.
    crs
        CRS of the bounds, or 'local'.
    height_m
        Ground height, ellipsoidal or z.
    path_limit_m
        Longest total path inside the cyclic prefix, metres; inf without.

    Returns
    -------
    tuple
        xmin, ymin, xmax, ymax, whole metres.

    Notes
    -----
    Source: docs/theory.md, eq. 8.
    """
    places = np.concatenate([tx, rx])
    flat = places if crs == LOCAL else projected_from_ecef(crs, places)
    altitude = max(1.0, float(np.median(flat[:, 2])) - height_m)
    slant = min(path_limit_m / 2, altitude / np.sin(np.radians(GRAZING_LIMIT_DEG)))
    reach = np.sqrt(max(slant**2 - altitude**2, 1.0))
    middle = (flat[:, :2].min(axis=0) + flat[:, :2].max(axis=0)) / 2
    low, high = np.floor(middle - reach), np.ceil(middle + reach)
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def auto_spacing(
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    frequency_hz: NDArray[np.float64],
    *,
    crs: str,
    bounds_m: tuple[float, float, float, float],
    height_m: float,
) -> float:
    """Return a pixel spacing (m, of the series 1-2-5) that resolves the finest cell of the scene.

    The spatial spectrum of a pixel is spanned by the gradient of the phase 2πf·path/c over pulses and
    frequencies; its largest extent along x or y over all pixels of a coarse net is the inverse of the cell.

    Parameters
    ----------
    tx, rx
        (pulse, 3) float64 phase centres, metres.
    frequency_hz
        (subcarrier,) float64.
    crs, bounds_m, height_m
        The scene.

    Notes
    -----
    Source: docs/theory.md, eq. 8.
    """
    xmin, ymin, xmax, ymax = bounds_m
    net = SceneGrid(crs, xmin, ymax, max(xmax - xmin, ymax - ymin) / 8, (8, 8), height_m)
    east = net.positions_at(*np.mgrid[:8, :8] + np.array([0.0, 1e-3])[:, None, None]) - net.positions()
    south = net.positions_at(*np.mgrid[:8, :8] + np.array([1e-3, 0.0])[:, None, None]) - net.positions()
    steps = np.stack([east, south], axis=-2) / (1e-3 * net.spacing_m)
    thin = slice(None, None, max(1, len(tx) // 64))
    gradient = sum(_unit(net.positions()[None] - centre[thin, None, None]) for centre in (tx, rx))
    slopes = np.einsum("pyxk,yxak->pyxa", gradient, steps)
    cycles = np.stack([slopes * f / SPEED_OF_LIGHT_M_S for f in (frequency_hz[0], frequency_hz[-1])])
    widest = float(np.ptp(cycles.reshape(-1, 8, 8, 2), axis=0).max())
    return _one_two_five(1.0 / (CELLS_PER_PIXEL * widest))


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def _one_two_five(value: float) -> float:
    decade = 10.0 ** np.floor(np.log10(value))
    return float(max(step * decade for step in (1, 2, 5) if step * decade <= value * (1 + 1e-9)))


def swath(
    grid: SceneGrid,
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    *,
    heights: Callable[[Window], NDArray[np.float64]] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the shortest and longest total path from each pulse to the scene.

    At most 33 × 33 blocks of pixels, each a point and a radius that holds its pixels at all their heights; the
    total path changes by at most twice the radius.

    Parameters
    ----------
    grid
        The scene.
    tx, rx
        (pulse, 3) float64 phase centres, metres, in the grid's processing frame.
    heights
        Gives the pixel heights (m) of a window; flat ground at `grid.height_m` if None.

    Returns
    -------
    tuple of ndarray
        (pulse,) float64 metres each; never longer, never shorter than any pixel's path.

    Examples
    --------
    >>> grid = SceneGrid("local", 0.0, 10.0, 1.0, (10, 10), 0.0)
    >>> near, far = swath(grid, *2 * [np.array([[-20.0, 5.0, 0.0]])])
    >>> bool(near[0] <= 41.02), bool(far[0] >= 59.0)
    (True, True)
    """
    blocks = list(grid.tiles(-(-max(grid.shape) // 33)))
    centre = np.array([[(part.start + part.stop - 1) / 2 for part in block] for block in blocks])
    across = np.array([[(part.stop - part.start - 1) / 2 * grid.spacing_m for part in block] for block in blocks])
    low, high = np.full((2, len(blocks)), grid.height_m)
    if heights is not None:
        low, high = np.array([[(height := heights(block)).min(), height.max()] for block in blocks]).T
    radius = np.sqrt((across**2).sum(axis=1) + ((high - low) / 2) ** 2)
    net = grid.positions_at(centre[:, 0], centre[:, 1], (low + high) / 2)
    nearest, farthest = np.empty((2, len(tx)))
    for first in range(0, len(tx), _PULSES_AT_ONCE):
        pulses = slice(first, first + _PULSES_AT_ONCE)
        path = sum(np.linalg.norm(net - antenna[pulses, None], axis=-1) for antenna in (tx, rx))
        nearest[pulses], farthest[pulses] = (path - 2 * radius).min(axis=1), (path + 2 * radius).max(axis=1)
    return nearest, farthest


def clearance(
    grid: SceneGrid,
    antenna: NDArray[np.float64],
    *,
    heights: Callable[[Window], NDArray[np.float64]] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how high each phase centre is above the pixel under it, and how high that pixel is.

    Parameters
    ----------
    grid
        The scene.
    antenna
        (pulse, 3) float64 phase centres, metres, in the grid's processing frame.
    heights
        As in `swath`.

    Returns
    -------
    tuple of ndarray
        (pulse,) float64 metres each. Beside the scene flat ground goes on at `grid.height_m`; what lies beside a DEM is
        not known: NaN.

    Examples
    --------
    >>> grid = SceneGrid("local", 0.0, 10.0, 1.0, (10, 10), 3.0)
    >>> clearance(grid, np.array([[5.0, 5.0, 7.0], [-20.0, 5.0, 7.0]]))
    (array([4., 4.]), array([3., 3.]))
    """
    place = antenna if grid.crs == LOCAL else projected_from_ecef(grid.crs, antenna)
    west, _, _, north = grid.bounds_m
    row, column = (np.floor(side / grid.spacing_m).astype(int) for side in (north - place[:, 1], place[:, 0] - west))
    under = np.full(len(antenna), grid.height_m if heights is None else np.nan)
    for window in grid.tiles(512):
        inside = (row >= window[0].start) & (row < window[0].stop)
        inside &= (column >= window[1].start) & (column < window[1].stop)
        if inside.any():
            ground = np.full(grid[window].shape, grid.height_m) if heights is None else heights(window)
            under[inside] = ground[row[inside] - window[0].start, column[inside] - window[1].start]
    return place[:, 2] - under, under
