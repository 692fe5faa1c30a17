"""The trees of one chunk of pulses over the tiles of a block, as the compiled library runs them."""

import ctypes
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.antenna.beam import Beams
from apertura.core.focus.engines.native_binding import call
from apertura.core.focus.engines.native_structs import (
    TREE_FEWER,
    TREE_GROUP,
    TREE_NODES,
    TREE_SLOTS,
    TREE_WEIGHTS,
    TreeJob,
    TreeTile,
)
from apertura.core.focus.engines.tree_inputs import Trees, delay_filter
from apertura.core.focus.engines.tree_nodes import matrices, nodes, pixel_places, supports
from apertura.core.focus.engines.tree_surface import Surface
from apertura.core.focus.engines.tree_track import LEAF, curve
from apertura.core.focus.engines.tree_weights import BY_TREE, DIRECTLY, SILENTLY, weights_over


@dataclass(frozen=True, eq=False)
class Tile:
    """Which part of a block it is, where its pixels lie, and whether they lie smoothly enough for a tree."""

    window: Window
    surface: Surface
    by_tree: bool


Task = tuple[Tile, NDArray[np.bool_]]
"""A tile, and which groups of 64 pulses are to be added to it."""

_Taken = tuple[
    NDArray[np.float32] | None, NDArray[np.uint8], NDArray[np.uint8]
]  # weights, ways, which go by themselves


@dataclass(eq=False)
class Chunk:
    """Some pulses over a block of pixels.

    Attributes
    ----------
    trees, beams
        Of the pulses.
    nodes_db, presum_db
        What one interpolation may err by, dB, and what pulses of a leaf may that leave a smooth track.
    sizes
        Pulses of the subapertures of each level.
    pixels, image
        (y, x, 3) float64 and (y, x) complex64, to which the pulses are added.
    """

    trees: Trees
    beams: Beams | None
    nodes_db: int
    presum_db: int
    sizes: tuple[int, ...]
    pixels: NDArray[np.float64]
    image: NDArray[np.complex64]
    _held: list[NDArray[np.generic]] = field(default_factory=list)  # what the structs point into
    _counts: list[NDArray[np.uint8]] = field(default_factory=list)  # numbers of nodes of each tile
    _fewer: list[NDArray[np.uint8]] = field(default_factory=list)  # numbers of pulses that stand for those of a leaf

    def add(self, tasks: list[Task]) -> list[NDArray[np.uint8]]:
        """Add what goes by tree, of the groups of 64 pulses given for each tile; return how groups are taken."""
        seen = [self._taken(*task) for task in tasks]
        ways = [way for _, way, _ in seen]
        self._fewer = [fewer for *_, fewer in seen]
        array = (TreeTile * len(tasks))(
            *(self._struct(tile, *taken) for (tile, _), taken in zip(tasks, seen, strict=True))
        )
        job = self._job(array)
        call("apertura_plan_tree", job)
        for struct, way in zip(array, ways, strict=True):
            if struct.top < 0:
                way[way == BY_TREE] = DIRECTLY
        self._fill(job, array)
        call("apertura_form_tree", job)
        return ways

    def _hold(self, array: NDArray[np.generic]) -> int:
        self._held.append(array)
        return array.ctypes.data

    def _taken(self, tile: Tile, wanted: NDArray[np.bool_]) -> _Taken:
        """Return the weights of the pulses over a tile, how groups of them are taken, and which go by themselves."""
        way, each = np.where(wanted, BY_TREE if tile.by_tree else DIRECTLY, SILENTLY), np.zeros(len(wanted), np.uint8)
        if self.beams is None or not tile.by_tree:
            return None, way.astype(np.uint8), each
        first, last = np.flatnonzero(wanted)[[0, -1]]
        groups, pulses = slice(first, last + 1), slice(first * TREE_GROUP, (last + 1) * TREE_GROUP)
        weight = np.zeros((len(self.trees), TREE_WEIGHTS), np.float32)
        aperture = self.trees.profiles.aperture[pulses]
        weight[pulses], found, each[groups] = weights_over(self.beams[pulses], aperture, tile.surface, self.nodes_db)
        way[groups] = np.where(wanted[groups], found, SILENTLY)
        return weight, way.astype(np.uint8), each

    def _struct(
        self, tile: Tile, weight: NDArray[np.float32] | None, way: NDArray[np.uint8], fewer: NDArray[np.uint8]
    ) -> TreeTile:
        rows, columns = tile.window
        surface, at = tile.surface, rows.start * self.image.shape[1] + columns.start
        counts = np.zeros(sum(2 * -(-len(self.trees) // size) for size in self.sizes), np.uint8)
        self._counts.append(counts)
        struct = TreeTile(
            surface=self._hold(np.ascontiguousarray(surface.coefficients)),
            pixels=self.pixels.ctypes.data + 24 * at,
            image=self.image.ctypes.data + 8 * at,
            weight=None if weight is None else self._hold(weight),
            way=self._hold(way),
            nodes=self._hold(counts),
            fewer=self._hold(fewer),
            degree=len(surface.coefficients) - 1,
            rows=rows.stop - rows.start,
            columns=columns.stop - columns.start,
            top=-1,
        )
        struct.centre[:] = surface.centre_m.tolist()
        return struct

    def _job(self, tiles: "ctypes.Array[TreeTile]") -> TreeJob:
        profiles, design = self.trees.profiles, self.trees.design
        tx, rx = (np.ascontiguousarray(leg, np.float64) for leg in profiles.aperture.legs)
        delay = delay_filter(profiles.oversampling)
        taps = np.repeat(design.taps.transpose(2, 0, 1)[..., None], 2, axis=-1)
        job = TreeJob(
            samples=self._hold(np.ascontiguousarray(profiles.samples)),
            start=self._hold(np.ascontiguousarray(profiles.start_m)),
            transmitter=self._hold(tx),
            receiver=self._hold(rx),
            stray=self._hold(self.trees.stray_m),
            rough=self._hold(self.trees.rough_m),
            track=self._hold(self.trees.tracks_m),
            delay=self._hold(delay),
            taps=self._hold(np.ascontiguousarray(taps, np.float32)),
            supports=self._hold(supports(self.nodes_db)),
            tiles=ctypes.addressof(tiles),
            pulses=len(profiles),
            length=profiles.samples.shape[1],
            up=design.up,
            lead=int(design.lead[0]),
            stride=self.image.shape[1],
            count=len(tiles),
            levels=len(self.sizes),
            mono=int(tx is rx or np.array_equal(tx, rx)),
            phase_polynomial=design.phase_polynomial,
            taps_count=design.taps.shape[2],
            delay_terms=len(delay),
            step=profiles.step_m,
            wavenumber=self.trees.wavenumber_rad_m,
            band=self.trees.band_rad_m,
            smooth=10 ** (self.presum_db / 20),
        )
        job.sizes[: len(self.sizes)] = self.sizes
        job.phase_coefficients[:] = design.phase_coefficients.tolist()
        return job

    def _fill(self, job: TreeJob, tiles: "ctypes.Array[TreeTile]") -> None:
        """Give the job the nodes and matrices that its plan asks for."""
        places = np.zeros(TREE_SLOTS, np.uintp)
        spread, mix = (np.zeros((TREE_NODES + 1, TREE_SLOTS), np.uintp) for _ in range(2))
        slots: dict[int, int] = {}  # pixels along a side → slot
        steps: set[tuple[int, int]] = set()  # numbers of nodes, of slots that they are interpolated to
        for tile, counts in zip(tiles, self._counts, strict=True):
            sides = tile.columns, tile.rows
            tile.column_slot, tile.row_slot = (slots.setdefault(n, TREE_NODES + 1 + len(slots)) for n in sides)
            levels = self._levels(counts)[: tile.top + 1]
            for (below, above), ratio in zip(pairwise(levels), self._ratios, strict=False):
                parents = above[np.arange(len(below)) // ratio]
                steps.update(zip(below.ravel().tolist(), parents.ravel().tolist(), strict=True))
            for top in levels[-1:]:
                for axis, slot in enumerate((tile.column_slot, tile.row_slot)):
                    steps.update((count, slot) for count in set(top[:, axis].tolist()))
        sizes = {slot: size for size, slot in slots.items()}
        for child, slot in steps:
            one, other = matrices(child, sizes.get(slot, slot), self.nodes_db, pixels=slot in sizes)
            spread[child, slot], mix[child, slot] = self._hold(one), self._hold(other)
        for slot in {slot for step in steps for slot in step}:
            at = pixel_places(sizes[slot]) if slot in sizes else nodes(slot, self.nodes_db)
            places[slot] = self._hold(np.ascontiguousarray(at))
        presum, curves = (np.zeros(TREE_FEWER + 1, np.uintp) for _ in range(2))
        for fewer in {int(n) for counts in self._fewer for n in counts if n > 1}:
            presum[fewer] = self._hold(np.ascontiguousarray(matrices(fewer, LEAF, self.nodes_db, pixels=True)[1].T))
            places[fewer] = self._hold(np.ascontiguousarray(nodes(fewer, self.nodes_db)))
            curves[fewer] = self._hold(curve(fewer, self.nodes_db))
        job.places, job.spread, job.mix = map(self._hold, (places, spread, mix))
        job.presum, job.curve = map(self._hold, (presum, curves))

    @property
    def _ratios(self) -> list[int]:
        return [above // below for below, above in pairwise(self.sizes)]

    def _levels(self, counts: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
        """Return the numbers of nodes of each level, (subaperture, 2)."""
        ends = np.cumsum([-(-len(self.trees) // size) for size in self.sizes])
        return np.split(counts.reshape(-1, 2), ends[:-1])
