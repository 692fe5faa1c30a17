"""Number of looks and aperture centre of each pixel, computed on a lattice over the scene."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.contracts import Window
from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import EXACT, any_illuminates, illumination_mask
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import ned_axes
from apertura.core.scene.angles import bistatic_angle_deg, incidence_deg, surface, unit
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.recorded import RecordedShares
from apertura.core.scene.swath import balls
from apertura.core.scene.terrain import FlatGround, Terrain

# ---- Lattice of nodes over a raster, and interpolation between them

BLOCK_PX = 256
"""Side of the tiles in which a raster is computed, pixels."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Lattice of nodes at every `pitch_px` pixels of a raster, and at its last row and column.

    Attributes
    ----------
    nodes
        Pixel rows and columns of the nodes, int64 each.
    pitch_px
        Pixels between nodes.

    Examples
    --------
    >>> lattice = Lattice.of((20, 40))
    >>> [at.tolist() for at in lattice.nodes]
    [[0, 16, 19], [0, 16, 32, 39]]
    >>> lattice.between(np.add.outer(lattice.nodes[0], lattice.nodes[1]), (slice(4, 5), slice(37, 39)))
    array([[41., 42.]])
    """

    nodes: tuple[NDArray[np.int64], NDArray[np.int64]]
    pitch_px: int
    _known: "dict[tuple[int, int, int], _Cells]" = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, shape: tuple[int, int], pitch_px: int = 16) -> "Lattice":
        """Return the lattice of a raster; `BLOCK_PX` is a multiple of the pitch."""
        rows, columns = (np.append(np.arange(0, size - 1, pitch_px), size - 1) for size in shape)
        return cls((rows, columns), pitch_px)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of nodes."""
        return (len(self.nodes[0]), len(self.nodes[1]))

    @property
    def blocks(self) -> list[Window]:
        """Windows of the nodes in each tile of `BLOCK_PX` pixels, row by row of tiles."""
        rows, columns = (
            [
                slice(*np.searchsorted(at, [first, first + BLOCK_PX]).tolist())
                for first in range(0, int(at[-1]) + 1, BLOCK_PX)
            ]
            for at in self.nodes
        )
        return [(row, column) for row in rows for column in columns]

    def between(self, values: NDArray[Any], window: Window, *, farthest: float | None = None) -> NDArray[Any]:
        """Interpolate values bilinearly at the pixels of a window, in float32 for float32 values, otherwise in float64.

        Parameters
        ----------
        values
            (node row, node column, ...).
        window
            Window of pixels.
        farthest
            Largest distance between the values (vectors along the last axis) of two corners of a cell, up to which
            values are interpolated; in cells with a larger distance, the value of the nearest corner is used.
        """
        (low, high, up), (left, right, across) = self._cells(window)
        extra, dtype = (1,) * (values.ndim - 2), np.float32 if values.dtype == np.float32 else np.float64
        up, across = up.reshape(-1, 1, *extra).astype(dtype), across.reshape(1, -1, *extra).astype(dtype)
        values, left, right = values[:, left[0] : right[-1] + 1], left - left[0], right - left[0]
        # Interpolate between rows of nodes first: these have few columns, so that one pass over all pixels remains.
        rows = values[low] + up * (values[high] - values[low])
        smooth: NDArray[Any] = rows.take(left, axis=1)
        slope = (rows.take(np.arange(1, rows.shape[1] + 1), axis=1, mode="clip") - rows).take(left, axis=1)
        slope *= across
        smooth += slope
        if farthest is None:
            return smooth
        # Corners are compared once per cell.
        (lows, row), (lefts, column) = (np.unique(nodes, return_inverse=True) for nodes in (low, left))
        highs, rights = (np.minimum(at + 1, size - 1) for at, size in zip((lows, lefts), values.shape, strict=False))
        corners = [values[np.ix_(*at)] for at in ((lows, lefts), (lows, rights), (highs, lefts), (highs, rights))]
        distance = np.max([np.linalg.norm(corner - corners[0], axis=-1) for corner in corners[1:]], axis=0)
        jumps = (distance > farthest).any(axis=tuple(range(2, distance.ndim)))
        if jumps.any():
            jumps = jumps[np.ix_(row, column)]
            near = values[np.ix_(np.where(up.ravel() < 0.5, low, high), np.where(across.ravel() < 0.5, left, right))]
            smooth[jumps] = near[jumps]
        return smooth

    def inside_positive(self, values: NDArray[Any], window: Window) -> NDArray[np.bool_]:
        """Return a mask, (row, column), of the pixels of a window for which all surrounding nodes are positive."""
        if (values[self.around(window)] > 0).all():
            return np.ones([part.stop - part.start for part in window], bool)
        (low, high, _), (left, right, _) = self._cells(window)
        corners = [values[np.ix_(row, column)] > 0 for row in (low, high) for column in (left, right)]
        return np.asarray(np.logical_and.reduce(corners))

    def around(self, window: Window) -> Window:
        """Return the window of nodes that surround the pixels of a window."""
        rows, columns = (slice(int(before[0]), int(after[-1]) + 1) for before, after, _ in self._cells(window))
        return rows, columns

    def _cells(self, window: Window) -> "tuple[_Cells, _Cells]":
        """Return the nodes before and after each pixel and the fractional position between them, along both axes."""
        return self._along(0, window[0]), self._along(1, window[1])

    def _along(self, axis: int, part: slice) -> "_Cells":
        """Return the nodes before and after the pixels of `part` along an axis, and their fractional positions."""
        key, nodes = (axis, part.start, part.stop), self.nodes[axis]
        if key not in self._known:  # cached: equal for all tiles of a row
            at = np.arange(part.start, part.stop)
            before = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, max(0, len(nodes) - 2))
            after = np.minimum(before + 1, len(nodes) - 1)
            self._known[key] = before, after, (at - nodes[before]) / np.maximum(1, nodes[after] - nodes[before])
        return self._known[key]

    def nearest(self, window: Window) -> list[tuple[tuple[int, int], Window]]:
        """Return the nodes nearest to the pixels of a window, each with the part of the window nearest to the node."""
        owned = []
        for at, part in zip(self.nodes, window, strict=True):
            ends = np.append((at[1:] + at[:-1] + 1) // 2, at[-1] + 1)
            starts = np.append(0, ends[:-1])
            first, last = np.searchsorted(ends, [part.start, part.stop - 1], side="right")
            owned.append(
                [
                    (node, slice(max(part.start, int(starts[node])), min(part.stop, int(ends[node]))))
                    for node in range(int(first), int(last) + 1)
                ]
            )
        return [((row, column), (rows, columns)) for row, rows in owned[0] for column, columns in owned[1]]


_Cells = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]


def fill(
    lattice: Lattice,
    block: Callable[[Window, NDArray[np.bool_]], None],
    grid: SceneGrid,
    terrain: Terrain,
    aperture: Aperture,
    beams: Beams | None,
    *,
    threads: int,
) -> None:
    """Call a function for each of `Lattice.blocks`, with the blocks of `AT_ONCE` pulses that may illuminate the block.

    Parameters
    ----------
    lattice, grid, terrain, aperture, beams
        As for `Looks`.
    block
        Function called with a window of nodes and a mask of pulse blocks, (block,) bool.
    threads
        Number of blocks processed in parallel.
    """
    reaching = illumination_mask(beams, aperture, *balls(grid, terrain, list(grid.tiles(BLOCK_PX))), pulses=AT_ONCE)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(block, lattice.blocks, reaching.T))


# ---- Number of looks and aperture centre of each pixel

SPREAD = 17
"""Number of pulses used to decide on shadow, evenly spread over the pulses that illuminate a pixel."""

PITCHES_PX = (128, 64, 32, 16)
"""Candidate pitches of a lattice, pixels; the widest pitch with sufficient accuracy is used."""

# minimum ratio of range to pitch: the error of the number of looks between nodes is 0.3 % in a beam of 20°
_RANGE_SHARE = 48
_PULSES = 256  # minimum number of pulses summed for a block of the lattice; the largest number is twice this number
# minimum median number of pulses with weight at a node, below which more pulses are summed; and limit of their number
_FEWEST, _MOST = 48, 2048
AT_ONCE = 64  # block size in pulses of the illumination test
_CELL_PX = 8  # side of the cells that are first tested as a whole, pixels
_PIXELS = 4096  # number of pixels tested together
# number of pulses evaluated for the centres of a block without illumination, used for interpolation in adjacent blocks
_DARK_PULSES = 64
# added to the distance of a pulse without weight, which is selected as centre only if no pulse has weight
_NO_WEIGHT_PENALTY = 1e6
# largest change of Σ|w|/Σw² between nodes for bilinear looks: the error relative to interpolated sums is 0.08 %
_ALIKE = 0.02
_JUMP_PITCHES = 4.0  # node pitches; centres of adjacent nodes separated by more than this belong to different passes


@dataclass(frozen=True, eq=False)
class Looks:
    """Number of looks and aperture centre of each pixel of an image; windows are read tile by tile.

    Attributes
    ----------
    grid, terrain
        Grid and terrain of the scene.
    aperture, beams
        Aperture of all pulses, and weights of the pulses; None: equal weights.
    lattice
        Nodes at which the following values are computed.
    total, squares
        (node row, node column) float32, Σ|w| and Σw² over the pulses, with the weights of antennas and sector.
    lit
        (node row, node column) bool, True where any sampled pulse has a weight, including that of the gate.
    centres
        (node row, node column, 2, 3) float64, metres: transmitter and receiver at the closest approach.
    pulses
        (node row, node column, `SPREAD`) int32, a selection of the pulses with at least half of the largest weight, or
        of all pulses if no pulse has weight.

    Notes
    -----
    Source: docs/theory/layers.md, sections 1, 2 and 4.
    """

    grid: SceneGrid
    terrain: Terrain
    aperture: Aperture
    beams: Beams | None
    lattice: Lattice
    total: NDArray[np.float32]
    squares: NDArray[np.float32]
    lit: NDArray[np.bool_]
    centres: Floats
    pulses: NDArray[np.int32]
    _masks: dict[tuple[int, int], NDArray[np.uint8] | bool] = field(default_factory=dict)

    @classmethod
    def of(
        cls, grid: SceneGrid, terrain: Terrain, aperture: Aperture, beams: Beams | None, *, threads: int = 1
    ) -> "Looks":
        """Compute the looks and aperture centres of a scene.

        Parameters
        ----------
        grid, terrain, aperture, beams
            As for `Looks`, with positions in the processing frame of the grid.
        threads
            Number of lattice blocks processed in parallel.

        Examples
        --------
        >>> from apertura.core.scene.terrain import FlatGround
        >>> grid = SceneGrid("local", -4.0, 24.0, 0.5, (8, 16))
        >>> track = np.stack([np.linspace(-9, 9, 37), np.zeros(37), np.full(37, 10.0)], -1)
        >>> looks = Looks.of(grid, FlatGround(0.0), Aperture(track, track), None)
        >>> window = (slice(0, 8), slice(4, 6))
        >>> looks.effective(window)[0, 0].item(), looks.centre(window)[0][0, 0].round(2).tolist()
        (37.0, [-1.75, 0.0, 10.0])
        """
        lattice = Lattice.of(grid.shape, pitch_px(grid, terrain, aperture, share=_RANGE_SHARE))
        looks = cls(
            grid,
            terrain,
            aperture,
            beams,
            lattice,
            np.zeros(lattice.shape, np.float32),
            np.zeros(lattice.shape, np.float32),
            np.zeros(lattice.shape, bool),
            np.zeros((*lattice.shape, 2, 3)),
            np.zeros((*lattice.shape, SPREAD), np.int32),
        )
        fill(lattice, looks._fill, grid, terrain, aperture, beams and beams.on_profiles, threads=threads)
        return looks

    def _fill(self, block: Window, reaching: NDArray[np.bool_]) -> None:
        """Compute the nodes of a block of the lattice from the pulses that may illuminate it."""
        rows, columns = (at[part] for at, part in zip(self.lattice.nodes, block, strict=True))
        points = self.terrain.positions_at(self.grid, *np.meshgrid(rows, columns, indexing="ij")).reshape(-1, 3)
        pulses = pulses_of(reaching, len(self.aperture))
        every = max(1, (pulses.stop - pulses.start) // (_PULSES if reaching.any() else _DARK_PULSES))
        while True:
            sample = slice(pulses.start, pulses.stop, every)
            aperture, beams = self.aperture[sample], self.beams and self.beams[sample]
            applied = beams and beams.on_profiles
            weight = np.ones((len(aperture), len(points))) if applied is None else applied.weight(aperture, points)
            n_weighted = (weight != 0).sum(axis=0)
            median = int(np.median(n_weighted[n_weighted > 0])) if n_weighted.any() else _FEWEST
            if every == 1 or median >= _FEWEST or len(aperture) >= _MOST:
                break
            every = max(1, every * median // (2 * _FEWEST), (pulses.stop - pulses.start) // _MOST)
        shape, pulses_each = (len(rows), len(columns)), (pulses.stop - pulses.start) / len(aperture)
        self.total[block] = (np.abs(weight).sum(axis=0) * pulses_each).reshape(shape)
        self.squares[block] = ((weight**2).sum(axis=0) * pulses_each).reshape(shape)
        if beams and beams.gate:
            weight *= beams.gate.weight(aperture, points)
        self.lit[block] = (weight != 0).any(axis=0).reshape(shape)
        self.centres[block] = _centres(aperture, beams, points, weight).reshape(*shape, 2, 3)
        self.pulses[block] = (pulses.start + every * _spread(weight)).reshape(*shape, SPREAD)

    def illuminated(self, tile: Window) -> NDArray[np.bool_]:
        """Return a mask of the pixels of a tile that any pulse illuminates, (row, column) bool, evaluated exactly.

        Parameters
        ----------
        tile
            Tile of the grid of `BLOCK_PX` pixels.
        """
        shape = (tile[0].stop - tile[0].start, tile[1].stop - tile[1].start)
        if self.beams is None:
            return np.ones(shape, bool)
        key = (tile[0].start, tile[1].start)
        if key not in self._masks:
            mask = self.lattice.inside_positive(self.lit, tile)
            self._fill_mask(mask, tile)
            self._masks[key] = bool(mask[0, 0]) if (mask == mask[0, 0]).all() else np.packbits(mask)
        cached = self._masks[key]
        if isinstance(cached, bool):
            return np.full(shape, cached)
        return np.unpackbits(cached, count=shape[0] * shape[1]).reshape(shape).astype(bool)

    def _fill_mask(self, mask: NDArray[np.bool_], tile: Window) -> None:
        """Set the illuminated pixels of a tile, cell by cell, from all pulses that may illuminate the cell."""
        if mask.all():
            return
        part = self.grid[tile]
        cells = [cell for cell in part.tiles(_CELL_PX) if not mask[cell].all()]
        if not cells or self.beams is None:
            return
        middle_m, radius_m = balls(part, self.terrain, cells)
        # Exclude combinations of cells and pulse blocks without illumination, with successively smaller pulse blocks.
        reached, pulses = np.arange(len(cells)), np.arange(len(self.aperture))
        for size in EXACT:
            reaching = illumination_mask(
                self.beams[pulses], self.aperture[pulses], middle_m[reached], radius_m[reached], pulses=size
            )
            reached = reached[reaching.any(axis=0)]
            pulses = pulses[np.repeat(reaching.any(axis=1), size)[: len(pulses)]]
        undecided = np.zeros(mask.shape, bool)
        for number in reached:
            undecided[cells[number]] = ~mask[cells[number]]
        rows, columns = np.nonzero(undecided)
        points = self.terrain.positions_at(part, rows, columns)
        for first in range(0, len(rows), _PIXELS):
            pixels = slice(first, first + _PIXELS)
            mask[rows[pixels], columns[pixels]] = any_illuminates(self.beams, self.aperture, points[pixels], pulses)

    def _sums(self, tile: Window) -> list[NDArray[np.float32]]:
        """Interpolate Σ|w| and Σw² at the pixels of a tile between nodes with pulses; 0 if no node has pulses.

        The weights are those of antennas and sector, without the gate.
        """
        sums = [self.lattice.between(values, tile) for values in (self.total, self.squares)]
        lit = self.total[self.lattice.around(tile)] > 0
        if not lit.all():
            share = self.lattice.between((self.total > 0).astype(np.float32), tile)
            share[share == 0] = np.inf
            sums = [values / share for values in sums]
        return sums

    def effective(self, tile: Window) -> NDArray[np.float32]:
        """Return the number of looks of the pixels of a tile, (row, column) float32; 0 without illumination.

        The number is interpolated bilinearly between nodes if Σ|w| and Σw² change by equal factors; otherwise it is
        computed from the interpolated Σ|w| and Σw².
        """
        if self._alike(tile):
            looks = self.lattice.between(self._node_looks, tile)
        else:
            total, squares = self._sums(tile)
            looks = total**2 / np.where(squares > 0, squares, np.float32(np.inf))
        if shares := self._recorded.at(tile):
            looks = (looks * shares[0] ** 2 / np.where(shares[1] > 0, shares[1], np.inf)).astype(np.float32)
        looks = np.maximum(np.float32(1), looks, out=looks)
        lit = self.illuminated(tile)
        return looks if lit.all() else np.where(lit, looks, np.float32(0))

    @cached_property
    def _node_looks(self) -> NDArray[np.float32]:
        return np.asarray(self.total**2 / np.where(self.squares > 0, self.squares, np.float32(np.inf)))

    def _alike(self, tile: Window) -> bool:
        """Return True if both sums change by equal factors of at most two between nodes (layers.md, eq. 4)."""
        nodes = self.lattice.around(tile)
        total = self.total[nodes]
        if not total.all():
            return False
        ratio = total / self.squares[nodes]
        return all(
            (np.abs(np.diff(values, axis=axis)) <= largest * values.min()).all()
            for values, largest in ((total, 1.0), (ratio, _ALIKE))
            for axis in (0, 1)
        )

    def weight_squares(self, window: Window) -> Floats:
        """Return Σw² at the pixels of a window, (row, column) float64; 0 where no surrounding node has pulses."""
        squares, shares = self._sums(window)[1].astype(np.float64), self._recorded.at(window)
        return squares if shares is None else squares * shares[1]

    @cached_property
    def _recorded(self) -> RecordedShares:
        return RecordedShares(self.grid, self.terrain, self.aperture, self.beams)

    def centre(self, tile: Window) -> tuple[Floats, Floats]:
        """Return both antenna positions (m) at the closest approach to each pixel, (row, column, 3) float64 each."""
        centre = self.lattice.between(self.centres, tile, farthest=self._jump_m)
        return centre[..., 0, :], centre[..., 1, :]

    @property
    def _jump_m(self) -> float:
        return _JUMP_PITCHES * self.lattice.pitch_px * self.grid.spacing_m

    def incidence_deg(self, tile: Window) -> NDArray[Any]:
        """Return the incidence angle of the transmitter at closest approach, (row, column), degrees.

        Over level terrain, the angle is interpolated bilinearly between nodes (docs/theory/layers.md, section 4).
        """
        if self._smooth(tile):
            return self.lattice.between(self._angles_deg[0], tile)
        return incidence_deg(*surface(self.grid, self.terrain, tile), self.centre(tile)[0])

    def ellipsoidal_incidence_deg(self, tile: Window) -> NDArray[Any]:
        """Return the angle of the transmitter from the vertical at closest approach, (row, column), degrees.

        Over level terrain this is `incidence_deg`.
        """
        grid = self.grid[tile]
        height_m = self.terrain.heights(grid)
        position, above = (grid.positions(height_m + more) for more in (0.0, 1.0))
        return incidence_deg(position, above - position, self.centre(tile)[0])

    def bistatic_angle_deg(self, tile: Window) -> NDArray[Any]:
        """Return the bistatic angle at closest approach, (row, column), degrees; interpolated as in `incidence_deg`."""
        if self._smooth(tile):
            return self.lattice.between(self._angles_deg[1], tile)
        return bistatic_angle_deg(self.terrain.positions(self.grid[tile]), *self.centre(tile))

    def line_of_sight_enu(self, tile: Window) -> NDArray[Any]:
        """Return the line of sight at closest approach: east, north and up of a unit vector, (row, column, 3) float64.

        The vector points from the ground to the sensor, for a bistatic pair along the bisector of the directions to
        transmitter and receiver (docs/theory/layers.md, eq. 1b). In a local frame, the axes are those of the frame.
        """
        position = self.terrain.positions(self.grid[tile])
        tx, rx = (unit(antenna - position) for antenna in self.centre(tile))
        sight = unit(tx + rx)
        # The axes turn by less than 1e-5 between nodes, so that they are linear there.
        if self.grid.frame == "local":
            return sight
        return np.asarray(np.einsum("...ij,...j", self.lattice.between(self._enu_axes, tile), sight))

    def slant_ranges_m(self, tile: Window) -> NDArray[Any]:
        """Return the distances of transmitter and receiver at closest approach, (row, column, 2) float64, metres."""
        position = self.terrain.positions(self.grid[tile])
        return np.stack([np.linalg.norm(antenna - position, axis=-1) for antenna in self.centre(tile)], -1)

    @cached_property
    def _enu_axes(self) -> Floats:
        """Geodetic east, north and up at the nodes, rows of (node row, node column, 3, 3), in ECEF."""
        row, column = np.meshgrid(*self.lattice.nodes, indexing="ij")
        north, east, down = np.moveaxis(ned_axes(self.grid.positions_at(row, column, 0.0)), -1, 0)
        return np.stack([east, north, -down], axis=-2)

    @cached_property
    def _angles_deg(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Incidence and bistatic angle at the nodes over level terrain, (node row, node column) each."""
        row, column = np.meshgrid(*self.lattice.nodes, indexing="ij")
        height_m = self.terrain.heights_at(self.grid, row, column)
        position_m, above_m = (self.grid.positions_at(row, column, height_m + added) for added in (0.0, 1.0))
        tx_m, rx_m = np.moveaxis(self.centres, 2, 0)
        angles = incidence_deg(position_m, above_m - position_m, tx_m), bistatic_angle_deg(position_m, tx_m, rx_m)
        return angles[0].astype(np.float32), angles[1].astype(np.float32)

    def _smooth(self, tile: Window) -> bool:
        """Return True if angles can be interpolated: level terrain, pitch far below the range, and a single pass."""
        if not isinstance(self.terrain, FlatGround) or self.lattice.pitch_px == PITCHES_PX[-1]:
            return False
        nodes = self.lattice.around(tile)
        steps = (np.linalg.norm(np.diff(self.centres[nodes], axis=axis), axis=-1) for axis in (0, 1))
        return all((step <= self._jump_m).all() for step in steps)


def pulses_of(reaching: NDArray[np.bool_], pulses: int) -> slice:
    """Return the slice from the first to the last pulse of the marked blocks; all pulses if no block is marked."""
    blocks = np.flatnonzero(reaching)
    if not blocks.size:
        return slice(0, pulses)
    return slice(int(blocks[0]) * AT_ONCE, min(int(blocks[-1] + 1) * AT_ONCE, pulses))


def pitch_px(grid: SceneGrid, terrain: Terrain, aperture: Aperture, *, share: float) -> int:
    """Return the widest pitch of a lattice, pixels, that is at most the range to the scene divided by `share`.

    Parameters
    ----------
    grid, terrain, aperture
        As for `Looks`.
    share
        Minimum ratio of range to pitch; if no pitch satisfies this ratio, the narrowest of `PITCHES_PX` is used.
    """
    middle = terrain.positions_at(grid, *(np.array([size // 2]) for size in grid.shape))
    sample = aperture[aperture.sample(_PULSES)]
    nearest_m = min(float(np.linalg.norm(leg - middle, axis=-1).min()) for leg in sample.legs)
    widest_px = nearest_m / share / grid.spacing_m
    return next((pitch for pitch in PITCHES_PX if pitch <= widest_px), PITCHES_PX[-1])


def _centres(aperture: Aperture, beams: Beams | None, points: Floats, weight: Floats) -> Floats:
    """Return both antenna positions at the closest approach to each point, (point, 2, 3), interpolated over pulses."""
    # Select the pulse with the shortest total path, or with the smallest |s| in a sector. A pulse without weight is
    # selected only if no pulse has weight.
    sector = None if beams is None else beams.sector
    distance = aperture.path(points) if sector is None else sector.place(aperture, points) ** 2
    dark = weight == 0
    distance = distance + _NO_WEIGHT_PENALTY * dark
    column, best = np.arange(len(points)), distance.argmin(axis=0)
    legs = np.stack(aperture.legs, axis=1)
    if len(aperture) < 3:
        return np.asarray(legs[best])
    # Fit a parabola through this pulse and its neighbours if all three pulses have weight or none of them has weight.
    inner = np.clip(best, 1, len(aperture) - 2)
    before, middle, after = (distance[inner + step, column] for step in (-1, 0, 1))
    same_weighting = (dark[inner - 1, column] == dark[inner, column]) & (dark[inner, column] == dark[inner + 1, column])
    curvature = before - 2 * middle + after
    fit = (inner == best) & (curvature > 0) & same_weighting
    shift = np.where(fit, (before - after) / np.where(fit, 2 * curvature, 1.0), 0.0)  # in pulses, at most one half
    neighbour = best + np.where(fit, np.sign(shift), 0).astype(np.int64)
    return np.asarray(legs[best] + np.abs(shift)[:, None, None] * (legs[neighbour] - legs[best]))


def _spread(weight: Floats) -> NDArray[np.int64]:
    """Return pulses, (point, `SPREAD`), evenly spread over the pulses with at least half of the largest weight."""
    size = np.abs(weight)
    count = np.cumsum(size >= size.max(axis=0) / 2, axis=0).T
    ranks = 1 + np.round(np.linspace(0, 1, SPREAD) * (count[:, -1:] - 1))
    # Offsets make the counts of all points one ascending sequence, so that a single search suffices.
    point = np.arange(len(count))[:, None]
    index = np.searchsorted((count + point * (len(size) + 1)).ravel(), ranks + point * (len(size) + 1))
    return np.asarray(index - point * len(size))
