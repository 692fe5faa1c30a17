"""A DEM in any CRS becomes ellipsoidal heights at the pixels of a grid."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from apertura.common.errors import CampaignError
from apertura.common.raster import opened_raster
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.scene.geoid_grid import undulation
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain, bilinear

LATTICE_M = 50.0
"""Between nodes this far apart, coordinates of another CRS are bilinear to a tenth of a millimetre."""

COVER_NODES = 129
"""Nodes along each side of the scene at which coverage is looked at."""

LOWEST_M, HIGHEST_M = -500.0, 9000.0
"""Land on Earth lies between (Dead Sea −430 m, Everest 8849 m), above whichever datum."""

MOST_POSTS = 100_000_000
"""Posts of a DEM that are held in memory at once."""

_TILE_PX = 512
_EXPECTED = "the raster that was opened before"

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Dem(Terrain):
    """A DEM and what its heights count from; `ap.open_dem` opens one.

    Attributes
    ----------
    path
        A GeoTIFF; band 1 holds heights.
    shape
        Rows and columns of the raster.
    pixel_from_map
        Affine coefficients a…f of (x, y) → (column, row), outer corner of the raster at (0, 0).
    horizontal
        WKT of the raster's CRS without heights; empty in a local frame.
    geodetic
        What pyproj reads: the three-dimensional geodetic CRS whose ellipsoid the undulations count from.
    geoid
        Grid of undulations; None where heights are ellipsoidal already.
    metres_per_unit
        Of the raster's heights, negative where they count downward.

    Notes
    -----
    Source: docs/theory/terrain.md, section 1.
    """

    path: Path
    shape: tuple[int, int]
    pixel_from_map: tuple[float, ...]
    horizontal: str
    geodetic: str
    geoid: Path | None
    metres_per_unit: float

    def heights(self, grid: SceneGrid) -> Floats:
        """Return the height of each pixel of a grid or of a window of it, reading no more of the DEM than that takes.

        Parameters
        ----------
        grid
            Pixels; each comes out the same whatever window it is asked with.

        Returns
        -------
        ndarray
            (row, column) float64, metres above the ellipsoid of `grid.crs` (z in a local frame), bilinear between
            posts; NaN outside the DEM and where one of the posts is a void.

        Raises
        ------
        CampaignError
            If a post that counts has a height that no land on Earth has: a void undeclared, or another unit.
        """
        side = max(1, int(LATTICE_M / grid.spacing_m))
        rows, columns = (np.arange(size) + first for size, first in zip(grid.shape, grid.first, strict=True))
        nodes = [np.arange(axis[0] // side, axis[-1] // side + 2) for axis in (rows, columns)]
        mesh = np.meshgrid(nodes[0] * side - grid.first[0], nodes[1] * side - grid.first[1], indexing="ij")
        place = grid.map_at(*mesh)
        on_nodes = np.stack([*self._posts(grid.crs, place[..., 0], place[..., 1]), self._shift(grid.crs, place)])
        share = [(axis / side - node[0]) for axis, node in zip((rows, columns), nodes, strict=True)]
        column, row, shift = bilinear(on_nodes, share[0][:, None], share[1][None, :])
        return np.asarray(self._sample(row, column) + shift)

    def check_cover(self, grid: SceneGrid) -> None:
        """Raise CampaignError unless the DEM reaches over the whole grid; say how much is missing and where."""
        place = grid.map_at(*np.rint(grid.sample_pixels(COVER_NODES)))
        column, row = self._posts(grid.crs, place[..., 0], place[..., 1])
        outside = ~self._inside(row, column)
        if not outside.any():
            return
        edges = {"north": outside[0], "south": outside[-1], "west": outside[:, 0], "east": outside[:, -1]}
        sides = [name for name, edge in edges.items() if edge.all()]
        sides = sides or [name for name, edge in edges.items() if edge.any()]
        rows, columns = self.shape
        raise CampaignError(
            f"{100 * outside.mean():.1f} % of the scene lies outside the DEM, to the {', '.join(sides) or 'inside'}: "
            f"the scene needs its columns {column.min():.1f} to {column.max():.1f} and rows {row.min():.1f} to "
            f"{row.max():.1f}",
            where=self.path,
            expected=f"a DEM under the whole scene; this one has {columns} columns and {rows} rows",
            remedy="Get the missing part, or make scene.bounds_m smaller.",
        )

    def _inside(self, row: Floats, column: Floats) -> NDArray[np.bool_]:
        reach = 0.5 + 1e-6
        inside = [(-reach <= at) & (at <= size - 1 + reach) for at, size in zip((row, column), self.shape, strict=True)]
        return inside[0] & inside[1]

    def _posts(self, crs: str, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return fractional column and row of map coordinates in the raster: (0, 0) is the first post."""
        a, b, c, d, e, f = self.pixel_from_map
        if self.horizontal:
            x, y = _transformer(crs, self.horizontal).transform(x, y)
            if CRS(self.horizontal).is_geographic:  # 0…360° or −180…180°, as the raster counts
                middle = (self.shape[1] / 2 - c) / a if a else 0.0
                x = x + 360 * np.round((middle - x) / 360)
        return np.asarray(a * x + b * y + c - 0.5), np.asarray(d * x + e * y + f - 0.5)

    def _shift(self, crs: str, place: Floats) -> Floats:
        """Return what turns heights of the DEM into heights above the ellipsoid of `crs`."""
        if crs == LOCAL:
            return np.zeros(place.shape[:-1])
        longitude, latitude = _transformer(crs, CRS(self.geodetic).to_2d()).transform(place[..., 0], place[..., 1])
        shift = np.zeros_like(longitude) if self.geoid is None else undulation(self.geoid, longitude, latitude)
        return np.asarray(
            _transformer(CRS(self.geodetic), CRS(crs).to_3d()).transform(longitude, latitude, shift)[2], np.float64
        )

    def _sample(self, row: Floats, column: Floats) -> Floats:
        """Return the raster's heights (m, above its datum) between posts; NaN outside it."""
        sampled = np.full(row.shape, np.nan)
        inside = self._inside(row, column)
        if not inside.any():
            return sampled
        at = (row[inside], column[inside])
        first, last = (
            [int(np.clip(np.floor(by(axis)), 0, size - 2)) for axis, size in zip(at, self.shape, strict=True)]
            for by in (np.min, np.max)
        )
        from rasterio.windows import Window

        counts = [high + 2 - low for low, high in zip(first, last, strict=True)]
        if counts[0] * counts[1] > MOST_POSTS:
            raise CampaignError(
                f"{counts[0]} × {counts[1]} posts under {row.shape[0]} × {row.shape[1]} pixels",
                where=self.path,
                expected=f"at most {MOST_POSTS} posts at once",
                remedy="Warp the DEM to a spacing near that of the scene with a GIS.",
            )
        with opened_raster(self.path, expected=_EXPECTED, remedy="Copy the DEM again.") as raster:
            window = Window(first[1], first[0], counts[1], counts[0])
            posts = raster.read(1, window=window, masked=True)
            posts = posts.astype(np.float64).filled(np.nan) * raster.scales[0] + raster.offsets[0]
        posts *= self.metres_per_unit
        place = (at[0] - first[0], at[1] - first[1])
        wild = (posts < LOWEST_M) | (posts > HIGHEST_M)
        if self.horizontal and wild.any() and np.isnan(bilinear(np.where(wild, np.nan, 0.0)[None], *place)).any():
            raise self._unearthly(posts, wild, first)
        sampled[inside] = bilinear(posts[None], *place)[0]
        return sampled

    def _unearthly(self, posts: Floats, wild: NDArray[np.bool_], start: list[int]) -> CampaignError:
        values, counts = np.unique(posts[wild], return_counts=True)
        (top, left), (rows, columns) = start, posts.shape
        return CampaignError(
            f"{wild.sum()} of the {wild.size} posts in rows {top} to {top + rows - 1}, columns {left} to "
            f"{left + columns - 1} have no height on Earth, most often {values[counts.argmax()]:g} m",
            where=self.path,
            expected=f"heights between {LOWEST_M:g} m and {HIGHEST_M:g} m",
            remedy="Declare the value that stands for a void as nodata (and fill the voids under the scene), or "
            "correct the unit of the heights.",
        )


@dataclass(frozen=True)
class UncheckedDem(Terrain):
    """A DEM under a scene before the stage `terrain` is made of it: a void is refused as the stage will refuse it.

    Attributes
    ----------
    dem, grid
        The DEM and the whole grid.
    """

    dem: Dem
    grid: SceneGrid

    def heights(self, grid: SceneGrid) -> Floats:
        """Return the DEM's heights; a void at pixels of the scene raises CampaignError with the count over all."""
        heights = self.dem.heights(grid)
        if grid.spacing_m == self.grid.spacing_m and np.isnan(heights).any():
            height_range(self.dem, self.grid, where=self.dem.path)
        return heights


def height_range(terrain: Terrain, grid: SceneGrid, *, where: Path) -> tuple[float, float]:
    """Return the lowest and the highest ground of a scene (m), read tile by tile.

    Parameters
    ----------
    terrain, grid
        The ground, and the whole grid.
    where
        The DEM that the heights come from.

    Raises
    ------
    CampaignError
        If a pixel has no height: how many, and where the first one is.
    """
    voids, first, low, high = 0, "", np.inf, -np.inf
    for window in grid.tiles(_TILE_PX):
        heights = terrain.heights(grid[window])
        void = np.isnan(heights)
        if void.any() and not voids:
            x, y = grid[window].map_at(*np.argwhere(void)[0])
            first = f"x {x:.2f}, y {y:.2f}"
        voids += int(void.sum())
        low, high = (float(by(heights, initial=at)) for by, at in ((np.nanmin, low), (np.nanmax, high)))
    if voids:
        total = grid.shape[0] * grid.shape[1]
        raise CampaignError(
            f"no height at {voids} of {total} pixels of the scene ({100 * voids / total:.2f} %), first at {first}",
            where=where,
            expected="a height at every post under the scene",
            remedy="Fill the voids (NaN or nodata) of the DEM with a GIS, or make scene.bounds_m smaller.",
        )
    return low, high


@lru_cache(maxsize=64)
def _transformer(source: str | CRS, target: str | CRS) -> Transformer:
    try:
        return Transformer.from_crs(source, target, always_xy=True, allow_ballpark=False)
    except ProjError as error:
        raise CampaignError(
            f"PROJ knows no exact way from {CRS(source).name} to {CRS(target).name}",
            where="scene.dem",
            expected="a DEM whose CRS PROJ can relate to the scene's",
            remedy="Warp the DEM into scene.crs with a GIS, and state its datum.",
        ) from error
