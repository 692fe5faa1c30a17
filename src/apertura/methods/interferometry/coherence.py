"""Coherence and phase of two images of one scene over a window, their common band, and the bias of coherence."""

from collections.abc import Iterable
from math import exp, lgamma
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.contracts import Window

# ---- Common band of two images, and the window of coherence ---------------------------------------------------------


def common_band(
    carriers: tuple[NDArray[np.float64], NDArray[np.float64]], spectra: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> float:
    """Return the coherence of unchanged terrain in two images with Gaussian bands.

    Parameters
    ----------
    carriers
        (2,) float64 each, centre of the image's band, cycles per metre east and north.
    spectra
        (2, 2) float64 each, covariance of the image's band, cycles² per m².

    Returns
    -------
    float
        Coherence, 0 to 1; differs by up to 0.09 from the overlap of equally wide bands with sharp edges.

    Notes
    -----
    Source: docs/theory/interferometry.md, eq. 1a.

    Examples
    --------
    >>> flat = np.eye(2) / 12  # as wide as a band of one cycle per metre
    >>> [round(common_band((np.zeros(2), np.array([shift, 0.0])), (flat, flat)), 2) for shift in (0, 0.2, 0.5, 1)]
    [1.0, 0.89, 0.47, 0.05]
    """
    difference, both = carriers[1] - carriers[0], (spectra[0] + spectra[1]) / 2
    shape = np.linalg.det(spectra[0]) * np.linalg.det(spectra[1]) / np.linalg.det(both) ** 2
    return float(shape**0.25 * np.exp(-difference @ np.linalg.solve(both, difference) / 4))


def window_px(spectrum: NDArray[np.float64], spacing_m: float, *, looks: float = 16, most: int = 65) -> int:
    """Return the side of the smallest window with at least `looks` independent samples, pixels, odd.

    Parameters
    ----------
    spectrum
        (2, 2) float64, covariance of the image's band, cycles² per m²; with sharp band edges, the area of a look is
        1/(12 √det) m².
    spacing_m
        Pixel spacing.
    looks
        Required number of independent samples for the coherence estimate.
    most
        Largest side of a window, pixels.

    Examples
    --------
    >>> window_px(np.eye(2) / 12, 0.25), window_px(np.eye(2) / 12, 2.0)
    (17, 5)
    """
    cells = 12 * np.sqrt(max(np.linalg.det(spectrum), 0.0)) * spacing_m**2  # area of a pixel, in looks
    side = np.sqrt(looks / min(cells, 1)) if cells > 0 else np.inf
    return int(min(2 * np.ceil((side - 1) / 2) + 1, most))


# ---- Coherence and phase over a square window -----------------------------------------------------------------------


def coherence(
    first: NDArray[np.complex64], second: NDArray[np.complex64], *, window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Return coherence and phase of two images over a window about each pixel, and the number of looks of the window.

    Both images are backprojected to the same terrain: their phase difference contains neither the flat-earth nor the
    terrain phase, nor the carrier of either image. No slope is removed.

    Parameters
    ----------
    first, second
        (y, x) complex64 on one grid, or a block of this grid with `window` // 2 more pixels on each side. Pixels that
        are NaN in either image are excluded from all windows.
    window
        Pixels along a side, odd. Pixels outside the block are excluded.

    Returns
    -------
    magnitude
        (y, x) float32, 0 to 1, biased estimate: its mean for independent images is `chance(looks)`. The bias is removed
        by `unbiased`. NaN where either image is NaN or zero within the window.
    phase
        (y, x) float32, phase of the first image minus that of the second, rad; NaN where the magnitude is NaN.
    looks
        Independent samples in a whole window, from the autocorrelation of each image; NaN for blocks without valid
        pixels.

    Raises
    ------
    ValueError
        If shapes differ or the window is not odd and positive.

    Notes
    -----
    Source: docs/theory/interferometry.md, eqs. 2 and 3. The order of each sum is fixed, so that a block with its margin
    reproduces the values of the whole image bit by bit.

    Examples
    --------
    >>> image = np.exp(1j * np.arange(25.0).reshape(5, 5) ** 2).astype(np.complex64)
    >>> magnitude, phase, looks = coherence(1j * image, 3 * image, window=3)
    >>> f"{magnitude[2, 2]:.3f} {phase[2, 2]:.3f}"
    '1.000 1.571'
    """
    if first.shape != second.shape or window < 1 or window % 2 == 0:
        raise ValueError(
            f"{first.shape=}, {second.shape=}, {window=}: equal shapes and an odd, positive window are required"
        )
    one, other = (np.where(np.isfinite(first) & np.isfinite(second), image, 0) for image in (first, second))
    return *estimate(first, second, window), _looks(one.astype(np.complex128), other.astype(np.complex128), window)


def estimate(
    first: NDArray[np.complex64], second: NDArray[np.complex64], window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return magnitude and phase of `coherence`, docs/theory/interferometry.md, eq. 2.

    Examples
    --------
    >>> estimate(np.full((3, 3), 2j, np.complex64), np.ones((3, 3), np.complex64), 3)[1].round(3)[1]
    array([1.571, 1.571, 1.571], dtype=float32)
    """
    finite = np.isfinite(first) & np.isfinite(second)
    one, other = (np.where(finite, image, 0).astype(np.complex128) for image in (first, second))
    crossed = box_sum(one * other.conj(), window)
    power = box_sum(np.abs(one) ** 2, window) * box_sum(np.abs(other) ** 2, window)
    valid = finite & (power > 0)
    magnitude, phase = (np.full(first.shape, np.nan, np.float32) for _ in range(2))
    magnitude[valid] = np.minimum(np.abs(crossed[valid]) / np.sqrt(power[valid]), 1)
    phase[valid] = np.angle(crossed[valid])
    return magnitude, phase


def chance(looks: float) -> float:
    """Return the mean estimated coherence of independent images, docs/theory/interferometry.md, eq. 4.

    Examples
    --------
    >>> [round(chance(looks), 3) for looks in (1, 4, 25)]
    [1.0, 0.457, 0.178]
    """
    return exp(lgamma(looks) + lgamma(1.5) - lgamma(looks + 0.5))


def unbiased(magnitude: NDArray[np.floating], looks: float | NDArray[np.floating]) -> NDArray[np.float32]:
    """Remove the bias of estimated coherence, docs/theory/interferometry.md, eq. 5.

    Parameters
    ----------
    magnitude
        (...) float32, from `coherence`.
    looks
        Number of looks, more than 1: one number, or one for each pixel.

    Returns
    -------
    ndarray
        (...) float32, 0 to 1; 0 where the estimate is below the rms value for independent images.

    Raises
    ------
    ValueError
        If `looks` is 1 or less, because any two single samples are coherent.

    Examples
    --------
    >>> unbiased(np.array([0.2, 0.5, 1.0], np.float32), 25.0).round(3)
    array([0.   , 0.468, 1.   ], dtype=float32)
    """
    if not np.all(looks > 1):
        raise ValueError(f"{np.min(looks)=}: the coherence of a single look is 1 for any images; use a wider window")
    square = (looks * magnitude.astype(np.float64) ** 2 - 1) / (looks - 1)
    return np.sqrt(np.maximum(square, 0)).astype(np.float32)


def box_sum(values: NDArray[Any], window: int) -> NDArray[Any]:
    """Return the sum over a window about each element of a plane, with zeros outside the plane.

    A running sum is not used: it would propagate the rounding error of a bright point to all following elements.
    """
    for axis in (0, 1):
        lines = np.swapaxes(values, 0, axis)
        padded = np.pad(lines, ((window // 2, window // 2), (0, 0)))
        added = padded[: len(lines)].copy()
        for at in range(1, window):
            added += padded[at : at + len(lines)]
        values = np.swapaxes(added, 0, axis)
    return values


def _looks(one: NDArray[np.complex128], other: NDArray[np.complex128], window: int) -> float:
    """Return the independent samples of a window, docs/theory/interferometry.md, eq. 3, accurate to 1e-6."""
    product = _correlation(one, window) * _correlation(other, window).conj()
    lag = window - np.abs(np.arange(1 - window, window))
    weight = np.multiply.outer(lag, lag)
    return float(window**4 / max((product * weight).sum().real, 1)) if np.isfinite(product).all() else float("nan")


def _correlation(image: NDArray[np.complex128], window: int) -> NDArray[np.complex128]:
    """Return the autocorrelation at lags below `window` along both axes, 1 at lag 0."""
    # Zero-padded, because the correlation is circular otherwise.
    padded = [scipy.fft.next_fast_len(size + window - 1) for size in image.shape]
    lags = np.arange(1 - window, window)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Single precision suffices, because the image is complex64; a peak of 1 avoids overflow of the power.
        spectrum = scipy.fft.fft2((image / np.abs(image).max()).astype(np.complex64), padded)
        correlation = spectrum.real**2 + spectrum.imag**2
        for axis in (0, 1):
            correlation = np.take(scipy.fft.ifft(correlation, axis=axis), lags, axis=axis)
        return np.asarray(correlation / correlation[window - 1, window - 1].real, np.complex128)


# ---- Coherence and phase of whole images, tile by tile --------------------------------------------------------------


def map_coherence(
    first: NDArray[np.complex64], second: NDArray[np.complex64], tiles: Iterable[Window], *, window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], float, NDArray[np.float32]]:
    """Return coherence and phase of whole images, computed tile by tile by `coherence`.

    Parameters
    ----------
    first, second
        (y, x) complex64 on one grid, NaN where no image was formed; each tile is read with its margin.
    tiles
        Windows that cover the grid.
    window
        Pixels along a side, odd.

    Returns
    -------
    magnitude, phase, looks
        As returned by `coherence`; looks are the median over tiles, NaN without a finite value.
    shared
        (y, x) float32, effective fraction of the pixels of a window that contribute its energy: about 1/2 for terrain,
        1/`looks` for a point (docs/theory/interferometry.md, eq. 6).

    Examples
    --------
    >>> image = np.exp(1j * np.arange(64.0).reshape(8, 8) ** 2).astype(np.complex64)
    >>> halves = [(slice(0, 8), slice(0, 4)), (slice(0, 8), slice(4, 8))]
    >>> tiled, whole = map_coherence(image, 1j * image, halves, window=3), coherence(image, 1j * image, window=3)
    >>> bool((tiled[0] == whole[0]).all() and (tiled[1] == whole[1]).all())
    True
    """
    planes = [np.full(first.shape, np.nan, np.float32) for _ in range(3)]
    looks: list[float] = []
    for tile in tiles:
        wider, inner = with_margin(tile, window // 2, first.shape)
        one, other = np.asarray(first[wider]), np.asarray(second[wider])
        magnitude, phase, looks_of_tile = coherence(one, other, window=window)
        looks.append(looks_of_tile)
        planes[0][tile], planes[1][tile] = magnitude[inner], phase[inner]
        planes[2][tile] = energy_spread(one, other, window)[inner]
    finite = [value for value in looks if np.isfinite(value)]
    return planes[0], planes[1], float(np.median(finite)) if finite else float("nan"), planes[2]


def with_margin(tile: Window, margin: int, shape: tuple[int, ...]) -> tuple[Window, Window]:
    """Return a tile widened by a margin within a raster, and the tile relative to the widened one.

    Examples
    --------
    >>> with_margin((slice(0, 8), slice(8, 16)), 3, (16, 18))
    ((slice(0, 11, None), slice(5, 18, None)), (slice(0, 8, None), slice(3, 11, None)))
    """
    rows, columns = (
        slice(max(0, at.start - margin), min(size, at.stop + margin)) for at, size in zip(tile, shape, strict=True)
    )
    inner, across = (
        slice(at.start - wide.start, at.stop - wide.start) for at, wide in zip(tile, (rows, columns), strict=True)
    )
    return (rows, columns), (inner, across)


def energy_spread(one: NDArray[np.complex64], other: NDArray[np.complex64], window: int) -> NDArray[np.float64]:
    """Return (Σp)²/(N Σp²) over a window about each pixel, with p the magnitude of the product of the images."""
    power = np.abs(one.astype(np.complex128) * other)
    finite = np.isfinite(power)
    power = np.where(finite, power, 0)
    total, squares, count = (
        box_sum(power, window),
        box_sum(power**2, window),
        box_sum(finite.astype(np.float64), window),
    )
    return np.asarray(total**2 / np.maximum(count * squares, np.finfo(np.float64).tiny))
