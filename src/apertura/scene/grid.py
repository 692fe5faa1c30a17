"""The scene grid as an immutable value: CRS, origin, spacing, shape, ground height; sliceable into tiles."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from apertura.errors import CampaignError
from apertura.geometry.geodesy import ecef_from_projected
from apertura.scene.pixel_positions import BLOCK_PX, block

LOCAL = "local"


@dataclass(frozen=True)
class SceneGrid:
    """North-up pixels on the ground.

    Attributes
    ----------
    crs
        What pyproj reads, or 'local' for Cartesian axes without a place on Earth (x east, y north, z up).
    west_m, north_m
        Outer corner of the whole grid, metres in `crs`.
    spacing_m
        Pixel spacing, metres.
    shape
        Rows, columns.
    height_m
        Ground height: ellipsoidal metres, or z of the local frame.
    first
        Row and column of pixel (0, 0) in the whole grid: a window counts from the whole grid's corner, so that its
        coordinates are the whole's to the bit.

    Examples
    --------
    >>> grid = SceneGrid("EPSG:32632", 500000.0, 100.0, 0.5, (40, 60), 10.0)
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
    height_m: float
    first: tuple[int, int] = (0, 0)

    @classmethod
    def from_bounds(
        cls, crs: str, bounds_m: tuple[float, float, float, float], *, spacing_m: float, height_m: float
    ) -> "SceneGrid":
        """Return the grid anchored at (xmin, ymax) of `bounds_m` (outer pixel edges).

        Raises
        ------
        CampaignError
            If the CRS is unknown, is not in metres, or its area of use does not hold the bounds.
        """
        xmin, ymin, xmax, ymax = bounds_m
        shape = (max(1, round((ymax - ymin) / spacing_m)), max(1, round((xmax - xmin) / spacing_m)))
        if crs != LOCAL:
            _check_crs(crs, bounds_m)
        return cls(crs, xmin, ymax, spacing_m, shape, height_m)

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """[xmin, ymin, xmax, ymax], outer pixel edges."""
        (west, north), (rows, columns) = self._corner, self.shape
        return (west, north - rows * self.spacing_m, west + columns * self.spacing_m, north)

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """Affine coefficients a…f of (column, row) → (x, y), as rasterio takes them."""
        west, north = self._corner
        return (self.spacing_m, 0.0, west, 0.0, -self.spacing_m, north)

    @property
    def _corner(self) -> tuple[float, float]:
        return (self.west_m + self.first[1] * self.spacing_m, self.north_m - self.first[0] * self.spacing_m)

    @property
    def x_m(self) -> NDArray[np.float64]:
        """Pixel centres eastward, (column,) float64."""
        return self._easting(np.arange(self.shape[1]))

    @property
    def y_m(self) -> NDArray[np.float64]:
        """Pixel centres from north to south, (row,) float64."""
        return self._northing(np.arange(self.shape[0]))

    def _easting(self, column: ArrayLike) -> NDArray[np.float64]:
        return np.asarray(self.west_m + (np.asarray(column) + self.first[1] + 0.5) * self.spacing_m, np.float64)

    def _northing(self, row: ArrayLike) -> NDArray[np.float64]:
        return np.asarray(self.north_m - (np.asarray(row) + self.first[0] + 0.5) * self.spacing_m, np.float64)

    def __getitem__(self, window: tuple[slice, slice]) -> "SceneGrid":
        """Return the grid of a window of rows and columns, without steps."""
        rows, columns = (range(size)[part] for part, size in zip(window, self.shape, strict=True))
        first = (self.first[0] + rows.start, self.first[1] + columns.start)
        return replace(self, first=first, shape=(len(rows), len(columns)))

    def tiles(self, side_px: int) -> Iterator[tuple[slice, slice]]:
        """Yield the windows of square tiles, row by row; those at the south and east edges may be smaller."""
        for row in range(0, self.shape[0], side_px):
            for column in range(0, self.shape[1], side_px):
                yield (
                    slice(row, min(row + side_px, self.shape[0])),
                    slice(column, min(column + side_px, self.shape[1])),
                )

    def positions(self, height_m: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Return the pixel centres in the processing frame.

        Parameters
        ----------
        height_m
            (row, column) float64, height of each pixel, metres, counted as `self.height_m`; flat ground if None.

        Returns
        -------
        ndarray
            (row, column, 3) float64 metres: ECEF, or the local frame's own axes.
        """
        if self.crs == LOCAL:
            return self._place(*np.meshgrid(self.x_m, self.y_m), height_m)
        places = np.empty((*self.shape, 3))
        for rows, columns in self._blocks():
            height = None if height_m is None else height_m[rows, columns]
            places[rows, columns] = self[rows, columns]._of_block(height)
        return places

    def _blocks(self) -> Iterator[tuple[slice, slice]]:
        """Yield the parts of blocks of the whole grid that this window holds."""
        rows, columns = (
            [slice(*cuts) for cuts in pairwise([0, *range(BLOCK_PX - first % BLOCK_PX, size, BLOCK_PX), size])]
            for first, size in zip(self.first, self.shape, strict=True)
        )
        return product(rows, columns)

    def _of_block(self, height_m: NDArray[np.float64] | None) -> NDArray[np.float64]:
        index = (self.first[0] // BLOCK_PX, self.first[1] // BLOCK_PX)
        found = block(self.crs, (self.north_m, self.west_m), self.spacing_m, self.height_m, index)
        if not found.exact:
            return self._place(*np.meshgrid(self.x_m, self.y_m), height_m)
        row, column = (np.arange(size) + at % BLOCK_PX for size, at in zip(self.shape, self.first, strict=True))
        return found.positions(row, column, None if height_m is None else height_m - self.height_m)

    def positions_at(
        self, row: ArrayLike, column: ArrayLike, height_m: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return (..., 3) float64 positions (m) of fractional pixel indices; (0, 0) is the first pixel's centre.

        Examples
        --------
        >>> SceneGrid("local", 0.0, 4.0, 1.0, (4, 6), 0.0).positions_at([0], [1], np.array([2.5]))
        array([[1.5, 3.5, 2.5]])
        """
        return self._place(self._easting(column), self._northing(row), height_m)

    def direction(self, vector_m: NDArray[np.float64], row: float, column: float) -> tuple[float, float]:
        """Return how far (east, north) along the grid's axes a vector of the processing frame points at a pixel.

        Examples
        --------
        >>> SceneGrid("local", 0.0, 8.0, 0.5, (16, 16), 0.0).direction(np.array([3.0, 4.0, 1.0]), 2.0, 5.0)
        (3.0, 4.0)
        """
        here, east, north = self.positions_at([row, row, row - 1], [column, column + 1, column])
        axes = np.stack([east - here, north - here])
        steps = axes @ vector_m / np.linalg.norm(axes, axis=1)
        return float(steps[0]), float(steps[1])

    def map_at(self, row: ArrayLike, column: ArrayLike) -> NDArray[np.float64]:
        """Return (..., 2) float64 easting and northing (m) in `crs` of fractional pixel indices."""
        return np.stack([self._easting(column), self._northing(row)], -1)

    def _place(
        self, x: NDArray[np.float64], y: NDArray[np.float64], height_m: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        height = np.full_like(x, self.height_m) if height_m is None else np.asarray(height_m, np.float64)
        return np.stack([x, y, height], -1) if self.crs == LOCAL else ecef_from_projected(self.crs, x, y, height)


def _check_crs(crs: str, bounds_m: tuple[float, float, float, float]) -> None:
    where = "config/config.yaml: scene"
    try:
        system = CRS(crs)
    except CRSError as error:
        raise CampaignError(
            f"crs {crs!r} is unknown to PROJ",
            where=where,
            expected="an EPSG code such as EPSG:32632, auto, or local",
            remedy="Correct scene.crs.",
        ) from error
    if not system.is_projected or any(axis.unit_name != "metre" for axis in system.axis_info):
        raise CampaignError(
            f"crs {crs} ({system.name}) is not projected in metres",
            where=where,
            expected="a projected CRS in metres, such as a UTM zone",
            remedy="Choose another scene.crs.",
        )
    _check_area_of_use(system, bounds_m, where)


def _check_area_of_use(system: CRS, bounds_m: tuple[float, float, float, float], where: str) -> None:
    area = system.area_of_use
    if area is None:
        return
    inverse = Transformer.from_crs(system, system.geodetic_crs, always_xy=True)
    xmin, ymin, xmax, ymax = bounds_m
    longitude, latitude = inverse.transform([xmin, xmax, xmin, xmax], [ymin, ymin, ymax, ymax])
    for lon, lat in zip(longitude, latitude, strict=True):
        if not (np.isfinite(lon) and area.west <= lon <= area.east and area.south <= lat <= area.north):
            raise CampaignError(
                f"bounds_m {list(bounds_m)} reach longitude {lon:.4f}, latitude {lat:.4f}",
                where=where,
                expected=f"inside the area of use of {system.name}: longitude {area.west} to {area.east}, "
                f"latitude {area.south} to {area.north}",
                remedy="Correct scene.bounds_m (easting before northing) or scene.crs.",
            )
