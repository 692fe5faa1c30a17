"""What trees of all tiles share, what goes by the direct kernel, and the trees of one chunk of pulses."""

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from threading import Lock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.contracts import Window
from apertura.core.antenna.beam import Beams
from apertura.core.focus.engines import native
from apertura.core.focus.engines.native_binding import (
    TREE_DELAYS,
    TREE_FEWER,
    TREE_GROUP,
    TREE_NODES,
    TREE_SLOTS,
    TREE_WEIGHTS,
    TreeJob,
    TreeTile,
    call,
)
from apertura.core.focus.engines.native_tables import BAND, TableDesign, Tables, design_table
from apertura.core.focus.engines.tree_nodes import (
    BY_TREE,
    DIRECTLY,
    SILENTLY,
    Surface,
    matrices,
    nodes,
    pixel_places,
    supports,
    weights_over,
)
from apertura.core.focus.engines.tree_view import LEAF, curve, leaf_roughness, leaves_of, stray, tracks
from apertura.core.focus.inputs import Profiles
from apertura.core.geometry.aperture import Aperture

# ---- How the direct kernel takes what a tree cannot: its setting, and tables that are made when they are needed


class Directly(NamedTuple):
    """How the direct kernel takes what a tree cannot."""

    oversampling: int
    tolerance_rad: float


_TOLERANCES_RAD = {-74: 1.5e-3, -80: 7e-4, -86: 3e-4, -92: 1.5e-4, -98: 1e-4}


@lru_cache
def directly(nodes_db: int, profile_oversampling: float, carrier_rad_per_sample: float) -> Directly:
    """Return how the direct kernel takes what trees of such nodes cannot: it errs less than they do.

    Examples
    --------
    >>> [directly(nodes_db, 2.0, 1.5).oversampling for nodes_db in (-50, -74, -98)]
    [4, 5, 12]
    """
    least: tuple[float, int] = (np.inf, 0)
    for oversampling in range(4, 33):  # more cells need not err less: the polynomial of the phase changes
        design = design_table(profile_oversampling, carrier_rad_per_sample, oversampling=float(oversampling), degree=2)
        least = min(least, (design.error_db(np.ones(64)), oversampling))
        if least[0] <= nodes_db + 5:
            break
    return Directly(least[1], _TOLERANCES_RAD.get(nodes_db, 1.5e-3))


class DirectTables:
    """Tables of the direct kernel, made when a tile first asks for them and shared by all."""

    def __init__(self, profiles: Profiles):
        self._profiles, self._lock, self._tables = profiles, Lock(), dict[int, Tables]()

    def __getitem__(self, oversampling: int) -> Tables:
        with self._lock:
            if oversampling not in self._tables:
                self._tables[oversampling] = native.prepare(self._profiles, oversampling=oversampling, degree=2)
            return self._tables[oversampling]


# ---- What trees of all tiles share: profiles, and the filters that expand them -------------------------------------

CELLS_AT_ONCE = 4
"""Cells per sample are a multiple of it: what a vector of AVX-512 holds."""

LEAST_PIXELS = 32**2
"""Of a tile: fewer go directly."""

LEAST_QUARTER_PX = 64
"""Side of the quarter of a tile: smaller ones are not worth a tree of their own."""

_SAMPLED = 64  # pulses at which a rough tile is looked at
_DELAY_DEGREE = 9


@dataclass(frozen=True, eq=False)
class Trees:
    """Pulses as trees read them.

    Attributes
    ----------
    profiles
        The pulses, contiguous.
    design
        Of the cells: which filters make them.
    stray_m
        (leaf,) float32, metres by which pulses of a leaf leave the parabola through its first, middle and last one.
    rough_m
        (leaf, 4) float32, metres by which they leave curves of growing degree, RMS.
    tracks_m
        (leaf, antenna, term, 3) float64, phase centres over each leaf as polynomials.
    first
        Number of the first pulse among those prepared.
    tables
        Of the direct kernel, for all pulses prepared.
    """

    profiles: Profiles
    design: TableDesign
    stray_m: NDArray[np.float32]
    rough_m: NDArray[np.float32]
    tracks_m: NDArray[np.float64]
    first: int
    tables: DirectTables

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self.profiles)

    def __getitem__(self, pulses: slice) -> "Trees":
        """Return those of pulses from a multiple of a leaf on.

        Raises
        ------
        ValueError
            If they begin elsewhere, or are not in a row.
        """
        first, last, step = pulses.indices(len(self))
        if step != 1 or first % LEAF:
            raise ValueError(f"{pulses}: pulses of a tree are taken from a multiple of {LEAF} on, and in a row")
        leaves = slice(first // LEAF, -(-last // LEAF))
        return replace(
            self,
            profiles=self.profiles[first:last],
            stray_m=self.stray_m[leaves],
            rough_m=self.rough_m[leaves],
            tracks_m=self.tracks_m[leaves],
            first=self.first + first,
        )

    def chunks(self, size: int) -> Iterator[slice]:
        """Yield slices of `size` pulses; they end at the same pulses whichever tile takes them."""
        first = 0
        while first < len(self):
            last = min(len(self), first + size - (self.first + first) % size)
            yield slice(first, last)
            first = last

    def direct(self, nodes_db: int) -> Tables:
        """Return the direct kernel's tables for these pulses."""
        return self.tables[self.directly(nodes_db).oversampling][self.first : self.first + len(self)]

    def directly(self, nodes_db: int) -> Directly:
        """Return the direct kernel's setting beside trees of such nodes."""
        return directly(nodes_db, self.profiles.oversampling, self.wavenumber_rad_m * self.profiles.step_m)

    def roughness(self, surface: Surface) -> float:
        """Return the error that pixels off the surface of a tile make, as the function of that name."""
        aperture = self.profiles.aperture
        some = aperture[aperture.sample(_SAMPLED)]
        return roughness(some, surface, wavenumber_rad_m=self.wavenumber_rad_m, band_rad_m=self.band_rad_m)

    @property
    def middle(self) -> Aperture:
        """The middle pulse."""
        return self.profiles.aperture[len(self) // 2 : len(self) // 2 + 1]

    @property
    def wavenumber_rad_m(self) -> float:
        """2πf_mid/c."""
        return 2 * np.pi * self.profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S

    @property
    def band_rad_m(self) -> float:
        """Half the band as a wavenumber, πB/c."""
        return float(np.pi / (self.profiles.step_m * self.profiles.oversampling))


def roughness(aperture: Aperture, surface: Surface, *, wavenumber_rad_m: float, band_rad_m: float) -> float:
    """Return the mean squared error by pixels that do not lie on the surface of their tile, relative.

    Parameters
    ----------
    aperture
        Some of the pulses, evenly spread.
    surface
        Of the tile.
    wavenumber_rad_m, band_rad_m
        2πf_mid/c and πB/c.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 9.
    """
    if not np.isfinite(surface.rough_m):
        return np.inf
    rate = aperture.path_gradient(surface.centre_m[None])[:, 0] @ surface.up
    against = rate[len(rate) // 2]  # the pulse of m, nearly: that of the whole flight, not of each chunk
    of_phase, of_delay = wavenumber_rad_m**2 * ((rate - against) ** 2).mean(), band_rad_m**2 / 3 * (rate**2).mean()
    return float(surface.rough_m**2 * (of_phase + of_delay))


def cells_per_sample(profile_oversampling: float, oversampling: float) -> int:
    """Return how many cells a sample is expanded to, for at least so many per resolution cell.

    Examples
    --------
    >>> cells_per_sample(2.0, 24), cells_per_sample(2.5, 24)
    (12, 12)
    """
    return CELLS_AT_ONCE * int(np.ceil(oversampling / profile_oversampling / CELLS_AT_ONCE - 1e-9))


def cells(profile_oversampling: float, carrier_rad_per_sample: float, oversampling: float, taps: int) -> TableDesign:
    """Return the filters that expand profiles to cells: straight lines in each, of so many taps."""
    count = cells_per_sample(profile_oversampling, oversampling)
    return design_table(
        profile_oversampling, carrier_rad_per_sample, oversampling=count * profile_oversampling, degree=1, taps=taps
    )


@lru_cache
def delay_filter(profile_oversampling: float) -> NDArray[np.float32]:
    """Return the filter that gives a profile between two samples, as polynomials of where between them.

    Returns
    -------
    ndarray
        (degree + 1, tap) float32, constant term first; of 0…1 from the sample before to the one behind. The first tap
        is that of the sample `tap / 2 - 1` before.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 7: least squares over the band.

    Examples
    --------
    >>> weights = 0.3 ** np.arange(10) @ delay_filter(2.0)
    >>> tone = np.exp(0.5j * np.pi * 0.9 * (np.arange(12) - 5))
    >>> bool(abs(weights @ tone - np.exp(0.5j * np.pi * 0.9 * 0.3)) < 1e-4)
    True
    """
    omega = np.pi / profile_oversampling * BAND
    basis = np.exp(1j * omega[:, None] * (np.arange(TREE_DELAYS) - TREE_DELAYS // 2 + 1))
    u = 0.5 - 0.5 * np.cos(np.pi * (np.arange(24) + 0.5) / 24)
    wanted = np.exp(1j * omega[:, None] * u)
    left, right = (np.concatenate([part.real, part.imag]) for part in (basis, wanted))
    taps = np.linalg.lstsq(left, right, rcond=1e-9)[0].T
    return np.ascontiguousarray(np.linalg.lstsq(np.vander(u, _DELAY_DEGREE + 1, increasing=True), taps)[0], np.float32)


def prepare(profiles: Profiles, *, oversampling: int = 24, taps: int = 8) -> Trees:
    """Return what trees of all tiles share; pulses are expanded to cells later, tile by tile.

    Parameters
    ----------
    profiles
        Band-limited profiles.
    oversampling
        Table cells per Nyquist cell c/B of total path, at least.
    taps
        Of the filters that make cells, 8 or 16.

    Raises
    ------
    ValueError
        If the profiles are oversampled less than 1.5 times or hold no pulse, or a position or start is not finite.

    Notes
    -----
    Source: docs/theory/tree.md, "Leaves"; the cells are those of docs/theory/engine.md, "Cells".
    """
    samples, start_m, places = profiles.for_tables()
    held = replace(profiles, samples=samples, start_m=start_m)
    legs = [leaves_of(leg) for leg in places]
    strayed, rough = stray(legs[0]) + stray(legs[1]), leaf_roughness(*legs)
    turn = 2 * np.pi * profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S * profiles.step_m
    found = cells(profiles.oversampling, turn, float(oversampling), taps)
    bent = np.stack([tracks(leg) for leg in legs], axis=1)
    return Trees(held, found, strayed.astype(np.float32), rough.astype(np.float32), bent, 0, DirectTables(held))


# ---- The trees of one chunk of pulses over the tiles of a block, as the compiled library runs them -----------------


@dataclass(frozen=True, eq=False)
class JobTile:
    """Which part of a block it is, where its pixels lie, and whether they lie smoothly enough for a tree."""

    window: Window
    surface: Surface
    by_tree: bool


Task = tuple[JobTile, NDArray[np.bool_]]
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

    def _taken(self, tile: JobTile, wanted: NDArray[np.bool_]) -> _Taken:
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
        self, tile: JobTile, weight: NDArray[np.float32] | None, way: NDArray[np.uint8], fewer: NDArray[np.uint8]
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
