"""Gate of the recorded total paths: weight of each pulse at each pixel by the end of its recording."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.aperture import Aperture

EDGE_CELLS = 8.0
"""Width of the edge of a gate, resolution cells v/B of total path: four times the half width of the main lobe with a
Hann window, so that the gated profile remains within twice the band (docs/theory/integration.md, eq. 6)."""


@dataclass(frozen=True, eq=False)
class RangeGate:
    """Weight of a pulse by total path: 1 up to an edge before the recorded limit, 0 from the limit on.

    Attributes
    ----------
    limit_m
        (pulse,) float64, longest total path whose echo is recorded completely, metres.
    edge_m
        Width of the edge, metres of total path.

    Notes
    -----
    Source: docs/theory/integration.md, eq. 6.

    Examples
    --------
    >>> gate = RangeGate(np.array([100.0, 90.0]), 10.0)
    >>> gate.at(np.array([[85.0, 90.0, 95.0, 100.0]])).round(2) + 0.0
    array([[1. , 1. , 0.5, 0. ],
           [0.5, 0. , 0. , 0. ]])
    """

    limit_m: NDArray[np.float64]
    edge_m: float

    def __getitem__(self, pulses: slice | NDArray[np.int64]) -> "RangeGate":
        """Return the gate of the selected pulses."""
        return replace(self, limit_m=self.limit_m[pulses])

    def moved(self, extra_path_m: NDArray[np.float64]) -> "RangeGate":
        """Return the gate of echoes with paths longer by `extra_path_m`, (pulse,) metres, as `Profiles.moved`."""
        return replace(self, limit_m=self.limit_m + extra_path_m)

    def at(self, path_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weight at total paths (pulse or 1, ...), 0 to 1."""
        depth = (self.limit_m.reshape(-1, *(1,) * (path_m.ndim - 1)) - path_m) / self.edge_m
        z = np.clip(depth, 0.0, 1.0)
        return np.asarray(z**4 * (35 - 84 * z + 70 * z**2 - 20 * z**3))

    def weight(self, aperture: Aperture, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weight of each pulse at points (point, 3) in metres, (pulse, point) float64."""
        return self.at(aperture.path(points_m))
