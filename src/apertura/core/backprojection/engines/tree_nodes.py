"""Nodes along the axes of a tile, and the surface through its pixels."""

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.backprojection.engines.native_binding import TreeJob, TreeTile, call

# ---- Nodes along an axis of a tile, and interpolation between them
#
# docs/theory/tree.md, "Nodes".

MOST_NODES = 128
"""Nodes along an axis: native/tree_job.hpp."""

COUNTS = (*range(2, 9), *range(10, 65, 2), *range(68, MOST_NODES + 1, 4))
"""Numbers of nodes that are used."""

_NOISE_DB = -20.0  # white noise in the design of weights, relative to the error they are designed for


@lru_cache(maxsize=4096)
def nodes(count: int, error_db: int) -> NDArray[np.float64]:
    """Return the places of so many nodes, (count,) float64, in -1…1: Chebyshev's, mapped to be nearly even.

    Parameters
    ----------
    count
        At least 1.
    error_db
        Tolerated error of one interpolation.

    Notes
    -----
    Source: D. Kosloff, H. Tal-Ezer, J. Comput. Phys. 104 (1993) 457, eq. 2.1 and 3.8.

    Examples
    --------
    >>> nodes(4, -74).round(3)
    array([-0.923, -0.38 ,  0.38 ,  0.923])
    """
    if count == 1:
        return np.zeros(1)
    alpha = float(np.clip(1 / np.cosh(-error_db / 20 * np.log(10) / count), 0.05, 0.9999))
    even = np.cos(np.pi * (np.arange(count)[::-1] + 0.5) / count)
    return np.asarray(np.arcsin(alpha * even) / np.arcsin(alpha))


def weights(count: int, places: NDArray[np.float64], error_db: int, band_rad: float) -> NDArray[np.float64]:
    """Return the weights of nodes at some places: least squares over a flat band.

    Parameters
    ----------
    count, error_db
        Of the nodes.
    places
        (place,) float64, in -1…1.
    band_rad
        Highest wavenumber, rad per half tile.

    Returns
    -------
    ndarray
        (place, count) float64.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 6.

    Examples
    --------
    >>> at = np.array([-0.3, 0.8])
    >>> wave = weights(12, at, -62, 6.0) @ np.exp(5j * nodes(12, -62))
    >>> bool(np.abs(wave - np.exp(5j * at)).max() < 1e-3)
    True
    """
    here = nodes(count, error_db)
    covariance = _sinc(band_rad, here, here) + 10 ** ((error_db + _NOISE_DB) / 10) * np.eye(count)
    return np.asarray(np.linalg.solve(covariance, _sinc(band_rad, here, places)).T)


@lru_cache
def supports(error_db: int) -> NDArray[np.float64]:
    """Return the widest band of the largest of `COUNTS` up to each number, (MOST_NODES + 1,) rad per half tile.

    Examples
    --------
    >>> supports(-74)[[8, 9, 10, 128]]
    array([  4.82,   4.82,   7.28, 187.58])
    """
    text = (
        (files("apertura.core.backprojection.engines") / "tree_supports.csv")
        .read_text(encoding="utf-8")
        .splitlines()[1:]
    )
    column = text[0].split(",").index(str(error_db))
    band_rad = np.zeros(MOST_NODES + 1)
    for line in text[1:]:
        values = line.split(",")
        band_rad[int(values[0]) :] = float(values[column])
    return band_rad


@lru_cache(maxsize=4096)
def matrices(
    count: int, target: int, error_db: int, *, pixels: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the weights of nodes at other nodes or at pixels, in the layout of the compiled tree.

    Parameters
    ----------
    count, error_db
        Of the nodes.
    target
        How many nodes or pixels there are to be interpolated to.
    pixels
        Whether they are pixels, evenly apart, the outermost at -1 and 1.

    Returns
    -------
    spread
        (count, 2·padded) float32: each weight twice, for real and imaginary part; zero beyond the target.
    mix
        (target, count) float32.
    """
    band = float(supports(error_db)[count])
    places = pixel_places(target) if pixels else nodes(target, error_db)
    weight = weights(count, places, error_db, band).astype(np.float32)
    spread = np.zeros((count, -(-target // 8) * 8, 2), np.float32)
    spread[:, :target] = weight.T[..., None]
    return spread.reshape(count, -1), np.ascontiguousarray(weight)


def pixel_places(count: int) -> NDArray[np.float64]:
    """Return where so many pixels lie along a tile, (count,) float64.

    Examples
    --------
    >>> pixel_places(3), pixel_places(1)
    (array([-1.,  0.,  1.]), array([0.]))
    """
    return np.linspace(-1, 1, count) if count > 1 else np.zeros(1)


def _sinc(band_rad: float, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sinc(band_rad / np.pi * (a[:, None] - b)))


# ---- Tiles, and the smooth surface through their pixels

BY_TREE, DIRECTLY, WITHOUT_ECHO = range(3)
"""Variant by which a group of pulses is summed over a tile: native/tree_job.hpp, TreeWay."""

DEGREE = 6
"""Degree of a surface that is no plane."""

_PLANE_M = 2e-5  # RMS distance of pixels from a plane that counts as one
_THIN = 20  # pixels along a side that a surface is fitted to, at most


@dataclass(frozen=True, eq=False)
class Surface:
    """Smooth surface through the pixels of a tile.

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
        RMS distance of the pixels from it; infinite if a pixel has no finite position.
    """

    coefficients: NDArray[np.float64]
    centre_m: NDArray[np.float64]
    up: NDArray[np.float64]
    rough_m: float


def windows(shape: tuple[int, ...], side_px: int) -> Iterator[Window]:
    """Yield windows of at most `side_px` pixels a side that divide a block of pixels as evenly as possible.

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
    """Return the surfaces through the pixels of tiles: planes where these are close enough.

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
    surfaces = [Surface(np.zeros((1, 1, 3)), np.zeros(3), np.zeros(3), np.inf)] * len(parts)
    left = list(range(len(parts)))
    for degree in (1, DEGREE):
        fitted = [_fit(pixels[parts[number]], degree) for number in left]
        rests = _residuals(pixels, [parts[number] for number in left], fitted)
        for number, coefficients, rest in zip(left, fitted, rests, strict=True):
            if np.isfinite(rest):
                centre = _value(coefficients, 0.0)
                surfaces[number] = Surface(coefficients, centre, _across(coefficients), float(np.sqrt(rest)))
        left = [number for number in left if _PLANE_M < surfaces[number].rough_m < np.inf]
        if not left:
            break
    return surfaces


def _fit(pixels: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return the coefficients of the surface through some pixels of a tile."""
    middle = pixels[pixels.shape[0] // 2, pixels.shape[1] // 2]
    (rows, fit_rows), (columns, fit_columns) = (_fitting(size, degree) for size in pixels.shape[:2])
    offsets = pixels[np.ix_(rows, columns)] - middle  # places may be those of the Earth's centre
    coefficients = np.tensordot(fit_rows, fit_columns @ offsets, 1)
    coefficients[0, 0] += middle
    return np.ascontiguousarray(coefficients)


def _residuals(
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
