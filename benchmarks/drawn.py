"""Random geometries: range 30 m to 10 km, aperture up to the range, carrier 0.4 to 10 GHz."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.geometry.aperture import Aperture

TRACKS = ("straight", "wobbling", "circular")
JITTERS_M = (0.0, 0.0, 1e-4, 1e-3, 1e-2)
BETWEEN_DEG = (0.0, 112.0, None, 112.0)  # bistatic angle in azimuth; None: drawn from 5 to 80
GROUNDS = ("flat", "tilted", "rolling")


class Flight(NamedTuple):
    """Parameters of a random track."""

    range_m: float
    aperture_m: float
    pulses: int
    track: str
    jitter_m: float
    between_deg: float


@dataclass(frozen=True)
class Geometry:
    """Random geometry; lengths in metres."""

    seed: int
    range_m: float
    aperture_m: float
    carrier_hz: float
    bandwidth_hz: float
    spacing_m: float
    rows: int
    columns: int
    pulses: int
    track: str
    jitter_m: float
    between_deg: float
    ground: str
    pixels: NDArray[np.float64] = field(repr=False, compare=False)
    aperture: Aperture = field(repr=False, compare=False)

    @property
    def step_m(self) -> float:
        """Total path between samples of a profile, half a resolution cell."""
        return C / self.bandwidth_hz / 2


def draw(seed: int) -> Geometry:
    """Draw a random geometry; kinds of tracks, nodes and terrain alternate with the seed."""
    generator = np.random.default_rng([15, seed])

    def evenly_in_log(low: float, high: float) -> float:
        return float(np.exp(generator.uniform(np.log(low), np.log(high))))

    range_m, carrier_hz = evenly_in_log(30, 10e3), evenly_in_log(0.4e9, 10e9)
    aperture_m = range_m * generator.uniform(0.05, 1)
    bandwidth_hz = min(generator.uniform(50e6, 500e6), carrier_hz / 3)
    spacing_m = evenly_in_log(C / carrier_hz / 8, 1.0)
    rows, columns, pulses = (int(generator.integers(*ends)) for ends in ((128, 321), (128, 321), (300, 1501)))
    track, ground = TRACKS[seed % 3], GROUNDS[seed // 3 % 3]
    between_deg = BETWEEN_DEG[seed % 4]
    if between_deg is None:
        between_deg = float(generator.uniform(5, 80))
    jitter_m = float(generator.choice(JITTERS_M))
    flight = Flight(range_m, aperture_m, pulses, track, jitter_m, between_deg)
    return Geometry(
        seed, range_m, aperture_m, carrier_hz, bandwidth_hz, spacing_m, rows, columns, pulses, track, jitter_m,
        between_deg, ground, _pixels(generator, (rows, columns), spacing_m, ground), _aperture(generator, flight),
    )  # fmt: skip


def _pixels(
    generator: np.random.Generator, shape: tuple[int, int], spacing_m: float, ground: str
) -> NDArray[np.float64]:
    """Return pixels about the origin with a random orientation, (y, x, 3)."""
    y, x = np.meshgrid(*(spacing_m * (np.arange(size) - (size - 1) / 2) for size in shape), indexing="ij")
    angle, (east, north) = generator.uniform(0, 2 * np.pi), generator.uniform(-0.25, 0.25, 2)
    extent, phases = spacing_m * max(shape), generator.uniform(0, 2 * np.pi, 2)
    rolls = np.sin(2 * np.pi * x / extent + phases[0]) + np.sin(1.4 * np.pi * y / extent + phases[1])
    rolls *= extent * 10 ** generator.uniform(-3, -1.7)
    height = {"flat": 0 * x, "tilted": east * x + north * y, "rolling": rolls}[ground]
    return np.stack([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle), height], -1)


def _aperture(generator: np.random.Generator, flight: Flight) -> Aperture:
    """Return both nodes' phase centres, separated by `between_deg` in azimuth as seen from the scene."""
    middle, legs = generator.uniform(0, 2 * np.pi), []
    for side in (-0.5, 0.5) if flight.between_deg else (0,):
        azimuth = middle + side * np.radians(flight.between_deg)
        elevation, distance = np.radians(generator.uniform(10, 60)), flight.range_m * generator.uniform(0.9, 1.1)
        along = np.linspace(-0.5, 0.5, flight.pulses) * flight.aperture_m * generator.uniform(0.8, 1)
        level, height = distance * np.cos(elevation), distance * np.sin(elevation)
        if flight.track == "circular":
            angle = azimuth + along / level
            place = np.stack([level * np.cos(angle), level * np.sin(angle), np.full(flight.pulses, height)], -1)
        else:
            heading = azimuth + np.pi / 2 + generator.uniform(-0.6, 0.6)
            place = np.array([level * np.cos(azimuth), level * np.sin(azimuth), height])
            place = place + along[:, None] * [np.cos(heading), np.sin(heading), 0.05 * generator.standard_normal()]
        if flight.track == "wobbling":
            place = place + _wobble(
                generator, flight.pulses, float(np.exp(generator.uniform(np.log(0.02), np.log(0.5))))
            )
        legs.append(place + flight.jitter_m * generator.standard_normal((flight.pulses, 3)))
    return Aperture(legs[0], legs[-1])


def _wobble(generator: np.random.Generator, pulses: int, size_m: float) -> NDArray[np.float64]:
    """Draw track deviations, (pulse, 3): 1 to 16 cycles over the track, with amplitudes decreasing with frequency."""
    cycles = np.arange(1, 17)
    terms = generator.standard_normal((2, len(cycles), 3)) / cycles[:, None]
    phase_rad = 2 * np.pi * np.linspace(0, 1, pulses)[:, None] * cycles
    return np.asarray(size_m * (np.cos(phase_rad) @ terms[0] + np.sin(phase_rad) @ terms[1]))
