"""How a node flies: where its logged point is at any time, how it is turned, where its antennas are and look."""

from collections.abc import Callable
from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Literal, Protocol, Self

import numpy as np
from numpy.random import Generator
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from apertura.common.arrays import Floats
from apertura.core.geometry.geodesy import body_axes, ned_axes
from apertura.simulation.impairments import STRICT_KEYS
from apertura.simulation.scene import Origin, Vector


class Trajectory(Protocol):
    """Position (m east, north, up) and attitude (rad: roll, pitch, yaw from north) at seconds after the first pulse."""

    def position(self, time_s: Floats) -> Floats:
        """Return (time, 3) float64, metres east, north, up of the origin."""

    def attitude(self, time_s: Floats) -> Floats:
        """Return (time, 3) float64, radians."""


@plain_dataclass(frozen=True)
class Sampled:
    """A cubic spline through given epochs.

    Attributes
    ----------
    time_s
        (epoch,) float64, seconds after the first pulse, increasing.
    position_m, attitude_rad
        (epoch, 3) float64: east, north, up of the origin; roll, pitch, yaw.
    """

    time_s: Floats
    position_m: Floats
    attitude_rad: Floats

    def position(self, time_s: Floats) -> Floats:
        """Return (time, 3) float64, metres east, north, up of the origin."""
        return self._spline(self.position_m)(time_s)

    def attitude(self, time_s: Floats) -> Floats:
        """Return (time, 3) float64, radians."""
        return self._spline(np.unwrap(self.attitude_rad, axis=0))(time_s)

    def _spline(self, values: Floats) -> Callable[[Floats], Floats]:
        from scipy.interpolate import CubicSpline  # slow to import, and a straight flight needs none

        return lambda time_s: np.asarray(CubicSpline(self.time_s, values)(time_s), np.float64)


@dataclass(frozen=True, config=STRICT_KEYS)
class Wobble:
    """Smooth random motion about what was meant to be flown, as wind and a position controller leave it."""

    sigma_m: Vector = Field(default=(0.03, 0.05, 0.04), description="standard deviation east, north, up, m")
    attitude_sigma_deg: Vector = Field(default=(2.0, 2.0, 3.0), description="the same of roll, pitch, yaw, deg")
    smoothing_s: float = Field(default=1.0, gt=0, description="standard deviation of the smoothing Gaussian, s")

    def around(self, path: Trajectory, duration_s: float, generator: Generator) -> Sampled:
        """Return `path` with the motion drawn, from 10 s before the first pulse to 10 s after `duration_s`.

        Examples
        --------
        >>> shaken = Wobble().around(Straight((0, 0, 5), (1, 0, 0)), 60.0, np.random.default_rng(0))
        >>> (shaken.position(np.arange(600) / 10)[:, 2].std() < 0.06).item()
        True
        """
        from scipy.ndimage import gaussian_filter1d

        step_s = min(0.1, self.smoothing_s / 8)
        time_s = np.arange(-10.0, duration_s + 10.0 + step_s, step_s)
        width = self.smoothing_s / step_s
        noise = gaussian_filter1d(generator.standard_normal((time_s.size, 6)), width, axis=0, mode="reflect")
        noise *= np.sqrt(2 * np.sqrt(np.pi) * width)  # back to unit variance
        position = path.position(time_s) + noise[:, :3] * self.sigma_m
        attitude = path.attitude(time_s) + noise[:, 3:] * np.radians(self.attitude_sigma_deg)
        return Sampled(time_s, position, attitude)


@dataclass(frozen=True, config=STRICT_KEYS)
class Straight:
    """Constant velocity, nose along the course, wings level; `wobble` is added when the flight is drawn.

    Examples
    --------
    >>> path = Straight((0, 0, 5), (0.5, 0, 0))
    >>> path.position(np.array([2.0]))
    array([[1., 0., 5.]])
    >>> np.degrees(path.attitude(np.array([2.0]))[0, 2]).round(6)
    np.float64(90.0)
    """

    start_m: Vector = Field(description="east, north, up of the origin at the first pulse, m")
    velocity_m_s: Vector = Field(description="east, north, up, m/s")
    wobble: Wobble | None = Field(default=None, description="random motion about it; null: none")
    kind: Literal["straight"] = Field(default="straight", kw_only=True, repr=False)

    def position(self, time_s: Floats) -> Floats:
        """Return (time, 3) float64, metres east, north, up of the origin."""
        return np.asarray(np.array(self.start_m) + np.multiply.outer(time_s, self.velocity_m_s), np.float64)

    def attitude(self, time_s: Floats) -> Floats:
        """Return (time, 3) float64, radians."""
        yaw = np.arctan2(self.velocity_m_s[0], self.velocity_m_s[1])
        return np.tile([0.0, 0.0, yaw], (np.size(time_s), 1))

    def intended(self) -> Trajectory:
        """Return what was meant to be flown, without the wobble."""
        return self


@dataclass(frozen=True, config=STRICT_KEYS)
class Waypoints:
    """A cubic spline through places at given times, such as a recorded flight.

    Examples
    --------
    >>> path = Waypoints((0, 1, 2), ((0, 0, 5), (1, 0, 5), (2, 0, 5))).intended()
    >>> path.position(np.array([0.5])), np.degrees(path.attitude(np.array([0.5])))[0, 2].round(6)
    (array([[0.5, 0. , 5. ]]), np.float64(90.0))
    """

    time_s: tuple[float, ...] = Field(min_length=2, description="seconds after the first pulse, increasing")
    position_m: tuple[Vector, ...] = Field(description="east, north, up of the origin at each, m")
    attitude_deg: tuple[Vector, ...] | None = Field(
        default=None,
        description="roll, pitch, yaw (clockwise from north) at each, degrees; null: level and along the course",
    )
    wobble: Wobble | None = Field(default=None, description="random motion about it; null: none")
    kind: Literal["waypoints"] = Field(default="waypoints", kw_only=True, repr=False)

    @model_validator(mode="after")
    def _one_place_per_time(self) -> Self:
        if (np.diff(self.time_s) <= 0).any():
            raise ValueError("time_s must increase")
        if any(
            len(values) != len(self.time_s) for values in (self.position_m, self.attitude_deg) if values is not None
        ):
            raise ValueError(f"position_m and attitude_deg must have one row for each of the {len(self.time_s)} times")
        return self

    def intended(self) -> Trajectory:
        """Return what was meant to be flown, without the wobble."""
        time_s, position = np.array(self.time_s), np.array(self.position_m)
        if self.attitude_deg is not None:
            return Sampled(time_s, position, np.radians(self.attitude_deg))
        velocity = np.gradient(position, time_s, axis=0)
        yaw = np.arctan2(velocity[:, 0], velocity[:, 1])
        return Sampled(time_s, position, np.column_stack([np.zeros((len(yaw), 2)), yaw]))


Track = Annotated[Straight | Waypoints, Field(discriminator="kind")]


def phase_centre(origin: Origin, path: Trajectory, time_s: Floats, lever_arm_m: Vector = (0.0, 0.0, 0.0)) -> Floats:
    """Return (time, 3) float64 ECEF (m) of an antenna `lever_arm_m` (forward, right, down) from the logged point.

    Examples
    --------
    >>> here = phase_centre(Origin(0, 0, 0), Straight((0, 0, 0), (1, 0, 0)), np.zeros(1), (0.0, 0.0, -1.0))
    >>> here.round(6) + 0.0
    array([[6378138.,       0.,       0.]])
    """
    position = origin.ecef(path.position(time_s))
    return np.asarray(position + body_turn(origin, path, time_s) @ np.array(lever_arm_m, np.float64))


def body_turn(origin: Origin, path: Trajectory, time_s: Floats) -> Floats:
    """Return (time, 3, 3) float64: forward-right-down of the body into ECEF.

    Examples
    --------
    >>> turn = body_turn(Origin(0, 0, 0), Straight((0, 0, 0), (1, 0, 0)), np.zeros(1))
    >>> (turn[0] @ [1.0, 0.0, 0.0]).round(6) + 0.0  # forward is east
    array([0., 1., 0.])
    """
    return np.asarray(ned_axes(origin.ecef(path.position(time_s))) @ body_axes(path.attitude(time_s)))


def logged_velocity(origin: Origin, path: Trajectory, time_s: Floats) -> Floats:
    """Return (time, 3) float64 ECEF velocity (m/s) of the logged point."""
    half_s = 1e-3
    after, before = (phase_centre(origin, path, time_s + sign * half_s) for sign in (1, -1))
    return np.asarray((after - before) / (2 * half_s))


@dataclass(frozen=True, config=STRICT_KEYS)
class GaussianBeam:
    """The beam of an antenna fixed to a node's body."""

    boresight_deg: tuple[float, float] = Field(
        description="azimuth clockwise from forward, elevation above the forward-right plane, degrees"
    )
    beamwidth_deg: tuple[float, float] = Field(description="full width at half power in azimuth, elevation, degrees")

    def gain(self, turn: Floats, antenna_m: Floats, points_m: Floats) -> Floats:
        """Return the field (pulse, point) float64 towards points, relative to boresight.

        Parameters
        ----------
        turn
            (pulse, 3, 3) float64, forward-right-down of the body into the frame of the points.
        antenna_m, points_m
            (pulse, 3) and (point, 3) float64, metres, in that frame.

        Notes
        -----
        Source: docs/theory/simulate.md, eq. 7. The antenna is turned in the body as a body is: by yaw, then pitch.

        Examples
        --------
        >>> aside = GaussianBeam((90.0, 0.0), (20.0, 40.0))
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
