"""Patches of the scene about bright places: which places may be points, and the pixels about each."""

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

# ---- Patches about bright places and their pixels -------------------------------------------------------------------


MOST_PATCHES, CLEAR = 32, 20.0
"""Most patches; and peak to surroundings, power: patches are taken until their sum is that of a dozen such points."""

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
    # The scene in nine parts, of which none may provide more than its share of the places.
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
    """Count the patches that fit in memory, given the number of complex values of each.

    Examples
    --------
    >>> count_in_memory([2**24] * 32)
    8
    """
    return max(int((np.cumsum(values) <= MOST_VALUES).sum()), min(1, len(values)))


def _spans(place_m: Floats, record: PairRecord, axes: Floats, correlation_s: float) -> tuple[Floats, Floats, Floats]:
    """Return the directions along and across the line of sight, the cells along both, half a patch in cells."""
    profiles = record.profiles
    some = profiles.aperture.sample(_PULSES)
    slope, time_s = profiles.aperture[some].path_gradient(place_m) @ axes[:2].T, record.time_s[some]
    if record.beams is not None:
        illuminated = record.beams[some].weight(profiles.aperture[some], place_m[None])[:, 0] > 0
        slope, time_s = (slope[illuminated], time_s[illuminated]) if illuminated.sum() > 2 else (slope, time_s)
    # Cycles per metre along and across the mean line of sight, over pulses and band: cells are their inverse extents.
    ahead = slope.mean(axis=0)
    ahead = ahead / np.linalg.norm(ahead) if np.linalg.norm(ahead) > 1e-3 else np.array([0.0, 1.0])
    turned = np.stack([ahead, [-ahead[1], ahead[0]]])
    by_time = slope @ turned.T
    band = profiles.centre_frequency_hz + np.array([-0.5, 0.5]) * profiles.bandwidth_hz
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

_SHARE_OF_CLEAREST = 0.05  # beside clear points faint places are their sidelobes
_APART = 0.6  # least distance of patches, in halves of a patch

MOST_LOOKS = 128
"""Parts of what a place is seen from, at most: the shorter, the coarser their images."""

REFINED_LOOKS = 4
"""Parts once tracks are refined, at least: long parts separate neighbours, several average their sidelobes."""

_BLURRED_RAD2 = 3.0  # growth of the phase errors' variance over a part: its image keeps most of a point's power
_BY_CHANCE = 1e-3  # that speckle anywhere in the scene passes for a point
_SIDE_PX = 256  # of parts of the image formed at once
_WEIGHED_PX, _WEIGHED_PULSES = 16, 8  # pixels from one weight of a part by antennas and sector to the next; its pulses
_TREE_PULSES = 256  # of a part, from which trees are faster than the direct sum
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
        cls,
        records: Sequence[PairRecord],
        grid: SceneGrid,
        terrain: Terrain,
        errors: Mapping[str, TrackErrors],
        *,
        looks: int | None = None,
    ) -> "Candidates":
        """Return those of a scene.

        Parameters
        ----------
        records
            Of every pair.
        grid, terrain
            The scene.
        errors
            Node → error statistics of its log.
        looks
            Parts of what a place is seen from, or as many as the pixels want that are looked at; by default of those
            that the logs' errors may require the shortest that show half as many bright places as any.
        """
        correlation_s = min(one.correlation_s for one in errors.values())
        if looks:
            looks = max(looks, sampled_looks(records, grid, terrain))
        by_looks = [
            (
                *bright_places(records, grid, terrain, looks=some),
                least_ratio(some * len(records), grid.shape[0] * grid.shape[1]),
            )
            for some in ([looks] if looks else looks_of(records, errors, _middle(grid, terrain)))
        ]
        clear = [float(np.minimum(ratio[ratio > least], CLEAR).sum()) for _, ratio, least in by_looks]
        places_m, ratio, least = next(one for one, sum_ in zip(by_looks, clear, strict=True) if 2 * sum_ >= max(clear))
        axes = east_north_up(grid, places_m)
        points = int((ratio > least).sum())
        if not points:
            return cls([], 0, axes)
        typical = patch_at(places_m[0], records, axes, correlation_s=correlation_s)
        apart_m = _APART * float(np.abs((typical.pixels_m - typical.place_m) @ axes[:2].T).max())
        helpful = ratio > max(min(HELPFUL_RATIO, least), _SHARE_OF_CLEAREST * float(ratio.max()))
        chosen = separated(places_m[helpful], ratio[helpful], axes, apart_m=apart_m)
        return cls([patch_at(place, records, axes, correlation_s=correlation_s) for place in chosen], points, axes)

    def rejected(self, errors: Mapping[str, TrackErrors], by_speckle: Refinement | None = None) -> Refinement:
        """Return a rejected refinement: no bright place, and why speckle does not do; no node is moved."""
        line = f"no place of the scene stands {decibels(LEAST_RATIO):.0f} dB out of what lies about it"
        report: dict[str, Any] = {"patches": self.points}
        if by_speckle is not None:
            line, report = f"{line}; {by_speckle.why}", {**report, "speckle": dict(by_speckle.report)}
        still = TrackCorrection(np.zeros(1), {node: np.zeros((1, 3)) for node in errors})
        std_m = {node: one.along(self.axes)[None] for node, one in errors.items()}
        return Refinement(still, std_m, False, line, report, {"refinement_no_bright_point": line})


def looks_of(records: Sequence[PairRecord], errors: Mapping[str, TrackErrors], place_m: Floats) -> list[int]:
    """Return into how many parts the time may be cut for which a place is seen, shortest parts first.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 10a: from parts over which the variance of the errors' phase grows by three,
    and whose images nothing blurs, to parts as long as an error lasts, whose images hold more of a point against
    clutter.
    """
    spans_s, shortest_s, longest_s = [], [], []
    for one in records:
        lasts_s, turned = one.turned(errors)
        longest_s.append(lasts_s)
        shortest_s.append(lasts_s * min(1.0, _BLURRED_RAD2 / (2 * turned**2)))
        spans_s.append(float(one.time_s[-1] - one.time_s[0]) * _seen(one, place_m))
    most, least = (int(np.clip(max(spans_s) / max(min(one), 1e-9), 1, MOST_LOOKS)) for one in (shortest_s, longest_s))
    steps = max(1, int(np.ceil(np.log2(most / least)))) if most > least else 0
    return [round(most * (least / most) ** (step / max(steps, 1))) for step in range(steps + 1)]


def sampled_looks(records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain) -> int:
    """Return the number of parts from which on no image is finer than the pixels that `bright_places` looks at.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 10b. Longer parts, of which pulses are the more the longer a flight is, would
    show points between pixels and hold all of the flight in memory.
    """
    place_m, step_m = _middle(grid, terrain), _step(records, grid) * grid.spacing_m
    most = 1.0
    for one in records:
        some = one.profiles.aperture.sample(_PULSES)
        slope = one.profiles.aperture[some].path_gradient(place_m)
        turned = np.linalg.norm(np.diff(slope, axis=0), axis=1) * one.profiles.centre_frequency_hz / SPEED_OF_LIGHT_M_S
        lasts = np.diff(one.time_s[some])
        fastest = float((turned / np.maximum(lasts, 1e-9)).max(initial=0.0))
        most = max(most, 2 * fastest * step_m * float(one.time_s[-1] - one.time_s[0]) * _seen(one, place_m))
    return int(np.ceil(most))


def least_ratio(looks: int, cells: int) -> float:
    """Return the power over the mean that speckle, averaged over looks, exceeds in one scene of a thousand.

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
    """Return places brighter than their surroundings in the images of all pairs, and by how much.

    Parameters
    ----------
    records
        Of every pair.
    grid, terrain
        The scene.
    looks
        Parts of the aperture whose images are summed.

    Returns
    -------
    places_m : ndarray
        (place, 3) float64, metres in the frame, those that stand out most first.
    ratio : ndarray
        (place,) float64, power over that of the surroundings, summed over parts of the aperture.

    Notes
    -----
    Source: docs/theory/autofocus.md, "Patches". Power is summed over images of parts of the aperture, on every
    so many-th pixel of the grid; a part that is short against the errors is focused whatever they are. Pulses of a part
    have Hann weights: sidelobes across the line of sight, which would pass for points, fall below −31 dB.
    """
    from scipy.ndimage import maximum_filter, median_filter  # slow to import

    cell_m = min(SPEED_OF_LIGHT_M_S / one.profiles.bandwidth_hz for one in records) / 2
    step = _step(records, grid)
    rows, columns = (np.arange(step // 2, size, step) for size in grid.shape)
    power = np.zeros((len(rows), len(columns)))
    places = [
        (part, terrain.positions_at(grid, *np.meshgrid(rows[part[0]], columns[part[1]], indexing="ij")))
        for part in _parts(len(rows), len(columns))
    ]
    # Power summed over the looks of each pair, each pair by its mean.
    for one in records:
        image = np.zeros_like(power)
        for power_of in _looks(one, looks, _middle(grid, terrain)):
            for part, pixels in places:
                image[part] += power_of(pixels)
        power += image / max(float(np.nanmean(image)), 1e-300)
    power = np.nan_to_num(power)
    # Surroundings: median over some range cells, on a thinned lattice; or sidelobes of the brightest place.
    reach = max(3, round(_ABOUT_CELLS * cell_m / (step * grid.spacing_m)))
    thin = max(1, reach // 3)
    about = median_filter(power[::thin, ::thin], size=7, mode="nearest")
    about = np.repeat(np.repeat(about, thin, 0), thin, 1)[: power.shape[0], : power.shape[1]]
    ratio = power / np.maximum(about, _SIDELOBES * power.max())
    # Local maxima, by their power over the surroundings.
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


def _step(records: Sequence[PairRecord], grid: SceneGrid) -> int:
    """Return the distance of pixels that bright places are looked for in, in pixels of the grid: half a range cell."""
    cell_m = min(SPEED_OF_LIGHT_M_S / one.profiles.bandwidth_hz for one in records) / 2
    return max(1, int(cell_m / 2 / grid.spacing_m))


def _middle(grid: SceneGrid, terrain: Terrain) -> Floats:
    """Return (3,) float64, metres in the frame, the middle of the scene."""
    return np.asarray(terrain.positions_at(grid, (grid.shape[0] - 1) / 2, (grid.shape[1] - 1) / 2))


def _seen(one: PairRecord, place_m: Floats) -> float:
    """Return the share of a flight that a place is seen from, by antennas and sector: 1 of all of it, more than 0."""
    if one.beams is None:
        return 1.0
    some = one.profiles.aperture.sample(_PULSES)
    share = float((one.beams[some].weight(one.profiles.aperture[some], place_m[None]) > 0).mean())
    return share or 1.0


def _looks(one: PairRecord, looks: int, place_m: Floats) -> Iterator[Callable[[Floats], Floats]]:
    """Yield what gives the power of pixels (y, x, 3) in each part of a flight.

    Parts are of equal length, half of each in the next; their pulses have Hann weights. Antennas and sector weigh the
    image of a part as in the mean over it: they change slowly. Tables are made once for each, and serve all places.
    """
    count = max(1, round(looks / _seen(one, place_m)))
    ends = np.linspace(0, len(one.time_s), count + 2 if count > 1 else 2).astype(int)
    for first, last in zip(ends, ends[2:] if count > 1 else ends[1:], strict=False):
        if last == first:
            continue
        part, many = one.profiles[int(first) : int(last)], last - first >= _TREE_PULSES
        engine = next(
            each for name in ("tree", "native", "numba")[not many :] if (each := load_engine(name)).available()
        )
        taper = np.hanning(last - first + 2)[1:-1, None].astype(np.float32)
        tables = engine.prepare(replace(part, samples=np.asarray(part.samples) * taper))
        some = np.linspace(first, last - 1, _WEIGHED_PULSES + 2)[1:-1].astype(int)
        beams = None if one.beams is None else one.beams[some]
        yield partial(_power, partial(engine.form, tables), beams, one.profiles.aperture[some])


def _power(
    form: Callable[[Floats], NDArray[np.complex64]], beams: Beams | None, some: Aperture, pixels: Floats
) -> Floats:
    """Return (y, x) float64, power of an image, weighted as `beams` do over some pulses; nothing is formed unseen."""
    weight: Floats = np.ones((1, 1))
    if beams is not None:
        rows, columns = (
            np.minimum(np.arange(0, size, _WEIGHED_PX) + _WEIGHED_PX // 2, size - 1) for size in pixels.shape[:2]
        )
        coarse = pixels[np.ix_(rows, columns)]
        mean = beams.weight(some, coarse.reshape(-1, 3)).mean(axis=0).reshape(coarse.shape[:2])
        weight = np.repeat(np.repeat(mean, _WEIGHED_PX, 0), _WEIGHED_PX, 1)[: pixels.shape[0], : pixels.shape[1]]
        if not weight.any():
            return np.zeros(pixels.shape[:2])
    return np.asarray((weight * np.abs(form(pixels))) ** 2, np.float64)
