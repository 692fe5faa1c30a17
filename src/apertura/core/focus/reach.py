"""Which pulses may add something to which pieces of a scene: the others are neither read, nor prepared, nor summed."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import reached
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import balls
from apertura.core.scene.terrain import Terrain

PULSES = 64
"""What is decided about at once; engines sum in blocks of as many, so leaving out what adds nothing changes no bit."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Which blocks of 64 pulses may weigh anything in which pieces of a scene.

    Attributes
    ----------
    lit
        (block, piece) bool.
    pulses
        How many there are.

    Examples
    --------
    >>> reach = Reach(np.array([[False, True], [True, True], [False, True]]), 150)
    >>> reach.within(0, slice(0, 150)), reach.within(1, slice(64, 150)), reach.within(0, slice(128, 150))
    (slice(64, 128, None), slice(0, 86, None), None)
    """

    lit: NDArray[np.bool_]
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
        """Return that of windows of a scene; without beams or sector every pulse reaches all of them.

        Parameters
        ----------
        beams, aperture
            Of every pulse.
        grid, terrain
            The scene.
        windows
            Its pieces.
        """
        if beams is None:
            return cls(np.ones((-(-len(aperture) // PULSES), len(windows)), bool), len(aperture))
        return cls(reached(beams, aperture, *balls(grid, terrain, windows), pulses=PULSES), len(aperture))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(piece,) bool: whether any pulse may see it."""
        return np.asarray(self.lit.any(axis=0))

    def within(self, piece: int, block: slice) -> slice | None:
        """Return the first to the last pulse of a block of pulses that may see a piece, counted from the block's start.

        None where none does. `block` begins at a multiple of 64, unless every pulse reaches the piece.
        """
        if self.lit[:, piece].all():
            return slice(0, block.stop - block.start)
        first = block.start // PULSES
        lit = np.flatnonzero(self.lit[first : -(-block.stop // PULSES), piece])
        if not lit.size:
            return None
        return slice(int(lit[0]) * PULSES, min(int(lit[-1] + 1) * PULSES, block.stop - block.start))


def pulse_blocks_of(pulses: int, count: int, *, whole: bool) -> list[slice]:
    """Return consecutive blocks of pulses of about one length.

    Parameters
    ----------
    pulses, count
        How many there are, and into how many blocks they go at most.
    whole
        Whether pieces are all reached by every pulse; else blocks begin at multiples of 64.

    Examples
    --------
    >>> pulse_blocks_of(200, 2, whole=False)
    [slice(0, 64, None), slice(64, 200, None)]
    """
    step = 1 if whole else PULSES
    ends = [number * pulses // count // step * step for number in range(count)] + [pulses]
    return [slice(*pair) for pair in pairwise(ends) if pair[0] < pair[1]]
