"""An image formed tile by tile: each tile on its own, in any order, by any number of threads."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from dask.base import compute
from dask.delayed import delayed
from dask.diagnostics.progress import ProgressBar
from numpy.typing import NDArray

from apertura.contracts import Window
from apertura.image.grid import SceneGrid


def form_tiles(
    form: Callable[[NDArray[np.float64]], NDArray[np.complex64]],
    grid: SceneGrid,
    windows: Iterable[Window],
    *,
    write: Callable[[Window, NDArray[np.complex64]], None],
    threads: int,
    heights: Callable[[Window], NDArray[np.float64]] | None = None,
    seconds_between_reports: float = 0.25,
) -> None:
    """Form each window of `grid` and write it as soon as it is done.

    Parameters
    ----------
    form
        Pixels (y, x, 3) → (y, x) complex64; releases the GIL.
    grid
        The whole scene.
    windows
        Tiles still to be formed.
    write
        Takes each finished tile; called from several threads, for windows that do not overlap.
    threads
        How many tiles are in work at once; the memory of pixel positions and results is theirs alone.
    heights
        Gives the pixel heights (m) of a window, from several threads; flat ground at `grid.height_m` if None.
    seconds_between_reports
        How often the progress bar is redrawn.

    Examples
    --------
    >>> grid = SceneGrid("local", 0.0, 4.0, 1.0, (4, 6), 0.0)
    >>> image = np.zeros(grid.shape, np.complex64)
    >>> form_tiles(lambda pixels: pixels[..., 0], grid, grid.tiles(4), write=image.__setitem__, threads=2)
    [...
    >>> image[0].real
    array([0.5, 1.5, 2.5, 3.5, 4.5, 5.5], dtype=float32)
    """

    def work(window: Window) -> None:
        height_m = None if heights is None else heights(window)
        write(window, np.asarray(form(grid[window].positions(height_m)), np.complex64))

    tasks: list[Any] = [delayed(work)(window) for window in windows]
    with ProgressBar(dt=seconds_between_reports):
        compute(*tasks, scheduler="threads", num_workers=threads)
