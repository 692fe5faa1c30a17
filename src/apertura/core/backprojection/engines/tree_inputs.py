"""Inputs of trees: filters and tracks common to all tiles, tables of the direct kernel, and jobs for pulse chunks."""

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from threading import Lock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines import native
from apertura.core.backprojection.engines.native_binding import (
    BY_TREE,
    DIRECTLY,
    NO_ECHO,
    TREE,
    TreeJob,
    TreeTile,
    call,
    weights_of,
)
from apertura.core.backprojection.engines.range_interpolation import BAND, TableDesign, Tables, design_table
from apertura.core.backprojection.engines.tree_geometry import (
    DEGREES,
    LEAF,
    Surface,
    curve,
    leaf_roughness,
    leaves_of,
    matrices,
    nodes,
    parabola_deviation,
    pixel_places,
    supports,
    tracks,
)
from apertura.core.backprojection.inputs import Profiles
from apertura.core.geometry.aperture import Aperture

# ---- Direct kernel used together with trees


class DirectSetting(NamedTuple):
    """Setting of the direct kernel used together with trees."""

    oversampling: int
    tolerance_rad: float


_TOLERANCES_RAD = {-74: 1.5e-3, -80: 7e-4, -86: 3e-4, -92: 1.5e-4, -98: 1e-4}


@lru_cache
def direct_setting(nodes_db: int, profile_oversampling: float, carrier_rad_per_sample: float) -> DirectSetting:
    """Return a setting of the direct kernel with an error below that of trees with the node error `nodes_db`.

    Examples
    --------
    >>> [direct_setting(nodes_db, 2.0, 1.5).oversampling for nodes_db in (-50, -74, -98)]
    [4, 5, 12]
    """
    least: tuple[float, int] = (np.inf, 0)
    for oversampling in range(4, 33):  # the error is not monotonic, because the phase polynomial changes
        design = design_table(profile_oversampling, carrier_rad_per_sample, oversampling=float(oversampling), degree=2)
        least = min(least, (design.error_db(np.ones(64)), oversampling))
        if least[0] <= nodes_db + 5:
            break
    return DirectSetting(least[1], _TOLERANCES_RAD.get(nodes_db, 1.5e-3))


class DirectTables:
    """Tables of the direct kernel, which are computed when a tile first requires them and shared by all tiles."""

    def __init__(self, profiles: Profiles):
        self._profiles, self._lock, self._tables = profiles, Lock(), dict[int, Tables]()

    def __getitem__(self, oversampling: int) -> Tables:
        with self._lock:
            if oversampling not in self._tables:
                self._tables[oversampling] = native.prepare(self._profiles, oversampling=oversampling, degree=2)
            return self._tables[oversampling]


# ---- Inputs common to all tiles

CELLS_AT_ONCE = 4
"""Divisor of the number of cells per sample, determined by the lanes of an AVX-512 vector."""

LEAST_PIXELS = 32**2
"""Minimum number of pixels of a tile: for a smaller tile, the overhead of a tree exceeds the cost of the direct sum."""

LEAST_QUARTER_PX = 64
"""Minimum side of the quarter of a tile, pixels: for smaller quarters, the cost of the direct sum is lower."""

_SAMPLED = 64  # number of pulses sampled for the roughness
_DELAY_DEGREE = 9


@dataclass(frozen=True, eq=False)
class Trees:
    """Pulses prepared for trees.

    Attributes
    ----------
    profiles
        Contiguous profiles of the pulses.
    design
        Filters of the cells.
    deviation_m
        (leaf,) float32, largest deviation of the pulses of a leaf from the parabola through its first, middle and last
        pulses, metres.
    rough_m
        (leaf, 4) float32, RMS deviation from curves of increasing degree, metres.
    tracks_m
        (leaf, antenna, term, 3) float64, polynomial coefficients of the phase centres over each leaf.
    first
        Number of the first pulse among all prepared pulses.
    tables
        Tables of the direct kernel for all prepared pulses.
    """

    profiles: Profiles
    design: TableDesign
    deviation_m: NDArray[np.float32]
    rough_m: NDArray[np.float32]
    tracks_m: NDArray[np.float64]
    first: int
    tables: DirectTables

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self.profiles)

    def __getitem__(self, pulses: slice) -> "Trees":
        """Return the trees of a slice of pulses that starts at a multiple of a leaf.

        Raises
        ------
        ValueError
            If the slice does not start at such a multiple, or if its step is not 1.
        """
        first, last, step = pulses.indices(len(self))
        if step != 1 or first % LEAF:
            raise ValueError(f"{pulses}: the pulses of a tree must start at a multiple of {LEAF} and be consecutive")
        leaves = slice(first // LEAF, -(-last // LEAF))
        return replace(
            self,
            profiles=self.profiles[first:last],
            deviation_m=self.deviation_m[leaves],
            rough_m=self.rough_m[leaves],
            tracks_m=self.tracks_m[leaves],
            first=self.first + first,
        )

    def chunks(self, size: int) -> Iterator[slice]:
        """Yield slices of `size` pulses, which end at the same pulses for every tile."""
        first = 0
        while first < len(self):
            last = min(len(self), first + size - (self.first + first) % size)
            yield slice(first, last)
            first = last

    def direct_tables(self, nodes_db: int) -> Tables:
        """Return the tables of the direct kernel for these pulses."""
        return self.tables[self.direct_setting(nodes_db).oversampling][self.first : self.first + len(self)]

    def direct_setting(self, nodes_db: int) -> DirectSetting:
        """Return the setting of the direct kernel for trees with the node error `nodes_db`."""
        return direct_setting(nodes_db, self.profiles.oversampling, self.wavenumber_rad_m * self.profiles.step_m)

    def roughness(self, surface: Surface) -> float:
        """Return the relative mean squared error from pixels off the surface of a tile; see function `roughness`."""
        aperture = self.profiles.aperture
        sampled = aperture[aperture.sample(_SAMPLED)]
        return roughness(sampled, surface, wavenumber_rad_m=self.wavenumber_rad_m, band_rad_m=self.band_rad_m)

    @property
    def middle(self) -> Aperture:
        """Aperture of the middle pulse."""
        return self.profiles.aperture[len(self) // 2 : len(self) // 2 + 1]

    @property
    def wavenumber_rad_m(self) -> float:
        """2πf_mid/v."""
        return self.profiles.wavenumber_rad_m

    @property
    def band_rad_m(self) -> float:
        """Half of the bandwidth as a wavenumber, πB/c."""
        return float(np.pi / (self.profiles.step_m * self.profiles.oversampling))


def roughness(aperture: Aperture, surface: Surface, *, wavenumber_rad_m: float, band_rad_m: float) -> float:
    """Return the relative mean squared error from pixels off the surface of a tile.

    Parameters
    ----------
    aperture
        Evenly spaced sample of the pulses.
    surface
        Surface of the tile.
    wavenumber_rad_m, band_rad_m
        2πf_mid/c and πB/c.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 9.
    """
    if not np.isfinite(surface.rough_m):
        return np.inf
    rate = aperture.path_gradient(surface.centre_m[None])[:, 0] @ surface.up
    reference = rate[len(rate) // 2]  # middle pulse of the whole flight, not of a chunk
    of_phase, of_delay = wavenumber_rad_m**2 * ((rate - reference) ** 2).mean(), band_rad_m**2 / 3 * (rate**2).mean()
    return float(surface.rough_m**2 * (of_phase + of_delay))


def cells_per_sample(profile_oversampling: float, oversampling: float) -> int:
    """Return the number of cells per sample for at least `oversampling` cells per resolution cell.

    Examples
    --------
    >>> cells_per_sample(2.0, 24), cells_per_sample(2.5, 24)
    (12, 12)
    """
    return CELLS_AT_ONCE * int(np.ceil(oversampling / profile_oversampling / CELLS_AT_ONCE - 1e-9))


def cells(profile_oversampling: float, carrier_rad_per_sample: float, oversampling: float, taps: int) -> TableDesign:
    """Return the filters with `taps` taps that expand profiles to cells of linear polynomials."""
    count = cells_per_sample(profile_oversampling, oversampling)
    return design_table(
        profile_oversampling, carrier_rad_per_sample, oversampling=count * profile_oversampling, degree=1, taps=taps
    )


@lru_cache
def delay_filter(profile_oversampling: float) -> NDArray[np.float32]:
    """Return the fractional-delay filter for profiles as polynomials of the position between two samples.

    Returns
    -------
    ndarray
        (degree + 1, tap) float32, constant term first; the variable is 0…1 from the previous to the next sample. The
        first tap corresponds to the sample that precedes the previous sample by `tap / 2 - 1` samples.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 7: least-squares fit over the band.

    Examples
    --------
    >>> weights = 0.3 ** np.arange(10) @ delay_filter(2.0)
    >>> tone = np.exp(0.5j * np.pi * 0.9 * (np.arange(12) - 5))
    >>> bool(abs(weights @ tone - np.exp(0.5j * np.pi * 0.9 * 0.3)) < 1e-4)
    True
    """
    omega = np.pi / profile_oversampling * BAND
    basis = np.exp(1j * omega[:, None] * (np.arange(TREE.delays) - TREE.delays // 2 + 1))
    u = 0.5 - 0.5 * np.cos(np.pi * (np.arange(24) + 0.5) / 24)
    ideal = np.exp(1j * omega[:, None] * u)
    matrix, target = (np.concatenate([part.real, part.imag]) for part in (basis, ideal))
    taps = np.linalg.lstsq(matrix, target, rcond=1e-9)[0].T
    return np.ascontiguousarray(np.linalg.lstsq(np.vander(u, _DELAY_DEGREE + 1, increasing=True), taps)[0], np.float32)


def prepare(profiles: Profiles, *, oversampling: int = 24, taps: int = 8) -> Trees:
    """Return the inputs that are common to the trees of all tiles; pulses are later expanded to cells tile by tile.

    Parameters
    ----------
    profiles
        Band-limited profiles.
    oversampling
        Minimum number of table cells per Nyquist cell c/B of total path.
    taps
        Number of taps of the filters from samples to cells, 8 or 16.

    Raises
    ------
    ValueError
        If the oversampling of the profiles is below 1.5, if there is no pulse, or if a position or start is not finite.

    Notes
    -----
    Source: docs/theory/tree.md, "Leaves"; for the cells, docs/theory/engine.md, "Cells".
    """
    samples, start_m, phase_centres = profiles.for_tables()
    contiguous = replace(profiles, samples=samples, start_m=start_m)
    legs = [leaves_of(leg) for leg in phase_centres]
    deviation, rough = parabola_deviation(legs[0]) + parabola_deviation(legs[1]), leaf_roughness(*legs)
    carrier_rad_per_sample = profiles.wavenumber_rad_m * profiles.step_m
    design = cells(profiles.oversampling, carrier_rad_per_sample, float(oversampling), taps)
    polynomials = np.stack([tracks(leg) for leg in legs], axis=1)
    return Trees(
        contiguous,
        design,
        deviation.astype(np.float32),
        rough.astype(np.float32),
        polynomials,
        0,
        DirectTables(contiguous),
    )


# ---- Weights of antennas and of the sector over a tile


class Weighed(NamedTuple):
    """Classification of groups of 64 pulses over a tile by the weights of antennas and sector.

    Attributes
    ----------
    variant
        (group,) uint8, variant of the sum.
    edge
        (group,) bool, True if the sector ends within the tile.
    slope
        (group, 3) float32, change of the depth in the edge of the sector along ξ, along η and over the pulses, each per
        half extent.
    each
        (group,) bool, True if weights change abruptly from pulse to pulse, so that pulses cannot be presummed.
    """

    variant: NDArray[np.uint8]
    edge: NDArray[np.bool_]
    slope: NDArray[np.float32]
    each: NDArray[np.bool_]


def weighed(beams: Beams, aperture: Aperture, surface: Surface, nodes_db: float) -> Weighed:
    """Classify the groups of pulses of an aperture over a tile by their weights.

    Notes
    -----
    Source: docs/theory/tree.md, "Weights".
    """
    pulses, groups = len(aperture), -(-len(aperture) // LEAF)
    tx, rx = (np.ascontiguousarray(leg, np.float64) for leg in aperture.legs)
    deviation_m = np.ascontiguousarray(sum(parabola_deviation(leaves_of(leg)) for leg in aperture.legs), np.float32)
    variant, each, edge = np.zeros((3, groups), np.uint8)
    slope, weight = np.zeros((groups, 3), np.float32), np.zeros((pulses, TREE.weights), np.float32)
    coefficients = np.ascontiguousarray(surface.coefficients)
    tile = TreeTile(
        surface=coefficients.ctypes.data,
        weight=weight.ctypes.data,
        variant=variant.ctypes.data,
        n_virtual_pulses=each.ctypes.data,
        edge=edge.ctypes.data,
        slope=slope.ctypes.data,
        degree=len(coefficients) - 1,
    )
    tile.centre[:] = surface.centre_m.tolist()
    beam, sector, _kept = weights_of(beams, pulses, pulses)
    call(
        "apertura_weigh_tree",
        TreeJob(
            transmitter=tx.ctypes.data,
            receiver=rx.ctypes.data,
            max_track_residual=deviation_m.ctypes.data,
            tiles=ctypes.addressof(tile),
            pulses=pulses,
            count=1,
            node_error=10 ** (nodes_db / 20),
            beam=beam,
            sector=sector,
        ),
    )
    return Weighed(variant, edge.astype(bool), slope, each.astype(bool))


# ---- Trees of a pulse chunk over the tiles of a block


@dataclass(frozen=True, eq=False)
class JobTile:
    """Tile of a block: window, surface of the pixels, and `by_tree`, True if the surface permits a tree."""

    window: Window
    surface: Surface
    by_tree: bool


Task = tuple[JobTile, NDArray[np.bool_]]
"""Tile, and mask of the groups of 64 pulses that are added to this tile, (group,) bool."""


@dataclass(eq=False)
class Chunk:
    """Sum of a pulse chunk over a block of pixels.

    Attributes
    ----------
    trees, beams
        Trees and beams of the pulses.
    nodes_db, presum_db
        Tolerated error of one interpolation, and tolerated error from deviations of the track of a leaf from the fitted
        curve, dB.
    sizes
        Number of pulses of the subapertures of each level.
    pixels, image
        (y, x, 3) float64, pixel positions; and (y, x) complex64, image to which the pulses are added.
    """

    trees: Trees
    beams: Beams | None
    nodes_db: int
    presum_db: int
    sizes: tuple[int, ...]
    pixels: NDArray[np.float64]
    image: NDArray[np.complex64]
    _kept: list[NDArray[np.generic]] = field(default_factory=list)  # arrays referenced by the structs
    _counts: list[NDArray[np.uint8]] = field(default_factory=list)  # node counts of each tile
    _n_virtual: list[NDArray[np.uint8]] = field(default_factory=list)  # virtual pulses of each leaf

    def add(self, tasks: list[Task]) -> list[NDArray[np.uint8]]:
        """Sum the given groups of 64 pulses at each tile by tree; return the variant of each group."""
        variants = [
            np.where(selected, BY_TREE if tile.by_tree else DIRECTLY, NO_ECHO).astype(np.uint8)
            for tile, selected in tasks
        ]
        array = (TreeTile * len(tasks))(
            *(self._struct(tile, variant) for (tile, _), variant in zip(tasks, variants, strict=True))
        )
        job = self._job(array)
        beam, sector, kept = weights_of(self.beams, len(self.trees), len(self.trees))
        job.beam, job.sector = beam, sector
        self._kept += kept
        call("apertura_plan_tree", job)
        for struct, variant in zip(array, variants, strict=True):
            if struct.top < 0:
                variant[variant == BY_TREE] = DIRECTLY
        self._fill(job, array)
        call("apertura_form_tree", job)
        return variants

    def _pointer_to(self, array: NDArray[np.generic]) -> int:
        self._kept.append(array)
        return array.ctypes.data

    def _struct(self, tile: JobTile, variant: NDArray[np.uint8]) -> TreeTile:
        rows, columns = tile.window
        surface, at = tile.surface, rows.start * self.image.shape[1] + columns.start
        counts = np.zeros(sum(2 * -(-len(self.trees) // size) for size in self.sizes), np.uint8)
        self._counts.append(counts)
        n_virtual, edge = np.zeros((2, len(variant)), np.uint8)
        self._n_virtual.append(n_virtual)
        antennas = self.beams and self.beams.antennas
        struct = TreeTile(
            surface=self._pointer_to(np.ascontiguousarray(surface.coefficients)),
            pixels=self.pixels.ctypes.data + 24 * at,
            image=self.image.ctypes.data + 8 * at,
            weight=self._pointer_to(np.zeros((len(self.trees), TREE.weights), np.float32)) if antennas else None,
            variant=self._pointer_to(variant),
            nodes=self._pointer_to(counts),
            n_virtual_pulses=self._pointer_to(n_virtual),
            edge=self._pointer_to(edge),
            slope=self._pointer_to(np.zeros((len(variant), 3), np.float32)),
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
            samples=self._pointer_to(np.ascontiguousarray(profiles.samples)),
            start=self._pointer_to(np.ascontiguousarray(profiles.start_m)),
            transmitter=self._pointer_to(tx),
            receiver=self._pointer_to(rx),
            max_track_residual=self._pointer_to(self.trees.deviation_m),
            rms_track_residual=self._pointer_to(self.trees.rough_m),
            track=self._pointer_to(self.trees.tracks_m),
            delay=self._pointer_to(delay),
            taps=self._pointer_to(np.ascontiguousarray(taps, np.float32)),
            supports=self._pointer_to(supports(self.nodes_db)),
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
            presum_error=10 ** (self.presum_db / 20),
            node_error=10 ** (self.nodes_db / 20),
        )
        job.sizes[: len(self.sizes)], job.curve_degrees[:] = self.sizes, DEGREES
        job.phase_coefficients[:] = design.phase_coefficients.tolist()
        return job

    def _fill(self, job: TreeJob, tiles: "ctypes.Array[TreeTile]") -> None:
        """Add the nodes and the matrices A of eq. 5, 6 and 8 for the node counts of a planned job to the job.

        The tables are indexed by slot. The slot is the node count or, for pixels as targets of the last merge, a higher
        number for each side of a tile.
        """
        # Required matrices A: from the node count of a child to the slot of the node count of its parent, or of the
        # pixels.
        slots: dict[int, int] = {}  # pixels along a side → slot
        merges: set[tuple[int, int]] = set()  # node count, slot
        ends = np.cumsum([-(-len(self.trees) // size) for size in self.sizes])
        for tile, counts in zip(tiles, self._counts, strict=True):
            sides = tile.columns, tile.rows
            tile.column_slot, tile.row_slot = (slots.setdefault(n, TREE.nodes + 1 + len(slots)) for n in sides)
            levels = np.split(counts.reshape(-1, 2), ends[:-1])[: tile.top + 1]  # (subaperture, 2) of each level
            for (children, parents), (size, wider) in zip(pairwise(levels), pairwise(self.sizes), strict=False):
                parent_of = parents[np.arange(len(children)) // (wider // size)]
                merges.update(zip(children.ravel().tolist(), parent_of.ravel().tolist(), strict=True))
            for top in levels[-1:]:
                for axis, slot in enumerate((tile.column_slot, tile.row_slot)):
                    merges.update((count, slot) for count in set(top[:, axis].tolist()))
        side_of = {slot: side for side, slot in slots.items()}
        # Eq. 5: both layouts of each matrix A, and positions of nodes and pixels for the phases u, v and m of eq. 3.
        positions = np.zeros(TREE.slots, np.uintp)
        spread, mix = (np.zeros((TREE.nodes + 1, TREE.slots), np.uintp) for _ in range(2))
        for count, slot in merges:
            by_node, by_target = matrices(count, side_of.get(slot, slot), self.nodes_db, pixels=slot in side_of)
            spread[count, slot], mix[count, slot] = self._pointer_to(by_node), self._pointer_to(by_target)
        for slot in {slot for merge in merges for slot in merge}:
            targets = pixel_places(side_of[slot]) if slot in side_of else nodes(slot, self.nodes_db)
            positions[slot] = self._pointer_to(np.ascontiguousarray(targets))
        # Eq. 8: weights A_pv of the pulses of a leaf in virtual pulses, and track polynomials at the virtual pulses.
        presum, curves = (np.zeros(TREE.virtual + 1, np.uintp) for _ in range(2))
        for count in {int(n) for counts in self._n_virtual for n in counts if n > 1}:
            presum[count] = self._pointer_to(
                np.ascontiguousarray(matrices(count, LEAF, self.nodes_db, pixels=True)[1].T)
            )
            positions[count] = self._pointer_to(np.ascontiguousarray(nodes(count, self.nodes_db)))
            curves[count] = self._pointer_to(curve(count, self.nodes_db))
        job.places, job.spread, job.mix = map(self._pointer_to, (positions, spread, mix))
        job.presum, job.curve = map(self._pointer_to, (presum, curves))
