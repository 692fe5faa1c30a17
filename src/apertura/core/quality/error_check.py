"""Certificate of the numerical error: pixels recomputed exactly, upper bound at 95 % confidence, and failing tiles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.quality.measures import BlockRaster

# ---- Error bound from drawn pixels

# confidence of the error bound, which was valid in at least 98.5 % of images (benchmarks/certificate.py)
CONFIDENCE = 0.95

_SIGMAS = 2.0  # instead of 1.645, the 95 % quantile of a Gaussian: sums of skewed errors have longer tails


@dataclass(frozen=True)
class ErrorBound:
    """RMS difference of all pixels of an image from the exact sum, relative to the RMS of the image.

    Attributes
    ----------
    bound_db
        Upper bound with a confidence of 95 %, dB.
    estimate_db
        Unbiased estimate, dB.
    """

    bound_db: float
    estimate_db: float

    def with_error(self, error_db: float | None) -> "ErrorBound":
        """Return the bound combined with an independent error, dB; None: no additional error.

        Examples
        --------
        >>> round(ErrorBound(-60.0, -63.0).with_error(-60.0).bound_db, 2)
        -56.99
        """
        if error_db is None:
            return self
        powers = 10 ** (np.array([self.bound_db, self.estimate_db]) / 10) + 10 ** (error_db / 10)
        bound_db, estimate_db = (10 * np.log10(powers)).tolist()
        return ErrorBound(bound_db, estimate_db)


def error_bound(
    computed: NDArray[np.complexfloating],
    exact: NDArray[np.complexfloating],
    density: NDArray[np.float64],
    *,
    power: float | NDArray[np.float64],
) -> ErrorBound:
    """Estimate the error of a whole image from random pixels, after correction by a common complex gain.

    Parameters
    ----------
    computed, exact
        (draw,) complex, values at the drawn pixels; a pixel drawn twice is listed twice.
    density
        (draw,) float64, expected number of draws of each drawn pixel.
    power
        Σ|I|² over all pixels of the image; or (draw,) float64, mean |I|² around each drawn pixel.

    Notes
    -----
    Source: docs/theory.md, eq. 6a.

    Examples
    --------
    >>> noise = 1e-3 * np.exp(2j * np.pi * np.random.default_rng(1).random(256))
    >>> bound = error_bound(np.ones(256), 1 + noise, np.full(256, 0.01), power=25600.0)
    >>> round(bound.estimate_db, 1), 0 < bound.bound_db - bound.estimate_db < 0.2
    (-60.0, True)
    """
    values = computed.astype(np.complex128)
    # G of eq. 6a by weighted least squares over the draws; z_k, and Σ|G·I|² as `total`.
    weighed = (np.abs(values) ** 2 / density).sum()
    gain = complex((values.conj() * exact / density).sum() / weighed) if weighed else 0j
    difference = np.abs(gain * values - exact) ** 2
    errors, levels = difference / density, np.zeros(len(values))
    if isinstance(power, float):
        total = power * abs(gain) ** 2
    else:
        levels = power / density * abs(gain) ** 2
        total = float(levels.sum())
    largest = float(levels.max())
    error = float(errors.sum())
    if not error or total <= largest:
        limit_db = _db(0.0 if not error else np.inf)
        return ErrorBound(limit_db, limit_db)
    deviation = np.sqrt(errors.size) * float((errors - error / total * levels).std())  # √K·s
    # Upper bound of q at 95 %: an error as large as the largest one may not have been drawn, and the brightest pixel
    # may have been drawn by chance.
    above = (error + float(errors.max())) / (total - largest) * np.exp(_SIGMAS * deviation / error)
    return ErrorBound(_db(above), _db(error / total))


def _db(power: float) -> float:
    """Return the power ratio error / (image + error) in dB, at most 0 dB and at least -313 dB."""
    least = np.finfo(np.float64).eps ** 2
    return float(10 * np.log10(max(power / (1 + power) if np.isfinite(power) else 1.0, least)))


# ---- Drawn pixels and the certificate

_BLOCK_PX = 256


def random_pixels(windows: Sequence[Window], count: int, generator: np.random.Generator) -> NDArray[np.int64]:
    """Draw random pixels uniformly over the tiles, (count, 2) int64 rows and columns.

    Parameters
    ----------
    windows
        All tiles. One pixel is drawn from each tile in turn, in random order, until `count` pixels are drawn.
    count
        Number of pixels.
    generator
        Random generator.

    Examples
    --------
    >>> random_pixels([(slice(0, 1), slice(0, 1)), (slice(0, 1), slice(1, 2))], 2, np.random.default_rng(0)).sum(0)
    array([0, 1])
    """
    order = generator.permutation(len(windows))
    drawn = []
    for number in range(count):
        window = windows[order[number % len(windows)]]
        drawn.append([generator.integers(part.start, part.stop) for part in window])
    return np.array(drawn, np.int64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Brightness:
    """Power of an image by tile: the distribution from which bright pixels are drawn.

    Attributes
    ----------
    power, level
        (tile,) float64, Σ|I|² and Σ|I| over the pixels of each tile.
    pixels
        Number of pixels of the whole image.
    """

    power: NDArray[np.float64]
    level: NDArray[np.float64]
    pixels: int

    @classmethod
    def of(cls, image: BlockRaster, windows: Sequence[Window]) -> "Brightness":
        """Return the brightness of a (y, x) complex image, tile by tile; NaN counts as zero."""
        sums = []
        for window in windows:
            level = _level(image[window])
            sums.append((float((level**2).sum()), float(level.sum())))
        power, level = np.array(sums).T
        return cls(power, level, int(np.prod(image.shape)))

    @property
    def mean_power(self) -> float:
        """Mean of |I|² over the image."""
        return float(self.power.sum()) / self.pixels

    def density(
        self, pixels: NDArray[np.int64], values: NDArray[np.complexfloating], windows: Sequence[Window], *, random: int
    ) -> NDArray[np.float64]:
        """Return the expected number of draws of each pixel by `random_pixels` and `draw` together, (pixel,) float64.

        `pixels`: (pixel, 2) int64, drawn pixels, of which the first `random` pixels are drawn by `random_pixels`.
        `values`: the image at these pixels.
        """
        density = np.zeros(len(pixels))
        for window in windows:
            height, width = (part.stop - part.start for part in window)
            density[_inside(pixels, window)] = random / (len(windows) * height * width)
        return density + (len(pixels) - random) * self._draw_probability(_level(values))

    def _draw_probability(self, level: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the probability that a draw selects a pixel with amplitude |I|: half by power, half by amplitude."""
        if not self.power.any():
            return np.zeros_like(level)
        return np.asarray((level**2 / self.power.sum() + level / self.level.sum()) / 2)

    def draw(
        self, image: BlockRaster, windows: Sequence[Window], count: int, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Draw pixels with probabilities that increase with brightness, (count, 2) int64; none if the image is zero."""
        if not (count and self.power.any()):
            return np.empty((0, 2), np.int64)
        edges = np.cumsum((self.power / self.power.sum() + self.level / self.level.sum()) / 2)
        teeth = (np.arange(count) + generator.random()) / count * edges[-1]
        drawn = []
        for number in np.unique(tiles := np.minimum(np.searchsorted(edges, teeth), len(edges) - 1)):
            window = windows[number]
            level = _level(image[window])
            within = np.cumsum(self._draw_probability(level))
            offset = teeth[tiles == number] - (edges[number - 1] if number else 0.0)
            flat = np.minimum(np.searchsorted(within, offset), level.size - 1)
            first = [part.start for part in window]
            drawn.append(np.stack(np.unravel_index(flat, level.shape), -1) + first)
        return np.concatenate(drawn)


def _level(block: NDArray[np.complexfloating]) -> NDArray[np.float64]:
    return np.nan_to_num(np.abs(np.asarray(block)).astype(np.float64))


@dataclass(frozen=True, eq=False)
class Certificate:
    """Exact values at the pixels drawn by `random_pixels`, which do not depend on the values of the image.

    Attributes
    ----------
    windows
        All tiles.
    pixels
        (pixel, 2) int64 rows and columns.
    exact
        (pixel,) complex128, values of the exact sum.
    """

    windows: Sequence[Window]
    pixels: NDArray[np.int64]
    exact: NDArray[np.complex128]

    def failing(self, image: BlockRaster, accuracy_db: float, *, power: float) -> tuple[list[Window], list[Window]]:
        """Return (tiles without a drawn pixel, tiles that do not meet the accuracy); both are empty if all tiles pass.

        A tile fails if the mean squared difference at its pixels exceeds the accuracy times the larger of `power`, the
        mean |I|² of the image, and the mean exact |I|² at these pixels: errors are proportional to the amplitude of
        bright targets. The drawn pixels do not depend on the image. If a run is killed while it recomputes tiles, the
        resumed run therefore selects the same tiles, provided that the failing tiles are recomputed last.
        """
        squared, exact_power = np.abs(values_at(image, self.pixels) - self.exact) ** 2, np.abs(self.exact) ** 2
        tolerated = 10 ** (accuracy_db / 10)
        empty, worse = [], []
        for window in self.windows:
            inside = _inside(self.pixels, window)
            if not inside.any():
                empty.append(window)
            elif not squared[inside].mean() <= tolerated * max(power, float(exact_power[inside].mean())):
                worse.append(window)
        return (empty if worse else []), worse

    def error(
        self, image: BlockRaster, brightness: Brightness, bright: NDArray[np.int64], exact: NDArray[np.complex128]
    ) -> ErrorBound:
        """Estimate the error of the whole image from its random pixels and `bright` pixels drawn by `brightness`.

        `bright`: (pixel, 2) int64, rows and columns. `exact`: (pixel,) complex128, the exact sum at these pixels.
        """
        pixels = np.concatenate([self.pixels, bright])
        values = values_at(image, pixels)
        density = brightness.density(pixels, values, self.windows, random=len(self.pixels))
        sums = np.concatenate([self.exact, exact])
        return error_bound(values, sums, density, power=float(brightness.power.sum()))


def _inside(pixels: NDArray[np.int64], window: Window) -> NDArray[np.bool_]:
    first, last = np.array([[part.start, part.stop] for part in window]).T
    return np.asarray(((pixels >= first) & (pixels < last)).all(axis=1))


def values_at(image: BlockRaster, pixels: NDArray[np.int64]) -> NDArray[np.complex64]:
    """Return the values of an image at (pixel, 2) rows and columns, 0 where NaN; each block is read once."""
    values, blocks = np.empty(len(pixels), np.complex64), pixels // _BLOCK_PX
    for block in np.unique(blocks, axis=0):
        inside, first = (blocks == block).all(axis=1), block * _BLOCK_PX
        rows, columns = (slice(int(at), int(at) + _BLOCK_PX) for at in first)
        values[inside] = np.nan_to_num(np.asarray(image[rows, columns]))[tuple((pixels[inside] - first).T)]
    return values
