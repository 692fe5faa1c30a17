"""Imaging geometry of a pair at the scene's middle: direction, angles, distance and band."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.core.imaging.formation import Formation
from apertura.core.scene.angles import bistatic_angle_deg, incidence_deg

_COUNTS = 0.5
"""Weight of a pulse at the middle from which it counts as illuminating it: half amplitude."""

_PULSES = 1024  # sampled for the carriers: they are means over the aperture, and it has few bends


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
        `carriers_cycles_m`: the same at three rows times three columns from corner to corner (`carrier_at`).
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
        "band_hz": float(f"{profiles.bandwidth_hz:.8g}"),
        "carrier_cycles_m": [float(f"{part:.8g}") for part in slope / profiles.wavelength_m],
        "carriers_cycles_m": [
            [[float(f"{x:.8g}") for x in place] for place in line] for line in carriers_of(formation)
        ],
    }


def carriers_of(formation: Formation) -> NDArray[np.float64]:
    """Return the carriers of points at corners, edges and middle of the scene, (3, 3, 2) as `carrier_at` takes them.

    Means over the pulses that illuminate a place, and over all where none does.
    """
    profiles, beams, shape = formation.profiles, formation.beams, formation.grid.shape
    some = profiles.aperture.sample(_PULSES)
    aperture, found = profiles.aperture[some], np.zeros((3, 3, 2))
    for row, column in np.ndindex(3, 3):
        at = row * (shape[0] - 1) / 2, column * (shape[1] - 1) / 2
        here, axes = ground_axes(formation, max(1.0, at[0]), min(at[1], shape[1] - 2.0))  # axes point up and right
        weight = np.ones(len(aperture)) if beams is None else beams[some].weight(aperture, here[None])[:, 0]
        slope = np.average(aperture.path_gradient(here), axis=0, weights=weight if weight.any() else None)
        found[row, column] = axes @ slope / profiles.wavelength_m
    return found


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
