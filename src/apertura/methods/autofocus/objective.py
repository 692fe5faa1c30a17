"""How sharp the patches are, as a function of the tracks: value and gradient from cached contributions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.methods.autofocus.blocks import Blocks, Contribution, Tracks

Floats = NDArray[np.float64]

MOST_WEIGHT = 1e4
_WEIGHT_OF_RATIO = 3.0
_SIDELOBES = 1e-3
"""Power of a point's sidelobes beyond its own patch, of an aperture without weights, whatever its tracks."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A patch as one pair sees it now.

    Attributes
    ----------
    energy
        Σ|I|², which stays as it was when the contributions were cached.
    contrast
        Σ|I|⁴/(Σ|I|²)².
    ratio
        Peak power against that of what lies about it: speckle, median/ln 2, or sidelobes of brighter points.
    """

    energy: float
    contrast: float
    ratio: float

    @classmethod
    def of(cls, image: NDArray[np.complex64], brightest: float = 0.0) -> "Seen":
        """Return what the image of a patch, (pixel,), shows beside others whose brightest pixel has so much power."""
        power = np.abs(image).astype(np.float64) ** 2
        energy = max(float(power.sum()), 1e-300)
        about = max(float(np.median(power)) / np.log(2), _SIDELOBES * brightest, 1e-300)
        return cls(energy, float((power**2).sum()) / energy**2, float(power.max()) / about)

    @property
    def weight(self) -> float:
        """How much its sharpness counts: as much as its point stands out."""
        return min(_WEIGHT_OF_RATIO * self.ratio, MOST_WEIGHT)


@dataclass(frozen=True, eq=False)
class Sharpness:
    """-½ Σ w·log(Σ|I|⁴/S²) over pairs and patches.

    Attributes
    ----------
    pairs
        Blocks of each pair.
    cached
        Pair → patch → what its blocks add.
    reference
        Node → (knot, 3) float64, metres: corrections that the contributions were cached at.
    seen
        Pair → patch → what it showed then.
    used
        (patch,) bool, patches that count.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 11 and 12.
    """

    pairs: Sequence[Blocks]
    cached: Sequence[Sequence[Contribution]]
    reference: Tracks
    seen: Sequence[Sequence[Seen]]
    used: NDArray[np.bool_]

    def __call__(self, tracks: Tracks) -> tuple[float, dict[str, Floats]]:
        """Return the value and its derivatives by the corrections, node → (knot, 3)."""
        total = 0.0
        gradient = {node: np.zeros_like(track) for node, track in tracks.items()}
        for blocks, patches, seen in zip(self.pairs, self.cached, self.seen, strict=True):
            moved = blocks.moves({node: tracks[node] - self.reference[node] for node in blocks.sighting.nodes})
            slopes = {node: np.zeros_like(move) for node, move in moved.items()}
            for patch, now, counts in zip(patches, seen, self.used, strict=True):
                if counts:
                    value, by_phase = _patch(patch, now, moved)
                    total += value
                    for node, slope in patch.slopes.items():
                        slopes[node][patch.blocks] += patch.wavenumber * by_phase[:, None] * slope
            for node, slope in slopes.items():
                gradient[node] += blocks.average.T @ slope
        return total, gradient


def phases(patch: Contribution, moved: Tracks) -> Floats:
    """Return (block,) float64, rad by which contributions turn where the nodes of each block have moved."""
    path = np.zeros(patch.blocks.stop - patch.blocks.start)
    for node, slope in patch.slopes.items():
        path += np.einsum("bi,bi->b", slope, moved[node][patch.blocks])
    return patch.wavenumber * path


def _patch(patch: Contribution, now: Seen, moved: Tracks) -> tuple[float, Floats]:
    """Return the value of a patch and its derivative by the phase of each block."""
    turn = np.exp(1j * phases(patch, moved)).astype(np.complex64)
    image = patch.values @ turn
    power = (image.real**2 + image.imag**2).astype(np.float64)
    fourth = float((power**2).sum())
    if not fourth:
        return 0.0, np.zeros(len(turn))
    by_image = (-now.weight * power / fourth * image).astype(np.complex64)
    by_phase = -2 * (turn * (by_image.conj() @ patch.values)).imag
    return -0.5 * now.weight * float(np.log(fourth / now.energy**2)), by_phase.astype(np.float64)
