"""What two images of one scene say of each other: place, phase and amplitude of the bright points they share."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.quality.bright_points import BrightPoint, common_shift
from apertura.quality.measures import Raster
from apertura.quality.point_targets import Patch

REACH_M = 4.0
"""Shifts between two images up to this, or a dozen cells, are looked for."""

SHIFTED_CELLS = 0.1
"""Images further apart than this, in resolution cells, and than their uncertainty allows, are of different places."""

OUT_OF_PHASE_RAD = 0.8
"""Two images so far apart in phase lose 0.7 dB when they are added."""

_POINT_CELLS = 0.05  # neighbours pull each peak about so far
_POINT_RAD = 0.05


@dataclass(frozen=True)
class Agreement:
    """How a second image lies against a first; place and phase are of the second less the first.

    Attributes
    ----------
    points
        Bright points that both show.
    shift_east_m, shift_north_m, shift_std_m
        Median over the points, and its standard deviation along one axis, metres.
    phase_rad, phase_std_rad
        Mean over the points, and its standard deviation.
    coherence
        Length of the mean phasor: 1 where all points say the same phase, 1/√points by chance.
    amplitude_db, amplitude_std_db
        Mean ratio of amplitudes, and how much it scatters from point to point.
    """

    points: int
    shift_east_m: float
    shift_north_m: float
    shift_std_m: float
    phase_rad: float
    phase_std_rad: float
    coherence: float
    amplitude_db: float
    amplitude_std_db: float

    @property
    def shift_m(self) -> float:
        """Distance between both images of a point."""
        return float(np.hypot(self.shift_east_m, self.shift_north_m))

    def shifted(self, cell_m: float) -> bool:
        """Return whether the images are of different places, as far as their points can tell."""
        return self.shift_m > SHIFTED_CELLS * cell_m + 3 * self.shift_std_m

    @property
    def out_of_phase(self) -> bool:
        """Whether adding the images would lose power, as far as their points can tell."""
        return abs(self.phase_rad) > OUT_OF_PHASE_RAD + 2 * self.phase_std_rad


def agreement(
    images: tuple[Raster, Raster],
    points: tuple[Sequence[BrightPoint], Sequence[BrightPoint]],
    *,
    spacing_m: float,
    cell_m: float,
) -> Agreement | None:
    """Return how two images agree; None where they share no bright point.

    Parameters
    ----------
    images
        (y, x) complex64 on one grid, carriers kept, row 0 in the north.
    points
        Bright points of each that dominate their cells.
    spacing_m
        Pixel spacing.
    cell_m
        Resolution cell, to which places are told to a tenth.

    Notes
    -----
    Source: docs/theory/focus.md, "Pairs". The phase is taken halfway between both peaks: at the peaks themselves it
    would turn with the carrier by the little that noise and neighbours move them.

    Examples
    --------
    >>> y, x = np.mgrid[:64, :64]
    >>> image = (np.sinc((y - 30) / 4) * np.sinc((x - 33) / 4)).astype(np.complex64)
    >>> point = [BrightPoint(30.0, 33.0, 1.0)]
    >>> found = agreement((image, 1j * image), (point, point), spacing_m=0.1, cell_m=0.4)
    >>> round(found.shift_m, 3), round(found.phase_rad, 3), found.out_of_phase
    (0.0, 1.571, True)
    """
    lists = [[(point.column * spacing_m, -point.row * spacing_m, point.amplitude) for point in some] for some in points]
    reach = max(REACH_M, 12 * cell_m)
    _, met = common_shift(lists[0], lists[1], reach=reach, gate=cell_m)
    if not met:
        return None
    apart = np.array([np.subtract(lists[1][j][:2], lists[0][i][:2]) for i, j in met])
    values = np.array([_between(images, points[0][i], points[1][j]) for i, j in met])
    shift, count = np.median(apart, axis=0), len(met)
    spread = 1.4826 * float(np.median(np.abs(apart - shift)))
    phasor = _mean_phasor(values)
    ratio_db = 20 * np.log10([points[1][j].amplitude / points[0][i].amplitude for i, j in met])
    return Agreement(
        points=count,
        shift_east_m=float(shift[0]),
        shift_north_m=float(shift[1]),
        shift_std_m=float(np.hypot(1.2533 * spread, _POINT_CELLS * cell_m) / np.sqrt(count)),
        phase_rad=float(np.angle(phasor)),
        phase_std_rad=float(np.hypot(np.sqrt(2 * max(0.0, 1 - abs(phasor))), _POINT_RAD) / np.sqrt(count)),
        coherence=float(abs(phasor)),
        amplitude_db=float(np.mean(ratio_db)),
        amplitude_std_db=float(np.std(ratio_db)),
    )


def _between(images: tuple[Raster, Raster], first: BrightPoint, second: BrightPoint) -> list[complex]:
    """Return both images halfway between their peaks."""
    row, column = (first.row + second.row) / 2, (first.column + second.column) / 2
    return [complex(Patch(image, round(row), round(column)).at(row, column)) for image in images]


def _mean_phasor(values: NDArray[np.complex128]) -> complex:
    """Return the mean phasor of the second against the first over points, weighted by the weaker's amplitude."""
    product = values[:, 1] * values[:, 0].conj()
    weight = np.abs(values / np.abs(values).max(axis=0)).min(axis=1)
    return complex((weight * np.exp(1j * np.angle(product))).sum() / weight.sum())
