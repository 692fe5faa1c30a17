"""Tiles of a tree: their sides, and the smooth surface through their pixels."""

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.focus.engines.native_binding import call
from apertura.core.focus.engines.native_structs import TreeJob, TreeTile

DEGREE = 6
"""Of a surface that is no plane."""

_PLANE_M = 2e-5
_THIN = 20


@dataclass(frozen=True, eq=False)
class Surface:
    """Where the pixels of a tile lie.

    Attributes
    ----------
    coefficients
        (degree + 1, degree + 1, 3) float64, metres: of Legendre polynomials along rows and columns, of -1…1 from the
        first pixel to the last.
    centre_m
        (3,) float64, the place at 0, 0.
    up
        (3,) float64, unit vector across the surface there.
    rough_m
        RMS distance of the pixels from it; infinite if one has no finite place.
    """

    coefficients: NDArray[np.float64]
    centre_m: NDArray[np.float64]
    up: NDArray[np.float64]
    rough_m: float


def windows(shape: tuple[int, ...], side_px: int) -> Iterator[Window]:
    """Yield windows of at most `side_px` pixels a side that share a block of pixels as evenly as whole pixels do.

    Examples
    --------
    >>> list(windows((100, 150), 128))
    [(slice(0, 100, None), slice(0, 75, None)), (slice(0, 100, None), slice(75, 150, None))]
    """
    parts = [-(-size // side_px) for size in shape]
    rows, columns = (
        [round(n * size / count) for n in range(count + 1)] for size, count in zip(shape, parts, strict=True)
    )
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            yield slice(top, bottom), slice(left, right)


def surfaces_of(pixels: NDArray[np.float64], parts: list[Window]) -> list[Surface]:
    """Return the surfaces through the pixels of tiles: planes where they will do.

    Parameters
    ----------
    pixels
        (y, x, 3) float64, metres, contiguous.
    parts
        The tiles.

    Notes
    -----
    Source: docs/theory/tree.md, "Surface".

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(40.0), np.arange(30.0))
    >>> surfaces_of(np.stack([x, y, 0.001 * x * x], -1), [(slice(0, 30), slice(0, 40))])[0].rough_m < 1e-9
    True
    """
    found = [Surface(np.zeros((1, 1, 3)), np.zeros(3), np.zeros(3), np.inf)] * len(parts)
    left = list(range(len(parts)))
    for degree in (1, DEGREE):
        fitted = [_fit(pixels[parts[number]], degree) for number in left]
        rests = _rests(pixels, [parts[number] for number in left], fitted)
        for number, coefficients, rest in zip(left, fitted, rests, strict=True):
            if np.isfinite(rest):
                centre = _value(coefficients, 0.0)
                found[number] = Surface(coefficients, centre, _across(coefficients), float(np.sqrt(rest)))
        left = [number for number in left if _PLANE_M < found[number].rough_m < np.inf]
        if not left:
            break
    return found


def _fit(pixels: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return the coefficients of the surface through some pixels of a tile."""
    middle = pixels[pixels.shape[0] // 2, pixels.shape[1] // 2]
    (rows, fit_rows), (columns, fit_columns) = (_fitting(size, degree) for size in pixels.shape[:2])
    offsets = pixels[np.ix_(rows, columns)] - middle  # places may be those of the Earth's centre
    found = np.tensordot(fit_rows, fit_columns @ offsets, 1)
    found[0, 0] += middle
    return np.ascontiguousarray(found)


def _rests(
    pixels: NDArray[np.float64], parts: list[Window], surfaces: list[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return the mean squared distance of the pixels of tiles from surfaces; NaN where one has no place."""
    tiles = (TreeTile * len(parts))()
    for tile, (rows, columns), surface in zip(tiles, parts, surfaces, strict=True):
        tile.surface, tile.degree = surface.ctypes.data, len(surface) - 1
        tile.pixels = pixels.ctypes.data + 24 * (rows.start * pixels.shape[1] + columns.start)
        tile.rows, tile.columns = rows.stop - rows.start, columns.stop - columns.start
    call("apertura_rest_tree", TreeJob(tiles=ctypes.addressof(tiles), count=len(parts), stride=pixels.shape[1]))
    return np.array([tile.rest for tile in tiles])


@lru_cache(maxsize=64)
def _fitting(size: int, degree: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return pixels along a side that a surface is fitted to, and the matrix that fits it."""
    place = np.linspace(-1, 1, size) if size > 1 else np.zeros(1)
    some: NDArray[np.int64] = np.unique(
        np.round(np.linspace(0, size - 1, min(size, 4 if degree == 1 else _THIN))).astype(np.int64)
    )
    return some, np.asarray(np.linalg.pinv(np.polynomial.legendre.legvander(place[some], degree)))


def _value(coefficients: NDArray[np.float64], place: float) -> NDArray[np.float64]:
    basis = np.polynomial.legendre.legvander(np.array([place]), len(coefficients) - 1)[0]
    return np.asarray(np.einsum("a,abk,b->k", basis, coefficients, basis))


def _across(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vector across a surface: that of its linear part."""
    across = np.cross(coefficients[0, 1], coefficients[1, 0])
    length = np.linalg.norm(across)
    return np.asarray(across / length if length else np.array([0.0, 0.0, 1.0]))
