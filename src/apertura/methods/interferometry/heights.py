"""From phase to height: unwrapping, reference level, valid pixels, accuracy, and the places of the heights."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.methods.interferometry.sensitivity import Sensitivity

# ---- Unwrapping and residues ----------------------------------------------------------------------------------------

_LEAST_SHARE = 0.01  # of all pixels, least size of a connected part: snaphu's default


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """Phase without jumps of a turn, part by part.

    Attributes
    ----------
    phase
        (y, x) float32, rad; NaN where it is not valid.
    part
        (y, x) uint32, 0 outside; between two parts any number of turns may lie.
    by
        The library and its version; empty: not unwrapped, the phase is within half a turn of its reference.
    residues
        Loops of four pixels around which the wrapped phase does not come back to itself.
    loops
        Loops of four valid pixels.
    jumps
        Neighbours whose wrapped phases lie more than half a turn apart: turns that unwrapping must decide on.
    """

    phase: NDArray[np.float32]
    part: NDArray[np.uint32]
    by: str
    residues: int
    loops: int
    jumps: int


def unwrap(phase: NDArray[np.float32], coherence: NDArray[np.float32], *, looks: float) -> Unwrapped:
    """Return the phase unwrapped by snaphu, where that is installed; else as it is, within a turn.

    Parameters
    ----------
    phase
        (y, x) float32, rad, NaN where it is not valid.
    coherence
        (y, x) float32, 0 to 1.
    looks
        Independent samples that one phase is the mean of.

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

    wrapped = np.where(valid, np.exp(1j * np.where(valid, phase, 0)), 0).astype(np.complex64)
    weight = np.where(valid, coherence, 0).astype(np.float32)
    whole, part = snaphu.unwrap(
        wrapped, weight, max(1.0, looks), cost="smooth", mask=valid, min_conncomp_frac=_LEAST_SHARE
    )
    known = valid & (part > 0)
    # its own phase is rounded: whole turns are taken from it, and the phase that was measured stays
    turns = np.round((np.where(known, whole, 0) - np.where(known, phase, 0)) / (2 * np.pi))
    return Unwrapped(
        np.where(known, phase + 2 * np.pi * turns, np.nan).astype(np.float32),
        np.where(known, part, 0).astype(np.uint32),
        by,
        residues,
        loops,
        jumps,
    )


def count_residues(phase: NDArray[np.float32]) -> tuple[int, int, int]:
    """Return residues, loops of four valid pixels, and neighbours more than half a turn apart.

    Examples
    --------
    >>> count_residues(np.array([[0.0, 2.0], [-2.0, 4.0]], np.float32))
    (1, 1, 1)
    """
    down, right = np.diff(phase, axis=0), np.diff(phase, axis=1)
    turns_down, turns_right = (np.round(difference / (2 * np.pi)) for difference in (down, right))
    # Whole turns around each loop of four pixels.
    around = turns_right[:-1] + turns_down[:, 1:] - turns_right[1:] - turns_down[:, :-1]
    there = np.isfinite(around)
    jumps = sum(int(np.count_nonzero(turns[np.isfinite(turns)])) for turns in (turns_down, turns_right))
    return int(np.count_nonzero(around[there])), int(there.sum()), jumps


def _library() -> str:
    """Return name and version of the library that unwraps; nothing where it is not installed."""
    try:
        return f"snaphu {version('snaphu')}"
    except PackageNotFoundError:
        return ""


# ---- Reference level: the constant phase between two images is arbitrary --------------------------------------------


@dataclass(frozen=True)
class KnownHeight:
    """A point of known height, where the images show it.

    Attributes
    ----------
    name
        What it is called.
    row, column
        The pixel nearest to where it shows.
    phase_rad
        The phase due to its height there.
    measured_rad
        The phase that is measured there, within a turn; NaN where none is.
    std_rad
        Its standard deviation.
    """

    name: str
    row: int
    column: int
    phase_rad: float
    measured_rad: float = float("nan")
    std_rad: float = 0.0


@dataclass(frozen=True)
class Level:
    """The constant removed from the phase, the level that heights count from.

    Attributes
    ----------
    phase_rad
        The constant.
    part
        The part of the unwrapped phase that it holds for; heights of others are unknown by whole turns.
    points
        The points of known height that give it; none: the median of the phase does.
    spread_rad
        Largest distance of such a point from the constant; None of fewer than two.
    std_rad
        Standard deviation of the constant: one error that all heights share; None without points, where it is unknown.
    """

    phase_rad: float
    part: int
    points: tuple[str, ...] = ()
    spread_rad: float | None = None
    std_rad: float | None = None


def level(phase: Unwrapped, known: Sequence[KnownHeight]) -> Level | None:
    """Return the constant between two images, docs/theory/interferometry.md, eq. 15; None where no phase is valid.

    Parameters
    ----------
    phase
        Unwrapped.
    known
        Points of known height; those whose own phase is not known do not count.

    Examples
    --------
    >>> phase = np.array([[0.1, 0.2, 0.6]], np.float32)
    >>> unwrapped = Unwrapped(phase, np.ones((1, 3), np.uint32), "", 0, 0, 0)
    >>> level(unwrapped, []).phase_rad, round(level(unwrapped, [KnownHeight("mast", 0, 2, 0.5, 0.7)]).phase_rad, 3)
    (0.2, 0.2)
    """
    valid = np.argwhere(np.isfinite(phase.phase) & (phase.part > 0))
    if not len(valid):
        return None
    measured = [(one, *_unwrapped(one, phase, valid)) for one in known if np.isfinite(one.measured_rad)]
    if not measured:
        sizes = np.bincount(phase.part[tuple(valid.T)])
        part = int(np.argmax(sizes[1:])) + 1
        return Level(round(float(np.median(phase.phase[phase.part == part])), 6), part)
    parts = [part for *_, part in measured]
    part = max(sorted(set(parts)), key=parts.count)
    constants = {one.name: value - one.phase_rad for one, value, of in measured if of == part}
    constant = float(np.median(list(constants.values())))
    spread = max(abs(value - constant) for value in constants.values()) if len(constants) > 1 else None
    std = _level_std(list(constants.values()), [one.std_rad for one, _, of in measured if of == part])
    return Level(round(constant, 6), part, tuple(constants), spread, round(std, 6))


def _level_std(constants: Sequence[float], stds: Sequence[float]) -> float:
    """Return the standard deviation of the median of some constants: by their own deviations, or by their scatter.

    Source: docs/theory/interferometry.md, eq. 15a.
    """
    count = len(constants)
    by_points = float(np.sqrt(np.square(stds).sum())) / count
    by_scatter = float(np.std(constants, ddof=1)) / np.sqrt(count) if count > 1 else 0.0
    return float(max(by_points, by_scatter) * (np.sqrt(np.pi / 2) if count > 2 else 1.0))


def _unwrapped(one: KnownHeight, phase: Unwrapped, valid: NDArray[np.int64]) -> tuple[float, int]:
    """Return the phase measured at a point, by the turns and in the part of the valid pixel nearest to it."""
    near = tuple(valid[np.argmin(((valid - (one.row, one.column)) ** 2).sum(axis=1))])
    turns = np.round((float(phase.phase[near]) - one.measured_rad) / (2 * np.pi))
    return float(one.measured_rad + 2 * np.pi * turns), int(phase.part[near])


def remove_level(phase: Unwrapped, reference: Level) -> NDArray[np.float32]:
    """Return the phase due to height, (y, x) float32 rad: of one part, within half a turn if not unwrapped.

    Examples
    --------
    >>> phase = Unwrapped(np.array([[3.0]], np.float32), np.ones((1, 1), np.uint32), "", 0, 0, 1)
    >>> remove_level(phase, Level(-1.0, 1)).round(3)
    array([[-2.283]], dtype=float32)
    """
    of_height = np.where(phase.part == reference.part, phase.phase - reference.phase_rad, np.nan).astype(np.float32)
    return of_height if phase.by or not phase.jumps else np.angle(np.exp(1j * of_height)).astype(np.float32)


# ---- Valid pixels, accuracy, and places of the heights --------------------------------------------------------------
BY_CHANCE = 1e-3
"""False alarm rate: share of incoherent pixels that still count as coherent."""

MARGIN = 1.4
"""Factor on the Cramér-Rao bound of the phase: simulated ground scatters at most so much more."""


_STEPS = 30  # of the fixed-point search for the pixel that shows a place
_MOST_COVERED = 1.5  # pixels that may show one place: 2 mean layover
_TOLERANCE_PX = 0.05  # tolerance of that search


def least_coherence(looks: float) -> float:
    """Return the coherence that `BY_CHANCE` of pixels reach where there is none, docs/theory/interferometry.md, eq. 7.

    Examples
    --------
    >>> [round(least_coherence(looks), 3) for looks in (4.0, 25.0)]
    [0.949, 0.5]
    """
    return float(np.sqrt(1 - BY_CHANCE ** (1 / max(looks - 1, 1e-6))))


def phase_std(coherence: NDArray[np.float32], looks: float | NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the standard deviation of the phase, rad, docs/theory/interferometry.md, eq. 8.

    Parameters
    ----------
    coherence
        (...) float32, without what chance adds to it.
    looks
        Independent samples that the phase is the mean of, of all or of each.

    Examples
    --------
    >>> phase_std(np.array([0.9, 0.0], np.float32), 25.0).round(3)
    array([0.096, 1.814], dtype=float32)
    """
    square = np.square(coherence.astype(np.float64))
    with np.errstate(divide="ignore"):
        bound = MARGIN * np.sqrt((1 - square) / (2 * looks * square))
    return np.asarray(np.minimum(bound, np.pi / np.sqrt(3)), np.float32)  # that of any phase at all


def height_valid(sensed: Sensitivity, coherence: NDArray[np.float32], looks: float) -> NDArray[np.bool_]:
    """Return a mask of the pixels that give a height: coherent beyond chance, and sensitive enough to height.

    Parameters
    ----------
    sensed
        At the pixels.
    coherence
        (...) float32, as measured.
    looks
        As of `phase_std`.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray(height_sensitive(sensed) & (sensed.overlap > 0) & (coherence > least_coherence(looks)))


def height_sensitive(sensed: Sensitivity) -> NDArray[np.bool_]:
    """Return a mask of a height of ambiguity below the height range: docs/theory/interferometry.md, section 5."""
    return np.asarray(sensed.ambiguity_m < sensed.range_m)


@dataclass(frozen=True, eq=False)
class PlacedHeights:
    """Heights at their own places.

    Attributes
    ----------
    height
        (y, x) float64, metres, of the ground at the middle of each pixel; NaN where no pixel shows it, or several do.
    std
        (y, x) float64, metres, by the phase's scatter and by that of the level.
    folded
        Places that more than one pixel shows by these heights: layover, or errors of unwrapping by whole turns.
    """

    height: Floats
    std: Floats
    folded: int


def place_heights(ground_m: Floats, rise_m: Floats, std_m: Floats, shift_px: Floats) -> PlacedHeights:
    """Return heights at the places that they belong to: ground that is higher than assumed shows where it is not.

    Parameters
    ----------
    ground_m
        (y, x) float64, heights that the images assume.
    rise_m, std_m
        (y, x) float64, how much higher the ground shown by a pixel is, NaN where that is not known; its deviation.
    shift_px
        (y, x, 2) float64, rows and columns from a pixel to the ground it shows, per metre of rise.

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
        return PlacedHeights(np.full(rise_m.shape, np.nan), np.full(rise_m.shape, np.nan), 0)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    # The pixel that shows each place, eq. 16, by fixed-point iteration.
    moved = np.moveaxis(shift_px, -1, 0) * rise_m[tuple(nearest)]  # a pixel beside all that are known leads on to them
    place = np.stack(np.meshgrid(*map(np.arange, rise_m.shape), indexing="ij")).astype(np.float64)
    shown, error_px = place, np.full(rise_m.shape, np.inf)
    for _ in range(_STEPS):
        target = place - [map_coordinates(one, shown, order=1, mode="nearest") for one in moved]
        error_px, shown = np.abs(target - shown).max(axis=0), target
        if not (error_px > _TOLERANCE_PX).any():
            break
    # Places that several pixels show, and places where the iteration has not converged, have no height.
    folds = _covered(place + moved, np.abs(_stretch(moved)) * known) > _MOST_COVERED
    converged = (error_px <= _TOLERANCE_PX) & ~folds
    height, std = (map_coordinates(one, shown, order=1, cval=np.nan) for one in (ground_m + rise_m, std_m))
    folded = int(((error_px > _TOLERANCE_PX) | folds)[np.isfinite(height)].sum())
    return PlacedHeights(np.where(converged, height, np.nan), np.where(converged, std, np.nan), folded)


def _covered(to: Floats, area: Floats) -> Floats:
    """Return the cover of each place: the mean over 3 × 3 of the areas of the pixels that show it."""
    from scipy.ndimage import uniform_filter

    inside = np.logical_and.reduce(
        [(np.round(at) >= 0) & (np.round(at) < size) for at, size in zip(to, area.shape, strict=True)]
    )
    row, column = (np.round(at[inside]).astype(np.int64) for at in to)
    cover = np.bincount(row * area.shape[1] + column, area[inside], minlength=area.size).reshape(area.shape)
    return np.asarray(uniform_filter(cover, 3, mode="nearest"))


def _stretch(moved: Floats) -> Floats:
    """Return the area of ground that a pixel shows, in pixels: negative where it is folded over."""
    size = moved.shape[1:]
    rows, columns = (
        [np.gradient(one, axis=axis) if size[axis] > 1 else np.zeros(size) for axis in (0, 1)] for one in moved
    )
    return np.asarray((1 + rows[0]) * (1 + columns[1]) - rows[1] * columns[0])
