"""Coherence and phase of two images of one scene over a window, the common band, and what chance makes of them."""

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
    """Return the coherence of unchanged ground in two images of Gaussian bands.

    Parameters
    ----------
    carriers
        (2,) float64 each, cycles per metre east and north, the middle of the image's band.
    spectra
        (2, 2) float64 each, cycles² per m², the covariance of that band.

    Returns
    -------
    float
        0 to 1, within 0.09 of what equally wide bands with sharp edges share.

    Notes
    -----
    Source: docs/theory/interferometry.md, eq. 1a.

    Examples
    --------
    >>> flat = np.eye(2) / 12  # as wide as a band of one cycle per metre
    >>> [round(common_band((np.zeros(2), np.array([apart, 0.0])), (flat, flat)), 2) for apart in (0, 0.2, 0.5, 1)]
    [1.0, 0.89, 0.47, 0.05]
    """
    difference, both = carriers[1] - carriers[0], (spectra[0] + spectra[1]) / 2
    shape = np.linalg.det(spectra[0]) * np.linalg.det(spectra[1]) / np.linalg.det(both) ** 2
    return float(shape**0.25 * np.exp(-difference @ np.linalg.solve(both, difference) / 4))


def window_px(spectrum: NDArray[np.float64], spacing_m: float, *, looks: float = 16, most: int = 65) -> int:
    """Return the side of the smallest window of at least `looks` independent samples, pixels, odd.

    Parameters
    ----------
    spectrum
        (2, 2) float64, cycles² per m², the covariance of the image's band: of one with sharp edges a look is
        1/(12 √det) m².
    spacing_m
        Between pixels.
    looks
        Independent samples that coherence is estimated from.
    most
        A window is not wider than so many pixels.

    Examples
    --------
    >>> window_px(np.eye(2) / 12, 0.25), window_px(np.eye(2) / 12, 2.0)
    (17, 5)
    """
    cells = 12 * np.sqrt(max(np.linalg.det(spectrum), 0.0)) * spacing_m**2  # of one pixel
    side = np.sqrt(looks / min(cells, 1)) if cells > 0 else np.inf
    return int(min(2 * np.ceil((side - 1) / 2) + 1, most))


# ---- Coherence and phase over a square window -----------------------------------------------------------------------


def coherence(
    first: NDArray[np.complex64], second: NDArray[np.complex64], *, window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Return coherence and phase of two images over a window about each pixel, and how many looks that window has.

    Both images are backprojected to one ground, so neither flat earth nor terrain is left in their phase difference,
    and its mean over a window has no carrier although each image keeps its own: no slope is taken off.

    Parameters
    ----------
    first, second
        (y, x) complex64 on one grid, or one block of it with `window` // 2 pixels more on each side. NaN in either:
        the pixel counts in no window.
    window
        Pixels along a side, odd. What of it lies outside the block does not count.

    Returns
    -------
    magnitude
        (y, x) float32, 0 to 1, as estimated: of images that have nothing in common it is `chance(looks)` in the mean,
        `unbiased` takes that off. NaN where either image is NaN, or the window empty of one of them.
    phase
        (y, x) float32, rad, of the first less that of the second; NaN with the magnitude.
    looks
        Independent samples in a whole window, by the autocorrelation of each image; NaN of blocks
        without a value.

    Raises
    ------
    ValueError
        If shapes differ or the window is not odd and positive.

    Notes
    -----
    Source: docs/theory/interferometry.md, eqs. 2 and 3. Each sum is added pixel by pixel in one order, so that a block
    with its margin gives what the whole image gives, to the bit.

    Examples
    --------
    >>> image = np.exp(1j * np.arange(25.0).reshape(5, 5) ** 2).astype(np.complex64)
    >>> magnitude, phase, looks = coherence(1j * image, 3 * image, window=3)
    >>> f"{magnitude[2, 2]:.3f} {phase[2, 2]:.3f}"
    '1.000 1.571'
    """
    if first.shape != second.shape or window < 1 or window % 2 == 0:
        raise ValueError(f"{first.shape=}, {second.shape=}, {window=}: one shape and an odd window are needed")
    there = np.isfinite(first) & np.isfinite(second)
    one, other = (np.where(there, image, 0).astype(np.complex128) for image in (first, second))
    crossed = box_sum(one * other.conj(), window)
    power = box_sum(np.abs(one) ** 2, window) * box_sum(np.abs(other) ** 2, window)
    valid = there & (power > 0)
    magnitude, phase = np.full(first.shape, np.nan, np.float32), np.full(first.shape, np.nan, np.float32)
    magnitude[valid] = np.minimum(np.abs(crossed[valid]) / np.sqrt(power[valid]), 1)
    phase[valid] = np.angle(crossed[valid])
    return magnitude, phase, _looks(one, other, window)


def chance(looks: float) -> float:
    """Return the mean coherence that is measured where there is none, docs/theory/interferometry.md, eq. 4.

    Examples
    --------
    >>> [round(chance(looks), 3) for looks in (1, 4, 25)]
    [1.0, 0.457, 0.178]
    """
    return exp(lgamma(looks) + lgamma(1.5) - lgamma(looks + 0.5))


def unbiased(magnitude: NDArray[np.float32], looks: float) -> NDArray[np.float32]:
    """Return coherence without what chance adds to it, docs/theory/interferometry.md, eq. 5.

    Parameters
    ----------
    magnitude
        (...) float32, from `coherence`.
    looks
        More than 1.

    Returns
    -------
    ndarray
        (...) float32, 0 to 1: 0 where the measured coherence is less than chance gives in the root of the mean square.

    Raises
    ------
    ValueError
        If there is one look: any two numbers are coherent.

    Examples
    --------
    >>> unbiased(np.array([0.2, 0.5, 1.0], np.float32), 25.0).round(3)
    array([0.   , 0.468, 1.   ], dtype=float32)
    """
    if not looks > 1:
        raise ValueError(f"{looks=}: coherence of one look is 1 whatever the images hold; take a wider window")
    square = (looks * magnitude.astype(np.float64) ** 2 - 1) / (looks - 1)
    return np.sqrt(np.maximum(square, 0)).astype(np.float32)


def box_sum(values: NDArray[Any], window: int) -> NDArray[Any]:
    """Return the sum over a window about each element of a plane; beside the plane there is nothing.

    No running sum: that would leave rounding of a bright point in all that follows it.
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
    """Return a window's independent samples, docs/theory/interferometry.md, eq. 3, to 1e-6 of them."""
    alike = _correlation(one, window) * _correlation(other, window).conj()
    lag = window - np.abs(np.arange(1 - window, window))
    weight = np.multiply.outer(lag, lag)
    return float(window**4 / max((alike * weight).sum().real, 1)) if np.isfinite(alike).all() else float("nan")


def _correlation(image: NDArray[np.complex128], window: int) -> NDArray[np.complex128]:
    """Return the autocorrelation at lags below `window`: (2 `window` - 1,) twice, 1 in the middle."""
    # Longer, else the correlation would be circular.
    longer = [scipy.fft.next_fast_len(size + window - 1) for size in image.shape]
    near = np.arange(1 - window, window)
    with np.errstate(divide="ignore", invalid="ignore"):
        # In single precision, as the image came: its peak at 1, so that powers of any image fit.
        spectrum = scipy.fft.fft2((image / np.abs(image).max()).astype(np.complex64), longer)
        alike = spectrum.real**2 + spectrum.imag**2
        for axis in (0, 1):
            alike = np.take(scipy.fft.ifft(alike, axis=axis), near, axis=axis)
        return np.asarray(alike / alike[window - 1, window - 1].real, np.complex128)


# ---- Coherence and phase of whole images, tile by tile --------------------------------------------------------------


def map_coherence(
    first: NDArray[np.complex64], second: NDArray[np.complex64], tiles: Iterable[Window], *, window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], float, NDArray[np.float32]]:
    """Return coherence and phase of whole images, tile by tile, as `coherence` has them.

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
    magnitude, phase, looks
        As of `coherence`; looks are the median of the tiles', NaN where none has any.
    shared
        (y, x) float32, pixels that a window's energy is spread over, as a share of it: about 1/2 of ground, 1/`looks`
        of a point (docs/theory/interferometry.md, eq. 6).

    Examples
    --------
    >>> image = np.exp(1j * np.arange(64.0).reshape(8, 8) ** 2).astype(np.complex64)
    >>> halves = [(slice(0, 8), slice(0, 4)), (slice(0, 8), slice(4, 8))]
    >>> apart, whole = map_coherence(image, 1j * image, halves, window=3), coherence(image, 1j * image, window=3)
    >>> bool((apart[0] == whole[0]).all() and (apart[1] == whole[1]).all())
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
        magnitude, phase, looks_of_tile = coherence(one, other, window=window)
        looks.append(looks_of_tile)
        planes[0][tile], planes[1][tile] = magnitude[inner], phase[inner]
        planes[2][tile] = _shared(one, other, window)[inner]
    there = [one for one in looks if np.isfinite(one)]
    return planes[0], planes[1], float(np.median(there)) if there else float("nan"), planes[2]


def _shared(one: NDArray[np.complex64], other: NDArray[np.complex64], window: int) -> NDArray[np.float64]:
    """Return (Σp)²/(N Σp²) over a window about each pixel, p the magnitude of the images' product."""
    power = np.abs(one.astype(np.complex128) * other)
    there = np.isfinite(power)
    power = np.where(there, power, 0)
    total, squares, count = box_sum(power, window), box_sum(power**2, window), box_sum(there.astype(np.float64), window)
    return np.asarray(total**2 / np.maximum(count * squares, np.finfo(np.float64).tiny))
