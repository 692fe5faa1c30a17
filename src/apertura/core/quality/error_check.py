"""Which pixels of an image are recomputed exactly, what they say of its error, and which tiles fail by them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.quality.error_bound import ErrorBound, error_bound
from apertura.core.quality.measures import Raster

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
    """Where the power of an image lies: what pixels are drawn by, and what their errors are compared with.

    Attributes
    ----------
    power, level
        (tile,) float64, Σ|I|² and Σ|I| over the pixels of each.
    peak
        Largest |I|.
    pixels
        Of the whole image.
    """

    power: NDArray[np.float64]
    level: NDArray[np.float64]
    peak: float
    pixels: int

    @classmethod
    def of(cls, image: Raster, windows: Sequence[Window]) -> "Brightness":
        """Return that of a (y, x) complex image, tile by tile; NaN counts as dark."""
        sums = []
        for window in windows:
            level = _level(image[window])
            sums.append((float((level**2).sum()), float(level.sum()), float(level.max())))
        power, level, peak = np.array(sums).T
        return cls(power, level, float(peak.max()), int(np.prod(image.shape)))

    @property
    def mean_power(self) -> float:
        """Mean of |I|² over the image."""
        return float(self.power.sum()) / self.pixels

    def density(
        self, pixels: NDArray[np.int64], values: NDArray[np.complexfloating], windows: Sequence[Window], *, random: int
    ) -> NDArray[np.float64]:
        """Return how often `random_pixels` and `draw` together take each of some pixels on average, (pixel,) float64.

        `pixels` holds the (pixel, 2) int64 that both drew, the first `random` of them the former's; `values` the image
        there.
        """
        density = np.zeros(len(pixels))
        for window in windows:
            height, width = (part.stop - part.start for part in window)
            density[_inside(pixels, window)] = random / (len(windows) * height * width)
        return density + (len(pixels) - random) * self._chance(_level(values))

    def _chance(self, level: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the chance of one draw to take pixels of that |I|: half by their power, half by |I|."""
        if not self.power.any():
            return np.zeros_like(level)
        return np.asarray((level**2 / self.power.sum() + level / self.level.sum()) / 2)

    def draw(
        self, image: Raster, windows: Sequence[Window], count: int, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Return pixels drawn by their brightness, (count, 2) int64; none of an image that is dark everywhere."""
        if not (count and self.power.any()):
            return np.empty((0, 2), np.int64)
        edges = np.cumsum((self.power / self.power.sum() + self.level / self.level.sum()) / 2)
        teeth = (np.arange(count) + generator.random()) / count * edges[-1]
        drawn = []
        for number in np.unique(tiles := np.minimum(np.searchsorted(edges, teeth), len(edges) - 1)):
            window = windows[number]
            level = _level(image[window])
            within = np.cumsum(self._chance(level))
            offset = teeth[tiles == number] - (edges[number - 1] if number else 0.0)
            flat = np.minimum(np.searchsorted(within, offset), level.size - 1)
            first = [part.start for part in window]
            drawn.append(np.stack(np.unravel_index(flat, level.shape), -1) + first)
        return np.concatenate(drawn)


def _level(block: NDArray[np.complexfloating]) -> NDArray[np.float64]:
    return np.nan_to_num(np.abs(np.asarray(block)).astype(np.float64))


@dataclass(frozen=True, eq=False)
class Certificate:
    """Exact values of the pixels that `random_pixels` drew, whatever the image holds.

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

    def failing(self, image: Raster, accuracy_db: float, *, power: float) -> tuple[list[Window], list[Window]]:
        """Return (tiles without a drawn pixel, tiles worse than asked); both empty when all tiles pass.

        A tile is worse when the mean squared difference at its pixels exceeds the accuracy times `power`, the mean
        |I|² of the image. Which pixels are looked at does not depend on the image, so a run that was killed while it
        redid tiles makes the same choice again, provided the failing tiles are redone last.
        """
        squared = np.abs(values_at(image, self.pixels) - self.exact) ** 2
        budget = 10 ** (accuracy_db / 10) * power
        empty, worse = [], []
        for window in self.windows:
            inside = _inside(self.pixels, window)
            if not inside.any():
                empty.append(window)
            elif not squared[inside].mean() <= budget:
                worse.append(window)
        return (empty if worse else []), worse

    def error(
        self, image: Raster, brightness: Brightness, bright: NDArray[np.int64], exact: NDArray[np.complex128]
    ) -> ErrorBound:
        """Return the error of the whole image, from its random pixels and `bright` ones drawn by `brightness`.

        `bright` holds (pixel, 2) int64 rows and columns, `exact` (pixel,) complex128 what the reference gives there.
        """
        pixels = np.concatenate([self.pixels, bright])
        values = values_at(image, pixels)
        density = brightness.density(pixels, values, self.windows, random=len(self.pixels))
        sums = np.concatenate([self.exact, exact])
        return error_bound(values, sums, density, power=float(brightness.power.sum()), peak=brightness.peak)


def _inside(pixels: NDArray[np.int64], window: Window) -> NDArray[np.bool_]:
    first, last = np.array([[part.start, part.stop] for part in window]).T
    return np.asarray(((pixels >= first) & (pixels < last)).all(axis=1))


def values_at(image: Raster, pixels: NDArray[np.int64]) -> NDArray[np.complex64]:
    """Return an image at (pixel, 2) rows and columns, 0 where no pulse made it; each block of it is read once."""
    values, blocks = np.empty(len(pixels), np.complex64), pixels // _BLOCK_PX
    for block in np.unique(blocks, axis=0):
        inside, first = (blocks == block).all(axis=1), block * _BLOCK_PX
        rows, columns = (slice(int(at), int(at) + _BLOCK_PX) for at in first)
        values[inside] = np.nan_to_num(np.asarray(image[rows, columns]))[tuple((pixels[inside] - first).T)]
    return values
