"""Nodes at every so many pixels of a raster, and what changes slowly interpolated between them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window

BLOCK_PX = 256
"""Side of the pieces in which a raster is computed."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Nodes at every `pitch_px` pixels of a raster, and at its last row and column.

    Attributes
    ----------
    nodes
        Rows and columns of pixels, int64 each.
    pitch_px
        Pixels between nodes.

    Examples
    --------
    >>> lattice = Lattice.of((20, 40))
    >>> [at.tolist() for at in lattice.nodes]
    [[0, 16, 19], [0, 16, 32, 39]]
    >>> lattice.between(np.add.outer(lattice.nodes[0], lattice.nodes[1]), (slice(4, 5), slice(37, 39)))
    array([[41., 42.]])
    """

    nodes: tuple[NDArray[np.int64], NDArray[np.int64]]
    pitch_px: int

    @classmethod
    def of(cls, shape: tuple[int, int], pitch_px: int = 16) -> "Lattice":
        """Return the lattice of a raster; `BLOCK_PX` is a multiple of the pitch."""
        rows, columns = (np.append(np.arange(0, size - 1, pitch_px), size - 1) for size in shape)
        return cls((rows, columns), pitch_px)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of nodes."""
        return (len(self.nodes[0]), len(self.nodes[1]))

    @property
    def blocks(self) -> list[Window]:
        """Windows of nodes, one for each tile of `BLOCK_PX` pixels: those in it, row by row of tiles."""
        rows, columns = (
            [
                slice(*np.searchsorted(at, [first, first + BLOCK_PX]).tolist())
                for first in range(0, int(at[-1]) + 1, BLOCK_PX)
            ]
            for at in self.nodes
        )
        return [(row, column) for row in rows for column in columns]

    def between(self, values: NDArray[Any], window: Window, *, farthest: float | None = None) -> NDArray[np.float64]:
        """Return values at the pixels of a window, bilinear between nodes.

        Parameters
        ----------
        values
            (node row, node column, ...).
        window
            Of pixels.
        farthest
            Length of the difference (last axis) of two corners of a cell above which the nearest corner counts.
        """
        (low, high, up), (left, right, across) = (_cells(at, part) for at, part in zip(self.nodes, window, strict=True))
        extra = (1,) * (values.ndim - 2)
        up, across = up.reshape(-1, 1, *extra), across.reshape(1, -1, *extra)
        corners = [values[np.ix_(row, column)] for row in (low, high) for column in (left, right)]
        top, bottom = (one + across * (other - one) for one, other in (corners[:2], corners[2:]))
        smooth = np.asarray(top + up * (bottom - top), np.float64)
        if farthest is None:
            return smooth
        apart = np.max([np.linalg.norm(corner - corners[0], axis=-1) for corner in corners[1:]], axis=0)
        jumps = (apart > farthest).any(axis=tuple(range(2, apart.ndim)))
        if jumps.any():
            near = values[np.ix_(np.where(up.ravel() < 0.5, low, high), np.where(across.ravel() < 0.5, left, right))]
            smooth[jumps] = near[jumps]
        return smooth

    def amid_positive(self, values: NDArray[Any], window: Window) -> NDArray[np.bool_]:
        """Return which pixels of a window, (row, column), lie among corners that are all positive."""
        (low, high, _), (left, right, _) = (_cells(at, part) for at, part in zip(self.nodes, window, strict=True))
        corners = [values[np.ix_(row, column)] > 0 for row in (low, high) for column in (left, right)]
        return np.asarray(np.logical_and.reduce(corners))

    def nearest(self, window: Window) -> list[tuple[tuple[int, int], Window]]:
        """Return the nodes nearest to the pixels of a window, each with the part of the window that is its."""
        owned = []
        for at, part in zip(self.nodes, window, strict=True):
            ends = np.append((at[1:] + at[:-1] + 1) // 2, at[-1] + 1)
            starts = np.append(0, ends[:-1])
            first, last = np.searchsorted(ends, [part.start, part.stop - 1], side="right")
            owned.append(
                [
                    (node, slice(max(part.start, int(starts[node])), min(part.stop, int(ends[node]))))
                    for node in range(int(first), int(last) + 1)
                ]
            )
        return [((row, column), (rows, columns)) for row, rows in owned[0] for column, columns in owned[1]]


def _cells(nodes: NDArray[np.int64], part: slice) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the nodes before and after each pixel, and how far between them it lies."""
    at = np.arange(part.start, part.stop)
    before = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, max(0, len(nodes) - 2))
    after = np.minimum(before + 1, len(nodes) - 1)
    return before, after, (at - nodes[before]) / np.maximum(1, nodes[after] - nodes[before])
