"""Refinement of tracks by the coherence of speckle between two pairs at equal spatial frequencies of the terrain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Bools, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain
from apertura.methods.autofocus.inputs import PairRecord, Prior, Refinement
from apertura.methods.autofocus.objective import Blocks, Contribution, PatchEcho, Tracks, phases
from apertura.methods.autofocus.patches import Patch
from apertura.methods.autofocus.solve import Gauge, minimise

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# ---- Tiles of the scene on which two pairs are compared -------------------------------------------------------------


MOST_TILES = 64
"""Maximum number of tiles; if a scene has more, the tiles about its centre are used."""

SAMPLING = 0.85
"""Pixel density relative to the Nyquist rate of the image; less than 1 suffices, because products of images are
summed.
"""

_CELLS_WIDE = 2.5  # width of a tile, in cross-range cells of the aperture flown within a correlation time
_STEPS = 64  # pulses sampled for the size and pixels of a tile


@dataclass(frozen=True, eq=False)
class SpeckleTile:
    """Square tile of the terrain.

    Attributes
    ----------
    patch
        Centre and pixels of the tile.
    sides_m
        (2, 3) float64, vectors from the northern to the southern and from the western to the eastern edge, metres in
        the frame.
    """

    patch: Patch
    sides_m: Floats


def tiles(
    records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain, *, correlation_s: float
) -> list[SpeckleTile]:
    """Return square tiles that cover the scene without gaps, with pixels fine enough for the sharpest pair.

    Parameters
    ----------
    records
        Records of all pairs.
    grid, terrain
        The scene.
    correlation_s
        Correlation time of track errors.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 22.

    Examples
    --------
    >>> from apertura.core.backprojection.inputs import Profiles
    >>> from apertura.core.geometry.aperture import Aperture
    >>> from apertura.core.scene.terrain import FlatGround
    >>> time_s = np.arange(0, 20, 0.1)
    >>> track = np.stack([time_s - 10, np.zeros(200), np.full(200, 10.0)], -1)
    >>> silent = np.zeros((200, 100), np.complex64)
    >>> profiles = Profiles(silent, np.full(200, 20.0), 0.366, 1.4e9, 2.0, Aperture(track, track))
    >>> grid = SceneGrid("local", -9.0, 24.0, 0.5, (36, 36))
    >>> scene_tiles = tiles([PairRecord("a-a", profiles, time_s)], grid, FlatGround(0.0), correlation_s=1.0)
    >>> len(scene_tiles), scene_tiles[0].sides_m.round(1).tolist()
    (9, [[0.0, -6.0, 0.0], [6.0, 0.0, 0.0]])
    """
    middle = terrain.positions_at(grid, (grid.shape[0] - 1) / 2, (grid.shape[1] - 1) / 2)
    side_m = tile_side_m(middle, records, correlation_s=correlation_s)
    counts = np.maximum(1, np.round(np.array(grid.shape) * grid.spacing_m / side_m)).astype(int)
    share = min(1.0, float(np.sqrt(MOST_TILES / counts.prod())))
    size, selected = np.array(grid.shape) / counts, np.maximum(1, counts * share).astype(int)
    first = (counts - selected) // 2
    corners = [size * (first + index) for index in np.ndindex(*selected)]
    return [_tile(corner, size, records, grid, terrain) for corner in corners]


def tile_side_m(place_m: Floats, records: Sequence[PairRecord], *, correlation_s: float) -> float:
    """Return the tile width that resolves track errors within their correlation time, metres.

    Parameters
    ----------
    place_m
        (3,) float64, scene centre, metres in the frame.
    records
        Records of all pairs.
    correlation_s
        Correlation time of track errors.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 22.
    """
    sides = []
    for record in records:
        first_s = np.linspace(record.time_s[0], record.time_s[-1] - correlation_s, _STEPS)
        pulses = [
            np.searchsorted(record.time_s, time_s).clip(max=len(record.time_s) - 1)
            for time_s in (first_s, first_s + correlation_s)
        ]
        before, after = (record.profiles.aperture[indices].path_gradient(place_m) for indices in pulses)
        angle_rad = float(np.median(np.linalg.norm(after - before, axis=-1)))
        sides.append(_CELLS_WIDE * SPEED_OF_LIGHT_M_S / (record.profiles.centre_frequency_hz * max(angle_rad, 1e-9)))
    return max(sides)


def _tile(
    corner: Floats, size: Floats, records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain
) -> SpeckleTile:
    """Return a tile of the grid from its corner and size, both in pixels (row, column)."""
    place, below, right = (
        terrain.positions_at(grid, *(corner + size * np.array(fraction) - 0.5))
        for fraction in ((0.5, 0.5), (1, 0.5), (0.5, 1))
    )
    sides_m = 2 * np.stack([below - place, right - place])
    cycles = []
    for record in records:
        aperture, band_hz = record.profiles.aperture, np.array([-0.5, 0.5]) * record.profiles.bandwidth_hz
        slope = aperture[aperture.sample(_STEPS)].path_gradient(place) @ sides_m.T
        wavenumbers = (record.profiles.centre_frequency_hz + band_hz) / SPEED_OF_LIGHT_M_S
        cycles.append(np.ptp(np.concatenate([slope * wavenumber for wavenumber in wavenumbers]), axis=0))
    counts = np.ceil(np.max(cycles, axis=0) / SAMPLING).astype(int) + 1
    rows, columns = (
        start + step * (np.arange(count) + 0.5) / count - 0.5
        for start, step, count in zip(corner, size, counts, strict=True)
    )
    pixels = terrain.positions_at(grid, *np.meshgrid(rows, columns, indexing="ij"))
    return SpeckleTile(Patch(place, pixels.reshape(-1, 3)), sides_m)


# ---- Coherence of two pairs at equal spatial frequencies of the terrain ---------------------------------------------

WEIGHT = 0.2
"""Weight in the objective of a resolution cell that two pairs share; docs/theory/autofocus.md, "Speckle"."""

_BLOCKS = 64  # blocks of the first pair that are multiplied at once with overlapping blocks of the second


@dataclass(frozen=True, eq=False)
class TileCoherence:
    """Coherence of a tile between the images of two pairs.

    Attributes
    ----------
    product
        (block of the first pair, block of the second pair) sparse complex64: Σ conj(B)·B' over the tile, divided by the
        energy of the two images of the tile and weighted by the spatial frequencies that both blocks share.
    cells
        Effective number of resolution cells: all cells of a tile with speckle; few if a point dominates the tile,
        because the spatial frequencies of a point are not independent.
    brightness
        Mean power of both images.
    contributions
        Blocks of each pair that illuminate the tile, and their path gradients, without the values.
    """

    product: "csr_array"
    cells: float
    brightness: float
    contributions: tuple[Contribution, Contribution]

    @classmethod
    def of(cls, tile: SpeckleTile, first: Contribution, second: Contribution) -> "TileCoherence":
        """Return the coherence of a tile from the cached contributions of two pairs."""
        powers = np.stack([np.abs(one.values.sum(axis=1)).astype(np.float64) ** 2 for one in (first, second)])
        energy = np.maximum(powers.sum(axis=1), 1e-300)
        even = 2 * energy**2 / np.maximum((powers**2).sum(axis=1), 1e-300)
        between = float(np.sqrt(energy.prod()))
        pixels, nothing = len(first.values), np.zeros((0, 0), np.complex64)
        cells = SAMPLING**2 * min(pixels, float(even.min()))
        return cls(
            _product(tile, first, second) / np.float32(between),
            cells,
            between / pixels,
            (replace(first, values=nothing), replace(second, values=nothing)),
        )

    def coherence(self, moved: Sequence[Tracks]) -> tuple[complex, list[NDArray[np.complex64]]]:
        """Return the coherence Σ conj(I)·I', normalised by the energies, and the contributions of both pairs' blocks.

        `moved` contains the displacements of the nodes of each pair, node → (block, 3) metres.
        """
        first, second = (
            np.exp(sign * 1j * phases(contribution, one)).astype(np.complex64)
            for sign, contribution, one in zip((-1, 1), self.contributions, moved, strict=True)
        )
        by_first = first * (self.product @ second)
        return complex(by_first.sum()), [by_first, second * (self.product.T @ first)]


def _product(tile: SpeckleTile, first: Contribution, second: Contribution) -> "csr_array":
    """Return (block, block) complex64, O ∘ BᴴB' of eq. 21.

    O is 1 for two blocks with the same direction of view, and 0 if the directions differ by the angular resolution of
    the tile or more. Only blocks that share spatial frequencies are multiplied and stored; their number per block does
    not depend on the length of the flight.
    """
    from scipy.sparse import csr_array  # slow to import

    # Spatial frequencies k·g of each block, cycles over the tile's sides, (block, 2); `across` is the unit normal to
    # the frequencies of the first pair, along which the frequencies of the second are compared.
    cycles = [one.wavenumber / (2 * np.pi) * sum(one.slopes.values()) @ tile.sides_m.T for one in (first, second)]
    across = cycles[0][:, ::-1] * [-1, 1] / np.linalg.norm(cycles[0], axis=1, keepdims=True)
    along = np.sum(across * cycles[0], axis=1)[:, None]
    values, rows, columns = [np.zeros(0, np.complex64)], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for start in range(0, len(across), _BLOCKS):
        block_slice = slice(start, start + _BLOCKS)
        # O of eq. 21, (1 − |difference in cycles|)₊, then O ∘ BᴴB' over the overlapping blocks.
        shared = np.maximum(1 - np.abs(along[block_slice] - across[block_slice] @ cycles[1].T), 0).astype(np.float32)
        sharing = np.flatnonzero(shared.any(axis=0))
        if sharing.size:
            near = slice(int(sharing[0]), int(sharing[-1]) + 1)
            row, column = np.nonzero(shared[:, near])
            product = first.values[:, block_slice].conj().T @ second.values[:, near] * shared[:, near]
            values.append(product[row, column])
            rows.append(row + start)
            columns.append(column + near.start)
    at = np.concatenate(rows), np.concatenate(columns)
    return csr_array((np.concatenate(values), at), shape=(len(across), len(cycles[1])))


@dataclass(frozen=True, eq=False)
class SpeckleAgreement:
    """Objective -w |Σ n·γ|: coherence of the images of two pairs over all tiles, up to a common phase.

    Attributes
    ----------
    pairs
        Blocks of both pairs.
    tiles
        Coherence of each tile between the pairs.
    reference
        Node → (knot, 3) float64, metres: track corrections of the cached contributions.
    weight
        Weight w of a resolution cell.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 20 and 21.
    """

    pairs: tuple[Blocks, Blocks]
    tiles: Sequence[TileCoherence]
    reference: Tracks
    weight: float = WEIGHT

    def __call__(self, tracks: Tracks) -> tuple[float, dict[str, Floats]]:
        """Return the value and its derivatives with respect to the corrections, node → (knot, 3)."""
        moved, coherences = self._evaluate(tracks)
        total = sum(tile.cells * coherence for tile, (coherence, _) in zip(self.tiles, coherences, strict=True))
        rotation = np.exp(-1j * np.angle(total))
        slopes = [{node: np.zeros_like(move) for node, move in one.items()} for one in moved]
        for tile, (_, shares) in zip(self.tiles, coherences, strict=True):
            for contribution, slope, share, sign in zip(tile.contributions, slopes, shares, (-1, 1), strict=True):
                by_path = sign * self.weight * tile.cells * contribution.wavenumber * (rotation * share).imag
                for node, path in contribution.slopes.items():
                    slope[node][contribution.blocks] += by_path[:, None] * path
        gradient = {node: np.zeros_like(track) for node, track in tracks.items()}
        for blocks, slope in zip(self.pairs, slopes, strict=True):
            for node, by_block in slope.items():
                gradient[node] += blocks.average.T @ by_block
        return -self.weight * abs(total), gradient

    def coherence(self, tracks: Tracks) -> NDArray[np.complex128]:
        """Return (tile,) complex128, the complex coherence of the two images of each tile."""
        return np.array([value for value, _ in self._evaluate(tracks)[1]])

    def _evaluate(self, tracks: Tracks) -> tuple[list[Tracks], list[tuple[complex, list[NDArray[np.complex64]]]]]:
        moved = [
            blocks.moves({node: tracks[node] - self.reference[node] for node in blocks.record.nodes})
            for blocks in self.pairs
        ]
        return moved, [tile.coherence(moved) for tile in self.tiles]


@dataclass(frozen=True, eq=False)
class SpeckleTiles:
    """Tiles of the scene with the echoes of all pairs of a flight.

    Attributes
    ----------
    pairs
        Blocks of each pair.
    tiles
        Tiles of the scene.
    echoes
        Pair → tile → summed echoes of the tile.
    """

    pairs: Sequence[Blocks]
    tiles: Sequence[SpeckleTile]
    echoes: Sequence[Sequence[PatchEcho]]

    @classmethod
    def of(cls, pairs: Sequence[Blocks], tiles: Sequence[SpeckleTile]) -> "SpeckleTiles":
        """Return the tiles with the summed echoes of all pairs."""
        return cls(pairs, tiles, [blocks.echoes([tile.patch for tile in tiles]) for blocks in pairs])

    def agreements(self, tracks: Tracks, used: NDArray[np.bool_] | None = None) -> list[SpeckleAgreement]:
        """Return the coherence objectives of all combinations of two pairs on the used tiles, at given corrections."""
        moved = [blocks.moves(tracks) for blocks in self.pairs]
        coherences: dict[tuple[int, int], list[TileCoherence]]
        coherences = {pairs: [] for pairs in combinations(range(len(self.pairs)), 2)}
        for number, tile in enumerate(self.tiles):
            if used is None or used[number]:
                contribution = [
                    blocks.contribution(echoes[number], displacement)
                    for blocks, echoes, displacement in zip(self.pairs, self.echoes, moved, strict=True)
                ]
                for (first, second), of_pairs in coherences.items():
                    of_pairs.append(TileCoherence.of(tile, contribution[first], contribution[second]))
        return [
            SpeckleAgreement(
                (self.pairs[first], self.pairs[second]), self._weighted_by_brightness(of_pairs, first, used), tracks
            )
            for (first, second), of_pairs in coherences.items()
        ]

    def _weighted_by_brightness(
        self, coherences: Sequence[TileCoherence], pair: int, used: NDArray[np.bool_] | None
    ) -> list[TileCoherence]:
        """Return the tiles with reduced cell numbers of dark tiles, in which sidelobes of brighter tiles may dominate.

        Brightness is corrected for the decrease of echo power with the squares of both distances.
        """
        brightness = []
        for coherence, tile in zip(
            coherences, (tile for n, tile in enumerate(self.tiles) if used is None or used[n]), strict=True
        ):
            tx_m2, rx_m2 = (np.sum((leg - tile.patch.place_m) ** 2, axis=1) for leg in self.pairs[pair].aperture.legs)
            brightness.append(coherence.brightness / float(np.mean(1 / (tx_m2 * rx_m2))))
        shares = np.minimum(1, np.array(brightness) / max(float(np.mean(brightness)), 1e-300))
        return [
            replace(coherence, cells=coherence.cells * float(share))
            for coherence, share in zip(coherences, shares, strict=True)
        ]


# ---- Refinement by speckle ------------------------------------------------------------------------------------------


LEAST_COHERENCE = 0.75
"""Minimum coherence of held-out tiles, 0 to 1; tracks with errors of a cycle or more do not reach this coherence."""

LEAST_GAIN = 0.1
"""Minimum increase of the coherence of held-out tiles."""

LEAST_EVEN = 0.25
"""Minimum fraction of resolution cells that contribute speckle; sidelobes of few points may be coherent for wrong
tracks.
"""

LEAST_TILES = 8
"""Minimum number of tiles, some of which are held out for validation."""

_STAGES, _ITERATIONS = 2, 15  # rounds of caching contributions; steps of L-BFGS-B in each round
_HELD_OUT = 4  # every fourth tile is held out of the fit


@dataclass(frozen=True)
class SpeckleEvidence:
    """Coherence of held-out tiles before and after the refinement.

    Attributes
    ----------
    before, after
        Mean coherence of a tile between the images of two pairs.
    tiles
        Number of tiles.
    even
        Effective fraction of resolution cells that contribute speckle.
    """

    before: float
    after: float
    tiles: int
    even: float

    @property
    def accepted(self) -> bool:
        """True if the tracks are used."""
        return self.after >= max(LEAST_COHERENCE, self.before + LEAST_GAIN) and self.even >= LEAST_EVEN

    @property
    def reason(self) -> str:
        """Reason of acceptance or rejection, one line."""
        line = f"coherence of two pairs on held-out tiles changed from {self.before:.2f} to {self.after:.2f}"
        if self.accepted:
            return line
        if self.even < LEAST_EVEN:
            return (
                f"only {self.even:.0%} of the resolution cells contribute speckle, {LEAST_EVEN:.0%} are required: "
                "bright points dominate"
            )
        return f"{line}; a coherence of {LEAST_COHERENCE} and an increase of {LEAST_GAIN} are required"


def refined_by_speckle(ground: SpeckleTiles, prior: Prior, knots_s: Floats) -> Refinement:
    """Refine tracks by maximum speckle coherence between pairs, validated on held-out tiles.

    Parameters
    ----------
    ground
        Tiles of all pairs.
    prior
        Prior of the nodes.
    knots_s
        (knot,) float64, times of the corrections.

    Notes
    -----
    Source: docs/theory/autofocus.md, "Speckle". The returned standard deviations are those of the logs; eq. 23 would
    reduce them by at most half.
    """
    unrefined, count = np.zeros(prior.size), len(ground.tiles)
    std_m = {
        name: np.tile(np.sqrt((node.std_m**2) @ node.axes**2), (len(knots_s), 1)) for name, node in prior.nodes.items()
    }
    if len(ground.pairs) < 2 or count < LEAST_TILES:
        reason = (
            "speckle refinement requires two pairs"
            if len(ground.pairs) < 2
            else f"speckle refinement requires {LEAST_TILES} tiles, the scene has {count}"
        )
        flags = {"refinement_no_bright_point": reason}
        return Refinement(
            TrackCorrection(knots_s, prior.tracks(unrefined)), std_m, False, reason, {"tiles": count}, flags
        )
    held_out = np.arange(count) % _HELD_OUT == 2
    before = _coherence(ground, prior, unrefined, held_out)
    after = _coherence(ground, prior, _solved(ground, prior, ~held_out), held_out)
    evidence = SpeckleEvidence(
        before[0], after[0], count, _coherence(ground, prior, unrefined, np.ones_like(held_out))[1]
    )
    refined = _solved(ground, prior, np.ones_like(held_out)) if evidence.accepted else unrefined
    coherence = [round(evidence.before, 3), round(evidence.after, 3)]
    report: dict[str, Any] = {"tiles": count, "even": round(evidence.even, 3), "coherence": coherence}
    flags = {} if evidence.accepted else {"refinement_rejected": evidence.reason}
    correction = TrackCorrection(knots_s, prior.tracks(refined))
    return Refinement(correction, std_m, evidence.accepted, evidence.reason, report, flags)


def _solved(ground: SpeckleTiles, prior: Prior, used: Bools) -> Floats:
    """Return the unknowns that maximise the coherence between pairs on the used tiles."""
    unknowns = np.zeros(prior.size)
    for _ in range(_STAGES):
        agreements = ground.agreements(prior.tracks(unknowns), used)

        def value(tracks: Tracks, every: Sequence[SpeckleAgreement] = agreements) -> tuple[float, dict[str, Floats]]:
            evaluated = [agreement(tracks) for agreement in every]
            gradient = {node: np.sum([by_node[node] for _, by_node in evaluated], axis=0) for node in tracks}
            return sum(of_pairs for of_pairs, _ in evaluated), gradient

        unknowns = minimise(value, prior, Gauge.none(prior.size), unknowns, iterations=_ITERATIONS)
    return unknowns


def _coherence(ground: SpeckleTiles, prior: Prior, unknowns: Floats, used: Bools) -> tuple[float, float]:
    """Return the mean coherence of the used tiles, and the effective fraction of their cells."""
    tracks = prior.tracks(unknowns)
    agreements = ground.agreements(tracks, used)
    weights = np.concatenate([[tile.cells for tile in one.tiles] for one in agreements])
    values = np.concatenate([np.abs(one.coherence(tracks)) for one in agreements])
    cells = SAMPLING**2 * sum(len(tile.patch.pixels_m) for tile, one in zip(ground.tiles, used, strict=True) if one)
    total = float(weights.sum())
    return float(weights @ values / max(total, 1e-300)), total / (cells * len(agreements))
