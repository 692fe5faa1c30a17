"""Coherence and phase of two images of one scene, over a square window, and what chance makes of them."""

from math import exp, lgamma
from typing import Any

import numpy as np
from numpy.typing import NDArray


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
        Independent samples in a whole window, by how each image's neighbours resemble each other; NaN of blocks
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
    crossed = boxed(one * other.conj(), window)
    power = boxed(np.abs(one) ** 2, window) * boxed(np.abs(other) ** 2, window)
    told = there & (power > 0)
    magnitude, phase = np.full(first.shape, np.nan, np.float32), np.full(first.shape, np.nan, np.float32)
    magnitude[told] = np.minimum(np.abs(crossed[told]) / np.sqrt(power[told]), 1)
    phase[told] = np.angle(crossed[told])
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


def boxed(values: NDArray[Any], window: int) -> NDArray[Any]:
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
    """Return a window's independent samples, docs/theory/interferometry.md, eq. 3."""
    alike = _correlation(one, window) * _correlation(other, window).conj()
    lag = window - np.abs(np.arange(1 - window, window))
    weight = np.multiply.outer(lag, lag)
    return float(window**4 / max((alike * weight).sum().real, 1)) if np.isfinite(alike).all() else float("nan")


def _correlation(image: NDArray[np.complex128], window: int) -> NDArray[np.complex128]:
    """Return how alike pixels are that lie up to `window` - 1 apart: (2 `window` - 1,) twice, 1 in the middle."""
    padded = np.pad(image, [(0, window - 1), (0, window - 1)])  # else the edges would meet
    alike = np.fft.ifft2(np.abs(np.fft.fft2(padded)) ** 2)
    near = np.arange(1 - window, window)
    alike = alike[np.ix_(near % alike.shape[0], near % alike.shape[1])]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(alike / alike[window - 1, window - 1].real)
