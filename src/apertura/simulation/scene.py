"""What the radar looks at: points, lines, plates and clutter at places east, north and up of an origin."""

from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from apertura.common.arrays import Floats
from apertura.core.geometry.geodesy import ecef_from_geodetic, ned_axes
from apertura.simulation.impairments import STRICT_KEYS

Vector = tuple[float, float, float]

_NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, config=STRICT_KEYS)
class Origin:
    """The place on Earth from which a simulation counts east, north and up (a plane, not the curved ground).

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
    height_m: float = Field(description="above the ellipsoid, m")

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


@plain_dataclass(frozen=True)
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


@dataclass(frozen=True, config=STRICT_KEYS)
class PointTarget:
    """A point."""

    position_m: Vector = Field(description="east, north, up, m")
    amplitude: complex = Field(default=1.0, description="echo amplitude at 1 m × 1 m")
    kind: Literal["point"] = Field(default="point", kw_only=True, repr=False)

    def points(self, generator: Generator) -> Scatterers:  # noqa: ARG002
        """Return the one point, east-north-up (m)."""
        return Scatterers(np.array([self.position_m], np.float64), np.array([self.amplitude], np.complex128))


@dataclass(frozen=True, config=STRICT_KEYS)
class Line:
    """A wire or an edge: equal points from start to end, both included."""

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
    """A flat parallelogram (a facet) of points, all four corners included.

    Examples
    --------
    >>> plate = Plate((0, 0, 0), (1, 0, 0), (0, 0, 1), counts=(2, 3))
    >>> plate.points(np.random.default_rng(0)).position_m[-1]
    array([1., 0., 1.])
    """

    corner_m: Vector = Field(description="east, north, up, m")
    side_m: Vector = Field(description="from the corner along one side, m")
    other_side_m: Vector = Field(description="from the corner along the other side, m")
    counts: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] = Field(description="points along each")
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
    """Ground of random points: circular Gaussian amplitudes, so that resolved cells are Rayleigh distributed."""

    bounds_m: tuple[float, float, float, float] = Field(description="east min, north min, east max, north max, m")
    reflectivity: float = Field(ge=0, description="mean power per square metre; 1: one unit point target per m²")
    density_per_m2: float = Field(default=10.0, gt=0, description="points per m²; several per cell look like ground")
    up_m: float = Field(default=0.0, description="height above the origin, m")
    slope: tuple[float, float] = Field(
        default=(0.0, 0.0), description="rise per metre east and north of the origin: a ramp"
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


def scatterers(origin: Origin, targets: tuple[Target, ...], generator: Generator) -> Scatterers:
    """Return the points of all targets in ECEF (m); the generator draws clutter.

    Examples
    --------
    >>> targets = (PointTarget((0, 0, 1)), Line((0, 0, 0), (1, 0, 0), 4))
    >>> scatterers(Origin(0, 0, 0), targets, np.random.default_rng(0)).position_m.shape
    (5, 3)
    """
    parts = [target.points(generator) for target in targets]
    position = np.concatenate([np.empty((0, 3)), *(part.position_m for part in parts)])
    return Scatterers(origin.ecef(position), np.concatenate([[0j][:0], *(part.amplitude for part in parts)]))
