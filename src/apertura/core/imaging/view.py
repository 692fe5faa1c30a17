"""Imaging geometry of a pair at the scene centre: direction, angles, distance and band."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.inputs import Profiles
from apertura.core.geometry.geodesy import ned_axes
from apertura.core.scene.angles import bistatic_angle_deg, incidence_deg
from apertura.core.scene.grid import SceneGrid

_COUNTS = 0.5
"""Minimum weight of a pulse that is considered to illuminate the scene centre: half amplitude."""

_ONE_SIDE = 0.95
"""Fraction of pulses with the scene on one side of the track, above which the image is assigned to this side."""

_OBSERVABLE_RAD = 1.0
"""RMS phase of a mirrored scene, radians, above which the mirrored scene is defocused: peak loss 4 dB."""

_PULSES = 1024  # pulses sampled for the carriers, which are means over a smooth track


class ViewedScene(Protocol):
    """Grid and terrain of a scene, with the profiles and the weights of the pulses; such as a `Formation`."""

    @property
    def profiles(self) -> Profiles: ...  # noqa: D102
    @property
    def beams(self) -> Beams | None: ...  # noqa: D102
    @property
    def grid(self) -> SceneGrid: ...  # noqa: D102
    def positions_at(self, row: ArrayLike, column: ArrayLike) -> NDArray[np.float64]: ...  # noqa: D102


def view_report(scene: ViewedScene, began: np.datetime64, time_s: NDArray[np.float64]) -> dict[str, Any]:
    """Report the imaging geometry at the scene centre for image.json; angles and distance at closest approach.

    Parameters
    ----------
    scene
        The scene, for example the formation of the image.
    began, time_s
        Time of the first pulse, UTC; and (pulse,) float64, times of the pulses in seconds since the first pulse.

    Returns
    -------
    dict
        `first_utc`, `last_utc`: times of the first and last pulse that illuminate the scene centre, or of the first and
        last pulse of the flight if none does. `heading_deg`, `look_deg`: heading and look direction of the midpoint
        between the antennas, clockwise from grid north. `look_vector_ecef`: unit vector of the look direction in ECEF;
        None in a local frame. `incidence_deg`: incidence angle of the transmitter, from the
        vertical. `bistatic_angle_deg`. `range_m`: half the total path. `height_m`: height of the midpoint above the
        terrain. `speed_m_s`: mean speed of the midpoint. `side`: side of the heading on which the scene lies: right,
        left, or both if the track encircles the scene. `side_mirror_rad`: RMS phase between the echoes of the scene and
        of the mirrored scene. `side_observable`: true if this phase exceeds 1 rad, so that a mirrored image is
        defocused. `centre_hz`, `band_hz`: centre frequency and bandwidth. `carrier_cycles_m`: centre of the spatial
        frequency band of the image at the scene centre, east and north (docs/theory/interferometry.md, eq. 1).
        `carriers_cycles_m`: the same centre at 3 x 3 points from corner to corner (`carrier_at`).
    """
    # The scene centre, and the pulses that illuminate it.
    point, (east, north) = ground_axes(scene, *((size - 1) / 2 for size in scene.grid.shape))
    profiles, beams = scene.profiles, scene.beams
    weight = np.ones(len(profiles)) if beams is None else beams.weight(profiles.aperture, point[None])[:, 0]
    counted = np.flatnonzero(weight >= _COUNTS)
    counted = counted if counted.size else np.arange(len(profiles))
    # Closest approach: shortest total path. The carrier is the mean path gradient divided by the wavelength.
    aperture, up = profiles.aperture[counted], _vertical(scene.grid, point)
    path, middle = aperture.path(point), aperture.middle_m
    closest = int(path.argmin())
    tx, rx = (leg[closest] for leg in aperture.legs)
    slope = np.stack([east, north]) @ aperture.path_gradient(point).mean(axis=0)
    times = began + (1e9 * time_s[counted[[0, -1]]]).round().astype("timedelta64[ns]")
    flight_m, look_m = middle[-1] - middle[0], point - middle[closest]
    incidence = float(incidence_deg(point, up, tx))
    # Directions are measured in the horizontal plane; on slopes, the axes along the terrain are inclined.
    level = np.stack([axis - (axis @ up) * up for axis in (east, north)])
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    mirror_rad = _mirror_rad(middle, up, incidence, profiles.wavelength_m)
    return {
        "first_utc": str(times[0]),
        "last_utc": str(times[1]),
        "heading_deg": _bearing_deg(*level @ flight_m),
        "look_deg": _bearing_deg(*level @ look_m),
        "look_vector_ecef": _unit(look_m) if scene.grid.frame == "ecef" else None,
        "speed_m_s": _speed_m_s(middle, time_s[counted]),
        "side": _side(middle, point, up),
        "side_mirror_rad": float(f"{mirror_rad:.4g}"),
        "side_observable": bool(mirror_rad > _OBSERVABLE_RAD),
        "incidence_deg": round(incidence, 4),
        "bistatic_angle_deg": round(float(bistatic_angle_deg(point, tx, rx)), 4),
        "range_m": round(float(path[closest]) / 2, 4),
        "height_m": round(float(-look_m @ up), 4),
        "centre_hz": float(profiles.centre_frequency_hz),
        "band_hz": float(f"{profiles.bandwidth_hz:.8g}"),
        "carrier_cycles_m": [float(f"{part:.8g}") for part in slope / profiles.wavelength_m],
        "carriers_cycles_m": [[[float(f"{x:.8g}") for x in carrier] for carrier in row] for row in carriers_of(scene)],
    }


def carriers_of(scene: ViewedScene) -> NDArray[np.float64]:
    """Return the carriers at the corners, edges and centre of the scene, (3, 3, 2) as required by `carrier_at`.

    Each carrier is a mean over the pulses that illuminate the point, or over all pulses if none does.
    """
    profiles, beams, shape = scene.profiles, scene.beams, scene.grid.shape
    sampled = profiles.aperture.sample(_PULSES)
    aperture, carriers = profiles.aperture[sampled], np.zeros((3, 3, 2))
    for row, column in np.ndindex(3, 3):
        at = row * (shape[0] - 1) / 2, column * (shape[1] - 1) / 2
        # `ground_axes` evaluates the pixels above and to the right, which must lie inside the grid.
        point, axes = ground_axes(scene, max(1.0, at[0]), min(at[1], shape[1] - 2.0))
        weight = np.ones(len(aperture)) if beams is None else beams[sampled].weight(aperture, point[None])[:, 0]
        slope = np.average(aperture.path_gradient(point), axis=0, weights=weight if weight.any() else None)
        carriers[row, column] = axes @ slope / profiles.wavelength_m
    return carriers


def ground_axes(scene: ViewedScene, row: float, column: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a point on the terrain, (3,) metres, and unit vectors along grid east and north at this point, (2, 3)."""
    point, east, north = scene.positions_at([row, row, row - 0.5], [column, column + 0.5, column])
    axes = np.stack([east - point, north - point])
    return point, axes / np.linalg.norm(axes, axis=1, keepdims=True)


def _vertical(grid: SceneGrid, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the upward unit vector at a point, in the frame of the grid."""
    return -ned_axes(point)[..., 2] if grid.frame == "ecef" else np.array([0.0, 0.0, 1.0])


def _unit(vector: NDArray[np.float64]) -> list[float]:
    return [round(float(part), 9) for part in vector / np.linalg.norm(vector)]


def _speed_m_s(middle_m: NDArray[np.float64], time_s: NDArray[np.float64]) -> float | None:
    duration_s = float(time_s[-1] - time_s[0])
    length_m = float(np.linalg.norm(np.diff(middle_m, axis=0), axis=1).sum())
    return round(length_m / duration_s, 3) if duration_s > 0 else None


def _side(middle_m: NDArray[np.float64], point_m: NDArray[np.float64], up: NDArray[np.float64]) -> str:
    """Return the side of the heading on which a point lies: left or right for nearly all pulses, otherwise both."""
    if len(middle_m) < 2:
        return "both"
    across = np.cross(np.gradient(middle_m, axis=0), point_m - middle_m) @ up  # positive to the left
    left = float((across > 0).mean())
    return "left" if left > _ONE_SIDE else "right" if left < 1 - _ONE_SIDE else "both"


def _mirror_rad(middle_m: NDArray[np.float64], up: NDArray[np.float64], incidence: float, wavelength_m: float) -> float:
    """Return the RMS phase between the echoes of a point and of its mirror image on the other side of the track.

    A horizontal deviation w of the track from a straight line decreases one total path by 2w sin θ and increases the
    other by the same amount: the phases differ by 4π/λ·2w sin θ.
    """
    flat = middle_m - middle_m.mean(axis=0)
    flat = flat - np.outer(flat @ up, up)
    widths = np.linalg.svd(flat, compute_uv=False)
    departure_m = float(widths[1]) / np.sqrt(len(flat)) if len(widths) > 1 else 0.0
    return 8 * np.pi / wavelength_m * departure_m * float(np.sin(np.radians(incidence)))


def _bearing_deg(east: float, north: float) -> float | None:
    """Return an angle clockwise from north, 0 to 360; None for a vector shorter than 1 µm."""
    if np.hypot(east, north) < 1e-6:  # metres
        return None
    return round(float(np.degrees(np.arctan2(east, north))) % 360, 4)
