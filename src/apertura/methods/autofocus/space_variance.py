"""Whether one phase per pulse mends a scene: how much the path errors of its edges differ from those of its middle."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from apertura.core.quality.path_errors import PointPaths
from apertura.methods.autofocus.inputs import TrackErrors
from apertura.methods.autofocus.prior import NodePrior

Floats = NDArray[np.float64]

MOST_LOSS_DB = 0.1
"""Of peak that one phase per pulse may leave at the scene's edges where it is enough."""


@dataclass(frozen=True)
class SpaceVariance:
    """What path errors leave at places of a scene once those of its middle are taken out.

    Attributes
    ----------
    residual_rad
        RMS over pulses and places.
    loss_db
        Of the peak's power, mean over the places, 0 or less; without what only shifts them.
    """

    residual_rad: float
    loss_db: float

    @property
    def method(self) -> Literal["one_phase", "tracks"]:
        """What the scene needs, and no more."""
        return "one_phase" if self.loss_db >= -MOST_LOSS_DB else "tracks"

    @property
    def reason(self) -> str:
        """In one line."""
        return (
            f"one phase per pulse leaves {self.residual_rad:.2g} rad rms and {-self.loss_db:.2g} dB at the scene's "
            f"edges, {MOST_LOSS_DB:g} dB are borne"
        )


def space_variance(middle: PointPaths, points_m: Floats, errors: Sequence[TrackErrors]) -> SpaceVariance:
    """Return what one phase per pulse, that of the scene's middle, leaves at other places.

    Parameters
    ----------
    middle
        A pair's paths to the middle of the scene.
    points_m
        (point, 3) float64, metres in the frame of the phase centres: the scene's corners.
    errors
        Of the logs: one where the pair is one node, else the transmitter's and the receiver's.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 30. A sidelink turns all places alike.

    Examples
    --------
    >>> from apertura.core.geometry.aperture import Aperture
    >>> along = np.linspace(-100, 100, 200)
    >>> track = np.stack([along, np.full(200, -2000.0), np.full(200, 500.0)], -1)
    >>> paths = PointPaths(Aperture(track, track), along / 20, np.zeros(3), np.eye(3), 0.2)
    >>> corners = np.array([[-20.0, -20, 0], [20, -20, 0], [-20, 20, 0], [20, 20, 0]])
    >>> far = space_variance(paths, corners, [TrackErrors((0.02, 0.02, 0.02))])
    >>> far.method, round(far.residual_rad, 3)
    ('one_phase', 0.013)
    """
    found = [_at(middle, point, errors) for point in points_m]
    residual_rad = float(np.sqrt(np.mean([power for power, _ in found])))
    return SpaceVariance(residual_rad, float(np.mean([loss_db for _, loss_db in found])))


def _at(middle: PointPaths, point_m: Floats, errors: Sequence[TrackErrors]) -> tuple[float, float]:
    """Return the mean square of what is left at a place, rad², and the loss that it makes, dB."""
    place = replace(middle, point_m=point_m)
    grows = (paths.by_node(same=len(errors) == 1, sidelink=False) for paths in (place, middle))
    parts: list[tuple[Floats, float]] = []
    for there, here, error in zip(*grows, errors, strict=True):
        slow = NodePrior.of(error, middle.time_s, middle.axes).slow
        for std_m, differs in zip(error.std_m, (there - here).T, strict=True):
            parts.append((std_m * differs, error.correlation_s))
            parts += [(mode * differs, float("inf")) for mode in slow.T]
    power = sum(float((std_m**2).mean()) for std_m, _ in parts)
    return power * (2 * np.pi / middle.wavelength_m) ** 2, place.of_noise(*parts).loss_db
