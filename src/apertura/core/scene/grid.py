"""Immutable grid of a scene: CRS, origin, spacing and shape. Slices of a grid are windows; heights are separate."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, product
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apertura.common.arrays import Floats, is_number
from apertura.common.errors import CampaignError, quoted
from apertura.core.geometry.geodesy import LOCAL, frame_from_map, local_crs, map_from_frame
from apertura.core.scene.map_crs import BLOCK_PX, axis_attributes, block, check_crs, grid_mapping


@dataclass(frozen=True)
class SceneGrid:
    """North-up pixel grid on a map; the heights of the pixels are provided by `apertura.core.scene.terrain`.

    Attributes
    ----------
    crs
        A pyproj definition, or 'local' for Cartesian axes without a geodetic position (x east, y north, z up).
    west_m, north_m
        Outer north-west corner of the whole grid, metres in `crs`.
    spacing_m
        Pixel spacing, metres.
    shape
        Rows, columns.
    first
        Row and column of pixel (0, 0) in the whole grid. Coordinates of a window are computed from the corner of the
        whole grid, so that coordinates of a pixel are bit-identical in all windows.
    name
        Name of a local frame in GIS software.

    Raises
    ------
    CampaignError
        If the spacing or a side is not positive, or a corner is not finite.

    Examples
    --------
    >>> grid = SceneGrid("EPSG:32632", 500000.0, 100.0, 0.5, (40, 60))
    >>> grid.bounds_m
    (500000.0, 80.0, 500030.0, 100.0)
    >>> grid[0:10, 5:10].shape, float(grid[0:10, 5:10].x_m[0]) == float(grid.x_m[5])
    ((10, 5), True)
    """

    crs: str
    west_m: float
    north_m: float
    spacing_m: float
    shape: tuple[int, int]
    first: tuple[int, int] = (0, 0)
    name: str = LOCAL

    def __post_init__(self) -> None:
        sides = np.asarray(self.shape, object)
        if sides.shape != (2,) or not all(isinstance(side, Integral) and int(side) > 0 for side in sides):
            raise CampaignError(
                quoted(self.shape), "SceneGrid: shape", "numbers of rows and columns", "Pass two integers above 0."
            )
        rows, columns = map(int, sides)  # products of short integers would overflow
        object.__setattr__(self, "shape", (rows, columns))
        metres = {"west_m": self.west_m, "north_m": self.north_m, "spacing_m": self.spacing_m}
        wrong = [name for name, value in metres.items() if not (isinstance(value, Real) and np.isfinite(value))]
        if wrong or self.spacing_m <= 0:
            name = wrong[0] if wrong else "spacing_m"
            above = " above 0" if name == "spacing_m" else ""
            raise CampaignError(
                quoted(metres[name]),
                f"SceneGrid: {name}",
                f"a finite number of metres{above}",
                f"Correct {name}.",
            )

    @classmethod
    def from_bounds(
        cls, crs: str, bounds_m: tuple[float, float, float, float], *, spacing_m: float, name: str = LOCAL
    ) -> "SceneGrid":
        """Return the grid with the given bounds; its outer north-west corner is (xmin, ymax).

        Raises
        ------
        CampaignError
            If the CRS is unknown or not in metres; the area of use of the CRS does not contain the bounds; `bounds_m`
            is not [xmin, ymin, xmax, ymax]; or the spacing is not positive.
        """
        try:
            xmin, ymin, xmax, ymax = map(float, bounds_m)
            ordered = -np.inf < xmin < xmax < np.inf and -np.inf < ymin < ymax < np.inf
        except (TypeError, ValueError):
            ordered = False
        if not ordered:
            raise CampaignError(
                quoted(bounds_m),
                where="SceneGrid.from_bounds: bounds_m",
                expected="xmin, ymin, xmax, ymax of the outer edges in metres, with xmin < xmax and ymin < ymax",
                remedy="Pass the bounds in this order.",
            )
        if not (is_number(spacing_m) and spacing_m > 0):
            where = "SceneGrid.from_bounds: spacing_m"
            raise CampaignError(quoted(spacing_m), where, "a finite number of metres above 0", "Correct spacing_m.")
        shape = (max(1, round((ymax - ymin) / spacing_m)), max(1, round((xmax - xmin) / spacing_m)))
        if crs != LOCAL:
            check_crs(crs, bounds_m)
        return cls(crs, xmin, ymax, spacing_m, shape, name=name)

    @property
    def frame(self) -> str:
        """Frame of positions: 'local', or 'ecef' (EPSG:4978)."""
        return "local" if self.crs == LOCAL else "ecef"

    @property
    def crs_wkt(self) -> str:
        """CRS of rasters on this grid, in the WKT that GDAL writes."""
        from rasterio.crs import CRS

        return str(CRS.from_user_input(local_crs(self.name) if self.crs == LOCAL else self.crs).to_wkt())

    @property
    def coordinates(self) -> dict[str, Any]:
        """Coordinates y, x and spatial_ref of an xarray raster on this grid, following the CF conventions."""
        step, _, west, _, _, north = self.transform
        reference = {"long_name": "coordinate reference system", **grid_mapping(self.crs_wkt)}
        reference |= {"GeoTransform": f"{west} {step} 0 {north} 0 {-step}"}
        y, x = (axis_attributes(side, projected=self.crs != LOCAL) for side in "yx")
        return {"y": ("y", self.y_m, y), "x": ("x", self.x_m, x), "spatial_ref": ((), 0, reference)}

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """[xmin, ymin, xmax, ymax] of the outer pixel edges, metres."""
        (west, north), (rows, columns) = self._corner, self.shape
        return (west, north - rows * self.spacing_m, west + columns * self.spacing_m, north)

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """Affine coefficients a…f of (column, row) → (x, y), in the order used by rasterio."""
        west, north = self._corner
        return (self.spacing_m, 0.0, west, 0.0, -self.spacing_m, north)

    @property
    def _corner(self) -> tuple[float, float]:
        return (self.west_m + self.first[1] * self.spacing_m, self.north_m - self.first[0] * self.spacing_m)

    @property
    def x_m(self) -> Floats:
        """Eastings of pixel centres from west to east, (column,) float64."""
        return self._easting(np.arange(self.shape[1]))

    @property
    def y_m(self) -> Floats:
        """Northings of pixel centres from north to south, (row,) float64."""
        return self._northing(np.arange(self.shape[0]))

    def _easting(self, column: ArrayLike) -> Floats:
        return np.asarray(self.west_m + (np.asarray(column) + self.first[1] + 0.5) * self.spacing_m, np.float64)

    def _northing(self, row: ArrayLike) -> Floats:
        return np.asarray(self.north_m - (np.asarray(row) + self.first[0] + 0.5) * self.spacing_m, np.float64)

    def __getitem__(self, window: tuple[slice, slice]) -> "SceneGrid":
        """Return the grid of a window of rows and columns, without steps."""
        if not (isinstance(window, tuple) and len(window) == 2 and all(isinstance(part, slice) for part in window)):
            raise CampaignError(
                quoted(window), "SceneGrid[…]", "slices of rows and of columns", "Write grid[0:5, 0:5]."
            )
        rows, columns = (range(size)[part] for part, size in zip(window, self.shape, strict=True))
        first = (self.first[0] + rows.start, self.first[1] + columns.start)
        return replace(self, first=first, shape=(len(rows), len(columns)))

    def tiles(self, side_px: int) -> Iterator[tuple[slice, slice]]:
        """Yield the windows of square tiles, row by row; tiles at the south and east edges may be smaller."""
        for row in range(0, self.shape[0], side_px):
            for column in range(0, self.shape[1], side_px):
                yield (
                    slice(row, min(row + side_px, self.shape[0])),
                    slice(column, min(column + side_px, self.shape[1])),
                )

    def coarse(self, count: int) -> "SceneGrid":
        """Return the grid of square blocks of pixels, with at least `count` blocks along the longer side if possible.

        Examples
        --------
        >>> SceneGrid("local", 0.0, 8.0, 0.5, (16, 40)).coarse(8)
        SceneGrid(crs='local', west_m=0.0, north_m=8.0, spacing_m=2.5, shape=(3, 8), first=(0, 0), name='local')
        """
        west, north = self._corner
        side = max(1, max(self.shape) // count)
        rows, columns = (max(1, size // side) for size in self.shape)
        return SceneGrid(self.crs, west, north, self.spacing_m * side, (rows, columns), name=self.name)

    def positions(self, height_m: ArrayLike) -> Floats:
        """Return the pixel centres in the processing frame.

        Parameters
        ----------
        height_m
            Scalar or (row, column) float64: a common height of all pixels, or the height of each pixel, metres above
            the ellipsoid of `crs` (z in a local frame).

        Returns
        -------
        ndarray
            (row, column, 3) float64, metres, in ECEF or in the local frame.
        """
        height = np.asarray(height_m, np.float64)
        if self.crs == LOCAL:
            return frame_from_map(self.crs, *np.meshgrid(self.x_m, self.y_m), height)
        positions = np.empty((*self.shape, 3))
        for rows, columns in self._blocks():
            part = height[rows, columns] if height.ndim else height
            positions[rows, columns] = self[rows, columns]._positions_in_block(part)
        return positions

    def _blocks(self) -> Iterator[tuple[slice, slice]]:
        """Yield the intersections of the blocks of the whole grid with this window."""
        rows, columns = (
            [slice(*cuts) for cuts in pairwise([0, *range(BLOCK_PX - first % BLOCK_PX, size, BLOCK_PX), size])]
            for first, size in zip(self.first, self.shape, strict=True)
        )
        return product(rows, columns)

    def _positions_in_block(self, height_m: Floats) -> Floats:
        index = (self.first[0] // BLOCK_PX, self.first[1] // BLOCK_PX)
        polynomials = block(self.crs, (self.north_m, self.west_m), self.spacing_m, index)
        if not polynomials.exact:
            return frame_from_map(self.crs, *np.meshgrid(self.x_m, self.y_m), height_m)
        row, column = (np.arange(size) + at % BLOCK_PX for size, at in zip(self.shape, self.first, strict=True))
        return polynomials.positions(row, column, height_m)

    def positions_at(self, row: ArrayLike, column: ArrayLike, height_m: ArrayLike) -> Floats:
        """Return the positions (m) of fractional pixel indices, (..., 3) float64; (0, 0) is the first pixel centre.

        Examples
        --------
        >>> SceneGrid("local", 0.0, 4.0, 1.0, (4, 6)).positions_at([0], [1], 2.5)
        array([[1.5, 3.5, 2.5]])
        """
        return frame_from_map(self.crs, self._easting(column), self._northing(row), height_m)

    def map_at(self, row: ArrayLike, column: ArrayLike) -> Floats:
        """Return easting and northing (m) in `crs` of fractional pixel indices, (..., 2) float64."""
        return np.stack([self._easting(column), self._northing(row)], -1)

    def pixel_of(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[Floats, Floats]:
        """Return the fractional row and column of map coordinates (m), the inverse of `map_at`.

        Examples
        --------
        >>> row, column = SceneGrid("local", 0.0, 4.0, 1.0, (4, 6)).pixel_of(1.5, 3.25)
        >>> float(row), float(column)
        (0.25, 1.0)
        """
        row = (self.north_m - np.asarray(y_m, np.float64)) / self.spacing_m - 0.5 - self.first[0]
        column = (np.asarray(x_m, np.float64) - self.west_m) / self.spacing_m - 0.5 - self.first[1]
        return np.asarray(row), np.asarray(column)

    def pixel_below(self, position: Floats) -> Floats:
        """Return (..., 3) float64: fractional row and column, and height (m), of positions in the processing frame.

        Examples
        --------
        >>> SceneGrid("local", 0.0, 8.0, 0.5, (16, 16)).pixel_below(np.array([0.25, 7.75, 3.0]))
        array([0., 0., 3.])
        """
        xyz_m = map_from_frame(self.crs, position)
        return np.stack([*self.pixel_of(xyz_m[..., 0], xyz_m[..., 1]), xyz_m[..., 2]], -1)

    def sample_pixels(self, count: int) -> tuple[Floats, Floats]:
        """Return rows and columns of pixels evenly distributed over the grid, with its corners, (count, count) float64.

        Examples
        --------
        >>> SceneGrid("local", 0.0, 4.0, 1.0, (4, 7)).sample_pixels(3)[1][0]
        array([0., 3., 6.])
        """
        row, column = (np.linspace(0, size - 1, min(size, count)) for size in self.shape)
        rows, columns = np.meshgrid(row, column, indexing="ij")
        return rows, columns

    def sample_points(self, count: int, height_m: float) -> Floats:
        """Return positions (m) of `sample_pixels` at a given height, (count, count, 3) float64, from north to south."""
        return self.positions_at(*self.sample_pixels(count), height_m)
