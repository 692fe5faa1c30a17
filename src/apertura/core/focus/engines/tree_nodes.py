"""Nodes along an axis of a tile: where they lie, how wide a band they hold, and weights that interpolate between them.

docs/theory/tree.md, "Nodes".
"""

from functools import lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

MOST_NODES = 128
"""Along an axis."""

COUNTS = (*range(2, 9), *range(10, 65, 2), *range(68, MOST_NODES + 1, 4))
"""Numbers of nodes that are used."""

NODES_DB = (-44, -50, -56, -62, -68, -74, -80, -86, -92, -98)
"""RMS errors of one interpolation that nodes are made for."""

_NOISE_DB = -20.0  # white noise that weights are made for, beside the error they are made for

_GAUSS, _SHARE = np.polynomial.legendre.leggauss(160)


@lru_cache(maxsize=4096)
def nodes(count: int, error_db: int) -> NDArray[np.float64]:
    """Return the places of so many nodes, (count,) float64, in -1…1: Chebyshev's, mapped to be nearly even.

    Parameters
    ----------
    count
        At least 1.
    error_db
        What one interpolation may err by.

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
    >>> found = weights(12, at, -62, 6.0) @ np.exp(5j * nodes(12, -62))
    >>> bool(np.abs(found - np.exp(5j * at)).max() < 1e-3)
    True
    """
    here = nodes(count, error_db)
    covariance = _sinc(band_rad, here, here) + 10 ** ((error_db + _NOISE_DB) / 10) * np.eye(count)
    return np.asarray(np.linalg.solve(covariance, _sinc(band_rad, here, places)).T)


def interpolation_error_db(count: int, error_db: int, band_rad: float) -> float:
    """Return the RMS error over the tile and a flat band of white content, dB; as `weights`.

    Examples
    --------
    >>> interpolation_error_db(12, -62, 8.0) < -62 < interpolation_error_db(12, -62, 12.0)
    True
    """
    here, weight = nodes(count, error_db), weights(count, _GAUSS, error_db, band_rad)
    covariance = _sinc(band_rad, here, here) + 10 ** ((error_db + _NOISE_DB) / 10) * np.eye(count)
    error = 1 - 2 * (weight * _sinc(band_rad, _GAUSS, here)).sum(1) + ((weight @ covariance) * weight).sum(1)
    return float(10 * np.log10(max(float(error @ _SHARE) / 2, 1e-30)))


@lru_cache
def supports(error_db: int) -> NDArray[np.float64]:
    """Return the widest band that the largest of `COUNTS` up to each number holds, (MOST_NODES + 1,) rad per half tile.

    Examples
    --------
    >>> supports(-74)[[8, 9, 10, 128]]
    array([  4.82,   4.82,   7.28, 187.58])
    """
    text = (files("apertura.core.focus.engines") / "tree_supports.csv").read_text(encoding="utf-8").splitlines()[1:]
    column = text[0].split(",").index(str(error_db))
    found = np.zeros(MOST_NODES + 1)
    for line in text[1:]:
        values = line.split(",")
        found[int(values[0]) :] = float(values[column])
    return found


def widest_band(count: int, error_db: int) -> float:
    """Return the widest band that nodes hold, rad per half tile, by bisection: what tree_supports.csv was made with."""
    low, high = 0.0, np.pi / 2 * count
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if interpolation_error_db(count, error_db, middle) <= error_db else (low, middle)
    return low


@lru_cache(maxsize=4096)
def matrices(
    count: int, target: int, error_db: int, *, pixels: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the weights of nodes at others or at pixels, as the compiled tree reads them.

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
