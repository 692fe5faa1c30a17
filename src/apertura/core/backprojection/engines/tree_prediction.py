"""Prediction of error, directly summed fraction, and cost of trees (docs/theory/tree.md, "Error" and "Cost").

The library computes the bands for a sample of tiles and pulse chunks of the job. The bands determine the numbers of
nodes and virtual pulses for every tolerated error. These numbers determine the predicted error and cost.
"""

import ctypes
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.common.units import decibels
from apertura.core.backprojection.engines import native
from apertura.core.backprojection.engines.engine import Setting, option_values, power_sum_db
from apertura.core.backprojection.engines.native_binding import (
    BY_TREE,
    DIRECTLY,
    NO_ECHO,
    TREE,
    TreeJob,
    TreeTile,
    call,
)
from apertura.core.backprojection.engines.tree_geometry import (
    DEGREES,
    LEAF,
    MOST_LAYERS,
    Surface,
    SurfaceResidual,
    layers_for,
    leaf_roughness,
    leaves_of,
    nodes_for,
    subaperture_sizes,
    surfaces_of,
)
from apertura.core.backprojection.engines.tree_inputs import (
    LEAST_QUARTER_PX,
    cells,
    cells_per_sample,
    direct_setting,
    roughness,
    weighed,
)
from apertura.core.backprojection.job import Job
from apertura.core.geometry.aperture import Aperture

# ---- Geometry of tiles and pulse chunks: numbers of nodes and virtual pulses


@dataclass(frozen=True, eq=False)
class TileView:
    """Imaging geometry of one tile and one pulse chunk.

    Attributes
    ----------
    bands_rad
        (2,) float for each level, half width of the band along columns and rows, rad per half tile.
    turn_rad
        Largest change of the carrier phase, relative to the phase at the tile centre, within half a leaf, rad.
    rough_rad
        (curve,) float64, RMS phase of deviations from curves of increasing degree, eq. 8b, rad.
    span_m
        Total path across the tile, metres.
    phase_rad
        RMS phase of the points of the tile relative to the tile centre, rad.
    """

    bands_rad: tuple[NDArray[np.floating], ...]
    turn_rad: float
    rough_rad: NDArray[np.float64]
    span_m: float
    phase_rad: float


def view_of_tile(
    aperture: Aperture, surface: Surface, sizes: tuple[int, ...], *, wavenumber_rad_m: float, band_rad_m: float
) -> TileView:
    """Return the geometry of one tile and one pulse chunk, as used in the plan of the library.

    Parameters
    ----------
    aperture
        Aperture of the chunk.
    surface
        Surface of the tile.
    sizes
        Number of pulses of the subapertures of each level.
    wavenumber_rad_m, band_rad_m
        2πf_mid/c and πB/c.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 4, 8 and 8b; native/tree_view.cpp. The first, middle and last subapertures of each
    level, and the first, middle and last leaves, are evaluated.
    """
    pulses, counts = len(aperture), [-(-len(aperture) // size) for size in sizes]
    tx, rx = (np.ascontiguousarray(leg, np.float64) for leg in aperture.legs)
    coefficients = np.ascontiguousarray(surface.coefficients)
    band, turn = np.zeros((sum(counts), 2), np.float32), np.zeros((-(-pulses // LEAF), 2), np.float32)
    variant, no_residual = np.full(len(turn), BY_TREE, np.uint8), np.zeros(len(turn), np.float32)
    tile = TreeTile(
        surface=coefficients.ctypes.data,
        variant=variant.ctypes.data,
        band=band.ctypes.data,
        turn=turn.ctypes.data,
        degree=len(coefficients) - 1,
    )
    tile.centre[:] = surface.centre_m.tolist()
    job = TreeJob(
        transmitter=tx.ctypes.data,
        receiver=rx.ctypes.data,
        max_track_residual=no_residual.ctypes.data,
        tiles=ctypes.addressof(tile),
        pulses=pulses,
        count=1,
        levels=len(sizes),
        wavenumber=wavenumber_rad_m,
        band=band_rad_m,
    )
    job.sizes[: len(sizes)] = sizes
    call("apertura_view_tree", job)
    bands = tuple(_widest_of_three(level) for level in np.split(band, np.cumsum(counts)[:-1]))
    turn_rad, residual_rad_m = _widest_of_three(turn[: max(1, pulses // LEAF)]).tolist()  # of complete leaves only
    phase_rad = wavenumber_rad_m * tile.slope_rms / np.sqrt(3)
    return TileView(bands, turn_rad, residual_rad_m * _roughest_m(aperture), tile.span, float(phase_rad))


def _widest_of_three(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the largest value in the first, middle and last rows, (column,)."""
    return np.asarray(values[np.unique(np.linspace(0, len(values) - 1, 3).astype(int))].max(axis=0))


@lru_cache(maxsize=64)
def _roughest_m(aperture: Aperture) -> NDArray[np.float64]:
    """Return the largest deviation, (curve,) metres, of a leaf from curves of increasing degree."""
    return np.asarray(leaf_roughness(*(leaves_of(leg) for leg in aperture.legs)).max(axis=0))


def widened_rad(slope: float, band_rad: NDArray[np.floating], nodes_db: float) -> NDArray[np.floating]:
    """Return the widening of bands by the edge of a sector, rad, as in native/tree_weight.hpp.

    Parameters
    ----------
    slope
        Change of the depth in the edge per half tile.
    band_rad
        Band without the effect of the edge, rad per half tile.
    nodes_db
        Tolerated error ε of one interpolation, dB.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 13.

    Examples
    --------
    >>> widened_rad(0.77, np.array([15.0]), -74).round(1)
    array([20.3])
    """
    content = np.maximum(band_rad, 1.0) * 10 ** (nodes_db / 10)
    return np.asarray(np.maximum(TREE.weighted_rad, slope * (9 / (10 * np.pi) / content) ** 0.25))


class Counts(NamedTuple):
    """Numbers of nodes and virtual pulses of one tile and one chunk.

    Attributes
    ----------
    nodes
        (2,) numbers of nodes along columns and rows for each level below the first level that requires too many nodes;
        empty if no tree is possible.
    virtual
        Number of virtual pulses of a leaf; 0 if the leaf is not presummed.
    presum_rad
        RMS phase error due to presumming, rad.
    """

    nodes: tuple[tuple[int, int], ...]
    virtual: int
    presum_rad: float


def counts_of(
    view: TileView,
    *,
    nodes_db: int,
    presum_db: float,
    weighted: bool,
    slope: NDArray[np.floating] | None = None,
    each: bool = False,
) -> Counts:
    """Return the numbers of nodes at each level, and the number of virtual pulses of a leaf.

    Parameters
    ----------
    view
        Geometry of the tile.
    nodes_db, presum_db
        Tolerated errors, dB.
    weighted
        True if pulses have antenna weights.
    slope
        (3,) slope of the depth in the edge of a sector, as in `Weighed.slope`; None inside the sector.
    each
        True if the pulses of a leaf are summed individually.
    """

    def count(band_rad: float, axis: int) -> int:
        """Return the number of nodes along ξ (0), along η (1) or over the pulses of a leaf (2), including weights."""
        band_rad += TREE.weighted_rad if weighted else 0.0
        widening = 0.0 if slope is None else float(widened_rad(slope[axis], np.array(band_rad), nodes_db))
        return int(nodes_for(np.array([band_rad + widening]), nodes_db)[0])

    levels: list[tuple[int, int]] = []
    for band in view.bands_rad:
        along, across = (count(float(rad), axis) for axis, rad in enumerate(band))
        if max(along, across) > TREE.nodes:
            break
        levels.append((along, across))
    # Eq. 8b: lowest degree with a sufficiently small deviation; eq. 8: nodes for the carrier, and margin.
    smooth = np.flatnonzero(view.rough_rad <= 10 ** (presum_db / 20))
    if len(smooth) and not each:
        virtual = max(DEGREES[smooth[0]] + TREE.virtual_margin, count(view.turn_rad, 2))
        if virtual <= TREE.virtual:
            number = np.searchsorted(DEGREES, virtual - TREE.virtual_margin, "right") - 1
            return Counts(tuple(levels), virtual, float(view.rough_rad[number]))
    return Counts(tuple(levels), 0, 0.0)


# ---- Sample of tiles and chunks

_TILES, _CHUNKS = 5, 3  # numbers of tiles and chunks sampled for a prediction
_GROUPS = 96  # number of groups of 64 pulses sampled for the weights over a tile


class SampledTile(NamedTuple):
    """Tile with the geometry for sampled pulse chunks; without geometry if a pixel has no position.

    Attributes
    ----------
    surface, views
        Surface of the tile, and geometry for each chunk.
    rough
        Relative mean squared error from pixels off the surface.
    layers_rad, aside_rad
        Band along the direction of heights, and phase of deviations perpendicular to this direction, rad.
    """

    surface: Surface
    views: tuple[TileView, ...] = ()
    rough: float = np.inf
    layers_rad: float = np.inf
    aside_rad: float = np.inf


@lru_cache(maxsize=64)
def sample_tiles(job: Job, pulses: int, side_px: int, chunk: int) -> tuple[SampledTile, ...]:
    """Return sampled tiles with sides of `side_px` pixels, and their geometry for sampled chunks."""
    side = min(side_px, job.tile_px, *job.shape)
    window = slice(0, side), slice(0, side)
    wave = {
        "wavenumber_rad_m": job.signal.wavenumber_rad_m,
        "band_rad_m": np.pi / (job.signal.step_m * job.signal.oversampling),
    }
    sampled = job.aperture[job.aperture.sample(64)]
    tiles = []
    for patch in _patches(job, side):
        pixels = np.ascontiguousarray(patch[window])
        (surface,) = surfaces_of(pixels, [window])
        if not np.isfinite(surface.rough_m):
            tiles.append(SampledTile(surface))
            continue
        views = tuple(
            view_of_tile(job.aperture[part], surface, subaperture_sizes(chunk), **wave)
            for part in _chunks(job, surface, pulses, chunk)
        )
        relief = SurfaceResidual.of(surface, pixels)
        tiles.append(
            SampledTile(
                surface,
                views,
                roughness(sampled, surface, **wave),
                relief.band_rad(job.aperture, **wave),
                wave["wavenumber_rad_m"] * relief.aside_m,
            )
        )
    return tuple(tiles)


def _patches(job: Job, side: int) -> list[NDArray[np.float64]]:
    """Return pixel positions of sampled tiles: patches of the job, or planes about sampled points of the terrain."""
    if job.patches_m:
        return list(job.patches_m)
    count = len(job.points_m)
    right, down = (native.pixel_steps(job.ground_m, axis, job.spacing_m).reshape(-1, 3) for axis in (1, 0))
    offsets = np.arange(side) - (side - 1) / 2
    return [
        job.points_m[n] + offsets[:, None, None] * down[n] + offsets[None, :, None] * right[n]
        for n in np.unique(np.linspace(0, count - 1, _TILES).astype(int))
    ]


def _chunks(job: Job, surface: Surface, pulses: int, chunk: int) -> list[NDArray[np.int64]]:
    """Return the pulses of sampled chunks that illuminate a tile."""
    summed, groups = _sampled_pulses(len(job.aperture), pulses)
    starts = np.arange(0, pulses, chunk)
    if beams := job.beams and job.beams.on_profiles:
        variant = weighed(beams[groups], job.aperture[groups], surface, _TYPICAL_DB).variant
        first = np.searchsorted(summed, groups[::LEAF][variant != NO_ECHO])
        starts = np.unique(first // chunk * chunk) if len(first) else starts
    selected = starts[np.unique(np.linspace(0, len(starts) - 1, _CHUNKS).astype(int))]
    return [summed[start : start + chunk] for start in selected]


def _sampled_pulses(flown: int, pulses: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of the summed pulses of a flight, and of sampled groups of 64 pulses."""
    summed = np.linspace(0, flown - 1, pulses).astype(int)
    count = pulses // LEAF
    if not count:
        return summed, summed
    numbers = np.unique(np.linspace(0, count - 1, min(count, _GROUPS)).astype(int))
    return summed, summed[: count * LEAF].reshape(count, LEAF)[numbers].ravel()


class SampledWeights(NamedTuple):
    """Weights of sampled groups of pulses that illuminate a tile.

    Attributes
    ----------
    directly
        Fraction of groups that are summed on smaller tiles or directly.
    edge
        Fraction of the remaining groups that are at the edge of the sector.
    slope
        (3,) RMS slope of the depth in the edge, as in `Weighed.slope`; None without an edge.
    each
        True if the weights of most groups change abruptly from pulse to pulse.
    """

    directly: float = 0.0
    edge: float = 0.0
    slope: NDArray[np.floating] | None = None
    each: bool = False


@lru_cache(maxsize=1024)
def sample_weights(job: Job, surface: Surface, pulses: int, nodes_db: int) -> SampledWeights:
    """Return the weights of sampled groups of pulses over a tile."""
    beams = job.beams and job.beams.on_profiles
    if beams is None:
        return SampledWeights()
    groups = _sampled_pulses(len(job.aperture), pulses)[1]
    classified = weighed(beams[groups], job.aperture[groups], surface, nodes_db)
    illuminated, by_tree = classified.variant != NO_ECHO, classified.variant == BY_TREE
    edge = by_tree & classified.edge
    return SampledWeights(
        float((classified.variant == DIRECTLY).sum() / max(1, illuminated.sum())),
        float(edge.sum() / max(1, by_tree.sum())),
        np.sqrt((classified.slope[edge] ** 2).mean(axis=0)) if edge.any() else None,
        bool(classified.each[by_tree].mean() > 0.5) if by_tree.any() else False,
    )


# ---- Error and cost of settings

SETTINGS: Mapping[int, tuple[int, int]] = {
    -50: (8, 8), -56: (16, 8), -62: (16, 8), -68: (24, 8), -74: (24, 8), -80: (32, 16),
    -86: (64, 16), -92: (64, 16), -98: (64, 16),
}  # fmt: skip
"""Error of one interpolation between nodes, dB → table cells per resolution cell, and taps, with a lower error."""

PRESUMS_DB = (0, 6, 12)
"""Candidate errors of virtual pulses, in dB relative to the error of one interpolation."""

SIDES_PX, CHUNKS = (64, 128, 256), (256, 1024, 2048)
"""Candidate sides of tiles, and candidate numbers of pulses of the largest subaperture."""

_GATED_DB = {True: -70.0, False: -50.0}  # error at the end of a gate, by `is_tapered`: the gate widens the band
_FLOAT32_DB = -92.0  # error of float32 sums, dB
_FLOAT32 = 2e-7  # relative rounding error of phases, due to path lengths and positions of cells

# Seconds on one core, measured on the same machine as the times of the direct kernel in native.py.
_NODE_S = 7e-10  # per look-up of a pulse at a node
_EXPAND_S = 2.6e-9  # per cell with sixteen filter taps
_EACH_EXPAND_S = 4.6e-9  # per cell of pulses that are not presummed; these cells are common to adjacent tiles
_ALIGN_S = 8e-11  # per sample, and per tap or pulse, for alignment to a tile and presumming
_MIX_S = 5e-12  # per complex multiply-add of merges and pixels
_LAYER_BYTES = 64  # per pixel of a height layer
_READ_S = 5e-8  # per pixel and height layer, for the interpolation
_PIXEL_S = 4.5e-9  # per pixel of a subaperture
_LEAF_S = 6e-6  # per leaf of a tile, for its plan
_SURFACE_S = 1.6e-8  # per pixel, for the fit of the surface
_TILE_S = 4e-5  # per tile of a chunk
_PIECEWISE = 1.1  # cost of direct sums tile by tile and chunk by chunk, relative to a single call
_ANTENNA_S = 5e-7  # per pulse, antenna and tile, for gains and the polynomials of gains
_EDGE = 1.6  # cost of a look-up at the edge of a sector, relative to a look-up inside the sector
_FORM_S = 4e-4  # per block of pixels
_TYPICAL_DB = -74  # node error assumed for the selection of chunks, dB
# number of pixel-pulse contributions below which one candidate is sufficient, because the direct kernel is fast
_SMALL = 1e8
_START_S = 0.03  # once per job, for the interpolation weights of all numbers of nodes


def candidates(job: Job, *, pulses: int, requested: Mapping[str, Any]) -> Iterator[Setting]:
    """Yield settings of trees, as described in `apertura.core.backprojection.engines.engine.Engine`.

    Notes
    -----
    Source: docs/theory/tree.md, "Error" and "Cost".
    """
    for side_px, chunk in _partitions(job, pulses, requested):
        for nodes_db in option_values(requested, "nodes_db", SETTINGS):
            oversampling, taps = SETTINGS[nodes_db]
            oversampling = requested.get("oversampling") or oversampling
            quickest = np.inf
            for presum_db in option_values(requested, "presum_db", [nodes_db + margin for margin in PRESUMS_DB]):
                layers = requested.get("height_layers")
                setting = _setting(
                    job, pulses, _Options(oversampling, taps, nodes_db, presum_db, side_px, chunk, layers)
                )
                if setting.seconds < quickest:  # a larger tolerated error is a candidate only if it saves time
                    quickest = setting.seconds
                    yield setting


def _partitions(job: Job, pulses: int, requested: Mapping[str, Any]) -> list[tuple[int, int]]:
    """Return candidate sides of tiles and chunk sizes in pulses; a single candidate for a small job."""
    pairs = list(product(option_values(requested, "side_px", SIDES_PX), option_values(requested, "chunk", CHUNKS)))
    most_px, most_pulses = 2 * min(job.tile_px, max(job.shape)), 8 * max(pulses, LEAF)
    fitting = [(side, chunk) for side, chunk in pairs if side < most_px and chunk < most_pulses] or pairs[:1]
    return fitting if job.pixels * pulses > _SMALL else fitting[-1:]


class _Options(NamedTuple):
    """Options of the engine; if `height_layers` is None, the number of layers is determined by the cost."""

    oversampling: int
    taps: int
    nodes_db: int
    presum_db: int
    side_px: int
    chunk: int
    height_layers: int | None


def _setting(job: Job, pulses: int, options: _Options) -> Setting:
    signal, nodes_db = job.signal, options.nodes_db
    # Direct kernel, tile by tile, for the fraction that cannot be summed by tree.
    carrier_rad = signal.wavenumber_rad_m * signal.step_m
    requested = {"degree": 2, **direct_setting(nodes_db, signal.oversampling, carrier_rad)._asdict()}
    direct = next(iter(native.candidates(job, pulses=pulses, requested=requested)))
    direct_s = _PIECEWISE * direct.form_seconds / (job.pixels * pulses * job.share)
    cost = _cost(job, pulses, options, direct_s)
    # Eq. 10, with errors of float32 sums and phases; errors of trees and direct sums are weighted by their fractions.
    design = cells(signal.oversampling, carrier_rad, float(options.oversampling), options.taps)
    table_db, levels = design.error_db(signal.window), len(subaperture_sizes(options.chunk))
    presum_db = decibels(cost.presum_rad2 + 1e-30)
    interpolated_db = nodes_db + decibels(2 * levels + 1 + (cost.layers > 1))
    tiles = sample_tiles(job, pulses, options.side_px, options.chunk)
    phases = [view.phase_rad for tile in tiles for view in tile.views]
    phase_rad = float(np.sqrt(np.mean(np.square(phases)))) if phases else 1.0
    phase_db = 2 * decibels(_FLOAT32 * phase_rad + 1e-9)
    is_tapered = bool(signal.window[0] < signal.window.max() / 4)
    gate_db = [_GATED_DB[is_tapered]] if job.beams and job.beams.gate else []
    tree_db = power_sum_db(table_db, interpolated_db, presum_db, _FLOAT32_DB, phase_db, *gate_db)
    powers = 10 ** (np.array([tree_db, direct.error_db]) / 10)
    error_db = decibels(float(powers @ [1 - cost.directly, cost.directly]))
    layers = cost.layers if cost.layers > 1 else 0
    return Setting(
        "tree",
        {"oversampling": options.oversampling, "taps": options.taps},
        {name: getattr(options, name) for name in ("nodes_db", "presum_db", "side_px", "chunk")}
        | {"height_layers": cost.most_layers},
        # rounded, so that a difference of 0.01 dB does not halve the side of tiles
        float(np.ceil(2 * error_db) / 2),
        cost.seconds,
        table_seconds=_START_S + (direct.table_seconds if cost.directly else 0.0),
        table_bytes=8 * pulses * signal.samples
        + (direct.table_bytes if cost.directly else 0)
        + _LAYER_BYTES * options.side_px**2 * layers,
        reasons={
            "oversampling": f"predicted error of the table {table_db:.1f} dB",
            "taps": "number of taps of the table filters",
            "nodes_db": f"predicted error of interpolation between nodes {nodes_db} dB at each of {levels} levels",
            "presum_db": f"predicted error of virtual pulses {presum_db:.0f} dB",
            "side_px": f"lowest cost; about {100 * cost.directly:.0f} % of pixel-pulse pairs are summed directly",
            "chunk": "number of pulses of the largest subaperture with the lowest cost",
            "height_layers": f"with more layers, the direct sum has a lower cost; this scene requires {layers or 'no'} "
            "layers",
        },
    )


class _Cost(NamedTuple):
    """Cost of an image, or of the tiles of one side.

    Attributes
    ----------
    seconds
        Time for the image; for tiles of one side, time if the whole image is summed with these tiles.
    directly
        Fraction that is not summed by tree.
    presum_rad2
        Mean squared phase error of virtual pulses, rad².
    most_layers
        Largest permitted number of height layers of a tile.
    layers
        Largest number of height layers that a sampled tile requires.
    """

    seconds: float
    directly: float
    presum_rad2: float
    most_layers: int
    layers: int


def _cost(job: Job, pulses: int, options: _Options, direct_s: float) -> _Cost:
    """Return the cost of the image, if the direct sum takes `direct_s` seconds per pixel and pulse."""
    side = min(options.side_px, job.tile_px, *job.shape)
    first = part = _by_tree(job, pulses, options, side, direct_s)
    seconds = _SURFACE_S * job.pixels + _FORM_S * job.tiles
    remaining, presum = 1.0, 0.0  # fraction not summed by larger tiles
    while True:
        weights_s = job.antennas * job.share * job.pixels / side**2 * pulses * _ANTENNA_S
        summed = max(0.0, remaining - part.directly)
        seconds, presum = seconds + summed * part.seconds + remaining * weights_s, max(presum, part.presum_rad2)
        remaining, side = remaining - summed, side // 2
        if not remaining or side < LEAST_QUARTER_PX:
            break
        part = _by_tree(job, pulses, options, side, None)
    seconds += remaining * pulses * job.share * job.pixels * direct_s
    return _Cost(seconds, remaining, presum, first.most_layers, first.layers)


def _by_tree(job: Job, pulses: int, options: _Options, side: int, direct_s: float | None) -> _Cost:
    """Return the cost for tiles of a given side length; height layers are considered if `direct_s` is given.

    Notes
    -----
    Source: docs/theory/tree.md, "Cost", "What goes directly" and "Height layers".
    """
    tiles = sample_tiles(job, pulses, side, options.chunk)
    counted = [_counted(job, pulses, options, side, tile) for tile in tiles]
    # Each layer requires a tree and an interpolation; the number of layers is limited by the cost of the direct sum.
    tile_s = [value for _, seconds, _ in counted for value in seconds]
    once_s, read_s = float(np.mean(tile_s or [np.inf])), _READ_S * side**2
    most_layers = min(MOST_LAYERS, int(pulses * side**2 * direct_s / (once_s + read_s))) if direct_s else 0
    if direct_s and options.height_layers is not None:
        most_layers = options.height_layers
    # Tiles are sufficiently flat by eq. 9, formed on the number of layers of eq. 11, or summed directly.
    error2, tree_s, shares, presum, layers_needed = (
        10 ** (options.nodes_db / 10),
        list[float](),
        list[float](),
        [0.0],
        1,
    )
    for tile, (counts, seconds, directly) in zip(tiles, counted, strict=True):
        layers = 1
        if tile.rough > 2 * error2:
            layers = layers_for(tile.layers_rad, options.nodes_db) if tile.aside_rad**2 <= error2 else most_layers + 1
        if not seconds or layers > max(1, most_layers):
            shares.append(0.0)
            continue
        shares.append((1 - directly) * len(seconds) / len(counts))
        tree_s += [layers * (chunk_s + (read_s if layers > 1 else 0.0)) for chunk_s in seconds]
        presum += [of_chunk.presum_rad**2 for of_chunk in counts if of_chunk.nodes]
        layers_needed = max(layers_needed, layers)
    all_s = job.share * job.pixels / side**2 * float(np.mean(tree_s or [0.0]))
    return _Cost(all_s, 1 - float(np.mean(shares)), float(np.mean(presum)), most_layers, layers_needed)


def _counted(
    job: Job, pulses: int, options: _Options, side: int, tile: SampledTile
) -> tuple[list[Counts], list[float], float]:
    """Return counts of a tile per sampled chunk, seconds of chunks with a tree, and directly summed fraction."""
    counts, seconds, too_steep = list[Counts](), list[float](), list[bool]()
    if not tile.views:
        return counts, seconds, 0.0
    weights = sample_weights(job, tile.surface, pulses, options.nodes_db)
    count = partial(
        counts_of,
        nodes_db=options.nodes_db,
        presum_db=options.presum_db,
        weighted=job.antennas > 0,
        each=weights.each,
    )
    for view in tile.views:
        inside = count(view)
        edge = count(view, slope=weights.slope) if weights.edge else inside  # eq. 13: more nodes, possibly no tree
        counts.append(inside)
        too_steep.append(not edge.nodes and bool(weights.edge))
        if inside.nodes:
            tree_s = (1 - weights.edge) * _tree_seconds(job, pulses, options, side, view, inside)
            if weights.edge and edge.nodes:
                tree_s += weights.edge * _tree_seconds(job, pulses, options, side, view, edge, lookup=_EDGE)
            seconds.append(-(-pulses // options.chunk) * tree_s)
    return counts, seconds, 1 - (1 - weights.directly) * (1 - weights.edge * float(np.mean(too_steep)))


def _tree_seconds(
    job: Job, pulses: int, options: _Options, side: int, view: TileView, counts: Counts, *, lookup: float = 1.0
) -> float:
    """Return the time of a tree over a tile and a chunk, seconds; `lookup` is the relative cost of a look-up."""
    chunk = min(pulses, options.chunk)
    subapertures = [-(-chunk // size) for size in subaperture_sizes(options.chunk)]
    # Leaves: pulses are aligned and presummed (eq. 7, 8), expanded to cells, and looked up at the nodes.
    summed = subapertures[0] * counts.virtual or chunk
    samples, (columns, rows) = view.span_m / job.signal.step_m + 6, counts.nodes[0]
    expanded = summed * samples * cells_per_sample(job.signal.oversampling, options.oversampling) * options.taps / 16
    tiles_in_row = min(job.tile_px, *job.shape) / side  # tiles with common cells of pulses that are not presummed
    aligned = chunk * (samples + options.taps) * (TREE.delays + counts.virtual) if counts.virtual else 0.0
    # Merges (eq. 5): product along ξ for all rows of nodes, then along η; the last merge evaluates the pixels.
    targets = [*counts.nodes[1:], (side, side)]
    mixed = sum(
        count * (-(-wide // 8) * 8) * (tall_from * wide_from + tall * tall_from)
        for count, (wide_from, tall_from), (wide, tall) in zip(subapertures, counts.nodes, targets, strict=False)
    )
    return (
        lookup * _NODE_S * summed * (-(-columns * rows // 16) * 16)
        + (_EXPAND_S if counts.virtual else _EACH_EXPAND_S / tiles_in_row) * expanded
        + _ALIGN_S * aligned
        + _MIX_S * mixed
        + _PIXEL_S * subapertures[len(counts.nodes) - 1] * side**2
        + _LEAF_S * subapertures[0]
        + _TILE_S
    )
