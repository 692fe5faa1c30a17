"""What the pairs of one flight add up to."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def coherent_sum(
    images: NDArray[np.complex64], peaks: NDArray[np.float64], phases_rad: NDArray[np.float64] | float = 0.0
) -> NDArray[np.complex64]:
    """Return the complex mean of peak-normalised images.

    Their spectra lie side by side, so the sum resolves finer than either: mono- and bistatic images add in phase
    once sidelink and path offsets are right (docs/theory.md, eq. 7).

    Parameters
    ----------
    images
        (pair, y, x) complex64 on one grid or a block of it, carriers kept; NaN where a pair sees nothing, to which it
        adds nothing.
    peaks
        (pair,) float64, largest magnitude of each whole image.
    phases_rad
        (pair,) float64, taken off each image first.

    Returns
    -------
    ndarray
        (y, x) complex64, 1 where every image peaks in phase, NaN where no pair sees anything.

    Raises
    ------
    ValueError
        If an image is empty.

    Examples
    --------
    >>> coherent_sum(np.array([[[2.0, 0.0]], [[4.0j, 0.0]]], np.complex64), np.array([2.0, 4.0])).round(3)
    array([[0.5+0.5j, 0. +0.j ]], dtype=complex64)
    """
    turned = np.exp(-1j * np.asarray(phases_rad)).astype(np.complex64)
    return np.asarray(_mean(_normalised(images, peaks) * turned.reshape(-1, 1, 1)), np.complex64)


def noncoherent_sum(images: NDArray[np.complex64], peaks: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the mean power of peak-normalised images: no gain in resolution, less speckle, no phase to trust.

    Parameters and errors as `coherent_sum`; returns (y, x) float32, linear power.

    Examples
    --------
    >>> noncoherent_sum(np.array([[[2.0, 1.0]], [[4.0j, 0.0]]], np.complex64), np.array([2.0, 4.0]))
    array([[1.   , 0.125]], dtype=float32)
    """
    power = np.abs(_normalised(images, peaks)).astype(np.float64) ** 2
    return np.asarray(_mean(power), np.float32)


def magnitude_sum(images: NDArray[np.complex64], peaks: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the mean magnitude of peak-normalised images, the paper's sum without phase.

    Parameters and errors as `coherent_sum`; returns (y, x) float32.

    Examples
    --------
    >>> magnitude_sum(np.array([[[2.0, 1.0]], [[4.0j, 0.0]]], np.complex64), np.array([2.0, 4.0]))
    array([[1.  , 0.25]], dtype=float32)
    """
    return np.asarray(_mean(np.abs(_normalised(images, peaks))), np.float32)


def _mean(images: NDArray[Any]) -> NDArray[Any]:
    """Return the mean over all pairs; one that sees nothing of a pixel counts as zero, and NaN if none does."""
    unseen = np.isnan(images)
    mean: NDArray[Any] = np.where(unseen, 0, images).mean(axis=0)
    mean[unseen.all(axis=0)] = np.nan
    return mean


def _normalised(images: NDArray[np.complex64], peaks: NDArray[np.float64]) -> NDArray[np.complex64]:
    if not (peaks > 0).all():
        raise ValueError(f"{peaks=}: an empty image adds nothing; leave its pair out")
    return np.asarray(images / peaks[:, None, None], np.complex64)
