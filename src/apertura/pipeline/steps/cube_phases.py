"""Coherence and phase between the images of a cube: a flight's pairs, and a pair's flights."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from apertura.common.contracts import Window
from apertura.core.scene.grid import SceneGrid
from apertura.methods.interferometry.coherence import chance, coherence
from apertura.methods.interferometry.common_band import common_band, window_px
from apertura.pipeline.steps.cube_labels import Images

_TILES_AT_ONCE = 4
"""Along a side: tiles are read with a margin, and what they share is read once."""

Compared = Mapping[str, Mapping[tuple[str, str], tuple[str, str]]]
"""'pair' or 'flight' → image, by flight and pair → the image it is compared with."""


def compared(images: Images, references: Mapping[str, str], first_flights: Mapping[str, str]) -> Compared:
    """Return which images are compared: each with its flight's reference pair, and with its pair's first flight.

    Parameters
    ----------
    images
        Those that were formed.
    references
        Flight → its reference pair.
    first_flights
        Pair → the flight that others are compared with.
    """
    to = {
        "pair": {(flight, pair): (flight, references[flight]) for flight, pair in images},
        "flight": {(flight, pair): (first_flights[pair], pair) for flight, pair in images},
    }
    return {kind: {one: other for one, other in rows.items() if one != other} for kind, rows in to.items()}


def window_of(images: Images, spacing_m: float) -> int:
    """Return the side (pixels) of the window that coherence is measured in: every image has 16 looks in it."""
    return max(window_px(_spectrum(image), spacing_m) for image in images.values())


def shared_band(one: xr.Dataset, other: xr.Dataset) -> float:
    """Return the most that unchanged ground can show of coherence, docs/theory/interferometry.md, eq. 1a."""
    carriers = tuple(np.array(image.attrs["quality"]["view"]["carrier_cycles_m"]) for image in (one, other))
    return common_band((carriers[0], carriers[1]), (_spectrum(one), _spectrum(other)))


def write_phase(
    images: tuple[xr.Dataset, xr.Dataset], arrays: tuple[Any, Any], grid: SceneGrid, *, side: int, window: int
) -> tuple[float, float]:
    """Write coherence and phase of two images tile by tile; return looks, and the coherence of chance.

    Parameters
    ----------
    images
        An image and the one it is compared with.
    arrays
        Of coherence and phase, (y, x) float32; a tile that one of the images does not hold is not written.
    grid
        Of all.
    side, window
        Of a tile, and of the window, pixels.

    Returns
    -------
    tuple
        NaN of images without a tile in common.
    """
    shares: list[float] = []
    for block in grid.tiles(_TILES_AT_ONCE * side):
        wide = _widened(block, window // 2, grid.shape)
        first, second = (image.image[wide].values for image in images)
        if not (np.isfinite(first) & np.isfinite(second)).any():
            continue
        for tile in _inside(grid, block, side):
            around = _widened(tile, window // 2, grid.shape)
            part = _against(around, wide)
            magnitude, phase, looks = coherence(first[part], second[part], window=window)
            middle = _against(tile, around)
            if np.isfinite(magnitude[middle]).any():
                shares.append(1 / looks)
                for array, values in zip(arrays, (magnitude, phase), strict=True):
                    array[tile] = values[middle]
    looks = 1 / float(np.mean(shares)) if shares else float("nan")
    return looks, chance(looks) if shares else looks


def _spectrum(image: xr.Dataset) -> Any:
    return np.array(image.attrs["quality"]["focus"]["spectrum_cycles2_m2"])


def _inside(grid: SceneGrid, block: Window, side: int) -> Iterator[Window]:
    for rows, columns in grid[block].tiles(side):
        top, left = block[0].start, block[1].start
        yield slice(rows.start + top, rows.stop + top), slice(columns.start + left, columns.stop + left)


def _widened(window: Window, by: int, shape: tuple[int, int]) -> Window:
    rows, columns = (
        slice(max(0, part.start - by), min(size, part.stop + by)) for part, size in zip(window, shape, strict=True)
    )
    return rows, columns


def _against(window: Window, whole: Window) -> Window:
    """Return a window counted from where another begins."""
    rows, columns = (slice(part.start - of.start, part.stop - of.start) for part, of in zip(window, whole, strict=True))
    return rows, columns
