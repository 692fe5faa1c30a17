"""Resolution of an image at each place, from the spatial spectrum that its pulses and its band sample there."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.contracts import Window
from apertura.core.antenna.beam import Beams
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.radiometry import point_weights
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.looks import Lattice, fill, pitch_px, pulses_of
from apertura.core.scene.terrain import Terrain

_ORDER = 4  # of moments: width by the second, the shape of the spectrum by the fourth
_ORDERS = [(east, total - east) for total in range(_ORDER + 1) for east in range(total + 1)]
_RANGE_SHARE = 24  # as of the calibration: the same weights change from node to node
_PULSES = 128  # summed for a block of the lattice, or up to twice as many
_HALF_POWER = np.log(2) / 2  # of -ln|p| where |p|² is one half
_LEAST_SPREAD = 1e-12  # of a spectrum's second moment, cycles² per m²: no aperture at all


@dataclass(frozen=True, eq=False)
class Resolution:
    """Moments of the spatial spectrum of each place, from which widths of a point follow in any direction.

    Attributes
    ----------
    lattice
        Nodes at which the moments are computed.
    moments
        (node row, node column, moment) float64, cycles per metre to their power, of the spectrum's density along
        eastward columns and northward rows on the ground; the first is 1, or 0 where no pulse sees the node.

    Notes
    -----
    Source: docs/theory/design.md, eq. 1 and 2.
    """

    lattice: Lattice
    moments: Floats

    @classmethod
    def of(
        cls,
        grid: SceneGrid,
        terrain: Terrain,
        aperture: Aperture,
        beams: Beams | None,
        *,
        frequency_hz: Floats,
        weight: Floats,
        threads: int = 1,
    ) -> "Resolution":
        """Return the resolution of a scene.

        Parameters
        ----------
        grid, terrain, aperture, beams
            As of `apertura.core.scene.looks.Looks`.
        frequency_hz, weight
            (subcarrier,) float64: RF frequencies, and the window over them.
        threads
            Blocks of the lattice in work at once.

        Examples
        --------
        A line of 20 m, 30 m away and as high: λR/2L across it, and along the ground c/2B over the sine of 45°, both
        times 0.886 of a flat spectrum.

        >>> from apertura.core.scene.terrain import FlatGround
        >>> along = np.linspace(-10, 10, 401)
        >>> track = np.stack([along, np.full(401, -30.0), np.full(401, 30.0)], -1)
        >>> band = 1.2e9 + np.linspace(-2e8, 2e8, 64)
        >>> grid = SceneGrid("local", -0.5, 0.5, 1.0, (1, 1))
        >>> found = Resolution.of(grid, FlatGround(0.0), Aperture(track, track), None, frequency_hz=band,
        ...                       weight=np.full(64, 1 / 64))
        >>> fine, coarse, azimuth = found.axes((slice(0, 1), slice(0, 1)))
        >>> fine.round(2), coarse.round(2), abs(azimuth).round(0)
        (array([[0.24]]), array([[0.47]]), array([[90.]]))
        """
        lattice = Lattice.of(grid.shape, pitch_px(grid, terrain, aperture, share=_RANGE_SHARE))
        moments = np.zeros((*lattice.shape, len(_ORDERS)))
        share = weight / weight.sum()
        of_band = [float((share * (frequency_hz / SPEED_OF_LIGHT_M_S) ** order).sum()) for order in range(_ORDER + 1)]

        def compute(block: Window, reaching: NDArray[np.bool_]) -> None:
            rows, columns = (at[part] for at, part in zip(lattice.nodes, block, strict=True))
            row, column = (one.ravel() for one in np.meshgrid(rows, columns, indexing="ij"))
            points = terrain.positions_at(grid, row, column)
            reached = pulses_of(reaching, len(aperture))
            some = slice(reached.start, reached.stop, max(1, (reached.stop - reached.start) // _PULSES))
            taken = aperture[some]
            parts, _ = point_weights(taken, beams and beams[some], points)
            density = np.abs(parts)
            total = density.sum(axis=0)
            density = density / np.maximum(total, 1e-300)
            gradient = taken.path_gradient(points)
            east, north = ((gradient * side).sum(axis=-1) for side in _sides(grid, terrain, row, column))
            found = [(density * east**a * north**b).sum(axis=0) * of_band[a + b] for a, b in _ORDERS]
            moments[block] = np.stack(found, axis=-1).reshape(len(rows), len(columns), -1)

        fill(lattice, compute, grid, terrain, aperture, beams, threads=threads)
        return cls(lattice, moments)

    @classmethod
    def summed(cls, images: Sequence["Resolution"]) -> "Resolution":
        """Return the resolution of the coherent sum of images of one grid, each of as much amplitude at a point.

        The spectra of pairs at different places lie side by side (docs/theory.md, eq. 7): their densities add.
        """
        nodes = max((image.lattice for image in images), key=lambda one: one.shape[0] * one.shape[1])
        total = np.zeros((*nodes.shape, len(_ORDERS)))
        for image in images:
            rows, columns = (slice(0, int(at[-1]) + 1) for at in nodes.nodes)
            same = image.lattice.shape == nodes.shape
            whole = image.moments if same else image.lattice.between(image.moments, (rows, columns))
            total += whole if same else whole[np.ix_(*nodes.nodes)]
        return cls(nodes, total / np.maximum(total[..., :1], 1e-300))

    def axes(self, window: Window) -> tuple[Floats, Floats, Floats]:
        """Return −3 dB widths of a point along the finest and the coarsest direction, and the azimuth of the finest.

        Parameters
        ----------
        window
            Of the grid.

        Returns
        -------
        tuple of ndarray
            (row, column) float64: metres, metres, and degrees clockwise from the grid's north, −90 to 90; NaN where no
            pulse sees the place, infinite along a direction that nothing resolves.
        """
        first, second = self._order(1), self._order(2)
        seen = self.moments[..., 0] > 0
        middle = first / np.where(seen, 1.0, np.nan)[..., None]
        north_north, north_east, east_east = np.moveaxis(second, -1, 0)
        spread = np.stack(
            [
                np.stack([east_east - middle[..., 1] ** 2, north_east - middle[..., 0] * middle[..., 1]], -1),
                np.stack([north_east - middle[..., 0] * middle[..., 1], north_north - middle[..., 0] ** 2], -1),
            ],
            -2,
        )
        known = np.isfinite(spread).all(axis=(-1, -2))
        _, vectors = np.linalg.eigh(np.where(known[..., None, None], spread, np.eye(2)))
        coarse_axis, fine_axis = vectors[..., 0], vectors[..., 1]
        widths = [self._width(axis) for axis in (fine_axis, coarse_axis)]
        # Azimuths jump from -90° to 90°: between nodes their double angle is what is smooth.
        doubled = np.stack(
            [fine_axis[..., 1] ** 2 - fine_axis[..., 0] ** 2, 2 * fine_axis[..., 0] * fine_axis[..., 1]], -1
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            smooth = [1 / self.lattice.between(1 / width, window) for width in widths]
        cosine, sine = np.moveaxis(self.lattice.between(doubled, window), -1, 0)
        return smooth[0], smooth[1], np.where(np.isfinite(smooth[0]), np.degrees(np.arctan2(sine, cosine)) / 2, np.nan)

    def along(self, direction: tuple[float, float], window: Window) -> Floats:
        """Return the −3 dB width of a point along (east, north), metres, (row, column); as `axes`."""
        axis = np.broadcast_to(np.array(direction) / np.hypot(*direction), (*self.lattice.shape, 2))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(1 / self.lattice.between(1 / self._width(axis), window))

    def look_azimuth_deg(self, window: Window) -> Floats:
        """Return the azimuth in which paths grow fastest on the ground, degrees clockwise from grid north."""
        north, east = np.moveaxis(self.lattice.between(self._order(1), window), -1, 0)
        return np.asarray(np.degrees(np.arctan2(east, north)))

    def _order(self, total: int) -> Floats:
        return self.moments[..., [number for number, (a, b) in enumerate(_ORDERS) if a + b == total]]

    def _width(self, axis: Floats) -> Floats:
        """Return −3 dB widths at the nodes along unit vectors (node row, node column, 2), metres."""
        east, north = axis[..., 0], axis[..., 1]
        raw = [
            sum(comb(total, a) * east**a * north ** (total - a) * self._order(total)[..., a] for a in range(total + 1))
            for total in range(_ORDER + 1)
        ]
        seen, mean = np.asarray(raw[0]) > 0, np.asarray(raw[1])
        variance = np.asarray(raw[2] - mean**2)
        fourth = np.asarray(raw[4] - 4 * mean * raw[3] + 6 * mean**2 * raw[2] - 3 * mean**4)
        excess = fourth / np.maximum(variance, _LEAST_SPREAD) ** 2 - 3
        # ln|p(x)| = −κ₂t²/2 + κ₄t⁴/24, t = 2πx: where that is −ln √2, in units of the spectrum's deviation
        root = 0.25 - np.minimum(excess, 1.0) * _HALF_POWER / 6
        square = 4 * _HALF_POWER / (1 + 2 * np.sqrt(np.maximum(root, 0.0)))
        width = np.sqrt(square) / (np.pi * np.sqrt(np.maximum(variance, 0.0)) + 1e-300)
        return np.where(seen, np.where(variance > _LEAST_SPREAD, width, np.inf), np.nan)


def _sides(
    grid: SceneGrid, terrain: Terrain, row: NDArray[np.int64], column: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Return how the ground moves per metre of the map eastward and northward, (point, 3) each."""
    sides = []
    for step, sign in (((0, 1), 1.0), ((1, 0), -1.0)):
        ends = [
            (np.clip(row + far * step[0], 0, grid.shape[0] - 1), np.clip(column + far * step[1], 0, grid.shape[1] - 1))
            for far in (-1, 1)
        ]
        apart = (ends[1][0] - ends[0][0]) + (ends[1][1] - ends[0][1])
        if grid.shape[step.index(1)] < 2:  # one row or column is continued level
            heights = terrain.heights_at(grid, row, column)
            ends = [(row + far * step[0], column + far * step[1]) for far in (-1, 1)]
            places = [grid.positions_at(*end, heights) for end in ends]
            apart = np.full(len(row), 2)
        else:
            places = [terrain.positions_at(grid, *end) for end in ends]
        sides.append(sign * (places[1] - places[0]) / (grid.spacing_m * apart)[:, None])
    return sides[0], sides[1]
