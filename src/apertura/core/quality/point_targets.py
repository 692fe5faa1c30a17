"""Point target analysis: peak position, −3 dB width and sidelobe ratios."""

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apertura.common.units import decibels
from apertura.core.quality.measures import BlockRaster

PATCH_PX = 64  # side of a patch, pixels

CUT_REACH_M = 3.0
"""Half length of the cuts through the brightest target of an image, metres: includes main lobe and first sidelobes."""

_REFINEMENTS = 7
"""Number of refinement rounds, each of which reduces the grid spacing by a factor of four: from one to 6e-5 pixel."""


class BandLimitedPatch:
    """Square patch of an image, interpolated as a band-limited function.

    Parameters
    ----------
    image
        (y, x) complex64, with the carrier phase.
    row, column
        Pixel at the centre of the patch.
    carrier
        Centre of the spatial frequency band, down and right, cycles per pixel (default: centre of the aliased band;
        phases between pixels are then correct up to a constant phase step per pixel).

    Notes
    -----
    Each bin of the discrete Fourier transform of the patch is assigned the alias frequency nearest to the band centre.
    Between pixels, the trigonometric polynomial is evaluated exactly. Splines of the real and imaginary parts are
    unsuitable, because the carrier phase changes by more than a radian per pixel.
    """

    def __init__(self, image: BlockRaster, row: int, column: int, carrier: tuple[float, float] | None = None) -> None:
        rows, columns = (_span(at, size) for at, size in zip((row, column), image.shape, strict=True))
        self._first = np.array([rows.start, columns.start], np.float64)
        square = np.nan_to_num(np.asarray(image[rows, columns])).astype(np.complex128)
        self._spectrum = np.fft.fft2(square, norm="forward")
        self._frequencies = [_centred(self._spectrum, axis, carrier and carrier[axis]) for axis in (0, 1)]

    def at(self, row: ArrayLike, column: ArrayLike) -> NDArray[np.complex128]:
        """Return the image at fractional pixels (0-based, of the whole image), complex128 in the shape of `row`."""
        down, right = (
            np.exp(2j * np.pi * np.multiply.outer(np.asarray(at, np.float64) - first, frequencies))
            for at, first, frequencies in zip((row, column), self._first, self._frequencies, strict=True)
        )
        return np.asarray(((down @ self._spectrum) * right).sum(axis=-1))


def carrier_at(carriers: NDArray[np.float64], shape: tuple[int, int], row: float, column: float) -> tuple[float, float]:
    """Return the centre of a point's spatial frequency band, east and north, cycles per metre.

    Parameters
    ----------
    carriers
        (3, 3, 2) float64, `carriers_cycles_m` of a view: rows, columns, east and north.
    shape
        Rows and columns of the image.
    row, column
        Fractional pixel.

    Notes
    -----
    Values are interpolated by parabolas through the nine points. The direction to an antenna varies smoothly over the
    scene; third-order variations are neglected.

    Examples
    --------
    >>> bent = np.array([[[c * c, r] for c in (-1, 0, 1)] for r in (-1, 0, 1)], float)
    >>> carrier_at(bent, (101, 101), 75, 75)
    (0.25, 0.5)
    """
    weights = []
    for at, size in zip((row, column), shape, strict=True):
        along = 2 * at / max(size - 1, 1) - 1
        weights.append(np.array([along * (along - 1) / 2, 1 - along**2, along * (along + 1) / 2]))
    east, north = np.einsum("r,c,rcx->x", *weights, np.asarray(carriers, np.float64))
    return float(east), float(north)


def _span(at: int, size: int) -> slice:
    first = min(max(0, at - PATCH_PX // 2), max(0, size - PATCH_PX))
    return slice(first, min(first + PATCH_PX, size))


def _centred(spectrum: NDArray[np.complex128], axis: int, middle: float | None) -> NDArray[np.float64]:
    """Return the frequency (cycles per pixel) of each DFT bin, unwrapped about a given or the estimated band centre."""
    power = (np.abs(spectrum) ** 2).sum(axis=1 - axis)
    count = len(power)
    bins = np.arange(count)
    if middle is None:
        middle = np.angle((power * np.exp(2j * np.pi * bins / count)).sum()) / (2 * np.pi)
    frequencies = bins / count
    return np.asarray(frequencies - np.round(frequencies - middle))


@dataclass(frozen=True)
class Peak:
    """Peak of a point target in an image.

    Attributes
    ----------
    row, column
        Fractional pixel of the maximum.
    value
        Complex amplitude at the maximum.
    """

    row: float
    column: float
    value: complex


def find_peak(image: BlockRaster, row: int, column: int) -> Peak:
    """Locate the maximum of the interpolated magnitude near a pixel.

    Parameters
    ----------
    image
        (y, x) complex64.
    row, column
        Start pixel; the nearest local maximum is refined to about 1e-4 pixel.

    Examples
    --------
    >>> y, x = np.mgrid[:64, :64]
    >>> image = np.sinc((y - 30.3) / 4) * np.sinc((x - 33.6) / 4) * np.exp(2j * y)
    >>> peak = find_peak(image.astype(np.complex64), 30, 34)
    >>> round(peak.row, 1), round(peak.column, 1)
    (30.3, 33.6)
    """
    patch = BandLimitedPatch(image, row, column)
    at, _ = locate_maximum(lambda *pixels: np.abs(patch.at(*pixels)), (row, column), (1.0, 1.0), rounds=_REFINEMENTS)
    return Peak(*at, complex(patch.at(*at)))


def locate_maximum(
    level: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.floating]],
    start: tuple[float, float],
    reach: tuple[float, float],
    *,
    rounds: int,
    counts: tuple[int, int] = (9, 9),
) -> tuple[tuple[float, float], float]:
    """Locate the maximum of a function of two coordinates near a point; return its coordinates and value.

    Parameters
    ----------
    level
        Values at two (n, m) float64 arrays of coordinates.
    start, reach
        The search covers `start` ± `reach` in each coordinate.
    rounds
        Number of successive grids. Each grid extends over one step of the previous grid to both sides of the best
        point found.
    counts
        Number of points of the first grid along each coordinate; later grids have 9 × 9 points.

    Examples
    --------
    >>> (x, y), top = locate_maximum(lambda x, y: 2 - (x - 0.3) ** 2 - (y + 0.1) ** 2, (0, 0), (1, 1), rounds=7)
    >>> round(x, 3), round(y, 3), round(top, 6)
    (0.3, -0.1, 2.0)
    """
    for _ in range(rounds):
        axes = (at + np.linspace(-half, half, count) for at, half, count in zip(start, reach, counts, strict=True))
        first, second = np.meshgrid(*axes, indexing="ij")
        values = level(first, second)
        best = np.unravel_index(int(values.argmax()), values.shape)
        start, highest = (float(first[best]), float(second[best])), float(values[best])
        reach = (2 * reach[0] / (counts[0] - 1), 2 * reach[1] / (counts[1] - 1))
        counts = (9, 9)
    return start, highest


@dataclass(frozen=True)
class Cut:
    """Measures of a cut through a peak.

    Attributes
    ----------
    width_m
        −3 dB width, metres; NaN if the main lobe extends beyond the cut.
    pslr_db, islr_db
        Peak and integrated sidelobe ratios along the cut, dB; NaN without sidelobes.
    """

    width_m: float
    pslr_db: float
    islr_db: float


def cut_through(
    image: BlockRaster,
    peak: Peak,
    *,
    direction: tuple[float, float],
    spacing_m: float,
    reach_m: float,
) -> Cut:
    """Measure width and sidelobe ratios along a line through a peak.

    Parameters
    ----------
    image
        (y, x) complex64, row 0 in the north.
    peak
        Result of `find_peak`.
    direction
        (east, north) of the line, of any length.
    spacing_m
        Pixel spacing.
    reach_m
        Half length of the line, limited by the patch of 64 pixels.

    Notes
    -----
    The main lobe ends at the first minima on both sides. The PSLR is the highest sample outside the main lobe relative
    to the peak; the ISLR is the energy outside the main lobe relative to the energy inside it.

    Examples
    --------
    >>> x = np.arange(64) - 32.0
    >>> image = np.outer(np.sinc(x / 8), np.sinc(x / 5)).astype(np.complex64)
    >>> cut = cut_through(image, Peak(32, 32, 1), direction=(1, 0), spacing_m=0.1, reach_m=2.5)
    >>> round(cut.width_m / 0.5, 2), round(cut.pslr_db, 1)
    (0.89, -13.3)
    """
    along, line = line_through(image, peak, direction=direction, spacing_m=spacing_m, reach_m=reach_m)
    middle = _summit(line)
    left, right = _first_minimum(line[middle::-1]), _first_minimum(line[middle:])
    lobe = slice(middle - left, middle + right + 1)
    beyond = np.concatenate([line[: lobe.start], line[lobe.stop :]])
    return Cut(
        half_power_width(line, middle) * float(along[1] - along[0]),
        decibels(beyond.max() / line[middle]) if beyond.size else float("nan"),
        decibels(beyond.sum() / line[lobe].sum()) if beyond.size else float("nan"),
    )


def cuts_report(
    image: BlockRaster, peak: Peak, *, cross_range: tuple[float, float], spacing_m: float, reach_m: float
) -> dict[str, float | None]:
    """Report cuts through a peak along and across the flight for image.json; None for values that a cut does not yield.

    Parameters as for `cut_through`; `cross_range` is the (east, north) direction of the flight.

    Examples
    --------
    >>> x = np.arange(64) - 32.0
    >>> image = np.outer(np.sinc(x / 8), np.sinc(x / 5)).astype(np.complex64)
    >>> report = cuts_report(image, Peak(32, 32, 1), cross_range=(1, 0), spacing_m=0.1, reach_m=2.5)
    >>> [round(report[f"{name}_range_width_m"], 2) for name in ("cross", "ground")]
    [0.44, 0.71]
    """
    cuts = {
        name: cut_through(image, peak, direction=direction, spacing_m=spacing_m, reach_m=reach_m)
        for name, direction in (("cross_range", cross_range), ("ground_range", (cross_range[1], -cross_range[0])))
    }
    return {
        f"{name}_{measure}": None if np.isnan(value) else round(value, 4)
        for name, cut in cuts.items()
        for measure, value in asdict(cut).items()
    }


def line_through(
    image: BlockRaster, peak: Peak, *, direction: tuple[float, float], spacing_m: float, reach_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sample a line through a peak: distances from the peak, metres, and power, (sample,) float64 each.

    Parameters as for `cut_through`. The line has 32 samples per pixel; its centre sample is at the peak.

    Examples
    --------
    >>> image = np.outer(np.sinc((np.arange(64) - 32) / 8), np.ones(64)).astype(np.complex64)
    >>> along_m, power = line_through(image, Peak(32, 32, 1), direction=(0, 1), spacing_m=0.1, reach_m=0.8)
    >>> along_m.size, round(float(along_m[-1]), 6), power[along_m.size // 2].round(3), power[-1].round(3)
    (513, 0.8, np.float64(1.0), np.float64(0.0))
    """
    patch = BandLimitedPatch(image, round(peak.row), round(peak.column))
    reach = min(reach_m, (PATCH_PX // 2 - 1) * spacing_m)
    along = np.linspace(-reach, reach, 1 + 2 * int(np.ceil(32 * reach / spacing_m)))
    east, north = np.array(direction) / np.hypot(*direction)
    line = np.abs(patch.at(peak.row - along * north / spacing_m, peak.column + along * east / spacing_m)) ** 2
    return along, line


def _summit(line: NDArray[np.float64]) -> int:
    """Return the index of the maximum near the centre of a line, where a wide lobe is flat within rounding errors."""
    middle = len(line) // 2
    for step in (-1, 1):
        while 0 < middle < len(line) - 1 and line[middle + step] > line[middle]:
            middle += step
    return middle


def _first_minimum(line: NDArray[np.float64]) -> int:
    rising = np.flatnonzero(np.diff(line) > 0)
    return int(rising[0]) if rising.size else len(line) - 1


def half_power_width(power: NDArray[np.float64], middle: int) -> float:
    """Return the −3 dB width, samples, of a lobe with the peak at sample `middle`; NaN if it lacks a half-power point.

    Examples
    --------
    >>> half_power_width(np.array([0.0, 0.0, 1.0, 0.0, 0.0]), 2)
    1.0
    """
    half = power[middle] / 2
    sides = []
    for side in (power[middle::-1], power[middle:]):
        below = np.flatnonzero(side < half)
        if not below.size:
            return float("nan")
        k = int(below[0])
        sides.append(k - 1 + (side[k - 1] - half) / (side[k - 1] - side[k]))
    return float(sum(sides))
