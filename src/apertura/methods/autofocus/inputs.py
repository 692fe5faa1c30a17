"""What a refinement is given: what each pair saw, and what is known of the errors of the tracks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.focus.inputs import Profiles
from apertura.core.geometry.track_correction import TrackCorrection


@dataclass(frozen=True, eq=False)
class Sighting:
    """What a pair saw from where its nodes' logs have it.

    Attributes
    ----------
    pair
        Its name, transmitter-receiver.
    profiles
        Range profiles; their samples may be read as they are asked for.
    time_s
        (pulse,) float64, seconds of the flight's clock, which all its pairs share.
    sidelink_m
        (pulse, 3) float64, metres: from the receiver's sidelink point to the transmitter's, as the logs have them;
        None where echoes were not given back a sidelink's length.
    beams
        What weighs pulses in the image; None where all count alike.
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

    def moved(self, correction: TrackCorrection) -> Profiles:
        """Return the profiles as seen from corrected tracks (docs/theory/autofocus.md, eq. 3)."""
        aperture = correction.aperture(self.profiles.aperture, self.pair, self.time_s)
        return self.profiles.moved(aperture, correction.longer_m(self.pair, self.time_s, self.sidelink_m))


@dataclass(frozen=True)
class TrackErrors:
    """What is known of the errors of a node's logged positions.

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
