"""What forms one image, opened once: inputs, scene, antennas and plan, handed to tiles, certificate and measures."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apertura.common.contracts import Window
from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import reached
from apertura.core.focus.contributions import band_limited_image
from apertura.core.focus.engines import load_engine, pieces, reference
from apertura.core.focus.engines.engine import Setting
from apertura.core.focus.inputs import PhaseHistory, Profiles
from apertura.core.focus.reach import PULSES, Reach, pulse_blocks_of
from apertura.core.focus.tiles import Weighing, image_array
from apertura.core.planning.plan import Plan
from apertura.core.scene.grid import SceneGrid

if TYPE_CHECKING:
    from dask.array.core import Array

PULSES_READ = 1024
"""Of a phase history at once, or of profiles where places are looked at closely."""


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
        How it is formed, on which model of the ground, and how pulses are weighed.
    side_px
        Of a tile.
    """

    history: PhaseHistory | None
    profiles: Profiles
    grid: SceneGrid
    plan: Plan
    side_px: int

    @property
    def beams(self) -> Beams | None:
        """What weighs pulses: antennas and the sector integrated; None where every pulse counts alike."""
        return self.plan.beams

    @property
    def count(self) -> int:
        """Pulses that 1 stands for."""
        return self.plan.count or len(self.profiles)

    @property
    def tiles(self) -> list[Window]:
        """Every tile of the grid."""
        return list(self.grid.tiles(self.side_px))

    @cached_property
    def windows(self) -> list[Window]:
        """Every tile that a pulse may see, a whole one first if there is one; the others are not formed, and zero."""
        tiles = self.tiles
        reach = Reach.of(self.beams, self.profiles.aperture, self.grid, self.plan.terrain, tiles)
        seen = [tile for tile, lit in zip(tiles, reach.seen, strict=True) if lit]
        side = tuple(min(self.side_px, size) for size in self.grid.shape)
        whole = next((tile for tile in seen if tuple(part.stop - part.start for part in tile) == side), None)
        return tiles if whole is None else [whole, *(tile for tile in seen if tile is not whole)]

    @cached_property
    def ways(self) -> Counter[str]:
        """Way of an engine → pixels × pulses that went so in this process; empty where an engine has one way."""
        return Counter()

    @cached_property
    def _pieces_of(self) -> dict[tuple[int, ...], list[Window]]:
        return {}

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
        total = np.zeros(len(places), np.complex128)
        for pulses, seen in self.seeing(places):
            some = (self.history or self.profiles)[pulses]
            for part, lit in seen:
                weights = self.beams and self.beams[pulses][part]
                total[lit] += _exact_sum(some[part], places[lit], weights)
        return np.asarray(total / self.count)

    def values(self, pixels: NDArray[np.int64]) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
        """Return the planned image at (pixel, 2) rows and columns, forming just what the engine needs for each.

        (pixel,) complex64, and mean |I|² over the pieces formed, (pixel,) float64.
        """
        windows = list(dict.fromkeys(self._piece(*pixel) for pixel in pixels.tolist()))
        image = dict(zip(windows, self.image_of([_slices(window) for window in windows]), strict=True))
        values, power = np.zeros(len(pixels), np.complex64), np.zeros(len(pixels))
        for number, (row, column) in enumerate(pixels.tolist()):
            top, _, left, _ = window = self._piece(row, column)
            values[number], power[number] = image[window][row - top, column - left], (np.abs(image[window]) ** 2).mean()
        return values, power

    def _piece(self, row: int, column: int) -> tuple[int, int, int, int]:
        """Return first and last row, first and last column of what the planned engine forms a pixel with."""
        tile = [
            (at // self.side_px * self.side_px, size) for at, size in zip((row, column), self.grid.shape, strict=True)
        ]
        shape = tuple(min(self.side_px, size - first) for first, size in tile)
        (top, _), (left, _) = tile
        for rows, columns in self._pieces(shape):
            if rows.start <= row - top < rows.stop and columns.start <= column - left < columns.stop:
                return top + rows.start, top + rows.stop, left + columns.start, left + columns.stop
        raise IndexError(f"pixel {row}, {column} of {self.grid.shape}")

    def _pieces(self, shape: tuple[int, ...]) -> list[Window]:
        if shape not in self._pieces_of:
            self._pieces_of[shape] = pieces(self.plan.setting.engine, shape, self.plan.setting.form_options)
        return self._pieces_of[shape]

    def image_of(self, windows: Sequence[Window]) -> list[NDArray[np.complex64]]:
        """Return the planned image in windows that begin at patches of an engine, block of pulses by block."""
        setting, beams, presum = self.plan.setting, self.beams, self.plan.presumming
        engine, inputs = load_engine(setting.engine), self._inputs(setting)
        if isinstance(inputs, Profiles) and presum is not None:
            inputs = self.plan.inputs(inputs)
        reach = Reach.of(beams, inputs.aperture, self.grid, self.plan.terrain, windows)
        places = [self.plan.terrain.positions(self.grid[window]) for window in windows]
        image = [np.zeros(place.shape[:2], np.complex64) for place in places]
        for block in pulse_blocks_of(len(inputs), setting.pulse_blocks, whole=beams is None):
            tables = engine.prepare(inputs[block], **setting.options)
            for number, place in enumerate(places):
                if (part := reach.within(number, block)) is not None:
                    some = tables if part == slice(0, block.stop - block.start) else tables[part]
                    weights = beams and beams[block][part]
                    image[number] += engine.form(some, place, beams=weights, **setting.form_options) / self.count
        return image

    def contributions(self, row: ArrayLike, column: ArrayLike) -> list[NDArray[np.complex128]]:
        """Return what each pulse that sees a fractional pixel adds to it, pixel by pixel, (pulse,) complex128.

        Raises
        ------
        ValueError
            If there are only profiles.
        """
        if self.history is None:
            raise ValueError("profiles do not tell what each pulse adds")
        places = self.positions_at(np.atleast_1d(row), np.atleast_1d(column))
        parts: list[list[NDArray[np.complex128]]] = [[np.empty(0, np.complex128)] for _ in places]
        for pulses, seen in self.seeing(places):
            some = self.history[pulses]
            for part, lit in seen:
                terms = reference.terms(some[part], places[lit], self.beams and self.beams[pulses][part])
                for place, column_of in zip(np.flatnonzero(lit), terms.T, strict=True):
                    parts[place].append(column_of[column_of != 0])
        return [np.concatenate(part) for part in parts]

    def seeing(self, places: NDArray[np.float64]) -> Iterator[tuple[slice, list[tuple[slice, NDArray[np.bool_]]]]]:
        """Yield blocks of pulses to be read, each with the parts of it that may see some places, and which.

        Parameters
        ----------
        places
            (place, 3) float64, metres.
        """
        aperture, beams = self.profiles.aperture, self.beams
        lit = reached(beams, aperture, places, np.zeros(len(places)), pulses=PULSES)
        for first in range(0, len(aperture), PULSES_READ):
            block = slice(first, min(first + PULSES_READ, len(aperture)))
            length = block.stop - block.start
            rows = lit[first // PULSES : -(-block.stop // PULSES)]
            parts = [
                (slice(number * PULSES, min(length, (number + 1) * PULSES)), row)
                for number, row in enumerate(rows)
                if row.any()
            ]
            if parts:
                yield block, parts

    def _inputs(self, setting: Setting) -> PhaseHistory | Profiles:
        if load_engine(setting.engine).READS == "profiles":
            return self.profiles
        if self.history is None:
            raise ValueError(f"engine {setting.engine} reads a phase history; there are only profiles")
        return self.history

    def _array(self, setting: Setting, *, presum: bool) -> "Array":
        inputs = self._inputs(setting)
        summed = self.plan.presumming if presum and isinstance(inputs, Profiles) else None
        return image_array(
            inputs,
            setting,
            self.grid,
            self.plan.terrain,
            side_px=self.side_px,
            weighing=Weighing(self.beams, summed, self.plan.count, self.ways),
        )


def _slices(window: tuple[int, int, int, int]) -> Window:
    return slice(*window[:2]), slice(*window[2:])


def _exact_sum(
    inputs: PhaseHistory | Profiles, places: NDArray[np.float64], beams: Beams | None
) -> NDArray[np.complex128]:
    if isinstance(inputs, PhaseHistory):
        return reference.form(inputs, places, beams=beams)
    return band_limited_image(inputs, places, beams=beams)
