"""Integration sector of a pixel: weights of the pulses of a long flight at each pixel."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.common.units import decibels
from apertura.core.geometry.aperture import Aperture, distance

TAPER = 0.1
"""Half width of an edge relative to the half width of the sector: the weight decreases from 1 to 0 between (1 - TAPER)
and (1 + TAPER) times the half width (docs/theory/integration.md)."""

_SAMPLES = 256  # number of samples of the window, for a relative error of 1e-6 of the -3 dB width and the sidelobe
_TRIED = 256  # number of pulses searched for the extremes of s
_END = 0.01  # tolerated error of these extremes relative to the half width


@dataclass(frozen=True, eq=False)
class Sector:
    """Interval of the direction cosine relative to the flight in which pulses are integrated at a pixel.

    With u_t, u_r the unit vectors from the antennas to the pixel, s = a_t·u_t + a_r·u_r is the decrease of the total
    path per metre of motion of both antennas together: 0 at the closest approach, 1 straight ahead. A pulse is
    integrated at a pixel if s is within `half` of the centre of the interval, with a smooth edge. The centre at a pixel
    is `centre`, or the nearest value for which the sector lies within the flight (`following`).

    Attributes
    ----------
    tx_axis, rx_axis
        (pulse, 3) float64: displacement of each antenna divided by the sum of the lengths of both displacements, so
        that the lengths of both axes add up to 1. Both axes are 0 if no antenna moves; s is then 0 at every pixel.
    centre, half
        Centre and half width of the interval of s; the weight is one half at the centre ± `half`.
    ends
        Pulses that include those at which s of any pixel is smallest or largest, and the sector of these pulses; None
        if all pixels have the same `centre`.

    Raises
    ------
    ValueError
        If shapes differ, or if the half width is not positive.

    Notes
    -----
    Source: docs/theory/integration.md, eqs. 1, 3 and 4.

    Examples
    --------
    >>> track = np.stack([np.linspace(-50, 50, 101), np.zeros(101), np.full(101, 10.0)], -1)
    >>> flown = Aperture(track, track)
    >>> sector = Sector.of(flown, chord_m=2.0, centre=0.0, half=0.25)
    >>> sector.weight(flown, np.array([[0.0, 30.0, 0.0]]))[[50, 40, 0], 0].round(2)
    array([1., 0., 0.])
    """

    tx_axis: NDArray[np.float64]
    rx_axis: NDArray[np.float64]
    centre: float
    half: float
    ends: "tuple[Aperture, Sector] | None" = None

    def __post_init__(self) -> None:
        if self.tx_axis.shape != self.rx_axis.shape or self.tx_axis.ndim != 2 or self.tx_axis.shape[1] != 3:
            raise ValueError(f"{self.tx_axis.shape=}, {self.rx_axis.shape=}: both must be (pulse, 3)")
        if not 0 < self.half < np.inf:
            raise ValueError(f"{self.half=}: must be positive")

    @classmethod
    def of(cls, aperture: Aperture, *, chord_m: float, centre: float, half: float) -> "Sector":
        """Return a sector about the directions of flight.

        Parameters
        ----------
        aperture
            Aperture in the frame of the pixels.
        chord_m
            Distance over which a direction is determined: long relative to position errors, short relative to the
            radius of turns.
        centre, half
            Attributes of the `Sector`.
        """
        return cls(*flight_axes(aperture, chord_m=chord_m), centre, half)

    def __getitem__(self, pulses: slice | NDArray[np.int64]) -> "Sector":
        """Return the sector of the selected pulses."""
        return replace(self, tx_axis=self.tx_axis[pulses], rx_axis=self.rx_axis[pulses])

    def following(self, aperture: Aperture, points_m: NDArray[np.float64]) -> "Sector":
        """Return the sector with the centre of each pixel limited so that the sector lies within the flight.

        Parameters
        ----------
        aperture
            Aperture of the same pulses.
        points_m
            (point, 3) float64, metres, distributed over the scene.

        Notes
        -----
        Source: docs/theory/integration.md, eq. 4.

        Examples
        --------
        >>> track = np.stack([np.linspace(-5, 5, 101), np.zeros(101), np.full(101, 10.0)], -1)
        >>> flown, points = Aperture(track, track), np.array([[0.0, 30.0, 0.0], [20.0, 30.0, 0.0]])
        >>> sector = Sector.of(flown, chord_m=2.0, centre=0.0, half=0.1)
        >>> sector.weight(flown, points).sum(axis=0).round(), sector.following(flown, points).centre_at(points).round(2)
        (array([64.,  0.]), array([0.  , 0.52]))
        """
        searched = np.unique(np.append(np.arange(len(aperture))[aperture.sample(_TRIED)], len(aperture) - 1))
        sample, sector = aperture[searched], replace(self[searched], ends=None)
        offset = sector.place(sample, points_m)
        if (offset.min(axis=0) <= -self.outer).all() and (offset.max(axis=0) >= self.outer).all():
            return self  # the flight contains the complete sector of every point
        # Select the smallest set of pulses with the extremes of s of every point, to an accuracy of `_END` of the half
        # width.
        is_extreme = np.concatenate([offset, -offset], axis=1)
        is_extreme = is_extreme <= is_extreme.min(axis=0) + _END * self.half
        ends: list[int] = []
        while is_extreme.any():
            ends.append(int(is_extreme.sum(axis=1).argmax()))
            is_extreme &= ~is_extreme[ends[-1]]
        return replace(self, ends=(sample[np.array(ends)], sector[np.array(ends)]))

    def centre_at(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the centre of the interval of s at points (..., 3) in metres, (...) float64."""
        if self.ends is None:
            return np.full(points_m.shape[:-1], self.centre)
        aperture, sector = self.ends
        cosine = sector.place(aperture, points_m) + self.centre
        first, last = cosine.min(axis=0), cosine.max(axis=0)
        middle = (first + last) / 2
        lowest, highest = np.minimum(first + self.outer, middle), np.maximum(last - self.outer, middle)
        return np.asarray(np.clip(self.centre, lowest, highest))

    def axis_change(self, other: "Sector") -> NDArray[np.float64]:
        """Return the largest change of s, (pulse,), for the axes of another sector with the same number of pulses."""
        axes = ((self.tx_axis, other.tx_axis), (self.rx_axis, other.rx_axis))
        return np.asarray(sum(np.linalg.norm(own - others, axis=1) for own, others in axes))

    @property
    def inner(self) -> float:
        """Distance from the centre up to which the weight is 1."""
        return (1 - TAPER) * self.half

    @property
    def outer(self) -> float:
        """Distance from the centre beyond which the weight is 0."""
        return (1 + TAPER) * self.half

    def place(self, aperture: Aperture, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return s minus the centre of the interval at points (..., 3) in metres, (pulse, ...) float64.

        Raises
        ------
        ValueError
            If the aperture has a different number of pulses.
        """
        if len(self.tx_axis) != len(aperture):
            raise ValueError(f"{len(self.tx_axis)=}: must equal the number of pulses, {len(aperture)}")
        # Matrix products relative to a nearby origin, to preserve the precision of squared distances.
        flat, origin = points_m.reshape(-1, 3), aperture.legs[0][:1].sum(axis=0)
        offset_m = flat - origin
        cosine = np.tile(-self.centre_at(flat), (len(aperture), 1))
        for axis, leg in zip((self.tx_axis, self.rx_axis), aperture.legs, strict=True):
            antenna = leg - origin
            square = antenna @ (-2 * offset_m.T)
            square += (antenna**2).sum(axis=1)[:, None]
            square += (offset_m**2).sum(axis=1)
            along = axis @ offset_m.T
            along -= (antenna * axis).sum(axis=1)[:, None]
            along /= np.sqrt(square, out=square)
            cosine += along
        return cosine.reshape(len(aperture), *points_m.shape[:-1])

    def weight(self, aperture: Aperture, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weight of each pulse at each point, 0 to 1; parameters and shape of the result as for `place`."""
        return edge((self.outer - np.abs(self.place(aperture, points_m))) / (self.outer - self.inner))

    def slack(
        self, aperture: Aperture, points_m: NDArray[np.float64], radius_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the largest change of `place` within given radii of points.

        Parameters
        ----------
        aperture, points_m
            As for `place`.
        radius_m
            Radii of spheres about the points, metres, in a shape that broadcasts with (pulse, ...).
        """
        slack = np.zeros((len(aperture), *points_m.shape[:-1]))
        if self.ends is not None:  # the centre of a pixel changes by no more than the extremes of s
            slack += (
                self.ends[1]
                .slack(self.ends[0], points_m, np.broadcast_to(radius_m, slack.shape).max(axis=0))
                .max(axis=0)
            )
        for axis, leg in zip((self.tx_axis, self.rx_axis), aperture.legs, strict=True):
            range_m = distance(leg.reshape(-1, *(1,) * (points_m.ndim - 1), 3), points_m)
            length = np.linalg.norm(axis, axis=1).reshape(-1, *(1,) * (points_m.ndim - 1))
            # a direction rotates by at most asin(radius/range); the difference of the unit vectors is smaller
            ratio = np.minimum(1.0, radius_m / range_m)
            slack += length * np.where(ratio < 1, np.pi / 2 * ratio, 2.0)
        return slack


def edge(depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weight at a depth inside a sector, in units of the edge width: a smoothstep function from 0 to 1.

    Examples
    --------
    >>> edge(np.array([-1.0, 0.0, 0.5, 1.0, 2.0]))
    array([0. , 0. , 0.5, 1. , 1. ])
    """
    inside = np.clip(depth, 0.0, 1.0)
    return np.asarray(inside**2 * (3 - 2 * inside))


def flight_axes(aperture: Aperture, *, chord_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the axes of a `Sector` at each pulse, from the displacement over a chord of `chord_m` about the pulse.

    Examples
    --------
    >>> along = np.stack([np.arange(9.0), np.zeros(9), np.zeros(9)], -1)
    >>> [axis[4].tolist() for axis in flight_axes(Aperture(along, 0 * along), chord_m=2.0)]
    [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    pulses = np.arange(len(aperture))
    path_m = np.cumsum(np.linalg.norm(np.diff(aperture.middle_m, axis=0, prepend=aperture.middle_m[:1]), axis=1))
    step = float(path_m[-1]) / max(1, len(aperture) - 1)
    half = int(min(max(1.0, np.ceil(chord_m / 2 / step)), len(aperture))) if step else 1
    before, after = np.maximum(pulses - half, 0), np.minimum(pulses + half, len(aperture) - 1)
    displacements = [leg[after] - leg[before] for leg in aperture.legs]
    total = sum(np.linalg.norm(displacement, axis=1) for displacement in displacements)
    tx, rx = (displacement / np.where(total > 0, total, 1.0)[:, None] for displacement in displacements)
    return tx, rx


def response() -> tuple[float, float]:
    """Return width and highest sidelobe of the point response along the flight for a sector with smooth edges.

    Returns
    -------
    width : float
        -3 dB width multiplied by the width of the sector's spectrum between the points of half weight.
    sidelobe_db : float
        Highest sidelobe, dB.

    Notes
    -----
    Source: docs/theory/integration.md, "Edges".

    Examples
    --------
    >>> [round(value, 2) for value in response()]
    [0.88, -13.44]
    """
    cosine = (np.arange(_SAMPLES) + 0.5) / _SAMPLES * (1 + TAPER)
    window = edge(((1 + TAPER) - cosine) / (2 * TAPER))
    position = np.linspace(0, 4, 2001)  # in units of the inverse width between half weights
    power = np.abs(np.cos(np.pi * np.multiply.outer(position, cosine)) @ window) ** 2
    power /= power[0]
    first = int(np.argmax(np.diff(power) > 0))
    width = 2 * float(np.interp(-0.5, -power[: first + 1], position[: first + 1]))
    return width, decibels(float(power[first:].max()))
