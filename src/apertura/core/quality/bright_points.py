"""Detection of isolated bright points of an image, at which focus, position and phase are measured."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.geometry.aperture import Aperture, Weigh
from apertura.core.quality.measures import BlockRaster
from apertura.core.quality.point_targets import PATCH_PX, find_peak

SPECKLE = 0.06
"""Mean power around a bright point relative to the power of the point, above which the point may be speckle. The ratio
for the brightest of 10⁶ speckle pixels is 0.07."""

# ---- Point response at other points

SMEARED_CELLS = 6.0
"""Number of resolution cells across the line of sight over which phase errors may smear a point: eq. 1b is used within
this distance."""

OVER_RESPONSE = 2.0
"""Minimum ratio of the amplitude of a point to the summed responses of brighter points at its position: 6 dB, because
tapers and phase errors displace and raise sidelobes."""

_RESPONSE_PULSES = 512  # number of sampled pulses, sufficient for a quarter of this number of phase cycles


@dataclass(frozen=True, eq=False)
class PointResponse:
    """Point response of an image: upper bound of the amplitude that a single point causes at other points.

    Attributes
    ----------
    aperture
        Phase centres of the pair, all pulses.
    envelope
        (sample,) complex, range response of a pulse over one period of the total path, referred to band centre. The
        centre sample corresponds to the path of the point and is 1.
    step_m
        Total path between samples.
    wavelength_m
        Wavelength at band centre.
    weigh
        Pulses and points → weights of antennas and of the integrated sector (default: equal weights).

    Notes
    -----
    Source: docs/theory/focus.md, eq. 1a and 1b.

    Examples
    --------
    Phase errors may smear the point by four cells in azimuth, but not by eight. At two range cells, the response is 0:

    >>> track = np.stack([np.linspace(-5, 5, 512), np.full(512, -100.0), np.full(512, 0.0)], -1)
    >>> response = PointResponse(Aperture(track, track), np.sinc(np.arange(-600, 600) / 120), 0.1, 0.26)
    >>> in_azimuth, in_range = [[5.2, 0, 0], [11.05, 0, 0]], [[0, 3.0, 0], [0, 6.0, 0]]
    >>> response.at(np.zeros(3), np.array(in_azimuth)).round(2).tolist()
    [1.0, 0.04]
    >>> response.at(np.zeros(3), np.array(in_range)).round(2).tolist()
    [0.64, 0.0]
    """

    aperture: Aperture
    envelope: NDArray[np.complexfloating]
    step_m: float
    wavelength_m: float
    weigh: Weigh | None = None

    def at(self, place_m: NDArray[np.float64], others_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return an upper bound of a point's response at other points, relative to its peak.

        Parameters
        ----------
        place_m
            (3,) float64, the point, metres, in the frame of the phase centres.
        others_m
            (other, 3) float64, metres.

        Returns
        -------
        ndarray
            (other,) float64, 0 to 1.
        """
        pulses = self.aperture.sample(_RESPONSE_PULSES)
        weight = np.ones(len(self.aperture[pulses])) if self.weigh is None else self.weigh(pulses, place_m[None])[:, 0]
        if not weight.any():
            return np.zeros(len(others_m))
        illuminates, weight = weight > 0, weight[weight > 0, None] / weight.sum()
        aperture = self.aperture[pulses][illuminates]
        # δ_m, and the bound of eq. 1b, which does not depend on phases.
        extra_path_m = aperture.path(others_m) - aperture.path(place_m[None])
        range_response = self._range_response(extra_path_m)
        bound = (weight * np.abs(range_response)).sum(axis=0)
        cycles = np.ptp(extra_path_m, axis=0) / self.wavelength_m
        # Eq. 1a; eq. 1b applies within the cells over which phase errors may smear the point.
        lobe = np.abs((weight * range_response * np.exp(2j * np.pi / self.wavelength_m * extra_path_m)).sum(axis=0))
        # If the sampled pulses undersample the phase, the sum aliases: the envelope of far sidelobes is used instead.
        is_sampled = cycles < len(aperture) / 4
        lobe = np.where(is_sampled, lobe, bound / np.maximum(np.pi * cycles, 1.0))
        return np.asarray(np.where(cycles < SMEARED_CELLS, bound, lobe))

    def _range_response(self, extra_path_m: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the periodic range response of a pulse at extra paths, interpolated linearly."""
        count = len(self.envelope)
        at = extra_path_m / self.step_m + count // 2
        below = np.floor(at)
        first, second = (self.envelope[(below + step).astype(np.int64) % count] for step in (0, 1))
        return np.asarray(first + (at - below) * (second - first))


def separated(
    amplitude: NDArray[np.floating], shown: Callable[[int, NDArray[np.int64]], NDArray[np.float64]], *, most: int
) -> list[int]:
    """Select the maxima that are separate points, not sidelobes or flanks of brighter points.

    Parameters
    ----------
    amplitude
        (maximum,) float, brightest first.
    shown
        Index of a maximum, and indices of other maxima → (other,) float64, response at the other maxima of a point at
        the first, as returned by `PointResponse.at`.
    most
        Largest number of points.

    Returns
    -------
    list of int
        Indices of the points, brightest first. The amplitude of each point exceeds the summed responses of all brighter
        points by the factor `OVER_RESPONSE`.

    Notes
    -----
    Source: docs/theory/focus.md, "Bright points".

    Examples
    --------
    >>> at = np.array([0.0, 1.4, 40.0, 50.0])
    >>> separated(np.array([1, 0.22, 0.2, 0.1]), lambda i, others: np.abs(np.sinc(at[others] - at[i])), most=9)
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
_CELL_UNITS = 1.8  # size of a resolution cell in every direction, in units of docs/theory/focus.md, eq. 6


def near(
    spectrum: NDArray[np.float64], spacing_m: float, cell_m: float
) -> Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]]:
    """Return a bound of the point response of an image from the covariance of its spatial spectrum alone.

    Parameters
    ----------
    spectrum
        (2, 2) float64, covariance of the spatial spectrum, east and north, cycles² per m².
    spacing_m
        Pixel spacing; row 0 in the north.
    cell_m
        Finest resolution cell.

    Returns
    -------
    callable
        Parameter `shown` of `bright_points`. Its values are 1 within two resolution cells in each direction, beyond
        which sidelobes are below `DEEPEST_DB`; 1 within `SMEARED_CELLS` finest cells, over which phase errors may smear
        a point; and 0 elsewhere.

    Examples
    --------
    >>> shown = near(np.diag([1.0, 0.01]), 0.1, 0.2)
    >>> shown(np.array([0, 0]), np.array([[0, 10], [0, 20], [50, 0], [60, 0]]))
    array([1., 0., 1., 0.])
    """
    unit = 2 * np.pi * spacing_m * np.linalg.cholesky(spectrum)

    def shown(pixel: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.float64]:
        down, right = (others - pixel).T
        lobe = np.linalg.norm(np.stack([right, -down], axis=1) @ unit, axis=1) < _LOBE_CELLS * _CELL_UNITS
        return np.asarray(lobe | (np.hypot(down, right) < SMEARED_CELLS * cell_m / spacing_m), np.float64)

    return shown


# ---- Bright points of an image

MOST_POINTS = 16  # largest number of points measured in an image
DEEPEST_DB = -12.0
"""Minimum amplitude of a point relative to the brightest point, dB: weaker maxima may be lobes of a defocused point."""

_MOST_MAXIMA = 1024  # largest number of maxima compared with the responses of brighter points
_POINT_CONTRAST = 10.0  # minimum power of a point relative to the surrounding speckle: 10 dB


@dataclass(frozen=True)
class BrightPoint:
    """Local maximum of an image.

    Attributes
    ----------
    row, column
        Fractional pixel.
    amplitude
        Magnitude at the maximum.
    background
        Mean power of the surrounding speckle relative to the power of the point, estimated by the median over a patch.
    carrier
        Spatial frequency of the carrier down and right, cycles per pixel; None: the aliased frequency is used.
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
    """Detect the brightest separate points of an image, brightest first.

    Parameters
    ----------
    image
        (y, x) complex64, with the carrier phase; NaN is excluded.
    windows
        Windows that cover the image once.
    cell_px
        Side of the squares in each of which only the brightest maximum is considered.
    shown
        (2,) int64 pixel of a point, and (n, 2) int64 pixels → (n,) float64, response of the point at these pixels, as
        returned by `PointResponse.at`.

    Examples
    --------
    >>> y, x = np.mgrid[:64, :128]
    >>> lobe = lambda row, column: np.sinc((y - row) / 4) * np.sinc((x - column) / 4)
    >>> whole = (slice(0, 64), slice(0, 128))
    >>> image = (lobe(30.25, 33.5) + 0.5 * lobe(20, 90)).astype(np.complex64)
    >>> shown = lambda pixel, others: np.abs(np.sinc((others - pixel) / 4)).prod(axis=1)
    >>> [(round(p.row, 1), round(p.column, 1)) for p in bright_points(image, [whole], cell_px=8, shown=shown)]
    [(30.2, 33.5), (20.0, 90.0)]
    """
    candidates, floor = np.zeros((0, 3)), 0.0
    for window in windows:
        magnitude = np.abs(np.nan_to_num(np.asarray(image[window])))
        if (top := float(magnitude.max(initial=0.0))) > floor:
            floor = max(floor, top * 10 ** (DEEPEST_DB / 20))
            candidates = np.concatenate([candidates, _cell_maxima(magnitude, window, cell_px)])
            candidates = candidates[candidates[:, 0] > floor]
    order = np.lexsort((candidates[:, 2], candidates[:, 1], -candidates[:, 0]))
    maxima = [(top, int(row), int(column)) for top, row, column in candidates[order][:_MOST_MAXIMA].tolist()]
    maxima = [maximum for maximum in maxima if _is_local_maximum(image, *maximum)]
    pixels = np.array([maximum[1:] for maximum in maxima], np.int64).reshape(-1, 2)
    kept = separated(
        np.array([maximum[0] for maximum in maxima]),
        lambda number, others: shown(pixels[number], pixels[others]),
        most=MOST_POINTS,
    )
    return [bright_point(image, int(row), int(column)) for row, column in pixels[kept]]


def has_point(image: BlockRaster, row: int, column: int, *, reach: int) -> bool:
    """Return True if a pixel within `reach` rows and columns of a given pixel is 10 dB above its surroundings.

    Examples
    --------
    >>> image = np.ones((64, 64), np.complex64)
    >>> image[30, 31] = 5
    >>> has_point(image, 31, 31, reach=2), has_point(image, 20, 31, reach=2)
    (True, False)
    """
    near, about = (
        np.abs(
            np.nan_to_num(np.asarray(image[max(0, row - far) : row + far + 1, max(0, column - far) : column + far + 1]))
        )
        for far in (reach, PATCH_PX // 2)
    )
    return bool(near.size and near.max() ** 2 > _POINT_CONTRAST * np.median(about.astype(np.float64) ** 2) / np.log(2))


def bright_point(image: BlockRaster, row: int, column: int) -> BrightPoint:
    """Measure the maximum of an image near a pixel, and its background power."""
    peak = find_peak(image, row, column)
    about = tuple(slice(max(0, at - PATCH_PX // 2), at + PATCH_PX // 2) for at in (row, column))
    power = np.abs(np.nan_to_num(np.asarray(image[about[0], about[1]]))).astype(np.float64) ** 2
    background = float(np.median(power)) / np.log(2) / abs(peak.value) ** 2
    return BrightPoint(peak.row, peak.column, float(abs(peak.value)), float(background))


def brightest_near(image: BlockRaster, row: float, column: float, reach: float) -> tuple[int, int]:
    """Return the brightest pixel of an image within `reach` rows and columns of a fractional pixel.

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
    """Return (magnitude, row, column) of the largest local maximum in each square cell of a block; magnitude 0 if none.

    Pixels at the edges of the block are compared with their neighbours inside it.
    """
    cell_px = min(cell_px, max(magnitude.shape))
    # Maximum over the 3 × 3 neighbourhood of every pixel, then the largest local maximum of each cell.
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


def _is_local_maximum(image: BlockRaster, magnitude: float, row: int, column: int) -> bool:
    """Return True if no neighbour of a pixel, in its own or another block, exceeds the pixel's magnitude."""
    about = image[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
    return bool(np.abs(np.nan_to_num(np.asarray(about))).max() <= magnitude)


def common_shift(
    first: Sequence[tuple[float, float, float]],
    second: Sequence[tuple[float, float, float]],
    *,
    reach: float,
    gate: float,
) -> tuple[tuple[float, float], list[tuple[int, int]]]:
    """Estimate the common shift between two lists of points, weighted by brightness, and match the shifted points.

    Parameters
    ----------
    first, second
        (x, y, amplitude) of points in two images of one scene.
    reach
        Largest shift considered, in the unit of x and y.
    gate
        Largest difference between two shifts that are considered equal, in the unit of x and y.

    Returns
    -------
    tuple
        (Δx, Δy), second minus first, and pairs of indices of the matched points. If no points match within reach, the
        shift is zero and the list of pairs is empty.

    Examples
    --------
    >>> first = [(0, 0, 1.0), (5, 1, 0.8), (2, 7, 0.5)]
    >>> second = [(x + 0.3, y - 0.1, a) for x, y, a in first]
    >>> shift, matched = common_shift(first, second, reach=4, gate=0.2)
    >>> np.round(shift, 3).tolist(), matched
    ([0.3, -0.1], [(0, 0), (1, 1), (2, 2)])
    """
    a, b = (np.array(points, np.float64).reshape(-1, 3) for points in (first, second))
    difference = b[None, :, :2] - a[:, None, :2]
    weight = np.minimum(a[:, None, 2] / a[:, 2].max(initial=1e-30), b[None, :, 2] / b[:, 2].max(initial=1e-30))
    weight = np.where(np.hypot(difference[..., 0], difference[..., 1]) <= reach, weight, 0.0)
    # Each difference of two points is a candidate shift; its score is the total weight of the points that match.
    best, votes = np.zeros(2), 0.0
    for i, j in zip(*np.nonzero(weight), strict=True):
        near = np.hypot(*np.moveaxis(difference - difference[i, j], -1, 0)) <= gate
        total = float((weight * near).max(axis=1).sum())
        total -= 1e-3 * float(np.hypot(*difference[i, j]) / reach)  # prefer the smaller of equally good shifts
        if total > votes:
            best, votes = difference[i, j], total
    matched = _matched(difference - best, weight, gate)
    if matched:
        best = np.median([difference[i, j] for i, j in matched], axis=0)
    return (float(best[0]), float(best[1])), matched


def _matched(difference: NDArray[np.float64], weight: NDArray[np.float64], gate: float) -> list[tuple[int, int]]:
    """Match points within the gate, closest points first and each point at most once; return pairs of indices."""
    distance = np.where(weight > 0, np.hypot(difference[..., 0], difference[..., 1]), np.inf)
    matched: list[tuple[int, int]] = []
    for flat in np.argsort(distance, axis=None):
        i, j = (int(at) for at in np.unravel_index(flat, distance.shape))
        if distance[i, j] > gate:
            break
        if all(i != matched_i and j != matched_j for matched_i, matched_j in matched):
            matched.append((i, j))
    return sorted(matched)
