"""Tracks that make the patches sharpest without leaving what the log allows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.track_correction import TrackCorrection
from apertura.methods.autofocus.blocks import Blocks, Contribution, PatchEcho
from apertura.methods.autofocus.gauge import Gauge
from apertura.methods.autofocus.objective import Seen, Sharpness, Tracks
from apertura.methods.autofocus.patches import Patch
from apertura.methods.autofocus.prior import Prior

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

ITERATIONS = 20
"""Steps towards the sharpest tracks before contributions are cached anew."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What is to be focused.

    Attributes
    ----------
    pairs
        Blocks of each pair.
    echoes
        Pair → patch → what it recorded of it.
    knots_s
        (knot,) float64, times of the corrections.
    prior
        Of the nodes.
    gauge
        What is held at the log's value.
    """

    pairs: Sequence[Blocks]
    echoes: Sequence[Sequence[PatchEcho]]
    knots_s: Floats
    prior: Prior
    gauge: Gauge

    def correction(self, unknowns: Floats) -> TrackCorrection:
        """Return the corrections of some unknowns."""
        return TrackCorrection(self.knots_s, self.prior.tracks(unknowns))

    def state(self, unknowns: Floats) -> "State":
        """Return what blocks add to the patches from tracks as corrected."""
        return replace(self.at(self.prior.tracks(unknowns)), unknowns=unknowns)

    def at(self, tracks: Tracks) -> "State":
        """Return the same of tracks whose unknowns nobody asks for."""
        cached = []
        for blocks, echoes in zip(self.pairs, self.echoes, strict=True):
            moved = blocks.moves(tracks)
            cached.append([blocks.contribution(echo, moved) for echo in echoes])
        return State(np.zeros(0), tracks, cached)

    @property
    def patches(self) -> list[Patch]:
        """Of the scene."""
        return [echo.patch for echo in self.echoes[0]]

    def of(self, patches: Sequence[int]) -> "Problem":
        """Return the problem of some of its patches."""
        return replace(self, echoes=[[echoes[number] for number in patches] for echoes in self.echoes])

    def sharper(self, state: "State", used: Bools, *, stages: int = 1) -> "State":
        """Return the tracks at which the patches used are sharpest, from a state on."""
        for _ in range(stages):
            sharpness = Sharpness(self.pairs, state.cached, state.tracks, state.seen, used)
            state = self.state(minimal(sharpness, self.prior, self.gauge, state.unknowns))
        return state

    def value(self, state: "State", used: Bools, weights: Sequence[Sequence[Seen]]) -> float:
        """Return what is to be small, with the weights and energies of another state."""
        value, _ = Sharpness(self.pairs, state.cached, state.tracks, weights, used)(state.tracks)
        return value + 0.5 * float(state.unknowns @ state.unknowns)


@dataclass(frozen=True, eq=False)
class State:
    """Tracks, and the patches as seen from them.

    Attributes
    ----------
    unknowns
        (unknown,) float64, of the prior.
    tracks
        Node → (knot, 3) float64, metres: the corrections.
    cached
        Pair → patch → what its blocks add.
    """

    unknowns: Floats
    tracks: Tracks
    cached: Sequence[Sequence[Contribution]]

    @cached_property
    def images(self) -> list[list[NDArray[np.complex64]]]:
        """Pair → patch → (pixel,) complex64."""
        return [[patch.values.sum(axis=1) for patch in patches] for patches in self.cached]

    @cached_property
    def seen(self) -> list[list[Seen]]:
        """Pair → patch → what it shows."""
        seen = []
        for images in self.images:
            brightest = max((float(np.abs(image).max()) ** 2 for image in images), default=0.0)
            seen.append([Seen.of(image, brightest) for image in images])
        return seen

    def of(self, patches: Sequence[int]) -> "State":
        """Return the state of some patches."""
        return replace(self, cached=[[cached[number] for number in patches] for cached in self.cached])


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
