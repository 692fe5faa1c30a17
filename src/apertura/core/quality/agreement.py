"""Agreement of two images of one scene: shift, phase and amplitude of their common bright points."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.core.quality.bright_points import BrightPoint, common_shift
from apertura.core.quality.measures import BlockRaster
from apertura.core.quality.point_targets import BandLimitedPatch

REACH_M = 4.0
"""Metres, largest shift between two images that is searched, or a dozen cells: more would match other points."""

SHIFTED = 0.18
"""Shift of two images in units of eq. 6, a tenth of the resolution cell, above which, and beyond their uncertainty,
they show different places."""

OUT_OF_PHASE_RAD = 0.6
"""Radians: two images with this phase difference lose 0.4 dB when they are added."""

_POINT = 0.09  # in units of eq. 6: neighbours pull each peak by about half a tenth of a cell
_POINT_RAD = 0.05  # neighbours turn the phase of a peak by about as much
_LARGEST_PHASE_STD_RAD = 0.4  # a phase less certain than this is not used


@dataclass(frozen=True)
class Agreement:
    """Differences of a second image from a first: shift and phase, second less first.

    Attributes
    ----------
    points
        Number of common bright points.
    shift_east_m, shift_north_m, shift_std_m
        Median over the points, and its standard deviation along one axis, metres.
    shift_units, shift_std_units
        The same in units of eq. 6, in which a resolution cell is about 1.8 in every direction.
    phase_rad, phase_std_rad
        Mean over the points, and its standard deviation.
    coherence
        Length of the mean phasor: 1 where all points have the same phase, 1/√points by chance.
    amplitude_db, amplitude_std_db
        Mean ratio of amplitudes, and its scatter from point to point.
    """

    points: int
    shift_east_m: float
    shift_north_m: float
    shift_std_m: float
    shift_units: float
    shift_std_units: float
    phase_rad: float
    phase_std_rad: float
    coherence: float
    amplitude_db: float
    amplitude_std_db: float

    @property
    def shift_m(self) -> float:
        """Distance between the images of a point, metres."""
        return float(np.hypot(self.shift_east_m, self.shift_north_m))

    @property
    def shifted(self) -> bool:
        """Whether the images show different places, by more than the uncertainty of their points."""
        return self.shift_units > SHIFTED + 3 * self.shift_std_units

    @property
    def out_of_phase(self) -> bool:
        """Whether adding the images would lose power, by more than the uncertainty of their points."""
        certain = self.phase_std_rad < _LARGEST_PHASE_STD_RAD
        return certain and abs(self.phase_rad) > OUT_OF_PHASE_RAD + 2 * self.phase_std_rad


def agreement(
    images: tuple[BlockRaster, BlockRaster],
    points: tuple[Sequence[BrightPoint], Sequence[BrightPoint]],
    *,
    spacing_m: float,
    cell_m: float,
    spectrum: NDArray[np.float64],
    alone: bool = False,
) -> Agreement | None:
    """Return the agreement of two images; None where fewer than two bright points, or half of either's, are common.

    Parameters
    ----------
    images
        (y, x) complex64 on one grid, carriers kept, row 0 in the north.
    points
        Bright points of each that dominate their cells.
    spacing_m
        Pixel spacing.
    cell_m
        Finest resolution cell: points of both this near to each other, after a common shift, are one.
    spectrum
        (2, 2) float64, covariance of a point's spatial spectrum east and north, cycles² per m².
    alone
        Neither image has another bright point: one point of each is then enough.

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
    lists = [[(point.column * spacing_m, -point.row * spacing_m, point.amplitude) for point in some] for some in points]
    reach = max(REACH_M, 12 * cell_m)
    _, matched = common_shift(lists[0], lists[1], reach=reach, gate=cell_m)
    if len(matched) < max(1 if alone else 2, min(map(len, points)) / 2):
        return None
    shifts = np.array([np.subtract(lists[1][j][:2], lists[0][i][:2]) for i, j in matched])
    values = np.array([_between(images, points[0][i], points[1][j]) for i, j in matched])
    shift, count = np.median(shifts, axis=0), len(matched)
    unit = 2 * np.pi * np.linalg.cholesky(spectrum)  # metres to units of eq. 6
    units = (shifts - shift) @ unit
    background = float(np.median([points[0][i].background + points[1][j].background for i, j in matched])) / 2
    std = np.hypot(1.2533 * 1.4826 * np.median(np.abs(units)), np.sqrt(background / 2 + _POINT**2)) / np.sqrt(count)
    phasor = _mean_phasor(values)
    ratio_db = 20 * np.log10([points[1][j].amplitude / points[0][i].amplitude for i, j in matched])
    return Agreement(
        points=count,
        shift_east_m=float(shift[0]),
        shift_north_m=float(shift[1]),
        shift_std_m=float(std * np.sqrt(np.trace(np.linalg.inv(unit @ unit.T)) / 2)),
        shift_units=float(np.linalg.norm(shift @ unit)),
        shift_std_units=float(std),
        phase_rad=float(np.angle(phasor)),
        phase_std_rad=float(np.sqrt(2 * max(0.0, 1 - abs(phasor)) + background + _POINT_RAD**2) / np.sqrt(count)),
        coherence=float(abs(phasor)),
        amplitude_db=float(np.mean(ratio_db)),
        amplitude_std_db=float(np.std(ratio_db)),
    )


def _between(images: tuple[BlockRaster, BlockRaster], first: BrightPoint, second: BrightPoint) -> list[complex]:
    """Return both images halfway between their peaks."""
    row, column = (first.row + second.row) / 2, (first.column + second.column) / 2
    return [
        complex(BandLimitedPatch(image, round(row), round(column), point.carrier).at(row, column))
        for image, point in zip(images, (first, second), strict=True)
    ]


def _mean_phasor(values: NDArray[np.complex128]) -> complex:
    """Return the mean phasor of the second against the first over points, weighted by the weaker's power."""
    product = values[:, 1] * values[:, 0].conj()
    weight = np.abs(values / np.abs(values).max(axis=0)).min(axis=1) ** 2
    return complex((weight * np.exp(1j * np.angle(product))).sum() / weight.sum())
