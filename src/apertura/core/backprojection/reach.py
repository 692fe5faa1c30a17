"""Selection of the pulses that may contribute to windows of a scene: other pulses are not read, prepared or summed."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import illumination_mask
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import balls
from apertura.core.scene.terrain import Terrain

PULSES = 64
"""Number of pulses per block. Engines sum blocks of this size: omitting blocks without a contribution leaves images
bit-identical."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Mask of the blocks of 64 pulses that may contribute to windows of a scene.

    Attributes
    ----------
    mask
        (block, window) bool.
    pulses
        Number of pulses.

    Examples
    --------
    >>> reach = Reach(np.array([[False, True], [True, True], [False, True]]), 150)
    >>> reach.within(0, slice(0, 150)), reach.within(1, slice(64, 150)), reach.within(0, slice(128, 150))
    (slice(64, 128, None), slice(0, 86, None), None)
    """

    mask: NDArray[np.bool_]
    pulses: int

    @classmethod
    def of(
        cls,
        beams: Beams | None,
        aperture: Aperture,
        grid: SceneGrid,
        terrain: Terrain,
        windows: Sequence[tuple[slice, slice]],
    ) -> "Reach":
        """Return the mask for windows of a scene; without beams and sector, every pulse contributes to all windows.

        Parameters
        ----------
        beams, aperture
            Beams and aperture of all pulses.
        grid, terrain
            The scene.
        windows
            Windows of the scene.
        """
        if beams is None:
            return cls(np.ones((-(-len(aperture) // PULSES), len(windows)), bool), len(aperture))
        return cls(illumination_mask(beams, aperture, *balls(grid, terrain, windows), pulses=PULSES), len(aperture))

    @property
    def illuminated(self) -> NDArray[np.bool_]:
        """(window,) bool, True if any pulse may illuminate the window."""
        return np.asarray(self.mask.any(axis=0))

    def within(self, piece: int, block: slice) -> slice | None:
        """Return the slice from the first to the last pulse of a block that may illuminate a window.

        The slice is relative to the start of the block; None if no pulse may illuminate the window. `block` starts at a
        multiple of 64, unless every pulse contributes to the window.
        """
        if self.mask[:, piece].all():
            return slice(0, block.stop - block.start)
        first = block.start // PULSES
        mask = np.flatnonzero(self.mask[first : -(-block.stop // PULSES), piece])
        if not mask.size:
            return None
        return slice(int(mask[0]) * PULSES, min(int(mask[-1] + 1) * PULSES, block.stop - block.start))


def pulse_blocks_of(pulses: int, count: int, *, any_start: bool) -> list[slice]:
    """Return consecutive pulse blocks of approximately equal length.

    Parameters
    ----------
    pulses, count
        Number of pulses, and largest number of blocks.
    any_start
        True if blocks may start at any pulse because every pulse contributes to every window; otherwise blocks start at
        multiples of 64.

    Examples
    --------
    >>> pulse_blocks_of(200, 2, any_start=False)
    [slice(0, 64, None), slice(64, 200, None)]
    """
    step = 1 if any_start else PULSES
    ends = [number * pulses // count // step * step for number in range(count)] + [pulses]
    return [slice(*pair) for pair in pairwise(ends) if pair[0] < pair[1]]
