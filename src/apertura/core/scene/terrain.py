"""Terrain of a scene (a constant height, a plane, or heights from a DEM), and two simplified terrain models."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apertura.common.arrays import Floats, is_number
from apertura.common.errors import CampaignError, quoted
from apertura.core.scene.grid import SceneGrid

# ---- Terrain models: flat, a plane, heights of a grid
#
# A `Terrain` provides the heights of a grid, of a window of a grid, or of single pixels.


_TILE_PX = 512  # side of the tiles in which heights at single pixels are read


class Terrain(Protocol):
    """Terrain heights; a subclass defines `heights`, from which the other methods are derived."""

    def heights(self, grid: SceneGrid) -> Floats:
        """Return the height of each pixel of a grid or of a window of a grid.

        Parameters
        ----------
        grid
            Grid or window of a grid; the height of a pixel is bit-identical in any window.

        Returns
        -------
        ndarray
            (row, column) float64, metres above the ellipsoid of `grid.crs` (z in a local frame).
        """

    def heights_at(self, grid: SceneGrid, row: ArrayLike, column: ArrayLike) -> Floats:
        """Interpolate heights (m) bilinearly at fractional pixel indices, (...,) float64; NaN outside the grid."""
        rows, columns = (np.asarray(axis, np.float64) for axis in np.broadcast_arrays(row, column))
        heights = np.full(rows.shape, np.nan)
        for tile in grid.tiles(_TILE_PX):
            inside = np.logical_and(*(_within(part, at) for part, at in zip(tile, (rows, columns), strict=True)))
            if inside.any():
                at = [
                    np.clip(axis[inside], 0, size - 1) for axis, size in zip((rows, columns), grid.shape, strict=True)
                ]
                first = [int(axis.min()) for axis in at]
                window = slice(first[0], int(at[0].max()) + 2), slice(first[1], int(at[1].max()) + 2)
                heights[inside] = bilinear(self.heights(grid[window])[None], at[0] - first[0], at[1] - first[1])[0]
        return heights

    def positions(self, grid: SceneGrid) -> Floats:
        """Return the positions (m) of the pixels on the terrain, (row, column, 3) float64, in the processing frame."""
        return grid.positions(self.heights(grid))

    def positions_at(self, grid: SceneGrid, row: ArrayLike, column: ArrayLike) -> Floats:
        """Return the positions (m) of fractional pixel indices on the terrain, (..., 3) float64."""
        return grid.positions_at(row, column, self.heights_at(grid, row, column))

    @property
    def spec(self) -> dict[str, Any]:
        """Parameters of the terrain as JSON values for provenance; empty if a file or stage defines the terrain."""
        return {}


@dataclass(frozen=True)
class FlatGround(Terrain):
    """Terrain of constant height.

    Attributes
    ----------
    height_m
        Height above the ellipsoid, or z of the local frame, metres.

    Examples
    --------
    >>> FlatGround(620.0).heights(SceneGrid("local", 0.0, 2.0, 1.0, (2, 3)))
    array([[620., 620., 620.],
           [620., 620., 620.]])
    """

    height_m: float

    def __post_init__(self) -> None:
        if not is_number(self.height_m):
            raise CampaignError(
                quoted(self.height_m), "FlatGround: height_m", "a finite number of metres", "Pass one number."
            )

    def heights(self, grid: SceneGrid) -> Floats:
        """Return the height at every pixel, as a broadcast view."""
        return np.broadcast_to(np.float64(self.height_m), grid.shape)

    def heights_at(self, grid: SceneGrid, row: ArrayLike, column: ArrayLike) -> Floats:  # noqa: ARG002
        """Return the constant height, also outside the grid."""
        return np.full(np.broadcast_shapes(np.shape(row), np.shape(column)), self.height_m)

    def positions(self, grid: SceneGrid) -> Floats:
        """Return the positions of the pixels at the constant height; this is faster than for varying heights."""
        return grid.positions(self.height_m)

    @property
    def spec(self) -> dict[str, Any]:
        """The height as JSON values."""
        return asdict(self)


@dataclass(frozen=True)
class Plane(Terrain):
    """Tilted plane in map coordinates.

    Attributes
    ----------
    x_m, y_m, height_m
        A point of the plane: easting and northing in the CRS of the grid, and height above the ellipsoid (z in a local
        frame).
    east, north
        Slope eastward and northward, metres per metre.

    Examples
    --------
    >>> Plane(0.5, 1.5, 10.0, east=0.1, north=-1.0).heights(SceneGrid("local", 0.0, 2.0, 1.0, (2, 3)))
    array([[10. , 10.1, 10.2],
           [11. , 11.1, 11.2]])
    """

    x_m: float
    y_m: float
    height_m: float
    east: float
    north: float

    @classmethod
    def through(cls, grid: SceneGrid, height_m: Floats) -> "Plane":
        """Fit a plane by least squares to the heights at the pixels of a grid, (row, column), metres.

        Examples
        --------
        >>> plane = Plane(0.0, 0.0, 620.0, east=0.2, north=0.1)
        >>> grid = SceneGrid("local", 0.0, 30.0, 1.0, (30, 40))
        >>> bool(np.allclose(Plane.through(grid, plane.heights(grid)).heights(grid), plane.heights(grid)))
        True
        """
        x, y = np.meshgrid(grid.x_m - grid.x_m[0], grid.y_m - grid.y_m[0])
        basis = np.stack([np.ones(x.size), x.ravel(), y.ravel()], -1)
        height, east, north = np.linalg.lstsq(basis, height_m.ravel() - height_m.mean())[0]
        return cls(float(grid.x_m[0]), float(grid.y_m[0]), float(height_m.mean() + height), float(east), float(north))

    def heights(self, grid: SceneGrid) -> Floats:
        """Return the height of the plane at every pixel."""
        return self._over(grid.x_m, grid.y_m[:, None])

    def heights_at(self, grid: SceneGrid, row: ArrayLike, column: ArrayLike) -> Floats:
        """Return the height of the plane at fractional pixel indices, also outside the grid."""
        xy_m = grid.map_at(*np.broadcast_arrays(row, column))
        return self._over(xy_m[..., 0], xy_m[..., 1])

    def _over(self, x_m: Floats, y_m: Floats) -> Floats:
        return np.asarray(self.height_m + self.east * (x_m - self.x_m) + self.north * (y_m - self.y_m))

    @property
    def spec(self) -> dict[str, Any]:
        """A point and the slopes as JSON values."""
        return asdict(self)


def ground_of(terrain: Terrain | float | None, grid: SceneGrid) -> Terrain:
    """Convert an argument to a terrain: a number gives a flat terrain; the default in a local frame has height 0.

    Raises
    ------
    CampaignError
        If the terrain of a georeferenced grid is missing, or if an argument has a wrong type.

    Examples
    --------
    >>> ground_of(2.5, SceneGrid("local", 0.0, 0.0, 1.0, (4, 4)))
    FlatGround(height_m=2.5)
    """
    if not isinstance(grid, SceneGrid):
        raise CampaignError(quoted(grid), "grid", "a SceneGrid", "Create one by SceneGrid.from_bounds(crs, bounds_m).")
    if terrain is None and grid.frame == "ecef":
        raise CampaignError(
            "no terrain for a georeferenced grid",
            where="terrain",
            expected=f"terrain heights above the ellipsoid of {grid.crs}",
            remedy="Pass a height in metres, or a terrain such as that of the scene of an opened campaign.",
        )
    if terrain is None or (isinstance(terrain, int | float | np.floating) and not isinstance(terrain, bool)):
        return FlatGround(float(terrain or 0.0))
    if isinstance(terrain, bool) or not hasattr(terrain, "positions_at"):
        raise CampaignError(
            quoted(terrain) if isinstance(terrain, str | Path) else f"an object of type {type(terrain).__name__}",
            where="terrain",
            expected="a height in metres, a FlatGround, a Plane or a Dem",
            remedy="Open a DEM file by apertura.open_dem(path, grid, datum=...).",
        )
    return terrain


class _Array(Protocol):
    def __getitem__(self, window: tuple[slice, slice], /) -> Any: ...


@dataclass(frozen=True, eq=False)
class GridHeights(Terrain):
    """Terrain heights at the pixels of a grid, such as the heights of the stage `terrain`.

    Attributes
    ----------
    grid
        The whole grid.
    height_m
        (row, column) float64, metres; a numpy or zarr array, which is read by windows.

    Examples
    --------
    >>> grid = SceneGrid("local", 0.0, 2.0, 1.0, (2, 3))
    >>> GridHeights(grid, np.arange(6.0).reshape(2, 3)).heights_at(grid, 0.5, [0.0, 1.5])
    array([1.5, 3. ])
    """

    grid: SceneGrid
    height_m: _Array

    def heights(self, grid: SceneGrid) -> Floats:
        """Return the heights of a window of the grid; for other grids, heights are interpolated bilinearly."""
        if (grid.crs, grid.west_m, grid.north_m, grid.spacing_m) != (
            self.grid.crs, self.grid.west_m, self.grid.north_m, self.grid.spacing_m,
        ):  # fmt: skip
            return self.heights_at(self.grid, *self.grid.pixel_of(grid.x_m, grid.y_m[:, None]))
        rows, columns = (slice(at, at + size) for at, size in zip(grid.first, grid.shape, strict=True))
        return np.asarray(self.height_m[rows, columns], np.float64)


def bilinear(values: Floats, row: Floats, column: Floats) -> Floats:
    """Interpolate values bilinearly between pixels, (layer, ...); a pixel with weight 0 may be NaN.

    Parameters
    ----------
    values
        (layer, row, column) float64.
    row, column
        Fractional indices in shapes that broadcast; values are extrapolated linearly beyond the edges.
    """
    first = [
        np.clip(np.floor(axis), 0, max(0, size - 2)).astype(np.int64)
        for axis, size in zip((row, column), values.shape[1:], strict=True)
    ]
    second = [np.minimum(at + 1, size - 1) for at, size in zip(first, values.shape[1:], strict=True)]
    down, right = row - first[0], column - first[1]
    corners = [values[:, r, c] for r in (first[0], second[0]) for c in (first[1], second[1])]
    return _between(_between(corners[0], corners[1], right), _between(corners[2], corners[3], right), down)


def _between(low: Floats, high: Floats, share: Floats) -> Floats:
    mixed = (1 - share) * low + share * high
    return np.where(np.abs(share) < 1e-9, low, np.where(np.abs(share - 1) < 1e-9, high, mixed))


def _within(part: slice, at: Floats) -> NDArray[np.bool_]:
    return np.asarray((at >= part.start - 0.5) & (at < part.stop - 0.5))


# ---- Terrain of a scene and two simplified models

_BLOCKS = 33


@dataclass(frozen=True)
class GroundModels:
    """Terrain of a scene and two simplified models, with the largest errors of the models.

    Attributes
    ----------
    full, level, plane
        The terrain, a model of constant height, and the best-fitting plane.
    relief_m, off_plane_m
        Largest differences of the terrain from `level` and from `plane`, metres.
    """

    full: Terrain
    level: FlatGround
    plane: Plane
    relief_m: float
    off_plane_m: float

    @classmethod
    def of(cls, terrain: Terrain, level: FlatGround | None, grid: SceneGrid) -> "GroundModels":
        """Fit the simplified models to the heights of a terrain at the centres of blocks of pixels.

        If no level is given, `level` has the mean of these heights; a flat terrain is used as `level` itself.

        Examples
        --------
        >>> grid = SceneGrid("local", 0.0, 8.0, 1.0, (8, 8))
        >>> models = GroundModels.of(Plane(0.0, 4.0, 7.0, east=0.0, north=0.5), FlatGround(7.0), grid)
        >>> models.relief_m, round(models.off_plane_m, 9)
        (1.75, 0.0)
        """
        blocks = grid.coarse(_BLOCKS)
        heights = terrain.heights(blocks)
        if level is None:
            level = terrain if isinstance(terrain, FlatGround) else FlatGround(float(np.nanmean(heights)))
        heights = np.where(np.isfinite(heights), heights, level.height_m)  # voids between pixels have no effect
        plane = Plane.through(blocks, heights)
        off_m = (np.abs(heights - model.heights(blocks)).max() for model in (level, plane))
        return cls(terrain, level, plane, *map(float, off_m))

    @classmethod
    def flat(cls, height_m: float = 0.0) -> "GroundModels":
        """Return the models of a flat terrain, which are all identical."""
        level = FlatGround(height_m)
        return cls(level, level, Plane(0.0, 0.0, height_m, 0.0, 0.0), 0.0, 0.0)

    def model(self, name: str) -> Terrain:
        """Return the model with the name used in a decision: 'plane' (level), 'tilted_plane' or 'dem'."""
        return {"plane": self.level, "tilted_plane": self.plane, "dem": self.full}[name]
