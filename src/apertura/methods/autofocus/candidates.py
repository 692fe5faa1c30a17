"""Where points may stand: bright places of images of short parts of the aperture, which errors of tracks blur least."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.focus.engines import load_engine
from apertura.core.geometry.geodesy import ned_axes
from apertura.core.geometry.track_correction import TrackCorrection
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain
from apertura.methods.autofocus.inputs import Sighting, TrackErrors
from apertura.methods.autofocus.outcome import Refinement
from apertura.methods.autofocus.patches import CLEAR, LEAST_PATCHES, Patch, bandwidth_hz, patch_at, spread_out

Floats = NDArray[np.float64]

LEAST_RATIO = 5.0
"""Power of a place against what lies about it, summed over parts of the aperture: less is no point."""

HELPFUL_RATIO = 3.5
"""Where there are points, places that stand out less help too."""

_LEAST_TOLD = 40.0  # by all points together, as patches are counted: a few faint ones may be speckle
_SHARE_OF_CLEAREST = 0.05  # beside clear points faint places are their sidelobes
_APART = 0.6  # of half a patch, at least, lie patches apart

MOST_LOOKS = 24
"""Parts of the aperture: each as long as an error lasts, or longer."""

_SIDE_PX = 512
_ABOUT_CELLS = 12  # of range: how far a place is compared with what lies about it
_SIDELOBES = 1e-3  # of the brightest: what stands out of nothing may be its sidelobe
_MOST_PLACES = 500


@dataclass(frozen=True, eq=False)
class Candidates:
    """What a scene has to refine by.

    Attributes
    ----------
    patches
        About places that stand out and apart, clearest first; none where too few are points.
    points
        How many places are points.
    axes
        (3, 3) float64, rows are east, north, up at the scene in the frame.
    """

    patches: Sequence[Patch]
    points: int
    axes: Floats

    @classmethod
    def of(
        cls, sightings: Sequence[Sighting], grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]
    ) -> "Candidates":
        """Return those of a scene as its pairs saw it, with what is known of each node's log."""
        lasting_s = min(one.correlation_s for one in errors.values())
        places_m, ratio = bright_places(sightings, grid, terrain, lasting_s=lasting_s)
        axes, points = east_north_up(grid, places_m), int((ratio > LEAST_RATIO).sum())
        told = float(np.minimum(ratio[ratio > LEAST_RATIO], CLEAR).sum())
        if points < LEAST_PATCHES or told < _LEAST_TOLD:
            return cls([], points, axes)
        typical = patch_at(places_m[0], sightings, axes, correlation_s=lasting_s)
        apart_m = _APART * float(np.abs((typical.pixels_m - typical.place_m) @ axes[:2].T).max())
        helpful = ratio > max(HELPFUL_RATIO, _SHARE_OF_CLEAREST * float(ratio.max()))
        chosen = spread_out(places_m[helpful], ratio[helpful], axes, apart_m=apart_m)
        return cls([patch_at(place, sightings, axes, correlation_s=lasting_s) for place in chosen], points, axes)

    def refused(self, errors: Mapping[str, TrackErrors], by_speckle: Refinement | None = None) -> Refinement:
        """Return that too few points stand out, and what else was tried in vain: no node is moved."""
        line = (
            f"{self.points} places of the scene stand {10 * np.log10(LEAST_RATIO):.0f} dB out of what lies about them; "
            f"{LEAST_PATCHES} are needed, twice as many where none stands out more"
        )
        report: dict[str, Any] = {"patches": self.points}
        if by_speckle is not None:
            line, report = f"{line}; {by_speckle.why}", {**report, "speckle": dict(by_speckle.report)}
        still = TrackCorrection(np.zeros(1), {node: np.zeros((1, 3)) for node in errors})
        std_m = {node: one.along(self.axes)[None] for node, one in errors.items()}
        return Refinement(still, std_m, False, line, report, {"refinement_too_few_patches": line})


def bright_places(
    sightings: Sequence[Sighting], grid: SceneGrid, terrain: Terrain, *, lasting_s: float
) -> tuple[Floats, Floats]:
    """Return places that stand out of what lies about them in the images of all pairs, and by how much.

    Parameters
    ----------
    sightings
        What every pair saw.
    grid, terrain
        The scene.
    lasting_s
        How long an error of the tracks lasts.

    Returns
    -------
    places_m : ndarray
        (place, 3) float64, metres in the frame, those that stand out most first.
    ratio : ndarray
        (place,) float64, power there against what lies about it, summed over parts of the aperture.

    Notes
    -----
    Source: docs/theory/autofocus.md, "Patches". Power is summed over images of parts of the aperture, on every
    so many-th pixel of the grid; a part as long as an error lasts is focused whatever the error.
    """
    from scipy.ndimage import maximum_filter, median_filter  # slow to import

    cell_m = min(SPEED_OF_LIGHT_M_S / bandwidth_hz(one.profiles) for one in sightings) / 2
    step = max(1, int(cell_m / 2 / grid.spacing_m))
    rows, columns = (np.arange(step // 2, size, step) for size in grid.shape)
    power = np.zeros((len(rows), len(columns)))
    for one in sightings:
        image = np.zeros_like(power)
        for part in _parts(len(rows), len(columns)):
            row, column = np.meshgrid(rows[part[0]], columns[part[1]], indexing="ij")
            places = terrain.positions_at(grid, row, column)
            image[part] = sum(np.abs(look).astype(np.float64) ** 2 for look in _looks(one, places, lasting_s))
        power += image / max(float(np.nanmean(image)), 1e-300)
    power = np.nan_to_num(power)
    reach = max(3, round(_ABOUT_CELLS * cell_m / (step * grid.spacing_m)))
    thin = max(1, reach // 3)
    about = median_filter(power[::thin, ::thin], size=7, mode="nearest")
    about = np.repeat(np.repeat(about, thin, 0), thin, 1)[: power.shape[0], : power.shape[1]]
    ratio = power / np.maximum(about, _SIDELOBES * power.max())
    top = (maximum_filter(power, 2 * max(1, reach // 6) + 1) == power) & (power > 0)
    down, right = np.nonzero(top)
    order = np.argsort(-ratio[down, right], kind="stable")[:_MOST_PLACES]
    down, right = down[order], right[order]
    return terrain.positions_at(grid, rows[down], columns[right]), ratio[down, right]


def east_north_up(grid: SceneGrid, places_m: Floats) -> Floats:
    """Return (3, 3) float64, rows are the unit vectors east, north, up at the scene, in the frame."""
    if grid.frame == "local" or not len(places_m):
        return np.eye(3)
    north, east, down = ned_axes(places_m.mean(axis=0)[None])[0].T
    return np.stack([east, north, -down])


def _parts(rows: int, columns: int) -> Iterator[tuple[slice, slice]]:
    for row in range(0, rows, _SIDE_PX):
        for column in range(0, columns, _SIDE_PX):
            yield slice(row, row + _SIDE_PX), slice(column, column + _SIDE_PX)


def _looks(one: Sighting, places: Floats, lasting_s: float) -> Iterator[NDArray[np.complex64]]:
    """Yield the image of each part of the aperture."""
    engine = load_engine("native")
    if not engine.available():
        engine = load_engine("numba")
    spans_s = float(one.time_s[-1] - one.time_s[0])
    count = int(np.clip(spans_s / max(lasting_s, 1e-9), 1, MOST_LOOKS))
    for pulses in one.profiles.aperture.blocks(count):
        beams = None if one.beams is None else one.beams[pulses]
        yield engine.form(engine.prepare(one.profiles[pulses]), places, beams=beams)
