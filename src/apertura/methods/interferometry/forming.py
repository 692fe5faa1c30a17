"""Coherence and phase of two whole images, tile by tile: what does not depend on how they lie to each other."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.methods.interferometry.coherence import boxed, coherence


@dataclass(frozen=True, eq=False)
class Formed:
    """Coherence and phase of two images.

    Attributes
    ----------
    magnitude, phase, looks
        As of `coherence.coherence`; looks are the median of the tiles', NaN where none has any.
    shared
        (y, x) float32, pixels that a window's energy is spread over, as a share of it: about 1/2 of ground, 1/`looks`
        of a point (docs/theory/interferometry.md, eq. 6).
    """

    magnitude: NDArray[np.float32]
    phase: NDArray[np.float32]
    shared: NDArray[np.float32]
    looks: float


def formed(
    first: NDArray[np.complex64], second: NDArray[np.complex64], tiles: Iterable[Window], *, window: int
) -> Formed:
    """Return what `apertura.methods.interferometry.coherence.coherence` tells of the whole.

    Parameters
    ----------
    first, second
        (y, x) complex64 on one grid, NaN where nothing was formed; read a tile with its margin at a time.
    tiles
        Windows that make up the grid.
    window
        Pixels along a side, odd.

    Examples
    --------
    >>> image = np.exp(1j * np.arange(64.0).reshape(8, 8) ** 2).astype(np.complex64)
    >>> halves = [(slice(0, 8), slice(0, 4)), (slice(0, 8), slice(4, 8))]
    >>> apart, whole = formed(image, 1j * image, halves, window=3), coherence(image, 1j * image, window=3)
    >>> bool((apart.magnitude == whole[0]).all() and (apart.phase == whole[1]).all())
    True
    """
    shape, margin = first.shape, window // 2
    planes = [np.full(shape, np.nan, np.float32) for _ in range(3)]
    looks: list[float] = []
    for tile in tiles:
        wider = tuple(
            slice(max(0, part.start - margin), min(size, part.stop + margin))
            for part, size in zip(tile, shape, strict=True)
        )
        inner = tuple(
            slice(part.start - wide.start, part.stop - wide.start) for part, wide in zip(tile, wider, strict=True)
        )
        one, other = np.asarray(first[wider]), np.asarray(second[wider])
        magnitude, phase, own = coherence(one, other, window=window)
        looks.append(own)
        planes[0][tile], planes[1][tile] = magnitude[inner], phase[inner]
        planes[2][tile] = _shared(one, other, window)[inner]
    there = [one for one in looks if np.isfinite(one)]
    return Formed(planes[0], planes[1], planes[2], float(np.median(there)) if there else float("nan"))


def _shared(one: NDArray[np.complex64], other: NDArray[np.complex64], window: int) -> NDArray[np.float64]:
    """Return (Σp)²/(N Σp²) over a window about each pixel, p the magnitude of the images' product."""
    power = np.abs(one.astype(np.complex128) * other)
    there = np.isfinite(power)
    power = np.where(there, power, 0)
    total, squares, count = boxed(power, window), boxed(power**2, window), boxed(there.astype(np.float64), window)
    return np.asarray(total**2 / np.maximum(count * squares, np.finfo(np.float64).tiny))
