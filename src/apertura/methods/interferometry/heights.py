"""Phase-to-height conversion: unwrapping, reference level, valid pixels, accuracy, and geocoding of heights."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.methods.interferometry.sensitivity import Sensitivity

# ---- Unwrapping and residues ----------------------------------------------------------------------------------------

_LEAST_SHARE = 0.01  # minimum fraction of all pixels in a connected component: default of snaphu
_ROWS = 256  # rows of pixels processed at once


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """Unwrapped phase by connected components.

    Attributes
    ----------
    phase
        (y, x) float32, rad; NaN where not valid.
    part
        (y, x) uint32, number of the connected component, 0 outside; the multiple of 2π between components is unknown.
    by
        Library and version; empty if the phase is not unwrapped but within π of its reference.
    residues
        Number of loops of four pixels with a nonzero sum of wrapped phase differences.
    loops
        Number of loops of four valid pixels.
    jumps
        Number of neighbouring pixels whose wrapped phases differ by more than π, which unwrapping must resolve.
    """

    phase: NDArray[np.float32]
    part: NDArray[np.uint32]
    by: str
    residues: int
    loops: int
    jumps: int


def unwrap(phase: NDArray[np.float32], coherence: NDArray[np.float32], *, looks: float, cell_px: int = 1) -> Unwrapped:
    """Unwrap the phase by snaphu if it is installed; otherwise return the wrapped phase.

    Parameters
    ----------
    phase
        (y, x) float32, rad, NaN where not valid.
    coherence
        (y, x) float32, 0 to 1.
    looks
        Independent samples averaged for a phase.
    cell_px
        Side of the cells whose mean phases are unwrapped, pixels; the phase must change by less than half a cycle per
        cell. Memory and time of snaphu are proportional to the number of cells.

    Notes
    -----
    Source: docs/theory/interferometry.md, section 6; C. W. Chen and H. A. Zebker, J. Opt. Soc. Am. A 18, 338 (2001).

    Examples
    --------
    >>> ramp = np.angle(np.exp(0.4j * np.arange(40.0))) * np.ones((24, 1))
    >>> unwrapped = unwrap(ramp.astype(np.float32), np.full((24, 40), 0.9, np.float32), looks=9.0)
    >>> unwrapped.residues, unwrapped.jumps
    (0, 48)
    """
    valid = np.isfinite(phase)
    residues, loops, jumps = count_residues(phase)
    by = _library()
    if not by or not jumps:
        return Unwrapped(phase, valid.astype(np.uint32), by, residues, loops, jumps)
    import snaphu

    count = max(1, _ROWS // cell_px)  # rows of cells in a strip
    strips = [slice(first, first + count * cell_px) for first in range(0, len(phase), count * cell_px)]
    sums = [_sums_of_cells(phase[strip], coherence[strip], cell_px) for strip in strips]
    cells, weight, covered = (np.concatenate(values) for values in zip(*sums, strict=True))
    whole, part = snaphu.unwrap(
        np.exp(1j * np.angle(cells)).astype(np.complex64),
        (weight / np.maximum(covered, 1)).astype(np.float32),
        max(1.0, looks),
        cost="smooth",
        mask=covered > 0,
        min_conncomp_frac=_LEAST_SHARE,
    )
    unwrapped, parts = np.full(phase.shape, np.nan, np.float32), np.zeros(phase.shape, np.uint32)
    for number, strip in enumerate(strips):
        of_cells = slice(number * count, (number + 1) * count)
        of_pixels = phase[strip]
        guess, label = (
            values[of_cells].repeat(cell_px, 0).repeat(cell_px, 1)[: of_pixels.shape[0], : of_pixels.shape[1]]
            for values in (whole, part)
        )
        known = np.isfinite(of_pixels) & (label > 0)
        # only the multiples of 2π are used and added to the measured phase of the pixels: snaphu rounds its phase
        cycles = np.round((guess[known] - of_pixels[known]) / (2 * np.pi))
        unwrapped[strip][known], parts[strip][known] = of_pixels[known] + 2 * np.pi * cycles, label[known]
    return Unwrapped(unwrapped, parts, by, residues, loops, jumps)


def _sums_of_cells(
    phase: NDArray[np.float32], coherence: NDArray[np.float32], side_px: int
) -> tuple[NDArray[np.complex64], NDArray[np.float32], NDArray[np.float32]]:
    """Return the sums of phasors, coherence and valid pixels over square cells, the last of which may be smaller."""
    valid = np.isfinite(phase)
    rows, columns = (range(0, size, side_px) for size in phase.shape)
    phasors = np.where(valid, np.exp(1j * np.where(valid, phase, 0)), 0).astype(np.complex64)
    phasor, weight, covered = (
        np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)
        for values in (phasors, np.where(valid, coherence, 0).astype(np.float32), valid.astype(np.float32))
    )
    return phasor, weight, covered


def count_residues(phase: NDArray[np.float32]) -> tuple[int, int, int]:
    """Count residues, loops of four valid pixels, and neighbours whose phases differ by more than π.

    Examples
    --------
    >>> count_residues(np.array([[0.0, 2.0], [-2.0, 4.0]], np.float32))
    (1, 1, 1)
    """
    residues = loops = jumps = 0
    for first in range(0, len(phase), _ROWS):
        block = phase[first : first + _ROWS + 1]  # the last row is the first of the next block
        down, right = (np.round(np.diff(block, axis=axis) / (2 * np.pi)) for axis in (0, 1))
        # Integer cycles around each loop of four pixels.
        around = right[:-1] + down[:, 1:] - right[1:] - down[:, :-1]
        loops += int(np.isfinite(around).sum())
        residues += int(np.count_nonzero(np.nan_to_num(around)))
        jumps += sum(int(np.count_nonzero(np.nan_to_num(cycles))) for cycles in (down, right[:_ROWS]))
    return residues, loops, jumps


def _library() -> str:
    """Return name and version of the unwrapping library; empty if it is not installed."""
    try:
        return f"snaphu {version('snaphu')}"
    except PackageNotFoundError:
        return ""


# ---- Reference level: the constant phase between two images is arbitrary --------------------------------------------


@dataclass(frozen=True)
class KnownHeight:
    """Point of known height at its position in the images.

    Attributes
    ----------
    name
        Name of the point.
    row, column
        Pixel nearest to the point in the images.
    phase_rad
        Phase due to the height of the point.
    measured_rad
        Measured wrapped phase at the pixel; NaN without a measurement.
    std_rad
        Standard deviation of the measured phase.
    """

    name: str
    row: int
    column: int
    phase_rad: float
    measured_rad: float = float("nan")
    std_rad: float = 0.0


@dataclass(frozen=True)
class Level:
    """Phase constant between the images, the reference level of the heights.

    Attributes
    ----------
    phase_rad
        Phase constant.
    part
        Component of the unwrapped phase for which the constant is valid; other components have unknown multiples of 2π.
    points
        Points of known height that determine the constant; empty if the constant is the median of the phase.
    spread_rad
        Largest deviation of a point from the constant; None for fewer than two points.
    std_rad
        Standard deviation of the constant, whose error is common to all heights; None (unknown) without points.
    """

    phase_rad: float
    part: int
    points: tuple[str, ...] = ()
    spread_rad: float | None = None
    std_rad: float | None = None


def level(phase: Unwrapped, known: Sequence[KnownHeight]) -> Level | None:
    """Return the phase constant between two images, docs/theory/interferometry.md, eq. 15; None without valid phase.

    Parameters
    ----------
    phase
        Unwrapped phase.
    known
        Points of known height; points without a measured phase are ignored.

    Examples
    --------
    >>> phase = np.array([[0.1, 0.2, 0.6]], np.float32)
    >>> unwrapped = Unwrapped(phase, np.ones((1, 3), np.uint32), "", 0, 0, 0)
    >>> level(unwrapped, []).phase_rad, round(level(unwrapped, [KnownHeight("mast", 0, 2, 0.5, 0.7)]).phase_rad, 3)
    (0.2, 0.2)
    """
    valid = np.isfinite(phase.phase) & (phase.part > 0)
    if not valid.any():
        return None
    measured = [(point, *_unwrapped(point, phase, valid)) for point in known if np.isfinite(point.measured_rad)]
    if not measured:
        sizes = np.bincount(phase.part[valid])
        part = int(np.argmax(sizes[1:])) + 1
        return Level(round(float(np.median(phase.phase[phase.part == part])), 6), part)
    parts = [part for *_, part in measured]
    part = max(sorted(set(parts)), key=parts.count)
    constants = {point.name: value - point.phase_rad for point, value, own_part in measured if own_part == part}
    constant = float(np.median(list(constants.values())))
    spread = max(abs(value - constant) for value in constants.values()) if len(constants) > 1 else None
    std = _level_std(list(constants.values()), [point.std_rad for point, _, own_part in measured if own_part == part])
    return Level(round(constant, 6), part, tuple(constants), spread, round(std, 6))


def _level_std(constants: Sequence[float], stds: Sequence[float]) -> float:
    """Return the standard deviation of the median of constants: from their standard deviations or scatter, if larger.

    Source: docs/theory/interferometry.md, eq. 15a.
    """
    count = len(constants)
    by_points = float(np.sqrt(np.square(stds).sum())) / count
    by_scatter = float(np.std(constants, ddof=1)) / np.sqrt(count) if count > 1 else 0.0
    return float(max(by_points, by_scatter) * (np.sqrt(np.pi / 2) if count > 2 else 1.0))


def _unwrapped(point: KnownHeight, phase: Unwrapped, valid: NDArray[np.bool_]) -> tuple[float, int]:
    """Return the unwrapped phase and the component at the valid pixel nearest to a point."""

    def within(half: int) -> NDArray[np.int64]:
        top, left = max(point.row - half, 0), max(point.column - half, 0)
        return np.argwhere(valid[top : point.row + half + 1, left : point.column + half + 1]) + (top, left)

    half = 1
    while not len(within(half)):
        half *= 2
    places = within(int(np.ceil(np.sqrt(2) * half)))  # the circle around the first square with a valid pixel
    near = tuple(places[np.argmin(((places - (point.row, point.column)) ** 2).sum(axis=1))])
    cycles = np.round((float(phase.phase[near]) - point.measured_rad) / (2 * np.pi))
    return float(point.measured_rad + 2 * np.pi * cycles), int(phase.part[near])


def remove_level(phase: Unwrapped, reference: Level) -> NDArray[np.float32]:
    """Return the phase due to height in the reference component, (y, x) float32 rad; wrapped if not unwrapped before.

    Examples
    --------
    >>> phase = Unwrapped(np.array([[3.0]], np.float32), np.ones((1, 1), np.uint32), "", 0, 0, 1)
    >>> remove_level(phase, Level(-1.0, 1)).round(3)
    array([[-2.283]], dtype=float32)
    """
    of_height = np.where(phase.part == reference.part, phase.phase - reference.phase_rad, np.nan).astype(np.float32)
    return of_height if phase.by or not phase.jumps else np.angle(np.exp(1j * of_height)).astype(np.float32)


# ---- Valid pixels, accuracy, and geocoding of the heights -----------------------------------------------------------
BY_CHANCE = 1e-3
"""False alarm rate: fraction of incoherent pixels that are accepted as coherent."""

_STEPS = 30  # iterations of the fixed-point search for the pixel at which a point is imaged
_MOST_COVERED = 1.5  # largest number of pixels at which a point is imaged; 2 indicates layover
_TOLERANCE_PX = 0.05  # largest step of the search at a point that is accepted
_CONVERGED_PX = 1e-3  # step at which the search of a point ends


def least_coherence(looks: float | NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the coherence threshold at the false alarm rate `BY_CHANCE`, docs/theory/interferometry.md, eq. 7.

    Examples
    --------
    >>> least_coherence(np.array([4.0, 25.0])).round(3)
    array([0.949, 0.5  ])
    """
    return np.asarray(np.sqrt(1 - BY_CHANCE ** (1 / np.maximum(looks - 1, 1e-6))))


def phase_std(coherence: NDArray[np.floating], looks: float | NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the standard deviation of the phase, rad, docs/theory/interferometry.md, eq. 8.

    Parameters
    ----------
    coherence
        (...) float32, unbiased.
    looks
        Independent samples averaged for the phase: one number for all pixels, or one for each pixel.

    Examples
    --------
    >>> phase_std(np.array([0.9, 0.0], np.float32), 25.0).round(3)
    array([0.068, 1.814], dtype=float32)
    """
    square = np.square(coherence.astype(np.float64))
    with np.errstate(divide="ignore"):
        bound = np.sqrt((1 - square) / (2 * looks * square))
    return np.asarray(np.minimum(bound, np.pi / np.sqrt(3)), np.float32)  # π/√3 for a uniformly distributed phase


def height_sensitive(sensed: Sensitivity) -> NDArray[np.bool_]:
    """Return a mask of pixels with a height of ambiguity below the range: docs/theory/interferometry.md, section 5."""
    return np.asarray(sensed.ambiguity_m < sensed.range_m)


@dataclass(frozen=True, eq=False)
class PlacedHeights:
    """Geocoded heights.

    Attributes
    ----------
    height
        (y, x) float64, terrain height at the centre of each pixel, metres; NaN unless imaged at exactly one pixel.
    std
        (y, x) float64, standard deviation due to the scatter of phase and level, metres.
    folded
        (y, x) bool, points that these heights image at more than one pixel, due to layover or unwrapping errors.
    """

    height: Floats
    std: Floats
    folded: NDArray[np.bool_]


def place_heights(
    ground_m: Floats, rise_m: NDArray[np.floating], std_m: NDArray[np.floating], shift_px: Floats
) -> PlacedHeights:
    """Geocode heights: terrain that is higher than assumed is imaged at a displaced pixel.

    A block with a margin of the largest displacement and three pixels gives the heights of the whole raster.

    Parameters
    ----------
    ground_m
        (y, x) float64, heights assumed in image formation.
    rise_m, std_m
        (y, x), height of the terrain imaged at a pixel above the assumed height, NaN if unknown; and its
        standard deviation.
    shift_px
        (y, x, 2) float64, rows and columns from a pixel to the terrain imaged there, per metre of rise.

    Notes
    -----
    Source: docs/theory/interferometry.md, eq. 16.

    Examples
    --------
    >>> flat, rise = np.zeros((9, 9)), np.full((9, 9), 0.5)
    >>> heights = place_heights(flat, rise, 0.1 * rise, np.full((9, 9, 2), [0.0, 4.0]))
    >>> heights.height[4].round(2)
    array([nan, nan, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5])
    """
    from scipy.ndimage import distance_transform_edt, map_coordinates

    known = np.isfinite(rise_m)
    if not known.any():
        return PlacedHeights(np.full(rise_m.shape, np.nan), np.full(rise_m.shape, np.nan), known)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    # Pixel at which each point is imaged, eq. 16, by fixed-point iteration; unknown rises are set to the nearest known.
    shift = np.moveaxis(shift_px, -1, 0) * rise_m[tuple(nearest)]
    position = np.stack(np.meshgrid(*map(np.arange, rise_m.shape), indexing="ij")).astype(np.float64)
    imaged_at, error_px = position.copy(), np.full(rise_m.shape, np.inf)
    for _ in range(_STEPS):
        moving = error_px > _CONVERGED_PX
        if not moving.any():
            break
        at = imaged_at[:, moving]
        target = position[:, moving] - [map_coordinates(axis, at, order=1, mode="nearest") for axis in shift]
        error_px[moving], imaged_at[:, moving] = np.abs(target - at).max(axis=0), target
    # Points imaged at several pixels, and points without convergence, have no height.
    folds = _covered(position + shift, np.abs(_stretch(shift)) * known) > _MOST_COVERED
    converged = (error_px <= _TOLERANCE_PX) & ~folds
    height, std = (map_coordinates(values, imaged_at, order=1, cval=np.nan) for values in (ground_m + rise_m, std_m))
    folded = ~converged & np.isfinite(height)
    return PlacedHeights(np.where(converged, height, np.nan), np.where(converged, std, np.nan), folded)


def _covered(positions: Floats, area: Floats) -> Floats:
    """Return the number of pixels at which a point is imaged: mean over 3 × 3 pixels of the areas mapped to it."""
    from scipy.ndimage import uniform_filter

    inside = np.logical_and.reduce(
        [(np.round(at) >= 0) & (np.round(at) < size) for at, size in zip(positions, area.shape, strict=True)]
    )
    row, column = (np.round(at[inside]).astype(np.int64) for at in positions)
    cover = np.bincount(row * area.shape[1] + column, area[inside], minlength=area.size).reshape(area.shape)
    return np.asarray(uniform_filter(cover, 3, mode="nearest"))


def _stretch(shift: Floats) -> Floats:
    """Return the terrain area imaged at a pixel, in pixels; negative in layover."""
    size = shift.shape[1:]
    rows, columns = (
        [np.gradient(component, axis=axis) if size[axis] > 1 else np.zeros(size) for axis in (0, 1)]
        for component in shift
    )
    return np.asarray((1 + rows[0]) * (1 + columns[1]) - rows[1] * columns[0])
