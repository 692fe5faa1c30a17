"""The image's own measured error: pixels recomputed by the reference, and the tiles that fail the accuracy asked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.contracts import Window
from apertura.quality.measures import NumericalError, Raster, numerical_error

BRIGHT_PIXELS = 16

_BLOCK_PX = 256


def certified_pixels(
    image: Raster, windows: Sequence[Window], count: int, generator: np.random.Generator
) -> NDArray[np.int64]:
    """Return pixels to recompute: random ones spread evenly over the tiles, then the brightest of the brightest tiles.

    Parameters
    ----------
    image
        (y, x) complex64; only its bright pixels matter here.
    windows
        Every tile.
    count
        Random pixels; tile after tile gets one until they are spent.
    generator
        Draws the pixels and, where tiles outnumber them, the tiles.

    Returns
    -------
    ndarray
        (count + at most 16, 2) int64 rows and columns.

    Examples
    --------
    >>> image = np.zeros((4, 4), np.complex64)
    >>> image[3, 1] = 1
    >>> certified_pixels(image, [(slice(0, 4), slice(0, 4))], 2, np.random.default_rng(0))[-1]
    array([3, 1])
    """
    order = generator.permutation(len(windows))
    drawn = []
    for turn in range(count):
        rows, columns = windows[order[turn % len(windows)]]
        drawn.append([generator.integers(part.start, part.stop) for part in (rows, columns)])
    peaks = [_brightest(image, window) for window in windows]
    bright = sorted(peaks, key=lambda peak: -peak[0])[:BRIGHT_PIXELS]
    return np.array(drawn + [[row, column] for _, row, column in bright], np.int64)


def _brightest(image: Raster, window: Window) -> tuple[float, int, int]:
    magnitude = np.abs(np.nan_to_num(np.asarray(image[window])))
    row, column = np.unravel_index(int(magnitude.argmax()), magnitude.shape)
    return float(magnitude[row, column]), window[0].start + int(row), window[1].start + int(column)


@dataclass(frozen=True)
class Certificate:
    """Exact values of some pixels.

    Attributes
    ----------
    pixels
        (pixel, 2) int64 rows and columns; the last ones are the bright ones.
    exact
        (pixel,) complex128 from `reference`.
    random
        How many of them are random: those that `rms_db` is about.
    """

    pixels: NDArray[np.int64]
    exact: NDArray[np.complex128]
    random: int

    def error(self, image: Raster) -> NumericalError:
        """Return RMS error over the random pixels and largest error over all, relative to the brightest."""
        values = self._values(image)
        some = slice(0, self.random)
        rms = numerical_error(values[some], self.exact[some])
        return replace(rms, peak_db=numerical_error(values, self.exact).peak_db)

    def failing(
        self, image: Raster, windows: Sequence[Window], accuracy_db: float
    ) -> tuple[list[Window], list[Window]]:
        """Return (tiles without a random pixel, tiles worse than asked); both empty when all tiles pass.

        A tile is worse when the mean squared difference at its random pixels exceeds the accuracy times the
        mean power of the reference at all of them. What is asked of a tile does not depend on the other tiles'
        results, so a run that was killed while it redid tiles makes the same choice again, provided the failing
        tiles are redone last.
        """
        some = slice(0, self.random)
        budget = 10 ** (accuracy_db / 10) * (np.abs(self.exact[some]) ** 2).mean()
        squared = np.abs(self._values(image)[some] - self.exact[some]) ** 2
        rows, columns = self.pixels[some].T
        empty, worse = [], []
        for window in windows:
            inside = (rows >= window[0].start) & (rows < window[0].stop)
            inside &= (columns >= window[1].start) & (columns < window[1].stop)
            if not inside.any():
                empty.append(window)
            elif not squared[inside].mean() <= budget:
                worse.append(window)
        return (empty if worse else []), worse

    def _values(self, image: Raster) -> NDArray[np.complex64]:
        """Return the image at the pixels; each block of it is read once."""
        values, blocks = np.empty(len(self.pixels), np.complex64), self.pixels // _BLOCK_PX
        for block in np.unique(blocks, axis=0):
            inside, first = (blocks == block).all(axis=1), block * _BLOCK_PX
            rows, columns = (slice(int(at), int(at) + _BLOCK_PX) for at in first)
            values[inside] = np.asarray(image[rows, columns])[tuple((self.pixels[inside] - first).T)]
        return values
