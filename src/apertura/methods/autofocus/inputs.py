"""Inputs and result of a track refinement: data of each pair, prior of track errors, corrections."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.inputs import Profiles
from apertura.core.geometry.lever_arms import TrackCorrection

# ---- Inputs: data of each pair, errors of the logs, reference points ------------------------------------------------


@dataclass(frozen=True, eq=False)
class PairRecord:
    """Range profiles of one pair along its logged tracks.

    Attributes
    ----------
    pair
        Name of the pair, transmitter-receiver.
    profiles
        Range profiles; their samples may be read lazily.
    time_s
        (pulse,) float64, seconds of the flight's clock, common to all pairs.
    sidelink_m
        (pulse, 3) float64, logged vector from the receiver's sidelink antenna to that of the transmitter, metres; None
        if delays are not measured relative to a sidelink.
    beams
        Antenna weights of pulses in the image; None for equal weights.
    """

    pair: str
    profiles: Profiles
    time_s: NDArray[np.float64]
    sidelink_m: NDArray[np.float64] | None = None
    beams: Beams | None = None

    @property
    def nodes(self) -> tuple[str, str]:
        """Transmitter and receiver."""
        tx, rx = self.pair.split("-")
        return tx, rx

    def extreme_errors(self, errors: Mapping[str, "TrackErrors"]) -> tuple[float, float]:
        """Return the shortest correlation time of the nodes' errors, s, and the rms phase of the largest error, rad."""
        of_nodes = [errors[node] for node in self.nodes]
        largest_m = max(max(error.std_m) for error in of_nodes)
        return min(error.correlation_s for error in of_nodes), 2 * self.profiles.wavenumber_rad_m * largest_m

    def moved(self, correction: TrackCorrection) -> Profiles:
        """Return the profiles along corrected tracks (docs/theory/autofocus.md, eq. 3)."""
        aperture = correction.aperture(self.profiles.aperture, self.pair, self.time_s)
        return self.profiles.moved(aperture, correction.longer_m(self.pair, self.time_s, self.sidelink_m))

    def corrected(self, correction: TrackCorrection) -> "PairRecord":
        """Return the record along corrected logs."""
        tx, rx = self.nodes
        between_m = self.sidelink_m
        if between_m is not None:
            between_m = between_m + correction.at(tx, self.time_s) - correction.at(rx, self.time_s)
        return replace(self, profiles=self.moved(correction), sidelink_m=between_m)


@dataclass(frozen=True)
class TrackErrors:
    """Statistics of the errors of a node's logged positions.

    Attributes
    ----------
    std_m
        Standard deviations east, north and up of the error that varies along the flight, metres.
    correlation_s
        Correlation time: the autocorrelation of the error falls linearly to zero within this time.
    drift_std_m
        Standard deviation per axis of a slow error over the whole flight: offset, slope and curvature.
    """

    std_m: tuple[float, float, float]
    correlation_s: float = 1.0
    drift_std_m: float = 0.0

    def along(self, axes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (3,) float64, `std_m` along the frame's axes, metres; rows of `axes` are east, north, up in the frame.

        Examples
        --------
        >>> TrackErrors((0.01, 0.01, 0.02)).along(np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]))
        array([0.01, 0.01, 0.02])
        """
        return np.asarray(np.sqrt(np.square(self.std_m) @ np.square(axes)))


@dataclass(frozen=True)
class ReferencePoint:
    """Point of the scene with a known position.

    Attributes
    ----------
    name
        Name of the point.
    place_m
        (3,) position in metres, in the frame of the phase centres.
    std_m
        Standard deviation of each coordinate, metres.
    """

    name: str
    place_m: tuple[float, float, float]
    std_m: float


# ---- Prior of track errors: smoothed white noise and slow modes -----------------------------------------------------


SLOW_MODES = 4
"""Number of slow modes: offset, slope, and half a period of a sine and a cosine over the flight."""


@dataclass(frozen=True, eq=False)
class NodePrior:
    """Prior of the corrections of one node: smoothed white noise m = σ·(mean of w neighbours)·√w, and slow modes.

    Attributes
    ----------
    std_m
        (3,) float64, standard deviations along the axes, metres.
    axes
        (3, 3) float64, rows are the unit vectors east, north, up in the frame of the phase centres.
    smooth
        Correlation time w in knots.
    slow
        (knot, mode) float64, slow modes scaled by their standard deviation; no columns without a slow error.

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
        """Return the prior of a node with knots at equally spaced times."""
        step_s = float(time_s[1] - time_s[0])
        smooth = max(1, round(errors.correlation_s / step_s))
        along = np.linspace(-1, 1, len(time_s))
        half = np.pi * (along + 1) / 2
        slow = np.stack([np.ones_like(along), along, np.sin(half), np.cos(half)], axis=1) * errors.drift_std_m / 2
        return cls(np.array(errors.std_m), axes, smooth, len(time_s), slow[:, : SLOW_MODES * (errors.drift_std_m > 0)])

    @property
    def size(self) -> int:
        """Number of unknowns, each of unit variance."""
        return 3 * (self.knots + self.smooth - 1 + int(self.slow.shape[1]))

    def tracks(self, unknowns: Floats) -> Floats:
        """Return (..., knot, 3) float64 corrections, metres in the frame, for (..., size) unknowns."""
        white = unknowns.reshape(*unknowns.shape[:-1], -1, 3)
        noise, slow = white[..., : self.knots + self.smooth - 1, :], white[..., self.knots + self.smooth - 1 :, :]
        total = np.cumsum(np.concatenate([np.zeros_like(noise[..., :1, :]), noise], axis=-2), axis=-2)
        smoothed = (total[..., self.smooth :, :] - total[..., : self.knots, :]) / np.sqrt(self.smooth)
        return np.asarray((smoothed * self.std_m + self.slow @ slow) @ self.axes)

    def adjoint(self, gradient: Floats) -> Floats:
        """Convert (..., knot, 3) derivatives with respect to corrections to (..., size) with respect to unknowns."""
        along_axes = gradient @ self.axes.T
        scaled = along_axes * self.std_m / np.sqrt(self.smooth)
        nothing = np.zeros((*scaled.shape[:-2], self.smooth, 3))
        total = np.cumsum(np.concatenate([nothing, scaled, nothing[..., 1:, :]], axis=-2), axis=-2)
        noise = total[..., self.smooth :, :] - total[..., : -self.smooth, :]
        both = np.concatenate([noise, self.slow.T @ along_axes], axis=-2)
        return np.asarray(both.reshape(*both.shape[:-2], -1))


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior of all nodes of a flight, with the unknowns of the nodes concatenated.

    Attributes
    ----------
    nodes
        Node → prior.
    """

    nodes: Mapping[str, NodePrior]

    @property
    def size(self) -> int:
        """Number of unknowns of all nodes."""
        return sum(node.size for node in self.nodes.values())

    def tracks(self, unknowns: Floats) -> dict[str, Floats]:
        """Return node → (..., knot, 3) float64 corrections, metres, for (..., size) unknowns."""
        return {name: node.tracks(unknowns[..., part]) for (name, node), part in self._parts()}

    def adjoint(self, gradient: Mapping[str, Floats]) -> Floats:
        """Convert derivatives with respect to node corrections to (..., size) derivatives with respect to unknowns."""
        return np.concatenate([node.adjoint(gradient[name]) for name, node in self.nodes.items()], axis=-1)

    def _parts(self) -> list[tuple[tuple[str, NodePrior], slice]]:
        ends = np.cumsum([0, *(node.size for node in self.nodes.values())])
        parts = [slice(*pair) for pair in pairwise(ends.tolist())]
        return list(zip(self.nodes.items(), parts, strict=True))


# ---- Result: corrections and their acceptance -----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Refinement:
    """Corrections of a flight's tracks estimated from its images.

    Attributes
    ----------
    correction
        Estimated correction, accepted or rejected.
    std_m
        Node → (knot, 3) float64, expected residual errors along the axes of the frame, metres.
    accepted
        True if images are formed with the correction, for all nodes and pairs.
    why
        Reason of acceptance or rejection, one line.
    report
        Measured values, as JSON values.
    flags
        Flag → measured values, one line.
    """

    correction: TrackCorrection
    std_m: Mapping[str, NDArray[np.float64]]
    accepted: bool
    reason: str
    report: Mapping[str, Any] = field(default_factory=dict)
    flags: Mapping[str, str] = field(default_factory=dict)
