"""The DEM under the scene: whether it opens, reaches over the scene, and has posts that no ground can have."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.scene.dem import Dem
from apertura.core.scene.grid import SceneGrid
from apertura.pipeline.check.inspected import Inspected

TALLEST_M = 500.0
"""Nothing narrower than two posts stands out of all land about it by more, and by more than ten posts are wide."""

_STEEPEST_POSTS = 10.0
_PER_POST = 2  # samples
_WINDOW = 7  # samples: three and a half posts
_MOST_SAMPLES = 1_000_000
_COARSE = 256
_MARGIN = _WINDOW - 1  # samples about the scene, of which nothing is said


def check_dem(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield a DEM or grid of a geoid that does not open, a DEM that ends inside the scene, heights not on Earth."""
    yield from inspected.no_ground
    dem, grid = inspected.ground and inspected.ground.dem, inspected.grid
    if dem and grid:
        dem.check_cover(grid)


def check_spikes(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield a DEM with single posts under the scene that stand out of it like needles, up or down.

    Heights are sampled twice a post. An opening (the largest minimum over windows of seven samples that hold a place)
    takes away what is narrower than the window and leaves slopes, ridges and cliffs, however high; a closing does so
    from below. What is taken away must be higher than 500 m, and than ten posts are wide: steeper than 80° all round.
    Of a scene larger than a million samples, that many about its middle are looked at.
    """
    dem, grid = inspected.ground and inspected.ground.dem, inspected.grid
    if not dem or not grid:
        return
    post_m = post_width_m(dem, grid)
    window = sampled_about(grid, post_m / _PER_POST)
    heights = _heights(dem, grid, window)
    spikes = needles(heights, taller_than_m=max(TALLEST_M, _STEEPEST_POSTS * post_m))
    if not spikes.any():
        return
    row, column = np.argwhere(spikes)[0]
    x, y = window.map_at(row, column)
    yield CampaignError(
        f"{heights[row, column]:.0f} m at x {x:.1f}, y {y:.1f}, where the land about it has "
        f"{np.nanmedian(heights[max(row - 6, 0) : row + 7, max(column - 6, 0) : column + 7]):.0f} m; "
        f"{int(spikes.sum())} of {spikes.size} samples stand out so",
        where=dem.path,
        expected=f"posts that stand out of all their neighbours by at most {TALLEST_M:.0f} m, or ten posts' width",
        remedy="Set those posts to nodata and fill them with a GIS.",
    )


def _heights(dem: Dem, grid: SceneGrid, window: SceneGrid) -> NDArray[np.float64]:
    """Return the heights of a window; of the scene alone where posts beside it have no height on Earth."""
    try:
        return dem.heights(window)
    except CampaignError:
        dem.heights(grid.coarse(_COARSE))
    return np.full(window.shape, np.nan)


def post_width_m(dem: Dem, grid: SceneGrid) -> float:
    """Return how far posts of a DEM are apart at the middle of a grid, metres, the narrower way."""
    xmin, ymin, xmax, ymax = grid.bounds_m
    x, y = (xmin + xmax) / 2 + np.array([0.0, 1.0, 0.0]), (ymin + ymax) / 2 + np.array([0.0, 0.0, 1.0])
    if grid.crs != LOCAL:
        x, y = Transformer.from_crs(grid.crs, dem.horizontal, always_xy=True).transform(x, y)
    a, b, _, d, e, _ = dem.pixel_from_map
    posts = np.stack([a * x + b * y, d * x + e * y])
    per_metre = np.linalg.norm(posts[:, 1:] - posts[:, :1], axis=0).max()
    return float(1 / per_metre)


def sampled_about(grid: SceneGrid, spacing_m: float) -> SceneGrid:
    """Return samples of so many metres over a grid and a margin about it, at most a million in its middle."""
    (xmin, ymin, xmax, ymax), most = grid.bounds_m, int(np.sqrt(_MOST_SAMPLES))
    sides = [min(round(side / spacing_m) + 2 * _MARGIN, most) for side in (xmax - xmin, ymax - ymin)]
    west, north = (xmin + xmax - sides[0] * spacing_m) / 2, (ymin + ymax + sides[1] * spacing_m) / 2
    return SceneGrid(grid.crs, west, north, spacing_m, (sides[1], sides[0]))


def needles(heights: NDArray[np.float64], *, taller_than_m: float) -> NDArray[np.bool_]:
    """Return (row, column) bool: what stands out of a surface, up or down, narrower than a window of seven samples.

    Within two windows' half widths of a void or of the edge nothing is said: land goes on there as nobody knows.

    Examples
    --------
    >>> cliff = np.where(np.arange(40) < 20, 0.0, 3000.0) + np.zeros((40, 1))
    >>> spike = cliff.copy()
    >>> spike[10, 10] = 900.0
    >>> needles(cliff, taller_than_m=500.0).sum(), np.argwhere(needles(spike, taller_than_m=500.0))
    (np.int64(0), array([[10, 10]]))
    """
    with np.errstate(invalid="ignore"):
        up = heights - _over_windows(_over_windows(heights, np.fmin), np.fmax)
        down = _over_windows(_over_windows(heights, np.fmax), np.fmin) - heights
        near = _over_windows(_over_windows(heights, np.maximum), np.maximum)  # NaN beside a void and an edge
        return np.asarray(((up > taller_than_m) | (down > taller_than_m)) & np.isfinite(near))


def _over_windows(heights: NDArray[np.float64], by: np.ufunc) -> NDArray[np.float64]:
    """Return the extreme of the window about each sample, both ways; outside is NaN, as voids are."""
    half = _WINDOW // 2
    for axis in (0, 1):
        padded = np.pad(heights, [(half, half) if way == axis else (0, 0) for way in (0, 1)], constant_values=np.nan)
        parts = [np.take(padded, range(first, first + heights.shape[axis]), axis) for first in range(_WINDOW)]
        heights = by.reduce(parts)
    return heights
