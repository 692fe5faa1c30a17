"""Patches of the scene about bright points: detection of candidate points, and the pixels about each."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.units import decibels
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines import load_engine
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import ned_axes
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain
from apertura.methods.autofocus.inputs import PairRecord, Refinement, TrackErrors

# ---- Patches about bright points and their pixels -------------------------------------------------------------------


MOST_PATCHES, CLEAR = 32, 20.0
"""Maximum number of patches; and peak-to-background power ratio of a clearly visible point. A dozen such points
suffice.
"""

MOST_VALUES = 2**27
"""Maximum number of complex values of block contributions (1 GB), which limits the number of patches."""

_ENOUGH = 12 * CLEAR  # sum of the ratios at which the selection of patches stops
_SAMPLING = 0.7  # pixel spacing, resolution cells; 0.5 gives no improvement, 0.85 less accurate positions
_RANGE_CELLS = 1.5  # half the size of a patch along the line of sight
_LEAST_CELLS, _MOST_CELLS = 6.0, 24.0  # half the size of a patch across the line of sight
_BANDWIDTH = 0.66  # bandwidth of errors with correlation time τ, in 1/τ; the patch must contain their sidelobes
_MOST_PIXELS = 1000  # maximum pixels of a patch
_PULSES = 256  # number of pulses sampled for the directions and cells of a patch
_SHARE = 0.4  # largest fraction of all patches in one ninth of the scene


@dataclass(frozen=True, eq=False)
class Patch:
    """Bright point with the pixels about it.

    Attributes
    ----------
    place_m
        (3,) float64, position of the point, metres in the frame.
    pixels_m
        (pixel, 3) float64, horizontal pixels about the point, metres in the frame.
    """

    place_m: Floats
    pixels_m: Floats


def separated(places_m: Floats, ratio: Floats, axes: Floats, *, apart_m: float) -> Floats:
    """Select a sufficient number of separated points over the scene, in descending order of power ratio.

    Parameters
    ----------
    places_m
        (point, 3) float64, metres in the frame, in descending order of `ratio`.
    ratio
        (point,) float64, peak-to-background power ratio of each point.
    axes
        (3, 3) float64, rows are east, north, up.
    apart_m
        Minimum distance between two points, metres.

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
    # The scene is divided into nine parts, each of which contributes at most the fraction `_SHARE` of the points.
    ninth = np.minimum((level - low) / extent * 3, 2.999).astype(int) @ np.array([3, 1])
    selected: list[int] = []
    for number in range(len(places_m)):
        information = float(np.minimum(ratio[selected], CLEAR).sum())
        if len(selected) == MOST_PATCHES or information >= _ENOUGH:
            break
        most = max(2, int(np.ceil(_SHARE * min(MOST_PATCHES, _ENOUGH / min(CLEAR, ratio[number])))))
        is_near = any(np.linalg.norm(level[number] - level[other]) < apart_m for other in selected)
        if not is_near and sum(ninth[other] == ninth[number] for other in selected) < most:
            selected.append(number)
    return places_m[selected]


def patch_at(place_m: Floats, records: Sequence[PairRecord], axes: Floats, *, correlation_s: float) -> Patch:
    """Return the patch about a point, with the pixel spacing of the sharpest pair and the width of the blurred point.

    Parameters
    ----------
    place_m
        (3,) float64, position of the point, metres in the frame.
    records
        Records of all pairs.
    axes
        (3, 3) float64, rows are east, north, up.
    correlation_s
        Correlation time of track errors.

    Notes
    -----
    Source: docs/theory/autofocus.md, "Patches".
    """
    spans = [_spans(place_m, record, axes, correlation_s) for record in records]
    directions = max(spans, key=lambda span: span[1][1])[0]
    cell = np.min([span[1] for span in spans], axis=0)
    half = np.max([span[2] for span in spans], axis=0)
    counts = 2 * np.ceil(half / _SAMPLING) + 1
    shrink = min(1.0, np.sqrt(_MOST_PIXELS / counts.prod()))
    sides = [
        np.arange(-(n := int(shrink * reach / _SAMPLING)), n + 1) * _SAMPLING * size
        for reach, size in zip(half, cell, strict=True)
    ]
    along, aside = np.meshgrid(*sides, indexing="ij")
    level = along[..., None] * directions[0] + aside[..., None] * directions[1]
    return Patch(place_m, place_m + level.reshape(-1, 2) @ axes[:2])


def count_in_memory(values: Sequence[int]) -> int:
    """Count the patches that fit in memory, given the number of complex values of each patch.

    Examples
    --------
    >>> count_in_memory([2**24] * 32)
    8
    """
    return max(int((np.cumsum(values) <= MOST_VALUES).sum()), min(1, len(values)))


def _spans(place_m: Floats, record: PairRecord, axes: Floats, correlation_s: float) -> tuple[Floats, Floats, Floats]:
    """Return the directions along and across the line of sight, and cell sizes and half patch sizes in cells."""
    profiles = record.profiles
    pulses = profiles.aperture.sample(_PULSES)
    slope, time_s = profiles.aperture[pulses].path_gradient(place_m) @ axes[:2].T, record.time_s[pulses]
    if record.beams is not None:
        illuminated = record.beams[pulses].weight(profiles.aperture[pulses], place_m[None])[:, 0] > 0
        slope, time_s = (slope[illuminated], time_s[illuminated]) if illuminated.sum() > 2 else (slope, time_s)
    # Cycles per metre along and across the mean line of sight, over pulses and band; cell sizes are inverse extents.
    along_sight = slope.mean(axis=0)
    along_sight = (
        along_sight / np.linalg.norm(along_sight) if np.linalg.norm(along_sight) > 1e-3 else np.array([0.0, 1.0])
    )
    directions = np.stack([along_sight, [-along_sight[1], along_sight[0]]])
    by_time = slope @ directions.T
    band = profiles.centre_frequency_hz + np.array([-0.5, 0.5]) * profiles.bandwidth_hz
    cycles = np.concatenate([by_time * frequency / SPEED_OF_LIGHT_M_S for frequency in band])
    cell = 1 / np.maximum(np.ptp(cycles, axis=0), 1e-9)
    spread = np.clip(_BANDWIDTH * float(np.ptp(time_s)) / correlation_s, _LEAST_CELLS, _MOST_CELLS)
    extent = np.ptp(by_time, axis=0)
    half = np.array([max(_RANGE_CELLS, spread * min(1.0, extent[0] / max(extent[1], 1e-9)) ** 2), spread])
    return directions, cell, half


# ---- Bright points in images of short subapertures ------------------------------------------------------------------

LEAST_RATIO = 5.0
"""Minimum peak-to-background power ratio of a point, summed over subapertures."""

HELPFUL_RATIO = 3.5
"""Minimum ratio of weaker points, which are used as well if the scene has points of `LEAST_RATIO`."""

_SHARE_OF_CLEAREST = 0.05  # minimum ratio relative to the largest ratio; points below may be sidelobes
_APART = 0.6  # minimum distance of patches, in half patch sizes

MOST_LOOKS = 128
"""Maximum number of subapertures from which a point is visible; shorter subapertures have coarser images."""

REFINED_LOOKS = 4
"""Minimum number of subapertures along refined tracks: long subapertures resolve neighbouring points, and a sum over
several subapertures averages sidelobes.
"""

_BLURRED_RAD2 = 3.0  # growth of the phase-error variance up to which an image keeps most of a point's power
_BY_CHANCE = 1e-3  # false alarm rate of points from speckle, per scene
_SIDE_PX = 256  # side of image tiles, pixels
_WEIGHED_PX, _WEIGHED_PULSES = 16, 8  # pixel spacing of antenna and sector weights; pulses averaged for a weight
_TREE_PULSES = 256  # number of pulses of a subaperture above which engine tree is faster than the direct sum
_ABOUT_CELLS = 12  # radius of the background in range cells
_SIDELOBES = 1e-3  # power relative to the brightest point, below which points may be its sidelobes
_MOST_PLACES = 500  # maximum number of candidates


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate points of a scene for the refinement of tracks.

    Attributes
    ----------
    patches
        Patches about separated bright points, in descending order of power ratio; empty if the scene has no bright
        point.
    points
        Number of points above the detection threshold.
    axes
        (3, 3) float64, rows are east, north, up at the scene in the frame.
    threshold
        Detection threshold: power of a point relative to its background.
    """

    patches: Sequence[Patch]
    points: int
    axes: Floats
    threshold: float

    @classmethod
    def of(
        cls,
        records: Sequence[PairRecord],
        grid: SceneGrid,
        terrain: Terrain,
        errors: Mapping[str, TrackErrors],
        *,
        looks: int | None = None,
    ) -> "Candidates":
        """Detect the candidate points of a scene.

        Parameters
        ----------
        records
            Records of all pairs.
        grid, terrain
            The scene.
        errors
            Node → error statistics of its log.
        looks
            Minimum number of subapertures; the pixel spacing may require more. The default is determined from the
            subaperture lengths that the errors of the logs may require: the shortest length at which at least half as
            many bright points are detected as at any other length.
        """
        correlation_s = min(one.correlation_s for one in errors.values())
        if looks:
            looks = max(looks, sampled_looks(records, grid, terrain))
        by_looks = [
            (
                *bright_places(records, grid, terrain, looks=count),
                least_ratio(count * len(records), grid.shape[0] * grid.shape[1]),
            )
            for count in ([looks] if looks else looks_of(records, errors, _middle(grid, terrain)))
        ]
        clear = [float(np.minimum(ratio[ratio > least], CLEAR).sum()) for _, ratio, least in by_looks]
        places_m, ratio, least = next(
            detected for detected, total in zip(by_looks, clear, strict=True) if 2 * total >= max(clear)
        )
        axes = east_north_up(grid, places_m)
        points = int((ratio > least).sum())
        if not points:
            return cls([], 0, axes, least)
        typical = patch_at(places_m[0], records, axes, correlation_s=correlation_s)
        apart_m = _APART * float(np.abs((typical.pixels_m - typical.place_m) @ axes[:2].T).max())
        helpful = ratio > max(min(HELPFUL_RATIO, least), _SHARE_OF_CLEAREST * float(ratio.max()))
        chosen = separated(places_m[helpful], ratio[helpful], axes, apart_m=apart_m)
        return cls(
            [patch_at(place, records, axes, correlation_s=correlation_s) for place in chosen], points, axes, least
        )

    def rejected(self, errors: Mapping[str, TrackErrors], by_speckle: Refinement | None = None) -> Refinement:
        """Return a rejected refinement, whose reason states that bright points and speckle are insufficient."""
        line = f"no point of the scene exceeds its background by {decibels(self.threshold):.0f} dB"
        report: dict[str, Any] = {"patches": self.points}
        if by_speckle is not None:
            line, report = f"{line}; {by_speckle.reason}", {**report, "speckle": dict(by_speckle.report)}
        unchanged = TrackCorrection(np.zeros(1), {node: np.zeros((1, 3)) for node in errors})
        std_m = {node: error.along(self.axes)[None] for node, error in errors.items()}
        return Refinement(unchanged, std_m, False, line, report, {"refinement_no_bright_point": line})


def looks_of(records: Sequence[PairRecord], errors: Mapping[str, TrackErrors], place_m: Floats) -> list[int]:
    """Return candidate numbers of subapertures within the time for which a point is visible, in descending order.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 10a: from subapertures over which the variance of the phase errors grows by
    3 rad², whose images are not blurred, to subapertures as long as the correlation time of the errors, whose images
    have a better contrast of points against clutter.
    """
    spans_s, shortest_s, longest_s = [], [], []
    for record in records:
        correlation_s, phase_rad = record.extreme_errors(errors)
        longest_s.append(correlation_s)
        shortest_s.append(correlation_s * min(1.0, _BLURRED_RAD2 / (2 * phase_rad**2)))
        spans_s.append(float(record.time_s[-1] - record.time_s[0]) * _visible_share(record, place_m))
    most, least = (
        int(np.clip(max(spans_s) / max(min(lengths_s), 1e-9), 1, MOST_LOOKS)) for lengths_s in (shortest_s, longest_s)
    )
    steps = max(1, int(np.ceil(np.log2(most / least)))) if most > least else 0
    return [round(most * (least / most) ** (step / max(steps, 1))) for step in range(steps + 1)]


def sampled_looks(records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain) -> int:
    """Return the minimum number of subapertures whose image resolution is no finer than the pixels of `bright_places`.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 10b. In images of longer subapertures, points may lie between pixels; memory
    for their pulses is proportional to the duration of the flight.
    """
    place_m, step_m = _middle(grid, terrain), _step(records, grid) * grid.spacing_m
    most = 1.0
    for record in records:
        pulses = record.profiles.aperture.sample(_PULSES)
        slope = record.profiles.aperture[pulses].path_gradient(place_m)
        change = np.linalg.norm(np.diff(slope, axis=0), axis=1)
        cycles_per_m = change * record.profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S
        interval_s, span_s = np.diff(record.time_s[pulses]), float(record.time_s[-1] - record.time_s[0])
        fastest = float((cycles_per_m / np.maximum(interval_s, 1e-9)).max(initial=0.0))
        most = max(most, 2 * fastest * step_m * span_s * _visible_share(record, place_m))
    return int(np.ceil(most))


def least_ratio(looks: int, cells: int) -> float:
    """Return the ratio to the mean power that speckle averaged over looks exceeds in one of 1000 scenes.

    Examples
    --------
    >>> [round(least_ratio(looks, 10_000), 1) for looks in (1, 4, 30)]
    [16.1, 6.0, 5.0]
    """
    from scipy.stats import gamma  # slow to import

    return max(LEAST_RATIO, float(gamma.isf(_BY_CHANCE / cells, looks)) / looks)


def bright_places(
    records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain, *, looks: int
) -> tuple[Floats, Floats]:
    """Detect local maxima in the summed images of all pairs, with their peak-to-background power ratio.

    Parameters
    ----------
    records
        Records of all pairs.
    grid, terrain
        The scene.
    looks
        Number of subapertures whose images are summed.

    Returns
    -------
    places_m : ndarray
        (point, 3) float64, metres in the frame, largest ratio first.
    ratio : ndarray
        (point,) float64, peak-to-background power ratio, summed over subapertures.

    Notes
    -----
    Source: docs/theory/autofocus.md, "Patches". Power is summed over images of subapertures on a thinned pixel grid;
    a subaperture that is short compared with the correlation time of the errors is focused for any errors. The pulses
    of a subaperture have Hann weights: cross-range sidelobes, which may be mistaken for points, are below −31 dB.
    """
    from scipy.ndimage import maximum_filter, median_filter  # slow to import

    cell_m = min(SPEED_OF_LIGHT_M_S / one.profiles.bandwidth_hz for one in records) / 2
    step = _step(records, grid)
    rows, columns = (np.arange(step // 2, size, step) for size in grid.shape)
    power = np.zeros((len(rows), len(columns)))
    tiles = [
        (window, terrain.positions_at(grid, *np.meshgrid(rows[window[0]], columns[window[1]], indexing="ij")))
        for window in _windows(len(rows), len(columns))
    ]
    # Power summed over the looks of each pair and normalised by the pair's mean.
    for record in records:
        image = np.zeros_like(power)
        for power_of in _looks(record, looks, _middle(grid, terrain)):
            for window, pixels in tiles:
                image[window] += power_of(pixels)
        power += image / max(float(np.nanmean(image)), 1e-300)
    power = np.nan_to_num(power)
    # Background: the median within `_ABOUT_CELLS` on a thinned lattice, or the sidelobes of the brightest point.
    reach = max(3, round(_ABOUT_CELLS * cell_m / (step * grid.spacing_m)))
    thin = max(1, reach // 3)
    background = median_filter(power[::thin, ::thin], size=7, mode="nearest")
    background = np.repeat(np.repeat(background, thin, 0), thin, 1)[: power.shape[0], : power.shape[1]]
    ratio = power / np.maximum(background, _SIDELOBES * power.max())
    # Local maxima, sorted by their ratio to the background.
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


def _windows(rows: int, columns: int) -> Iterator[tuple[slice, slice]]:
    for row in range(0, rows, _SIDE_PX):
        for column in range(0, columns, _SIDE_PX):
            yield slice(row, row + _SIDE_PX), slice(column, column + _SIDE_PX)


def _step(records: Sequence[PairRecord], grid: SceneGrid) -> int:
    """Return the pixel step for the detection of bright points, half a range cell, in pixels of the grid."""
    cell_m = min(SPEED_OF_LIGHT_M_S / record.profiles.bandwidth_hz for record in records) / 2
    return max(1, int(cell_m / 2 / grid.spacing_m))


def _middle(grid: SceneGrid, terrain: Terrain) -> Floats:
    """Return (3,) float64, scene centre, metres in the frame."""
    return np.asarray(terrain.positions_at(grid, (grid.shape[0] - 1) / 2, (grid.shape[1] - 1) / 2))


def _visible_share(record: PairRecord, place_m: Floats) -> float:
    """Return the fraction of pulses for which a point is within beams and sector, or 1 if there is no such pulse."""
    if record.beams is None:
        return 1.0
    pulses = record.profiles.aperture.sample(_PULSES)
    share = float((record.beams[pulses].weight(record.profiles.aperture[pulses], place_m[None]) > 0).mean())
    return share or 1.0


def _looks(record: PairRecord, looks: int, place_m: Floats) -> Iterator[Callable[[Floats], Floats]]:
    """Yield, for each subaperture of a flight, the function that returns the power at pixels (y, x, 3).

    Subapertures have equal length and overlap by one half; their pulses have Hann weights. The image of a subaperture
    is multiplied by the mean antenna and sector weight, which changes slowly with position. The tables of a subaperture
    are computed once for all pixels.
    """
    count = max(1, round(looks / _visible_share(record, place_m)))
    ends = np.linspace(0, len(record.time_s), count + 2 if count > 1 else 2).astype(int)
    for first, last in zip(ends, ends[2:] if count > 1 else ends[1:], strict=False):
        if last == first:
            continue
        subaperture, is_long = record.profiles[int(first) : int(last)], last - first >= _TREE_PULSES
        engine = next(
            each for name in ("tree", "native", "numba")[not is_long :] if (each := load_engine(name)).available()
        )
        taper = np.hanning(last - first + 2)[1:-1, None].astype(np.float32)
        tables = engine.prepare(replace(subaperture, samples=np.asarray(subaperture.samples) * taper))
        pulses = np.linspace(first, last - 1, _WEIGHED_PULSES + 2)[1:-1].astype(int)
        beams = None if record.beams is None else record.beams[pulses]
        yield partial(_power, partial(engine.form, tables), beams, record.profiles.aperture[pulses])


def _power(
    form: Callable[[Floats], NDArray[np.complex64]], beams: Beams | None, aperture: Aperture, pixels: Floats
) -> Floats:
    """Return (y, x) float64, image power times the mean weight of `beams` over `aperture`; 0 if no pixel is visible."""
    weight: Floats = np.ones((1, 1))
    if beams is not None:
        rows, columns = (
            np.minimum(np.arange(0, size, _WEIGHED_PX) + _WEIGHED_PX // 2, size - 1) for size in pixels.shape[:2]
        )
        coarse = pixels[np.ix_(rows, columns)]
        mean = beams.weight(aperture, coarse.reshape(-1, 3)).mean(axis=0).reshape(coarse.shape[:2])
        weight = np.repeat(np.repeat(mean, _WEIGHED_PX, 0), _WEIGHED_PX, 1)[: pixels.shape[0], : pixels.shape[1]]
        if not weight.any():
            return np.zeros(pixels.shape[:2])
    return np.asarray((weight * np.abs(form(pixels))) ** 2, np.float64)
