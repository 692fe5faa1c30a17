"""Interferogram of two images of one scene: coherence, phase, heights, and the limits that it exceeds."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.contracts import Window
from apertura.common.errors import number_of
from apertura.common.flags import Flags
from apertura.methods.interferometry.coherence import chance, map_coherence, unbiased
from apertura.methods.interferometry.heights import (
    MARGIN,
    KnownHeight,
    Level,
    PlacedHeights,
    Unwrapped,
    height_sensitive,
    height_valid,
    least_coherence,
    level,
    phase_std,
    place_heights,
    remove_level,
    unwrap,
)
from apertura.methods.interferometry.sensitivity import Sensitivity

# ---- Limits of the method and their flags ---------------------------------------------------------------------------


@dataclass(frozen=True)
class InterferogramCounts:
    """Counts and medians of one interferogram.

    Attributes
    ----------
    common
        Pixels visible to both images, without shadow or layover.
    coherent
        Of them, those more coherent than chance; `sensitive`: those whose phase a height turns enough.
    coherence, chance
        Median of the common pixels as measured, and the mean where there is none.
    overlap
        Median share of the spectrum that both images sample.
    ambiguity_m
        Median height of one turn, metres.
    told
        Pixels whose phase was unwrapped; `apart`: those of them in parts without a level.
    residues, loops, jumps, by
        As of `apertura.methods.interferometry.heights.Unwrapped`.
    folded
        As of `apertura.methods.interferometry.heights.PlacedHeights`.
    points
        Points of known height that give the level.
    """

    common: int
    coherent: int
    sensitive: int
    coherence: float
    chance: float
    overlap: float
    ambiguity_m: float
    told: int = 0
    apart: int = 0
    residues: int = 0
    loops: int = 0
    jumps: int = 0
    by: str = ""
    folded: int = 0
    points: int = 0


MOST_INCOHERENT = 0.5
"""Share of the common pixels that may be no more coherent than chance: more is flagged."""

MOST_RESIDUES = 1e-3
"""Residues per loop of four pixels: more is flagged."""

MOST_FOLDED = 0.01
"""Share of the unwrapped pixels whose places several pixels show: more is flagged."""


def interferogram_flags(measured: InterferogramCounts) -> Flags:
    """Return the limits that an interferogram exceeds: flag → what was measured.

    Examples
    --------
    >>> sorted(interferogram_flags(InterferogramCounts(100, 10, 100, 0.2, 0.18, 0.0, 2.0)))
    ['interferogram_decorrelated']
    """
    one, flags = measured, Flags()
    if one.common - one.coherent > MOST_INCOHERENT * one.common or not one.common:
        beyond = ": the tracks lie further apart than any coherence reaches" if one.overlap == 0 else ""
        flags["interferogram_decorrelated"] = (
            f"{one.coherent} of {one.common} pixels visible to both are more coherent than chance; in the median "
            f"coherence is {one.coherence:.2f} where chance makes {one.chance:.2f} and geometry leaves "
            f"{one.overlap:.2f} of the spectrum in common{beyond}"
        )
    if one.sensitive < one.common:
        flags["height_insensitive"] = (
            f"at {one.common - one.sensitive} of {one.common} pixels one turn of the phase is more height than the "
            "range is long: the tracks lie too close together for a height"
        )
    ambiguous = []
    if one.apart:
        ambiguous.append(f"{one.apart} of {one.told} pixels lie in parts apart, whole turns from the others: left out")
    if one.jumps and not one.by:
        ambiguous.append(
            f"snaphu is not installed and the phase jumps by a turn at {number_of(one.jumps, 'place')}: heights are "
            f"known up to multiples of {one.ambiguity_m:.3g} m"
        )
    if ambiguous:
        flags["height_ambiguous"] = "; ".join(ambiguous)
    inconsistent = []
    if one.residues > MOST_RESIDUES * one.loops:
        inconsistent.append(f"around {one.residues} of {one.loops} loops of four pixels the phase does not come back")
    if one.folded > MOST_FOLDED * one.told:
        inconsistent.append(f"places shown by several pixels are left out: {one.folded}")
    if inconsistent:
        flags["unwrapping_inconsistent"] = (
            f"{'; '.join(inconsistent)}: heights may err by multiples of {one.ambiguity_m:.3g} m"
        )
    if one.told and not one.points:
        flags["height_relative"] = (
            "no point of known height shows: the median of the phase is taken for the height that the terrain has, and "
            "an error of it is another height wherever one turn is another height"
        )
    return flags


# ---- Interferogram: coherence, phase, and heights at their own places -----------------------------------------------

LEAST_LOOKS = 4.0
"""Looks that a window's energy must be spread over: with fewer a point beside its middle decides its phase."""


@dataclass(frozen=True, eq=False)
class AssumedGround:
    """Ground that both images assume at each pixel.

    Attributes
    ----------
    height_m
        (y, x) float64, metres.
    visible
        (y, x) bool, visible to both images, without shadow or layover.
    sensed
        Of the phase to height there.
    shift_px
        (y, x, 2) float64, rows and columns from a pixel to the ground it shows, per metre of height.
    known
        Points of known height.
    track_std
        From the points that heights count from to the deviation of the phase by errors of the tracks, (y, x) float64
        rad; None where nobody knows these.
    """

    height_m: Floats
    visible: NDArray[np.bool_]
    sensed: Sensitivity
    shift_px: Floats
    known: Sequence[KnownHeight] = ()
    track_std: Callable[[Sequence[KnownHeight]], Floats] | None = None


@dataclass(frozen=True, eq=False)
class Interferogram:
    """Coherence, phase and heights of two images.

    Attributes
    ----------
    panels
        ``phase``, ``coherence`` and ``unwrapped`` where the images show it, ``height`` and ``height_std`` where the
        ground lies: (y, x) float32, NaN where they are not valid.
    looks
        Independent samples of a window; NaN where there is none.
    measured
        Counts that decide on the flags.
    level
        Reference of the heights, and the constant removed from the phase; None without a valid pixel.
    """

    panels: Mapping[str, NDArray[np.float32]]
    looks: float
    measured: InterferogramCounts
    level: Level | None


def form_interferogram(
    first: NDArray[np.complex64],
    second: NDArray[np.complex64],
    ground: AssumedGround,
    tiles: Iterable[Window],
    *,
    window: int,
) -> Interferogram:
    """Return the interferogram of two images on one grid.

    Parameters
    ----------
    first, second, tiles, window
        As of `apertura.methods.interferometry.coherence.map_coherence`.
    ground
        Assumed by both.

    Notes
    -----
    Source: docs/theory/interferometry.md.

    Examples
    --------
    An image against itself: coherent everywhere, and its phase is insensitive to height.

    >>> generator, one = np.random.default_rng(0), np.ones((32, 32))
    >>> image = (generator.normal(size=(32, 32)) + 1j * generator.normal(size=(32, 32))).astype(np.complex64)
    >>> same = Sensitivity(0 * one, 0 * one, np.zeros((32, 32, 2)), one, 30 * one)
    >>> flat = AssumedGround(0 * one, one > 0, same, np.zeros((32, 32, 2)))
    >>> own = form_interferogram(image, image, flat, [(slice(0, 32), slice(0, 32))], window=5)
    >>> own.measured.coherent, own.measured.sensitive, bool(np.isnan(own.panels["height"]).all())
    (1024, 0, True)
    """
    # Coherence, phase and looks of every window (eqs. 2 to 6); pixels whose phase gives a height.
    magnitude, phase, looks, shared = map_coherence(first, second, tiles, window=window)
    common = ground.visible & np.isfinite(magnitude)
    enough = looks > 1  # coherence of a single look is 1 whatever the images hold
    energy = looks * shared.astype(np.float64)  # looks that the window's energy is spread over
    dominated = energy < LEAST_LOOKS
    valid = (
        common & ~dominated & height_valid(ground.sensed, magnitude, looks) if enough else np.zeros(common.shape, bool)
    )
    # Phase about its mean, unwrapped.
    centre = float(np.angle(np.exp(1j * phase[valid].astype(np.float64)).sum())) if valid.any() else 0.0
    centred = np.where(valid, np.angle(np.exp(1j * (phase - centre))), np.nan).astype(np.float32)
    unwrapped = unwrap(centred, magnitude, looks=looks)
    effective_looks = np.minimum(looks, 2 * energy)
    # The constant between both images by points of known height (eq. 15), else by the median.
    known = [
        replace(
            one,
            measured_rad=float(phase[one.row, one.column]) - centre,
            # what decorrelates a window about a point is spread over all its looks, of which the point takes one; the
            # window does not cut the response in its middle
            std_rad=float(phase_std(unbiased(magnitude[one.row, one.column], looks), looks)) / MARGIN,
        )
        for one in ground.known
        if common[one.row, one.column]
    ]
    reference = level(unwrapped, known)
    alone = remove_level(unwrapped, reference) if reference else np.full(common.shape, np.nan, np.float32)
    # σ_φ of eq. 8, with the level's and the tracks' own deviations; heights at the places they belong to (eq. 16).
    scatter = phase_std(unbiased(magnitude, looks), effective_looks).astype(np.float64)
    if reference:
        scatter = np.hypot(scatter, reference.std_rad or 0.0)
    if reference and ground.track_std:
        scatter = np.hypot(scatter, ground.track_std([one for one in known if one.name in reference.points]))
    at_place = _placed(ground, alone, scatter)
    panels = {
        "phase": np.where(common, phase, np.nan).astype(np.float32),
        "coherence": np.where(common, magnitude, np.nan).astype(np.float32),
        "unwrapped": alone,
        "height": at_place.height.astype(np.float32),
        "height_std": at_place.std.astype(np.float32),
    }
    coherent = magnitude > least_coherence(looks) if enough else np.zeros(common.shape, bool)
    counted = _measured(ground.sensed, common, coherent, magnitude, chance(looks) if enough else 1.0)
    return Interferogram(panels, looks, _unwrapping(counted, unwrapped, alone, reference, at_place), reference)


def _placed(ground: AssumedGround, alone: NDArray[np.float32], phase_std_rad: Floats) -> PlacedHeights:
    """Return heights at their own places from the phase due to height and its deviation."""
    rise = ground.sensed.height(alone.astype(np.float64))
    std = np.full(rise.shape, np.nan)
    there = np.isfinite(rise)
    if there.any():
        steep = np.abs(ground.sensed.slope + 2 * ground.sensed.bend * rise)[there]
        std[there] = phase_std_rad[there] / steep
    return place_heights(ground.height_m, rise, std, ground.shift_px)


def _measured(
    sensed: Sensitivity,
    common: NDArray[np.bool_],
    coherent: NDArray[np.bool_],
    magnitude: NDArray[np.float32],
    by_chance: float,
) -> InterferogramCounts:
    """Return counts and medians of the pixels visible to both images."""
    count = int(common.sum())

    def middle(values: NDArray[np.floating]) -> float:
        return float(np.median(values[common])) if count else 0.0

    return InterferogramCounts(
        common=count,
        coherent=int((common & coherent).sum()),
        sensitive=int((common & height_sensitive(sensed)).sum()),
        coherence=middle(magnitude),
        chance=by_chance,
        overlap=middle(sensed.overlap),
        ambiguity_m=min(middle(sensed.ambiguity_m), 1e9),  # JSON has no infinity
    )


def _unwrapping(
    counted: InterferogramCounts,
    phase: Unwrapped,
    alone: NDArray[np.float32],
    reference: Level | None,
    at_place: PlacedHeights,
) -> InterferogramCounts:
    """Return the counts completed by those of unwrapping."""
    unwrapped, kept = int(np.isfinite(phase.phase).sum()), int(np.isfinite(alone).sum())
    return replace(
        counted,
        told=unwrapped,
        apart=unwrapped - kept,
        residues=phase.residues,
        loops=phase.loops,
        jumps=phase.jumps,
        by=phase.by,
        folded=at_place.folded,
        points=len(reference.points) if reference else 0,
    )
