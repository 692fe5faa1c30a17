"""Prediction of trees: error, share of pixels and pulses that are summed directly, and cost.

A few tiles of the job are viewed from a few chunks of its pulses by the library, which gives the bands that plans count
nodes by; numbers of nodes and virtual pulses follow for every tolerated error, and from them error and seconds.
docs/theory/tree.md, "Error" and "Cost".
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

# ---- Views of tiles from chunks of pulses: numbers of nodes and virtual pulses


@dataclass(frozen=True, eq=False)
class TileView:
    """Geometry of one tile from one chunk of pulses.

    Attributes
    ----------
    bands_rad
        (2,) float of each level: half width of the band along columns and rows, rad per half tile.
    turn_rad
        Largest phase change of the carrier within half a leaf against the tile's centre.
    rough_rad
        (curve,) RMS phase of deviations from curves of growing degree, (8b).
    span_m
        Total path across the tile.
    phase_rad
        RMS phase of its places against its centre.
    """

    bands_rad: tuple[NDArray[np.floating], ...]
    turn_rad: float
    rough_rad: NDArray[np.float64]
    span_m: float
    phase_rad: float


def view_of_tile(
    aperture: Aperture, surface: Surface, sizes: tuple[int, ...], *, wavenumber_rad_m: float, band_rad_m: float
) -> TileView:
    """Return the geometry of one tile from one chunk of pulses, as the library plans by it.

    Parameters
    ----------
    aperture
        Of the chunk.
    surface
        Of the tile.
    sizes
        Pulses of the subapertures of each level.
    wavenumber_rad_m, band_rad_m
        2πf_mid/c and πB/c.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 4, 8 and 8b; native/tree_view.cpp. Of each level and of the leaves
    three are taken, the first, middle and last.
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
    turn_rad, residual_rad_m = _widest_of_three(turn[: max(1, pulses // LEAF)]).tolist()  # of whole leaves
    phase_rad = wavenumber_rad_m * tile.slope_rms / np.sqrt(3)
    return TileView(bands, turn_rad, residual_rad_m * _roughest_m(aperture), tile.span, float(phase_rad))


def _widest_of_three(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (column,) the largest of first, middle and last row."""
    return np.asarray(values[np.unique(np.linspace(0, len(values) - 1, 3).astype(int))].max(axis=0))


@lru_cache(maxsize=64)
def _roughest_m(aperture: Aperture) -> NDArray[np.float64]:
    """Return (curve,) the largest deviation of a leaf from curves of growing degree."""
    return np.asarray(leaf_roughness(*(leaves_of(leg) for leg in aperture.legs)).max(axis=0))


def widened_rad(slope: float, band_rad: NDArray[np.floating], nodes_db: float) -> NDArray[np.floating]:
    """Return by how much the edge of a sector widens bands, rad: native/tree_weight.hpp.

    Parameters
    ----------
    slope
        Change of the depth in the edge per half tile.
    band_rad
        Without it, rad per half tile.
    nodes_db
        Tolerated error of one interpolation, ε.

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
    """Numbers of nodes and pulses of one tile and one chunk.

    Attributes
    ----------
    nodes
        (2,) of each level, along columns and rows; fewer levels where the higher ones need too many. None: no tree.
    virtual
        Virtual pulses that replace those of a leaf; 0: none do.
    presum_rad
        RMS error by these.
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
    """Return the numbers of nodes of each level, and of virtual pulses of a leaf.

    Parameters
    ----------
    view
        Of the tile.
    nodes_db, presum_db
        Tolerated errors.
    weighted
        By antennas.
    slope
        (3,) of the depth in the edge of a sector, as `Weighed.slope`; None: inside of it.
    each
        Whether the pulses of a leaf are summed one by one.
    """

    def count(band_rad: float, axis: int) -> int:
        """Return the number of nodes along ξ (0), η (1) or the pulses of a leaf (2), weights included."""
        band_rad += TREE.weighted_rad if weighted else 0.0
        widening = 0.0 if slope is None else float(widened_rad(slope[axis], np.array(band_rad), nodes_db))
        return int(nodes_for(np.array([band_rad + widening]), nodes_db)[0])

    levels: list[tuple[int, int]] = []
    for band in view.bands_rad:
        along, across = (count(float(rad), axis) for axis, rad in enumerate(band))
        if max(along, across) > TREE.nodes:
            break
        levels.append((along, across))
    # (8b): the lowest degree that follows the track closely enough; (8): nodes for the carrier, and a margin.
    smooth = np.flatnonzero(view.rough_rad <= 10 ** (presum_db / 20))
    if len(smooth) and not each:
        virtual = max(DEGREES[smooth[0]] + TREE.virtual_margin, count(view.turn_rad, 2))
        if virtual <= TREE.virtual:
            degree_followed = np.searchsorted(DEGREES, virtual - TREE.virtual_margin, "right") - 1
            return Counts(tuple(levels), virtual, float(view.rough_rad[degree_followed]))
    return Counts(tuple(levels), 0, 0.0)


# ---- Sample of tiles and chunks

_TILES, _CHUNKS = 5, 3  # sampled for a prediction
_GROUPS = 96  # of 64 pulses, whose weights over a tile are evaluated


class SampledTile(NamedTuple):
    """A tile, viewed from a few chunks of pulses; without views where a pixel has no place.

    Attributes
    ----------
    surface, views
        Of the tile.
    rough
        Mean squared error by pixels off the surface.
    layers_rad, aside_rad
        Band along heights, and phase of the deviation across them.
    """

    surface: Surface
    views: tuple[TileView, ...] = ()
    rough: float = np.inf
    layers_rad: float = np.inf
    aside_rad: float = np.inf


@lru_cache(maxsize=64)
def sample_tiles(job: Job, pulses: int, side_px: int, chunk: int) -> tuple[SampledTile, ...]:
    """Return some tiles of one side, viewed from some chunks."""
    side = min(side_px, job.tile_px, *job.shape)
    window = slice(0, side), slice(0, side)
    wave = {
        "wavenumber_rad_m": job.signal.wavenumber_rad_m,
        "band_rad_m": np.pi / (job.signal.step_m * job.signal.oversampling),
    }
    some = job.aperture[job.aperture.sample(64)]
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
                roughness(some, surface, **wave),
                relief.band_rad(job.aperture, **wave),
                wave["wavenumber_rad_m"] * relief.aside_m,
            )
        )
    return tuple(tiles)


def _patches(job: Job, side: int) -> list[NDArray[np.float64]]:
    """Return the pixels' places of a few tiles: those of the job, or on planes about some points of its ground."""
    if job.patches_m:
        return list(job.patches_m)
    count = len(job.points_m)
    right, down = (native.pixel_steps(job.ground_m, axis, job.spacing_m).reshape(-1, 3) for axis in (1, 0))
    at = np.arange(side) - (side - 1) / 2
    return [
        job.points_m[n] + at[:, None, None] * down[n] + at[None, :, None] * right[n]
        for n in np.unique(np.linspace(0, count - 1, _TILES).astype(int))
    ]


def _chunks(job: Job, surface: Surface, pulses: int, chunk: int) -> list[NDArray[np.int64]]:
    """Return the pulses of some chunks that illuminate a tile."""
    summed, groups = _sampled_pulses(len(job.aperture), pulses)
    starts = np.arange(0, pulses, chunk)
    if job.beams is not None:
        variant = weighed(job.beams[groups], job.aperture[groups], surface, _TYPICAL_DB).variant
        first = np.searchsorted(summed, groups[::LEAF][variant != NO_ECHO])
        starts = np.unique(first // chunk * chunk) if len(first) else starts
    some = starts[np.unique(np.linspace(0, len(starts) - 1, _CHUNKS).astype(int))]
    return [summed[start : start + chunk] for start in some]


def _sampled_pulses(flown: int, pulses: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return as many pulses of a flight as are summed, and of these some whole groups of 64; all of a short flight."""
    summed = np.linspace(0, flown - 1, pulses).astype(int)
    count = pulses // LEAF
    if not count:
        return summed, summed
    numbers = np.unique(np.linspace(0, count - 1, min(count, _GROUPS)).astype(int))
    return summed, summed[: count * LEAF].reshape(count, LEAF)[numbers].ravel()


class SampledWeights(NamedTuple):
    """Weights of some groups of pulses that illuminate a tile.

    Attributes
    ----------
    directly
        Share that goes to smaller tiles or directly.
    edge
        Share of the others at the edge of the sector.
    slope
        (3,) RMS of the depth there, as `Weighed.slope`; None without an edge.
    each
        Whether most have weights that jump from pulse to pulse.
    """

    directly: float = 0.0
    edge: float = 0.0
    slope: NDArray[np.floating] | None = None
    each: bool = False


@lru_cache(maxsize=1024)
def sample_weights(job: Job, surface: Surface, pulses: int, nodes_db: int) -> SampledWeights:
    """Return the weights of some groups of pulses over a tile."""
    if job.beams is None:
        return SampledWeights()
    groups = _sampled_pulses(len(job.aperture), pulses)[1]
    found = weighed(job.beams[groups], job.aperture[groups], surface, nodes_db)
    illuminated, by_tree = found.variant != NO_ECHO, found.variant == BY_TREE
    edge = by_tree & found.edge
    return SampledWeights(
        float((found.variant == DIRECTLY).sum() / max(1, illuminated.sum())),
        float(edge.sum() / max(1, by_tree.sum())),
        np.sqrt((found.slope[edge] ** 2).mean(axis=0)) if edge.any() else None,
        bool(found.each[by_tree].mean() > 0.5) if by_tree.any() else False,
    )


# ---- Error and cost of settings

SETTINGS: Mapping[int, tuple[int, int]] = {
    -50: (8, 8), -56: (16, 8), -62: (16, 8), -68: (24, 8), -74: (24, 8), -80: (32, 16),
    -86: (64, 16), -92: (64, 16), -98: (64, 16),
}  # fmt: skip
"""Error of one interpolation, dB → table cells per resolution cell, and taps, whose error is below that of nodes."""

PRESUMS_DB = (0, 6, 12)
"""dB above the error of an interpolation that virtual pulses may err by."""

SIDES_PX, CHUNKS = (64, 128, 256), (256, 1024, 2048)
"""Sides of tiles and pulses of the largest subaperture that are considered."""

_FLOAT32_DB = -92.0  # error of float32 sums
_FLOAT32 = 2e-7  # of a phase of so many radians: path lengths, and places of cells

# Seconds on one core, of the same machine as the direct kernel's in native.py.
_NODE_S = 7e-10  # a look-up of a pulse at a node
_EXPAND_S = 2.6e-9  # sixteen taps of a cell's filters
_EACH_EXPAND_S = 4.6e-9  # of pulses that no virtual pulse replaces, whose cells neighbouring tiles share
_ALIGN_S = 8e-11  # a sample and a tap or pulse, aligned to a tile and presummed
_MIX_S = 5e-12  # a complex multiply-add of merges and pixels
_LAYER_BYTES = 64  # a pixel's on one height layer
_READ_S = 5e-8  # a pixel read from one of its height layers
_PIXEL_S = 4.5e-9  # a pixel of a subaperture's
_LEAF_S = 6e-6  # a leaf over a tile: its plan
_SURFACE_S = 1.6e-8  # a pixel's place, fitted
_TILE_S = 4e-5  # a tile of a chunk
_PIECEWISE = 1.1  # cost of direct sums tile by tile and chunk by chunk, relative to one call
_ANTENNA_S = 5e-7  # a pulse's gains of one antenna over a tile, and their polynomial
_EDGE = 1.6  # a look-up at the edge of a sector, relative to one inside
_FORM_S = 4e-4  # a block of pixels
_TYPICAL_DB = -74  # error of nodes by which chunks are chosen
_SMALL = 1e8  # pixels × pulses that the direct kernel sums in less than that
_START_S = 0.03  # the weights of all numbers of nodes that a job takes, once


def candidates(job: Job, *, pulses: int, requested: Mapping[str, Any]) -> Iterator[Setting]:
    """Yield settings of trees, as `apertura.core.backprojection.engines.engine.Engine` describes.

    Notes
    -----
    Source: docs/theory/tree.md, "Error" and "Cost".
    """
    for side_px, chunk in _cuts(job, pulses, requested):
        for nodes_db in option_values(requested, "nodes_db", SETTINGS):
            oversampling, taps = SETTINGS[nodes_db]
            oversampling = requested.get("oversampling") or oversampling
            quickest = np.inf
            for presum_db in option_values(requested, "presum_db", [nodes_db + more for more in PRESUMS_DB]):
                layers = requested.get("height_layers")
                setting = _setting(
                    job, pulses, _Options(oversampling, taps, nodes_db, presum_db, side_px, chunk, layers)
                )
                if setting.seconds < quickest:  # a larger tolerated error must save time
                    quickest = setting.seconds
                    yield setting


def _cuts(job: Job, pulses: int, requested: Mapping[str, Any]) -> list[tuple[int, int]]:
    """Return sides of tiles and pulses of chunks to predict; one where the job is too small to gain by more."""
    cuts = list(product(option_values(requested, "side_px", SIDES_PX), option_values(requested, "chunk", CHUNKS)))
    most_px, most_pulses = 2 * min(job.tile_px, max(job.shape)), 8 * max(pulses, LEAF)
    fitting = [(side, chunk) for side, chunk in cuts if side < most_px and chunk < most_pulses] or cuts[:1]
    return fitting if job.pixels * pulses > _SMALL else fitting[-1:]


class _Options(NamedTuple):
    """Options of the engine; `height_layers` None: as many as pay."""

    oversampling: int
    taps: int
    nodes_db: int
    presum_db: int
    side_px: int
    chunk: int
    height_layers: int | None


def _setting(job: Job, pulses: int, options: _Options) -> Setting:
    signal, nodes_db = job.signal, options.nodes_db
    # What no tree sums: the direct kernel, tile by tile.
    carrier_rad = signal.wavenumber_rad_m * signal.step_m
    requested = {"degree": 2, **direct_setting(nodes_db, signal.oversampling, carrier_rad)._asdict()}
    direct = next(iter(native.candidates(job, pulses=pulses, requested=requested)))
    direct_s = _PIECEWISE * direct.form_seconds / (job.pixels * pulses * job.share)
    cost = _cost(job, pulses, options, direct_s)
    # (10), with float32 sums and phases; errors of trees and of direct sums add by their shares.
    design = cells(signal.oversampling, carrier_rad, float(options.oversampling), options.taps)
    table_db, levels = design.error_db(signal.window), len(subaperture_sizes(options.chunk))
    presum_db = decibels(cost.presum_rad2 + 1e-30)
    interpolated_db = nodes_db + decibels(2 * levels + 1 + (cost.layers > 1))
    tiles = sample_tiles(job, pulses, options.side_px, options.chunk)
    phases = [view.phase_rad for tile in tiles for view in tile.views]
    phase_rad = float(np.sqrt(np.mean(np.square(phases)))) if phases else 1.0
    phase_db = 2 * decibels(_FLOAT32 * phase_rad + 1e-9)
    tree_db = power_sum_db(table_db, interpolated_db, presum_db, _FLOAT32_DB, phase_db)
    powers = 10 ** (np.array([tree_db, direct.error_db]) / 10)
    error_db = decibels(float(powers @ [1 - cost.directly, cost.directly]))
    layers = cost.layers if cost.layers > 1 else 0
    return Setting(
        "tree",
        {"oversampling": options.oversampling, "taps": options.taps},
        {name: getattr(options, name) for name in ("nodes_db", "presum_db", "side_px", "chunk")}
        | {"height_layers": cost.most_layers},
        float(np.ceil(2 * error_db) / 2),  # else a hundredth of a dB would select tiles of half the side
        cost.seconds,
        table_seconds=_START_S + (direct.table_seconds if cost.directly else 0.0),
        table_bytes=8 * pulses * signal.samples
        + (direct.table_bytes if cost.directly else 0)
        + _LAYER_BYTES * options.side_px**2 * layers,
        reasons={
            "oversampling": f"table errs by {table_db:.1f} dB",
            "taps": "of the table's filters",
            "nodes_db": f"interpolation between nodes errs by {nodes_db} dB at each of {levels} levels",
            "presum_db": f"virtual pulses err by {presum_db:.0f} dB",
            "side_px": f"cheapest here; about {100 * cost.directly:.0f} % of pixel·pulses go directly",
            "chunk": "pulses of the largest subaperture, cheapest here",
            "height_layers": f"more do not pay on rough ground; {layers or 'none'} needed here",
        },
    )


class _Cost(NamedTuple):
    """Cost of an image, or of the tiles of one side.

    Attributes
    ----------
    seconds
        Of the image; of tiles: if they summed all of it.
    directly
        Share that no tree sums.
    presum_rad2
        Mean squared phase error of virtual pulses.
    most_layers
        Most height layers between which a tile may be interpolated.
    layers
        Most height layers that a sampled tile needs.
    """

    seconds: float
    directly: float
    presum_rad2: float
    most_layers: int
    layers: int


def _cost(job: Job, pulses: int, options: _Options, direct_s: float) -> _Cost:
    """Return the cost of the image where the direct sum takes `direct_s` per pixel and pulse."""
    side = min(options.side_px, job.tile_px, *job.shape)
    first = part = _by_tree(job, pulses, options, side, direct_s)
    seconds = _SURFACE_S * job.pixels + _FORM_S * job.tiles
    left, presum = 1.0, 0.0  # share that larger tiles did not sum
    while True:
        weighed_s = job.antennas * job.share * job.pixels / side**2 * pulses * _ANTENNA_S
        taken = max(0.0, left - part.directly)
        seconds, presum = seconds + taken * part.seconds + left * weighed_s, max(presum, part.presum_rad2)
        left, side = left - taken, side // 2
        if not left or side < LEAST_QUARTER_PX:
            break
        part = _by_tree(job, pulses, options, side, None)
    seconds += left * pulses * job.share * job.pixels * direct_s
    return _Cost(seconds, left, presum, first.most_layers, first.layers)


def _by_tree(job: Job, pulses: int, options: _Options, side: int, direct_s: float | None) -> _Cost:
    """Return the cost of tiles of one side; height layers are considered where `direct_s` is given.

    Notes
    -----
    Source: docs/theory/tree.md, "Cost", "What goes directly" and "Height layers".
    """
    tiles = sample_tiles(job, pulses, side, options.chunk)
    counted = [_counted(job, pulses, options, side, tile) for tile in tiles]
    # Layers cost a tree and a reading each: as many pay as cost less than the direct sum.
    tile_s = [one for _, seconds, _ in counted for one in seconds]
    once_s, read_s = float(np.mean(tile_s or [np.inf])), _READ_S * side**2
    most_layers = min(MOST_LAYERS, int(pulses * side**2 * direct_s / (once_s + read_s))) if direct_s else 0
    if direct_s and options.height_layers is not None:
        most_layers = options.height_layers
    # Tiles: flat enough by (9), on as many layers as (11) takes, or directly.
    error2, spent, shares, presum, layers_needed = 10 ** (options.nodes_db / 10), list[float](), list[float](), [0.0], 1
    for tile, (counts, seconds, directly) in zip(tiles, counted, strict=True):
        layers = 1
        if tile.rough > 2 * error2:
            layers = layers_for(tile.layers_rad, options.nodes_db) if tile.aside_rad**2 <= error2 else most_layers + 1
        if not seconds or layers > max(1, most_layers):
            shares.append(0.0)
            continue
        shares.append((1 - directly) * len(seconds) / len(counts))
        spent += [layers * (one + (read_s if layers > 1 else 0.0)) for one in seconds]
        presum += [one.presum_rad**2 for one in counts if one.nodes]
        layers_needed = max(layers_needed, layers)
    all_s = job.share * job.pixels / side**2 * float(np.mean(spent or [0.0]))
    return _Cost(all_s, 1 - float(np.mean(shares)), float(np.mean(presum)), most_layers, layers_needed)


def _counted(
    job: Job, pulses: int, options: _Options, side: int, tile: SampledTile
) -> tuple[list[Counts], list[float], float]:
    """Return counts of a tile for each chunk viewed, seconds of those with a tree, and the share that goes directly."""
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
        edge = count(view, slope=weights.slope) if weights.edge else inside  # (13): more nodes, maybe no tree
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
    """Return the seconds of a tree over a tile and a chunk; `lookup`: cost of a look-up relative to one inside."""
    chunk = min(pulses, options.chunk)
    subapertures = [-(-chunk // size) for size in subaperture_sizes(options.chunk)]
    # Leaves: pulses aligned and presummed (7), (8), expanded to cells, and looked up at the nodes.
    summed = subapertures[0] * counts.virtual or chunk
    samples, (columns, rows) = view.span_m / job.signal.step_m + 6, counts.nodes[0]
    expanded = summed * samples * cells_per_sample(job.signal.oversampling, options.oversampling) * options.taps / 16
    tiles_beside = min(job.tile_px, *job.shape) / side  # which share the cells of pulses summed one by one
    aligned = chunk * (samples + options.taps) * (TREE.delays + counts.virtual) if counts.virtual else 0.0
    # Merges (5): the product along ξ for all rows of nodes, then along η; the last one goes to the pixels.
    targets = [*counts.nodes[1:], (side, side)]
    mixed = sum(
        count * (-(-wide // 8) * 8) * (tall_from * wide_from + tall * tall_from)
        for count, (wide_from, tall_from), (wide, tall) in zip(subapertures, counts.nodes, targets, strict=False)
    )
    return (
        lookup * _NODE_S * summed * (-(-columns * rows // 16) * 16)
        + (_EXPAND_S if counts.virtual else _EACH_EXPAND_S / tiles_beside) * expanded
        + _ALIGN_S * aligned
        + _MIX_S * mixed
        + _PIXEL_S * subapertures[len(counts.nodes) - 1] * side**2
        + _LEAF_S * subapertures[0]
        + _TILE_S
    )
