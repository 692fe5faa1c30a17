"""DEM in any CRS: opening and checking the file, and ellipsoidal heights at the pixels of a grid."""

import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from apertura.common.arrays import Floats
from apertura.common.errors import CampaignError, number_of, quoted, shown
from apertura.common.raster import opened_raster
from apertura.core.geometry.geodesy import GEODETIC, LOCAL, is_on_wgs84
from apertura.core.scene.geoid import declared_datum, geoid_file, grid_names, undulation
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain, bilinear

# ---- Ellipsoidal heights of a DEM at the pixels of a grid

LATTICE_M = 50.0
"""Spacing of nodes at which coordinates in another CRS are computed, metres. Bilinear interpolation between nodes has
an error of 0.1 mm."""

COVER_NODES = 129
"""Number of nodes along each side of the scene at which coverage is checked."""

LOWEST_M, HIGHEST_M = -500.0, 9000.0
"""Range of possible land heights on Earth above any datum, metres; the extremes are −430 m (Dead Sea) and 8849 m
(Mount Everest)."""

MOST_POSTS = 100_000_000
"""Largest number of posts of a DEM in memory at once: 0.8 GB of float64."""

FILLS = (0.0, -1.0, 1.0, 255.0, -99.0, 99.0, 999.0, -100.0, -499.0)
"""Common fill values of voids that lie within the range of land heights."""

STEEPEST = 5.0
"""Slope (rise over run) over `STEP_M` or one post spacing, above which a flag is raised: 79 degrees."""

STEP_M = 20.0
"""Horizontal distance over which a step is measured, metres: a step at the limit of the slope is 100 m high."""

_FILL_MARGIN = 16  # number of posts around the scene that are also read in order to find the edges of a void
_MOST_STEPS = 1_000_000
_TILE_PX = 512
_SAME_RASTER = "the raster that was opened before"


@dataclass(frozen=True)
class Dem(Terrain):
    """Raster DEM and its vertical datum; opened by `ap.open_dem`.

    Attributes
    ----------
    path
        GeoTIFF with heights in band 1.
    shape
        Rows and columns of the raster.
    pixel_from_map
        Affine coefficients a…f of (x, y) → (column, row), with the outer corner of the raster at (0, 0).
    horizontal
        WKT of the horizontal CRS of the raster; empty in a local frame.
    geodetic
        Three-dimensional geodetic CRS (any pyproj definition), to the ellipsoid of which the undulations refer.
    geoid
        Grid of undulations; None if heights are ellipsoidal.
    metres_per_unit
        Unit of the heights in the raster, metres; negative if heights are positive downward.

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
        """Return the height of each pixel of a grid or of a window; only the required part of the DEM is read.

        Parameters
        ----------
        grid
            Grid or window of a grid; the height of a pixel does not depend on the window.

        Returns
        -------
        ndarray
            (row, column) float64, metres above the ellipsoid of `grid.crs` (z in a local frame), interpolated
            bilinearly between posts; NaN outside the DEM and where one of the posts is a void.

        Raises
        ------
        CampaignError
            If a height depends on a post outside the range of land heights (undeclared void or wrong unit), or on a
            block of posts that equal one of `FILLS` and are surrounded by steep walls (undeclared void).
        """
        side = max(1, int(LATTICE_M / grid.spacing_m))
        rows, columns = (np.arange(size) + first for size, first in zip(grid.shape, grid.first, strict=True))
        nodes = [np.arange(axis[0] // side, axis[-1] // side + 2) for axis in (rows, columns)]
        mesh = np.meshgrid(nodes[0] * side - grid.first[0], nodes[1] * side - grid.first[1], indexing="ij")
        xy_m = grid.map_at(*mesh)
        on_nodes = np.stack([*self._posts(grid.crs, xy_m[..., 0], xy_m[..., 1]), self._shift(grid.crs, xy_m)])
        share = [(axis / side - node[0]) for axis, node in zip((rows, columns), nodes, strict=True)]
        column, row, shift = bilinear(on_nodes, share[0][:, None], share[1][None, :])
        return np.asarray(self._sample(row, column) + shift)

    def check_cover(self, grid: SceneGrid) -> None:
        """Raise CampaignError if the DEM does not cover the whole grid, with the missing fraction and side."""
        xy_m = grid.map_at(*np.rint(grid.sample_pixels(COVER_NODES)))
        column, row = self._posts(grid.crs, xy_m[..., 0], xy_m[..., 1])
        outside = ~self._inside(row, column)
        if not outside.any():
            return
        edges = {"north": outside[0], "south": outside[-1], "west": outside[:, 0], "east": outside[:, -1]}
        sides = [name for name, edge in edges.items() if edge.all()]
        sides = sides or [name for name, edge in edges.items() if edge.any()]
        rows, columns = self.shape
        raise CampaignError(
            f"{100 * outside.mean():.1f} % of the scene lies outside the DEM, to the {', '.join(sides) or 'inside'}: "
            f"the scene extends over columns {column.min():.1f} to {column.max():.1f} and rows {row.min():.1f} to "
            f"{row.max():.1f} of the DEM",
            where=self.path,
            expected=f"a DEM that covers the whole scene; this DEM has {columns} columns and {rows} rows",
            remedy="Obtain the missing part of the DEM, or reduce scene.bounds_m.",
        )

    def _inside(self, row: Floats, column: Floats) -> NDArray[np.bool_]:
        reach = 0.5 + 1e-6
        inside = [(-reach <= at) & (at <= size - 1 + reach) for at, size in zip((row, column), self.shape, strict=True)]
        return inside[0] & inside[1]

    def _posts(self, crs: str, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return fractional column and row of map coordinates in the raster; (0, 0) is the first post."""
        a, b, c, d, e, f = self.pixel_from_map
        if self.horizontal:
            x, y = _transformer(crs, self.horizontal).transform(x, y)
            if CRS(self.horizontal).is_geographic:  # convert to the longitude range of the raster, 0…360° or −180…180°
                middle = (self.shape[1] / 2 - c) / a if a else 0.0
                x = x + 360 * np.round((middle - x) / 360)
        return np.asarray(a * x + b * y + c - 0.5), np.asarray(d * x + e * y + f - 0.5)

    def _shift(self, crs: str, xy_m: Floats) -> Floats:
        """Return the offset that converts heights of the DEM to heights of a grid in `crs`, metres."""
        if crs == LOCAL:
            return np.zeros(xy_m.shape[:-1])
        longitude, latitude = _transformer(crs, CRS(self.geodetic).to_2d()).transform(xy_m[..., 0], xy_m[..., 1])
        shift = np.zeros_like(longitude) if self.geoid is None else undulation(self.geoid, longitude, latitude)
        target = CRS(crs).to_3d() if is_on_wgs84(crs) else CRS(GEODETIC)
        transformed = _transformer(CRS(self.geodetic), target).transform(longitude, latitude, shift)
        return np.asarray(transformed[2], np.float64)

    def _sample(self, row: Floats, column: Floats) -> Floats:
        """Return heights of the raster (m, above the datum of the raster) between posts; NaN outside the raster."""
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
                remedy="Resample the DEM to a spacing similar to that of the scene with a GIS.",
            )
        with opened_raster(self.path, expected=_SAME_RASTER, remedy="Copy the DEM again.") as raster:
            window = Window(first[1], first[0], counts[1], counts[0])
            stored, posts = _heights(raster, window)
            index = (at[0] - first[0], at[1] - first[1])
            if self.horizontal and np.isin(stored, FILLS).any():
                self._check_fills(raster, first, counts, index)
        posts *= self.metres_per_unit
        impossible = (posts < LOWEST_M) | (posts > HIGHEST_M)
        if (
            self.horizontal
            and impossible.any()
            and np.isnan(bilinear(np.where(impossible, np.nan, 0.0)[None], *index)).any()
        ):
            raise self._impossible_heights(posts, impossible, first)
        sampled[inside] = bilinear(posts[None], *index)[0]
        return sampled

    def _check_fills(self, raster: Any, first: list[int], counts: list[int], index: tuple[Floats, Floats]) -> None:
        """Raise CampaignError if a height depends on a block of posts with a fill value, surrounded by steep walls.

        Posts around the requested posts are also read, because only a block that ends within the window is a void.
        """
        from rasterio.windows import Window

        start = [max(0, post - _FILL_MARGIN) for post in first]
        stop = [min(size, post + n + _FILL_MARGIN) for post, n, size in zip(first, counts, self.shape, strict=True)]
        stored, heights = _heights(raster, Window(start[1], start[0], stop[1] - start[1], stop[0] - start[0]))
        heights *= self.metres_per_unit
        wall_m = STEEPEST * max(STEP_M, self._post_m)
        for value in FILLS:
            block, lowest_m = walled(heights, stored == value, wall_m=wall_m)
            requested = block[tuple(slice(a - b, a - b + n) for a, b, n in zip(first, start, counts, strict=True))]
            if requested.any() and np.isnan(bilinear(np.where(requested, np.nan, 0.0)[None], *index)).any():
                row, column = (int(axis[0]) + offset for axis, offset in zip(np.nonzero(block), start, strict=True))
                raise CampaignError(
                    f"a void filled with {value:g}: {number_of(int(block.sum()), 'post')} of this value from row "
                    f"{row}, column {column}, surrounded by posts that differ by at least {lowest_m:.0f} m",
                    where=self.path,
                    expected="terrain heights, and voids declared as nodata",
                    remedy=f"Declare {value:g} as nodata for these posts, and fill the voids with a GIS.",
                )

    @property
    def _post_m(self) -> float:
        """Spacing of posts along the axis with the larger spacing, metres."""
        a, b, _, d, e, _ = self.pixel_from_map
        unit_m = 111_195.0 if CRS(self.horizontal).is_geographic else 1.0
        return unit_m / max(float(min(np.hypot(a, d), np.hypot(b, e))), 1e-12)

    def _impossible_heights(self, posts: Floats, impossible: NDArray[np.bool_], start: list[int]) -> CampaignError:
        values, counts = np.unique(posts[impossible], return_counts=True)
        (top, left), (rows, columns) = start, posts.shape
        return CampaignError(
            f"{impossible.sum()} of the {impossible.size} posts in rows {top} to {top + rows - 1}, columns {left} to "
            f"{left + columns - 1} have impossible heights, most frequently {values[counts.argmax()]:g} m",
            where=self.path,
            expected=f"heights between {LOWEST_M:g} m and {HIGHEST_M:g} m",
            remedy="Declare the fill value of voids as nodata (and fill the voids within the scene), or correct the "
            "unit of the heights.",
        )


def walled(heights: Floats, same: NDArray[np.bool_], *, wall_m: float) -> tuple[NDArray[np.bool_], float]:
    """Return the blocks of `same` posts that are surrounded by steps in height, and the lowest of these steps.

    Parameters
    ----------
    heights
        (row, column) float64, metres; NaN in voids, which are ignored as neighbours.
    same
        (row, column) bool, True for posts of equal height.
    wall_m
        Minimum height difference from all neighbours in the same row or column, metres.

    Returns
    -------
    tuple
        (row, column) bool, mask of the posts of blocks that do not touch an edge; and lowest step in metres, infinite
        if there is no block.

    Examples
    --------
    >>> pit = np.full((5, 5), 620.0)
    >>> pit[2, 2:4] = 0.0
    >>> block, lowest_m = walled(pit, pit == 0.0, wall_m=100.0)
    >>> np.argwhere(block).tolist(), lowest_m
    ([[2, 2], [2, 3]], 620.0)
    """
    from scipy.ndimage import label

    padded, inner = np.pad(heights, 1, constant_values=np.nan), np.pad(same, 1)
    step_m = np.full(same.shape, np.inf)  # smallest height difference from a neighbour outside the block
    for neighbour in ((slice(None, -2), slice(1, -1)), (slice(2, None), slice(1, -1))):
        for rows, columns in (neighbour, neighbour[::-1]):
            difference_m = np.where(inner[rows, columns], np.nan, np.abs(padded[rows, columns] - heights))
            step_m = np.fmin(step_m, np.where(same, difference_m, np.nan))
    if not (same & np.isfinite(step_m) & (step_m > wall_m)).any():
        return np.zeros_like(same), np.inf
    blocks, _ = label(same)
    rejected = np.unique(
        np.concatenate([blocks[same & (step_m <= wall_m)], blocks[0], blocks[-1], blocks[:, 0], blocks[:, -1]])
    )
    block = same & ~np.isin(blocks, rejected)
    return block, float(step_m[block].min(initial=np.inf))


@dataclass(frozen=True)
class UncheckedDem(Terrain):
    """DEM of a scene that the stage `terrain` has not checked yet: voids raise the same error as in this stage.

    Attributes
    ----------
    dem, grid
        The DEM and the whole grid.
    """

    dem: Dem
    grid: SceneGrid

    def heights(self, grid: SceneGrid) -> Floats:
        """Return the heights of the DEM; voids in the scene raise CampaignError with the number of pixels affected."""
        heights = self.dem.heights(grid)
        if grid.spacing_m == self.grid.spacing_m and np.isnan(heights).any():
            height_range(self.dem, self.grid, where=self.dem.path)
        return heights


def height_range(terrain: Terrain, grid: SceneGrid, *, where: Path) -> tuple[float, float]:
    """Return the lowest and highest terrain heights of a scene (m); heights are read tile by tile.

    Parameters
    ----------
    terrain, grid
        The terrain, and the whole grid.
    where
        File of the DEM, for error messages.

    Raises
    ------
    CampaignError
        If pixels have no height; the message contains the number of these pixels and the position of the first one.
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
            expected="a height at every post within the scene",
            remedy="Fill the voids (NaN or nodata) of the DEM with a GIS, or reduce scene.bounds_m.",
        )
    return low, high


def _heights(raster: Any, window: Any) -> tuple[Floats, Floats]:
    """Return the stored values of a window, with NaN in voids, and the heights in the unit of the raster."""
    stored = raster.read(1, window=window, masked=True).astype(np.float64).filled(np.nan)
    return stored, stored * raster.scales[0] + raster.offsets[0]


class Step(NamedTuple):
    """Step of the terrain of a scene: height difference, horizontal distance, and map position, metres."""

    height_m: float
    over_m: float
    x_m: float
    y_m: float


def steepest_step(terrain: Terrain, grid: SceneGrid) -> Step | None:
    """Return the highest step of the terrain that is steeper than `STEEPEST` over `STEP_M`; None if there is none.

    Cliffs are rarely this steep. Typical causes are voids filled with a constant, and areas with a different datum or
    from a different source.

    Parameters
    ----------
    terrain, grid
        The terrain, and the whole grid.
    """
    coarsest = int(np.ceil(np.sqrt(grid.shape[0] * grid.shape[1] / _MOST_STEPS)))
    every = max(1, round(STEP_M / 4 / grid.spacing_m), coarsest)
    rows, columns = (np.arange(every // 2, size, every) for size in grid.shape)
    heights = terrain.heights_at(grid, rows[:, None], columns[None, :])
    ahead = max(1, round(STEP_M / (every * grid.spacing_m)))
    over_m, steps = ahead * every * grid.spacing_m, list[Step]()
    for drops in (heights[ahead:] - heights[:-ahead], heights[:, ahead:] - heights[:, :-ahead]):
        if drops.size:
            drop = np.nan_to_num(np.abs(drops))
            row, column = np.unravel_index(int(drop.argmax()), drop.shape)
            x_m, y_m = (float(coordinate) for coordinate in grid.map_at(rows[row], columns[column]))
            steps.append(Step(float(drop[row, column]), over_m, x_m, y_m))
    highest = max(steps, default=None)
    return highest if highest is not None and highest.height_m > STEEPEST * over_m else None


@lru_cache(maxsize=64)
def _transformer(source: str | CRS, target: str | CRS) -> Transformer:
    try:
        return Transformer.from_crs(source, target, always_xy=True, allow_ballpark=False)
    except ProjError as error:
        raise CampaignError(
            f"PROJ has no exact transformation from {CRS(source).name} to {CRS(target).name}",
            where="scene.dem",
            expected="a DEM in a CRS that PROJ can transform to the CRS of the scene",
            remedy="Reproject the DEM to scene.crs with a GIS, and configure the datum of the DEM.",
        ) from error


# ---- Opening a DEM file

_COLOURS = {"red", "green", "blue", "palette", "hue", "saturation", "lightness", "cyan", "magenta", "yellow"}
_EXPECTED = "the DEM of scene.dem, a GeoTIFF of heights"
NAMES_FILES = re.compile(r'\+proj=|grids=|init=|"PROJ4"|PARAMETERFILE\["[^"]*","[^"]*[/\\:~]', re.IGNORECASE)
"""Keywords of a CRS (WKT) that cause PROJ to open files other than the grids in the folders of PROJ."""

_REMEDY = "Correct the DEM, or scene.dem and scene.dem_datum (in Python: path and datum)."


def open_dem(
    path: str | Path, scene: str | SceneGrid, *, datum: str = "carried", geoid: str | Path | None = None
) -> Dem:
    """Open a DEM in any CRS as the terrain of a scene.

    Parameters
    ----------
    path
        GeoTIFF with heights in band 1; sidecar files (.aux.xml, .ovr, .tfw) are ignored.
    scene
        Grid that the DEM must cover; or only the CRS of the grid (a pyproj definition or 'local'), to omit the coverage
        check.
    datum
        Datum of the heights: 'ellipsoid', 'egm96', 'egm2008', or 'carried'. 'carried' selects the datum that the CRS of
        the raster declares; in a local frame, heights are z of the frame.
    geoid
        Grid of undulations; None: the grid is searched in the folders of PROJ.

    Raises
    ------
    CampaignError
        If the file is not a DEM; the CRS of the file contradicts `datum`, or does not declare the required datum; the
        grid of undulations is missing; or the DEM does not cover the scene.

    Examples
    --------
    A DEM in UTM with ellipsoidal heights, and a scene of 4 × 4 pixels:

    >>> import numpy as np, rasterio
    >>> from tempfile import TemporaryDirectory
    >>> profile = {"width": 9, "height": 9, "count": 1, "dtype": "float32", "crs": "EPSG:32632"}
    >>> transform = rasterio.Affine(5, 0, 500000, 0, -5, 5400045)
    >>> with TemporaryDirectory() as folder:
    ...     with rasterio.open(f"{folder}/dem.tif", "w", "GTiff", transform=transform, **profile) as raster:
    ...         raster.write(np.full((9, 9), 612.5, np.float32), 1)
    ...     grid = SceneGrid("EPSG:32632", 500020.0, 5400020.0, 0.5, (4, 4))
    ...     float(open_dem(f"{folder}/dem.tif", grid, datum="ellipsoid").heights(grid)[0, 0])
    612.5
    """
    if not isinstance(scene, str | SceneGrid):
        raise CampaignError(quoted(scene), "open_dem: scene", "a SceneGrid, or a CRS", "Pass the grid of the images.")
    crs = scene if isinstance(scene, str) else scene.crs
    dem = _dem(Path(path), crs, datum=datum, geoid=None if geoid is None else Path(geoid))
    if not isinstance(scene, str):
        dem.check_cover(scene)
    return dem


def _dem(path: Path, crs: str, *, datum: str, geoid: Path | None) -> Dem:
    """Open a DEM for a scene in `crs`, without the coverage check; parameters as for `open_dem`."""
    pixel_from_map, shape, unit, system = _header(path)
    if crs == LOCAL:
        if system is not None and (system.is_geographic or system.is_projected):
            raise _wrong(
                path, f"CRS {system.name} for a scene in the local frame", "a DEM in the axes of the local frame"
            )
        return Dem(path, shape, pixel_from_map, "", "", None, 1.0)
    if system is None or not (system.is_geographic or system.is_projected or system.is_compound):
        raise _wrong(path, "no geodetic CRS", f"a georeferenced DEM, or scene.crs: {LOCAL}")
    vertical_datum = _datum(path, system, datum)
    metres = _metres_per_unit(path, system, unit)
    horizontal = system.sub_crs_list[0] if system.is_compound else system.to_2d()
    # Undulations of EGM96 and EGM2008, and configured ellipsoidal heights, refer to WGS 84. All other heights refer to
    # the ellipsoid of the CRS of the raster.
    refers_to_wgs84 = vertical_datum in {"egm96", "egm2008"} or (
        datum == "ellipsoid" and not is_on_wgs84(horizontal.to_wkt())
    )
    own = None if refers_to_wgs84 else horizontal.geodetic_crs
    geodetic = CRS(GEODETIC) if own is None else own.to_3d()
    undulations = (
        None
        if vertical_datum == "ellipsoid"
        else geoid_file(vertical_datum, geoid, names=grid_names(system) if datum == "carried" else ())
    )
    return Dem(path, shape, pixel_from_map, horizontal.to_wkt(), geodetic.to_wkt(), undulations, metres)


def _header(path: Path) -> tuple[tuple[float, ...], tuple[int, int], str, CRS | None]:
    """Read the transform (x, y) → (column, row), rows and columns, unit of the heights and CRS of a raster."""
    with opened_raster(path, expected=_EXPECTED, remedy=_REMEDY) as raster:
        shape, unit, transform, dtype = (
            raster.shape,
            (raster.units[0] or "metre").lower(),
            raster.transform,
            raster.dtypes[0],
        )
        colours = [band.name for band in raster.colorinterp if band.name in _COLOURS]
        try:
            system = CRS.from_user_input(raster.crs) if raster.crs else None
            if system and NAMES_FILES.search(system.to_wkt()):
                raise _wrong(path, "a CRS that refers to a file", "a self-contained CRS, or a CRS with a known grid")
        except ProjError as error:
            raise _wrong(path, f"a CRS that PROJ cannot parse ({shown(error)})", "a CRS that PROJ can parse") from error
    if colours:
        found = f"colours ({', '.join(colours)}), not heights"
        raise _wrong(path, found, "a band of heights, not a shaded relief or a map")
    if min(shape) < 2:
        raise _wrong(path, f"{shape[0]} × {shape[1]} posts", "at least 2 × 2")
    if not np.issubdtype(np.dtype(dtype), np.integer) and not np.issubdtype(np.dtype(dtype), np.floating):
        raise _wrong(path, f"heights of type {dtype}", "integers or floating-point numbers")
    sides = (float(np.hypot(transform.a, transform.d)), float(np.hypot(transform.b, transform.e)))
    if not np.isfinite(transform[:6]).all() or abs(transform.determinant) <= 1e-9 * sides[0] * sides[1]:
        found = f"a degenerate transform {[float(value) for value in transform[:6]]}"
        raise _wrong(path, found, "pixels of finite area")
    inverse = ~transform
    coefficients = (inverse.a, inverse.b, inverse.c, inverse.d, inverse.e, inverse.f)
    if not np.isfinite(coefficients).all():
        raise _wrong(path, f"pixels of {sides[0]:g} × {sides[1]:g} units", "pixels at distinct positions")
    return coefficients, shape, unit, system


def _wrong(path: Path, found: str, expected: str) -> CampaignError:
    return CampaignError(
        found,
        where=path,
        expected=expected,
        remedy=_REMEDY,
    )


def _datum(path: Path, system: CRS, configured: str) -> str:
    """Return the vertical datum of a raster, after a comparison with the configured datum."""
    declared = declared_datum(system)
    if configured == "carried":
        if declared is None:
            raise _wrong(
                path, f"a CRS without heights ({system.name})", "a configured datum: ellipsoid, egm96 or egm2008"
            )
        return declared
    if declared not in {None, configured}:
        found = f"heights above {declared}, according to the CRS of the file"
        raise _wrong(path, found, f"heights above {configured}, as configured; or dem_datum: carried")
    return configured


def _metres_per_unit(path: Path, system: CRS, unit: str) -> float:
    """Return the unit of the heights of a raster, metres; negative if heights are positive downward."""
    axis = system.axis_info[-1]
    if len(system.axis_info) == 3:
        return float(axis.unit_conversion_factor * (-1 if axis.direction == "down" else 1))
    if unit not in {"m", "metre", "meter", "metres", "meters"}:
        raise _wrong(path, f"heights in {unit}", "metres")
    return 1.0
