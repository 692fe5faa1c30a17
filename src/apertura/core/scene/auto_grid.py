"""Automatic grid of a scene: UTM zone, bounds and pixel spacing from the flight and the waveform."""

import numpy as np
from numpy.typing import NDArray
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import frame_from_map, geodetic_from_ecef, map_from_frame
from apertura.core.scene.grid import SceneGrid

GRAZING_LIMIT_DEG = 10.0
"""Smallest grazing angle within automatic bounds, degrees: at smaller angles, backscatter and terrain accuracy are
lower."""

PIXELS_PER_CELL = 3.0
"""Number of pixels per finest resolution cell, along each axis; the Nyquist limit of a band-limited magnitude is 2."""


def utm_crs(position: NDArray[np.float64]) -> str:
    """Return the EPSG code of the WGS 84 UTM zone, or polar stereographic CRS, at an ECEF position.

    Examples
    --------
    >>> from apertura.core.geometry.geodesy import ecef_from_geodetic
    >>> utm_crs(ecef_from_geodetic(*map(np.array, (48.4, 9.95, 600.0))))
    'EPSG:32632'
    >>> utm_crs(ecef_from_geodetic(*map(np.array, (-85.0, 9.95, 600.0))))
    'EPSG:5042'
    """
    latitude, longitude, _ = geodetic_from_ecef(position)
    zones = query_utm_crs_info("WGS 84", AreaOfInterest(longitude, latitude, longitude, latitude))
    polar = "5041" if latitude > 0 else "5042"
    return f"EPSG:{zones[0].code if zones else polar}"


def auto_bounds(
    aperture: Aperture,
    *,
    crs: str,
    height_m: float,
    path_limit_m: float,
) -> tuple[float, float, float, float]:
    """Return the bounds of the area within the path limit of every pulse and above the smallest grazing angle.

    Parameters
    ----------
    aperture
        Aperture in ECEF or the local frame.
    crs
        CRS of the bounds, or 'local'.
    height_m
        Terrain height, metres above the ellipsoid, or z of the local frame.
    path_limit_m
        Longest total path within the cyclic prefix, metres; inf if unlimited.

    Returns
    -------
    tuple
        xmin, ymin, xmax, ymax, rounded outward to integer metres.

    Notes
    -----
    Source: docs/theory.md, eq. 8.
    """
    flat = map_from_frame(crs, np.concatenate(aperture.legs))
    altitude = max(1.0, float(np.median(flat[:, 2])) - height_m)
    slant = min(path_limit_m / 2, altitude / np.sin(np.radians(GRAZING_LIMIT_DEG)))
    reach = np.sqrt(max(slant**2 - altitude**2, 1.0))
    middle = (flat[:, :2].min(axis=0) + flat[:, :2].max(axis=0)) / 2
    sample, corners = aperture[aperture.sample(64)], np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])

    def longest_m(reach: float) -> float:
        east, north = (middle + (reach + 1) * corners).T  # outer corners, rounded to metres
        return float(sample.path(frame_from_map(crs, east, north, np.full(4, height_m))).max())

    # The paths from the ends of the track to the corners of the square may exceed the limit: the square is reduced
    # until no path does. If no size fits, the square is unchanged, and checks of the scene report the excess.
    fitting = (reach * share for share in np.linspace(1, 0.1, 91) if longest_m(reach * share) <= path_limit_m)
    reach = next(fitting, reach)
    low, high = np.floor(middle - reach), np.ceil(middle + reach)
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def auto_spacing(
    aperture: Aperture,
    frequency_hz: NDArray[np.float64],
    *,
    crs: str,
    bounds_m: tuple[float, float, float, float],
    height_m: float,
) -> float:
    """Return a pixel spacing (metres, from the series 1-2-5) that samples the finest resolution cell of the scene.

    The spatial spectrum of a pixel is spanned by the gradient of the phase 2πf·path/c over pulses and frequencies. Its
    largest extent along x or y over the pixels of a coarse grid is the inverse of the resolution cell.

    Parameters
    ----------
    aperture
        Aperture in ECEF or the local frame.
    frequency_hz
        (subcarrier,) float64.
    crs, bounds_m, height_m
        CRS, bounds and terrain height of the scene.

    Notes
    -----
    Source: docs/theory.md, eq. 8.
    """
    xmin, ymin, xmax, ymax = bounds_m
    grid = SceneGrid(crs, xmin, ymax, max(xmax - xmin, ymax - ymin) / 8, (8, 8))
    row, column = np.mgrid[:8, :8]
    points = grid.positions_at(row, column, height_m)
    shifted = np.stack(
        [grid.positions_at(row, column + 1e-3, height_m), grid.positions_at(row + 1e-3, column, height_m)]
    )
    axes = np.moveaxis(shifted - points, 0, -2) / (1e-3 * grid.spacing_m)
    gradient = aperture[aperture.sample(64)].path_gradient(points)
    slopes = np.einsum("pyxk,yxak->pyxa", gradient, axes)
    cycles = np.stack([slopes * f / SPEED_OF_LIGHT_M_S for f in (frequency_hz[0], frequency_hz[-1])])
    widest = float(np.ptp(cycles.reshape(-1, 8, 8, 2), axis=0).max())
    return _one_two_five(1.0 / (PIXELS_PER_CELL * widest))


MOST_PIXELS = 25_000_000
"""Largest number of pixels of an automatic grid: 200 MB per image."""

_FEWEST_PIXELS = 250_000  # number of pixels that is permitted for any recording


def most_pixels(pulses: int, subcarriers: int) -> int:
    """Return the largest number of pixels of an automatic grid, which corresponds to one resolution cell per sample.

    A resolution cell has `PIXELS_PER_CELL` pixels along each axis.

    Examples
    --------
    >>> most_pixels(300, 1024), most_pixels(10, 512), most_pixels(10**6, 1024)
    (2764800, 250000, 25000000)
    """
    return min(MOST_PIXELS, max(_FEWEST_PIXELS, round(PIXELS_PER_CELL**2) * pulses * subcarriers))


def coarsened(spacing_m: float, bounds_m: tuple[float, float, float, float], most: int) -> float:
    """Return a spacing not below `spacing_m`, from the series 1-2-5, with at most `most` pixels within the bounds.

    Examples
    --------
    >>> coarsened(0.01, (0.0, 0.0, 106.0, 106.0), 25_000_000), coarsened(0.5, (0.0, 0.0, 106.0, 106.0), 25_000_000)
    (0.05, 0.5)
    """
    xmin, ymin, xmax, ymax = bounds_m
    least = ((xmax - xmin) * (ymax - ymin) / most) ** 0.5
    if spacing_m >= least:
        return spacing_m
    fitting = _one_two_five(least)
    return fitting if fitting >= least * (1 - 1e-9) else _one_two_five(2.5 * fitting)


def _one_two_five(value: float) -> float:
    """Return the largest value of the series 1-2-5 that does not exceed `value`."""
    decade = 10.0 ** np.floor(np.log10(value))
    return float(max(step * decade for step in (1, 2, 5) if step * decade <= value * (1 + 1e-9)))
