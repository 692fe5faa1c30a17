"""Measures of what several images of one scene add up to."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.quality.bright_points import BrightPoint
from apertura.quality.measures import Raster, coherence_factor
from apertura.quality.point_targets import Patch


@dataclass(frozen=True)
class Amplitude:
    """A raster of power as complex amplitudes without phase, block by block.

    Attributes
    ----------
    power
        (y, x) float32, linear.

    Examples
    --------
    >>> Amplitude(np.array([[4.0, 9.0]], np.float32))[0:1, 1:2]
    array([[3.+0.j]], dtype=complex64)
    """

    power: Raster

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows, columns."""
        return self.power.shape

    def __getitem__(self, window: tuple[slice, slice]) -> NDArray[np.complex64]:
        power: NDArray[Any] = np.asarray(self.power[window])
        return np.asarray(np.sqrt(power), np.complex64)


def coherence_between(
    images: Sequence[Raster], phases_rad: NDArray[np.float64], points: Sequence[BrightPoint]
) -> float:
    """Return how well images agree in phase at bright points: 1 in phase, 1 over their number by chance.

    Parameters
    ----------
    images
        (y, x) complex64 on one grid, carriers kept.
    phases_rad
        (image,) float64, taken off each.
    points
        Where; all count alike.

    Notes
    -----
    Source: docs/theory.md, eq. 7. Amplitudes are taken off: a sum's own maximum would choose where they agree.

    Examples
    --------
    >>> image = np.ones((64, 64), np.complex64)
    >>> coherence_between([image, -image], np.array([0.0, np.pi]), [BrightPoint(30.0, 31.0, 1.0)])
    1.0
    """
    found = []
    for point in points:
        at = round(point.row), round(point.column)
        values = np.array([complex(Patch(image, *at).at(point.row, point.column)) for image in images])
        found.append(coherence_factor(np.exp(1j * (np.angle(values) - phases_rad))))
    return float(np.mean(found))
