"""What is added to the logged positions of a flight's nodes, and what paths of its pairs are longer by."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.aperture import Aperture


@dataclass(frozen=True, eq=False)
class TrackCorrection:
    """Corrections of the tracks of a flight's nodes; a node that is not named stays where its log has it.

    Attributes
    ----------
    time_s
        (knot,) float64, seconds of the flight's clock, ascending; between knots corrections are linear, beyond them
        constant.
    moved_m
        Node → (knot, 3) float64, metres to be added to each of its points, in the frame of the phase centres.
    further_m
        Pair → (knot,) float64, metres of total path by which all its echoes lie further, wherever its nodes are; a pair
        that is not named has none.

    Examples
    --------
    >>> higher = TrackCorrection(np.array([0.0, 2.0]), {"a": np.array([[0, 0, 0.0], [0, 0, 0.2]])})
    >>> higher.at("a", np.array([1.0])), higher.at("b", np.array([1.0]))
    (array([[0. , 0. , 0.1]]), array([[0., 0., 0.]]))
    """

    time_s: NDArray[np.float64]
    moved_m: Mapping[str, NDArray[np.float64]]
    further_m: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    def at(self, node: str, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far a node is moved at some times, (pulse, 3) float64, metres."""
        moved = self.moved_m.get(node)
        if moved is None:
            return np.zeros((len(time_s), 3))
        return np.stack([np.interp(time_s, self.time_s, axis) for axis in moved.T], axis=-1)

    def aperture(self, logged: Aperture, pair: str, time_s: NDArray[np.float64]) -> Aperture:
        """Return the phase centres of a pair, transmitter-receiver, as corrected at the times of its pulses."""
        tx, rx = pair.split("-")
        return Aperture(logged.tx_m + self.at(tx, time_s), logged.rx_m + self.at(rx, time_s))

    def longer_m(
        self, pair: str, time_s: NDArray[np.float64], between_m: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """Return by how much all echoes of a pair lie further than from the logs: ∆ and what is its own.

        Parameters
        ----------
        pair
            transmitter-receiver.
        time_s
            (pulse,) float64.
        between_m
            (pulse, 3) float64, metres: from the receiver's sidelink point to the transmitter's, as the logs have it;
            None where echoes were not given back a sidelink's length.

        Returns
        -------
        ndarray
            (pulse,) float64, metres of total path.

        Notes
        -----
        Source: docs/theory/autofocus.md, eq. 2 and 34.

        Examples
        --------
        >>> apart = np.array([[3.0, 0.0, 0.0]])
        >>> wider = TrackCorrection(np.zeros(1), {"a": np.array([[0.5, 0, 0]])}, {"a-b": np.array([0.1])})
        >>> wider.longer_m("a-b", np.zeros(1), apart), wider.longer_m("a-a", np.zeros(1), None)
        (array([0.6]), array([0.]))
        """
        own = self.further_m.get(pair)
        further_m = np.zeros(len(time_s)) if own is None else np.interp(time_s, self.time_s, own)
        if between_m is None:
            return further_m
        tx, rx = pair.split("-")
        corrected = between_m + self.at(tx, time_s) - self.at(rx, time_s)
        return np.asarray(further_m + np.linalg.norm(corrected, axis=1) - np.linalg.norm(between_m, axis=1))
