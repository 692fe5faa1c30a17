"""Agreement of two images of one scene: relative shift and phase, from bright points or from patches of terrain."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import comb
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.common.errors import number_of
from apertura.core.quality.bright_points import BrightPoint, common_shift
from apertura.core.quality.measures import BlockRaster, weighted_median
from apertura.core.quality.point_targets import PATCH_PX, BandLimitedPatch

REACH_M = 4.0
"""Largest shift between two images that is searched, metres; shifts of at least 12 resolution cells are searched. With
larger shifts, different points would be matched."""

WIDEST_PIXEL = 1.05
"""Largest pixel spacing in units of the finest resolution cell: pixels of 1.13 cells sample a flat band critically."""

SHIFTED = 0.18
"""Tolerated shift of two images in units of eq. 6, corresponding to a tenth of the resolution cell. Images with a
significantly larger shift are considered displaced."""

OUT_OF_PHASE_RAD = 0.6
"""Tolerated phase difference of two images, radians: the loss of their sum is 0.4 dB."""

LEAST_COHERENCE = 0.5
"""Minimum magnitude of the mean phasor over common points, 0 to 1: phases with more scatter cannot be corrected by a
constant phase."""

LARGEST_PHASE_STD_RAD = 0.4
"""Largest standard deviation of a phase that is used, radians: the loss from a phase error of this size is 0.2 dB."""

_MOST_PATCHES = 16  # largest number of patches that are compared; the brightest patches are selected
_LEAST_LOOKS = 12
"""Minimum number of independent samples: fewer may lie on one flank of a point response (interferometry.md, eq. 6)."""
_BY_CHANCE = 0.001  # significance level: probability with which unrelated images are classified as coherent
_WIDER = (2.0, 4.0, 8.0)  # resolution cells: gates within which points with different shifts are matched
_FEWEST_SPREAD = 3  # minimum number of points for a wide gate: matches of two points may be accidental
_FAR = 4.0  # standard deviations from the median shift, beyond which a match is an outlier
# factor on the bounds of phase and position from looks, for the excess scatter of terrain (interferometry.md, eq. 8)
_MARGIN = 1.4

# carrier cycles: a larger shift is closer to the shift caused by a path error of one wavelength than to zero
_HALF_CYCLE = 0.5
_POINT = 0.09  # displacement of a peak by neighbours, in units of eq. 6: about a twentieth of a resolution cell
_POINT_RAD = 0.05  # phase error of a peak caused by neighbours


@dataclass(frozen=True)
class Agreement:
    """Shift and phase of a second image relative to a first.

    Attributes
    ----------
    by
        Features compared: 'bright points', or 'looks' (independent samples of terrain patches).
    points
        Number of common points or looks.
    shift_east_m, shift_north_m, shift_std_m
        Mean shift over the points, and its standard deviation along one axis, metres.
    shift_units, shift_std_units
        Mean shift and its standard deviation in units of eq. 6; a resolution cell is about 1.8 units in every
        direction.
    cycles, cycles_std
        Component of the shift along the carrier, the direction in which a path error displaces a point, and its
        standard deviation, in carrier cycles. Below half a cycle, the phase determines the path error unambiguously.
        0 for looks.
    phase_rad, phase_std_rad
        Mean phase difference over the points, and its standard deviation.
    coherence
        For points, the magnitude of their mean phasor: 1 for equal phases, 1/√points for random phases. For patches,
        the coherence in their common band.
    spread
        True if the shifts of points differ by more than a resolution cell.
    """

    by: Literal["bright points", "looks"]
    points: int
    shift_east_m: float
    shift_north_m: float
    shift_std_m: float
    shift_units: float
    shift_std_units: float
    cycles: float
    cycles_std: float
    phase_rad: float
    phase_std_rad: float
    coherence: float
    spread: bool = False

    @property
    def evidence(self) -> str:
        """Number of common bright points or looks, with its noun."""
        return number_of(self.points, "bright point" if self.by == "bright points" else "look")

    @property
    def shift_m(self) -> float:
        """Magnitude of the shift, metres."""
        return float(np.hypot(self.shift_east_m, self.shift_north_m))

    @property
    def shift_std_along_m(self) -> float:
        """Standard deviation of the shift along its own direction, metres."""
        return self.shift_m * self.shift_std_units / self.shift_units if self.shift_units else self.shift_std_m

    @property
    def shifted(self) -> bool:
        """True if the images are displaced relative to each other by a significant shift."""
        return self.spread or self.shift_units > SHIFTED + 3 * self.shift_std_units or self.cycle_off

    @property
    def cycle_off(self) -> bool:
        """True if the shift corresponds to a path error of half a wavelength or more: the phase is then ambiguous."""
        return self.shift_units > SHIFTED and abs(self.cycles) > max(_HALF_CYCLE, 3 * self.cycles_std)

    @property
    def certain(self) -> bool:
        """True if the standard deviation of the phase is small enough for the phase to be used."""
        return self.phase_std_rad < LARGEST_PHASE_STD_RAD

    @property
    def incoherent(self) -> bool:
        """True if bright points have no common phase; a phase measured on patches is always significant."""
        return self.by == "bright points" and self.coherence < LEAST_COHERENCE

    @property
    def out_of_phase(self) -> bool:
        """True if the phase difference significantly exceeds the tolerance, so that the coherent sum loses power."""
        return self.certain and abs(self.phase_rad) > OUT_OF_PHASE_RAD + 2 * self.phase_std_rad

    @property
    def alignable(self) -> bool:
        """True if a constant phase correction brings the second image into phase with the first."""
        return self.certain and not self.shifted and not self.incoherent

    @property
    def reversed(self) -> "Agreement":
        """The same agreement with the images interchanged: that of the first image relative to the second."""
        signed = ("shift_east_m", "shift_north_m", "cycles", "phase_rad")
        return replace(self, **{name: -getattr(self, name) for name in signed})


# ---- By isolated bright points


def agreement(
    images: tuple[BlockRaster, BlockRaster],
    points: tuple[Sequence[BrightPoint], Sequence[BrightPoint]],
    *,
    spacing_m: float,
    cell_m: float,
    spectrum: NDArray[np.float64],
    alone: bool = False,
) -> Agreement | None:
    """Measure the agreement of two images by their common bright points; None without common points.

    The common points must number at least two and half of the points of the image with fewer points. Otherwise, the
    brightest points of both images must lie in one resolution cell.

    Parameters
    ----------
    images
        (y, x) complex64 on one grid, with the carrier phase, row 0 in the north.
    points
        Isolated bright points of each image, with their carriers.
    spacing_m
        Pixel spacing.
    cell_m
        Finest resolution cell: points within this distance, after a common shift, are matched.
    spectrum
        (2, 2) float64, covariance of a point's spatial spectrum east and north, cycles² per m².
    alone
        True if neither image has other bright points: in that case one common point at any position is sufficient.

    Notes
    -----
    Source: docs/theory/focus.md, "Pairs". The phase is evaluated midway between the two peaks. At the peaks themselves,
    the displacement caused by noise and neighbours would add carrier phase.

    Examples
    --------
    >>> y, x = np.mgrid[:64, :64]
    >>> image = (np.sinc((y - 30) / 4) * np.sinc((x - 33) / 4)).astype(np.complex64)
    >>> point = [BrightPoint(30.0, 33.0, 1.0)]
    >>> wide = np.diag([0.5, 0.5])
    >>> result = agreement((image, 1j * image), (point, point), spacing_m=0.1, cell_m=0.4, spectrum=wide, alone=True)
    >>> round(result.shift_m, 3), round(result.phase_rad, 3), result.out_of_phase
    (0.0, 1.571, True)
    """
    # Common points, their shifts from first to second, and the values of both images midway between the peaks.
    lists = [
        [(point.column * spacing_m, -point.row * spacing_m, point.amplitude) for point in of_image]
        for of_image in points
    ]
    matched, spread = _common_points(lists, cell_m, alone=alone)
    if not matched:
        return None
    shifts = np.array([np.subtract(lists[1][j][:2], lists[0][i][:2]) for i, j in matched])
    values = np.array([_between(images, points[0][i], points[1][j]) for i, j in matched])
    background = np.array([points[0][i].background + points[1][j].background for i, j in matched])
    unit = np.asarray(2 * np.pi * np.linalg.cholesky(spectrum), np.float64)  # metres to units of eq. 6
    carriers = np.array([[_carrier(points[0][i]), _carrier(points[1][j])] for i, j in matched]) / spacing_m
    # Variance of the shift, ε/2 along an axis in units of eq. 6, and of the phase, ε/2 rad², plus the effects of
    # neighbours. If the carriers differ, the phase also varies with the midpoint, whose variance is a quarter of the
    # variance of the shift.
    differ = np.diff(carriers, axis=1)[:, 0]
    slope = np.einsum("pi,ij,pj->p", differ, np.linalg.inv(spectrum), differ)
    shift_variance = background / 2 + _POINT**2
    phase_variance = background / 2 * (1 + slope / 4) + _POINT_RAD**2
    # Mean shift and mean phasor, weighted by the inverse of these variances.
    shift, std = _weighted_shift(shifts, shift_variance, unit)
    along = carriers.mean(axis=(0, 1))
    phasors = np.exp(1j * np.angle(values[:, 1] * values[:, 0].conj()))
    phasor = complex((phasors / phase_variance).sum() / (1 / phase_variance).sum())
    deviations = np.abs(np.angle(phasors / phasor))[:, None] / np.sqrt(phase_variance)[:, None]
    scatter = _excess(deviations, phase_variance)
    return Agreement(
        by="bright points",
        points=len(matched),
        shift_east_m=float(shift[0]),
        shift_north_m=float(shift[1]),
        shift_std_m=float(std * np.sqrt(np.trace(np.linalg.inv(unit @ unit.T)) / 2)),
        shift_units=float(np.linalg.norm(shift @ unit)),
        shift_std_units=std,
        cycles=float(along @ shift),
        cycles_std=float(std * np.sqrt(along @ np.linalg.solve(unit @ unit.T, along))),
        phase_rad=float(np.angle(phasor)),
        phase_std_rad=float(scatter / np.sqrt((1 / phase_variance).sum())),
        coherence=float(abs(phasor)),
        spread=spread,
    )


def _common_points(
    lists: Sequence[Sequence[tuple[float, float, float]]], cell_m: float, *, alone: bool
) -> tuple[list[tuple[int, int]], bool]:
    """Return the common points of two images, and True if the shifts of these points differ by more than a cell.

    After a common shift, half of the points of the image with fewer points must have matches within one cell.
    Otherwise, the brightest points of both images must lie in one cell. Height, heading and drift errors displace
    points by different amounts. Points are therefore also matched within wider gates, provided that the number of
    matches is statistically significant.
    """
    reach, fewest = max(REACH_M, 12 * cell_m), min(map(len, lists))
    _, matched = common_shift(lists[0], lists[1], reach=reach, gate=cell_m)
    if len(matched) >= max(1 if alone else 2, fewest / 2):
        return matched, False
    for gate in _WIDER if fewest >= _FEWEST_SPREAD else ():
        _, wider = common_shift(lists[0], lists[1], reach=reach, gate=gate * cell_m)
        if len(wider) >= fewest / 2 and _chance(lists, len(wider), reach, gate * cell_m) < _BY_CHANCE:
            return wider, True
    return _brightest_of_both(lists, cell_m), False


def _chance(lists: Sequence[Sequence[tuple[float, float, float]]], matches: int, reach: float, gate: float) -> float:
    """Return an upper bound of the probability of `matches` accidental matches of unrelated points under any shift.

    Shifts within reach are tested at intervals of one gate. At each shift, the number of matches has a binomial
    distribution: a point of the image with fewer points has a match with the probability p, the fraction of the area
    covered by the gates around the points of the other image.
    """
    fewer, more = sorted(lists, key=len)
    position = np.array([point[:2] for point in more])
    width, height = np.ptp(position, axis=0) + 2 * gate
    covered = min(1.0, len(more) * np.pi * gate**2 / (width * height))
    trials = len(fewer) * len(more)  # each pair of points defines a shift with which this pair matches
    at_least = sum(
        comb(len(fewer) - 1, count) * covered**count * (1 - covered) ** (len(fewer) - 1 - count)
        for count in range(matches - 1, len(fewer))
    )
    return float(min(trials, (reach / gate) ** 2 * np.pi) * at_least)


def _brightest_of_both(lists: Sequence[Sequence[tuple[float, float, float]]], cell_m: float) -> list[tuple[int, int]]:
    """Return the brightest points of two images if these lie in one cell, which is statistically significant."""
    if not all(lists):
        return []
    i, j = (int(np.argmax([amplitude for _, _, amplitude in points])) for points in lists)
    return [(i, j)] if np.hypot(*np.subtract(lists[1][j][:2], lists[0][i][:2])) <= cell_m else []


def _weighted_shift(
    shifts: NDArray[np.float64], variance: NDArray[np.float64], unit: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Return the mean of (point, 2) shifts, metres, and its standard deviation along an axis, units of eq. 6.

    The given variances are lower bounds, which are increased if the points scatter more. Outliers far from the median
    are excluded as accidental matches with other points.
    """
    middle = np.array([weighted_median(along, 1 / variance) for along in shifts.T])
    off = np.abs((shifts - middle) @ unit) / np.sqrt(variance)[:, None]
    excess = _excess(off, variance)
    weight = np.where((off < _FAR * excess).all(axis=1), 1 / variance, 0.0)
    return np.average(shifts, axis=0, weights=weight), excess / float(np.sqrt(weight.sum()))


def _excess(off: NDArray[np.float64], variance: NDArray[np.float64]) -> float:
    """Return the ratio of the scatter of points to their standard deviations, at least 1.

    `off`: (point, axis), deviations in units of the standard deviations. The weighted median is robust against weak
    points that are sidelobes in one of the images.
    """
    weights = np.repeat(1 / variance, off.shape[1])
    return max(1.0, 1.4826 * weighted_median(off.ravel(), weights)) if len(off) > 1 else 1.0


def _carrier(point: BrightPoint) -> tuple[float, float]:
    """Return the carrier of a point, cycles per pixel east and north; zero if unknown."""
    return (0.0, 0.0) if point.carrier is None else (point.carrier[1], -point.carrier[0])


def _between(images: tuple[BlockRaster, BlockRaster], first: BrightPoint, second: BrightPoint) -> list[complex]:
    """Return the values of both images midway between their peaks."""
    row, column = (first.row + second.row) / 2, (first.column + second.column) / 2
    return [
        complex(BandLimitedPatch(image, round(row), round(column), point.carrier).at(row, column))
        for image, point in zip(images, (first, second), strict=True)
    ]


# ---- By patches of terrain, in the common band of both images


def agreement_of_ground(
    images: tuple[BlockRaster, BlockRaster],
    windows: Iterable[Window],
    *,
    spacing_m: float,
    cell_m: float,
    spectrum: NDArray[np.float64],
) -> Agreement | None:
    """Measure the agreement of two images by their brightest patches; None if their coherence is not significant.

    Parameters
    ----------
    images
        (y, x) complex64 on one grid, with the carrier phase; NaN counts as zero.
    windows
        Windows that cover the grid once.
    spacing_m, cell_m, spectrum
        As for `agreement`.

    Notes
    -----
    Source: docs/theory/fusion.md, eq. 6. Spatial frequencies contained in only one image do not contribute, so that
    neither carrier has to be removed. As in `agreement`, the phase refers to a point of the terrain.

    Examples
    --------
    >>> generator = np.random.default_rng(1)
    >>> ground = generator.normal(size=(64, 64)) + 1j * generator.normal(size=(64, 64))
    >>> other = 1j * (ground + 0.5 * generator.normal(size=(64, 64)))
    >>> whole, scale = [(slice(0, 64), slice(0, 64))], {"spacing_m": 1.0, "cell_m": 1.0, "spectrum": np.eye(2) / 12}
    >>> result = agreement_of_ground((ground, other), whole, **scale)
    >>> round(result.coherence, 1), round(result.phase_rad, 1), result.shift_m < 0.1
    (0.9, 1.6, True)
    >>> agreement_of_ground((ground, generator.normal(size=(64, 64))), whole, **scale) is None
    True
    """
    patch_windows = _brightest(images, windows)
    patches = np.array([[_read(image, window) for window in patch_windows] for image in images])
    powers = (np.abs(patches) ** 2).sum(axis=(1, 2, 3)) if patches.size else np.zeros(2)
    if not powers.all():
        return None
    first, second = np.fft.fft2(patches, (2 * PATCH_PX,) * 2)  # zero-padded to avoid circular correlation
    scale = float(np.sqrt(powers.prod()))
    looks = _looks(first, second, np.abs(patches), powers)
    level = np.abs(np.fft.ifft2((second * first.conj()).sum(axis=0))) / scale  # |R| of eq. 6
    far = max(2, min(PATCH_PX // 2, int(max(REACH_M, 12 * cell_m) / spacing_m)))
    # Maximum within reach, if statistically significant: |R|² > 1 − (0.001/n)^{1/(L−1)} for n cells and L looks.
    lags = np.arange(-far, far + 1)
    near = level[np.ix_(lags, lags)]
    cells = max(1.0, near.size * 12 * float(np.sqrt(max(np.linalg.det(spectrum), 0.0))) * spacing_m**2)
    if looks < _LEAST_LOOKS or near.max() ** 2 <= 1 - (_BY_CHANCE / cells) ** (1 / (looks - 1)):
        return None
    # Shift: lag of the maximum, interpolated between pixels. Phase: at lag 0, the same point of the terrain.
    down, right = (lags[int(at)] for at in np.unravel_index(int(near.argmax()), near.shape))
    shift = spacing_m * np.array([_between_lags(level[down], right), -_between_lags(level[:, right], down)])
    at_zero_lag = complex((patches[1] * patches[0].conj()).sum()) / scale
    unit = 2 * np.pi * np.linalg.cholesky(spectrum)
    shift_std, phase_std = (_std_of_looks(size, looks) for size in (float(near.max()), abs(at_zero_lag)))
    return Agreement(
        by="looks",
        points=round(looks),
        shift_east_m=float(shift[0]),
        shift_north_m=float(shift[1]),
        shift_std_m=float(shift_std * np.sqrt(np.trace(np.linalg.inv(unit @ unit.T)) / 2)),
        shift_units=float(np.linalg.norm(shift @ unit)),
        shift_std_units=shift_std,
        cycles=0.0,
        cycles_std=0.0,
        phase_rad=float(np.angle(at_zero_lag)),
        phase_std_rad=phase_std,
        coherence=float(near.max()),
    )


def _brightest(images: tuple[BlockRaster, BlockRaster], windows: Iterable[Window]) -> list[Window]:
    """Return the windows of the brightest patches in both images, at most `_MOST_PATCHES`."""
    patches: list[tuple[float, Window]] = []
    for rows, columns in windows:
        levels = np.prod([np.abs(np.nan_to_num(np.asarray(image[rows, columns]))) for image in images], axis=0)
        for top, left in product(range(0, levels.shape[0], PATCH_PX), range(0, levels.shape[1], PATCH_PX)):
            part = levels[top : top + PATCH_PX, left : left + PATCH_PX]
            down, right = rows.start + top, columns.start + left
            window = slice(down, down + part.shape[0]), slice(right, right + part.shape[1])
            patches.append((float(part.sum()), window))
    patches.sort(key=lambda patch: -patch[0])
    return [window for level, window in patches[:_MOST_PATCHES] if level > 0]


def _read(image: BlockRaster, window: Window) -> NDArray[np.complex128]:
    """Return a patch of shape (`PATCH_PX`, `PATCH_PX`), zero outside the window."""
    patch = np.zeros((PATCH_PX, PATCH_PX), np.complex128)
    block = np.nan_to_num(np.asarray(image[window]))
    patch[: block.shape[0], : block.shape[1]] = block
    return patch


def _looks(
    first: NDArray[np.complex128],
    second: NDArray[np.complex128],
    size: NDArray[np.float64],
    powers: NDArray[np.float64],
) -> float:
    """Return the number of independent samples: the number of resolution cells, or less if power is concentrated."""
    by_band = powers.prod() * first[0].size * PATCH_PX**2 / (np.abs(first) ** 2 * np.abs(second) ** 2).sum()
    joint = size.prod(axis=0)
    by_power = 2 * by_band * joint.sum() ** 2 / (np.count_nonzero(joint) * (joint**2).sum())
    return float(min(by_band, by_power))


def _between_lags(level: NDArray[np.float64], best: int) -> float:
    """Return the position of a maximum between lags, interpolated by a parabola."""
    before, at, after = (level[(best + step) % len(level)] for step in (-1, 0, 1))
    bend = before - 2 * at + after
    return float(best + (0.5 * (before - after) / bend if bend else 0.0))


def _std_of_looks(coherence: float, looks: float) -> float:
    """Return the standard deviation of a phase, radians, or of a shift along an axis, units of eq. 6."""
    square = max((looks * coherence**2 - 1) / (looks - 1), 1e-6)  # bias of the squared coherence removed
    return float(min(_MARGIN * np.sqrt(max(1 - square, 0.0) / (2 * looks * square)), np.pi / np.sqrt(3)))
