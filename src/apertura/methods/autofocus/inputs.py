"""Inputs and outcome of a refinement of tracks: data of each pair, prior of track errors, corrections."""

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
        Its name, transmitter-receiver.
    profiles
        Range profiles; their samples may be read lazily.
    time_s
        (pulse,) float64, seconds of the flight's clock, which all its pairs share.
    sidelink_m
        (pulse, 3) float64, metres: from the receiver's sidelink point to the transmitter's, as the logs have them;
        None where echoes do not count from a sidelink.
    beams
        Antenna weights of pulses in the image; None where all count alike.
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

    def turned(self, errors: Mapping[str, "TrackErrors"]) -> tuple[float, float]:
        """Return the correlation time of its nodes' shortest error, s, and the phase of the largest, radians rms."""
        of_nodes = [errors[node] for node in self.nodes]
        largest_m = max(max(error.std_m) for error in of_nodes)
        return min(error.correlation_s for error in of_nodes), 2 * self.profiles.wavenumber_rad_m * largest_m

    def moved(self, correction: TrackCorrection) -> Profiles:
        """Return the profiles over corrected tracks (docs/theory/autofocus.md, eq. 3)."""
        aperture = correction.aperture(self.profiles.aperture, self.pair, self.time_s)
        return self.profiles.moved(aperture, correction.longer_m(self.pair, self.time_s, self.sidelink_m))

    def corrected(self, correction: TrackCorrection) -> "PairRecord":
        """Return the record as if its logs had been corrected."""
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
        East, north, up, metres: of what changes along the flight.
    correlation_s
        How long an error lasts: its autocorrelation falls linearly to zero over this.
    drift_std_m
        Of a slow error over the whole flight, in each axis: offset, slope and a slow bow.
    """

    std_m: tuple[float, float, float]
    correlation_s: float = 1.0
    drift_std_m: float = 0.0

    def along(self, axes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (3,) float64, metres, `std_m` along the frame's axes; rows of `axes` are east, north, up in the frame.

        Examples
        --------
        >>> TrackErrors((0.01, 0.01, 0.02)).along(np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]))
        array([0.01, 0.01, 0.02])
        """
        return np.asarray(np.sqrt(np.square(self.std_m) @ np.square(axes)))


@dataclass(frozen=True)
class ReferencePoint:
    """A point of the scene whose place is known.

    Attributes
    ----------
    name
        Of the point.
    place_m
        (3,) metres, in the frame of the phase centres.
    std_m
        Of each coordinate.
    """

    name: str
    place_m: tuple[float, float, float]
    std_m: float


# ---- Prior of track errors: smoothed white noise and slow modes -----------------------------------------------------


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
        """Number of unknowns, each of unit variance."""
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
        """Number of unknowns of all nodes."""
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


# ---- Outcome: corrections, and whether they are accepted ------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Refinement:
    """Corrections of a flight's tracks estimated from its images.

    Attributes
    ----------
    correction
        Estimated, accepted or not.
    std_m
        Node → (knot, 3) float64, metres: errors expected to remain, along the axes of the frame.
    accepted
        Whether images are formed with the correction: as a whole or not at all.
    why
        Reason of acceptance or rejection, one line.
    report
        As JSON values: what was measured.
    flags
        Flag → what was measured, in one line.
    """

    correction: TrackCorrection
    std_m: Mapping[str, NDArray[np.float64]]
    accepted: bool
    why: str
    report: Mapping[str, Any] = field(default_factory=dict)
    flags: Mapping[str, str] = field(default_factory=dict)
