"""What forms one image, opened once: inputs, scene, antennas and plan, handed to tiles, certificate and measures."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apertura.antenna.beam import Beams
from apertura.contracts import Window
from apertura.focus.band_limited import band_limited_image
from apertura.focus.engines import PATCH_PX, load_engine, reference
from apertura.focus.engines.engine import Setting
from apertura.focus.inputs import PhaseHistory, Profiles
from apertura.focus.tiles import image_array
from apertura.planning.plan import Plan
from apertura.scene.grid import SceneGrid

if TYPE_CHECKING:
    from dask.array.core import Array

_PULSES_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class Formation:
    """Everything that forms the tiles of one image.

    Attributes
    ----------
    history
        What was recorded, which the double sum reads; None where there are only profiles.
    profiles
        The same as range profiles, which table engines read.
    grid
        Of the image.
    plan
        How it is formed, and on which model of the ground.
    side_px
        Of a tile.
    beams
        Of the antennas; None where they are isotropic.
    """

    history: PhaseHistory | None
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
        """Return the image at (pixel, 2) rows and columns, (pixel,) complex128, by the double sum over the history.

        Where there are only profiles, by their band-limited interpolation in float64.
        """
        places = self.positions_at(*pixels.T)
        if self.history is None:
            total = band_limited_image(self.profiles, places, beams=self.beams)
        else:
            total = reference.form(self.history, places, beams=self.beams)
        return np.asarray(total / len(self.profiles))

    def values(self, pixels: NDArray[np.int64]) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
        """Return the planned image at (pixel, 2) rows and columns, forming just the patch of each.

        (pixel,) complex64, and mean |I|² over those patches, (pixel,) float64.
        """
        setting, side = self.plan.setting, PATCH_PX
        engine, inputs = load_engine(setting.engine), self._inputs(setting)
        if isinstance(inputs, Profiles):
            inputs = self.plan.inputs(inputs)
        tables, values = engine.prepare(inputs, **setting.options), np.empty(len(pixels), np.complex64)
        power = np.empty(len(pixels))
        for index, (row, column) in enumerate(pixels):
            top, left = row // side * side, column // side * side
            places = self.plan.terrain.positions(self.grid[top : top + side, left : left + side])
            patch = engine.form(tables, places, beams=self.beams, **setting.form_options) / len(self.profiles)
            values[index], power[index] = patch[row - top, column - left], (np.abs(patch) ** 2).mean()
        return values, power

    def contributions(self, row: ArrayLike, column: ArrayLike) -> NDArray[np.complex128]:
        """Return what each pulse adds at fractional pixels, (pulse, pixel) complex128; 0 where it does not see one.

        Raises
        ------
        ValueError
            If there are only profiles.
        """
        if self.history is None:
            raise ValueError("profiles do not tell what each pulse adds")
        places = self.positions_at(np.atleast_1d(row), np.atleast_1d(column))
        parts = [slice(first, first + _PULSES_AT_ONCE) for first in range(0, len(self.history), _PULSES_AT_ONCE)]
        beams = self.beams
        return np.concatenate([reference.terms(self.history[part], places, beams and beams[part]) for part in parts])

    def _inputs(self, setting: Setting) -> PhaseHistory | Profiles:
        if load_engine(setting.engine).READS == "profiles":
            return self.profiles
        if self.history is None:
            raise ValueError(f"engine {setting.engine} reads a phase history; there are only profiles")
        return self.history

    def _array(self, setting: Setting, *, presum: bool) -> "Array":
        inputs = self._inputs(setting)
        return image_array(
            inputs,
            setting,
            self.grid,
            self.plan.terrain,
            side_px=self.side_px,
            beams=self.beams,
            presum=self.plan.presumming if presum and isinstance(inputs, Profiles) else None,
        )
