"""Multilooking and speckle: mean power of pixel blocks, equivalent number of looks (ENL), and the Lee filter."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.contracts import Window
from apertura.core.scene.map_crs import BLOCK_PX

LAGS_PX = 32
"""Largest lag of the speckle correlation, pixels: a resolution cell is 2 to 4 pixels wide, and the correlation vanishes
within ten cells."""

_MEASURED_PX = 128  # side of the blocks used for the correlation: at least 96² pixel pairs at each lag
_MEASURED_WINDOWS = 3  # minimum number of windows of the local ENL along a side of a block
_LARGEST_PX = 4096  # largest side of a block; the ENL is not estimated if windows are wider
_MEASURED_BLOCKS, _MOST_PX = 64, 1 << 24  # largest number of blocks, and approximate largest total number of pixels
WINDOW = 7
"""Side of the window for filter and local ENL, in pixels of the multilooked raster, as in Lee (1980)."""

_PARTS = 4  # subdivisions of a block per axis, which model the variation of the look direction across the block
# |ρ|² at large lags above which a block is excluded: blocks of two resolution cells, or a constant image
_MOST_CHANCE = 0.5
_FEWEST_PX = 10  # minimum side of a block: a smaller block contains only lags close to zero
_STEP, _SCATTER = 0.02, 0.2  # histogram bin, and standard deviation of a local estimate for smoothing, of ln(ENL)


def block_means(values: Floats, side: int) -> Floats:
    """Return the means of square blocks of pixels.

    Parameters
    ----------
    values
        (row, column) real; NaN is excluded.
    side
        Side of a block, pixels. If a block extends beyond the image, its value is the mean of the pixels inside the
        image.

    Returns
    -------
    ndarray
        (block row, block column) float64, NaN where fewer than half of the pixels of a block are valid.

    Examples
    --------
    >>> block_means(np.arange(8.0).reshape(2, 4), 2)
    array([[2.5, 4.5]])
    """
    rows, columns = (-(-size // side) * side for size in values.shape)
    padded = np.full((rows, columns), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    blocks = padded.reshape(rows // side, side, columns // side, side)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    return np.where(2 * count >= side**2, total / np.maximum(count, 1), np.nan)


@dataclass(frozen=True, eq=False)
class Speckle:
    """Speckle of an image, described by the correlation of its pixels.

    Attributes
    ----------
    correlation
        (2·lags + 1, 2·lags + 1) float64, |ρ|² over lags of rows and columns up to ±`LAGS_PX`, with ρ the correlation of
        complex pixels. For fully developed speckle, |ρ|² equals the correlation of the pixel powers.

    Notes
    -----
    Source: docs/theory/speckle.md, eqs. 1 to 3.
    """

    correlation: Floats

    @classmethod
    def of(cls, blocks: Iterable[NDArray[np.complex64]]) -> "Speckle":
        """Estimate the speckle of an image by the median correlation over blocks.

        Parameters
        ----------
        blocks
            (row, column) complex64 each, of equal shape. Blocks are excluded if fewer than half of the pixels are valid
            (not NaN), or if all pixels are zero.

        Raises
        ------
        ValueError
            If no valid block is large enough, or if the correlation does not decay within the blocks.

        Examples
        --------
        >>> generator = np.random.default_rng(0)
        >>> white = [generator.standard_normal((64, 64, 2)) @ [1, 1j] for _ in range(20)]
        >>> round(Speckle.of(white).looks(5), 1)
        25.0
        """
        large = (block for block in blocks if min(block.shape) >= _FEWEST_PX)
        valid = (block for block in large if 2 * np.isfinite(block).sum() >= block.size and np.nansum(np.abs(block)))
        correlations = [_squared_correlation(block) for block in valid]
        if not correlations:
            raise ValueError("no block of the image has enough valid pixels")
        middle = np.median(correlations, axis=0)
        corner = slice(0, len(middle) // 4)
        floor = np.median(middle[corner, corner])  # bias of |ρ|² from a finite number of pixels
        if floor > _MOST_CHANCE:
            raise ValueError(f"the correlation between pixels of the image is {floor:.2f} even at large lags")
        return cls(np.maximum(middle - floor, 0.0) / (1 - floor))

    @property
    def area_px(self) -> float:
        """Correlation area ∫|ρ|², pixels."""
        return float(self.correlation.sum())

    def looks(self, side: int) -> float:
        """Return the equivalent number of looks of the mean power over a square of pixels.

        Parameters
        ----------
        side
            Side of the square, pixels.
        """
        most = len(self.correlation) // 2
        share = np.maximum(side - np.abs(np.arange(-most, most + 1)), 0) / side**2
        return float(1 / (share @ self.correlation @ share))


def _flattened(block: NDArray[Any], parts: int) -> NDArray[Any]:
    """Return a block without its quadratic phase, which is fitted to phase gradients in parts × parts subdivisions."""
    places = [np.arange(size) - (size - 1) / 2 for size in block.shape]
    rows, columns = np.meshgrid(*places, indexing="ij")
    equations, gradients, weights = list[list[float]](), list[float](), list[float]()
    for row in np.array_split(np.arange(block.shape[0]), parts):
        for column in np.array_split(np.arange(block.shape[1]), parts):
            part = block[row[0] : row[-1] + 1, column[0] : column[-1] + 1]
            r, c = (float(at[indices].mean()) for at, indices in zip(places, (row, column), strict=True))
            steps = (part[1:] * part[:-1].conj()).sum(), (part[:, 1:] * part[:, :-1].conj()).sum()
            equations += [[1.0, 0.0, r, 0.0, c], [0.0, 1.0, 0.0, c, r]]
            gradients += [float(np.angle(step)) for step in steps]
            weights += [float(np.sqrt(np.abs(step))) for step in steps]
    weight = np.array(weights)
    down, across, d, e, f = np.linalg.lstsq(np.array(equations) * weight[:, None], np.array(gradients) * weight)[0]
    phase = (down + d * rows / 2 + f * columns) * rows + (across + e * columns / 2) * columns
    return np.asarray(block * np.exp(-1j * phase))


def _squared_correlation(block: NDArray[np.complex64]) -> Floats:
    """Return |ρ|² of a block; at each lag, ρ is averaged over all pixel pairs."""
    lags = min(LAGS_PX, min(block.shape) // 2 - 1)
    rows, columns = (slice(size - lags, size + lags + 1) for size in block.shape)
    known = np.isfinite(block)
    flat = _flattened(_flattened(np.where(known, block, 0).astype(np.complex128), 1), _PARTS)

    def lagged(values: NDArray[Any]) -> NDArray[np.complex128]:
        spectrum = np.fft.fft2(values, [2 * size for size in values.shape])
        return np.fft.fftshift(np.fft.ifft2(np.abs(spectrum) ** 2))[rows, columns]

    mean = lagged(flat) / np.maximum(lagged(known).real, 1.0)
    return np.asarray(np.abs(mean / mean[lags, lags]) ** 2)


def _local(power: Floats, within: float) -> tuple[Floats, Floats]:
    """Return mean, and variance divided by squared mean (eq. 4), over the window about each pixel; NaN is excluded."""
    from scipy.ndimage import correlate1d

    def summed(
        values: Floats,
    ) -> Floats:  # not a running sum, which would propagate the rounding error of bright points
        for axis in (0, 1):
            values = correlate1d(values, np.ones(WINDOW), axis=axis, mode="constant")
        return values

    known = np.isfinite(power)
    count, filled = summed(known.astype(np.float64)), np.where(known, power, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = summed(filled) / count
        ratio = np.where(mean > 0, np.maximum(summed(filled**2) / count / mean**2 - 1, 0.0), 0.0)
    return mean, (1 + 1 / within) * ratio + 1 / within


def found_looks(rasters: Iterable[Floats], within: float) -> float:
    """Estimate the equivalent number of looks of homogeneous terrain, the mode of local estimates.

    Parameters
    ----------
    rasters
        (row, column) float64, multilooked power in blocks of the image.
    within
        Number of looks of the mean over a whole window, from `Speckle.looks`.

    Returns
    -------
    float
        Number of looks; NaN if all blocks are smaller than a window.

    Notes
    -----
    Source: docs/theory/speckle.md, eq. 4.

    Examples
    --------
    >>> power = np.random.default_rng(0).gamma(10.0, 0.1, (200, 200))
    >>> bool(abs(found_looks([power], 490.0) / 10 - 1) < 0.1)
    True
    """
    inner, values = slice(WINDOW // 2, -(WINDOW // 2), 2), np.array([])
    for raster in rasters:
        if min(raster.shape) >= WINDOW:
            mean, spread = _local(raster, within)
            values = np.append(values, -np.log(spread[inner, inner][mean[inner, inner] > 0]))
    if not values.size:
        return float("nan")
    bins = np.arange(values.min(), values.max() + _STEP, _STEP)
    counts, _ = np.histogram(values, np.append(bins - _STEP / 2, bins[-1] + _STEP / 2))
    reach = np.arange(-3 * _SCATTER, 3 * _SCATTER + _STEP / 2, _STEP)
    smooth = np.convolve(counts, np.exp(-0.5 * (reach / _SCATTER) ** 2))[len(reach) // 2 :][: len(bins)]
    return float(np.exp(bins[smooth.argmax()]))


def lee(power: Floats, *, looks: float, within: float) -> Floats:
    """Filter speckle by Lee's linear minimum-mean-square-error estimate from local mean and variance.

    Parameters
    ----------
    power
        (row, column) float64, multilooked power, including noise. NaN is excluded from the statistics and preserved.
    looks
        Equivalent number of looks of a pixel.
    within
        Equivalent number of looks of the mean over a whole window, from `Speckle.looks`.

    Returns
    -------
    ndarray
        (row, column) float64, filtered power.

    Notes
    -----
    Source: docs/theory/speckle.md, eqs. 4 and 5: J.-S. Lee, "Digital image enhancement and noise filtering by use of
    local statistics", IEEE TPAMI 2 (1980), 165-168.

    Examples
    --------
    >>> power = np.random.default_rng(0).gamma(4.0, 0.25, (200, 200))
    >>> smooth = lee(power, looks=4.0, within=196.0)
    >>> round(smooth.mean(), 2), bool(smooth.var() < power.var() / 10)
    (np.float64(1.0), True)
    """
    mean, spread = _local(power, within)
    texture = np.maximum(spread - 1 / looks, 0.0) / (1 + 1 / looks)
    with np.errstate(invalid="ignore"):
        return np.asarray(mean + texture / (texture + 1 / looks) * (power - mean))


@dataclass(frozen=True, eq=False)
class Multilook:
    """Mean power of square pixel blocks of an image, window by window.

    Attributes
    ----------
    image
        Window of pixels → (row, column) complex64, NaN where invalid.
    pixels
        Rows and columns of pixels of the image.
    side
        Side of a square, pixels.
    noise
        Window of pixels → (row, column) float64, mean noise power, which is subtracted; None: noise is not subtracted.
    filtered
        True if speckle is filtered before noise is subtracted; False if the number of looks is unknown.
    looks, within, found
        Equivalent numbers of looks of a square, and of the filter window, both computed from the speckle correlation;
        and number of looks of a square measured on homogeneous terrain. NaN if the image has too few valid pixels.
    """

    image: Callable[[Window], NDArray[np.complex64]]
    pixels: tuple[int, int]
    side: int
    noise: Callable[[Window], Floats] | None
    filtered: bool
    looks: float
    within: float
    found: float

    @classmethod
    def of(
        cls,
        image: Callable[[Window], NDArray[np.complex64]],
        pixels: tuple[int, int],
        side: int,
        *,
        noise: Callable[[Window], Floats] | None = None,
        filtered: bool = False,
    ) -> "Multilook":
        """Create the multilooked power of an image; the number of looks is measured in randomly placed blocks.

        Parameters
        ----------
        image, pixels, side, noise, filtered
            As for `Multilook`.

        Examples
        --------
        >>> white = np.random.default_rng(0).standard_normal((512, 512, 2)) @ [1, 1j]
        >>> multilook = Multilook.of(lambda window: white[window], white.shape, 4)
        >>> multilook.shape, round(multilook.looks), multilook.mean((slice(0, 2), slice(5, 8))).shape
        ((128, 128), 16, (2, 3))
        """
        size_px = min(max(_MEASURED_PX, _MEASURED_WINDOWS * WINDOW * side), _LARGEST_PX)
        rows, columns = (min(size_px, size) // side * side or min(size_px, size) for size in pixels)
        count = max(1, min(_MEASURED_BLOCKS, min(_MOST_PX, 2 * pixels[0] * pixels[1]) // (rows * columns)))
        corners = np.random.default_rng(0).uniform(size=(count, 2)) * (pixels[0] - rows, pixels[1] - columns)
        starts = sorted({(int(row) // side * side, int(column) // side * side) for row, column in corners})
        blocks = [image((slice(row, row + rows), slice(column, column + columns))) for row, column in starts]
        looks = within = found = float("nan")
        try:
            speckle = Speckle.of(block[:_MEASURED_PX, :_MEASURED_PX] for block in blocks)
        except ValueError:
            return cls(image, pixels, side, noise, False, looks, within, found)
        looks, within = speckle.looks(side), speckle.looks(WINDOW * side)
        found = found_looks([block_means(np.abs(block) ** 2, side) for block in blocks], within)
        return cls(image, pixels, side, noise, filtered, looks, within, found)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of squares; squares of the last row and column may extend beyond the image."""
        rows, columns = (-(-size // self.side) for size in self.pixels)
        return rows, columns

    def mean(self, window: Window) -> Floats:
        """Return the mean power in a window of squares, (row, column) float64; NaN if most pixels are invalid."""
        margin = WINDOW // 2 if self.filtered else 0
        rows, columns = (
            slice(max(0, part.start - margin), min(size, part.stop + margin))
            for part, size in zip(window, self.shape, strict=True)
        )
        power, noise = self._parts((rows, columns))
        if self.filtered:
            power = lee(power, looks=self.looks, within=self.within)
        inner = tuple(
            slice(at.start - by.start, at.stop - by.start) for at, by in zip(window, (rows, columns), strict=True)
        )
        return np.asarray((power - noise)[inner])

    def mean_noise(self, window: Window) -> Floats:
        """Return the mean noise power in a window of squares, (row, column) float64; NaN as for `mean`."""
        return np.asarray(self._parts(window)[1])

    def _parts(self, window: Window) -> Floats:
        """Return power and noise in a window of squares; the image is read in parts of at most a tile or a square."""
        step, (rows, columns) = max(1, BLOCK_PX // self.side), window
        values = np.zeros((2, rows.stop - rows.start, columns.stop - columns.start))
        for row in range(rows.start, rows.stop, step):
            for column in range(columns.start, columns.stop, step):
                part = (slice(row, min(row + step, rows.stop)), slice(column, min(column + step, columns.stop)))
                read = tuple(
                    slice(at.start * self.side, min(at.stop * self.side, size))
                    for at, size in zip(part, self.pixels, strict=True)
                )
                target = tuple(
                    slice(at.start - by.start, at.stop - by.start) for at, by in zip(part, window, strict=True)
                )
                pixels = self.image((read[0], read[1]))
                values[0][target] = block_means(np.abs(pixels).astype(np.float64) ** 2, self.side)
                if self.noise is not None:
                    noise = np.where(np.isfinite(pixels), self.noise((read[0], read[1])), np.nan)
                    values[1][target] = block_means(noise, self.side)
        return values
