"""Resolution of an image at each pixel, from the spatial spectrum sampled by its pulses and its band."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
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
from apertura.core.scene.looks import Lattice, fill, pulses_of
from apertura.core.scene.terrain import FlatGround, Terrain

_ORDER = 4  # highest order of moments: the second order yields the width of the spectrum, the fourth order its shape
_ORDERS = [(east, total - east) for total in range(_ORDER + 1) for east in range(total + 1)]
_PULSES = 128  # minimum number of pulses summed for a block of the lattice; the largest number is twice this number
_HALF_POWER = np.log(2) / 2  # -ln|p| where |p|² is one half
_UPRIGHT = 4  # moments that involve the vertical, needed on slopes
_LEAST_SPREAD = 1e-12  # cycles² per m²: a spectrum with a smaller second moment is treated as a single point


@dataclass(frozen=True, eq=False)
class Resolution:
    """Moments of the spatial spectrum on a lattice, from which the width of a point in any direction follows.

    Attributes
    ----------
    grid, terrain
        The scene.
    lattice
        Nodes at which the moments are computed.
    moments
        (node row, node column, moment) float64, moments of the spectral density, cycles per metre to the power of the
        order of the moment. First the moments of `_ORDERS` over level ground, eastward and northward, of which the
        first is 1, or 0 where no pulse illuminates the node. Then the moments that involve the vertical u: u, east·u,
        north·u and u².

    Notes
    -----
    Source: docs/theory/design.md, eq. 1 and 2.
    """

    grid: SceneGrid
    terrain: Terrain
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
        """Compute the resolution of a scene.

        Parameters
        ----------
        grid, terrain, aperture, beams
            As for `apertura.core.scene.looks.Looks`.
        frequency_hz, weight
            (subcarrier,) float64: RF frequencies, and the window over them.
        threads
            Number of lattice blocks computed concurrently.

        Examples
        --------
        Straight track of 20 m at 30 m horizontal distance and 30 m height. The widths are λR/2L along the track and
        c/2B divided by the sine of 45° in ground range, both multiplied by 0.886 for a flat spectrum.

        >>> from apertura.core.scene.terrain import FlatGround
        >>> along = np.linspace(-10, 10, 401)
        >>> track = np.stack([along, np.full(401, -30.0), np.full(401, 30.0)], -1)
        >>> band = 1.2e9 + np.linspace(-2e8, 2e8, 64)
        >>> grid = SceneGrid("local", -0.5, 0.5, 1.0, (1, 1))
        >>> resolution = Resolution.of(grid, FlatGround(0.0), Aperture(track, track), None, frequency_hz=band,
        ...                            weight=np.full(64, 1 / 64))
        >>> fine, coarse, azimuth = resolution.axes((slice(0, 1), slice(0, 1)))
        >>> fine.round(2), coarse.round(2), abs(azimuth).round(0)
        (array([[0.24]]), array([[0.47]]), array([[90.]]))
        """
        lattice = Lattice.of(
            grid.shape
        )  # the same pitch for all pairs, so that moments of several pairs can be added node by node
        moments = np.zeros((*lattice.shape, len(_ORDERS) + _UPRIGHT))
        share = weight / weight.sum()
        of_band = [float((share * (frequency_hz / SPEED_OF_LIGHT_M_S) ** order).sum()) for order in range(_ORDER + 1)]

        def compute(block: Window, reaching: NDArray[np.bool_]) -> None:
            rows, columns = (at[part] for at, part in zip(lattice.nodes, block, strict=True))
            row, column = (axis.ravel() for axis in np.meshgrid(rows, columns, indexing="ij"))
            height_m = np.asarray(terrain.heights_at(grid, row, column), np.float64)
            points = grid.positions_at(row, column, height_m)
            neighbours = [grid.positions_at(row, column + 1, height_m), grid.positions_at(row - 1, column, height_m)]
            sides = [(neighbour - points) / grid.spacing_m for neighbour in neighbours]
            sides.append(grid.positions_at(row, column, height_m + 1.0) - points)
            reached = pulses_of(reaching, len(aperture))
            sampled = slice(reached.start, reached.stop, max(1, (reached.stop - reached.start) // _PULSES))
            pulses = aperture[sampled]
            parts, _ = point_weights(pulses, beams and beams[sampled], points)
            density = np.abs(parts)
            density = density / np.maximum(density.sum(axis=0), 1e-300)
            gradient = pulses.path_gradient(points)
            east, north, up = ((gradient * side).sum(axis=-1) for side in sides)
            products = [(density * east**a * north**b).sum(axis=0) * of_band[a + b] for a, b in _ORDERS]
            products += [(density * up).sum(axis=0) * of_band[1]]
            products += [(density * up * other).sum(axis=0) * of_band[2] for other in (east, north, up)]
            moments[block] = np.stack(products, axis=-1).reshape(len(rows), len(columns), -1)

        fill(lattice, compute, grid, terrain, aperture, beams, threads=threads)
        return cls(grid, terrain, lattice, moments)

    @classmethod
    def summed(cls, images: Sequence["Resolution"]) -> "Resolution":
        """Return the resolution of the coherent sum of images on one grid, assuming equal amplitudes of a point.

        The spectra of pairs at different positions do not overlap (docs/theory.md, eq. 7): their densities add.
        """
        total = np.sum([image.moments for image in images], axis=0)
        return replace(images[0], moments=total / np.maximum(total[..., :1], 1e-300))

    def axes(self, window: Window) -> tuple[Floats, Floats, Floats]:
        """Return the −3 dB widths of a point in the finest and coarsest directions, and the azimuth of the finest one.

        Parameters
        ----------
        window
            Rows and columns of the grid.

        Returns
        -------
        tuple of ndarray
            (row, column) float64 each: both widths in metres, and the azimuth in degrees clockwise from grid north,
            −90 to 90. Values are NaN where no pulse illuminates the pixel. The width is infinite in a direction without
            resolution.
        """
        if isinstance(self.terrain, FlatGround):
            fine, coarse, azimuth = self._axes_at_nodes
            doubled = [self._between(part, window) for part in (np.cos(2 * azimuth), np.sin(2 * azimuth))]
            with np.errstate(divide="ignore"):
                widths = [1 / self._between(1 / width, window) for width in (fine, coarse)]
            return widths[0], widths[1], np.degrees(np.arctan2(doubled[1], doubled[0])) / 2
        spread = [self._between(part, window) for part in self._spread_at_nodes]
        _, _, azimuth, *values = _principal(*_on_slopes(spread, _slopes(self.grid, self.terrain, window)))
        fine, coarse = (
            _width(self._between(shape, window), value)
            for shape, value in zip(self._shapes_at_nodes, values, strict=True)
        )
        return fine, coarse, np.degrees(azimuth)

    def look_azimuth_deg(self, window: Window) -> Floats:
        """Return the azimuth of the steepest increase of the total path, degrees clockwise from grid north."""
        east, north = (self._between(self._raw(order), window) for order in ((1, 0), (0, 1)))
        return np.asarray(np.degrees(np.arctan2(east, north)))

    def _raw(self, order: tuple[int, int]) -> Floats:
        """Return a moment at the nodes; NaN at nodes that no pulse illuminates."""
        illuminated = self.moments[..., 0] > 0
        return np.where(illuminated, self.moments[..., _ORDERS.index(order)], np.nan)

    def _central(self, order: tuple[int, int]) -> Floats:
        """Return a central moment at the nodes: central moments vary smoothly between nodes, means do not."""
        means = self._raw((1, 0)), self._raw((0, 1))
        return np.asarray(
            sum(
                comb(order[0], a) * comb(order[1], b) * self._raw((a, b))
                * (-means[0]) ** (order[0] - a) * (-means[1]) ** (order[1] - b)
                for a in range(order[0] + 1)
                for b in range(order[1] + 1)
            )
        )  # fmt: skip

    def _between(self, values: Floats, window: Window) -> Floats:
        """Interpolate values at the pixels of a window between nodes with finite values; NaN if there are none."""
        known = np.isfinite(values)
        share = self.lattice.between(known.astype(np.float64), window)
        mean = self.lattice.between(np.where(known, values, 0.0), window)
        return np.where(share > 0, mean / np.where(share > 0, share, 1.0), np.nan)

    @cached_property
    def _spread_at_nodes(self) -> list[Floats]:
        """Covariances east-east, east-north, north-north, east-up, north-up and up-up of the spectrum at the nodes."""
        mean, *products = np.moveaxis(self.moments[..., len(_ORDERS) :], -1, 0)
        means = self._raw((1, 0)), self._raw((0, 1)), mean
        upright = [product - mean * other for product, other in zip(products, means, strict=True)]
        return [*(self._central(order) for order in ((2, 0), (1, 1), (0, 2))), *upright]

    @cached_property
    def _shapes_at_nodes(self) -> list[Floats]:
        """Values of s of docs/theory/design.md, eq. 2, along the finest and the coarsest direction of level ground."""
        level, shapes = self._spread_at_nodes[:3], []
        east, north, *_ = _principal(*level)
        for axis in ((east, north), (-north, east)):
            second, fourth = (
                sum(
                    comb(order, a) * axis[0] ** a * axis[1] ** (order - a) * self._central((a, order - a))
                    for a in range(order + 1)
                )
                for order in (2, 4)
            )
            excess = fourth / np.maximum(second, _LEAST_SPREAD) ** 2 - 3
            # Solve ln|p(x)| = −κ₂t²/2 + κ₄t⁴/24 = −ln √2, t = 2πx, in units of the spectrum's standard deviation.
            root = 0.25 - np.minimum(excess, 1.0) * _HALF_POWER / 6
            shapes.append(4 * _HALF_POWER / (1 + 2 * np.sqrt(np.maximum(root, 0.0))))
        return shapes

    @cached_property
    def _axes_at_nodes(self) -> tuple[Floats, Floats, Floats]:
        """Widths along both axes (m) and azimuth (rad) of the direction of finest resolution, on level ground."""
        _, _, azimuth, *values = _principal(*self._spread_at_nodes[:3])
        fine, coarse = (_width(shape, value) for shape, value in zip(self._shapes_at_nodes, values, strict=True))
        return fine, coarse, azimuth


def _principal(east: Floats, both: Floats, north: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return the east and north components of the axis of largest variance, its azimuth (rad), and both variances."""
    mean, half = (east + north) / 2, np.hypot((east - north) / 2, both)
    angle = np.arctan2(2 * both, east - north) / 2  # anticlockwise from east
    azimuth = np.pi / 2 - angle
    azimuth = (azimuth + np.pi / 2) % np.pi - np.pi / 2
    return np.cos(angle), np.sin(angle), azimuth, mean + half, mean - half


def _width(shape: Floats, variance: Floats) -> Floats:
    width = np.sqrt(shape) / (np.pi * np.sqrt(np.maximum(variance, _LEAST_SPREAD)))
    return np.asarray(np.where(variance <= _LEAST_SPREAD, np.inf, width))


def _on_slopes(spread: list[Floats], slopes: tuple[Floats, Floats]) -> tuple[Floats, Floats, Floats]:
    """Return the east-east, east-north and north-north covariances on sloping terrain, in horizontal coordinates."""
    east, both, north, east_up, north_up, up_up = spread
    to_east, to_north = slopes
    return (
        east + 2 * to_east * east_up + to_east**2 * up_up,
        both + to_north * east_up + to_east * north_up + to_east * to_north * up_up,
        north + 2 * to_north * north_up + to_north**2 * up_up,
    )


def _slopes(grid: SceneGrid, terrain: Terrain, window: Window) -> tuple[Floats, Floats]:
    """Return the eastward and northward slopes of the terrain, metres per metre, (row, column) each."""
    around = [
        slice(max(0, part.start - 1), min(size, part.stop + 1)) for part, size in zip(window, grid.shape, strict=True)
    ]
    heights = np.asarray(terrain.heights(grid[around[0], around[1]]), np.float64)
    inner = tuple(
        slice(part.start - whole.start, part.stop - whole.start) for part, whole in zip(window, around, strict=True)
    )
    rises = [
        np.gradient(heights, axis=axis)[inner] / grid.spacing_m
        if heights.shape[axis] > 1
        else np.zeros(heights.shape)[inner]
        for axis in (1, 0)
    ]
    return rises[0], -rises[1]
