"""Isolated bright points of an image: where focus, place and phase can be measured without truth."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.geometry.aperture import Aperture, Weigh
from apertura.core.quality.measures import BlockRaster
from apertura.core.quality.point_targets import PATCH_PX, find_peak

SPECKLE = 0.06
"""Power around a bright point relative to its own, above which it may be speckle: the brightest of 10⁶ has 0.07."""

# ---- What of one point an image shows at another place

SMEARED_CELLS = 6.0
"""Cells across the line of sight over which phase errors may spread a point: within, the bound of eq. 1b counts."""

OVER_RESPONSE = 2.0
"""Amplitude of a point over what brighter ones show there: 6 dB, as tapers and phase errors move and raise lobes."""

_RESPONSE_PULSES = 512  # sampled; they follow a phase that turns up to a quarter as often


@dataclass(frozen=True, eq=False)
class PointResponse:
    """The response of an image to a point: how bright one point alone makes the places about it.

    Attributes
    ----------
    aperture
        Phase centres of the pair, every pulse.
    envelope
        (sample,) complex, response of a pulse over a whole period of total path, referred to the band's middle; 1 at
        the sample in the middle, where the path is that of the point.
    step_m
        Total path from sample to sample.
    wavelength_m
        Of the band's middle.
    weigh
        Pulses and points → weights, of antennas or of the sector integrated; by default all count alike.

    Notes
    -----
    Source: docs/theory/focus.md, eq. 1a and 1b.

    Examples
    --------
    Four cells aside are within what phase errors may smear, eight are not; a range cell farther nothing is left:

    >>> track = np.stack([np.linspace(-5, 5, 512), np.full(512, -100.0), np.full(512, 0.0)], -1)
    >>> response = PointResponse(Aperture(track, track), np.sinc(np.arange(-600, 600) / 120), 0.1, 0.26)
    >>> aside, behind = [[5.2, 0, 0], [11.05, 0, 0]], [[0, 3.0, 0], [0, 6.0, 0]]
    >>> response.at(np.zeros(3), np.array(aside)).round(2).tolist()
    [1.0, 0.04]
    >>> response.at(np.zeros(3), np.array(behind)).round(2).tolist()
    [0.64, 0.0]
    """

    aperture: Aperture
    envelope: NDArray[np.complexfloating]
    step_m: float
    wavelength_m: float
    weigh: Weigh | None = None

    def at(self, place_m: NDArray[np.float64], others_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the amplitude that a point shows at other places, relative to its own, at most.

        Parameters
        ----------
        place_m
            (3,) float64, metres, in the frame of the phase centres: the point.
        others_m
            (place, 3) float64, metres.

        Returns
        -------
        ndarray
            (place,) float64, 0 to 1.
        """
        some = self.aperture.sample(_RESPONSE_PULSES)
        weight = np.ones(len(self.aperture[some])) if self.weigh is None else self.weigh(some, place_m[None])[:, 0]
        if not weight.any():
            return np.zeros(len(others_m))
        illuminates, weight = weight > 0, weight[weight > 0, None] / weight.sum()
        flown = self.aperture[some][illuminates]
        # δ_m, and the bound (1b), which needs no phases.
        farther_m = flown.path(others_m) - flown.path(place_m[None])
        range_part = self._of_range(farther_m)
        bound = (weight * np.abs(range_part)).sum(axis=0)
        turns = np.ptp(farther_m, axis=0) / self.wavelength_m
        # (1a); where phase errors may smear the point, within some cells, (1b) counts.
        lobe = np.abs((weight * range_part * np.exp(2j * np.pi / self.wavelength_m * farther_m)).sum(axis=0))
        # where samples do not follow the phase the sum would fold: the envelope of a far sidelobe stands for it
        followed = turns < len(flown) / 4
        lobe = np.where(followed, lobe, bound / np.maximum(np.pi * turns, 1.0))
        return np.asarray(np.where(turns < SMEARED_CELLS, bound, lobe))

    def _of_range(self, farther_m: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the response of a pulse at places whose path is longer than the point's, periodic, linear between."""
        count = len(self.envelope)
        at = farther_m / self.step_m + count // 2
        below = np.floor(at)
        first, second = (self.envelope[(below + step).astype(np.int64) % count] for step in (0, 1))
        return np.asarray(first + (at - below) * (second - first))


def separated(
    amplitude: NDArray[np.floating], shown: Callable[[int, NDArray[np.int64]], NDArray[np.float64]], *, most: int
) -> list[int]:
    """Select the maxima that are points of their own and no sidelobes or skirts of brighter ones.

    Parameters
    ----------
    amplitude
        (maximum,) float, brightest first.
    shown
        A maximum and some others → (other,) float64, what a point at the first shows there: `PointResponse.at`.
    most
        Points to return.

    Returns
    -------
    list of int
        Brightest first. Each exceeds what all brighter ones together show at its place by `OVER_RESPONSE`.

    Notes
    -----
    Source: docs/theory/focus.md, "Bright points".

    Examples
    --------
    >>> at = np.array([0.0, 1.4, 40.0, 50.0])
    >>> separated(np.array([1, 0.22, 0.2, 0.1]), lambda one, others: np.abs(np.sinc(at[others] - at[one])), most=9)
    [0, 2, 3]
    """
    explained, points = np.zeros(len(amplitude)), list[int]()
    for number in range(len(amplitude)):
        if len(points) == most:
            break
        if amplitude[number] > OVER_RESPONSE * explained[number]:
            points.append(number)
            rest = np.arange(number + 1, len(amplitude))
            explained[rest] += amplitude[number] * shown(number, rest)
    return points


_LOBE_CELLS = 2.0
_CELL_UNITS = 1.8  # a resolution cell in units of docs/theory/focus.md, eq. 6, in every direction


def near(
    spectrum: NDArray[np.float64], spacing_m: float, cell_m: float
) -> Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]]:
    """Bound the response of an image to a point, where only the covariance of its spatial spectrum is known.

    Parameters
    ----------
    spectrum
        (2, 2) float64, east and north, cycles² per m².
    spacing_m
        Of the pixels; row 0 in the north.
    cell_m
        Finest resolution cell.

    Returns
    -------
    callable
        As `shown` of `bright_points`: 1 within two resolution cells of their direction, beyond which sidelobes are
        weaker than `DEEPEST_DB`, and within `SMEARED_CELLS` of the finest, which errors smear; 0 beyond.

    Examples
    --------
    >>> shown = near(np.diag([1.0, 0.01]), 0.1, 0.2)
    >>> shown(np.array([0, 0]), np.array([[0, 10], [0, 20], [50, 0], [60, 0]]))
    array([1., 0., 1., 0.])
    """
    unit = 2 * np.pi * spacing_m * np.linalg.cholesky(spectrum)

    def shown(one: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.float64]:
        down, right = (others - one).T
        lobe = np.linalg.norm(np.stack([right, -down], axis=1) @ unit, axis=1) < _LOBE_CELLS * _CELL_UNITS
        return np.asarray(lobe | (np.hypot(down, right) < SMEARED_CELLS * cell_m / spacing_m), np.float64)

    return shown


# ---- Bright points of an image

MOST_POINTS = 16  # of an image that are measured, at most
DEEPEST_DB = -12.0
"""dB below the brightest point: weaker points may be what defocus leaves of it."""

_MOST_MAXIMA = 1024  # of an image that are compared with brighter points' responses
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


def bright_points(
    image: BlockRaster,
    windows: Iterable[Window],
    *,
    cell_px: int,
    shown: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]],
) -> list[BrightPoint]:
    """Return the brightest local maxima that are points of their own, brightest first.

    Parameters
    ----------
    image
        (y, x) complex64, carrier kept; NaN is left out.
    windows
        Windows that cover it once.
    cell_px
        Of the maxima in a square of this side only the brightest is looked at.
    shown
        (2,) int64 pixel of a point and (n, 2) int64 pixels → (n,) float64, what the point shows there, as
        `PointResponse.at`.

    Examples
    --------
    >>> y, x = np.mgrid[:64, :128]
    >>> lobe = lambda row, column: np.sinc((y - row) / 4) * np.sinc((x - column) / 4)
    >>> whole = (slice(0, 64), slice(0, 128))
    >>> image = (lobe(30.25, 33.5) + 0.5 * lobe(20, 90)).astype(np.complex64)
    >>> shown = lambda one, others: np.abs(np.sinc((others - one) / 4)).prod(axis=1)
    >>> [(round(p.row, 1), round(p.column, 1)) for p in bright_points(image, [whole], cell_px=8, shown=shown)]
    [(30.2, 33.5), (20.0, 90.0)]
    """
    found, floor = np.zeros((0, 3)), 0.0
    for window in windows:
        magnitude = np.abs(np.nan_to_num(np.asarray(image[window])))
        if (top := float(magnitude.max(initial=0.0))) > floor:
            floor = max(floor, top * 10 ** (DEEPEST_DB / 20))
            found = np.concatenate([found, _cell_maxima(magnitude, window, cell_px)])
            found = found[found[:, 0] > floor]
    found = found[np.lexsort((found[:, 2], found[:, 1], -found[:, 0]))][:_MOST_MAXIMA]
    maxima = [(top, int(row), int(column)) for top, row, column in found.tolist()]
    maxima = [one for one in maxima if _stands_out(image, *one)]
    pixels = np.array([one[1:] for one in maxima], np.int64).reshape(-1, 2)
    kept = separated(
        np.array([one[0] for one in maxima]), lambda one, others: shown(pixels[one], pixels[others]), most=MOST_POINTS
    )
    return [bright_point(image, int(row), int(column)) for row, column in pixels[kept]]


def has_point(image: BlockRaster, row: int, column: int, *, reach: int) -> bool:
    """Test whether an image has a pixel 10 dB above its surroundings within `reach` pixels of a place.

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


def bright_point(image: BlockRaster, row: int, column: int) -> BrightPoint:
    """Return the maximum of an image near a pixel, with the power around it."""
    peak = find_peak(image, row, column)
    about = tuple(slice(max(0, at - PATCH_PX // 2), at + PATCH_PX // 2) for at in (row, column))
    power = np.abs(np.nan_to_num(np.asarray(image[about[0], about[1]]))).astype(np.float64) ** 2
    background = float(np.median(power)) / np.log(2) / abs(peak.value) ** 2
    return BrightPoint(peak.row, peak.column, float(abs(peak.value)), float(background))


def brightest_near(image: BlockRaster, row: float, column: float, reach: float) -> tuple[int, int]:
    """Return the brightest pixel of an image within `reach` pixels of a place, by row and by column.

    Examples
    --------
    >>> brightest_near(np.eye(9)[::-1] * np.arange(9), 4.5, 4.5, 1.0)
    (3, 5)
    """
    first = [max(0, int(np.floor(at - reach))) for at in (row, column)]
    window = np.abs(
        np.nan_to_num(np.asarray(image[first[0] : int(row + reach) + 2, first[1] : int(column + reach) + 2]))
    )
    down, right = np.unravel_index(int(window.argmax()), window.shape)
    return first[0] + int(down), first[1] + int(right)


def _cell_maxima(magnitude: NDArray[np.float32], window: Window, cell_px: int) -> NDArray[np.float64]:
    """Return (magnitude, row, column) of the largest local maximum in each square cell of a block, where there is one.

    Pixels at the block's edges are compared with their neighbours inside it.
    """
    cell_px = min(cell_px, max(magnitude.shape))
    # Largest of the 3 × 3 neighbours of every pixel, then the largest local maximum of each cell.
    highest = magnitude
    for axis in (0, 1):
        lines, about = np.swapaxes(highest, 0, axis), np.swapaxes(highest.copy(), 0, axis)
        np.maximum(about[1:], lines[:-1], out=about[1:])
        np.maximum(about[:-1], lines[1:], out=about[:-1])
        highest = np.swapaxes(about, 0, axis)
    rows, columns = (-(-size // cell_px) * cell_px for size in magnitude.shape)
    padded = np.zeros((rows, columns), magnitude.dtype)
    padded[: magnitude.shape[0], : magnitude.shape[1]] = np.where(magnitude == highest, magnitude, 0)
    cells = padded.reshape(rows // cell_px, cell_px, columns // cell_px, cell_px).swapaxes(1, 2)
    flat = cells.reshape(*cells.shape[:2], -1)
    best = flat.argmax(axis=-1)
    down, right = np.indices(best.shape)
    row = window[0].start + down * cell_px + best // cell_px
    column = window[1].start + right * cell_px + best % cell_px
    return np.stack([flat.max(axis=-1), row, column], axis=-1, dtype=np.float64).reshape(-1, 3)


def _stands_out(image: BlockRaster, magnitude: float, row: int, column: int) -> bool:
    """Test whether no pixel about a maximum of its block exceeds it, across the blocks' edges too."""
    about = image[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
    return bool(np.abs(np.nan_to_num(np.asarray(about))).max() <= magnitude)


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
    # Every difference of two points is a candidate: the weight of the points that match under it, each of them once.
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
