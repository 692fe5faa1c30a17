"""An image formed tile by tile: each tile on its own, in any order, by any number of threads."""

from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from dask.base import compute
from dask.delayed import delayed
from dask.diagnostics.progress import ProgressBar
from numpy.typing import NDArray

from apertura.contracts import Window
from apertura.scene.grid import SceneGrid
from apertura.scene.terrain import Terrain

Former = Callable[[NDArray[np.float64]], NDArray[np.complex64]]
"""Pixels (y, x, 3) → (y, x) complex64; releases the GIL."""


def form_tiles(
    form: Former,
    grid: SceneGrid,
    terrain: Terrain,
    windows: Iterable[Window],
    *,
    write: Callable[[Window, NDArray[np.complex64]], None],
    threads: int,
    seconds_between_reports: float = 0.1,
) -> None:
    """Form each window of `grid` and write it as soon as it is done.

    Parameters
    ----------
    form
        What a tile's pixels hold.
    grid, terrain
        The whole scene and its ground, whose heights are read from several threads.
    windows
        Tiles still to be formed.
    write
        Takes each finished tile; called from several threads, for windows that do not overlap.
    threads
        How many tiles are in work at once; the memory of pixel positions and results is theirs alone.
    seconds_between_reports
        How often the progress bar is redrawn.

    Examples
    --------
    >>> from apertura.scene.terrain import FlatGround
    >>> flat = FlatGround(0.0)
    >>> grid = SceneGrid("local", 0.0, 4.0, 1.0, (4, 6))
    >>> image = np.zeros(grid.shape, np.complex64)
    >>> form_tiles(lambda pixels: pixels[..., 0], grid, flat, grid.tiles(4), write=image.__setitem__, threads=2)
    [...
    >>> image[0].real
    array([0.5, 1.5, 2.5, 3.5, 4.5, 5.5], dtype=float32)
    """

    def work(window: Window) -> None:
        write(window, np.asarray(form(terrain.positions(grid[window])), np.complex64))

    tasks: list[Any] = [delayed(work)(window) for window in windows]
    with ProgressBar(dt=seconds_between_reports):
        compute(*tasks, scheduler="threads", num_workers=threads)


def form_blocks(
    former: Callable[[slice], Former],
    pulses: int,
    grid: SceneGrid,
    terrain: Terrain,
    windows: Iterable[Window],
    *,
    blocks: int,
    write: Callable[[Window, NDArray[np.complex64]], None],
    scratch: Path,
    **how: Any,
) -> None:
    """Form each window as the sum of its images from blocks of pulses, so that one block's tables are held at a time.

    Sums over blocks are complex64 in a file without a name; windows are written with the last block, those of a run
    that was killed before are formed anew.

    Parameters
    ----------
    former
        Pulses of a block → what its tiles hold; called when the one before is done with.
    pulses
        How many there are in all.
    grid, terrain, windows, write
        As `form_tiles`.
    blocks
        How many; of equal size but for one pulse.
    scratch
        Folder on a disk with 8 bytes to spare per pixel.
    how
        Other keywords of `form_tiles`.

    Examples
    --------
    >>> from apertura.scene.terrain import FlatGround
    >>> flat = FlatGround(0.0)
    >>> grid = SceneGrid("local", 0.0, 4.0, 1.0, (4, 6))
    >>> image = np.zeros(grid.shape, np.complex64)
    >>> count = lambda part: lambda pixels: np.full(pixels.shape[:2], part.stop - part.start, np.complex64)
    >>> form_blocks(count, 7, grid, flat, grid.tiles(4), blocks=3, write=image.__setitem__, scratch=Path(), threads=1)
    [...
    >>> image.real.min(), image.real.max()
    (np.float32(7.0), np.float32(7.0))
    """
    windows = list(windows)
    edges = [number * pulses // blocks for number in range(blocks + 1)]
    *early, last = (slice(*pair) for pair in pairwise(edges))
    if not early:
        return form_tiles(former(last), grid, terrain, windows, write=write, **how)
    with TemporaryFile(dir=scratch) as file:
        total = np.memmap(file, np.complex64, "w+", shape=grid.shape)

        def add(window: Window, part: NDArray[np.complex64]) -> None:
            total[window] += part

        def finish(window: Window, part: NDArray[np.complex64]) -> None:
            write(window, total[window] + part)

        for block in early:
            form_tiles(former(block), grid, terrain, windows, write=add, **how)
        form_tiles(former(last), grid, terrain, windows, write=finish, **how)
    return None
