"""Speckle of an image: mean power of squares of pixels, the looks that it has by correlation and as found, a filter."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.contracts import Window
from apertura.core.scene.map_crs import BLOCK_PX

LAGS_PX = 32
"""Lags of the correlation of speckle, either way: a cell is 2 to 4 pixels wide, its correlation gone by ten cells."""

_MEASURED_PX = 128  # side of the blocks that the correlation is measured in: all lags then have many pairs
_MEASURED_WINDOWS = 3  # of local looks along a block, at least
_LARGEST_PX = 4096  # along a block; of wider windows no looks are found
_MEASURED_BLOCKS, _MOST_PX = 64, 1 << 24  # that looks are measured in, and pixels of all of them, about
WINDOW = 7
"""Side of the window of the filter and of local looks, cells of the multilooked raster; Lee's own (1980)."""

_PARTS = 4  # of a block, either way, that tell how the direction of view turns across it
_MOST_CHANCE = 0.5  # |ρ|² at far lags: of a block of two cells, or of an image that does not vary
_FEWEST_PX = 10  # along a block: of less all lags are about zero
_STEP, _SCATTER = 0.02, 0.2  # of ln(looks): of its histogram, and of what 49 cells tell, which smooths it


def block_means(values: Floats, side: int) -> Floats:
    """Return the means of square blocks of pixels.

    Parameters
    ----------
    values
        (row, column) real; NaN is left out.
    side
        Of a block, pixels. Blocks that hang over the edge are means of what they hold.

    Returns
    -------
    ndarray
        (block row, block column) float64, NaN where less than half of a block is known.

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
    """Speckle of an image as its pixels are correlated.

    Attributes
    ----------
    correlation
        (2·lags + 1, 2·lags + 1) float64, |ρ|² over lags of rows and columns, at most `LAGS_PX` either way: that of the
        complex pixels, which of developed speckle is the correlation of their powers.

    Notes
    -----
    Source: docs/theory/speckle.md, eqs. 1 to 3.
    """

    correlation: Floats

    @classmethod
    def of(cls, blocks: Iterable[NDArray[np.complex64]]) -> "Speckle":
        """Return the speckle of an image, the median of what blocks of it show.

        Parameters
        ----------
        blocks
            (row, column) complex64 each, of one shape; those of which less than half is known (not NaN), or without
            power, are left out.

        Raises
        ------
        ValueError
            If no block is left, they are too small, or the correlation has no end in them.

        Examples
        --------
        >>> generator = np.random.default_rng(0)
        >>> white = [generator.standard_normal((64, 64, 2)) @ [1, 1j] for _ in range(20)]
        >>> round(Speckle.of(white).looks(5), 1)
        25.0
        """
        large = (one for one in blocks if min(one.shape) >= _FEWEST_PX)
        some = (one for one in large if 2 * np.isfinite(one).sum() >= one.size and np.nansum(np.abs(one)))
        found = [_squared_correlation(one) for one in some]
        if not found:
            raise ValueError("no block of the image holds enough pixels")
        middle = np.median(found, axis=0)
        corner = slice(0, len(middle) // 4)
        floor = np.median(middle[corner, corner])  # chance: of so few pixels no correlation is nothing
        if floor > _MOST_CHANCE:
            raise ValueError(f"pixels of the image are correlated by {floor:.2f} wherever they lie")
        return cls(np.maximum(middle - floor, 0.0) / (1 - floor))

    @property
    def area_px(self) -> float:
        """Pixels that vary as one, ∫|ρ|²."""
        return float(self.correlation.sum())

    def looks(self, side: int) -> float:
        """Return the equivalent number of looks of the mean power of a square of pixels.

        Parameters
        ----------
        side
            Of the square, pixels.
        """
        most = len(self.correlation) // 2
        share = np.maximum(side - np.abs(np.arange(-most, most + 1)), 0) / side**2
        return float(1 / (share @ self.correlation @ share))


def _flattened(block: NDArray[Any], parts: int) -> NDArray[Any]:
    """Return a block without the quadratic phase that fits how fast its phase turns in parts × parts of it."""
    places = [np.arange(size) - (size - 1) / 2 for size in block.shape]
    rows, columns = np.meshgrid(*places, indexing="ij")
    equations, turns, weights = list[list[float]](), list[float](), list[float]()
    for row in np.array_split(np.arange(block.shape[0]), parts):
        for column in np.array_split(np.arange(block.shape[1]), parts):
            part = block[row[0] : row[-1] + 1, column[0] : column[-1] + 1]
            r, c = (float(at[some].mean()) for at, some in zip(places, (row, column), strict=True))
            steps = (part[1:] * part[:-1].conj()).sum(), (part[:, 1:] * part[:, :-1].conj()).sum()
            equations += [[1.0, 0.0, r, 0.0, c], [0.0, 1.0, 0.0, c, r]]
            turns += [float(np.angle(one)) for one in steps]
            weights += [float(np.sqrt(np.abs(one))) for one in steps]
    sized = np.array(weights)
    down, across, d, e, f = np.linalg.lstsq(np.array(equations) * sized[:, None], np.array(turns) * sized)[0]
    phase = (down + d * rows / 2 + f * columns) * rows + (across + e * columns / 2) * columns
    return np.asarray(block * np.exp(-1j * phase))


def _squared_correlation(block: NDArray[np.complex64]) -> Floats:
    """Return |ρ|² of a block, each lag over the pairs that it has."""
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
    """Return the mean of the window about each cell, and variance over squared mean (eq. 4); NaN is left out."""
    from scipy.ndimage import correlate1d

    def summed(values: Floats) -> Floats:  # no running sum: a bright point would leave its rounding in all that follow
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
    """Return the equivalent number of looks that homogeneous ground has: the commonest of local ones.

    Parameters
    ----------
    rasters
        (row, column) float64, mean power of cells, of several places.
    within
        Looks of the mean over a whole window, `Speckle.looks`.

    Returns
    -------
    float
        NaN where no place holds a whole window.

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
    for one in rasters:
        if min(one.shape) >= WINDOW:
            mean, spread = _local(one, within)
            values = np.append(values, -np.log(spread[inner, inner][mean[inner, inner] > 0]))
    if not values.size:
        return float("nan")
    places = np.arange(values.min(), values.max() + _STEP, _STEP)
    counts, _ = np.histogram(values, np.append(places - _STEP / 2, places[-1] + _STEP / 2))
    reach = np.arange(-3 * _SCATTER, 3 * _SCATTER + _STEP / 2, _STEP)
    smooth = np.convolve(counts, np.exp(-0.5 * (reach / _SCATTER) ** 2))[len(reach) // 2 :][: len(places)]
    return float(np.exp(places[smooth.argmax()]))


def lee(power: Floats, *, looks: float, within: float) -> Floats:
    """Return mean power with less speckle: the linear estimate of least square error, by local mean and variance.

    Parameters
    ----------
    power
        (row, column) float64, mean power of cells, with its noise; NaN is left out and stays.
    looks
        Equivalent number of looks of a cell.
    within
        That of the mean over a whole window, `Speckle.looks`.

    Returns
    -------
    ndarray
        (row, column) float64.

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
    """Mean power of squares of an image's pixels, window by window.

    Attributes
    ----------
    image
        Window of pixels → (row, column) complex64, NaN where nothing is known.
    pixels
        Rows and columns of them.
    side
        Of a square, pixels.
    noise
        Window of pixels → (row, column) float64, mean power of the noise in them, which is taken off; None: none is.
    filtered
        Whether speckle is filtered, before noise is taken off; false where looks are not known.
    looks, within, found
        Equivalent number of looks of a square, of the filter's window, both by the correlation of speckle, and of a
        square of homogeneous ground as found. NaN: too little of the image is known.
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
        """Return the mean power of an image, with its looks measured in blocks at random places.

        Parameters
        ----------
        image, pixels, side, noise, filtered
            As of `Multilook`.

        Examples
        --------
        >>> white = np.random.default_rng(0).standard_normal((512, 512, 2)) @ [1, 1j]
        >>> some = Multilook.of(lambda window: white[window], white.shape, 4)
        >>> some.shape, round(some.looks), some.mean((slice(0, 2), slice(5, 8))).shape
        ((128, 128), 16, (2, 3))
        """
        wanted = min(max(_MEASURED_PX, _MEASURED_WINDOWS * WINDOW * side), _LARGEST_PX)
        rows, columns = (min(wanted, size) // side * side or min(wanted, size) for size in pixels)
        count = max(1, min(_MEASURED_BLOCKS, min(_MOST_PX, 2 * pixels[0] * pixels[1]) // (rows * columns)))
        corners = np.random.default_rng(0).uniform(size=(count, 2)) * (pixels[0] - rows, pixels[1] - columns)
        starts = sorted({(int(row) // side * side, int(column) // side * side) for row, column in corners})
        blocks = [image((slice(row, row + rows), slice(column, column + columns))) for row, column in starts]
        looks = within = found = float("nan")
        try:
            speckle = Speckle.of(one[:_MEASURED_PX, :_MEASURED_PX] for one in blocks)
        except ValueError:
            return cls(image, pixels, side, noise, False, looks, within, found)
        looks, within = speckle.looks(side), speckle.looks(WINDOW * side)
        found = found_looks([block_means(np.abs(one) ** 2, side) for one in blocks], within)
        return cls(image, pixels, side, noise, filtered, looks, within, found)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of squares; those at the edge may hang over it."""
        rows, columns = (-(-size // self.side) for size in self.pixels)
        return rows, columns

    def mean(self, window: Window) -> Floats:
        """Return the mean power of a window of squares, (row, column) float64; NaN where less than half is known."""
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
        """Return the mean power of the noise of a window of squares, (row, column) float64; NaN as of `mean`."""
        return np.asarray(self._parts(window)[1])

    def _parts(self, window: Window) -> Floats:
        """Return power and noise of a window of squares, read in parts no larger than a tile, or a square."""
        step, (rows, columns) = max(1, BLOCK_PX // self.side), window
        values = np.zeros((2, rows.stop - rows.start, columns.stop - columns.start))
        for row in range(rows.start, rows.stop, step):
            for column in range(columns.start, columns.stop, step):
                part = (slice(row, min(row + step, rows.stop)), slice(column, min(column + step, columns.stop)))
                read = tuple(
                    slice(at.start * self.side, min(at.stop * self.side, size))
                    for at, size in zip(part, self.pixels, strict=True)
                )
                here = tuple(
                    slice(at.start - by.start, at.stop - by.start) for at, by in zip(part, window, strict=True)
                )
                pixels = self.image((read[0], read[1]))
                values[0][here] = block_means(np.abs(pixels).astype(np.float64) ** 2, self.side)
                if self.noise is not None:
                    noise = np.where(np.isfinite(pixels), self.noise((read[0], read[1])), np.nan)
                    values[1][here] = block_means(noise, self.side)
        return values
