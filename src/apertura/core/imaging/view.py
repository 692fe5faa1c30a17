"""Imaging geometry of a pair at the scene's middle: direction, angles, distance and band."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.core.imaging.formation import Formation
from apertura.core.scene.angles import bistatic_angle_deg, incidence_deg

_COUNTS = 0.5
"""Weight of a pulse at the middle from which it counts as illuminating it: half amplitude."""

_ONE_SIDE = 0.95
"""Share of the pulses that see the scene on one side, above which an image has that side."""

_OBSERVABLE_RAD = 1.0
"""Phase rms of a mirrored scene, above which it is out of focus: its peaks lose 4 dB."""

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
        `first_utc`, `last_utc`: the pulses that illuminate the middle, all of them where none does.
        `heading_deg`, `look_deg`: directions of flight and of view of the antennas' midpoint, clockwise from
        grid north. `incidence_deg`: of the transmitter, from the vertical. `bistatic_angle_deg`. `range_m`:
        half the total path. `height_m`: of the midpoint above the ground. `speed_m_s`: of the midpoint, mean.
        `side`: of the direction of flight on which the scene lies, right, left, or both where a track turns
        around it; `side_mirror_rad`: rms phase by which the echo of the mirrored scene differs, and
        `side_observable`: whether it exceeds 1 rad, so that a mirrored image is not in focus. `centre_hz`,
        `band_hz`. `carrier_cycles_m`: the spatial frequency that the image's band lies about, east and north
        (docs/theory/interferometry.md, eq. 1). `carriers_cycles_m`: the same at three rows times three columns
        from corner to corner (`carrier_at`).
    """
    # The scene's middle, and the pulses that illuminate it.
    here, (east, north) = ground_axes(formation, *((size - 1) / 2 for size in formation.grid.shape))
    profiles, beams = formation.profiles, formation.beams
    weight = np.ones(len(profiles)) if beams is None else beams.weight(profiles.aperture, here[None])[:, 0]
    counted = np.flatnonzero(weight >= _COUNTS)
    counted = counted if counted.size else np.arange(len(profiles))
    # Closest approach: the least total path; the carrier is the mean gradient of the path over the wavelength.
    aperture, up = profiles.aperture[counted], np.cross(east, north)
    path, middle = aperture.path(here), aperture.middle_m
    closest = int(path.argmin())
    tx, rx = (leg[closest] for leg in aperture.legs)
    slope = np.stack([east, north]) @ aperture.path_gradient(here).mean(axis=0)
    times = began + (1e9 * time_s[counted[[0, -1]]]).round().astype("timedelta64[ns]")
    flown, looked = middle[-1] - middle[0], here - middle[closest]
    incidence = float(incidence_deg(here, up, tx))
    mirror_rad = _mirror_rad(middle, up, incidence, profiles.wavelength_m)
    return {
        "first_utc": str(times[0]),
        "last_utc": str(times[1]),
        "heading_deg": _bearing_deg(flown @ east, flown @ north),
        "look_deg": _bearing_deg(looked @ east, looked @ north),
        "speed_m_s": _speed_m_s(middle, time_s[counted]),
        "side": _side(middle, here, up),
        "side_mirror_rad": float(f"{mirror_rad:.4g}"),
        "side_observable": bool(mirror_rad > _OBSERVABLE_RAD),
        "incidence_deg": round(incidence, 4),
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


def _speed_m_s(middle_m: NDArray[np.float64], time_s: NDArray[np.float64]) -> float | None:
    lasting_s = float(time_s[-1] - time_s[0])
    length_m = float(np.linalg.norm(np.diff(middle_m, axis=0), axis=1).sum())
    return round(length_m / lasting_s, 3) if lasting_s > 0 else None


def _side(middle_m: NDArray[np.float64], here_m: NDArray[np.float64], up: NDArray[np.float64]) -> str:
    """Return on which side of the direction of flight a place lies: of nearly all pulses, else both."""
    if len(middle_m) < 2:
        return "both"
    across = np.cross(np.gradient(middle_m, axis=0), here_m - middle_m) @ up  # positive to the left
    left = float((across > 0).mean())
    return "left" if left > _ONE_SIDE else "right" if left < 1 - _ONE_SIDE else "both"


def _mirror_rad(middle_m: NDArray[np.float64], up: NDArray[np.float64], incidence: float, wavelength_m: float) -> float:
    """Return the rms phase between the echoes of a place and of its mirror image beyond the track.

    Horizontal departures w of the track from its straight line shorten one path by 2w sin θ and lengthen the other:
    4π/λ·2w sin θ between both.
    """
    flat = middle_m - middle_m.mean(axis=0)
    flat = flat - np.outer(flat @ up, up)
    widths = np.linalg.svd(flat, compute_uv=False)
    departure_m = float(widths[1]) / np.sqrt(len(flat)) if len(widths) > 1 else 0.0
    return 8 * np.pi / wavelength_m * departure_m * float(np.sin(np.radians(incidence)))


def _bearing_deg(east: float, north: float) -> float | None:
    """Return an angle clockwise from north, 0 to 360; None where there is no direction."""
    if np.hypot(east, north) < 1e-6:  # metres
        return None
    return round(float(np.degrees(np.arctan2(east, north))) % 360, 4)
