"""Tiles of a tree: their sides, and the smooth surface through their pixels."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.contracts import Window

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
    rows, columns = ([round(n * size / parts) for n in range(parts + 1)] for size, parts in _parts(shape, side_px))
    for top, bottom in zip(rows, rows[1:], strict=False):
        for left, right in zip(columns, columns[1:], strict=False):
            yield slice(top, bottom), slice(left, right)


def _parts(shape: tuple[int, ...], side_px: int) -> list[tuple[int, int]]:
    return [(size, -(-size // side_px)) for size in shape]


def surface_of(pixels: NDArray[np.float64]) -> Surface:
    """Return the surface through the pixels of a tile: a plane where it will do.

    Parameters
    ----------
    pixels
        (y, x, 3) float64, metres.

    Notes
    -----
    Source: docs/theory/tree.md, "Surface".

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(40.0), np.arange(30.0))
    >>> surface_of(np.stack([x, y, 0.001 * x * x], -1)).rough_m < 1e-9
    True
    """
    middle = pixels[pixels.shape[0] // 2, pixels.shape[1] // 2]
    offsets = pixels - middle  # places may be those of the Earth's centre
    for degree in (1, DEGREE):
        (rows, fit_rows, all_rows), (columns, fit_columns, all_columns) = (
            _fitting(size, degree) for size in pixels.shape[:2]
        )
        some = fit_columns @ offsets[np.ix_(rows, columns)]
        found = np.tensordot(fit_rows, some, 1)
        rest = (offsets - all_columns @ np.tensordot(all_rows, found, 1)).ravel()
        rough_m = float(np.sqrt(rest @ rest * 3 / rest.size))
        if not rough_m > _PLANE_M:
            break
    if not np.isfinite(rough_m):
        return Surface(np.zeros((1, 1, 3)), np.zeros(3), np.zeros(3), np.inf)
    found[0, 0] += middle
    return Surface(found, _value(found, 0.0), _across(found), rough_m)


@lru_cache(maxsize=64)
def _fitting(size: int, degree: int) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels that a surface is fitted to, the matrix that fits it, and the one that evaluates it everywhere."""
    place = np.linspace(-1, 1, size) if size > 1 else np.zeros(1)
    some = np.unique(np.round(np.linspace(0, size - 1, min(size, 4 if degree == 1 else _THIN))).astype(int))
    basis = np.polynomial.legendre.legvander(place, degree)
    return some, np.linalg.pinv(basis[some]), basis


def _value(coefficients: NDArray[np.float64], place: float) -> NDArray[np.float64]:
    basis = np.polynomial.legendre.legvander(np.array([place]), len(coefficients) - 1)[0]
    return np.asarray(np.einsum("a,abk,b->k", basis, coefficients, basis))


def _across(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vector across a surface: that of its linear part."""
    across = np.cross(coefficients[0, 1], coefficients[1, 0])
    length = np.linalg.norm(across)
    return np.asarray(across / length if length else np.array([0.0, 0.0, 1.0]))
