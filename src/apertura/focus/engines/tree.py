"""Backprojection by subaperture trees on Cartesian tiles: faster by the order of things for large images.

A tile's tree sums few pulses at few nodes, and merges subapertures on ever more nodes until the pixels themselves are
the nodes (docs/theory/tree.md). Tiles depend on nothing but their own pixels. Pulses and tiles that a tree cannot take
go through the direct kernel.
"""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from apertura.antenna.beam import Beams
from apertura.contracts import Window
from apertura.focus.engines import native
from apertura.focus.engines.engine import EngineOptions, checked_pixels
from apertura.focus.engines.native_binding import available, instruction_set
from apertura.focus.engines.native_structs import TREE_GROUP, TREE_SIDE
from apertura.focus.engines.tree_chunk import Chunk, Tile
from apertura.focus.engines.tree_inputs import DIRECTLY_AT, Trees, prepare
from apertura.focus.engines.tree_prediction import candidates
from apertura.focus.engines.tree_surface import surfaces_of, windows
from apertura.focus.engines.tree_track import subaperture_sizes
from apertura.focus.engines.tree_weights import DIRECTLY

__all__ = ["READS", "WAYS", "available", "candidates", "form", "instruction_set", "pieces", "prepare"]

READS: Literal["profiles"] = "profiles"

WAYS = ("by tree", "directly", "without an echo")


LEAST_PIXELS = 32**2
"""Of a tile: fewer go directly."""


class Options(EngineOptions):
    """What may be asked of the engine."""

    oversampling: Annotated[int, Field(ge=8, le=64)] | None = Field(
        None, description="table cells per resolution cell c/B of total path"
    )
    nodes_db: Literal[-50, -56, -62, -68, -74, -80, -86, -92, -98] | None = Field(
        None, description="what one interpolation between nodes may err by, dB"
    )
    presum_db: Annotated[int, Field(ge=-100, le=-40)] | None = Field(
        None, description="what pulses may err by for which fewer stand, of what their track leaves a smooth curve, dB"
    )
    side_px: Annotated[int, Field(ge=16, le=TREE_SIDE)] | None = Field(
        None, description="largest side of a tree's tile, pixels"
    )
    chunk: Literal[256, 512, 1024, 2048] | None = Field(None, description="pulses of the largest subaperture")


def form(
    trees: Trees,
    pixels: NDArray[np.float64],
    *,
    beams: Beams | None = None,
    nodes_db: int = -74,
    presum_db: float = -74,
    side_px: int = 128,
    chunk: int = 1024,
    counts: NDArray[np.int64] | None = None,
) -> NDArray[np.complex64]:
    """Sum the pulses over a block of pixels.

    Parameters
    ----------
    trees
        From `prepare`.
    pixels
        (y, x, 3) float64, metres, in the frame of the phase centres: any surface.
    beams
        Weight of each pulse at each pixel; none by default.
    nodes_db
        What one interpolation between nodes may err by, dB.
    presum_db
        What pulses may err by for which fewer stand, of what their track leaves a smooth curve, dB RMS.
    side_px
        Of the tiles that the block is cut into, at most; each gets the same bits with or without the others.
    chunk
        Pulses of the largest subaperture.
    counts
        (3,) int64 to which the number of pixels × pulses is added that went by tree, directly, or had no echo.

    Returns
    -------
    ndarray
        (y, x) complex64. Pulses whose profile does not reach a pixel add zero; a pixel without a finite position is
        NaN.

    Raises
    ------
    ValueError
        If `pixels` has another shape, or beams are of other pulses.
    MemoryError
        If the library found no memory.

    Notes
    -----
    Source: docs/theory/tree.md.
    """
    if beams is not None and any(b is not None and len(b.axes) != len(trees) for b in (beams.transmit, beams.receive)):
        raise ValueError(f"beams must be of {len(trees)} pulses")
    pixels = checked_pixels(pixels)
    image = np.zeros(pixels.shape[:2], np.complex64)
    tally = np.zeros(3, np.int64)
    tiles = _tiles(trees, pixels, side_px, nodes_db)
    sizes = subaperture_sizes(chunk)
    for pulses in trees.chunks(chunk):
        some, weighing = trees[pulses], beams and beams[pulses]
        ways = Chunk(some, weighing, nodes_db, presum_db, sizes, pixels, image).add(tiles)
        for tile, way in zip(tiles, ways, strict=True):
            for run in _direct_runs(way, len(some)):
                part, weights = some.direct(nodes_db)[run], weighing and weighing[run]
                tolerance_rad = DIRECTLY_AT[nodes_db].tolerance_rad
                image[tile.window] += native.form(part, pixels[tile.window], beams=weights, tolerance_rad=tolerance_rad)
            pulses_of = np.minimum(TREE_GROUP, len(some) - TREE_GROUP * np.arange(len(way)))
            tally += image[tile.window].size * np.bincount(way, pulses_of, 3).astype(np.int64)
    if counts is not None:
        counts += tally
    return image


def pieces(shape: tuple[int, ...], form_options: Mapping[str, Any]) -> Iterator[Window]:
    """Yield the windows of a block of pixels that get the same bits when they are formed alone: its tiles."""
    return windows(shape, form_options["side_px"])


def _tiles(trees: Trees, pixels: NDArray[np.float64], side_px: int, nodes_db: int) -> list[Tile]:
    """Return the tiles of a block; those that are small or rough do not go by tree."""
    parts = list(windows(pixels.shape[:2], side_px))
    limit = 2 * 10 ** (nodes_db / 10)
    return [
        Tile(part, surface, pixels[part].size >= 3 * LEAST_PIXELS and trees.roughness(surface) <= limit)
        for part, surface in zip(parts, surfaces_of(pixels, parts), strict=True)
    ]


def _direct_runs(way: NDArray[np.uint8], pulses: int) -> Iterator[slice]:
    """Yield runs of pulses that are taken directly."""
    edges = [0, *(np.flatnonzero(np.diff(way)) + 1).tolist(), len(way)]
    for first, last in pairwise(edges):
        if way[first] == DIRECTLY:
            yield slice(first * TREE_GROUP, min(pulses, last * TREE_GROUP))
