"""Measures of what several images of one scene add up to."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.quality.measures import Raster, coherence_factor
from apertura.quality.point_targets import Patch, Peak


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


def coherence_of_images(
    images: Sequence[Raster], amplitudes: Sequence[float], pixel: tuple[int, int], peak: Peak
) -> float:
    """Return the coherence factor of what each image contributes to a peak of their sum: 1 in phase, 1/M at random.

    Parameters
    ----------
    images
        (y, x) complex64 on one grid, carriers kept.
    amplitudes
        By which each is divided before it is added, its largest magnitude.
    pixel
        Row and column of the brightest pixel of the sum.
    peak
        The peak beside it.

    Notes
    -----
    Source: docs/theory.md, eq. 7.
    """
    values = [
        complex(Patch(image, *pixel).at(peak.row, peak.column)) / amplitude
        for image, amplitude in zip(images, amplitudes, strict=True)
    ]
    return coherence_factor(np.array(values))
