"""Tracks that make the patches sharpest without leaving what the log allows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.geometry.track_correction import TrackCorrection
from apertura.refinement.blocks import Blocks, Contribution
from apertura.refinement.gauge import Gauge
from apertura.refinement.objective import Seen, Sharpness, Tracks
from apertura.refinement.patches import Patch
from apertura.refinement.prior import Prior

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

STAGES, ITERATIONS = 3, 20
"""Contributions are cached anew so often, and the sharpest tracks looked for in so many steps."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What is to be focused.

    Attributes
    ----------
    pairs
        Blocks of each pair.
    patches
        Of the scene.
    knots_s
        (knot,) float64, times of the corrections.
    prior
        Of the nodes.
    gauge
        What is held at the log's value.
    """

    pairs: Sequence[Blocks]
    patches: Sequence[Patch]
    knots_s: Floats
    prior: Prior
    gauge: Gauge

    def correction(self, unknowns: Floats) -> TrackCorrection:
        """Return the corrections of some unknowns."""
        return TrackCorrection(self.knots_s, self.prior.tracks(unknowns))

    def cached(self, unknowns: Floats) -> list[list[Contribution]]:
        """Return pair → patch → what blocks add there from tracks as corrected."""
        correction = self.correction(unknowns)
        return [blocks.contributions(self.patches, correction) for blocks in self.pairs]

    def solved(self, start: Floats, used: Bools, *, stages: int = STAGES) -> Floats:
        """Return the unknowns at which the patches used are sharpest, from `start` on."""
        unknowns = start
        for _ in range(stages):
            unknowns = self._stage(unknowns, used)
        return unknowns

    def lowest(self, starts: Sequence[Floats], used: Bools) -> tuple[int, Floats, list[float]]:
        """Return which start leads lowest, where to, and the value of each, all with the weights of the first."""
        found = [self.solved(start, used) for start in starts]
        first = [[Seen.of(patch.values.sum(axis=1)) for patch in patches] for patches in self.cached(starts[0])]
        values = [self._value(unknowns, used, first) for unknowns in found]
        best = int(np.argmin(values))
        return best, found[best], values

    def _value(self, unknowns: Floats, used: Bools, weights: Sequence[Sequence[Seen]]) -> float:
        tracks = self.prior.tracks(unknowns)
        value, _ = Sharpness(self.pairs, self.cached(unknowns), tracks, weights, used)(tracks)
        return value + 0.5 * float(unknowns @ unknowns)

    def _stage(self, unknowns: Floats, used: Bools) -> Floats:
        cached = self.cached(unknowns)
        seen = [[Seen.of(patch.values.sum(axis=1)) for patch in patches] for patches in cached]
        sharpness = Sharpness(self.pairs, cached, self.prior.tracks(unknowns), seen, used)
        return minimal(sharpness, self.prior, self.gauge, unknowns)


def minimal(
    value: Callable[[Tracks], tuple[float, dict[str, Floats]]],
    prior: Prior,
    gauge: Gauge,
    start: Floats,
    *,
    iterations: int = ITERATIONS,
) -> Floats:
    """Return the unknowns that make a function of the tracks and half their own square smallest, gauge held."""
    from scipy.optimize import minimize  # slow to import

    held = gauge.modes.T @ (gauge.modes @ start)

    def whole(unknowns: Floats) -> tuple[float, Floats]:
        free = gauge.held(unknowns) + held
        some, by_tracks = value(prior.tracks(free))
        return some + 0.5 * float(unknowns @ unknowns), gauge.held(prior.adjoint(by_tracks)) + unknowns

    options = {"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": 20}
    found = minimize(whole, gauge.held(start), jac=True, method="L-BFGS-B", options=options)
    return np.asarray(gauge.held(found.x) + held)
