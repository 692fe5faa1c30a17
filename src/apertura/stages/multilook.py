"""Multilooking: mean power on a coarser grid, of the images of a pair and of the sums of a flight."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config.processing import Multilooking
from apertura.common.arrays import Floats
from apertura.common.contracts import Window
from apertura.core.imaging.multilook import Multilook
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.looks import BLOCK_PX
from apertura.formats.export.radiometry import of_multilooked

_FEWEST_CELLS = 64  # multilook cells along a tile; the margin read by the filter is small in comparison


@dataclass(frozen=True)
class LazyLayer:
    """Raster whose blocks are computed on reading, tile by tile, in threads.

    Attributes
    ----------
    grid
        Grid of the raster.
    dtype
        Data type of the values.
    of
        Function from a window of the grid to its values (row, column).
    threads
        Number of tiles computed in parallel.
    tile_px
        Side of a tile, pixels.
    components
        Number of components of a raster of vectors, its last axis; None: a raster of scalars.
    """

    grid: SceneGrid
    dtype: type[np.generic]
    of: Callable[[Window], NDArray[Any]]
    threads: int
    tile_px: int = BLOCK_PX
    components: int | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns, and components of a vector."""
        return self._shape(self.grid)

    def _shape(self, grid: SceneGrid) -> tuple[int, ...]:
        return grid.shape if self.components is None else (*grid.shape, self.components)

    def __getitem__(self, block: Window) -> NDArray[Any]:
        """Return the values of a block of rows and columns."""
        part = self.grid[block]
        values = np.empty(self._shape(part), self.dtype)

        def work(tile: Window) -> None:
            rows, columns = (slice(at.start + by, at.stop + by) for at, by in zip(tile, part.first, strict=True))
            values[tile] = self.of((rows, columns))

        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(work, part.tiles(self.tile_px)))
        return values


def side_of(grid: SceneGrid, multilook: Multilooking) -> int:
    """Return the side of a multilook cell, pixels."""
    return max(1, round(multilook.spacing_m / grid.spacing_m))


def multilook_of(
    image: Callable[[Window], NDArray[np.complex64]],
    grid: SceneGrid,
    multilook: Multilooking,
    *,
    noise: Callable[[Window], Floats] | None = None,
) -> Multilook:
    """Return the multilooked power of an image as configured; the mean noise power is subtracted, if given."""
    filtered = multilook.speckle_filter == "lee"
    return Multilook.of(image, grid.shape, side_of(grid, multilook), noise=noise, filtered=filtered)


def coarse(
    grid: SceneGrid, cells: Multilook, *, threads: int, of: Callable[[Window], Floats] | None = None
) -> LazyLayer:
    """Return the raster of multilook cells: their mean power, or the values of a function of a window of cells."""
    coarser = replace(grid, spacing_m=cells.side * grid.spacing_m, shape=cells.shape)
    return LazyLayer(coarser, np.float32, of or cells.mean, threads, max(_FEWEST_CELLS, BLOCK_PX // cells.side))


def mean_power_report(cells: Multilook, means: Mapping[str, Any], *, noise: str) -> dict[str, Any]:
    """Return the radiometric report of a multilooked raster; `means`: radiometric report of the averaged pixels."""
    return of_multilooked(
        means,
        side_px=cells.side,
        looks=cells.looks,
        found=cells.found,
        noise=noise,
        speckle="Lee" if cells.filtered else "none",
    )
