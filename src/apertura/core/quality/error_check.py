"""Numerical error of an image: pixels recomputed exactly, an upper bound at 95 % confidence, tiles that fail."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.quality.measures import BlockRaster

# ---- Error bound from drawn pixels

CONFIDENCE = 0.95  # of the error bound: it held in 98.5 % of images or more (benchmarks/certificate.py)

_SIGMAS = 2.0  # 1.645 would leave out 5 % of a Gaussian; sums of skewed errors reach further


@dataclass(frozen=True)
class ErrorBound:
    """RMS difference of an image from the exact sum over all its pixels, relative to the RMS of the image.

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
        """Return the bound with another error that is independent of this one, dB; None: there is none.

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
    """Return the error of a whole image from pixels drawn at random, after one complex gain.

    Parameters
    ----------
    computed, exact
        (draw,) complex, the drawn pixels; a pixel drawn twice is listed twice.
    density
        (draw,) float64, how often a draw like this takes that pixel on average.
    power
        Σ|I|² over all pixels of the image; or (draw,) float64, |I|² around each draw.

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
        nothing = _db(0.0 if not error else np.inf)
        return ErrorBound(nothing, nothing)
    deviation = np.sqrt(errors.size) * float((errors - error / total * levels).std())  # √K·s
    # q at 95 %: the draws may have missed an error as large as the largest, and hit the brightest pixel by chance.
    above = (error + float(errors.max())) / (total - largest) * np.exp(_SIGMAS * deviation / error)
    return ErrorBound(_db(above), _db(error / total))


def _db(power: float) -> float:
    """Return a ratio of powers that cannot exceed 1, as the difference is a part of the exact sum; 0 is -313 dB."""
    least = np.finfo(np.float64).eps ** 2
    return float(10 * np.log10(max(power / (1 + power) if np.isfinite(power) else 1.0, least)))


# ---- Drawn pixels and the certificate

_BLOCK_PX = 256


def random_pixels(windows: Sequence[Window], count: int, generator: np.random.Generator) -> NDArray[np.int64]:
    """Return random pixels spread evenly over the tiles, (count, 2) int64 rows and columns.

    Parameters
    ----------
    windows
        Every tile; one after the other gets a pixel until `count` are spent, in an order that is drawn.
    count
        Pixels.
    generator
        Draws the pixels and, where tiles outnumber them, the tiles.

    Examples
    --------
    >>> random_pixels([(slice(0, 1), slice(0, 1)), (slice(0, 1), slice(1, 2))], 2, np.random.default_rng(0)).sum(0)
    array([0, 1])
    """
    order = generator.permutation(len(windows))
    drawn = []
    for turn in range(count):
        window = windows[order[turn % len(windows)]]
        drawn.append([generator.integers(part.start, part.stop) for part in window])
    return np.array(drawn, np.int64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Brightness:
    """Power of an image by tile: the distribution that bright pixels are drawn from.

    Attributes
    ----------
    power, level
        (tile,) float64, Σ|I|² and Σ|I| over the pixels of each.
    pixels
        Of the whole image.
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
        """Return the mean number of draws of each of some pixels by `random_pixels` and `draw`, (pixel,) float64.

        `pixels` are the (pixel, 2) int64 of both draws, those of `random_pixels` (`random` of them) first; `values` the
        image there.
        """
        density = np.zeros(len(pixels))
        for window in windows:
            height, width = (part.stop - part.start for part in window)
            density[_inside(pixels, window)] = random / (len(windows) * height * width)
        return density + (len(pixels) - random) * self._draw_probability(_level(values))

    def _draw_probability(self, level: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the probability that one draw takes pixels of that |I|: half by their power, half by |I|."""
        if not self.power.any():
            return np.zeros_like(level)
        return np.asarray((level**2 / self.power.sum() + level / self.level.sum()) / 2)

    def draw(
        self, image: BlockRaster, windows: Sequence[Window], count: int, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Return pixels drawn by their brightness, (count, 2) int64; none of an image that is zero everywhere."""
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
    """Exact values of the pixels that `random_pixels` drew, whatever the values of the image.

    Attributes
    ----------
    windows
        Every tile.
    pixels
        (pixel, 2) int64 rows and columns.
    exact
        (pixel,) complex128 from `reference`.
    """

    windows: Sequence[Window]
    pixels: NDArray[np.int64]
    exact: NDArray[np.complex128]

    def failing(self, image: BlockRaster, accuracy_db: float, *, power: float) -> tuple[list[Window], list[Window]]:
        """Return (tiles without a drawn pixel, tiles worse than requested); both empty when all tiles pass.

        A tile is worse when the mean squared difference at its pixels exceeds the accuracy times the larger of `power`,
        the mean |I|² of the image, and of what is there: a pixel on a bright target may err by more than a dark one.
        The pixels do not depend on the image, so a run that was killed while it redid tiles makes the same choice
        again, provided the failing tiles are recomputed last.
        """
        squared, there = np.abs(values_at(image, self.pixels) - self.exact) ** 2, np.abs(self.exact) ** 2
        tolerated = 10 ** (accuracy_db / 10)
        empty, worse = [], []
        for window in self.windows:
            inside = _inside(self.pixels, window)
            if not inside.any():
                empty.append(window)
            elif not squared[inside].mean() <= tolerated * max(power, float(there[inside].mean())):
                worse.append(window)
        return (empty if worse else []), worse

    def error(
        self, image: BlockRaster, brightness: Brightness, bright: NDArray[np.int64], exact: NDArray[np.complex128]
    ) -> ErrorBound:
        """Return the error of the whole image, from its random pixels and `bright` ones drawn by `brightness`.

        `bright` are (pixel, 2) int64 rows and columns, `exact` (pixel,) complex128 the reference's values there.
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
    """Return an image at (pixel, 2) rows and columns, 0 where no pulse illuminates it; each block is read once."""
    values, blocks = np.empty(len(pixels), np.complex64), pixels // _BLOCK_PX
    for block in np.unique(blocks, axis=0):
        inside, first = (blocks == block).all(axis=1), block * _BLOCK_PX
        rows, columns = (slice(int(at), int(at) + _BLOCK_PX) for at in first)
        values[inside] = np.nan_to_num(np.asarray(image[rows, columns]))[tuple((pixels[inside] - first).T)]
    return values
