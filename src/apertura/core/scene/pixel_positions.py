"""Where the pixels of a projected grid are: PROJ at a few nodes of each block, polynomials in between.

PROJ takes as long for a pixel as the sum of hundreds of pulses; Earth is so smooth that over a block of pixels
polynomials of degree four are as exact as float64 holds positions (docs/theory/planner.md, "Pixel positions").
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.geodesy import ecef_from_projected

BLOCK_PX = 256

DEGREE = 4

TOLERANCE_M = 3e-8
"""Blocks whose polynomials miss PROJ by more than this between the nodes are placed by PROJ, pixel by pixel."""

_CLIMB_M = 1e4  # ECEF is exactly linear in ellipsoidal height: positions at two heights tell all
_NODES = np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
_BETWEEN = np.array([-1.0, -0.5, 0.45, 1.0])


@dataclass(frozen=True, eq=False)
class Block:
    """Polynomials of the positions of BLOCK_PX × BLOCK_PX pixels over -1 ≤ u, v ≤ 1 down and right.

    Attributes
    ----------
    middle_m
        (3,) float64, ECEF metres, on the ellipsoid.
    offset_m, normal
        (DEGREE + 1, DEGREE + 1, 3) float64, coefficient of u^k v^l: ECEF metres from the middle, on the ellipsoid; and
        change per metre of height.
    exact
        Whether they are within `TOLERANCE_M` of PROJ.
    """

    middle_m: NDArray[np.float64]
    offset_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    exact: bool

    def positions(
        self, row: NDArray[np.int64], column: NDArray[np.int64], height_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return (row, column, 3) float64 ECEF metres.

        Parameters
        ----------
        row, column
            (row,) and (column,) int64, counted from the block's corner.
        height_m
            () or (row, column) float64, ellipsoidal height of all pixels or of each.
        """
        down, right = ((2 * index + 1) / BLOCK_PX - 1 for index in (row, column))
        if height_m.ndim == 0:  # one height: one polynomial
            return _evaluated(self.offset_m + height_m * self.normal, down, right) + self.middle_m
        offset = _evaluated(self.offset_m, down, right)
        offset += height_m[..., None] * _evaluated(self.normal, down, right)
        return offset + self.middle_m


@lru_cache(maxsize=4096)
def block(crs: str, north_west_m: tuple[float, float], spacing_m: float, index: tuple[int, int]) -> Block:
    """Return the polynomials of a block of a grid.

    Parameters
    ----------
    crs
        Projected, in metres.
    north_west_m
        Northing and easting of the grid's outer corner.
    spacing_m
        Of its pixels.
    index
        Row and column of the block in the grid.

    Examples
    --------
    >>> corner = block("EPSG:32632", (5e6, 5e5), 0.5, (0, 0))
    >>> corner.exact, corner.positions(np.arange(2), np.arange(3), np.array(100.0)).shape
    (True, (2, 3, 3))
    """
    side_m = BLOCK_PX * spacing_m
    north_m, west_m = north_west_m[0] - index[0] * side_m, north_west_m[1] + index[1] * side_m

    def proj(nodes: NDArray[np.float64], height: float) -> NDArray[np.float64]:
        down, right = np.meshgrid((nodes + 1) * side_m / 2, (nodes + 1) * side_m / 2, indexing="ij")
        return ecef_from_projected(crs, west_m + right, north_m - down, np.full(down.shape, height))

    ground, above = proj(_NODES, 0.0), proj(_NODES, _CLIMB_M)
    middle_m = ground[DEGREE // 2, DEGREE // 2]
    inverse = np.linalg.inv(np.vander(_NODES, increasing=True))
    offset, normal = (
        np.einsum("ki,lj,ijc->klc", inverse, inverse, values)
        for values in (ground - middle_m, (above - ground) / _CLIMB_M)
    )
    between = _evaluated(offset, _BETWEEN, _BETWEEN) + middle_m
    worst = np.abs(between - proj(_BETWEEN, 0.0)).max()
    return Block(middle_m, offset, normal, bool(worst < TOLERANCE_M))


def _evaluated(
    coefficients: NDArray[np.float64], down: NDArray[np.float64], right: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return Σ c_kl u^k v^l by Horner's rule, element by element: the same bits whatever the window."""
    along = coefficients[:, -1, None]
    for power in range(DEGREE - 1, -1, -1):
        along = along * right[:, None] + coefficients[:, power, None]
    total = np.broadcast_to(along[-1], (len(down), *along[-1].shape))
    for power in range(DEGREE - 1, -1, -1):
        total = total * down[:, None, None] + along[power]
    return total
