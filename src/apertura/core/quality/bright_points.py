"""Isolated bright points of an image: where focus, place and phase can be measured without truth."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.quality.measures import BlockRaster
from apertura.core.quality.point_targets import PATCH_PX, find_peak

MOST_POINTS = 16  # of an image that are measured, at most
DEEPEST_DB = -12.0
"""dB below the brightest point: weaker points may be its sidelobes."""


_POINT_CONTRAST = 10.0  # power of a point relative to the speckle around it: 10 dB


@dataclass(frozen=True)
class BrightPoint:
    """A local maximum of an image.

    Attributes
    ----------
    row, column
        Fractional pixel.
    amplitude
        Magnitude there.
    background
        Power of its surroundings relative to its own: mean of speckle, from the median over a patch.
    carrier
        Spatial frequency of its carrier down and right, cycles per pixel; None: as the pixels fold it.
    """

    row: float
    column: float
    amplitude: float
    background: float = 0.0
    carrier: tuple[float, float] | None = None


def bright_points(image: BlockRaster, windows: Iterable[Window], *, apart_px: int) -> list[BrightPoint]:
    """Return the brightest isolated local maxima, brightest first.

    Parameters
    ----------
    image
        (y, x) complex64, carrier kept; NaN is left out.
    windows
        Windows that cover it once.
    apart_px
        Of two maxima closer than this only the brighter one is taken: a few resolution cells.

    Examples
    --------
    >>> y, x = np.mgrid[:64, :128]
    >>> lobe = lambda row, column: np.sinc((y - row) / 4) * np.sinc((x - column) / 4)
    >>> whole = (slice(0, 64), slice(0, 128))
    >>> image = (lobe(30.25, 33.5) + 0.5 * lobe(20, 90)).astype(np.complex64)
    >>> [(round(p.row, 1), round(p.column, 1)) for p in bright_points(image, [whole], apart_px=16)]
    [(30.2, 33.5), (20.0, 90.0)]
    """
    maxima: list[tuple[float, int, int]] = []
    for window in windows:
        magnitude = np.abs(np.nan_to_num(np.asarray(image[window])))
        maxima += _cell_maxima(magnitude, window, apart_px)
    maxima.sort(key=lambda one: (-one[0], one[1], one[2]))
    kept: list[tuple[float, int, int]] = []
    for one in maxima:
        if not one[0] > maxima[0][0] * 10 ** (DEEPEST_DB / 20) or len(kept) == MOST_POINTS:
            break
        if all(np.hypot(one[1] - row, one[2] - column) >= apart_px for _, row, column in kept):
            kept.append(one)
    return [_bright_point(image, row, column) for _, row, column in kept]


def has_point(image: BlockRaster, row: int, column: int, *, reach: int) -> bool:
    """Return whether an image has a pixel 10 dB above its surroundings within `reach` pixels of a place.

    Examples
    --------
    >>> image = np.ones((64, 64), np.complex64)
    >>> image[30, 31] = 5
    >>> has_point(image, 31, 31, reach=2), has_point(image, 20, 31, reach=2)
    (True, False)
    """
    here, about = (
        np.abs(
            np.nan_to_num(np.asarray(image[max(0, row - far) : row + far + 1, max(0, column - far) : column + far + 1]))
        )
        for far in (reach, PATCH_PX // 2)
    )
    return bool(here.size and here.max() ** 2 > _POINT_CONTRAST * np.median(about.astype(np.float64) ** 2) / np.log(2))


def _bright_point(image: BlockRaster, row: int, column: int) -> BrightPoint:
    peak = find_peak(image, row, column)
    about = tuple(slice(max(0, at - PATCH_PX // 2), at + PATCH_PX // 2) for at in (row, column))
    power = np.abs(np.nan_to_num(np.asarray(image[about[0], about[1]]))).astype(np.float64) ** 2
    background = float(np.median(power)) / np.log(2) / abs(peak.value) ** 2
    return BrightPoint(peak.row, peak.column, float(abs(peak.value)), float(background))


def _cell_maxima(magnitude: NDArray[np.float32], window: Window, cell_px: int) -> list[tuple[float, int, int]]:
    """Return (magnitude, row, column) of the largest pixel of each square cell of a block."""
    rows, columns = (-(-size // cell_px) * cell_px for size in magnitude.shape)
    padded = np.zeros((rows, columns), magnitude.dtype)
    padded[: magnitude.shape[0], : magnitude.shape[1]] = magnitude
    cells = padded.reshape(rows // cell_px, cell_px, columns // cell_px, cell_px).swapaxes(1, 2)
    flat = cells.reshape(*cells.shape[:2], -1)
    best = flat.argmax(axis=-1)
    down, right = np.indices(best.shape)
    row = window[0].start + down * cell_px + best // cell_px
    column = window[1].start + right * cell_px + best % cell_px
    top = flat.max(axis=-1)
    return [(float(a), int(r), int(c)) for a, r, c in zip(top.flat, row.flat, column.flat, strict=True) if a > 0]


def common_shift(
    first: Sequence[tuple[float, float, float]],
    second: Sequence[tuple[float, float, float]],
    *,
    reach: float,
    gate: float,
) -> tuple[tuple[float, float], list[tuple[int, int]]]:
    """Return the common shift between two lists of points, weighted by brightness, and the pairs that match under it.

    Parameters
    ----------
    first, second
        (x, y, amplitude) of points in two images of one scene.
    reach
        Largest shift considered, in the unit of x and y.
    gate
        Two differences closer than this count as one shift.

    Returns
    -------
    tuple
        (Δx, Δy), second less first, and pairs of indices of the points that match under it. Without any within reach,
        zero and no pairs.

    Examples
    --------
    >>> here = [(0, 0, 1.0), (5, 1, 0.8), (2, 7, 0.5)]
    >>> there = [(x + 0.3, y - 0.1, a) for x, y, a in here]
    >>> shift, matched = common_shift(here, there, reach=4, gate=0.2)
    >>> np.round(shift, 3).tolist(), matched
    ([0.3, -0.1], [(0, 0), (1, 1), (2, 2)])
    """
    a, b = (np.array(points, np.float64).reshape(-1, 3) for points in (first, second))
    difference = b[None, :, :2] - a[:, None, :2]
    weight = np.minimum(a[:, None, 2] / a[:, 2].max(initial=1e-30), b[None, :, 2] / b[:, 2].max(initial=1e-30))
    weight = np.where(np.hypot(difference[..., 0], difference[..., 1]) <= reach, weight, 0.0)
    best, votes = np.zeros(2), 0.0
    for i, j in zip(*np.nonzero(weight), strict=True):
        near = np.hypot(*np.moveaxis(difference - difference[i, j], -1, 0)) <= gate
        total = float((weight * near).max(axis=1).sum())
        total -= 1e-3 * float(np.hypot(*difference[i, j]) / reach)  # of equal shifts the smaller
        if total > votes:
            best, votes = difference[i, j], total
    matched = _matched(difference - best, weight, gate)
    if matched:
        best = np.median([difference[i, j] for i, j in matched], axis=0)
    return (float(best[0]), float(best[1])), matched


def _matched(difference: NDArray[np.float64], weight: NDArray[np.float64], gate: float) -> list[tuple[int, int]]:
    """Return pairs of points that lie within the gate, each point at most once, nearest first."""
    distance = np.where(weight > 0, np.hypot(difference[..., 0], difference[..., 1]), np.inf)
    matched: list[tuple[int, int]] = []
    for flat in np.argsort(distance, axis=None):
        i, j = (int(at) for at in np.unravel_index(flat, distance.shape))
        if distance[i, j] > gate:
            break
        if all(i != one and j != other for one, other in matched):
            matched.append((i, j))
    return sorted(matched)
