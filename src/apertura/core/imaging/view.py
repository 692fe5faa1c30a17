"""Imaging geometry of a pair at the scene's middle: direction, angles, distance and band."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.imaging.formation import Formation
from apertura.core.scene.visibility import bistatic_angle_deg, incidence_deg

_COUNTS = 0.5
"""Weight of a pulse at the middle from which it counts as illuminating it: half amplitude."""


def view_report(formation: Formation, began: np.datetime64, time_s: NDArray[np.float64]) -> dict[str, Any]:
    """Return the imaging geometry for image.json, of the scene's middle; angles and distance at closest approach.

    Parameters
    ----------
    formation
        Formation of the image.
    began, time_s
        The first pulse, UTC; and (pulse,) float64, seconds from it.

    Returns
    -------
    dict
        `first_utc`, `last_utc`: the pulses that illuminate the middle, all of them where none does. `heading_deg`,
        `look_deg`: directions of flight and of view of the antennas' midpoint, clockwise from grid north.
        `incidence_deg`: of the transmitter, from the vertical. `bistatic_angle_deg`. `range_m`: half the total path.
        `height_m`: of the midpoint above the ground. `centre_hz`, `band_hz`. `carrier_cycles_m`: the spatial frequency
        that the image's band lies about, east and north (docs/theory/interferometry.md, eq. 1).
    """
    here, (east, north) = ground_axes(formation, *((size - 1) / 2 for size in formation.grid.shape))
    profiles, beams = formation.profiles, formation.beams
    weight = np.ones(len(profiles)) if beams is None else beams.weight(profiles.aperture, here[None])[:, 0]
    counted = np.flatnonzero(weight >= _COUNTS)
    counted = counted if counted.size else np.arange(len(profiles))
    aperture, up = profiles.aperture[counted], np.cross(east, north)
    path, middle = aperture.path(here), aperture.middle_m
    closest = int(path.argmin())
    tx, rx = (leg[closest] for leg in aperture.legs)
    slope = np.stack([east, north]) @ aperture.path_gradient(here).mean(axis=0)
    times = began + (1e9 * time_s[counted[[0, -1]]]).round().astype("timedelta64[ns]")
    flown, looked = middle[-1] - middle[0], here - middle[closest]
    return {
        "first_utc": str(times[0]),
        "last_utc": str(times[1]),
        "heading_deg": _bearing_deg(flown @ east, flown @ north),
        "look_deg": _bearing_deg(looked @ east, looked @ north),
        "incidence_deg": round(float(incidence_deg(here, up, tx)), 4),
        "bistatic_angle_deg": round(float(bistatic_angle_deg(here, tx, rx)), 4),
        "range_m": round(float(path[closest]) / 2, 4),
        "height_m": round(float(-looked @ up), 4),
        "centre_hz": float(profiles.centre_frequency_hz),
        "band_hz": float(f"{SPEED_OF_LIGHT_M_S / (profiles.step_m * profiles.oversampling):.8g}"),
        "carrier_cycles_m": [
            float(f"{part:.8g}") for part in slope * profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S
        ],
    }


def ground_axes(formation: Formation, row: float, column: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a place on the ground, (3,) metres, and unit vectors east and north from it along the grid, (2, 3)."""
    here, east, north = formation.positions_at([row, row, row - 0.5], [column, column + 0.5, column])
    axes = np.stack([east - here, north - here])
    return here, axes / np.linalg.norm(axes, axis=1, keepdims=True)


def _bearing_deg(east: float, north: float) -> float | None:
    """Return an angle clockwise from north, 0 to 360; None where there is no direction."""
    if np.hypot(east, north) < 1e-6:  # metres
        return None
    return round(float(np.degrees(np.arctan2(east, north))) % 360, 4)
