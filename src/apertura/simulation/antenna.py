"""Antennas that look one way: a Gaussian beam fixed to a node's body."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.geometry.geodesy import body_axes

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Antenna:
    """A Gaussian beam.

    Attributes
    ----------
    boresight_deg
        Azimuth clockwise from forward, elevation above the forward-right plane.
    beamwidth_deg
        Full width at half power in azimuth and elevation.
    """

    boresight_deg: tuple[float, float]
    beamwidth_deg: tuple[float, float]

    def gain(self, turn: Floats, antenna_m: Floats, points_m: Floats) -> Floats:
        """Return the field towards points, relative to boresight.

        Parameters
        ----------
        turn
            (pulse, 3, 3) float64, forward-right-down of the body into the frame of the points.
        antenna_m, points_m
            (pulse, 3) and (point, 3) float64, metres, in that frame.

        Returns
        -------
        ndarray
            (pulse, point) float64.

        Notes
        -----
        Source: docs/theory/simulate.md, eq. 7. The antenna is turned in the body as a body is: by yaw, then pitch.

        Examples
        --------
        >>> aside = Antenna((90.0, 0.0), (20.0, 40.0))
        >>> points = np.array([[0.0, 5.0, 0.0], [-np.sin(np.radians(10)), np.cos(np.radians(10)), 0.0]])
        >>> (aside.gain(np.eye(3)[None], np.zeros((1, 3)), points) ** 2).round(3)
        array([[1. , 0.5]])
        """
        azimuth_deg, elevation_deg = self.boresight_deg
        own = turn @ body_axes(np.radians([0.0, elevation_deg, azimuth_deg]))
        ahead, right, down = np.einsum("pij,pni->jpn", own, points_m[None] - antenna_m[:, None])
        azimuth, elevation = np.arctan2(right, ahead), np.arctan2(-down, np.hypot(ahead, right))
        parts = zip((azimuth, elevation), np.radians(self.beamwidth_deg), strict=True)
        return np.asarray(2.0 ** (-2 * sum((angle / width) ** 2 for angle, width in parts)))
