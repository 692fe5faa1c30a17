"""Rules for the cheapest model of geometry that a scene needs: one midpoint for two antennas, a plane for terrain."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.scene.grid import SceneGrid
from apertura.scene.terrain import FlatGround, Plane, Terrain

MIDPOINT_WAVELENGTHS = 1 / 16
TERRAIN_RAD = 0.4
TERRAIN_PIXELS = 0.5

_BLOCKS = 33


@dataclass(frozen=True)
class Decision:
    """One choice.

    Attributes
    ----------
    name, value
        What was chosen: a key of the config's `processing` where it can be overridden.
    reason
        One line with the numbers.
    error_db
        Error that this choice adds, relative to the full model; None where it adds none.
    """

    name: str
    value: str | int | float | bool
    reason: str
    error_db: float | None = None


def midpoint_error(
    tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], place_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how much longer the bistatic path is than twice the range from the midpoint, (pulse, place) metres.

    Notes
    -----
    Source: DESIGN section 5; for a baseline b across the line of sight it is b²/4R.

    Examples
    --------
    >>> tx, rx = np.array([[-1.0, 0, 0]]), np.array([[1.0, 0, 0]])
    >>> round(float(midpoint_error(tx, rx, np.array([[0.0, 100.0, 0.0]]))[0, 0]), 5)  # 2²/(4·100)
    0.01
    """
    legs = sum(np.linalg.norm(place_m - antenna[:, None], axis=-1) for antenna in (tx_m, rx_m))
    return np.asarray(legs - 2 * np.linalg.norm(place_m - (tx_m + rx_m)[:, None] / 2, axis=-1))


def midpoint_error_db(
    tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], place_m: NDArray[np.float64], *, wavelength_m: float
) -> float:
    """Return the error of imaging a pair from its midpoints, dB: RMS phase error over pulses and places.

    What is alike at all places and pulses only turns the image's phase and is not counted.
    """
    longer = midpoint_error(tx_m, rx_m, place_m)
    return float(20 * np.log10(2 * np.pi * float((longer - longer.mean()).std()) / wavelength_m + 1e-12))


def decide_midpoint(
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    place_m: NDArray[np.float64],
    *,
    wavelength_m: float,
    accuracy_db: float,
    bistatic_costs: bool,
) -> Decision:
    """Decide whether a bistatic pair may be imaged as if both antennas were at their midpoint.

    Parameters
    ----------
    tx_m, rx_m
        (pulse, 3) float64, metres.
    place_m
        (place, 3) float64, metres: a net over the scene.
    wavelength_m
        Of the band centre.
    accuracy_db
        Error asked.
    bistatic_costs
        Whether the engine takes longer for two legs than for one.
    """
    baseline = float(np.linalg.norm(tx_m - rx_m, axis=1).max())
    if baseline == 0:
        return Decision("midpoint", False, "monostatic: both phase centres are one")
    worst = float(np.abs(midpoint_error(tx_m, rx_m, place_m)).max()) / wavelength_m
    error_db = midpoint_error_db(tx_m, rx_m, place_m, wavelength_m=wavelength_m)
    allowed = worst < MIDPOINT_WAVELENGTHS
    line = f"baseline {baseline:.2f} m makes b²/4R up to {worst:.3g} λ, limit λ/16 = {MIDPOINT_WAVELENGTHS} λ"
    if allowed and error_db <= accuracy_db - 6 and bistatic_costs:
        return Decision("midpoint", True, f"{line}; error {error_db:.1f} dB, and one leg is cheaper", error_db)
    why = "the rule forbids it" if not allowed else f"it would err by {error_db:.1f} dB"
    if allowed and error_db <= accuracy_db - 6:
        why = f"it would err by {error_db:.1f} dB only, but the engine sums two legs at the cost of one"
    return Decision("midpoint", False, f"{line}; {why}")


def wobble_m(position_m: NDArray[np.float64]) -> float:
    """Return the RMS distance of a track from its straight line, metres.

    Examples
    --------
    >>> along = np.linspace(0, 30, 301)
    >>> round(wobble_m(np.stack([along, 0.1 * np.sin(4 * np.pi * along / 3), 0 * along], -1)), 3)  # 0.1/√2
    0.071
    """
    apart = position_m - position_m.mean(axis=0)
    strengths = np.linalg.svd(apart, compute_uv=False)
    return float(np.sqrt((strengths[1:] ** 2).sum() / len(apart)))


@dataclass(frozen=True)
class GroundModels:
    """The ground of a scene and its two cheaper models, with how far they are off.

    Attributes
    ----------
    full, flat, plane
        The ground, the same at one height, and the plane through it.
    relief_m, off_plane_m
        Largest difference of the ground from `flat` and from `plane`, metres.
    """

    full: Terrain
    flat: FlatGround
    plane: Plane
    relief_m: float
    off_plane_m: float

    @classmethod
    def of(cls, terrain: Terrain, flat: FlatGround, grid: SceneGrid) -> "GroundModels":
        """Return the models of a ground from its heights in the middle of blocks of pixels.

        Examples
        --------
        >>> grid = SceneGrid("local", 0.0, 8.0, 1.0, (8, 8))
        >>> models = GroundModels.of(Plane(0.0, 4.0, 7.0, east=0.0, north=0.5), FlatGround(7.0), grid)
        >>> models.relief_m, round(models.off_plane_m, 9)
        (1.75, 0.0)
        """
        blocks = grid.coarse(_BLOCKS)
        heights = terrain.heights(blocks)
        heights = np.where(np.isfinite(heights), heights, flat.height_m)  # a void between pixels is not imaged
        plane = Plane.through(blocks, heights)
        off_m = (np.abs(heights - model.heights(blocks)).max() for model in (flat, plane))
        return cls(terrain, flat, plane, *map(float, off_m))

    @classmethod
    def level(cls, height_m: float = 0.0) -> "GroundModels":
        """Return the models of flat ground, which is its own."""
        flat = FlatGround(height_m)
        return cls(flat, flat, Plane(0.0, 0.0, height_m, 0.0, 0.0), 0.0, 0.0)

    def called(self, name: str) -> Terrain:
        """Return the model that a decision names: 'plane' (level), 'tilted_plane' or 'dem'."""
        return {"plane": self.flat, "tilted_plane": self.plane, "dem": self.full}[name]


def decide_terrain(
    ground: GroundModels,
    *,
    track_m: NDArray[np.float64],
    place_m: NDArray[np.float64],
    up: NDArray[np.float64],
    wavelength_m: float,
    spacing_m: float,
) -> Decision:
    """Decide whether a plane, a tilted plane or the DEM stands for the ground.

    Parameters
    ----------
    ground
        The ground and its cheaper models.
    track_m
        (pulse, 3) float64, mean of both phase centres.
    place_m
        (place, 3) float64, points evenly spread over the scene.
    up
        (3,) float64, unit vector.
    wavelength_m, spacing_m
        Of the band centre; of the pixels.

    Notes
    -----
    Source: docs/theory/planner.md, "Terrain": a height that is wrong by δh turns the look angle by δh over the ground
    range and shifts the pixel by δh·H over it.
    """
    apart = track_m[:: max(1, len(track_m) // 64)][:, None] - place_m
    above = apart @ up
    range_m = np.sqrt(np.maximum((apart**2).sum(-1) - above**2, 1e-6))
    nearest, steepest = float(range_m.min()), float((np.abs(above) / range_m).max())
    rms = wobble_m(track_m)
    focus_m = TERRAIN_RAD * wavelength_m * nearest / (4 * np.pi * max(rms, 1e-9))
    shift_m = TERRAIN_PIXELS * spacing_m / max(steepest, 1e-9)
    limit = min(focus_m, shift_m)
    rule = (
        f"wobble {rms:.3f} m rms and ground range from {nearest:.1f} m bear {focus_m:.3g} m (0.4 rad), "
        f"half a pixel of shift {shift_m:.3g} m"
    )
    if isinstance(ground.full, FlatGround):
        return Decision("terrain", "plane", f"no DEM; height may be wrong by {limit:.3g} m: {rule}")
    if ground.relief_m < limit:
        return Decision("terrain", "plane", f"relief {ground.relief_m:.3g} m; {rule}")
    off_plane = f"relief {ground.relief_m:.3g} m, {ground.off_plane_m:.3g} m off a tilted plane; {rule}"
    return Decision("terrain", "tilted_plane" if ground.off_plane_m < limit else "dem", off_plane)
