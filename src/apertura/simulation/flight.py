"""How a node flies: where its logged point is at any time, how it is turned, and where its antennas are then."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from apertura.geometry.geodesy import body_axes, ecef_from_geodetic, ned_axes
from apertura.simulation.scene import Origin, Vector

Floats = NDArray[np.float64]


class Trajectory(Protocol):
    """Position (m east, north, up) and attitude (rad: roll, pitch, yaw from north) at seconds after the first pulse."""

    def position(self, time_s: Floats) -> Floats:
        """Return (time, 3) float64, metres east, north, up of the origin."""

    def attitude(self, time_s: Floats) -> Floats:
        """Return (time, 3) float64, radians."""


@dataclass(frozen=True)
class Straight:
    """Constant velocity, nose along the course, wings level.

    Attributes
    ----------
    start_m
        East, north, up at the first pulse, metres.
    velocity_m_s
        East, north, up, metres per second.

    Examples
    --------
    >>> path = Straight((0, 0, 5), (0.5, 0, 0))
    >>> path.position(np.array([2.0]))
    array([[1., 0., 5.]])
    >>> np.degrees(path.attitude(np.array([2.0]))[0, 2]).round(6)
    np.float64(90.0)
    """

    start_m: Vector
    velocity_m_s: Vector

    def position(self, time_s: Floats) -> Floats:
        """Return (time, 3) float64, metres east, north, up of the origin."""
        return np.asarray(np.array(self.start_m) + np.multiply.outer(time_s, self.velocity_m_s), np.float64)

    def attitude(self, time_s: Floats) -> Floats:
        """Return (time, 3) float64, radians."""
        yaw = np.arctan2(self.velocity_m_s[0], self.velocity_m_s[1])
        return np.tile([0.0, 0.0, yaw], (np.size(time_s), 1))


@dataclass(frozen=True)
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
        return np.asarray(CubicSpline(self.time_s, self.position_m)(time_s), np.float64)

    def attitude(self, time_s: Floats) -> Floats:
        """Return (time, 3) float64, radians."""
        return np.asarray(CubicSpline(self.time_s, np.unwrap(self.attitude_rad, axis=0))(time_s), np.float64)


def wobble(
    path: Trajectory,
    duration_s: float,
    generator: Generator,
    *,
    sigma_m: Vector = (0.03, 0.05, 0.04),
    attitude_sigma_deg: Vector = (2.0, 2.0, 3.0),
    smoothing_s: float = 1.0,
) -> Sampled:
    """Return `path` shaken by smooth random motion, as wind and a position controller leave it.

    Parameters
    ----------
    path
        What was meant to be flown.
    duration_s
        Time from first to last pulse; 10 s more are made on either side.
    generator
        Draws the motion.
    sigma_m
        Standard deviation east, north, up, metres.
    attitude_sigma_deg
        Standard deviation of roll, pitch, yaw, degrees.
    smoothing_s
        Standard deviation of the Gaussian that smooths white noise.

    Examples
    --------
    >>> shaken = wobble(Straight((0, 0, 5), (1, 0, 0)), 60.0, np.random.default_rng(0))
    >>> (shaken.position(np.arange(600) / 10)[:, 2].std() < 0.06).item()
    True
    """
    step_s = min(0.1, smoothing_s / 8)
    time_s = np.arange(-10.0, duration_s + 10.0 + step_s, step_s)
    width = smoothing_s / step_s
    noise = gaussian_filter1d(generator.standard_normal((time_s.size, 6)), width, axis=0, mode="reflect")
    noise *= np.sqrt(2 * np.sqrt(np.pi) * width)  # back to unit variance
    position = path.position(time_s) + noise[:, :3] * sigma_m
    return Sampled(time_s, position, path.attitude(time_s) + noise[:, 3:] * np.radians(attitude_sigma_deg))


def follow_log(
    time_s: Floats,
    geodetic: Floats,
    origin: Origin,
    *,
    attitude_rad: Floats | None = None,
    start_s: float = 0.0,
    moved_to_m: Vector | None = None,
) -> Sampled:
    """Return a recorded flight as a trajectory.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, increasing; any zero.
    geodetic
        (epoch, 3) float64: latitude (deg), longitude (deg), ellipsoidal height (m).
    origin
        Where the simulation counts from.
    attitude_rad
        (epoch, 3) float64: roll, pitch, yaw; level and along the course if None.
    start_s
        The log's time of the first pulse.
    moved_to_m
        East, north, up at which the first pulse shall be; the place of the log if None.

    Examples
    --------
    >>> log = np.array([[0, 0, 10.0], [0, 1e-5, 10.0], [0, 2e-5, 10.0]])
    >>> path = follow_log(np.arange(3.0), log, Origin(0, 0, 0), moved_to_m=(0, 0, 5))
    >>> path.position(np.array([1.0])).round(2) + 0.0
    array([[1.11, 0.  , 5.  ]])
    """
    position = origin.enu(ecef_from_geodetic(*geodetic.T))
    time_s = time_s - start_s
    if attitude_rad is None:
        velocity = np.gradient(position, time_s, axis=0)
        yaw = np.arctan2(velocity[:, 0], velocity[:, 1])
        attitude_rad = np.column_stack([np.zeros((len(yaw), 2)), yaw])
    flown = Sampled(time_s, position, attitude_rad)
    if moved_to_m is None:
        return flown
    shift = np.array(moved_to_m) - flown.position(np.zeros(1))
    return Sampled(time_s, position + shift, attitude_rad)


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


def phase_centre_velocity(
    origin: Origin, path: Trajectory, time_s: Floats, lever_arm_m: Vector = (0.0, 0.0, 0.0)
) -> Floats:
    """Return (time, 3) float64 ECEF velocity (m/s) of the same antenna."""
    half_s = 1e-3
    after, before = (phase_centre(origin, path, time_s + sign * half_s, lever_arm_m) for sign in (1, -1))
    return np.asarray((after - before) / (2 * half_s))
