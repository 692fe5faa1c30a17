"""Measures of an image: numerical error, entropy, coherence, noise floor."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

# ---- Measures of one image


class BlockRaster(Protocol):
    """2-D array whose slices are numpy arrays: a numpy or zarr array."""

    @property
    def shape(self) -> tuple[int, ...]: ...  # noqa: D102

    def __getitem__(self, window: tuple[slice, slice], /) -> Any: ...


HELD_BYTES = 1 << 27
"""Largest raster that is kept in memory, bytes: 4096 x 4096 complex64 pixels."""


def held(raster: BlockRaster) -> BlockRaster:
    """Load a raster that is read repeatedly into memory, unless it is larger than `HELD_BYTES`.

    Examples
    --------
    >>> held(Amplitude(np.array([[4.0, 9.0]], np.float32)))
    array([[2.+0.j, 3.+0.j]], dtype=complex64)
    """
    rows, columns = raster.shape
    if isinstance(raster, np.ndarray) or rows * columns * raster[0:1, 0:1].dtype.itemsize > HELD_BYTES:
        return raster
    return np.asarray(raster[0:rows, 0:columns])


def numerical_error_db(computed: NDArray[np.complex64], reference: NDArray[np.complex128]) -> float:
    """Return the RMS error of pixels after a common complex gain, relative to the RMS of the reference, dB.

    Parameters
    ----------
    computed, reference
        (pixel,) complex.

    Notes
    -----
    Source: docs/theory.md, "Image" (numerical_error_db).

    Examples
    --------
    >>> exact = np.array([1.0 + 0j, 2.0, 2.0])
    >>> round(numerical_error_db(2j * (exact + [0, 0, 0.003]), exact), 1)
    -62.6
    """
    values = computed.astype(np.complex128)
    power = np.vdot(values, values).real
    gain = complex(np.vdot(values, reference) / power) if power else 0j
    error = np.sqrt((np.abs(gain * values - reference) ** 2).mean())
    level = np.sqrt((np.abs(reference) ** 2).mean())
    return float(20 * np.log10(max(error / level, np.finfo(np.float64).eps))) if level > 0 else 0.0


@dataclass(frozen=True)
class ImageStatistics:
    """Statistics of an image's pixels.

    Attributes
    ----------
    entropy
        Shannon entropy −Σ q ln q, nats, with each pixel's fraction q of the total power: lower for better focus.
    noise_floor_db
        Median power relative to peak power, rounded to 0.01 dB: the level between targets.
    peak
        Largest magnitude.
    row, column
        Pixel of the largest magnitude.
    """

    entropy: float
    noise_floor_db: float
    peak: float
    row: int
    column: int


_BINS_PER_DB, _LOWEST_DB, _HIGHEST_DB = 100, -300, 300


def image_statistics(image: BlockRaster, windows: Iterable[tuple[slice, slice]]) -> ImageStatistics:
    """Return entropy, noise floor and peak of an image, one window at a time.

    Parameters
    ----------
    image
        (y, x) complex64, any array whose slices are numpy arrays; NaN is excluded.
    windows
        Windows that cover the image once.

    Raises
    ------
    ValueError
        If all pixels are zero or NaN.

    Examples
    --------
    >>> halves = [(slice(0, 5), slice(0, 10)), (slice(5, 10), slice(0, 10))]
    >>> statistics = image_statistics(np.ones((10, 10), np.complex64), halves)
    >>> round(statistics.entropy, 4), statistics.peak, statistics.noise_floor_db
    (4.6052, 1.0, 0.0)
    """
    total = weighted = peak = 0.0
    peak_pixel = (0, 0)
    counts = np.zeros((_HIGHEST_DB - _LOWEST_DB) * _BINS_PER_DB, np.int64)
    empty = 0
    for window in windows:
        block = np.asarray(image[window])
        power = np.nan_to_num(np.abs(block).astype(np.float64)) ** 2
        best = int(power.argmax())
        if power.flat[best] > peak:
            peak = float(power.flat[best])
            row, column = np.unravel_index(best, power.shape)
            peak_pixel = (window[0].start + int(row), window[1].start + int(column))
        # Sums Σp and Σp ln p for the entropy, and a histogram of power with bins of 0.01 dB. Pixels without power are
        # below the lowest bin.
        present = power[power > 0]
        empty += int(np.isfinite(block).sum()) - present.size
        total += present.sum()
        weighted += (present * np.log(present)).sum()
        bins = np.clip((10 * np.log10(present) - _LOWEST_DB) * _BINS_PER_DB, 0, counts.size - 1)
        counts += np.bincount(bins.astype(np.int64), minlength=counts.size)
    if not peak:
        raise ValueError("all pixels of the image are zero or NaN")
    median_bin = int(np.searchsorted(empty + np.cumsum(counts), (empty + counts.sum()) / 2))
    # Median power over the peak; −Σ q ln q = ln Σp − Σp ln p/Σp with q = p/Σp.
    floor = _LOWEST_DB + median_bin / _BINS_PER_DB - 10 * np.log10(peak)
    return ImageStatistics(
        float(np.log(total) - weighted / total), min(0.0, round(float(floor), 2)), float(np.sqrt(peak)), *peak_pixel
    )


def coherence_factor(contributions: NDArray[np.complex128]) -> float:
    """Return Γ = |Σ s_m|² / (M Σ |s_m|²) of pulse contributions s_m at a pixel: 1 in phase, 1/M for random phases.

    Notes
    -----
    Source: docs/theory.md, "Quality".

    Examples
    --------
    >>> coherence_factor(np.exp(1j * np.array([0.3, 0.3, 0.3])))
    1.0
    """
    energy = len(contributions) * float((np.abs(contributions) ** 2).sum())
    return float(np.round(np.abs(contributions.sum()) ** 2 / energy, 12)) if energy else 0.0


def weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Return the weighted median of values, interpolated.

    Examples
    --------
    >>> weighted_median(np.array([1.0, 9.0, 2.0]), np.array([1.0, 1.0, 1.0]))
    2.0
    """
    order = np.argsort(values)
    share = np.cumsum(weights[order]) - weights[order] / 2
    return float(np.interp(weights.sum() / 2, share, values[order]))


# ---- Power rasters as amplitudes


@dataclass(frozen=True)
class Amplitude:
    """Raster of power presented as complex amplitudes with zero phase, block by block.

    Attributes
    ----------
    power
        (y, x) float32, linear.

    Examples
    --------
    >>> Amplitude(np.array([[4.0, 9.0]], np.float32))[0:1, 1:2]
    array([[3.+0.j]], dtype=complex64)
    """

    power: BlockRaster

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows, columns."""
        return self.power.shape

    def __getitem__(self, window: tuple[slice, slice]) -> NDArray[np.complex64]:
        power: NDArray[Any] = np.asarray(self.power[window])
        return np.asarray(np.sqrt(power), np.complex64)
