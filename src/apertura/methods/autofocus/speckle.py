"""Tracks refined where no point stands out: by the speckle that two pairs see alike."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.track_correction import TrackCorrection
from apertura.methods.autofocus.agreement import Agreement, Ground
from apertura.methods.autofocus.blocks import Tracks
from apertura.methods.autofocus.gauge import Gauge
from apertura.methods.autofocus.outcome import Refinement
from apertura.methods.autofocus.prior import Prior
from apertura.methods.autofocus.solve import minimal
from apertura.methods.autofocus.tiles import SAMPLING

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEAST_COHERENCE = 0.75
"""Of tiles that were not fitted: less is left by tracks that are cycles wrong."""

LEAST_GAIN = 0.1
"""By which the coherence of those tiles must have grown."""

LEAST_EVEN = 0.25
"""Share of the ground that must be even: what a few points throw about agrees by chance."""

LEAST_TILES = 8

_STAGES, _ITERATIONS = 2, 15
_HELD_OUT = 4  # every so many-th tile is not fitted


@dataclass(frozen=True)
class Agreed:
    """What tiles say of tracks that were not fitted to them.

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
        """Whether the tracks are to be believed."""
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


def refined_by_speckle(ground: Ground, prior: Prior, knots_s: Floats) -> Refinement:
    """Return the corrections with which pairs agree on the ground, and whether they are to be believed.

    Parameters
    ----------
    ground
        Tiles as all pairs see them.
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
            "speckle of one pair says nothing of its tracks" if len(ground.pairs) < 2 else f"{count} tiles are too few"
        )
        flags = {"refinement_too_few_patches": why}
        return Refinement(TrackCorrection(knots_s, prior.tracks(nothing)), std_m, False, why, {"tiles": count}, flags)
    held_out = np.arange(count) % _HELD_OUT == 2
    begun = _coherence(ground, prior, nothing, held_out)
    told = _coherence(ground, prior, _solved(ground, prior, ~held_out), held_out)
    agreed = Agreed(begun[0], told[0], count, _coherence(ground, prior, nothing, np.ones_like(held_out))[1])
    found = _solved(ground, prior, np.ones_like(held_out)) if agreed.accepted else nothing
    coherence = [round(agreed.before, 3), round(agreed.after, 3)]
    report: dict[str, Any] = {"tiles": count, "even": round(agreed.even, 3), "coherence": coherence}
    flags = {} if agreed.accepted else {"refinement_rejected": agreed.why}
    correction = TrackCorrection(knots_s, prior.tracks(found))
    return Refinement(correction, std_m, agreed.accepted, agreed.why, report, flags)


def _solved(ground: Ground, prior: Prior, used: Bools) -> Floats:
    """Return the unknowns with which pairs agree best on the tiles used."""
    unknowns = np.zeros(prior.size)
    for _ in range(_STAGES):
        agreements = ground.agreements(prior.tracks(unknowns), used)

        def value(tracks: Tracks, every: Sequence[Agreement] = agreements) -> tuple[float, dict[str, Floats]]:
            found = [one(tracks) for one in every]
            return sum(one for one, _ in found), {
                node: np.sum([by[node] for _, by in found], axis=0) for node in tracks
            }

        unknowns = minimal(value, prior, Gauge.none(prior.size), unknowns, iterations=_ITERATIONS)
    return unknowns


def _coherence(ground: Ground, prior: Prior, unknowns: Floats, used: Bools) -> tuple[float, float]:
    """Return the mean coherence of the tiles used, and the share of their cells that counts."""
    tracks = prior.tracks(unknowns)
    agreements = ground.agreements(tracks, used)
    weights = np.concatenate([[tile.cells for tile in one.tiles] for one in agreements])
    values = np.concatenate([np.abs(one.coherence(tracks)) for one in agreements])
    cells = SAMPLING**2 * sum(len(tile.patch.pixels_m) for tile, one in zip(ground.tiles, used, strict=True) if one)
    total = float(weights.sum())
    return float(weights @ values / max(total, 1e-300)), total / (cells * len(agreements))
