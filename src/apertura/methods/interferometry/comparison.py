"""Interferogram of two images of one scene: coherence, phase, heights, and exceeded limits."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.contracts import Window
from apertura.common.errors import number_of
from apertura.common.flags import Flags
from apertura.core.quality.measures import BlockRaster
from apertura.methods.interferometry.coherence import chance, energy_spread, estimate, unbiased, with_margin
from apertura.methods.interferometry.common_band import CommonBand
from apertura.methods.interferometry.heights import (
    KnownHeight,
    Level,
    height_sensitive,
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
    looks
        Median independent samples of a window of the filtered images; 0 without common pixels.
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
    looks: float
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
    >>> sorted(interferogram_flags(InterferogramCounts(100, 10, 100, 0.2, 0.18, 25.0, 0.0, 2.0)))
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

LEAST_LOOKS = 3.0
"""Minimum number of looks over which the energy of a window is spread; with fewer, a point outside the centre of the
window dominates.
"""


@dataclass(frozen=True, eq=False)
class AssumedGround:
    """Terrain assumed by both images, and its properties at each pixel.

    Attributes
    ----------
    band
        Bands of both images, with the lattice of the grid.
    sensed
        Sensitivity of the phase to height at the nodes of the lattice, (node row, node column, …).
    height_m
        Function that returns the heights of a window of the grid, (y, x) float64 metres.
    visible
        (y, x) bool, True for pixels visible in both images, without shadow or layover.
    known
        Points of known height.
    track_std
        Function of the reference points of the heights that returns the standard deviation of the phase due to track
        errors, (node row, node column) float64 rad; None if the track errors are unknown.
    """

    band: CommonBand
    sensed: Sensitivity
    height_m: Callable[[Window], Floats]
    visible: NDArray[np.bool_]
    known: Sequence[KnownHeight] = ()
    track_std: Callable[[Sequence[KnownHeight]], Floats] | None = None

    def at(self, window: Window) -> Sensitivity:
        """Return the sensitivity at the pixels of a window."""
        return self.sensed.between(self.band.lattice, window)

    def shift_px(self, window: Window) -> Floats:
        """Return rows and columns from a pixel to the terrain imaged there, per metre of height, (y, x, 2) float64."""
        shift_m = self.band.lattice.between(self.sensed.shift, window)
        return np.asarray(shift_m[..., ::-1] * [-1, 1] / self.band.spacing_m)


@dataclass(frozen=True, eq=False)
class Interferogram:
    """Coherence, phase and heights of two images.

    Attributes
    ----------
    panels
        `PANELS`: phase, coherence and unwrapped at image pixels, height and height_std at the position of the terrain;
        (y, x) float32, NaN where not valid.
    measured
        Counts for the flags.
    level
        Reference of the heights, and the constant removed from the phase; None if there is no valid pixel.
    """

    panels: Mapping[str, NDArray[np.float32]]
    measured: InterferogramCounts
    level: Level | None


def form_interferogram(
    first: BlockRaster,
    second: BlockRaster,
    ground: AssumedGround,
    tiles: Iterable[Window],
    *,
    window: int,
) -> Interferogram:
    """Form the interferogram of two images on one grid, tile by tile except for phase unwrapping.

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

    >>> from apertura.core.scene.looks import Lattice
    >>> lattice, one = Lattice.of((32, 32)), np.ones((3, 3))
    >>> track = np.linspace(-4, 4, 9)[:, None] * [1.0, 0, 0] + [0, -20.0, 20.0] + np.zeros((9, 1, 1))
    >>> nodes = np.stack(np.meshgrid([0, 4, 7.75], [7.75, 3.75, 0], [0]), axis=-1).reshape(9, 3)
    >>> band = CommonBand.of(lattice, nodes, np.eye(3), ((track, track),) * 2, (1e9 + 4e6 * np.arange(64), np.ones(64)),
    ...     spacing_m=0.25, wave_speed_m_s=3e8)
    >>> generator = np.random.default_rng(0)
    >>> image = (generator.normal(size=(32, 32)) + 1j * generator.normal(size=(32, 32))).astype(np.complex64)
    >>> insensitive = Sensitivity(0 * one, 0 * one, np.zeros((3, 3, 2)), one, 30 * one)
    >>> flat = AssumedGround(band, insensitive, lambda window: np.zeros((32, 32))[window], np.ones((32, 32), bool))
    >>> own = form_interferogram(image, image, flat, [(slice(0, 32), slice(0, 32))], window=15)
    >>> own.measured.coherent, own.measured.sensitive, bool(np.isnan(own.panels["height"]).all())
    (1024, 0, True)
    """
    tiles = list(tiles)
    planes, valid, counted = _coherence_of(first, second, ground, tiles, window)
    phase, magnitude = planes["phase"], planes["coherence"]
    # Phase about its mean, unwrapped, and its constant (eq. 15) from points of known height, otherwise the median.
    centre = float(np.angle(sum(np.exp(1j * phase[tile][valid[tile]].astype(np.float64)).sum() for tile in tiles)))
    centred = np.full(first.shape, np.nan, np.float32)
    for tile in tiles:
        about = np.angle(np.exp(1j * (phase[tile].astype(np.float64) - centre)))
        centred[tile] = np.where(valid[tile], about, np.nan)
    # The phase is a mean over the window: in a third of the window it changes by less than half a cycle.
    unwrapped = unwrap(centred, magnitude, looks=counted.looks, cell_px=(window + 1) // 3)
    known = [
        replace(
            point,
            measured_rad=float(phase[pixel]) - centre,
            # decorrelation about a point is spread over all looks of the window, one of which contains the point; the
            # point response lies at the centre of the window and is not truncated
            std_rad=float(_scatter(magnitude[pixel], looks, looks)),
        )
        for point in ground.known
        if (looks := planes["looks"][pixel := (point.row, point.column)]) > 0
    ]
    reference, folded = level(unwrapped, known), 0
    planes |= {name: np.full(first.shape, np.nan, np.float32) for name in ("unwrapped", "height", "height_std")}
    if reference:
        planes["unwrapped"] = remove_level(unwrapped, reference)
        used = [point for point in known if point.name in reference.points]
        folded = _place_heights(ground, planes, np.hypot(planes.pop("scatter"), reference.std_rad or 0.0), used, tiles)
    count, kept = (int(np.isfinite(values).sum()) for values in (unwrapped.phase, planes["unwrapped"]))
    counted = replace(
        counted,
        unwrapped=count,
        apart=count - kept,
        residues=unwrapped.residues,
        loops=unwrapped.loops,
        jumps=unwrapped.jumps,
        by=unwrapped.by,
        folded=folded,
        points=len(reference.points) if reference else 0,
    )
    return Interferogram({name: planes[name] for name in PANELS}, counted, reference)


PANELS = ("phase", "coherence", "unwrapped", "height", "height_std")
"""Rasters of an interferogram."""

Planes = dict[str, NDArray[np.float32]]


def _coherence_of(
    first: BlockRaster, second: BlockRaster, ground: AssumedGround, tiles: Sequence[Window], window: int
) -> tuple[Planes, NDArray[np.bool_], InterferogramCounts]:
    """Return coherence, phase, its deviation (eq. 8) and looks of the common band, and pixels with a valid height."""
    names = ("phase", "coherence", "scatter", "looks")
    planes: Planes = {name: np.full(first.shape, np.nan, np.float32) for name in names}
    valid, coherent_px, sensitive_px = np.zeros(first.shape, bool), 0, 0
    for tile in tiles:
        wider, inner = with_margin(tile, window // 2, first.shape)
        one, other, looks_of = ground.band.filtered(first, second, wider, window=window)
        found = (*estimate(one, other, window), looks_of, energy_spread(one, other, window))
        magnitude, phase, looks, spread = (plane[inner] for plane in found)
        sensed, energy = ground.at(tile), looks * spread  # looks over which the energy of the window is spread
        common = ground.visible[tile] & np.isfinite(magnitude)
        coherent, sensitive = common & (magnitude > least_coherence(looks)), common & height_sensitive(sensed)
        valid[tile] = coherent & sensitive & (sensed.overlap > 0) & (energy >= LEAST_LOOKS)
        coherent_px, sensitive_px = coherent_px + int(coherent.sum()), sensitive_px + int(sensitive.sum())
        scatter = _scatter(magnitude, looks, np.minimum(looks, 2 * energy))
        for plane, values in zip(planes.values(), (phase, magnitude, scatter, looks), strict=True):
            plane[tile] = np.where(common, values, np.nan)
    common = np.isfinite(planes["coherence"])
    nodes = common[np.ix_(*ground.band.lattice.nodes)]

    def median(values: NDArray[np.floating], where: NDArray[np.bool_]) -> float:
        return float(np.median(values[where])) if where.any() else 0.0

    looks_px = median(planes["looks"], common)
    return (
        planes,
        valid,
        InterferogramCounts(
            common=int(common.sum()),
            coherent=coherent_px,
            sensitive=sensitive_px,
            coherence=median(planes["coherence"], common),
            chance=chance(looks_px) if looks_px else 1.0,
            looks=looks_px,
            overlap=median(ground.sensed.overlap, nodes),
            ambiguity_m=min(median(ground.sensed.ambiguity_m, nodes), 1e9),  # JSON has no infinity
        ),
    )


def _scatter(
    magnitude: NDArray[np.floating], looks: NDArray[np.floating], averaged: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Return the standard deviation of the phase, of which `averaged` of the looks of the window contribute."""
    return phase_std(unbiased(magnitude, np.maximum(looks, 1 + 1e-6)), averaged)


def _place_heights(
    ground: AssumedGround,
    planes: Planes,
    scatter: NDArray[np.float32],
    reference: Sequence[KnownHeight],
    tiles: Sequence[Window],
) -> int:
    """Compute the planes of heights and their deviation (eqs. 8, 11 and 16); return the number of folded points."""
    lattice, shape = ground.band.lattice, scatter.shape
    track_std = ground.track_std(reference) if ground.track_std else np.zeros(lattice.shape)
    rise, std = (np.full(shape, np.nan, np.float32) for _ in range(2))
    reach_px, folded = 0.0, 0
    for tile in tiles:
        sensed = ground.at(tile)
        height = sensed.height(planes["unwrapped"][tile].astype(np.float64))
        rise[tile], slope = height, np.abs(sensed.slope + 2 * sensed.bend * height)
        std[tile] = np.hypot(scatter[tile], lattice.between(track_std, tile)) / slope
        reach_px = max(reach_px, np.nanmax(np.abs(ground.shift_px(tile) * height[..., None]), initial=0))
    for tile in tiles:
        wider, inner = with_margin(tile, int(reach_px) + 4, shape)
        geocoded = place_heights(ground.height_m(wider), rise[wider], std[wider], ground.shift_px(wider))
        planes["height"][tile], planes["height_std"][tile] = geocoded.height[inner], geocoded.std[inner]
        folded += int(geocoded.folded[inner].sum())
    return folded
