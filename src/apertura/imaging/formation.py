"""What forms one image, opened once: inputs, scene, antennas and plan, handed to tiles, certificate and measures."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apertura.antenna.beam import Beams
from apertura.contracts import Window
from apertura.focus.engines import load_engine, reference
from apertura.focus.engines.engine import Setting
from apertura.focus.inputs import PhaseHistory, Profiles
from apertura.focus.tiles import image_array
from apertura.planning.plan import Plan
from apertura.scene.grid import SceneGrid

if TYPE_CHECKING:
    from dask.array.core import Array


@dataclass(frozen=True, eq=False)
class Formation:
    """Everything that forms the tiles of one image.

    Attributes
    ----------
    history
        What was recorded, which the double sum reads.
    profiles
        The same as range profiles, which table engines read.
    grid
        Of the image.
    plan
        How it is formed, and on which model of the ground.
    side_px
        Of a tile.
    beams
        Of the antennas; None where they look everywhere alike.
    """

    history: PhaseHistory
    profiles: Profiles
    grid: SceneGrid
    plan: Plan
    side_px: int
    beams: Beams | None = None

    @property
    def windows(self) -> list[Window]:
        """Every tile."""
        return list(self.grid.tiles(self.side_px))

    @property
    def image(self) -> "Array":
        """The image as planned: a dask array, (row, column) complex64, whose chunks are the tiles."""
        return self._array(self.plan.setting, presum=True)

    def image_by(self, setting: Setting) -> "Array":
        """Return the image by another setting, from every pulse as it is."""
        return self._array(setting, presum=False)

    def positions_at(self, row: ArrayLike, column: ArrayLike) -> NDArray[np.float64]:
        """Return (..., 3) float64 positions (m) of fractional pixel indices, on the ground."""
        return self.plan.terrain.positions_at(self.grid, row, column)

    def exact(self, pixels: NDArray[np.int64]) -> NDArray[np.complex128]:
        """Return the image at (pixel, 2) rows and columns by the double sum, (pixel,) complex128."""
        return reference.form(self.history, self.positions_at(*pixels.T), beams=self.beams) / len(self.history)

    def contributions(self, row: float, column: float) -> NDArray[np.complex128]:
        """Return what each pulse that sees a place adds there, (pulse,) complex128."""
        place = self.positions_at(np.array([row]), np.array([column]))
        terms = reference.terms(self.history, place, self.beams)[:, 0]
        return np.asarray(terms[terms != 0])

    def _array(self, setting: Setting, *, presum: bool) -> "Array":
        inputs = self.profiles if load_engine(setting.engine).READS == "profiles" else self.history
        return image_array(
            inputs,
            setting,
            self.grid,
            self.plan.terrain,
            side_px=self.side_px,
            beams=self.beams,
            presum=self.plan.presumming if presum and isinstance(inputs, Profiles) else None,
        )
