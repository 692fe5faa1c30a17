"""What two pairs see alike: the same spatial frequencies of the ground, at different times, speckle or not."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from apertura.methods.autofocus.blocks import Blocks, Contribution, PatchEcho, Tracks
from apertura.methods.autofocus.objective import phases
from apertura.methods.autofocus.tiles import SAMPLING, Tile

Floats = NDArray[np.float64]

WEIGHT = 0.2
"""Of a resolution cell that two pairs see alike; docs/theory/autofocus.md, "Speckle"."""


@dataclass(frozen=True, eq=False)
class Alike:
    """A tile as two pairs see it.

    Attributes
    ----------
    product
        (block of the first, block of the second) complex64: Σ conj(B)·B' over the tile, by its two images' energies and
        weighed by how far both blocks see the same spatial frequencies.
    cells
        Resolution cells that count: all of a tile of speckle; few where a point stands out, whose spatial frequencies
        are not independent.
    brightness
        Mean power of both images.
    seen
        What blocks of each pair see it and how they turn; without what they add.
    """

    product: NDArray[np.complex64]
    cells: float
    brightness: float
    seen: tuple[Contribution, Contribution]

    @classmethod
    def of(cls, tile: Tile, first: Contribution, second: Contribution) -> "Alike":
        """Return what a tile's contributions to two pairs have in common, from the tracks that they were cached at."""
        powers = np.stack([np.abs(one.values.sum(axis=1)).astype(np.float64) ** 2 for one in (first, second)])
        energy = np.maximum(powers.sum(axis=1), 1e-300)
        even = 2 * energy**2 / np.maximum((powers**2).sum(axis=1), 1e-300)
        between = float(np.sqrt(energy.prod()))
        product = first.values.conj().T @ second.values / np.float32(between) * _overlap(tile, first, second)
        pixels, nothing = len(first.values), np.zeros((0, 0), np.complex64)
        cells = SAMPLING**2 * min(pixels, float(even.min()))
        return cls(product, cells, between / pixels, (replace(first, values=nothing), replace(second, values=nothing)))

    def coherence(self, moved: Sequence[Tracks]) -> tuple[complex, list[NDArray[np.complex64]]]:
        """Return Σ conj(I)·I' by the images' energies, and the part of each block of both pairs in it.

        Where the nodes of each pair's blocks have moved, node → (block, 3), metres.
        """
        first, second = (
            np.exp(sign * 1j * phases(seen, one)).astype(np.complex64)
            for sign, seen, one in zip((-1, 1), self.seen, moved, strict=True)
        )
        by_first = first * (self.product @ second)
        return complex(by_first.sum()), [by_first, second * (first @ self.product)]


def _overlap(tile: Tile, first: Contribution, second: Contribution) -> NDArray[np.float32]:
    """Return (block, block) float32: 1 where both look at a tile along one line, 0 from a resolvable angle on."""
    cycles = [one.wavenumber / (2 * np.pi) * sum(one.slopes.values()) @ tile.sides_m.T for one in (first, second)]
    across = cycles[0][:, ::-1] * [-1, 1] / np.linalg.norm(cycles[0], axis=1, keepdims=True)
    apart = np.sum(across * cycles[0], axis=1)[:, None] - across @ cycles[1].T
    return np.asarray(np.maximum(1 - np.abs(apart), 0), np.float32)


@dataclass(frozen=True, eq=False)
class Agreement:
    """-w |Σ n·γ|: how far the images of two pairs agree on all tiles, but for one phase.

    Attributes
    ----------
    pairs
        Blocks of both.
    tiles
        What they see alike.
    reference
        Node → (knot, 3) float64, metres: corrections that the tiles' contributions were cached at.
    weight
        Of a resolution cell.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 20 and 21.
    """

    pairs: tuple[Blocks, Blocks]
    tiles: Sequence[Alike]
    reference: Tracks
    weight: float = WEIGHT

    def __call__(self, tracks: Tracks) -> tuple[float, dict[str, Floats]]:
        """Return the value and its derivatives by the corrections, node → (knot, 3)."""
        moved, found = self._found(tracks)
        total = sum(tile.cells * coherence for tile, (coherence, _) in zip(self.tiles, found, strict=True))
        turn = np.exp(-1j * np.angle(total))
        slopes = [{node: np.zeros_like(move) for node, move in one.items()} for one in moved]
        for tile, (_, parts) in zip(self.tiles, found, strict=True):
            for seen, slope, part, sign in zip(tile.seen, slopes, parts, (-1, 1), strict=True):
                by_path = sign * self.weight * tile.cells * seen.wavenumber * (turn * part).imag
                for node, path in seen.slopes.items():
                    slope[node][seen.blocks] += by_path[:, None] * path
        gradient = {node: np.zeros_like(track) for node, track in tracks.items()}
        for blocks, slope in zip(self.pairs, slopes, strict=True):
            for node, by_block in slope.items():
                gradient[node] += blocks.average.T @ by_block
        return -self.weight * abs(total), gradient

    def coherence(self, tracks: Tracks) -> NDArray[np.complex128]:
        """Return (tile,) complex128, at most 1: how far two images of each agree, and the phase between them."""
        return np.array([value for value, _ in self._found(tracks)[1]])

    def _found(self, tracks: Tracks) -> tuple[list[Tracks], list[tuple[complex, list[NDArray[np.complex64]]]]]:
        moved = [
            blocks.moves({node: tracks[node] - self.reference[node] for node in blocks.sighting.nodes})
            for blocks in self.pairs
        ]
        return moved, [tile.coherence(moved) for tile in self.tiles]


@dataclass(frozen=True, eq=False)
class Ground:
    """The scene in tiles, as all pairs of a flight see it.

    Attributes
    ----------
    pairs
        Blocks of each.
    tiles
        Of the scene.
    echoes
        Pair → tile → what it recorded of it.
    """

    pairs: Sequence[Blocks]
    tiles: Sequence[Tile]
    echoes: Sequence[Sequence[PatchEcho]]

    @classmethod
    def of(cls, pairs: Sequence[Blocks], tiles: Sequence[Tile]) -> "Ground":
        """Return the ground as it was recorded."""
        return cls(pairs, tiles, [blocks.echoes([tile.patch for tile in tiles]) for blocks in pairs])

    def agreements(self, tracks: Tracks, used: NDArray[np.bool_] | None = None) -> list[Agreement]:
        """Return what every two pairs see alike of the tiles used, from corrected tracks: node → (knot, 3), metres."""
        moved = [blocks.moves(tracks) for blocks in self.pairs]
        both = list(combinations(range(len(self.pairs)), 2))
        alike: dict[tuple[int, int], list[Alike]] = {pairs: [] for pairs in both}
        for number, tile in enumerate(self.tiles):
            if used is None or used[number]:
                seen = [
                    blocks.contribution(echoes[number], at)
                    for blocks, echoes, at in zip(self.pairs, self.echoes, moved, strict=True)
                ]
                for one, other in both:
                    alike[one, other].append(Alike.of(tile, seen[one], seen[other]))
        return [
            Agreement((self.pairs[one], self.pairs[other]), self._even(found, one, used), tracks)
            for (one, other), found in alike.items()
        ]

    def _even(self, alike: Sequence[Alike], pair: int, used: NDArray[np.bool_] | None) -> list[Alike]:
        """Return tiles, the darker ones counting less: they hold what brighter ones threw there.

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
