"""Interferogram of two images of one scene: coherence, phase, heights, and exceeded limits."""

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
        Number of pixels visible in both images, without shadow or layover.
    coherent
        Number of common pixels with significant coherence; `sensitive` counts the common pixels with sufficient
        sensitivity to height.
    coherence, chance
        Median estimated coherence of the common pixels, and its expected value for independent images.
    overlap
        Median fraction of the image spectrum that both images sample.
    ambiguity_m
        Median height of ambiguity, metres.
    unwrapped
        Number of pixels with unwrapped phase; `apart` counts the unwrapped pixels in components without a reference
        level.
    residues, loops, jumps, by
        As in `apertura.methods.interferometry.heights.Unwrapped`.
    folded
        As in `apertura.methods.interferometry.heights.PlacedHeights`.
    points
        Number of points of known height that determine the level.
    """

    common: int
    coherent: int
    sensitive: int
    coherence: float
    chance: float
    overlap: float
    ambiguity_m: float
    unwrapped: int = 0
    apart: int = 0
    residues: int = 0
    loops: int = 0
    jumps: int = 0
    by: str = ""
    folded: int = 0
    points: int = 0


MOST_INCOHERENT = 0.5
"""Largest fraction of common pixels without significant coherence."""

MOST_RESIDUES = 1e-3
"""Largest number of residues per loop of four pixels."""

MOST_FOLDED = 0.01
"""Largest number of points imaged at several pixels, relative to the number of unwrapped pixels."""


def interferogram_flags(measured: InterferogramCounts) -> Flags:
    """Return flag → measured values for the limits that an interferogram exceeds.

    Examples
    --------
    >>> sorted(interferogram_flags(InterferogramCounts(100, 10, 100, 0.2, 0.18, 0.0, 2.0)))
    ['interferogram_decorrelated']
    """
    counts, flags = measured, Flags()
    if counts.common - counts.coherent > MOST_INCOHERENT * counts.common or not counts.common:
        no_overlap = "; the spectra of the two images do not overlap" if counts.overlap == 0 else ""
        flags["interferogram_decorrelated"] = (
            f"{counts.coherent} of {counts.common} common pixels have significant coherence; median coherence "
            f"{counts.coherence:.2f} ({counts.chance:.2f} expected for independent images), spectral overlap "
            f"{counts.overlap:.2f}{no_overlap}"
        )
    if counts.sensitive < counts.common:
        flags["height_insensitive"] = (
            f"at {counts.common - counts.sensitive} of {counts.common} pixels the height of ambiguity exceeds the "
            "range: the baseline is too short for heights"
        )
    ambiguous = []
    if counts.apart:
        ambiguous.append(
            f"{counts.apart} of {counts.unwrapped} unwrapped pixels are excluded: they lie in components without a "
            "reference level, with unknown multiples of 2π"
        )
    if counts.jumps and not counts.by:
        ambiguous.append(
            f"snaphu is not installed and the phase has {number_of(counts.jumps, 'jump')} of 2π: heights are ambiguous "
            f"by multiples of {counts.ambiguity_m:.3g} m"
        )
    if ambiguous:
        flags["height_ambiguous"] = "; ".join(ambiguous)
    inconsistent = []
    if counts.residues > MOST_RESIDUES * counts.loops:
        inconsistent.append(f"{counts.residues} phase residues in {counts.loops} loops of four pixels")
    if counts.folded > MOST_FOLDED * counts.unwrapped:
        inconsistent.append(f"{number_of(counts.folded, 'point')} imaged at several pixels and excluded")
    if inconsistent:
        flags["unwrapping_inconsistent"] = (
            f"{'; '.join(inconsistent)}: heights may have errors of multiples of {counts.ambiguity_m:.3g} m"
        )
    if counts.unwrapped and not counts.points:
        flags["height_relative"] = (
            "no point of known height is visible: heights are relative to the terrain model; their offset varies "
            "with the height of ambiguity"
        )
    return flags


# ---- Interferogram: coherence, phase, and geocoded heights ----------------------------------------------------------

LEAST_LOOKS = 4.0
"""Minimum number of looks over which the energy of a window is spread; with fewer, a point outside the centre of the
window dominates.
"""


@dataclass(frozen=True, eq=False)
class AssumedGround:
    """Terrain assumed by both images, and its properties at each pixel.

    Attributes
    ----------
    height_m
        (y, x) float64, metres.
    visible
        (y, x) bool, True for pixels visible in both images, without shadow or layover.
    sensed
        Sensitivity of the phase to height.
    shift_px
        (y, x, 2) float64, rows and columns from a pixel to the terrain imaged there, per metre of height.
    known
        Points of known height.
    track_std
        Function of the reference points of the heights that returns the standard deviation of the phase due to track
        errors, (y, x) float64 rad; None if the track errors are unknown.
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
        ``phase``, ``coherence`` and ``unwrapped`` at image pixels, ``height`` and ``height_std`` at the position of the
        terrain: (y, x) float32, NaN where not valid.
    looks
        Independent samples of a window; NaN without valid pixels.
    measured
        Counts for the flags.
    level
        Reference of the heights, and the constant removed from the phase; None if there is no valid pixel.
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
    """Form the interferogram of two images on one grid.

    Parameters
    ----------
    first, second, tiles, window
        As for `apertura.methods.interferometry.coherence.map_coherence`.
    ground
        Terrain assumed by both images.

    Notes
    -----
    Source: docs/theory/interferometry.md.

    Examples
    --------
    Two copies of an image are coherent everywhere, and their phase is insensitive to height.

    >>> generator, one = np.random.default_rng(0), np.ones((32, 32))
    >>> image = (generator.normal(size=(32, 32)) + 1j * generator.normal(size=(32, 32))).astype(np.complex64)
    >>> same = Sensitivity(0 * one, 0 * one, np.zeros((32, 32, 2)), one, 30 * one)
    >>> flat = AssumedGround(0 * one, one > 0, same, np.zeros((32, 32, 2)))
    >>> own = form_interferogram(image, image, flat, [(slice(0, 32), slice(0, 32))], window=5)
    >>> own.measured.coherent, own.measured.sensitive, bool(np.isnan(own.panels["height"]).all())
    (1024, 0, True)
    """
    # Coherence, phase and looks of every window (eqs. 2 to 6), and the pixels whose phase determines a height.
    magnitude, phase, looks, shared = map_coherence(first, second, tiles, window=window)
    common = ground.visible & np.isfinite(magnitude)
    enough = looks > 1  # for a single look, the coherence of any two images is 1
    energy = looks * shared.astype(np.float64)  # looks over which the energy of the window is spread
    dominated = energy < LEAST_LOOKS
    valid = (
        common & ~dominated & height_valid(ground.sensed, magnitude, looks) if enough else np.zeros(common.shape, bool)
    )
    # Phase about its mean, unwrapped.
    centre = float(np.angle(np.exp(1j * phase[valid].astype(np.float64)).sum())) if valid.any() else 0.0
    centred = np.where(valid, np.angle(np.exp(1j * (phase - centre))), np.nan).astype(np.float32)
    unwrapped = unwrap(centred, magnitude, looks=looks)
    effective_looks = np.minimum(looks, 2 * energy)
    # Phase constant between the images from points of known height (eq. 15), otherwise from the median.
    known = [
        replace(
            point,
            measured_rad=float(phase[point.row, point.column]) - centre,
            # decorrelation about a point is spread over all looks of the window, one of which contains the point; the
            # point response lies at the centre of the window and is not truncated
            std_rad=float(phase_std(unbiased(magnitude[point.row, point.column], looks), looks)) / MARGIN,
        )
        for point in ground.known
        if common[point.row, point.column]
    ]
    reference = level(unwrapped, known)
    height_phase = remove_level(unwrapped, reference) if reference else np.full(common.shape, np.nan, np.float32)
    # σ_φ of eq. 8, combined with the standard deviations due to the level and the tracks; geocoded heights (eq. 16).
    scatter = phase_std(unbiased(magnitude, looks), effective_looks).astype(np.float64)
    if reference:
        scatter = np.hypot(scatter, reference.std_rad or 0.0)
    if reference and ground.track_std:
        scatter = np.hypot(scatter, ground.track_std([point for point in known if point.name in reference.points]))
    geocoded = _placed(ground, height_phase, scatter)
    panels = {
        "phase": np.where(common, phase, np.nan).astype(np.float32),
        "coherence": np.where(common, magnitude, np.nan).astype(np.float32),
        "unwrapped": height_phase,
        "height": geocoded.height.astype(np.float32),
        "height_std": geocoded.std.astype(np.float32),
    }
    coherent = magnitude > least_coherence(looks) if enough else np.zeros(common.shape, bool)
    counted = _measured(ground.sensed, common, coherent, magnitude, chance(looks) if enough else 1.0)
    return Interferogram(panels, looks, _unwrapping(counted, unwrapped, height_phase, reference, geocoded), reference)


def _placed(ground: AssumedGround, height_phase: NDArray[np.float32], phase_std_rad: Floats) -> PlacedHeights:
    """Return geocoded heights from the height phase and its standard deviation."""
    rise = ground.sensed.height(height_phase.astype(np.float64))
    std = np.full(rise.shape, np.nan)
    finite = np.isfinite(rise)
    if finite.any():
        slope = np.abs(ground.sensed.slope + 2 * ground.sensed.bend * rise)[finite]
        std[finite] = phase_std_rad[finite] / slope
    return place_heights(ground.height_m, rise, std, ground.shift_px)


def _measured(
    sensed: Sensitivity,
    common: NDArray[np.bool_],
    coherent: NDArray[np.bool_],
    magnitude: NDArray[np.float32],
    chance_level: float,
) -> InterferogramCounts:
    """Return counts and medians of the common pixels."""
    count = int(common.sum())

    def median(values: NDArray[np.floating]) -> float:
        return float(np.median(values[common])) if count else 0.0

    return InterferogramCounts(
        common=count,
        coherent=int((common & coherent).sum()),
        sensitive=int((common & height_sensitive(sensed)).sum()),
        coherence=median(magnitude),
        chance=chance_level,
        overlap=median(sensed.overlap),
        ambiguity_m=min(median(sensed.ambiguity_m), 1e9),  # JSON has no infinity
    )


def _unwrapping(
    counted: InterferogramCounts,
    phase: Unwrapped,
    height_phase: NDArray[np.float32],
    reference: Level | None,
    geocoded: PlacedHeights,
) -> InterferogramCounts:
    """Return the counts with the results of unwrapping added."""
    unwrapped, kept = int(np.isfinite(phase.phase).sum()), int(np.isfinite(height_phase).sum())
    return replace(
        counted,
        unwrapped=unwrapped,
        apart=unwrapped - kept,
        residues=phase.residues,
        loops=phase.loops,
        jumps=phase.jumps,
        by=phase.by,
        folded=geocoded.folded,
        points=len(reference.points) if reference else 0,
    )
