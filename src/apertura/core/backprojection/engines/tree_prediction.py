"""Prediction of trees: error, share of pixels and pulses that are summed directly, and cost."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.core.backprojection.engines import native_prediction
from apertura.core.backprojection.engines.engine import Setting, option_values, power_sum_db
from apertura.core.backprojection.engines.native_binding import TREE_DELAYS
from apertura.core.backprojection.engines.native_prediction import pixel_steps
from apertura.core.backprojection.engines.tree_inputs import (
    LEAST_QUARTER_PX,
    cells,
    cells_per_sample,
    direct_setting,
    roughness,
    weighed,
)
from apertura.core.backprojection.engines.tree_nodes import BY_TREE, DIRECTLY, WITHOUT_ECHO, Surface, surfaces_of
from apertura.core.backprojection.engines.tree_view import (
    LEAF,
    MOST_SHEETS,
    Counts,
    SurfaceResidual,
    TileView,
    counts_of,
    sheets_for,
    subaperture_sizes,
    view_of_tile,
)
from apertura.core.backprojection.job import Job, Signal

# ---- Sample of tiles and chunks

_TILES, _CHUNKS = 5, 3  # sampled for a prediction
_GROUPS = 96  # of 64 pulses, whose weights over a tile are evaluated


@dataclass(frozen=True, eq=False)
class SampledTiles:
    """A few tiles of one side, and their views from a few chunks of pulses."""

    surfaces: tuple[Surface, ...]
    views: tuple[tuple[TileView, ...], ...]
    rough: tuple[float, ...]  # mean squared error by pixels off their surface
    sheets_rad: tuple[tuple[float, float], ...]  # band along heights, and phase of the deviation across them
    groups: NDArray[np.int64]  # pulses of some groups of 64, spread over the flight

    @property
    def phase_rad(self) -> float:
        """RMS phase over the views, of places of a tile against its centre."""
        phases = [view.phase_rad for views in self.views for view in views]
        return float(np.sqrt(np.mean(np.square(phases)))) if phases else 1.0


@lru_cache(maxsize=64)
def sample_tiles(job: Job, pulses: int, side_px: int, chunk: int) -> SampledTiles:
    """Return some tiles, and their views from some chunks."""
    side = min(side_px, job.tile_px, *job.shape)
    window = slice(0, side), slice(0, side)
    patches = [np.ascontiguousarray(patch[window]) for patch in _patches(job, side)]
    surfaces = tuple(surfaces_of(patch, [window])[0] for patch in patches)
    places = np.linspace(0, len(job.aperture) - 1, pulses).astype(int)
    groups = _groups(places)
    k, b = job.signal.wavenumber_rad_m, np.pi / (job.signal.step_m * job.signal.oversampling)
    views = tuple(
        tuple(
            view_of_tile(
                job.aperture[places[start : start + chunk]],
                surface,
                subaperture_sizes(chunk),
                wavenumber_rad_m=k,
                band_rad_m=b,
            )
            for start in _starts(job, surface, groups, places, chunk)
        )
        for surface in surfaces
        if np.isfinite(surface.rough_m)
    )
    some = job.aperture[job.aperture.sample(64)]
    rough = tuple(roughness(some, surface, wavenumber_rad_m=k, band_rad_m=b) for surface in surfaces)
    sheets = tuple(
        _sheets(job, surface, patch, wavenumber_rad_m=k, band_rad_m=b)
        for surface, patch in zip(surfaces, patches, strict=True)
    )
    return SampledTiles(surfaces, views, rough, sheets, groups)


def _groups(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the pulses of some whole groups, spread over a flight; of a flight shorter than one, all."""
    count = len(places) // LEAF
    numbers = np.unique(np.linspace(0, count - 1, min(count, _GROUPS)).astype(int))
    return places[: count * LEAF].reshape(count, LEAF)[numbers].ravel() if count else places


def _starts(
    job: Job, surface: Surface, groups: NDArray[np.int64], places: NDArray[np.int64], chunk: int
) -> NDArray[np.int64]:
    """Return where some chunks begin that illuminate a tile."""
    starts = np.arange(0, len(places), chunk)
    if job.beams is not None:
        found = weighed(job.beams[groups], job.aperture[groups], surface, _TYPICAL_DB)
        first = np.searchsorted(places, groups[::LEAF][found.variant != WITHOUT_ECHO])
        starts = np.unique(first // chunk * chunk) if len(first) else starts
    return np.asarray(starts[np.unique(np.linspace(0, len(starts) - 1, _CHUNKS).astype(int))])


def _sheets(
    job: Job, surface: Surface, patch: NDArray[np.float64], *, wavenumber_rad_m: float, band_rad_m: float
) -> tuple[float, float]:
    """Return `SampledTiles.sheets_rad` of a tile."""
    if not np.isfinite(surface.rough_m):
        return np.inf, np.inf
    relief = SurfaceResidual.of(surface, patch)
    band = relief.band_rad(job.aperture, wavenumber_rad_m=wavenumber_rad_m, band_rad_m=band_rad_m)
    return band, wavenumber_rad_m * relief.aside_m


@dataclass(frozen=True, eq=False)
class SampledWeights:
    """What weights make of some groups of pulses that illuminate a tile.

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


@lru_cache(maxsize=256)
def sample_weights(job: Job, sampled: SampledTiles, nodes_db: int) -> tuple[SampledWeights, ...]:
    """Return what weights make of the groups of pulses over each tile with a surface."""
    smooth = [surface for surface in sampled.surfaces if np.isfinite(surface.rough_m)]
    return tuple(_sampled_weights(job, surface, sampled.groups, nodes_db) for surface in smooth)


def _sampled_weights(job: Job, surface: Surface, groups: NDArray[np.int64], nodes_db: int) -> SampledWeights:
    if job.beams is None:
        return SampledWeights()
    found = weighed(job.beams[groups], job.aperture[groups], surface, nodes_db)
    illuminated, taken = found.variant != WITHOUT_ECHO, found.variant == BY_TREE
    edge = taken & found.edge
    return SampledWeights(
        float((found.variant == DIRECTLY).sum() / max(1, illuminated.sum())),
        float(edge.sum() / max(1, taken.sum())),
        np.sqrt((found.slope[edge] ** 2).mean(axis=0)) if edge.any() else None,
        bool(found.each[taken].mean() > 0.5) if taken.any() else False,
    )


def _patches(job: Job, side: int) -> list[NDArray[np.float64]]:
    """Return the pixels' places of a few tiles: those of the job, or on planes about some points of its ground."""
    if job.patches_m:
        return list(job.patches_m)
    count = len(job.points_m)
    right, down = (pixel_steps(job.ground_m, axis, job.spacing_m).reshape(-1, 3) for axis in (1, 0))
    at = np.arange(side) - (side - 1) / 2
    return [
        job.points_m[n] + at[:, None, None] * down[n] + at[None, :, None] * right[n]
        for n in np.unique(np.linspace(0, count - 1, _TILES).astype(int))
    ]


# ---- Error and cost of settings

SETTINGS: Mapping[int, tuple[int, int]] = {
    -50: (8, 8), -56: (16, 8), -62: (16, 8), -68: (24, 8), -74: (24, 8), -80: (32, 16),
    -86: (64, 16), -92: (64, 16), -98: (64, 16),
}  # fmt: skip
"""Error of one interpolation, dB → table cells per resolution cell, and taps, whose error is below that of nodes."""

PRESUMS_DB = (0, 6, 12)
"""dB above the error of an interpolation that replacing pulses by fewer may err by."""

SIDES_PX, CHUNKS = (64, 128, 256), (256, 1024, 2048)
"""Sides of tiles and pulses of the largest subaperture that are considered."""

_FLOAT32_DB = -92.0  # error of float32 sums
_FLOAT32 = 2e-7  # of a phase of so many radians: path lengths, and places of cells

# Seconds on one core, of the same machine as the direct kernel's in native_prediction.py.
_NODE_S = 7e-10  # a look-up of a pulse at a node
_EXPAND_S = 2.6e-9  # sixteen taps of a cell's filters
_EACH_EXPAND_S = 4.6e-9  # of pulses that no fewer replace, whose cells neighbouring tiles share
_ALIGN_S = 8e-11  # a sample and a tap or pulse, aligned to a tile and replaced by fewer
_MIX_S = 5e-12  # a complex multiply-add of merges and pixels
_SHEET_BYTES = 64  # a pixel's on one sheet
_READ_S = 5e-8  # a pixel read from one of its sheets
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
        sampled = sample_tiles(job, pulses, side_px, chunk)
        for nodes_db in option_values(requested, "nodes_db", SETTINGS):
            oversampling, taps = SETTINGS[nodes_db]
            oversampling = requested.get("oversampling") or oversampling
            quickest = np.inf
            for presum_db in option_values(requested, "presum_db", [nodes_db + more for more in PRESUMS_DB]):
                options = _Options(oversampling, taps, nodes_db, presum_db, side_px, chunk, requested.get("sheets"))
                setting = _setting(job, sampled, pulses, options)
                if setting.seconds < quickest:  # a larger tolerated error must save time
                    quickest = setting.seconds
                    yield setting


def _cuts(job: Job, pulses: int, requested: Mapping[str, Any]) -> list[tuple[int, int]]:
    """Return sides of tiles and pulses of chunks to predict; one where the job is too small to gain by more."""
    cuts = list(product(option_values(requested, "side_px", SIDES_PX), option_values(requested, "chunk", CHUNKS)))
    most_px, most_pulses = 2 * min(job.tile_px, max(job.shape)), 8 * max(pulses, LEAF)
    fitting = [(side, chunk) for side, chunk in cuts if side < most_px and chunk < most_pulses] or cuts[:1]
    return fitting if job.pixels * pulses > _SMALL else fitting[-1:]


@dataclass(frozen=True)
class _Options:
    oversampling: int
    taps: int
    nodes_db: int
    presum_db: int
    side_px: int
    chunk: int
    sheets: int | None  # as many as pay


@dataclass(frozen=True)
class _Work:
    """One tile and one chunk: pulses, pixels along a side, and how many such tiles lie along the side of a block."""

    pulses: int
    side: int
    beside: float


def _setting(job: Job, sampled: SampledTiles, pulses: int, options: _Options) -> Setting:
    signal, nodes_db = job.signal, options.nodes_db
    carrier_rad = signal.wavenumber_rad_m * signal.step_m
    design = cells(signal.oversampling, carrier_rad, float(options.oversampling), options.taps)
    table_db, levels = design.error_db(signal.window), len(subaperture_sizes(options.chunk))
    requested = {"degree": 2, **direct_setting(nodes_db, signal.oversampling, carrier_rad)._asdict()}
    direct = next(iter(native_prediction.candidates(job, pulses=pulses, requested=requested)))
    direct_s = _PIECEWISE * direct.form_seconds / (job.pixels * pulses * job.share)
    cost = _cost(job, pulses, options, direct_s)
    presum_db = float(10 * np.log10(cost.presum_rad2 + 1e-30))
    interpolated_db = nodes_db + 10 * float(np.log10(2 * levels + 1 + (cost.layers > 1)))
    phase_db = 20 * float(np.log10(_FLOAT32 * sampled.phase_rad + 1e-9))
    tree_db = power_sum_db(table_db, interpolated_db, presum_db, _FLOAT32_DB, phase_db)
    powers = 10 ** (np.array([tree_db, direct.error_db]) / 10)
    error_db = 10 * np.log10(powers @ [1 - cost.directly, cost.directly])
    return Setting(
        "tree",
        {"oversampling": options.oversampling, "taps": options.taps},
        {name: getattr(options, name) for name in ("nodes_db", "presum_db", "side_px", "chunk")}
        | {"sheets": cost.sheets},
        float(np.ceil(2 * error_db) / 2),  # else a hundredth of a dB would select tiles of half the side
        cost.seconds,
        table_seconds=_START_S + (direct.table_seconds if cost.directly else 0.0),
        table_bytes=8 * pulses * signal.samples
        + (direct.table_bytes if cost.directly else 0)
        + _SHEET_BYTES * options.side_px**2 * (cost.layers if cost.layers > 1 else 0),
        reasons={
            "oversampling": f"table errs by {table_db:.1f} dB",
            "taps": "of the table's filters",
            "nodes_db": f"interpolation between nodes errs by {nodes_db} dB at each of {levels} levels",
            "presum_db": f"pulses for which fewer stand err by {presum_db:.0f} dB",
            "side_px": f"cheapest here; about {100 * cost.directly:.0f} % of pixel·pulses go directly",
            "chunk": "pulses of the largest subaperture, cheapest here",
            "sheets": f"more do not pay on rough ground; {cost.layers if cost.layers > 1 else 'none'} needed here",
        },
    )


@dataclass(frozen=True)
class _Cost:
    """Cost of an image, or of the tiles of one side.

    Attributes
    ----------
    seconds
        Of the image; of tiles: if they summed all of it.
    directly
        Share that no tree sums.
    presum_rad2
        Mean squared phase error of pulses replaced by fewer.
    sheets
        Most sheets between which a tile may be interpolated.
    layers
        Most sheets that a sampled tile needs.
    """

    seconds: float
    directly: float
    presum_rad2: float
    sheets: int
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
    return _Cost(seconds, left, presum, first.sheets, first.layers)


def _by_tree(job: Job, pulses: int, options: _Options, side: int, direct_s: float | None) -> _Cost:
    """Return the cost of tiles of one side; sheets are considered where `direct_s` is given."""
    sampled, chunks = sample_tiles(job, pulses, side, options.chunk), -(-pulses // options.chunk)
    work = _Work(min(pulses, options.chunk), side, min(job.tile_px, *job.shape) / side)
    weights, limit = sample_weights(job, sampled, options.nodes_db), 10 ** (options.nodes_db / 20)
    counted = partial(counts_of, nodes_db=options.nodes_db, presum_db=options.presum_db, weighted=job.antennas > 0)
    counts = [[counted(one, each=has.each) for one in here] for here, has in zip(sampled.views, weights, strict=True)]
    at_edge = [
        [counted(one, each=has.each, slope=has.slope) if has.edge else None for one in here]
        for here, has in zip(sampled.views, weights, strict=True)
    ]

    def seconds_of(view: TileView, inside: Counts, edge: Counts | None, share: float) -> float:
        parts = [(1 - share, inside, 1.0)] + ([(share, edge, _EDGE)] if edge and edge.nodes else [])
        return chunks * sum(
            part * cost * amount
            for part, one_count, dearer in parts
            for cost, amount in features(view, one_count, options, job.signal, work, dearer=dearer)
        )

    costs = [
        [
            seconds_of(one, one_count, edge, has.edge)
            for one, one_count, edge in zip(here, node_counts, edges, strict=True)
            if one_count.nodes
        ]
        for here, node_counts, edges, has in zip(sampled.views, counts, at_edge, weights, strict=True)
    ]
    too_steep = [[edge is not None and not edge.nodes for edge in edges] for edges in at_edge]
    directly = [
        1 - (1 - has.directly) * (1 - has.edge * float(np.mean(steep)))
        for has, steep in zip(weights, too_steep, strict=True)
    ]
    once, read_s = float(np.mean([one for each in costs for one in each] or [np.inf])), _READ_S * side**2
    pay = min(MOST_SHEETS, int(pulses * side**2 * direct_s / (once + read_s))) if direct_s else 0
    sheets = pay if options.sheets is None or not direct_s else options.sheets
    spent, share, presum, most = list[float](), list[float](), [0.0], 1
    tiles = iter(zip(counts, costs, directly, strict=True))
    for surface, rough, (band, aside) in zip(sampled.surfaces, sampled.rough, sampled.sheets_rad, strict=True):
        node_counts, cost, edge = next(tiles) if np.isfinite(surface.rough_m) else ([], [], 0.0)
        layers = 1 if rough <= 2 * limit**2 else sheets_for(band, options.nodes_db) if aside <= limit else sheets + 1
        if layers > max(1, sheets):
            cost = []
        most = max(most, layers) if cost else most
        share.append((1 - edge) * len(cost) / max(1, len(node_counts)))
        spent += [layers * (one + (read_s if layers > 1 else 0.0)) for one in cost]
        presum += [one_count.presum_rad**2 for one_count in node_counts if one_count.nodes and cost]
    seconds = job.share * job.pixels / side**2 * float(np.mean(spent or [0.0]))
    return _Cost(seconds, 1 - float(np.mean(share)), float(np.mean(presum)), sheets, most)


def features(
    view: TileView, counts: Counts, options: _Options, signal: Signal, work: "_Work", *, dearer: float = 1.0
) -> list[tuple[float, float]]:
    """Return the operations of a tree over one tile and one chunk: seconds of each, and their number.

    `dearer` is the cost of a look-up relative to one inside a sector.
    """
    leaves = [-(-work.pulses // size) for size in subaperture_sizes(options.chunk)]
    samples = view.span_m / signal.step_m + 6
    looked_up = leaves[0] * counts.fewer if counts.fewer else work.pulses
    cells_of = cells_per_sample(signal.oversampling, options.oversampling)
    aligned = work.pulses * (samples + options.taps) * (TREE_DELAYS + counts.fewer) if counts.fewer else 0.0
    columns, rows = counts.nodes[0]
    expand_s = _EXPAND_S if counts.fewer else _EACH_EXPAND_S / work.beside
    return [
        (dearer * _NODE_S, looked_up * (-(-columns * rows // 16) * 16)),
        (expand_s, looked_up * samples * cells_of * options.taps / 16),
        (_ALIGN_S, aligned),
        (_MIX_S, _mixed(counts, leaves, work.side)),
        (_PIXEL_S, leaves[len(counts.nodes) - 1] * work.side**2),
        (_LEAF_S, leaves[0]),
        (_TILE_S, 1.0),
    ]


def _mixed(counts: Counts, leaves: list[int], side: int) -> float:
    """Return the multiply-adds of all merges, the last one to pixels."""
    targets = [*counts.nodes[1:], (side, side)]
    return float(
        sum(
            count * (-(-wide // 8) * 8) * (rows * columns + tall * rows)
            for count, (columns, rows), (wide, tall) in zip(leaves, counts.nodes, targets, strict=False)
        )
    )
