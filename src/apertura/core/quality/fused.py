"""Measures of what several images of one scene add up to."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.core.quality.measures import Raster


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
