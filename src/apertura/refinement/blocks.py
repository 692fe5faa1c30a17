"""Blocks of pulses: what tracks are corrected by, and what each block of a pair adds to the patches."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.focus.contributions import block_contributions
from apertura.focus.inputs import Profiles
from apertura.geometry.track_correction import TrackCorrection
from apertura.refinement.inputs import Sighting
from apertura.refinement.patches import Patch

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Blocks:
    """The pulses of one pair, by the knots of the corrections.

    Attributes
    ----------
    sighting
        The pair.
    edges
        (knot + 1,) int64, first pulse of each block, and the number of pulses.
    average
        (block, knot) sparse float64: mean over the pulses of a block of what is linear between knots.
    """

    sighting: Sighting
    edges: NDArray[np.int64]
    average: "csr_array"

    @classmethod
    def of(cls, sighting: Sighting, knots_s: Floats) -> "Blocks":
        """Return the blocks of a pair about equally spaced knots."""
        from scipy.sparse import csr_array  # slow to import

        count, step_s = len(knots_s), float(knots_s[1] - knots_s[0])
        edges = np.searchsorted(sighting.time_s, np.append(knots_s - step_s / 2, np.inf))
        edges[0] = 0
        place = np.clip((sighting.time_s - knots_s[0]) / step_s, 0, count - 1)
        left = np.minimum(place.astype(np.int64), count - 2)
        block = np.repeat(np.arange(count), np.diff(edges))
        share = 1 / np.maximum(np.diff(edges), 1)[block]
        right = place - left
        values = np.concatenate([(1 - right) * share, right * share])
        where = np.concatenate([block, block]), np.concatenate([left, left + 1])
        return cls(sighting, edges, csr_array((values, where), shape=(count, count)))

    def average_of(self, tracks: Floats) -> Floats:
        """Return (mode, block, 3) float64, the mean of (mode, knot, 3) tracks over the pulses of each block."""
        modes, knots, _ = tracks.shape
        flat = np.moveaxis(tracks, 1, 0).reshape(knots, -1)
        return np.moveaxis((self.average @ flat).reshape(knots, modes, 3), 0, 1)

    def contributions(self, patches: Sequence[Patch], correction: TrackCorrection) -> list["Contribution"]:
        """Return what each block adds to the pixels of each patch from tracks as corrected."""
        profiles = self.sighting.moved(correction)
        middle = np.minimum((self.edges[:-1] + self.edges[1:]) // 2, len(profiles) - 1)
        slopes = self._slopes(patches, correction, middle)
        return [
            Contribution.of(profiles, patch, self, {node: slope[:, number] for node, slope in slopes.items()})
            for number, patch in enumerate(patches)
        ]

    def _slopes(
        self, patches: Sequence[Patch], correction: TrackCorrection, middle: NDArray[np.int64]
    ) -> Mapping[str, Floats]:
        """Return node → (block, patch, 3) float64, growth of the path per metre that it moves (eq. 2)."""
        sighting = self.sighting
        aperture, time_s = sighting.profiles.aperture[middle], sighting.time_s[middle]
        at = correction.aperture(aperture, sighting.pair, time_s)
        places = np.stack([patch.place_m for patch in patches])
        away = [leg[:, None] - places for leg in at.legs]
        unit = [one / np.linalg.norm(one, axis=-1, keepdims=True) for one in away]
        tx, rx = sighting.nodes
        if tx == rx:
            return {tx: unit[0] + unit[1]}
        if sighting.sidelink_m is not None:
            between = sighting.sidelink_m[middle] + correction.at(tx, time_s) - correction.at(rx, time_s)
            along = (between / np.linalg.norm(between, axis=1, keepdims=True))[:, None]
            unit = [unit[0] - along, unit[1] + along]
        return {tx: unit[0], rx: unit[1]}


@dataclass(frozen=True, eq=False)
class Contribution:
    """What the blocks of a pair that see a patch add to it.

    Attributes
    ----------
    values
        (pixel, block) complex64.
    blocks
        Which of the pair's blocks those are.
    slopes
        Node → (block, 3) float64, growth of the path at the patch per metre that the node moves.
    wavenumber
        2πf_mid/c.
    cells
        Resolution cells that a pixel stands for.
    """

    values: NDArray[np.complex64]
    blocks: slice
    slopes: Mapping[str, Floats]
    wavenumber: float
    cells: float

    @classmethod
    def of(cls, profiles: Profiles, patch: Patch, blocks: Blocks, slopes: Mapping[str, Floats]) -> "Contribution":
        """Return what blocks add to one patch."""
        beams, edges = blocks.sighting.beams, blocks.edges
        weights, used = None, np.diff(edges) > 0
        if beams is not None:
            weights = beams.weight(profiles.aperture, patch.place_m[None])[:, 0]
            used &= np.add.reduceat(np.append(weights, 0.0), edges[:-1]) > 0
        seen = np.flatnonzero(used)
        part = slice(int(seen[0]), int(seen[-1]) + 1) if seen.size else slice(0, 0)
        values = block_contributions(profiles, patch.pixels_m, edges=edges[part.start : part.stop + 1], weights=weights)
        wavenumber = 2 * np.pi * profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S
        return cls(values, part, {node: slope[part] for node, slope in slopes.items()}, wavenumber, patch.cells)
