"""Backprojection by subaperture trees on Cartesian tiles, with a lower order of complexity for large images.

Over a tile of up to 256 × 256 pixels, the sum over consecutive pulses is band-limited after removal of the phase φ of a
reference pulse (docs/theory/tree.md, eq. 3 and 4). The sum is therefore computed at a small number of nodes and
interpolated:

1. **Surface** (`tree_geometry`). The pixel positions of a tile are approximated by a plane or by Legendre polynomials
   of degree 6.
2. **Plan** (native/tree_plan.hpp). Every subaperture of each level is assigned the smallest number of nodes that
   supports its band (4b), and every leaf of 64 pulses the smallest number of virtual pulses (8). The highest level is
   the last level at which 128 nodes are sufficient.
3. **Leaves** (native/tree_leaf.hpp). The pulses of a leaf are aligned to the tile centre (7), presummed to virtual
   pulses (8), expanded to cells and summed at the nodes of the leaf, with the weights of antennas and sector (13).
4. **Merges** (native/tree_merge.hpp). Subapertures of 64, 256 and `chunk` pulses are merged by two small matrix
   products each, with φ of the child removed and φ of the parent restored (5); the last merge evaluates the pixels.
5. **Height layers** (`tree_geometry`). If pixels deviate from the surface (9), the tile is formed on several parallel
   layers, and the pixels are interpolated between the layers (11).

Contributions that a tree cannot sum are summed on the quarters of the tile, or otherwise by the direct kernel (engine
`native`). This applies to ends of profiles inside the tile, weights that are not smooth, more than 128 nodes, and tiles
below 32 × 32 pixels. A tile depends only on its own pixels. `tree_inputs` prepares the inputs common to all tiles and
the jobs of the library; `tree_prediction` predicts error (10) and cost of a setting.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise, product
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from apertura.common.contracts import Window
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines import native
from apertura.core.backprojection.engines.engine import EngineOptions, checked_pixels
from apertura.core.backprojection.engines.native_binding import DIRECTLY, TREE, available, instruction_set
from apertura.core.backprojection.engines.tree_geometry import (
    LEAF,
    MOST_LAYERS,
    HeightLayers,
    SurfaceResidual,
    layers_for,
    subaperture_sizes,
    surfaces_of,
    windows,
)
from apertura.core.backprojection.engines.tree_inputs import (
    LEAST_PIXELS,
    LEAST_QUARTER_PX,
    Chunk,
    JobTile,
    Task,
    Trees,
    prepare,
)
from apertura.core.backprojection.engines.tree_prediction import candidates

__all__ = ["READS", "VARIANTS", "available", "candidates", "form", "instruction_set", "pieces", "prepare"]

READS: Literal["profiles"] = "profiles"

VARIANTS = ("by tree", "directly", "without an echo")


class Options(EngineOptions):
    """Options of the engine."""

    oversampling: Annotated[int, Field(ge=8, le=64)] | None = Field(
        None, description="table cells per resolution cell c/B of total path"
    )
    nodes_db: Literal[-50, -56, -62, -68, -74, -80, -86, -92, -98] | None = Field(
        None, description="tolerated error of one interpolation between nodes, dB"
    )
    presum_db: Annotated[int, Field(ge=-100, le=-38)] | None = Field(
        None, description="tolerated error from deviations of the track from the curve of the virtual pulses, dB"
    )
    side_px: Annotated[int, Field(ge=16, le=TREE.side)] | None = Field(
        None, description="largest side of a tile of a tree, pixels"
    )
    chunk: Literal[256, 512, 1024, 2048] | None = Field(None, description="number of pulses of the largest subaperture")
    height_layers: Annotated[int, Field(ge=0, le=MOST_LAYERS)] | None = Field(
        None, description="largest number of height layers for the interpolation of a tile of rough terrain"
    )


def form(
    trees: Trees,
    pixels: NDArray[np.float64],
    *,
    beams: Beams | None = None,
    nodes_db: int = -74,
    presum_db: int = -74,
    side_px: int = 128,
    chunk: int = 1024,
    height_layers: int = 0,
    counts: NDArray[np.int64] | None = None,
) -> NDArray[np.complex64]:
    """Sum the pulses at a block of pixels.

    Parameters
    ----------
    trees
        Trees from `prepare`.
    pixels
        (y, x, 3) float64, metres, in the frame of the phase centres, on any surface.
    beams
        Weight of each pulse at each pixel (default: 1).
    nodes_db
        Tolerated error of one interpolation between nodes, dB.
    presum_db
        Tolerated RMS error from deviations of the track from the curve of the virtual pulses, dB.
    side_px
        Largest side of the tiles into which the block is divided; the bits of a tile do not depend on other tiles.
    chunk
        Number of pulses of the largest subaperture.
    height_layers
        Largest number of height layers for the interpolation of a tile of rough terrain; tiles that require more layers
        are summed directly.
    counts
        (3,) int64 array to which the numbers of pixel-pulse contributions are added: summed by tree, summed directly,
        and without an echo.

    Returns
    -------
    ndarray
        (y, x) complex64. Pulses do not contribute to pixels that are not covered by their profiles; a pixel without a
        finite position is NaN.

    Raises
    ------
    ValueError
        If the shape of `pixels` is not (y, x, 3), if beams have a different number of pulses, or if an option is not in
        the range of `Options`.
    MemoryError
        If the library cannot allocate memory.

    Notes
    -----
    Source: docs/theory/tree.md.
    """
    options = {"nodes_db": nodes_db, "presum_db": presum_db, "side_px": side_px, "chunk": chunk}
    Options.model_validate(options | {"height_layers": height_layers})
    if beams is not None and any(b is not None and len(b.axes) != len(trees) for b in (beams.transmit, beams.receive)):
        raise ValueError(f"beams must have {len(trees)} pulses")
    pixels = checked_pixels(pixels)
    image = np.zeros(pixels.shape[:2], np.complex64)
    block = partial(_Block, trees, nodes_db, presum_db, chunk)
    flat = block(pixels, image)
    tiles = flat.tiles(list(windows(pixels.shape[:2], side_px)))
    rough = {tile: layers for tile in tiles if not tile.by_tree and (layers := flat.height_layers(tile, height_layers))}
    flat.sum(beams, [tile for tile in tiles if tile not in rough])
    total = flat.counts
    for tile, layers in rough.items():
        layer_pixels = layers.pixels
        on_layers = block(layer_pixels, np.zeros(layer_pixels.shape[:2], np.complex64))
        on_layers.sum(beams, on_layers.tiles(layers.windows))
        image[tile.window] = layers.read(on_layers.image, trees.middle, trees.wavenumber_rad_m)
        of_tile = on_layers.counts // len(layers.heights_m)
        total += of_tile
        total[0] += image[tile.window].size * len(trees) - of_tile.sum()  # remainder of the division
    if counts is not None:
        counts += total
    return image


def pieces(shape: tuple[int, ...], form_options: Mapping[str, Any]) -> Iterator[Window]:
    """Yield the tiles of a block of pixels: windows that can be formed independently with bit-identical results."""
    return windows(shape, form_options["side_px"])


@dataclass(eq=False)
class _Block:
    """Sum over all pulses at a block of pixels: image, tolerated errors, and number of contributions per variant."""

    trees: Trees
    nodes_db: int
    presum_db: int
    chunk: int
    pixels: NDArray[np.float64]
    image: NDArray[np.complex64]
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(VARIANTS), np.int64))
    _quarters: dict[JobTile, list[JobTile]] = field(default_factory=dict)

    def tiles(self, tile_windows: list[Window]) -> list[JobTile]:
        """Return the tiles that correspond to windows of the block; small or rough tiles are not summed by tree."""
        limit = 2 * 10 ** (self.nodes_db / 10)
        return [
            JobTile(
                window,
                surface,
                self.pixels[window].size >= 3 * LEAST_PIXELS and self.trees.roughness(surface) <= limit,
            )
            for window, surface in zip(tile_windows, surfaces_of(self.pixels, tile_windows), strict=True)
        ]

    def height_layers(self, tile: JobTile, most: int) -> HeightLayers | None:
        """Return the height layers for a tile with rough terrain; None if more than `most` layers are required."""
        trees, limit = self.trees, 10 ** (self.nodes_db / 20)
        pixels = self.pixels[tile.window]
        if not most or not np.isfinite(tile.surface.rough_m) or pixels.size < 3 * LEAST_PIXELS:
            return None
        relief = SurfaceResidual.of(tile.surface, pixels)
        if trees.wavenumber_rad_m * relief.aside_m > limit:
            return None
        wave = {"wavenumber_rad_m": trees.wavenumber_rad_m, "band_rad_m": trees.band_rad_m}
        band = relief.band_rad(trees.profiles.aperture, **wave)
        return HeightLayers.of(relief, band, self.nodes_db) if layers_for(band, self.nodes_db) <= most else None

    def sum(self, beams: Beams | None, tiles: list[JobTile]) -> None:
        """Add all pulses to the image at the given tiles."""
        for pulses in self.trees.chunks(self.chunk):
            trees = self.trees[pulses]
            all_groups = np.ones(-(-len(trees) // LEAF), bool)
            if tiles:
                self.add(trees, beams and beams[pulses], [(tile, all_groups) for tile in tiles])

    def add(self, trees: Trees, beams: Beams | None, tasks: list[Task]) -> None:
        """Add groups of pulses to tiles, by tree if possible, otherwise on quarters of the tile, or directly."""
        chunk = Chunk(
            trees, beams, self.nodes_db, self.presum_db, subaperture_sizes(self.chunk), self.pixels, self.image
        )
        pulses_of = np.minimum(LEAF, len(trees) - LEAF * np.arange(-(-len(trees) // LEAF)))
        remaining: list[Task] = []
        for (tile, selected), variants in zip(tasks, chunk.add(tasks), strict=True):
            direct = selected & (variants == DIRECTLY)
            smaller = self._quartered(tile) if direct.any() else []
            remaining += [(quarter, direct) for quarter in smaller]
            done = selected & ~direct if smaller else selected
            self.counts += self.image[tile.window].size * np.bincount(variants[done], pulses_of[done], 3).astype(
                np.int64
            )
            for run in () if smaller else _runs(direct, len(trees)):
                self.image[tile.window] += native.form(
                    trees.direct_tables(self.nodes_db)[run],
                    self.pixels[tile.window],
                    beams=beams and beams[run],
                    tolerance_rad=self.trees.direct_setting(self.nodes_db).tolerance_rad,
                )
        if remaining:
            self.add(trees, beams, remaining)

    def _quartered(self, tile: JobTile) -> list[JobTile]:
        """Return the quarters of a tile, over which the geometry is smoother; empty for a small tile."""
        rows, columns = tile.window
        if min(rows.stop - rows.start, columns.stop - columns.start) < 2 * LEAST_QUARTER_PX:
            return []
        if tile not in self._quarters:
            tops, lefts = (
                (slice(part.start, middle), slice(middle, part.stop))
                for part, middle in ((part, (part.start + part.stop) // 2) for part in tile.window)
            )
            self._quarters[tile] = self.tiles(list(product(tops, lefts)))
        return self._quarters[tile]


def _runs(groups: NDArray[np.bool_], pulses: int) -> Iterator[slice]:
    """Yield contiguous slices of pulses in the selected groups."""
    edges = [0, *(np.flatnonzero(np.diff(groups)) + 1).tolist(), len(groups)]
    for first, last in pairwise(edges):
        if groups[first]:
            yield slice(first * LEAF, min(pulses, last * LEAF))
