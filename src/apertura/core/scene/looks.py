"""Looks of each pixel and the centre of its aperture, computed on a lattice over the scene."""

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
from apertura.core.antenna.illumination import illumination_mask
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.angles import bistatic_angle_deg, incidence_deg, surface
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import balls
from apertura.core.scene.terrain import FlatGround, Terrain

# ---- Lattice of nodes over a raster, and interpolation between them

BLOCK_PX = 256
"""Side of the pieces in which a raster is computed."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Nodes at every `pitch_px` pixels of a raster, and at its last row and column.

    Attributes
    ----------
    nodes
        Rows and columns of pixels, int64 each.
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
        """Windows of nodes, one for each tile of `BLOCK_PX` pixels: those in it, row by row of tiles."""
        rows, columns = (
            [
                slice(*np.searchsorted(at, [first, first + BLOCK_PX]).tolist())
                for first in range(0, int(at[-1]) + 1, BLOCK_PX)
            ]
            for at in self.nodes
        )
        return [(row, column) for row in rows for column in columns]

    def between(self, values: NDArray[Any], window: Window, *, farthest: float | None = None) -> NDArray[Any]:
        """Return values at the pixels of a window, bilinear between nodes: in float32 of float32, else in float64.

        Parameters
        ----------
        values
            (node row, node column, ...).
        window
            Of pixels.
        farthest
            Length of the difference (last axis) of two corners of a cell above which the nearest corner counts.
        """
        (low, high, up), (left, right, across) = self._cells(window)
        extra, dtype = (1,) * (values.ndim - 2), np.float32 if values.dtype == np.float32 else np.float64
        up, across = up.reshape(-1, 1, *extra).astype(dtype), across.reshape(1, -1, *extra).astype(dtype)
        values, left, right = values[:, left[0] : right[-1] + 1], left - left[0], right - left[0]
        # First between rows of nodes, of few columns, so that one pass over all pixels is left.
        rows = values[low] + up * (values[high] - values[low])
        smooth: NDArray[Any] = rows.take(left, axis=1)
        more = (rows.take(np.arange(1, rows.shape[1] + 1), axis=1, mode="clip") - rows).take(left, axis=1)
        more *= across
        smooth += more
        if farthest is None:
            return smooth
        # Corners are compared once a cell.
        (lows, row), (lefts, column) = (np.unique(one, return_inverse=True) for one in (low, left))
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
        """Return which pixels of a window, (row, column), lie among corners that are all positive."""
        if (values[self.around(window)] > 0).all():
            return np.ones([part.stop - part.start for part in window], bool)
        (low, high, _), (left, right, _) = self._cells(window)
        corners = [values[np.ix_(row, column)] > 0 for row in (low, high) for column in (left, right)]
        return np.asarray(np.logical_and.reduce(corners))

    def around(self, window: Window) -> Window:
        """Return the window of those nodes that the pixels of a window lie between."""
        rows, columns = (slice(int(before[0]), int(after[-1]) + 1) for before, after, _ in self._cells(window))
        return rows, columns

    def _cells(self, window: Window) -> "tuple[_Cells, _Cells]":
        """Return along both axes the nodes before and after each pixel, and how far between them it lies."""
        return self._along(0, window[0]), self._along(1, window[1])

    def _along(self, axis: int, part: slice) -> "_Cells":
        key, nodes = (axis, part.start, part.stop), self.nodes[axis]
        if key not in self._known:  # tiles of one row ask for the same
            at = np.arange(part.start, part.stop)
            before = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, max(0, len(nodes) - 2))
            after = np.minimum(before + 1, len(nodes) - 1)
            self._known[key] = before, after, (at - nodes[before]) / np.maximum(1, nodes[after] - nodes[before])
        return self._known[key]

    def nearest(self, window: Window) -> list[tuple[tuple[int, int], Window]]:
        """Return the nodes nearest to the pixels of a window, each with the part of the window that is its."""
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
    """Call a function for each of `Lattice.blocks`, with the blocks of `AT_ONCE` pulses that may illuminate it.

    Parameters
    ----------
    lattice, grid, terrain, aperture, beams
        As of `Looks`.
    block
        Of the window of nodes, and (block of pulses,) bool.
    threads
        Blocks in work at once.
    """
    reaching = illumination_mask(beams, aperture, *balls(grid, terrain, list(grid.tiles(BLOCK_PX))), pulses=AT_ONCE)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(block, lattice.blocks, reaching.T))


# ---- Looks, and centre of the aperture of each pixel

SPREAD = 17
"""Pulses, evenly spread over those that illuminate a pixel, from which shadow is decided."""

PITCHES_PX = (128, 64, 32, 16)
"""Of a lattice: the widest that is narrow enough for what lies on it."""

_RANGE_SHARE = 48  # ranges to the scene: looks between nodes then err by 0.3 % in a beam of 20°
_PULSES = 256  # summed for a block of the lattice, or up to twice as many
_FEWEST, _MOST = 48, 2048  # of them that half of its nodes have a weight of, at least: else more are summed, up to
AT_ONCE = 64  # pulses of a block whose illumination is decided together
_EXACT = (AT_ONCE, 8)  # pulses that are left out together where none of them can illuminate the pixel
_CELL_PX = 8  # side of the cells of which it is first asked whether a pulse can reach them
_PIXELS = 4096  # that are decided together
_DARK_PULSES = 64  # evaluated for the centres of a block that no pulse reaches: its neighbours interpolate with them
_NO_WEIGHT_PENALTY = 1e6  # added to the distance of a pulse without weight: it is a centre only where none has weight
_ALIKE = 0.02  # change of Σ|w|/Σw² from node to node up to which looks are bilinear: 0.08 % off the two sums at most
_JUMP_PITCHES = 4.0  # node pitches: centres of neighbouring nodes further apart belong to different passes


@dataclass(frozen=True, eq=False)
class Looks:
    """Looks and aperture centre of each place of an image; windows are read tile by tile.

    Attributes
    ----------
    grid, terrain
        The scene.
    aperture, beams
        Every pulse, and its weights; None: all count alike.
    lattice
        Nodes at which the following are computed.
    total, squares
        (node row, node column) float32, Σ|w| and Σw² over the pulses.
    centres
        (node row, node column, 2, 3) float64, metres: transmitter and receiver at the closest approach.
    pulses
        (node row, node column, `SPREAD`) int32, some of those that weigh half or more; all pulses where none does.

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
    centres: Floats
    pulses: NDArray[np.int32]
    _masks: dict[tuple[int, int], NDArray[np.uint8] | bool] = field(default_factory=dict)

    @classmethod
    def of(
        cls, grid: SceneGrid, terrain: Terrain, aperture: Aperture, beams: Beams | None, *, threads: int = 1
    ) -> "Looks":
        """Return the looks of a scene.

        Parameters
        ----------
        grid, terrain, aperture, beams
            As of `Looks`; positions in the grid's processing frame.
        threads
            Blocks of the lattice in work at once.

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
            np.zeros((*lattice.shape, 2, 3)),
            np.zeros((*lattice.shape, SPREAD), np.int32),
        )
        fill(lattice, looks._fill, grid, terrain, aperture, beams, threads=threads)
        return looks

    def _fill(self, block: Window, reaching: NDArray[np.bool_]) -> None:
        """Compute the nodes of a block of the lattice from the pulses that may illuminate it."""
        rows, columns = (at[part] for at, part in zip(self.lattice.nodes, block, strict=True))
        points = self.terrain.positions_at(self.grid, *np.meshgrid(rows, columns, indexing="ij")).reshape(-1, 3)
        some = pulses_of(reaching, len(self.aperture))
        every = max(1, (some.stop - some.start) // (_PULSES if reaching.any() else _DARK_PULSES))
        while True:
            few = slice(some.start, some.stop, every)
            aperture, beams = self.aperture[few], self.beams and self.beams[few]
            weight = np.ones((len(aperture), len(points))) if beams is None else beams.weight(aperture, points)
            counted = (weight != 0).sum(axis=0)
            found = int(np.median(counted[counted > 0])) if counted.any() else _FEWEST
            if every == 1 or found >= _FEWEST or len(aperture) >= _MOST:
                break
            every = max(1, every * found // (2 * _FEWEST), (some.stop - some.start) // _MOST)
        shape, pulses_each = (len(rows), len(columns)), (some.stop - some.start) / len(aperture)
        self.total[block] = (np.abs(weight).sum(axis=0) * pulses_each).reshape(shape)
        self.squares[block] = ((weight**2).sum(axis=0) * pulses_each).reshape(shape)
        self.centres[block] = _centres(aperture, beams, points, weight).reshape(*shape, 2, 3)
        self.pulses[block] = (some.start + every * _spread(weight)).reshape(*shape, SPREAD)

    def illuminated(self, tile: Window) -> NDArray[np.bool_]:
        """Return whether any pulse illuminates the pixels of a tile, exactly, (row, column) bool.

        Parameters
        ----------
        tile
            One of the grid's tiles of `BLOCK_PX` pixels.
        """
        shape = (tile[0].stop - tile[0].start, tile[1].stop - tile[1].start)
        if self.beams is None:
            return np.ones(shape, bool)
        key = (tile[0].start, tile[1].start)
        if key not in self._masks:
            mask = self.lattice.inside_positive(self.total, tile)
            self._fill_mask(mask, tile)
            self._masks[key] = bool(mask[0, 0]) if (mask == mask[0, 0]).all() else np.packbits(mask)
        known = self._masks[key]
        if isinstance(known, bool):
            return np.full(shape, known)
        return np.unpackbits(known, count=shape[0] * shape[1]).reshape(shape).astype(bool)

    def _fill_mask(self, mask: NDArray[np.bool_], tile: Window) -> None:
        """Set the pixels of a tile that a pulse illuminates, cell by cell, from every pulse that may reach them."""
        if mask.all():
            return
        part = self.grid[tile]
        cells = [cell for cell in part.tiles(_CELL_PX) if not mask[cell].all()]
        if not cells or self.beams is None:
            return
        middle_m, radius_m = balls(part, self.terrain, cells)
        near, mine = np.arange(len(cells)), np.arange(len(self.aperture))
        for size in _EXACT:
            reaching = illumination_mask(
                self.beams[mine], self.aperture[mine], middle_m[near], radius_m[near], pulses=size
            )
            near, mine = near[reaching.any(axis=0)], mine[np.repeat(reaching.any(axis=1), size)[: len(mine)]]
        undecided = np.zeros(mask.shape, bool)
        for number in near:
            undecided[cells[number]] = ~mask[cells[number]]
        rows, columns = np.nonzero(undecided)
        points = self.terrain.positions_at(part, rows, columns)
        for first in range(0, len(rows), _PIXELS):
            some = slice(first, first + _PIXELS)
            mask[rows[some], columns[some]] = _any(self.beams, self.aperture, points[some], mine)

    def _sums(self, tile: Window) -> list[NDArray[np.float32]]:
        """Return Σ|w| and Σw² at the pixels of a tile, between those nodes that have pulses; 0 where none has."""
        sums = [self.lattice.between(values, tile) for values in (self.total, self.squares)]
        lit = self.total[self.lattice.around(tile)] > 0
        if not lit.all():
            share = self.lattice.between((self.total > 0).astype(np.float32), tile)
            share[share == 0] = np.inf
            sums = [values / share for values in sums]
        return sums

    def effective(self, tile: Window) -> NDArray[np.float32]:
        """Return the looks of the pixels of a tile, (row, column) float32; 0 where no pulse illuminates them.

        Bilinear between nodes themselves where Σ|w| and Σw² change alike, else by these two.
        """
        if self._alike(tile):
            looks = self.lattice.between(self._node_looks, tile)
        else:
            total, squares = self._sums(tile)
            looks = total**2 / np.where(squares > 0, squares, np.float32(np.inf))
        looks = np.maximum(np.float32(1), looks, out=looks)
        lit = self.illuminated(tile)
        return looks if lit.all() else np.where(lit, looks, np.float32(0))

    @cached_property
    def _node_looks(self) -> NDArray[np.float32]:
        return np.asarray(self.total**2 / np.where(self.squares > 0, self.squares, np.float32(np.inf)))

    def _alike(self, tile: Window) -> bool:
        """Return whether both sums change alike from node to node, none to more than twice: layers.md, eq. 4."""
        near = self.lattice.around(tile)
        total = self.total[near]
        if not total.all():
            return False
        inverse = total / self.squares[near]
        return all(
            (np.abs(np.diff(of, axis=axis)) <= most * of.min()).all()
            for of, most in ((total, 1.0), (inverse, _ALIKE))
            for axis in (0, 1)
        )

    def weight_squares(self, window: Window) -> Floats:
        """Return Σw² at the pixels of a window, (row, column) float64; 0 where no node about them has pulses."""
        return self._sums(window)[1].astype(np.float64)

    def centre(self, tile: Window) -> tuple[Floats, Floats]:
        """Return transmitter and receiver at each pixel's closest approach, (row, column, 3) float64 metres each."""
        centre = self.lattice.between(self.centres, tile, farthest=self._jump_m)
        return centre[..., 0, :], centre[..., 1, :]

    @property
    def _jump_m(self) -> float:
        return _JUMP_PITCHES * self.lattice.pitch_px * self.grid.spacing_m

    def incidence_deg(self, tile: Window) -> NDArray[Any]:
        """Return the angle from the ground's normal to the transmitter at closest approach, (row, column) degrees.

        Over level ground bilinear between nodes (docs/theory/layers.md, section 4).
        """
        if self._smooth(tile):
            return self.lattice.between(self._angles_deg[0], tile)
        return incidence_deg(*surface(self.grid, self.terrain, tile), self.centre(tile)[0])

    def bistatic_angle_deg(self, tile: Window) -> NDArray[Any]:
        """Return the angle between both antennas at closest approach, (row, column) degrees; as `incidence_deg`."""
        if self._smooth(tile):
            return self.lattice.between(self._angles_deg[1], tile)
        return bistatic_angle_deg(self.terrain.positions(self.grid[tile]), *self.centre(tile))

    @cached_property
    def _angles_deg(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(node row, node column), over level ground."""
        row, column = np.meshgrid(*self.lattice.nodes, indexing="ij")
        height_m = self.terrain.heights_at(self.grid, row, column)
        place_m, above_m = (self.grid.positions_at(row, column, height_m + more) for more in (0.0, 1.0))
        tx_m, rx_m = np.moveaxis(self.centres, 2, 0)
        angles = incidence_deg(place_m, above_m - place_m, tx_m), bistatic_angle_deg(place_m, tx_m, rx_m)
        return angles[0].astype(np.float32), angles[1].astype(np.float32)

    def _smooth(self, tile: Window) -> bool:
        """Return whether angles are those between nodes: level ground, nodes that its range is many of, no jump."""
        if not isinstance(self.terrain, FlatGround) or self.lattice.pitch_px == PITCHES_PX[-1]:
            return False
        near = self.lattice.around(tile)
        steps = (np.linalg.norm(np.diff(self.centres[near], axis=axis), axis=-1) for axis in (0, 1))
        return all((step <= self._jump_m).all() for step in steps)


def pulses_of(reaching: NDArray[np.bool_], pulses: int) -> slice:
    """Return the first to the last pulse of the blocks marked; all pulses where none is."""
    blocks = np.flatnonzero(reaching)
    if not blocks.size:
        return slice(0, pulses)
    return slice(int(blocks[0]) * AT_ONCE, min(int(blocks[-1] + 1) * AT_ONCE, pulses))


def pitch_px(grid: SceneGrid, terrain: Terrain, aperture: Aperture, *, share: float) -> int:
    """Return the pitch of a lattice whose nodes are no farther apart than a share of the range to the scene.

    Parameters
    ----------
    grid, terrain, aperture
        As of `Looks`.
    share
        Ranges hold so many pitches, if one of `PITCHES_PX` is so narrow.
    """
    middle = terrain.positions_at(grid, *(np.array([size // 2]) for size in grid.shape))
    few = aperture[aperture.sample(_PULSES)]
    nearest_m = min(float(np.linalg.norm(leg - middle, axis=-1).min()) for leg in few.legs)
    most = nearest_m / share / grid.spacing_m
    return next((pitch for pitch in PITCHES_PX if pitch <= most), PITCHES_PX[-1])


def _any(
    beams: Beams, aperture: Aperture, points: Floats, pulses: NDArray[np.int64], sizes: tuple[int, ...] = _EXACT
) -> NDArray[np.bool_]:
    """Return at which points (point, 3) any of some pulses has a weight.

    A pulse of each block is tried first. Then what none of a block can illuminate is left out, block by block in ever
    smaller ones, so that every pulse is tried near the edges of beams alone.
    """
    if not pulses.size or not len(points):
        return np.zeros(len(points), bool)
    tried = pulses[sizes[0] // 2 :: sizes[0]] if sizes else pulses
    illuminated = (beams[tried].weight(aperture[tried], points) != 0).any(axis=0)
    if not sizes or illuminated.all():
        return np.asarray(illuminated)
    left = np.flatnonzero(~illuminated)
    near = illumination_mask(beams[pulses], aperture[pulses], points[left], np.zeros(left.size), pulses=sizes[0])
    for number in np.flatnonzero(near.any(axis=1)):
        undecided = left[near[number] & ~illuminated[left]]
        block = pulses[number * sizes[0] : (number + 1) * sizes[0]]
        illuminated[undecided] = _any(beams, aperture, points[undecided], block, sizes[1:])
    return np.asarray(illuminated)


def _centres(aperture: Aperture, beams: Beams | None, points: Floats, weight: Floats) -> Floats:
    """Return both antennas (point, 2, 3) where each point is passed closest, between pulses too."""
    # The pulse of least total path, or of the least s of a sector; one without weight only where none has.
    sector = None if beams is None else beams.sector
    distance = aperture.path(points) if sector is None else sector.place(aperture, points) ** 2
    dark = weight == 0
    distance = distance + _NO_WEIGHT_PENALTY * dark
    column, best = np.arange(len(points)), distance.argmin(axis=0)
    legs = np.stack(aperture.legs, axis=1)
    if len(aperture) < 3:
        return np.asarray(legs[best])
    # A parabola through it and its neighbours, where all three have weight or none.
    inner = np.clip(best, 1, len(aperture) - 2)
    before, here, after = (distance[inner + step, column] for step in (-1, 0, 1))
    same_weighting = (dark[inner - 1, column] == dark[inner, column]) & (dark[inner, column] == dark[inner + 1, column])
    bend = before - 2 * here + after
    fit = (inner == best) & (bend > 0) & same_weighting
    shift = np.where(fit, (before - after) / np.where(fit, 2 * bend, 1.0), 0.0)  # in pulses, within a half
    beside = best + np.where(fit, np.sign(shift), 0).astype(np.int64)
    return np.asarray(legs[best] + np.abs(shift)[:, None, None] * (legs[beside] - legs[best]))


def _spread(weight: Floats) -> NDArray[np.int64]:
    """Return pulses (point, `SPREAD`) evenly spread over those that weigh half or more of the most, of all if none."""
    size = np.abs(weight)
    count = np.cumsum(size >= size.max(axis=0) / 2, axis=0).T
    ranks = 1 + np.round(np.linspace(0, 1, SPREAD) * (count[:, -1:] - 1))
    # Counts of all points in one row that ascends.
    point = np.arange(len(count))[:, None]
    found = np.searchsorted((count + point * (len(size) + 1)).ravel(), ranks + point * (len(size) + 1))
    return np.asarray(found - point * len(size))
