"""What the radar looks at: points, lines, plates and clutter at places east, north and up of an origin."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from apertura.geometry.geodesy import ecef_from_geodetic, ned_axes

Vector = tuple[float, float, float]
Floats = NDArray[np.float64]

_NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Origin:
    """The place on Earth from which a simulation counts east, north and up (a plane, not the curved ground).

    Attributes
    ----------
    latitude_deg, longitude_deg
        WGS 84, degrees.
    height_m
        Above the ellipsoid, metres.

    Examples
    --------
    >>> origin = Origin(0.0, 0.0, 0.0)
    >>> origin.ecef(np.array([0.0, 0.0, 10.0]))
    array([6378147.,       0.,       0.])
    >>> origin.enu(origin.ecef(np.array([1.0, 2.0, 3.0]))).round(6)
    array([1., 2., 3.])
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float

    def ecef(self, enu_m: Floats) -> Floats:
        """Return (..., 3) float64 ECEF (m) of (..., 3) east, north, up (m)."""
        centre, axes = self._frame()
        return np.asarray(centre + enu_m @ axes.T)

    def enu(self, ecef_m: Floats) -> Floats:
        """Return (..., 3) float64 east, north, up (m) of (..., 3) ECEF (m)."""
        centre, axes = self._frame()
        return np.asarray((ecef_m - centre) @ axes)

    def _frame(self) -> tuple[Floats, Floats]:
        centre = ecef_from_geodetic(*(np.array(v) for v in (self.latitude_deg, self.longitude_deg, self.height_m)))
        return centre, ned_axes(centre) @ _NED_FROM_ENU


@dataclass(frozen=True)
class Scatterers:
    """Points that scatter, whatever shape they came from.

    Attributes
    ----------
    position_m
        (point, 3) float64, metres, in the frame asked for.
    amplitude
        (point,) complex128, echo amplitude at 1 m × 1 m.
    """

    position_m: Floats
    amplitude: NDArray[np.complex128]


class Target(Protocol):
    """Anything that can be drawn as points."""

    def points(self, generator: Generator) -> Scatterers:
        """Return its points, east-north-up (m)."""


@dataclass(frozen=True)
class PointTarget:
    """A point: east, north, up (m) and complex amplitude."""

    position_m: Vector
    amplitude: complex = 1.0

    def points(self, generator: Generator) -> Scatterers:  # noqa: ARG002
        """Return the one point."""
        return Scatterers(np.array([self.position_m], np.float64), np.array([self.amplitude], np.complex128))


@dataclass(frozen=True)
class Line:
    """A wire or an edge: equal points from start to end, east-north-up (m); `amplitude` is that of all together."""

    start_m: Vector
    end_m: Vector
    count: int
    amplitude: complex = 1.0

    def points(self, generator: Generator) -> Scatterers:  # noqa: ARG002
        """Return `count` points, both ends included."""
        share = np.linspace(0.0, 1.0, self.count)[:, None]
        position = (1 - share) * np.array(self.start_m) + share * np.array(self.end_m)
        return Scatterers(position, np.full(self.count, self.amplitude / self.count, np.complex128))


@dataclass(frozen=True)
class Plate:
    """A flat parallelogram of points, spanned by two sides from a corner; `amplitude` is that of all together.

    Examples
    --------
    >>> plate = Plate((0, 0, 0), (1, 0, 0), (0, 0, 1), counts=(2, 3))
    >>> plate.points(np.random.default_rng(0)).position_m[-1]
    array([1., 0., 1.])
    """

    corner_m: Vector
    side_m: Vector
    other_side_m: Vector
    counts: tuple[int, int]
    amplitude: complex = 1.0

    def points(self, generator: Generator) -> Scatterers:  # noqa: ARG002
        """Return counts[0] × counts[1] points, all four corners included."""
        first, second = (np.linspace(0.0, 1.0, count) for count in self.counts)
        grid = np.stack(np.meshgrid(first, second, indexing="ij"), -1).reshape(-1, 2)
        position = np.array(self.corner_m) + grid @ np.array([self.side_m, self.other_side_m], np.float64)
        return Scatterers(position, np.full(len(grid), self.amplitude / len(grid), np.complex128))


@dataclass(frozen=True)
class Clutter:
    """Ground of random points: circular Gaussian amplitudes, so that resolved cells are Rayleigh distributed.

    Attributes
    ----------
    bounds_m
        east min, north min, east max, north max.
    reflectivity
        Mean power per square metre (1 is one unit point target per m²).
    density_per_m2
        Points per square metre; several per resolution cell look like ground.
    up_m
        Height above the origin.
    """

    bounds_m: tuple[float, float, float, float]
    reflectivity: float
    density_per_m2: float = 10.0
    up_m: float = 0.0

    def points(self, generator: Generator) -> Scatterers:
        """Draw the points and their amplitudes."""
        east, north, east_max, north_max = self.bounds_m
        count = round((east_max - east) * (north_max - north) * self.density_per_m2)
        plan = generator.uniform((east, north), (east_max, north_max), (count, 2))
        parts = generator.standard_normal((count, 2)) * np.sqrt(self.reflectivity / self.density_per_m2 / 2)
        position = np.column_stack([plan, np.full(count, self.up_m)])
        return Scatterers(position, parts[:, 0] + 1j * parts[:, 1])


@dataclass(frozen=True)
class Scene:
    """An origin and what stands around it."""

    origin: Origin
    targets: tuple[Target, ...]

    def scatterers(self, generator: Generator) -> Scatterers:
        """Return the points of all targets in ECEF (m).

        Examples
        --------
        >>> scene = Scene(Origin(0, 0, 0), (PointTarget((0, 0, 1)), Line((0, 0, 0), (1, 0, 0), 4)))
        >>> scene.scatterers(np.random.default_rng(0)).position_m.shape
        (5, 3)
        """
        parts = [target.points(generator) for target in self.targets]
        position = np.concatenate([np.empty((0, 3)), *(part.position_m for part in parts)])
        return Scatterers(self.origin.ecef(position), np.concatenate([[0j][:0], *(part.amplitude for part in parts)]))
