"""Terrain under the scene: a DEM in any CRS becomes ellipsoidal heights at the pixels of the grid."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.windows import Window

from apertura.errors import CampaignError
from apertura.scene.geoid import undulation
from apertura.scene.grid import LOCAL, SceneGrid

LATTICE_M = 50.0
"""Between nodes this far apart, coordinates of another CRS are bilinear to a tenth of a millimetre."""

COVER_NODES = 129
"""Nodes along each side of the scene at which coverage is looked at."""

LOWEST_M, HIGHEST_M = -500.0, 9000.0
"""Land on Earth lies between (Dead Sea −430 m, Everest 8849 m), above whichever datum."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Terrain:
    """A DEM and what its heights count from.

    Attributes
    ----------
    path
        A raster that GDAL reads; band 1 holds heights.
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
        on_nodes = np.stack([*self._pixels(grid.crs, place[..., 0], place[..., 1]), self._shift(grid.crs, place)])
        share = [(axis / side - node[0]) for axis, node in zip((rows, columns), nodes, strict=True)]
        column, row, shift = _bilinear(on_nodes, share[0][:, None], share[1][None, :])
        return np.asarray(self._sample(row, column) + shift)

    def check_cover(self, grid: SceneGrid) -> None:
        """Raise CampaignError unless the DEM reaches over the whole grid; say how much is missing and where."""
        nodes = [np.rint(np.linspace(0, size - 1, min(size, COVER_NODES))) for size in grid.shape]
        place = grid.map_at(*np.meshgrid(*nodes, indexing="ij"))
        column, row = self._pixels(grid.crs, place[..., 0], place[..., 1])
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
        near = 0.5 + 1e-6
        return (
            (row >= -near)
            & (row <= self.shape[0] - 1 + near)
            & (column >= -near)
            & (column <= self.shape[1] - 1 + near)
        )

    def _pixels(self, crs: str, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return column and row of places, counted in posts: (0, 0) is the first post."""
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
        sampled = np.full(row.shape, np.nan)
        inside = self._inside(row, column)
        if not inside.any():
            return sampled
        row, column = row[inside], column[inside]
        first = [
            np.clip(np.floor(axis), 0, size - 2).astype(np.int64)
            for axis, size in zip((row, column), self.shape, strict=True)
        ]
        start = [int(axis.min()) for axis in first]
        count = [int(axis.max()) - begin + 2 for axis, begin in zip(first, start, strict=True)]
        with rasterio.open(self.path) as raster:
            posts = raster.read(1, window=Window(start[1], start[0], count[1], count[0]), masked=True)
            posts = posts.astype(np.float64).filled(np.nan) * raster.scales[0] + raster.offsets[0]
        posts *= self.metres_per_unit
        place = (row - start[0], column - start[1])
        wild = (posts < LOWEST_M) | (posts > HIGHEST_M)
        if self.horizontal and wild.any() and np.isnan(_bilinear(np.where(wild, np.nan, 0.0)[None], *place)).any():
            raise self._unearthly(posts, wild, start)
        sampled[inside] = _bilinear(posts[None], *place)[0]
        return sampled

    def _unearthly(self, posts: Floats, wild: NDArray[np.bool_], start: list[int]) -> CampaignError:
        values, counts = np.unique(posts[wild], return_counts=True)
        (top, left), (rows, columns) = start, posts.shape
        return CampaignError(
            f"{wild.sum()} of the {wild.size} posts in rows {top} to {top + rows - 1}, columns {left} to "
            f"{left + columns - 1} have no height on Earth, most often {values[counts.argmax()]:g} m",
            where=self.path,
            expected=f"heights between {LOWEST_M:g} m and {HIGHEST_M:g} m",
            remedy="Declare the value that stands for a void as nodata (and fill the voids under the scene), or mend "
            "the unit of the heights.",
        )


@lru_cache(maxsize=64)
def _transformer(source: str | CRS, target: str | CRS) -> Transformer:
    try:
        return Transformer.from_crs(source, target, always_xy=True, allow_ballpark=False)
    except ProjError as error:
        raise CampaignError(
            f"PROJ knows no exact way from {CRS(source).name} to {CRS(target).name}",
            where="config/config.yaml: scene.dem",
            expected="a DEM whose CRS PROJ can relate to the scene's",
            remedy="Warp the DEM into scene.crs with a GIS, and state its datum.",
        ) from error


def _bilinear(values: Floats, row: Floats, column: Floats) -> Floats:
    """Return (layer, row, column) `values` at fractional places; a post of no weight does not count, even if NaN."""
    first = [
        np.clip(np.floor(axis), 0, size - 2).astype(np.int64)
        for axis, size in zip((row, column), values.shape[1:], strict=True)
    ]
    down, right = row - first[0], column - first[1]
    corners = [values[:, first[0] + i, first[1] + j] for i in (0, 1) for j in (0, 1)]
    return _between(_between(corners[0], corners[1], right), _between(corners[2], corners[3], right), down)


def _between(low: Floats, high: Floats, share: Floats) -> Floats:
    mixed = (1 - share) * low + share * high
    return np.where(np.abs(share) < 1e-9, low, np.where(np.abs(share - 1) < 1e-9, high, mixed))
