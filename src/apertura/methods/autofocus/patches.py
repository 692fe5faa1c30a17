"""Patches of the scene about bright places: which places may be points, and the pixels about each."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.focus.engines import load_engine
from apertura.core.focus.inputs import Profiles
from apertura.core.geometry.geodesy import ned_axes
from apertura.core.geometry.phase_centres import TrackCorrection
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain
from apertura.methods.autofocus.inputs import PairRecord, Refinement, TrackErrors

# ---- Patches about bright places and their pixels -------------------------------------------------------------------


MOST_PATCHES, CLEAR = 32, 20.0
"""Most patches; and peak to surroundings, power: patches are taken until their sum is that of a dozen such points."""

LEAST_PATCHES = 4
"""With fewer, none would be left for validation."""

MOST_VALUES = 2**27
"""Complex values, a gigabyte, of what blocks add to patches: with more, fewer patches are used."""

_ENOUGH = 12 * CLEAR  # sum of the ratios at which no more patches are taken
_SAMPLING = 0.7  # of Nyquist of the image: at 0.5 no better, at 0.85 places are less accurate
_RANGE_CELLS = 1.5  # half of a patch along the line of sight
_LEAST_CELLS, _MOST_CELLS = 6.0, 24.0  # half of a patch across it
_BANDWIDTH = 0.66  # of an error that lasts τ, in 1/τ: its sidelobes should stay in the patch
_MOST_PIXELS = 1000  # of a patch
_PULSES = 256  # sampled for the directions and cells of a patch
_SHARE = 0.4  # of all patches, at most, in one ninth of the scene


@dataclass(frozen=True, eq=False)
class Patch:
    """A bright place.

    Attributes
    ----------
    place_m
        (3,) float64, metres in the frame.
    pixels_m
        (pixel, 3) float64, metres, level about the place.
    """

    place_m: Floats
    pixels_m: Floats


def separated(places_m: Floats, ratio: Floats, axes: Floats, *, apart_m: float) -> Floats:
    """Return as many places as are needed, clearest first, apart from each other and spread over the scene.

    Parameters
    ----------
    places_m
        (place, 3) float64, metres in the frame, clearest first.
    ratio
        (place,) float64, power of each against what lies about it.
    axes
        (3, 3) float64, rows are east, north, up.
    apart_m
        Least distance between two.

    Returns
    -------
    ndarray
        (patch, 3) float64.

    Examples
    --------
    >>> places = np.array([[0.0, 0, 0], [0.1, 0, 0], [5, 0, 0], [0, 5, 0]])
    >>> len(separated(places, np.full(4, 10.0), np.eye(3), apart_m=1.0))
    3
    """
    level = (places_m - places_m.mean(axis=0)) @ axes[:2].T
    low, extent = level.min(axis=0), np.maximum(np.ptp(level, axis=0), 1e-9)
    ninth = np.minimum((level - low) / extent * 3, 2.999).astype(int) @ np.array([3, 1])
    taken: list[int] = []
    for number in range(len(places_m)):
        information = float(np.minimum(ratio[taken], CLEAR).sum())
        if len(taken) == MOST_PATCHES or information >= _ENOUGH:
            break
        most = max(2, int(np.ceil(_SHARE * min(MOST_PATCHES, _ENOUGH / min(CLEAR, ratio[number])))))
        near = any(np.linalg.norm(level[number] - level[other]) < apart_m for other in taken)
        if not near and sum(ninth[other] == ninth[number] for other in taken) < most:
            taken.append(number)
    return places_m[taken]


def patch_at(place_m: Floats, records: Sequence[PairRecord], axes: Floats, *, correlation_s: float) -> Patch:
    """Return the pixels about a place: as fine as the sharpest pair needs, as wide as errors spread its energy.

    Parameters
    ----------
    place_m
        (3,) float64, metres in the frame.
    records
        Of all pairs.
    axes
        (3, 3) float64, rows are east, north, up.
    correlation_s
        How long an error of the tracks lasts.

    Notes
    -----
    Source: docs/theory/autofocus.md, "Patches".
    """
    spans = [_spans(place_m, record, axes, correlation_s) for record in records]
    across = max(spans, key=lambda one: one[1][1])[0]
    cell = np.min([one[1] for one in spans], axis=0)
    half = np.max([one[2] for one in spans], axis=0)
    counts = 2 * np.ceil(half / _SAMPLING) + 1
    shrink = min(1.0, np.sqrt(_MOST_PIXELS / counts.prod()))
    sides = [
        np.arange(-(n := int(shrink * reach / _SAMPLING)), n + 1) * _SAMPLING * size
        for reach, size in zip(half, cell, strict=True)
    ]
    along, aside = np.meshgrid(*sides, indexing="ij")
    level = along[..., None] * across[0] + aside[..., None] * across[1]
    return Patch(place_m, place_m + level.reshape(-1, 2) @ axes[:2])


def count_in_memory(values: Sequence[int]) -> int:
    """Return how many patches fit in memory, given the number of complex values of each.

    Examples
    --------
    >>> count_in_memory([2**24] * 32)
    8
    """
    return max(int((np.cumsum(values) <= MOST_VALUES).sum()), min(LEAST_PATCHES, len(values)))


def bandwidth_hz(profiles: Profiles) -> float:
    """Return the bandwidth of some profiles."""
    return SPEED_OF_LIGHT_M_S / (profiles.step_m * profiles.oversampling)


def _spans(place_m: Floats, record: PairRecord, axes: Floats, correlation_s: float) -> tuple[Floats, Floats, Floats]:
    """Return the directions along and across the line of sight, the cells along both, half a patch in cells."""
    profiles = record.profiles
    some = profiles.aperture.sample(_PULSES)
    slope, time_s = profiles.aperture[some].path_gradient(place_m) @ axes[:2].T, record.time_s[some]
    if record.beams is not None:
        illuminated = record.beams[some].weight(profiles.aperture[some], place_m[None])[:, 0] > 0
        slope, time_s = (slope[illuminated], time_s[illuminated]) if illuminated.sum() > 2 else (slope, time_s)
    ahead = slope.mean(axis=0)
    ahead = ahead / np.linalg.norm(ahead) if np.linalg.norm(ahead) > 1e-3 else np.array([0.0, 1.0])
    turned = np.stack([ahead, [-ahead[1], ahead[0]]])
    by_time = slope @ turned.T
    band = profiles.centre_frequency_hz + np.array([-0.5, 0.5]) * bandwidth_hz(profiles)
    cycles = np.concatenate([by_time * frequency / SPEED_OF_LIGHT_M_S for frequency in band])
    cell = 1 / np.maximum(np.ptp(cycles, axis=0), 1e-9)
    spread = np.clip(_BANDWIDTH * float(np.ptp(time_s)) / correlation_s, _LEAST_CELLS, _MOST_CELLS)
    turning = np.ptp(by_time, axis=0)
    half = np.array([max(_RANGE_CELLS, spread * min(1.0, turning[0] / max(turning[1], 1e-9)) ** 2), spread])
    return turned, cell, half


# ---- Bright places in images of short parts of the aperture ---------------------------------------------------------

LEAST_RATIO = 5.0
"""Peak power over its surroundings, summed over parts of the aperture: less is no point."""

HELPFUL_RATIO = 3.5
"""The same of weaker places that are used as well where there are points."""

_LEAST_RATIO_SUM = 40.0  # sum over all points, each up to CLEAR: a few faint ones may be speckle
_SHARE_OF_CLEAREST = 0.05  # beside clear points faint places are their sidelobes
_APART = 0.6  # least distance of patches, in halves of a patch

MOST_LOOKS = 24
"""Parts of the aperture: each as long as an error lasts, or longer."""

_SIDE_PX = 512  # of parts of the image formed at once
_ABOUT_CELLS = 12  # of range: radius of the surroundings
_SIDELOBES = 1e-3  # of the brightest: fainter places may be its sidelobes
_MOST_PLACES = 500  # of candidates kept


@dataclass(frozen=True, eq=False)
class Candidates:
    """Places of a scene by which tracks can be refined.

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
        cls, records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]
    ) -> "Candidates":
        """Return those of a scene, from all pairs and the error statistics of each node's log."""
        correlation_s = min(one.correlation_s for one in errors.values())
        places_m, ratio = bright_places(records, grid, terrain, correlation_s=correlation_s)
        axes, points = east_north_up(grid, places_m), int((ratio > LEAST_RATIO).sum())
        information = float(np.minimum(ratio[ratio > LEAST_RATIO], CLEAR).sum())
        if points < LEAST_PATCHES or information < _LEAST_RATIO_SUM:
            return cls([], points, axes)
        typical = patch_at(places_m[0], records, axes, correlation_s=correlation_s)
        apart_m = _APART * float(np.abs((typical.pixels_m - typical.place_m) @ axes[:2].T).max())
        helpful = ratio > max(HELPFUL_RATIO, _SHARE_OF_CLEAREST * float(ratio.max()))
        chosen = separated(places_m[helpful], ratio[helpful], axes, apart_m=apart_m)
        return cls([patch_at(place, records, axes, correlation_s=correlation_s) for place in chosen], points, axes)

    def rejected(self, errors: Mapping[str, TrackErrors], by_speckle: Refinement | None = None) -> Refinement:
        """Return a rejected refinement: too few points, and why speckle does not do; no node is moved."""
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
    records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain, *, correlation_s: float
) -> tuple[Floats, Floats]:
    """Return places brighter than their surroundings in the images of all pairs, and by how much.

    Parameters
    ----------
    records
        Of every pair.
    grid, terrain
        The scene.
    correlation_s
        How long an error of the tracks lasts.

    Returns
    -------
    places_m : ndarray
        (place, 3) float64, metres in the frame, those that stand out most first.
    ratio : ndarray
        (place,) float64, power over that of the surroundings, summed over parts of the aperture.

    Notes
    -----
    Source: docs/theory/autofocus.md, "Patches". Power is summed over images of parts of the aperture, on every
    so many-th pixel of the grid; a part as long as an error lasts is focused whatever the error.
    """
    from scipy.ndimage import maximum_filter, median_filter  # slow to import

    cell_m = min(SPEED_OF_LIGHT_M_S / bandwidth_hz(one.profiles) for one in records) / 2
    step = max(1, int(cell_m / 2 / grid.spacing_m))
    rows, columns = (np.arange(step // 2, size, step) for size in grid.shape)
    power = np.zeros((len(rows), len(columns)))
    for one in records:
        image = np.zeros_like(power)
        for part in _parts(len(rows), len(columns)):
            row, column = np.meshgrid(rows[part[0]], columns[part[1]], indexing="ij")
            places = terrain.positions_at(grid, row, column)
            image[part] = sum(np.abs(look).astype(np.float64) ** 2 for look in _looks(one, places, correlation_s))
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


def _looks(one: PairRecord, places: Floats, correlation_s: float) -> Iterator[NDArray[np.complex64]]:
    """Yield the image of each part of the aperture."""
    engine = load_engine("native")
    if not engine.available():
        engine = load_engine("numba")
    spans_s = float(one.time_s[-1] - one.time_s[0])
    count = int(np.clip(spans_s / max(correlation_s, 1e-9), 1, MOST_LOOKS))
    for pulses in one.profiles.aperture.blocks(count):
        beams = None if one.beams is None else one.beams[pulses]
        yield engine.form(engine.prepare(one.profiles[pulses]), places, beams=beams)
