"""Coherence and phase of two whole images, tile by tile: what does not depend on how they lie to each other."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from apertura.contracts import Window
from apertura.interferometry.coherence import coherence


def formed(
    first: NDArray[np.complex64], second: NDArray[np.complex64], tiles: Iterable[Window], *, window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Return coherence, phase and looks of two images, as `apertura.interferometry.coherence.coherence` of the whole.

    Parameters
    ----------
    first, second
        (y, x) complex64 on one grid, NaN where nothing was formed; read a tile with its margin at a time.
    tiles
        Windows that make up the grid.
    window
        Pixels along a side, odd.

    Returns
    -------
    magnitude, phase
        (y, x) float32; rad.
    looks
        The median of the tiles'; NaN where no tile has any.

    Examples
    --------
    >>> image = np.exp(1j * np.arange(64.0).reshape(8, 8) ** 2).astype(np.complex64)
    >>> halves = [(slice(0, 8), slice(0, 4)), (slice(0, 8), slice(4, 8))]
    >>> apart, whole = formed(image, 1j * image, halves, window=3), coherence(image, 1j * image, window=3)
    >>> bool((apart[0] == whole[0]).all() and (apart[1] == whole[1]).all())
    True
    """
    shape, margin = first.shape, window // 2
    magnitude, phase = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    looks = []
    for tile in tiles:
        wider = tuple(
            slice(max(0, part.start - margin), min(size, part.stop + margin))
            for part, size in zip(tile, shape, strict=True)
        )
        inner = tuple(
            slice(part.start - wide.start, part.stop - wide.start) for part, wide in zip(tile, wider, strict=True)
        )
        told = coherence(np.asarray(first[wider]), np.asarray(second[wider]), window=window)
        magnitude[tile], phase[tile] = told[0][inner], told[1][inner]
        looks.append(told[2])
    there = [one for one in looks if np.isfinite(one)]
    return magnitude, phase, float(np.median(there)) if there else float("nan")
