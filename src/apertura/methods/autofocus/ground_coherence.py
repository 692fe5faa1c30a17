"""Refinement of tracks by the coherence of the ground: speckle that two pairs share at equal spatial frequencies."""

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
"""Of a larger scene, tiles about its middle."""

SAMPLING = 0.85
"""Pixels over Nyquist of the image: products of two images are only summed."""

_CELLS_WIDE = 2.5  # of a tile, in cells of an aperture that is flown while an error lasts
_STEPS = 64  # pulses sampled for the size and pixels of a tile


@dataclass(frozen=True, eq=False)
class SpeckleTile:
    """A square of the ground.

    Attributes
    ----------
    patch
        Its middle and pixels.
    sides_m
        (2, 3) float64, metres in the frame: from its northern edge to the southern, from the western to the eastern.
    """

    patch: Patch
    sides_m: Floats


def tiles(
    records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain, *, correlation_s: float
) -> list[SpeckleTile]:
    """Return squares that cover the scene without gaps, their pixels as fine as the sharpest pair needs.

    Parameters
    ----------
    records
        All pairs.
    grid, terrain
        The scene.
    correlation_s
        How long an error of the tracks lasts.

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
    >>> found = tiles([PairRecord("a-a", profiles, time_s)], grid, FlatGround(0.0), correlation_s=1.0)
    >>> len(found), found[0].sides_m.round(1).tolist()
    (9, [[0.0, -6.0, 0.0], [6.0, 0.0, 0.0]])
    """
    middle = terrain.positions_at(grid, (grid.shape[0] - 1) / 2, (grid.shape[1] - 1) / 2)
    side_m = tile_side_m(middle, records, correlation_s=correlation_s)
    counts = np.maximum(1, np.round(np.array(grid.shape) * grid.spacing_m / side_m)).astype(int)
    share = min(1.0, float(np.sqrt(MOST_TILES / counts.prod())))
    size, taken = np.array(grid.shape) / counts, np.maximum(1, counts * share).astype(int)
    first = (counts - taken) // 2
    corners = [size * (first + place) for place in np.ndindex(*taken)]
    return [_tile(corner, size, records, grid, terrain) for corner in corners]


def tile_side_m(place_m: Floats, records: Sequence[PairRecord], *, correlation_s: float) -> float:
    """Return the width of tiles that resolves the errors of the tracks within their correlation time, metres.

    Parameters
    ----------
    place_m
        (3,) float64, metres in the frame: the middle of the scene.
    records
        All pairs.
    correlation_s
        How long an error of the tracks lasts.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 22.
    """
    sides = []
    for one in records:
        first_s = np.linspace(one.time_s[0], one.time_s[-1] - correlation_s, _STEPS)
        pulses = [
            np.searchsorted(one.time_s, at).clip(max=len(one.time_s) - 1) for at in (first_s, first_s + correlation_s)
        ]
        before, after = (one.profiles.aperture[some].path_gradient(place_m) for some in pulses)
        turned = float(np.median(np.linalg.norm(after - before, axis=-1)))
        sides.append(_CELLS_WIDE * SPEED_OF_LIGHT_M_S / (one.profiles.centre_frequency_hz * max(turned, 1e-9)))
    return max(sides)


def _tile(
    corner: Floats, size: Floats, records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain
) -> SpeckleTile:
    """Return a tile of the grid from its corner and size, both in pixels (row, column)."""
    place, below, right = (
        terrain.positions_at(grid, *(corner + size * np.array(part) - 0.5)) for part in ((0.5, 0.5), (1, 0.5), (0.5, 1))
    )
    sides_m = 2 * np.stack([below - place, right - place])
    cycles = []
    for one in records:
        aperture, band_hz = one.profiles.aperture, np.array([-0.5, 0.5]) * one.profiles.bandwidth_hz
        slope = aperture[aperture.sample(_STEPS)].path_gradient(place) @ sides_m.T
        wavenumbers = (one.profiles.centre_frequency_hz + band_hz) / SPEED_OF_LIGHT_M_S
        cycles.append(np.ptp(np.concatenate([slope * wavenumber for wavenumber in wavenumbers]), axis=0))
    counts = np.ceil(np.max(cycles, axis=0) / SAMPLING).astype(int) + 1
    rows, columns = (
        start + step * (np.arange(count) + 0.5) / count - 0.5
        for start, step, count in zip(corner, size, counts, strict=True)
    )
    pixels = terrain.positions_at(grid, *np.meshgrid(rows, columns, indexing="ij"))
    return SpeckleTile(Patch(place, pixels.reshape(-1, 3)), sides_m)


# ---- Coherence of two pairs at equal spatial frequencies of the ground ----------------------------------------------

WEIGHT = 0.2
"""Of a resolution cell that two pairs share; docs/theory/autofocus.md, "Speckle"."""

_BLOCKS = 64  # of the first pair, multiplied at once with those of the second that they share something with


@dataclass(frozen=True, eq=False)
class TileCoherence:
    """A tile in the images of two pairs.

    Attributes
    ----------
    product
        (block of the first, block of the second) sparse complex64: Σ conj(B)·B' over the tile, by its two images'
        energies and weighed by the spatial frequencies that both blocks share.
    cells
        Resolution cells that count: all of a tile of speckle; few where a point stands out, whose spatial frequencies
        are not independent.
    brightness
        Mean power of both images.
    contributions
        Blocks of each pair that illuminate it and their path slopes, without values.
    """

    product: "csr_array"
    cells: float
    brightness: float
    contributions: tuple[Contribution, Contribution]

    @classmethod
    def of(cls, tile: SpeckleTile, first: Contribution, second: Contribution) -> "TileCoherence":
        """Return the product of a tile's contributions in two pairs, along the tracks that they were cached at."""
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
        """Return Σ conj(I)·I' by the images' energies, and the part of each block of both pairs in it.

        Where the nodes of each pair's blocks have moved, node → (block, 3), metres.
        """
        first, second = (
            np.exp(sign * 1j * phases(contribution, one)).astype(np.complex64)
            for sign, contribution, one in zip((-1, 1), self.contributions, moved, strict=True)
        )
        by_first = first * (self.product @ second)
        return complex(by_first.sum()), [by_first, second * (self.product.T @ first)]


def _product(tile: SpeckleTile, first: Contribution, second: Contribution) -> "csr_array":
    """Return (block, block) complex64, O ∘ BᴴB' of eq. 21.

    O is 1 where both blocks look along one line, 0 from a resolvable angle on. Only blocks that share spatial
    frequencies are multiplied and kept: of a block as many as there are while an error lasts, however long the flight.
    """
    from scipy.sparse import csr_array  # slow to import

    # Spatial frequencies k·g of each block, cycles over the tile's sides, (block, 2); `across` is the unit normal of
    # one, along which those of the other pair are compared with it.
    cycles = [one.wavenumber / (2 * np.pi) * sum(one.slopes.values()) @ tile.sides_m.T for one in (first, second)]
    across = cycles[0][:, ::-1] * [-1, 1] / np.linalg.norm(cycles[0], axis=1, keepdims=True)
    along = np.sum(across * cycles[0], axis=1)[:, None]
    values, rows, columns = [np.zeros(0, np.complex64)], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for begin in range(0, len(across), _BLOCKS):
        some = slice(begin, begin + _BLOCKS)
        # O of eq. 21, (1 − |cycles apart|)₊, then O ∘ BᴴB' over the blocks that share any.
        shared = np.maximum(1 - np.abs(along[some] - across[some] @ cycles[1].T), 0).astype(np.float32)
        sharing = np.flatnonzero(shared.any(axis=0))
        if sharing.size:
            near = slice(int(sharing[0]), int(sharing[-1]) + 1)
            row, column = np.nonzero(shared[:, near])
            product = first.values[:, some].conj().T @ second.values[:, near] * shared[:, near]
            values.append(product[row, column])
            rows.append(row + begin)
            columns.append(column + near.start)
    at = np.concatenate(rows), np.concatenate(columns)
    return csr_array((np.concatenate(values), at), shape=(len(across), len(cycles[1])))


@dataclass(frozen=True, eq=False)
class SpeckleAgreement:
    """-w |Σ n·γ|: coherence of the images of two pairs over all tiles, up to one phase.

    Attributes
    ----------
    pairs
        Blocks of both.
    tiles
        Of both.
    reference
        Node → (knot, 3) float64, metres: corrections that the tiles' contributions were cached at.
    weight
        Of a resolution cell.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 20 and 21.
    """

    pairs: tuple[Blocks, Blocks]
    tiles: Sequence[TileCoherence]
    reference: Tracks
    weight: float = WEIGHT

    def __call__(self, tracks: Tracks) -> tuple[float, dict[str, Floats]]:
        """Return the value and its derivatives by the corrections, node → (knot, 3)."""
        moved, found = self._evaluate(tracks)
        total = sum(tile.cells * coherence for tile, (coherence, _) in zip(self.tiles, found, strict=True))
        turn = np.exp(-1j * np.angle(total))
        slopes = [{node: np.zeros_like(move) for node, move in one.items()} for one in moved]
        for tile, (_, parts) in zip(self.tiles, found, strict=True):
            for contribution, slope, part, sign in zip(tile.contributions, slopes, parts, (-1, 1), strict=True):
                by_path = sign * self.weight * tile.cells * contribution.wavenumber * (turn * part).imag
                for node, path in contribution.slopes.items():
                    slope[node][contribution.blocks] += by_path[:, None] * path
        gradient = {node: np.zeros_like(track) for node, track in tracks.items()}
        for blocks, slope in zip(self.pairs, slopes, strict=True):
            for node, by_block in slope.items():
                gradient[node] += blocks.average.T @ by_block
        return -self.weight * abs(total), gradient

    def coherence(self, tracks: Tracks) -> NDArray[np.complex128]:
        """Return (tile,) complex128, coherence of the two images of each tile and the phase between them."""
        return np.array([value for value, _ in self._evaluate(tracks)[1]])

    def _evaluate(self, tracks: Tracks) -> tuple[list[Tracks], list[tuple[complex, list[NDArray[np.complex64]]]]]:
        moved = [
            blocks.moves({node: tracks[node] - self.reference[node] for node in blocks.record.nodes})
            for blocks in self.pairs
        ]
        return moved, [tile.coherence(moved) for tile in self.tiles]


@dataclass(frozen=True, eq=False)
class SpeckleTiles:
    """The scene in tiles, with the echoes of all pairs of a flight.

    Attributes
    ----------
    pairs
        Blocks of each.
    tiles
        Of the scene.
    echoes
        Pair → tile → its summed echoes.
    """

    pairs: Sequence[Blocks]
    tiles: Sequence[SpeckleTile]
    echoes: Sequence[Sequence[PatchEcho]]

    @classmethod
    def of(cls, pairs: Sequence[Blocks], tiles: Sequence[SpeckleTile]) -> "SpeckleTiles":
        """Return the tiles with their echoes."""
        return cls(pairs, tiles, [blocks.echoes([tile.patch for tile in tiles]) for blocks in pairs])

    def agreements(self, tracks: Tracks, used: NDArray[np.bool_] | None = None) -> list[SpeckleAgreement]:
        """Return the agreement of every two pairs on the tiles used, along corrections node → (knot, 3), metres."""
        moved = [blocks.moves(tracks) for blocks in self.pairs]
        both = list(combinations(range(len(self.pairs)), 2))
        alike: dict[tuple[int, int], list[TileCoherence]] = {pairs: [] for pairs in both}
        for number, tile in enumerate(self.tiles):
            if used is None or used[number]:
                contribution = [
                    blocks.contribution(echoes[number], at)
                    for blocks, echoes, at in zip(self.pairs, self.echoes, moved, strict=True)
                ]
                for one, other in both:
                    alike[one, other].append(TileCoherence.of(tile, contribution[one], contribution[other]))
        return [
            SpeckleAgreement(
                (self.pairs[one], self.pairs[other]), self._weighted_by_brightness(found, one, used), tracks
            )
            for (one, other), found in alike.items()
        ]

    def _weighted_by_brightness(
        self, alike: Sequence[TileCoherence], pair: int, used: NDArray[np.bool_] | None
    ) -> list[TileCoherence]:
        """Return tiles, the darker ones with fewer cells: sidelobes of brighter ones cover them.

        Brightness is that of the ground: echoes fall off with the square of both distances.
        """
        bright = []
        for one, tile in zip(
            alike, (tile for n, tile in enumerate(self.tiles) if used is None or used[n]), strict=True
        ):
            there, back = (np.sum((leg - tile.patch.place_m) ** 2, axis=1) for leg in self.pairs[pair].aperture.legs)
            bright.append(one.brightness / float(np.mean(1 / (there * back))))
        share = np.minimum(1, np.array(bright) / max(float(np.mean(bright)), 1e-300))
        return [replace(one, cells=one.cells * float(part)) for one, part in zip(alike, share, strict=True)]


# ---- Refinement by speckle ------------------------------------------------------------------------------------------


LEAST_COHERENCE = 0.75
"""Of tiles that were not fitted, 0 to 1: tracks that are wrong by cycles leave less."""

LEAST_GAIN = 0.1
"""Least growth of the coherence of those tiles."""

LEAST_EVEN = 0.25
"""Least share of the ground that must be even: sidelobes of a few points agree by chance."""

LEAST_TILES = 8
"""Least number of tiles: with fewer, none would be left for validation."""

_STAGES, _ITERATIONS = 2, 15  # of caching contributions; steps of L-BFGS-B in each
_HELD_OUT = 4  # every fourth tile is left out of the fit


@dataclass(frozen=True)
class SpeckleEvidence:
    """Coherence of tiles that were not fitted, before and after.

    Attributes
    ----------
    before, after
        Mean coherence of two pairs' images of a tile.
    tiles
        How many there are.
    even
        Share of the ground's resolution cells that count.
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
    def why(self) -> str:
        """One line."""
        grown = f"coherence of two pairs went from {self.before:.2f} to {self.after:.2f} on ground that was not fitted"
        if self.accepted:
            return grown
        if self.even < LEAST_EVEN:
            return f"only {self.even:.0%} of the ground is even, {LEAST_EVEN:.0%} are needed: points stand out"
        return f"{grown}: {LEAST_COHERENCE} and {LEAST_GAIN} more than before are needed"


def refined_by_speckle(ground: SpeckleTiles, prior: Prior, knots_s: Floats) -> Refinement:
    """Return the corrections at which pairs agree on the ground, and whether they are accepted.

    Parameters
    ----------
    ground
        Tiles of all pairs.
    prior
        Of the nodes.
    knots_s
        (knot,) float64, times of the corrections.

    Notes
    -----
    Source: docs/theory/autofocus.md, "Speckle". The standard deviations are the log's: eq. 23 makes them smaller by no
    more than a half.
    """
    nothing, count = np.zeros(prior.size), len(ground.tiles)
    std_m = {
        name: np.tile(np.sqrt((node.std_m**2) @ node.axes**2), (len(knots_s), 1)) for name, node in prior.nodes.items()
    }
    if len(ground.pairs) < 2 or count < LEAST_TILES:
        why = (
            "speckle of one pair does not determine its tracks"
            if len(ground.pairs) < 2
            else f"{count} tiles are too few"
        )
        flags = {"refinement_no_bright_point": why}
        return Refinement(TrackCorrection(knots_s, prior.tracks(nothing)), std_m, False, why, {"tiles": count}, flags)
    held_out = np.arange(count) % _HELD_OUT == 2
    before = _coherence(ground, prior, nothing, held_out)
    after = _coherence(ground, prior, _solved(ground, prior, ~held_out), held_out)
    evidence = SpeckleEvidence(
        before[0], after[0], count, _coherence(ground, prior, nothing, np.ones_like(held_out))[1]
    )
    found = _solved(ground, prior, np.ones_like(held_out)) if evidence.accepted else nothing
    coherence = [round(evidence.before, 3), round(evidence.after, 3)]
    report: dict[str, Any] = {"tiles": count, "even": round(evidence.even, 3), "coherence": coherence}
    flags = {} if evidence.accepted else {"refinement_rejected": evidence.why}
    correction = TrackCorrection(knots_s, prior.tracks(found))
    return Refinement(correction, std_m, evidence.accepted, evidence.why, report, flags)


def _solved(ground: SpeckleTiles, prior: Prior, used: Bools) -> Floats:
    """Return the unknowns with which pairs agree best on the tiles used."""
    unknowns = np.zeros(prior.size)
    for _ in range(_STAGES):
        agreements = ground.agreements(prior.tracks(unknowns), used)

        def value(tracks: Tracks, every: Sequence[SpeckleAgreement] = agreements) -> tuple[float, dict[str, Floats]]:
            found = [one(tracks) for one in every]
            return sum(one for one, _ in found), {
                node: np.sum([by[node] for _, by in found], axis=0) for node in tracks
            }

        unknowns = minimise(value, prior, Gauge.none(prior.size), unknowns, iterations=_ITERATIONS)
    return unknowns


def _coherence(ground: SpeckleTiles, prior: Prior, unknowns: Floats, used: Bools) -> tuple[float, float]:
    """Return the mean coherence of the tiles used, and the share of their cells that counts."""
    tracks = prior.tracks(unknowns)
    agreements = ground.agreements(tracks, used)
    weights = np.concatenate([[tile.cells for tile in one.tiles] for one in agreements])
    values = np.concatenate([np.abs(one.coherence(tracks)) for one in agreements])
    cells = SAMPLING**2 * sum(len(tile.patch.pixels_m) for tile, one in zip(ground.tiles, used, strict=True) if one)
    total = float(weights.sum())
    return float(weights @ values / max(total, 1e-300)), total / (cells * len(agreements))
