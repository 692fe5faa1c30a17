"""What is known of the errors of tracks before the image is asked: white noise that is smoothed, and slow modes."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apertura.methods.autofocus.inputs import TrackErrors

Floats = NDArray[np.float64]

SLOW_MODES = 4
"""Offset, slope, and half a sine and cosine over the flight."""


@dataclass(frozen=True, eq=False)
class NodePrior:
    """Corrections of one node as smoothed white noise: m = σ·(mean of w neighbours)·√w, and slow modes.

    Attributes
    ----------
    std_m
        (3,) float64, along the axes.
    axes
        (3, 3) float64, rows are the unit vectors east, north, up in the frame of the phase centres.
    smooth
        w, knots that an error lasts.
    slow
        (knot, mode) float64, slow modes with their standard deviation; no columns where there are none.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 10. Such noise has the autocorrelation of
    `apertura.core.quality.path_errors.autocorrelation` over w knots.

    Examples
    --------
    >>> prior = NodePrior.of(TrackErrors((0.02, 0.02, 0.04)), np.arange(0, 30, 0.1), np.eye(3))
    >>> tracks = prior.tracks(np.random.default_rng(0).standard_normal(prior.size))
    >>> tracks.shape, tracks.std(axis=0).round(2)
    ((300, 3), array([0.02, 0.02, 0.04]))
    """

    std_m: Floats
    axes: Floats
    smooth: int
    knots: int
    slow: Floats

    @classmethod
    def of(cls, errors: TrackErrors, time_s: Floats, axes: Floats) -> "NodePrior":
        """Return the prior of a node whose knots stand at equally spaced times."""
        step_s = float(time_s[1] - time_s[0])
        smooth = max(1, round(errors.correlation_s / step_s))
        along = np.linspace(-1, 1, len(time_s))
        half = np.pi * (along + 1) / 2
        slow = np.stack([np.ones_like(along), along, np.sin(half), np.cos(half)], axis=1) * errors.drift_std_m / 2
        return cls(np.array(errors.std_m), axes, smooth, len(time_s), slow[:, : SLOW_MODES * (errors.drift_std_m > 0)])

    @property
    def size(self) -> int:
        """How many unknowns there are, each of unit variance."""
        return 3 * (self.knots + self.smooth - 1 + int(self.slow.shape[1]))

    def tracks(self, unknowns: Floats) -> Floats:
        """Return (..., knot, 3) float64 corrections, metres in the frame, of (..., size) unknowns."""
        white = unknowns.reshape(*unknowns.shape[:-1], -1, 3)
        noise, slow = white[..., : self.knots + self.smooth - 1, :], white[..., self.knots + self.smooth - 1 :, :]
        total = np.cumsum(np.concatenate([np.zeros_like(noise[..., :1, :]), noise], axis=-2), axis=-2)
        smoothed = (total[..., self.smooth :, :] - total[..., : self.knots, :]) / np.sqrt(self.smooth)
        return np.asarray((smoothed * self.std_m + self.slow @ slow) @ self.axes)

    def adjoint(self, gradient: Floats) -> Floats:
        """Return (..., size) derivatives by the unknowns of what has (..., knot, 3) derivatives by the corrections."""
        turned = gradient @ self.axes.T
        scaled = turned * self.std_m / np.sqrt(self.smooth)
        nothing = np.zeros((*scaled.shape[:-2], self.smooth, 3))
        total = np.cumsum(np.concatenate([nothing, scaled, nothing[..., 1:, :]], axis=-2), axis=-2)
        noise = total[..., self.smooth :, :] - total[..., : -self.smooth, :]
        both = np.concatenate([noise, self.slow.T @ turned], axis=-2)
        return np.asarray(both.reshape(*both.shape[:-2], -1))


@dataclass(frozen=True, eq=False)
class Prior:
    """The nodes of a flight, each with its own unknowns, one after the other.

    Attributes
    ----------
    nodes
        Name → its prior.
    """

    nodes: Mapping[str, NodePrior]

    @property
    def size(self) -> int:
        """How many unknowns all nodes have."""
        return sum(node.size for node in self.nodes.values())

    def tracks(self, unknowns: Floats) -> dict[str, Floats]:
        """Return node → (..., knot, 3) float64 corrections, metres, of (..., size) unknowns."""
        return {name: node.tracks(unknowns[..., part]) for (name, node), part in self._parts()}

    def adjoint(self, gradient: Mapping[str, Floats]) -> Floats:
        """Return (..., size) derivatives by the unknowns of what has those by the corrections of each node."""
        return np.concatenate([node.adjoint(gradient[name]) for name, node in self.nodes.items()], axis=-1)

    def _parts(self) -> list[tuple[tuple[str, NodePrior], slice]]:
        ends = np.cumsum([0, *(node.size for node in self.nodes.values())])
        parts = [slice(*pair) for pair in pairwise(ends.tolist())]
        return list(zip(self.nodes.items(), parts, strict=True))
