"""Agreement of two images of one scene: shift and phase of what they share, bright points or ground of many cells."""

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
"""Metres, largest shift between two images that is searched, or a dozen cells: more would match other points."""

WIDEST_PIXEL = 1.05
"""Pixel spacing in finest resolution cells at most: pixels of 1.13 cells of a flat band sample it critically."""

SHIFTED = 0.18
"""Shift of two images in units of eq. 6, a tenth of the resolution cell, above which, and beyond their uncertainty,
they show different places."""

OUT_OF_PHASE_RAD = 0.6
"""Radians: two images with this phase difference lose 0.4 dB when they are added."""

LEAST_COHERENCE = 0.5
"""Mean phasor over common points, 0 to 1: below it phases scatter too much for a constant phase to correct."""

LARGEST_PHASE_STD_RAD = 0.4
"""Radians: a phase less certain than this is not used; two images that much out of phase lose 0.2 dB."""

_MOST_PATCHES = 16  # of ground that are compared: the brightest
_LEAST_LOOKS = 12
"""Independent samples: with fewer the coherence of one flank of a response would count (eq. 6 of interferometry)."""
_BY_CHANCE = 0.001  # probability at which images with nothing in common are taken for coherent
_WIDER = (2.0, 4.0, 8.0)  # resolution cells: gates within which points that shift by different amounts are matched
_FEWEST_SPREAD = 3  # points: of two, a match of both within a wide gate may be chance
_FAR = 4.0  # deviations of a point from the median of all, beyond which it is another one
_MARGIN = 1.4  # on the bound of phase and place by looks: what ground scatters beyond it (eq. 8 of interferometry)

_HALF_CYCLE = 0.5  # turns of the carrier: a shift above is nearer to that of a path a wavelength off than to none
_POINT = 0.09  # in units of eq. 6: neighbours pull each peak by about half a tenth of a cell
_POINT_RAD = 0.05  # neighbours turn the phase of a peak by about as much


@dataclass(frozen=True)
class Agreement:
    """Differences of a second image from a first: shift and phase, second less first.

    Attributes
    ----------
    by
        'bright points', or 'looks' of ground that is no point: independent samples of patches.
    points
        How many of these are common.
    shift_east_m, shift_north_m, shift_std_m
        Mean over the points, and its standard deviation along one axis, metres.
    shift_units, shift_std_units
        The same in units of eq. 6, in which a resolution cell is about 1.8 in every direction.
    cycles, cycles_std
        The shift in turns of the carrier, along which a path error shifts a point: as long as it is below one half,
        the phase tells that error whole; 0 by looks.
    phase_rad, phase_std_rad
        Mean over the points, and its standard deviation.
    coherence
        Length of the mean phasor of points: 1 where all have the same phase, 1/√points by chance; of patches the
        coherence of their common band.
    spread
        Whether points are shifted by amounts that differ by more than a resolution cell.
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
        """Number of bright points or looks in common, in words."""
        return number_of(self.points, "bright point" if self.by == "bright points" else "look")

    @property
    def shift_m(self) -> float:
        """Distance between the images of a point, metres."""
        return float(np.hypot(self.shift_east_m, self.shift_north_m))

    @property
    def shift_std_along_m(self) -> float:
        """Standard deviation of the distance along the shift: a cell is not as long in every direction."""
        return self.shift_m * self.shift_std_units / self.shift_units if self.shift_units else self.shift_std_m

    @property
    def shifted(self) -> bool:
        """True if the images show different places, by more than the uncertainty of their points."""
        return self.spread or self.shift_units > SHIFTED + 3 * self.shift_std_units or self.cycle_off

    @property
    def cycle_off(self) -> bool:
        """True if the shift is one that a path wrong by a whole wavelength makes: the phase then shows nothing."""
        return self.shift_units > SHIFTED and abs(self.cycles) > max(_HALF_CYCLE, 3 * self.cycles_std)

    @property
    def certain(self) -> bool:
        """True if the phase is known well enough to be used."""
        return self.phase_std_rad < LARGEST_PHASE_STD_RAD

    @property
    def incoherent(self) -> bool:
        """True if bright points have no common phase; that of patches is significant where it is measured at all."""
        return self.by == "bright points" and self.coherence < LEAST_COHERENCE

    @property
    def out_of_phase(self) -> bool:
        """True if adding the images would lose power, by more than the uncertainty of their phase."""
        return self.certain and abs(self.phase_rad) > OUT_OF_PHASE_RAD + 2 * self.phase_std_rad

    @property
    def alignable(self) -> bool:
        """True if a constant phase would bring the second image into phase with the first."""
        return self.certain and not self.shifted and not self.incoherent

    @property
    def reversed(self) -> "Agreement":
        """The differences of the first image from the second."""
        turned = ("shift_east_m", "shift_north_m", "cycles", "phase_rad")
        return replace(self, **{name: -getattr(self, name) for name in turned})


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
    """Return the agreement of two images by bright points; None where these are not the same.

    Fewer than two in common, or than half of either's, are no evidence, but for the brightest of both in one cell.

    Parameters
    ----------
    images
        (y, x) complex64 on one grid, carriers kept, row 0 in the north.
    points
        Isolated bright points of each, with their carriers.
    spacing_m
        Pixel spacing.
    cell_m
        Finest resolution cell: points of both this near to each other, after a common shift, are one.
    spectrum
        (2, 2) float64, covariance of a point's spatial spectrum east and north, cycles² per m².
    alone
        Neither image has another bright point: one point of each is then enough wherever they lie.

    Notes
    -----
    Source: docs/theory/focus.md, "Pairs". The phase is taken halfway between both peaks: at the peaks themselves it
    would turn with the carrier by the little that noise and neighbours move them.

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
    # Points of both that are the same, the shift from first to second, and both images halfway between their peaks.
    lists = [[(point.column * spacing_m, -point.row * spacing_m, point.amplitude) for point in some] for some in points]
    matched, spread = _common_points(lists, cell_m, alone=alone)
    if not matched:
        return None
    shifts = np.array([np.subtract(lists[1][j][:2], lists[0][i][:2]) for i, j in matched])
    values = np.array([_between(images, points[0][i], points[1][j]) for i, j in matched])
    background = np.array([points[0][i].background + points[1][j].background for i, j in matched])
    unit = np.asarray(2 * np.pi * np.linalg.cholesky(spectrum), np.float64)  # metres to units of eq. 6
    carriers = np.array([[_carrier(points[0][i]), _carrier(points[1][j])] for i, j in matched]) / spacing_m
    # Both peaks scatter by ε/2 in units squared along an axis, and by neighbours; the phase of each by ε/2 rad². Where
    # the carriers differ, the phase between them turns with the place halfway, which scatters a quarter as much.
    differ = np.diff(carriers, axis=1)[:, 0]
    slope = np.einsum("pi,ij,pj->p", differ, np.linalg.inv(spectrum), differ)
    place, turn = background / 2 + _POINT**2, background / 2 * (1 + slope / 4) + _POINT_RAD**2
    # Mean shift and mean phasor, weighted by the inverse of these variances.
    shift, std = _weighted_place(shifts, place, unit)
    along = carriers.mean(axis=(0, 1))
    phasors = np.exp(1j * np.angle(values[:, 1] * values[:, 0].conj()))
    phasor = complex((phasors / turn).sum() / (1 / turn).sum())
    scatter = _excess(np.abs(np.angle(phasors / phasor))[:, None] / np.sqrt(turn)[:, None], turn)
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
        phase_std_rad=float(scatter / np.sqrt((1 / turn).sum())),
        coherence=float(abs(phasor)),
        spread=spread,
    )


def _common_points(
    lists: Sequence[Sequence[tuple[float, float, float]]], cell_m: float, *, alone: bool
) -> tuple[list[tuple[int, int]], bool]:
    """Return the points that two images have in common, and whether they lie apart by shifts that differ.

    Within one cell of a common shift half of the points of either image are evidence; so is the brightest of both in
    one cell. Heights, courses and drifts shift points by different amounts: within wider gates points are the same
    where chance does not bring about as many matches.
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
    """Return a bound on the probability that so many points match under some shift though images share none.

    Shifts within reach that differ by a gate are tried; under each, a point finds another within the gate with the
    probability p that the points of the denser image cover of the area that its points lie in (binomial distribution).
    """
    fewer, more = sorted(lists, key=len)
    place = np.array([point[:2] for point in more])
    width, height = np.ptp(place, axis=0) + 2 * gate
    covered = min(1.0, len(more) * np.pi * gate**2 / (width * height))
    trials = len(fewer) * len(more)  # each pair of points gives a shift, under which it matches itself
    at_least = sum(
        comb(len(fewer) - 1, count) * covered**count * (1 - covered) ** (len(fewer) - 1 - count)
        for count in range(matches - 1, len(fewer))
    )
    return float(min(trials, (reach / gate) ** 2 * np.pi) * at_least)


def _brightest_of_both(lists: Sequence[Sequence[tuple[float, float, float]]], cell_m: float) -> list[tuple[int, int]]:
    """Return the brightest point of each of two images if both lie in one cell, which chance does not bring about."""
    if not all(lists):
        return []
    i, j = (int(np.argmax([amplitude for _, _, amplitude in some])) for some in lists)
    return [(i, j)] if np.hypot(*np.subtract(lists[1][j][:2], lists[0][i][:2])) <= cell_m else []


def _weighted_place(
    shifts: NDArray[np.float64], variance: NDArray[np.float64], unit: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Return the mean of (point, 2) shifts, metres, and its deviation along an axis, units of eq. 6.

    The variances told, of each point in units, are a lower bound: points that scatter more say so themselves. Points
    that lie far from the median are other points that happen to be near.
    """
    middle = np.array([weighted_median(along, 1 / variance) for along in shifts.T])
    off = np.abs((shifts - middle) @ unit) / np.sqrt(variance)[:, None]
    excess = _excess(off, variance)
    weight = np.where((off < _FAR * excess).all(axis=1), 1 / variance, 0.0)
    return np.average(shifts, axis=0, weights=weight), excess / float(np.sqrt(weight.sum()))


def _excess(off: NDArray[np.float64], variance: NDArray[np.float64]) -> float:
    """Return by what factor points scatter more than their variances tell, 1 or more; `off` (point, axis), deviations.

    By the weighted median: a weak point that is a sidelobe in one image does not make the bright ones uncertain.
    """
    weights = np.repeat(1 / variance, off.shape[1])
    return max(1.0, 1.4826 * weighted_median(off.ravel(), weights)) if len(off) > 1 else 1.0


def _carrier(point: BrightPoint) -> tuple[float, float]:
    """Return the carrier of a point, cycles per pixel east and north; zero if it is not told."""
    return (0.0, 0.0) if point.carrier is None else (point.carrier[1], -point.carrier[0])


def _between(images: tuple[BlockRaster, BlockRaster], first: BrightPoint, second: BrightPoint) -> list[complex]:
    """Return both images halfway between their peaks."""
    row, column = (first.row + second.row) / 2, (first.column + second.column) / 2
    return [
        complex(BandLimitedPatch(image, round(row), round(column), point.carrier).at(row, column))
        for image, point in zip(images, (first, second), strict=True)
    ]


# ---- By ground of many cells, in the band that both images have


def agreement_of_ground(
    images: tuple[BlockRaster, BlockRaster],
    windows: Iterable[Window],
    *,
    spacing_m: float,
    cell_m: float,
    spectrum: NDArray[np.float64],
) -> Agreement | None:
    """Return the agreement of two images by their brightest patches; None where these have nothing in common.

    Parameters
    ----------
    images
        (y, x) complex64 on one grid, carriers kept; NaN counts as zero.
    windows
        Windows that cover it once.
    spacing_m, cell_m, spectrum
        As of `agreement`.

    Notes
    -----
    Source: docs/theory/fusion.md, eq. 6. Spatial frequencies that one image alone holds add nothing, so neither
    carrier has to be taken off; the phase is that at one place of the ground, as by points.

    Examples
    --------
    >>> generator = np.random.default_rng(1)
    >>> ground = generator.normal(size=(64, 64)) + 1j * generator.normal(size=(64, 64))
    >>> other = 1j * (ground + 0.5 * generator.normal(size=(64, 64)))
    >>> whole, where = [(slice(0, 64), slice(0, 64))], {"spacing_m": 1.0, "cell_m": 1.0, "spectrum": np.eye(2) / 12}
    >>> told = agreement_of_ground((ground, other), whole, **where)
    >>> round(told.coherence, 1), round(told.phase_rad, 1), told.shift_m < 0.1
    (0.9, 1.6, True)
    >>> agreement_of_ground((ground, generator.normal(size=(64, 64))), whole, **where) is None
    True
    """
    places = _brightest(images, windows)
    patches = np.array([[_read(image, where) for where in places] for image in images])
    powers = (np.abs(patches) ** 2).sum(axis=(1, 2, 3)) if patches.size else np.zeros(2)
    if not powers.all():
        return None
    first, second = np.fft.fft2(patches, (2 * PATCH_PX,) * 2)  # padded: no correlation around the edges
    scale = float(np.sqrt(powers.prod()))
    looks = _looks(first, second, np.abs(patches), powers)
    level = np.abs(np.fft.ifft2((second * first.conj()).sum(axis=0))) / scale  # |R| of eq. 6
    far = max(2, min(PATCH_PX // 2, int(max(REACH_M, 12 * cell_m) / spacing_m)))
    # Its maximum within reach, if chance does not make it: |R|² > 1 − (0.001/n)^{1/(L−1)} of n cells and L looks.
    lags = np.arange(-far, far + 1)
    near = level[np.ix_(lags, lags)]
    cells = max(1.0, near.size * 12 * float(np.sqrt(max(np.linalg.det(spectrum), 0.0))) * spacing_m**2)
    if looks < _LEAST_LOOKS or near.max() ** 2 <= 1 - (_BY_CHANCE / cells) ** (1 / (looks - 1)):
        return None
    # Shift by the lag of the maximum, to a fraction of a pixel; phase at lag 0, one place of the ground.
    down, right = (lags[int(at)] for at in np.unravel_index(int(near.argmax()), near.shape))
    shift = spacing_m * np.array([_between_lags(level[down], right), -_between_lags(level[:, right], down)])
    together = complex((patches[1] * patches[0].conj()).sum()) / scale
    unit = 2 * np.pi * np.linalg.cholesky(spectrum)
    place_std, phase_std = (_std_of_looks(size, looks) for size in (float(near.max()), abs(together)))
    return Agreement(
        by="looks",
        points=round(looks),
        shift_east_m=float(shift[0]),
        shift_north_m=float(shift[1]),
        shift_std_m=float(place_std * np.sqrt(np.trace(np.linalg.inv(unit @ unit.T)) / 2)),
        shift_units=float(np.linalg.norm(shift @ unit)),
        shift_std_units=place_std,
        cycles=0.0,
        cycles_std=0.0,
        phase_rad=float(np.angle(together)),
        phase_std_rad=phase_std,
        coherence=float(near.max()),
    )


def _brightest(images: tuple[BlockRaster, BlockRaster], windows: Iterable[Window]) -> list[Window]:
    """Return the patches that are brightest in both images, at most `_MOST_PATCHES`."""
    found: list[tuple[float, Window]] = []
    for rows, columns in windows:
        levels = np.prod([np.abs(np.nan_to_num(np.asarray(image[rows, columns]))) for image in images], axis=0)
        for top, left in product(range(0, levels.shape[0], PATCH_PX), range(0, levels.shape[1], PATCH_PX)):
            part = levels[top : top + PATCH_PX, left : left + PATCH_PX]
            down, right = rows.start + top, columns.start + left
            found.append((float(part.sum()), (slice(down, down + part.shape[0]), slice(right, right + part.shape[1]))))
    found.sort(key=lambda one: -one[0])
    return [where for level, where in found[:_MOST_PATCHES] if level > 0]


def _read(image: BlockRaster, where: Window) -> NDArray[np.complex128]:
    """Return a patch of (`PATCH_PX`, `PATCH_PX`), zero beyond its window."""
    patch = np.zeros((PATCH_PX, PATCH_PX), np.complex128)
    block = np.nan_to_num(np.asarray(image[where]))
    patch[: block.shape[0], : block.shape[1]] = block
    return patch


def _looks(
    first: NDArray[np.complex128],
    second: NDArray[np.complex128],
    size: NDArray[np.float64],
    powers: NDArray[np.float64],
) -> float:
    """Return independent samples of patches: cells that their power is spread over, fewer where few pixels hold it."""
    by_band = powers.prod() * first[0].size * PATCH_PX**2 / (np.abs(first) ** 2 * np.abs(second) ** 2).sum()
    together = size.prod(axis=0)
    by_power = 2 * by_band * together.sum() ** 2 / (np.count_nonzero(together) * (together**2).sum())
    return float(min(by_band, by_power))


def _between_lags(level: NDArray[np.float64], best: int) -> float:
    """Return the place of a maximum between lags, by a parabola."""
    before, at, after = (level[(best + step) % len(level)] for step in (-1, 0, 1))
    bend = before - 2 * at + after
    return float(best + (0.5 * (before - after) / bend if bend else 0.0))


def _std_of_looks(coherence: float, looks: float) -> float:
    """Return the deviation of a phase, radians, and of a place along an axis, units of eq. 6."""
    square = max((looks * coherence**2 - 1) / (looks - 1), 1e-6)  # without what chance adds
    return float(min(_MARGIN * np.sqrt(max(1 - square, 0.0) / (2 * looks * square)), np.pi / np.sqrt(3)))
