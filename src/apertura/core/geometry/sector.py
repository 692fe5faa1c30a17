"""The sector that a pixel is integrated over: weights of the pulses of a long flight at each pixel."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.common.units import decibels
from apertura.core.geometry.aperture import Aperture, Weigh, distance

TAPER = 0.1
"""Of the half width: the weight falls from 1 to 0 between 1 - TAPER and 1 + TAPER (docs/theory/integration.md)."""

_SAMPLES = 256  # of the window: its width and sidelobe to 1e-6
_TRIED = 256  # pulses among which those are looked for that end what was flown
_END = 0.01  # of the half width: how well these know it


@dataclass(frozen=True, eq=False)
class Sector:
    """Interval of the direction cosine to the flight within which a pulse counts for a pixel.

    With u_t, u_r the unit vectors from the antennas to the pixel, s = a_t·u_t + a_r·u_r is the decrease of the total
    path per metre that both antennas fly together: 0 at the closest approach, 1 straight ahead. A pulse counts
    for a pixel where s is within `half` of the centre, with a smooth edge. The centre of a pixel is `centre`, or, where
    too little of its sector was flown, the nearest one of which all was (`following`).

    Attributes
    ----------
    tx_axis, rx_axis
        (pulse, 3) float64: displacement of each antenna over that of both together; their lengths sum to 1, or are 0
        where no antenna moves and every pixel is at its closest approach.
    centre, half
        Of s; at the centre ± `half` the weight is one half.
    ends
        Pulses at which s of some pixel is least or largest, and the sector of these pulses; None: `centre` is that of
        every pixel.

    Raises
    ------
    ValueError
        If shapes differ, or the half width is not positive.

    Notes
    -----
    Source: docs/theory/integration.md, eq. 1, 3 and 4.

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
            In the frame of the pixels.
        chord_m
            Distance over which a direction is taken: longer than positions err, shorter than the flight turns.
        centre, half
            As of a `Sector`.
        """
        return cls(*flight_axes(aperture, chord_m=chord_m), centre, half)

    def __getitem__(self, pulses: slice | NDArray[np.int64]) -> "Sector":
        """Return the sector of some pulses."""
        return replace(self, tx_axis=self.tx_axis[pulses], rx_axis=self.rx_axis[pulses])

    def following(self, aperture: Aperture, points_m: NDArray[np.float64]) -> "Sector":
        """Return the sector whose centres follow what was flown past each pixel.

        Parameters
        ----------
        aperture
            Of the same pulses.
        points_m
            (point, 3) float64, metres, spread over the scene.

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
        some = np.unique(np.append(np.arange(len(aperture))[aperture.sample(_TRIED)], len(aperture) - 1))
        few, there = aperture[some], replace(self[some], ends=None)
        place = there.place(few, points_m)
        if (place.min(axis=0) <= -self.outer).all() and (place.max(axis=0) >= self.outer).all():
            return self  # every place was passed by more than its sector
        # The fewest pulses by which the ends of what was flown are known to a small part of the sector.
        within = np.concatenate([place, -place], axis=1)
        within = within <= within.min(axis=0) + _END * self.half
        ends: list[int] = []
        while within.any():
            ends.append(int(within.sum(axis=1).argmax()))
            within &= ~within[ends[-1]]
        return replace(self, ends=(few[np.array(ends)], there[np.array(ends)]))

    def centre_at(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the centre of s of each point (..., 3), in metres: (...) float64."""
        if self.ends is None:
            return np.full(points_m.shape[:-1], self.centre)
        aperture, there = self.ends
        place = there.place(aperture, points_m) + self.centre
        first, last = place.min(axis=0), place.max(axis=0)
        middle = (first + last) / 2
        lowest, highest = np.minimum(first + self.outer, middle), np.maximum(last - self.outer, middle)
        return np.asarray(np.clip(self.centre, lowest, highest))

    def axis_change(self, other: "Sector") -> NDArray[np.float64]:
        """Return the largest change of s by other axes, of a sector of as many pulses, (pulse,)."""
        axes = ((self.tx_axis, other.tx_axis), (self.rx_axis, other.rx_axis))
        return np.asarray(sum(np.linalg.norm(mine - theirs, axis=1) for mine, theirs in axes))

    @property
    def inner(self) -> float:
        """Distance from the centre up to which the weight is 1."""
        return (1 - TAPER) * self.half

    @property
    def outer(self) -> float:
        """Distance from the centre from which on it is 0."""
        return (1 + TAPER) * self.half

    def place(self, aperture: Aperture, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return s less the centre of the point, (pulse, ...) float64, of points (..., 3) in metres.

        Raises
        ------
        ValueError
            If the aperture is of other pulses.
        """
        if len(self.tx_axis) != len(aperture):
            raise ValueError(f"{len(self.tx_axis)=}: must be one for each of {len(aperture)} pulses")
        # Matrix products about a nearby origin, where squares of distances keep their precision.
        flat, middle = points_m.reshape(-1, 3), aperture.legs[0][:1].sum(axis=0)
        offset_m = flat - middle
        place = np.tile(-self.centre_at(flat), (len(aperture), 1))
        for axis, leg in zip((self.tx_axis, self.rx_axis), aperture.legs, strict=True):
            antenna = leg - middle
            square = antenna @ (-2 * offset_m.T)
            square += (antenna**2).sum(axis=1)[:, None]
            square += (offset_m**2).sum(axis=1)
            along = axis @ offset_m.T
            along -= (antenna * axis).sum(axis=1)[:, None]
            along /= np.sqrt(square, out=square)
            place += along
        return place.reshape(len(aperture), *points_m.shape[:-1])

    def weight(self, aperture: Aperture, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weight of each pulse at each point: as `place`, 0 to 1."""
        return edge((self.outer - np.abs(self.place(aperture, points_m))) / (self.outer - self.inner))

    def over(self, aperture: Aperture) -> Weigh:
        """Return the function that weights some pulses of an aperture at points."""
        return lambda pulses, points_m: self[pulses].weight(aperture[pulses], points_m)

    def slack(
        self, aperture: Aperture, points_m: NDArray[np.float64], radius_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the largest change of `place` within some radius of a point.

        Parameters
        ----------
        aperture, points_m
            As `place`.
        radius_m
            Of balls about the points, metres, in a shape that goes with (pulse, ...).
        """
        slack = np.zeros((len(aperture), *points_m.shape[:-1]))
        if self.ends is not None:  # a centre moves no farther than the ends of what was flown
            slack += (
                self.ends[1]
                .slack(self.ends[0], points_m, np.broadcast_to(radius_m, slack.shape).max(axis=0))
                .max(axis=0)
            )
        for axis, leg in zip((self.tx_axis, self.rx_axis), aperture.legs, strict=True):
            range_m = distance(leg.reshape(-1, *(1,) * (points_m.ndim - 1), 3), points_m)
            length = np.linalg.norm(axis, axis=1).reshape(-1, *(1,) * (points_m.ndim - 1))
            # a direction rotates by asin(radius/range) at most; the difference of the unit vectors is less
            turn = np.minimum(1.0, radius_m / range_m)
            slack += length * np.where(turn < 1, np.pi / 2 * turn, 2.0)
        return slack


def edge(depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weight at some depth inside a sector, in widths of its edge: 0 at 0, 1 at 1, level at both.

    Examples
    --------
    >>> edge(np.array([-1.0, 0.0, 0.5, 1.0, 2.0]))
    array([0. , 0. , 0.5, 1. , 1. ])
    """
    inside = np.clip(depth, 0.0, 1.0)
    return np.asarray(inside**2 * (3 - 2 * inside))


def flight_axes(aperture: Aperture, *, chord_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the axes of a `Sector`: of each pulse, over the distance `chord_m` about it, clipped at the ends.

    Examples
    --------
    >>> along = np.stack([np.arange(9.0), np.zeros(9), np.zeros(9)], -1)
    >>> [axis[4].tolist() for axis in flight_axes(Aperture(along, 0 * along), chord_m=2.0)]
    [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    pulses = np.arange(len(aperture))
    way = np.cumsum(np.linalg.norm(np.diff(aperture.middle_m, axis=0, prepend=aperture.middle_m[:1]), axis=1))
    step = float(way[-1]) / max(1, len(aperture) - 1)
    half = int(min(max(1.0, np.ceil(chord_m / 2 / step)), len(aperture))) if step else 1
    before, after = np.maximum(pulses - half, 0), np.minimum(pulses + half, len(aperture) - 1)
    flown = [leg[after] - leg[before] for leg in aperture.legs]
    together = sum(np.linalg.norm(leg, axis=1) for leg in flown)
    tx, rx = (leg / np.where(together > 0, together, 1.0)[:, None] for leg in flown)
    return tx, rx


def response() -> tuple[float, float]:
    """Return width and highest sidelobe of a point's response along the flight, by the smooth edges.

    Returns
    -------
    width : float
        -3 dB width times the width of the sector's spectrum between its half weights.
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
    place = (np.arange(_SAMPLES) + 0.5) / _SAMPLES * (1 + TAPER)
    window = edge(((1 + TAPER) - place) / (2 * TAPER))
    at = np.linspace(0, 4, 2001)  # in inverses of the width between half weights
    power = np.abs(np.cos(np.pi * np.multiply.outer(at, place)) @ window) ** 2
    power /= power[0]
    first = int(np.argmax(np.diff(power) > 0))
    width = 2 * float(np.interp(-0.5, -power[: first + 1], at[: first + 1]))
    return width, decibels(float(power[first:].max()))
