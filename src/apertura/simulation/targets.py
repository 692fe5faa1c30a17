"""Targets of a scene and trajectories of nodes, in east, north and up coordinates of an origin."""

from collections.abc import Callable
from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Literal, Protocol, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from apertura.common.arrays import Floats
from apertura.core.geometry.geodesy import body_axes, ecef_from_geodetic, ned_axes
from apertura.simulation.impairments import STRICT_KEYS

Vector = tuple[float, float, float]

_NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, config=STRICT_KEYS)
class Origin:
    """Geodetic origin of the east, north and up coordinates of a simulation (a tangent plane).

    Examples
    --------
    >>> origin = Origin(0.0, 0.0, 0.0)
    >>> origin.ecef(np.array([0.0, 0.0, 10.0]))
    array([6378147.,       0.,       0.])
    >>> origin.enu(origin.ecef(np.array([1.0, 2.0, 3.0]))).round(6)
    array([1., 2., 3.])
    """

    latitude_deg: float = Field(ge=-90, le=90, description="WGS 84, degrees")
    longitude_deg: float = Field(ge=-180, le=180, description="WGS 84, degrees")
    height_m: float = Field(description="height above the ellipsoid, m")

    def ecef(self, enu_m: Floats) -> Floats:
        """Convert east, north, up to ECEF, (..., 3) float64, metres."""
        centre, axes = self._frame()
        return np.asarray(centre + enu_m @ axes.T)

    def enu(self, ecef_m: Floats) -> Floats:
        """Convert ECEF to east, north, up, (..., 3) float64, metres."""
        centre, axes = self._frame()
        return np.asarray((ecef_m - centre) @ axes)

    def _frame(self) -> tuple[Floats, Floats]:
        centre = ecef_from_geodetic(*(np.array(v) for v in (self.latitude_deg, self.longitude_deg, self.height_m)))
        return centre, ned_axes(centre) @ _NED_FROM_ENU


@plain_dataclass(frozen=True)
class Scatterers:
    """Point scatterers of all targets.

    Attributes
    ----------
    position_m
        (point, 3) float64, metres.
    amplitude
        (point,) complex128, echo amplitude at 1 m × 1 m.
    """

    position_m: Floats
    amplitude: NDArray[np.complex128]


@dataclass(frozen=True, config=STRICT_KEYS)
class PointTarget:
    """Point target."""

    position_m: Vector = Field(description="east, north, up, m")
    amplitude: complex = Field(default=1.0, description="echo amplitude at 1 m × 1 m")
    kind: Literal["point"] = Field(default="point", kw_only=True, repr=False)

    def points(self, generator: Generator) -> Scatterers:  # noqa: ARG002
        """Return the point, east-north-up (m)."""
        return Scatterers(np.array([self.position_m], np.float64), np.array([self.amplitude], np.complex128))


@dataclass(frozen=True, config=STRICT_KEYS)
class Line:
    """Line target, such as a wire or an edge: equal points from start to end, inclusive."""

    start_m: Vector = Field(description="east, north, up, m")
    end_m: Vector = Field(description="east, north, up, m")
    count: int = Field(gt=0, description="number of points")
    amplitude: complex = Field(default=1.0, description="echo amplitude of all points together")
    kind: Literal["line"] = Field(default="line", kw_only=True, repr=False)

    def points(self, generator: Generator) -> Scatterers:  # noqa: ARG002
        """Return `count` points, east-north-up (m)."""
        share = np.linspace(0.0, 1.0, self.count)[:, None]
        position = (1 - share) * np.array(self.start_m) + share * np.array(self.end_m)
        return Scatterers(position, np.full(self.count, self.amplitude / self.count, np.complex128))


@dataclass(frozen=True, config=STRICT_KEYS)
class Plate:
    """Plate target: a flat parallelogram (facet) of points, including its corners.

    Examples
    --------
    >>> plate = Plate((0, 0, 0), (1, 0, 0), (0, 0, 1), counts=(2, 3))
    >>> plate.points(np.random.default_rng(0)).position_m[-1]
    array([1., 0., 1.])
    """

    corner_m: Vector = Field(description="east, north, up, m")
    side_m: Vector = Field(description="vector from the corner along one side, m")
    other_side_m: Vector = Field(description="vector from the corner along the other side, m")
    counts: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] = Field(
        description="number of points along each side"
    )
    amplitude: complex = Field(default=1.0, description="echo amplitude of all points together")
    kind: Literal["plate"] = Field(default="plate", kw_only=True, repr=False)

    def points(self, generator: Generator) -> Scatterers:  # noqa: ARG002
        """Return counts[0] × counts[1] points, east-north-up (m)."""
        first, second = (np.linspace(0.0, 1.0, count) for count in self.counts)
        grid = np.stack(np.meshgrid(first, second, indexing="ij"), -1).reshape(-1, 2)
        position = np.array(self.corner_m) + grid @ np.array([self.side_m, self.other_side_m], np.float64)
        return Scatterers(position, np.full(len(grid), self.amplitude / len(grid), np.complex128))


@dataclass(frozen=True, config=STRICT_KEYS)
class Clutter:
    """Clutter of random points with circular Gaussian amplitudes; magnitudes of resolution cells are Rayleigh."""

    bounds_m: tuple[float, float, float, float] = Field(description="east min, north min, east max, north max, m")
    reflectivity: float = Field(ge=0, description="mean power per square metre; 1: one unit point target per m²")
    density_per_m2: float = Field(
        default=10.0, gt=0, description="points per m²; several per resolution cell give developed speckle"
    )
    up_m: float = Field(default=0.0, description="height above the origin, m")
    slope: tuple[float, float] = Field(
        default=(0.0, 0.0), description="slope eastward and northward from the origin, m/m"
    )
    kind: Literal["clutter"] = Field(default="clutter", kw_only=True, repr=False)

    def points(self, generator: Generator) -> Scatterers:
        """Draw the points and their amplitudes, east-north-up (m)."""
        east, north, east_max, north_max = self.bounds_m
        count = round((east_max - east) * (north_max - north) * self.density_per_m2)
        plan = generator.uniform((east, north), (east_max, north_max), (count, 2))
        parts = generator.standard_normal((count, 2)) * np.sqrt(self.reflectivity / self.density_per_m2 / 2)
        position = np.column_stack([plan, self.up_m + plan @ np.array(self.slope)])
        return Scatterers(position, parts[:, 0] + 1j * parts[:, 1])


Target = Annotated[PointTarget | Line | Plate | Clutter, Field(discriminator="kind")]


@dataclass(frozen=True, config=STRICT_KEYS)
class TargetChange:
    """Change of a target of the campaign in one flight: displaced, turned, weaker, stronger or absent."""

    target: int = Field(ge=0, description="number of the target in `targets`, from 0")
    shift_m: Vector = Field(default=(0.0, 0.0, 0.0), description="displacement of all its points east, north, up, m")
    factor: complex = Field(default=1.0, description="factor of its echo amplitude; 0: the target is absent")


def scatterers(
    origin: Origin, targets: tuple[Target, ...], generator: Generator, changes: tuple[TargetChange, ...] = ()
) -> Scatterers:
    """Return the point scatterers of all targets in ECEF (m); `generator` draws the clutter.

    `changes` are applied to the drawn points, so that flights over one scene have the same clutter.

    Examples
    --------
    >>> targets = (PointTarget((0, 0, 1)), Line((0, 0, 0), (1, 0, 0), 4))
    >>> scatterers(Origin(0, 0, 0), targets, np.random.default_rng(0)).position_m.shape
    (5, 3)
    >>> gone = scatterers(Origin(0, 0, 0), targets, np.random.default_rng(0), (TargetChange(0, factor=0.0),))
    >>> gone.amplitude.real
    array([0.  , 0.25, 0.25, 0.25, 0.25])
    """
    parts = [target.points(generator) for target in targets]
    for change in changes:
        part = parts[change.target]
        parts[change.target] = Scatterers(part.position_m + np.array(change.shift_m), part.amplitude * change.factor)
    position = np.concatenate([np.empty((0, 3)), *(part.position_m for part in parts)])
    return Scatterers(origin.ecef(position), np.concatenate([[0j][:0], *(part.amplitude for part in parts)]))


class Trajectory(Protocol):
    """Position and attitude of a node as functions of the time after the first pulse, seconds."""

    def position(self, time_s: Floats) -> Floats:
        """Return the position, (time, 3) float64, metres east, north, up of the origin."""

    def attitude(self, time_s: Floats) -> Floats:
        """Return roll, pitch and yaw (from north), (time, 3) float64, radians."""


@plain_dataclass(frozen=True)
class Sampled:
    """Trajectory by cubic splines through epochs.

    Attributes
    ----------
    time_s
        (epoch,) float64, seconds after the first pulse, ascending.
    position_m, attitude_rad
        (epoch, 3) float64: east, north, up of the origin; roll, pitch, yaw.
    """

    time_s: Floats
    position_m: Floats
    attitude_rad: Floats

    def position(self, time_s: Floats) -> Floats:
        """Return the position, (time, 3) float64, metres east, north, up of the origin."""
        return self._spline(self.position_m)(time_s)

    def attitude(self, time_s: Floats) -> Floats:
        """Return roll, pitch and yaw (from north), (time, 3) float64, radians."""
        return self._spline(np.unwrap(self.attitude_rad, axis=0))(time_s)

    def _spline(self, values: Floats) -> Callable[[Floats], Floats]:
        from scipy.interpolate import CubicSpline  # slow to import, and not required for a straight flight

        return lambda time_s: np.asarray(CubicSpline(self.time_s, values)(time_s), np.float64)


@dataclass(frozen=True, config=STRICT_KEYS)
class Wobble:
    """Smooth random motion about the intended track, as caused by wind and a position controller."""

    sigma_m: Vector = Field(default=(0.03, 0.05, 0.04), description="standard deviation east, north, up, m")
    attitude_sigma_deg: Vector = Field(
        default=(2.0, 2.0, 3.0), description="standard deviation of roll, pitch, yaw, degrees"
    )
    smoothing_s: float = Field(default=1.0, gt=0, description="standard deviation of the smoothing Gaussian, s")

    def around(self, path: Trajectory, duration_s: float, generator: Generator) -> Sampled:
        """Add a drawn motion to `path`, from 10 s before the first pulse to 10 s after `duration_s`.

        Examples
        --------
        >>> wobbling = Wobble().around(Straight((0, 0, 5), (1, 0, 0)), 60.0, np.random.default_rng(0))
        >>> (wobbling.position(np.arange(600) / 10)[:, 2].std() < 0.06).item()
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
    """Track of constant velocity with level attitude along the course; `wobble` is added when the flight is drawn.

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
    wobble: Wobble | None = Field(default=None, description="random motion about the track; null: none")
    kind: Literal["straight"] = Field(default="straight", kw_only=True, repr=False)

    def position(self, time_s: Floats) -> Floats:
        """Return the position, (time, 3) float64, metres east, north, up of the origin."""
        return np.asarray(np.array(self.start_m) + np.multiply.outer(time_s, self.velocity_m_s), np.float64)

    def attitude(self, time_s: Floats) -> Floats:
        """Return roll, pitch and yaw (from north), (time, 3) float64, radians."""
        yaw = np.arctan2(self.velocity_m_s[0], self.velocity_m_s[1])
        return np.tile([0.0, 0.0, yaw], (np.size(time_s), 1))

    def intended(self) -> Trajectory:
        """Return the intended trajectory, without the wobble."""
        return self


@dataclass(frozen=True, config=STRICT_KEYS)
class Waypoints:
    """Track by a cubic spline through positions at given times, such as those of a recorded flight.

    Examples
    --------
    >>> path = Waypoints((0, 1, 2), ((0, 0, 5), (1, 0, 5), (2, 0, 5))).intended()
    >>> path.position(np.array([0.5])), np.degrees(path.attitude(np.array([0.5])))[0, 2].round(6)
    (array([[0.5, 0. , 5. ]]), np.float64(90.0))
    """

    time_s: tuple[float, ...] = Field(min_length=2, description="times, seconds after the first pulse, ascending")
    position_m: tuple[Vector, ...] = Field(description="east, north, up of the origin at each time, m")
    attitude_deg: tuple[Vector, ...] | None = Field(
        default=None,
        description="roll, pitch, yaw (clockwise from north) at each time, degrees; null: level and along the course",
    )
    wobble: Wobble | None = Field(default=None, description="random motion about the track; null: none")
    kind: Literal["waypoints"] = Field(default="waypoints", kw_only=True, repr=False)

    @model_validator(mode="after")
    def _one_place_per_time(self) -> Self:
        if (np.diff(self.time_s) <= 0).any():
            raise ValueError("time_s must be strictly ascending")
        if any(
            len(values) != len(self.time_s) for values in (self.position_m, self.attitude_deg) if values is not None
        ):
            raise ValueError(f"position_m and attitude_deg must have one row for each of the {len(self.time_s)} times")
        return self

    def intended(self) -> Trajectory:
        """Return the intended trajectory, without the wobble."""
        time_s, position = np.array(self.time_s), np.array(self.position_m)
        if self.attitude_deg is not None:
            return Sampled(time_s, position, np.radians(self.attitude_deg))
        velocity = np.gradient(position, time_s, axis=0)
        yaw = np.arctan2(velocity[:, 0], velocity[:, 1])
        return Sampled(time_s, position, np.column_stack([np.zeros((len(yaw), 2)), yaw]))


Track = Annotated[Straight | Waypoints, Field(discriminator="kind")]


def phase_centre(origin: Origin, path: Trajectory, time_s: Floats, lever_arm_m: Vector = (0.0, 0.0, 0.0)) -> Floats:
    """Return the ECEF position of an antenna at `lever_arm_m` (forward, right, down) from the logged point, (time, 3).

    Examples
    --------
    >>> position_m = phase_centre(Origin(0, 0, 0), Straight((0, 0, 0), (1, 0, 0)), np.zeros(1), (0.0, 0.0, -1.0))
    >>> position_m.round(6) + 0.0
    array([[6378138.,       0.,       0.]])
    """
    position = origin.ecef(path.position(time_s))
    return np.asarray(position + body_rotation(origin, path, time_s) @ np.array(lever_arm_m, np.float64))


def body_rotation(origin: Origin, path: Trajectory, time_s: Floats) -> Floats:
    """Return the rotations from body axes (forward, right, down) to ECEF, (time, 3, 3) float64.

    Examples
    --------
    >>> rotation = body_rotation(Origin(0, 0, 0), Straight((0, 0, 0), (1, 0, 0)), np.zeros(1))
    >>> (rotation[0] @ [1.0, 0.0, 0.0]).round(6) + 0.0  # forward is east
    array([0., 1., 0.])
    """
    return np.asarray(ned_axes(origin.ecef(path.position(time_s))) @ body_axes(path.attitude(time_s)))


def logged_velocity(origin: Origin, path: Trajectory, time_s: Floats) -> Floats:
    """Return the ECEF velocity of the logged point, (time, 3) float64, m/s."""
    half_s = 1e-3
    after, before = (phase_centre(origin, path, time_s + sign * half_s) for sign in (1, -1))
    return np.asarray((after - before) / (2 * half_s))


@dataclass(frozen=True, config=STRICT_KEYS)
class GaussianBeam:
    """Gaussian beam of an antenna that is fixed to the body of a node."""

    boresight_deg: tuple[float, float] = Field(
        description="azimuth clockwise from forward, elevation above the forward-right plane, degrees"
    )
    beamwidth_deg: tuple[float, float] = Field(description="full width at half power in azimuth, elevation, degrees")

    def gain(self, rotation: Floats, antenna_m: Floats, points_m: Floats) -> Floats:
        """Return the field towards points relative to boresight, (pulse, point) float64.

        Parameters
        ----------
        rotation
            (pulse, 3, 3) float64, rotations from body axes (forward, right, down) to the frame of the points.
        antenna_m, points_m
            (pulse, 3) and (point, 3) float64, metres, in that frame.

        Notes
        -----
        Source: docs/theory/simulate.md, eq. 7. The antenna is rotated relative to the body by yaw, then pitch.

        Examples
        --------
        >>> aside = GaussianBeam((90.0, 0.0), (20.0, 40.0))
        >>> points = np.array([[0.0, 5.0, 0.0], [-np.sin(np.radians(10)), np.cos(np.radians(10)), 0.0]])
        >>> (aside.gain(np.eye(3)[None], np.zeros((1, 3)), points) ** 2).round(3)
        array([[1. , 0.5]])
        """
        azimuth_deg, elevation_deg = self.boresight_deg
        axes = rotation @ body_axes(np.radians([0.0, elevation_deg, azimuth_deg]))
        ahead, right, down = np.einsum("pij,pni->jpn", axes, points_m[None] - antenna_m[:, None])
        azimuth, elevation = np.arctan2(right, ahead), np.arctan2(-down, np.hypot(ahead, right))
        cuts = zip((azimuth, elevation), np.radians(self.beamwidth_deg), strict=True)
        return np.asarray(2.0 ** (-2 * sum((angle / width) ** 2 for angle, width in cuts)))
