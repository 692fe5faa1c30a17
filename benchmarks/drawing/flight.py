"""Random geometry of a campaign: tracks and scene."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.simulation import Straight, Waypoints, Wobble
from apertura.simulation.targets import Track, Vector
from drawing.dice import CHANCE_OF_A_FLAW, Dice

KINDS = ("straight", "circular", "squinted", "climbing")
MOST_SUBCARRIERS = 2048
LARGEST_IMAGE_PX = 320


@dataclass(frozen=True)
class Geometry:
    """Geometry of a campaign: angles in radians, lengths in metres, speed in m/s."""

    kind: str
    range_m: float
    up_m: float
    aperture_rad: float
    heading_rad: float
    speed_m_s: float
    step_m: float
    pulses: int
    half_width_m: float
    cell_m: float

    @property
    def ground_range_m(self) -> float:
        """Horizontal distance of the track midpoint from the scene centre."""
        return float(np.sqrt(self.range_m**2 - self.up_m**2))

    @property
    def prf_hz(self) -> float:
        """Pulses per second."""
        return self.speed_m_s / self.step_m


def draw_geometry(dice: Dice, highest_hz: float, bandwidth_hz: float, true: dict[str, str]) -> Geometry:
    """Draw a track that samples its scene without ambiguity or, as an intentional flaw, undersamples the scene."""
    kind, pulses = dice.one_of(*KINDS), int(dice.between(80, 200))
    farthest_m = (MOST_SUBCARRIERS * C / bandwidth_hz - 8.0) / 4.0
    range_m = dice.between(max(8.0, 10 * C / bandwidth_hz), min(300.0, farthest_m))
    up_m = range_m * dice.uniform(0.25, 0.7)
    wavelength_m, down_cell_m = C / highest_hz, C / (2 * bandwidth_hz) / np.sqrt(1 - (up_m / range_m) ** 2)
    # Ten range cells must fit into two fifths of the unambiguous cross-range extent.
    widest = pulses * wavelength_m / (48 * down_cell_m)
    aperture_rad = min(dice.between(max(0.04, 10 * wavelength_m / range_m), 0.8), widest)
    cross_cell_m = wavelength_m / (2 * aperture_rad)
    cell_m = min(cross_cell_m, down_cell_m)
    half_m = min(0.2 * pulses * cross_cell_m, 0.25 * range_m, LARGEST_IMAGE_PX / 6 * cell_m)
    if dice.chance(CHANCE_OF_A_FLAW):
        pulses //= 5
        true["azimuth_undersampled"] = "a fifth of the pulses required by the scene"
    step_m = aperture_rad * range_m / (pulses - 1)
    heading = dice.uniform(0, 2 * np.pi)
    return Geometry(
        kind,
        range_m,
        up_m,
        aperture_rad,
        heading,
        dice.between(0.2, 1) * min(15.0, 0.1 * range_m),
        step_m,
        pulses,
        half_m,
        cell_m,
    )


def track(geometry: Geometry, behind_rad: float, farther: float) -> Track:
    """Return a track about the origin, rotated relative to the transmitter's track and at a different range."""
    ground, up = geometry.ground_range_m * farther, geometry.up_m * farther
    duration_s = (geometry.pulses - 1) / geometry.prf_hz
    middle = geometry.heading_rad + behind_rad + (np.radians(30) if geometry.kind == "squinted" else 0.0)
    away, course = _direction(middle), _direction(geometry.heading_rad + behind_rad + np.pi / 2)
    wobble = Wobble(smoothing_s=2.0)
    if geometry.kind == "circular":
        time_s = np.linspace(-6.0, duration_s + 6.0, 41)
        angles = middle + geometry.speed_m_s / ground * (time_s - duration_s / 2)
        places = [(ground * np.cos(angle), ground * np.sin(angle), up) for angle in angles]
        return Waypoints(tuple(time_s.tolist()), _vectors(places), wobble=wobble)
    climb = 0.3 if geometry.kind == "climbing" else 0.0
    velocity = geometry.speed_m_s * (course + [0, 0, climb]) / np.hypot(1, climb)
    start = ground * away + [0, 0, up] - velocity * duration_s / 2
    start_m, velocity_m_s = _vectors([start, velocity])
    return Straight(start_m, velocity_m_s, wobble)


def _direction(angle_rad: float) -> np.ndarray:
    return np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])


def _vectors(places: list[Any]) -> tuple[Vector, ...]:
    return tuple((float(east), float(north), float(up)) for east, north, up in places)
