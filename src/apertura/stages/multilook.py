"""Mean power of squares of pixels, on a coarser grid: of the layers of a pair, and of the sums of a flight."""

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

_FEWEST_CELLS = 64  # along a tile of mean power: those around it that the filter reads, too, are few


@dataclass(frozen=True)
class LazyLayer:
    """A raster whose blocks are computed on reading, tile by tile, in threads.

    Attributes
    ----------
    grid
        Its pixels.
    dtype
        Of the values.
    of
        Window of the grid → values (row, column).
    threads
        Tiles computed at once.
    tile_px
        Side of a tile.
    """

    grid: SceneGrid
    dtype: type[np.generic]
    of: Callable[[Window], NDArray[Any]]
    threads: int
    tile_px: int = BLOCK_PX

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.grid.shape

    def __getitem__(self, block: Window) -> NDArray[Any]:
        """Return the values of a block of rows and columns."""
        part = self.grid[block]
        values = np.empty(part.shape, self.dtype)

        def work(tile: Window) -> None:
            rows, columns = (slice(at.start + by, at.stop + by) for at, by in zip(tile, part.first, strict=True))
            values[tile] = self.of((rows, columns))

        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(work, part.tiles(self.tile_px)))
        return values


def side_of(grid: SceneGrid, multilook: Multilooking) -> int:
    """Return the side of the squares that power is averaged over, pixels."""
    return max(1, round(multilook.spacing_m / grid.spacing_m))


def multilook_of(
    image: Callable[[Window], NDArray[np.complex64]],
    grid: SceneGrid,
    multilook: Multilooking,
    *,
    noise: Callable[[Window], Floats] | None = None,
) -> Multilook:
    """Return the mean power of an image by the settings, with `noise` subtracted where it is given."""
    filtered = multilook.speckle_filter == "lee"
    return Multilook.of(image, grid.shape, side_of(grid, multilook), noise=noise, filtered=filtered)


def coarse(
    grid: SceneGrid, cells: Multilook, *, threads: int, of: Callable[[Window], Floats] | None = None
) -> LazyLayer:
    """Return the raster of squares of pixels: their mean power, or a function of a window of squares."""
    coarser = replace(grid, spacing_m=cells.side * grid.spacing_m, shape=cells.shape)
    return LazyLayer(coarser, np.float32, of or cells.mean, threads, max(_FEWEST_CELLS, BLOCK_PX // cells.side))


def mean_power_report(cells: Multilook, means: Mapping[str, Any], *, noise: str) -> dict[str, Any]:
    """Return the meaning of mean power, of pixels that mean `means`."""
    return of_multilooked(
        means,
        side_px=cells.side,
        looks=cells.looks,
        found=cells.found,
        noise=noise,
        speckle="Lee" if cells.filtered else "none",
    )
