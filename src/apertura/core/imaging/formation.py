"""Image formation: inputs, scene, antennas and plan of one image, used by tiles, certificate and measures."""

from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apertura.common.contracts import Window
from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import illumination_mask
from apertura.core.backprojection.contributions import band_limited_image, band_limited_terms
from apertura.core.backprojection.engines import load_engine, pieces, reference
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.reach import PULSES, Reach, pulse_blocks_of
from apertura.core.backprojection.tiles import Weighing, image_array
from apertura.core.echo.captures import spread
from apertura.core.echo.demodulate import remove_path
from apertura.core.planning.plan import Plan
from apertura.core.scene.grid import SceneGrid

if TYPE_CHECKING:
    from dask.array.core import Array

PULSES_READ = 1024
"""Number of pulses read per block of a phase history, or of profiles at single points; limits the memory."""


@dataclass(frozen=True, eq=False)
class Formation:
    """Inputs and settings of the formation of one image.

    Attributes
    ----------
    history
        Phase history; None if only profiles are available.
    profiles
        The same data as range profiles, for the engines that interpolate tables.
    grid
        Grid of the image.
    plan
        Engine, terrain model and weights of pulses.
    side_px
        Side of a tile.
    compression_db
        Error of the profiles relative to the history, measured at range compression, dB; None: not measured.
    """

    history: PhaseHistory | None
    profiles: Profiles
    grid: SceneGrid
    plan: Plan
    side_px: int
    compression_db: float | None = None

    @property
    def summed(self) -> PhaseHistory | Profiles:
        """Input of the exact sum: the profiles if their compression error is known or there is no history."""
        return self.profiles if self.history is None or self.compression_db is not None else self.history

    @property
    def beams(self) -> Beams | None:
        """Weights of pulses, from antennas and the integrated sector; None if every pulse has weight 1."""
        return self.plan.beams

    @property
    def count(self) -> int:
        """Number of pulses by which the sum is divided."""
        return self.plan.count or len(self.profiles)

    @property
    def tiles(self) -> list[Window]:
        """Every tile of the grid."""
        return list(self.grid.tiles(self.side_px))

    @cached_property
    def windows(self) -> list[Window]:
        """Tiles that a pulse may illuminate, starting with a full-sized tile if any; other tiles remain zero."""
        tiles = self.tiles
        reach = Reach.of(self.beams, self.profiles.aperture, self.grid, self.plan.terrain, tiles)
        formed = [tile for tile, illuminated in zip(tiles, reach.illuminated, strict=True) if illuminated]
        side = tuple(min(self.side_px, size) for size in self.grid.shape)
        full = next((tile for tile in formed if tuple(part.stop - part.start for part in tile) == side), None)
        return tiles if full is None else [full, *(tile for tile in formed if tile is not full)]

    @cached_property
    def variant_counts(self) -> Counter[str]:
        """Variant of the engine's sum → number of pixel-pulse contributions; empty with a single variant."""
        return Counter()

    @cached_property
    def _pieces_of(self) -> dict[tuple[int, ...], list[Window]]:
        return {}

    @property
    def image(self) -> "Array":
        """The image with the planned setting: a dask array, (row, column) complex64, whose chunks are the tiles."""
        return self._array(self.plan.setting, presum=True)

    def image_by(self, setting: Setting) -> "Array":
        """Return the image computed with another setting, without presumming."""
        return self._array(setting, presum=False)

    def positions_at(self, row: ArrayLike, column: ArrayLike) -> NDArray[np.float64]:
        """Return (..., 3) float64 positions (m) of fractional pixel indices, on the terrain."""
        return self.plan.terrain.positions_at(self.grid, row, column)

    def exact(self, pixels: NDArray[np.int64], *, threads: int = 1) -> NDArray[np.complex128]:
        """Return the image at (pixel, 2) rows and columns, (pixel,) complex128, by the exact sum over `summed`.

        Profiles are interpolated band-limited in float64. The result does not depend on the number of threads.
        """
        points_m = self.positions_at(*pixels.T)

        def summed(read: tuple[slice, list[tuple[slice, NDArray[np.bool_]]]]) -> NDArray[np.complex128]:
            pulses, parts = read
            inputs, total = self.summed[pulses], np.zeros(len(points_m), np.complex128)
            for part, inside in parts:
                weights = self.beams and self.beams[pulses][part]
                total[inside] += _exact_sum(inputs[part], points_m[inside], weights)
            return total

        with ThreadPoolExecutor(threads) as pool:
            blocks = pool.map(summed, self.illuminating_pulses(points_m))
            return np.asarray(sum(blocks, np.zeros(len(points_m), np.complex128)) / self.count)

    def values(self, pixels: NDArray[np.int64]) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
        """Return the planned image at (pixel, 2) rows and columns, computing only the pieces that contain these pixels.

        Returns (pixel,) complex64, and the mean |I|² over the piece of each pixel, (pixel,) float64.
        """
        windows = list(dict.fromkeys(self._piece(*pixel) for pixel in pixels.tolist()))
        images = self.image_of([(slice(*window[:2]), slice(*window[2:])) for window in windows])
        image = dict(zip(windows, images, strict=True))
        values, power = np.zeros(len(pixels), np.complex64), np.zeros(len(pixels))
        for number, (row, column) in enumerate(pixels.tolist()):
            top, _, left, _ = window = self._piece(row, column)
            values[number], power[number] = image[window][row - top, column - left], (np.abs(image[window]) ** 2).mean()
        return values, power

    def _piece(self, row: int, column: int) -> tuple[int, int, int, int]:
        """Return the limits of the engine's piece that contains a pixel: first and end row, first and end column."""
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
        """Return the planned image in windows aligned to the engine's patches, accumulated over pulse blocks."""
        setting, beams, presum = self.plan.setting, self.beams, self.plan.presumming
        engine, inputs = load_engine(setting.engine), self._inputs(setting)
        if isinstance(inputs, Profiles) and presum is not None:
            inputs = self.plan.inputs(inputs)
        reach = Reach.of(beams, inputs.aperture, self.grid, self.plan.terrain, windows)
        patches_m = [self.plan.terrain.positions(self.grid[window]) for window in windows]
        image = [np.zeros(patch_m.shape[:2], np.complex64) for patch_m in patches_m]
        for block in pulse_blocks_of(len(inputs), setting.pulse_blocks, any_start=beams is None):
            tables = engine.prepare(inputs[block], **setting.options)
            for number, patch_m in enumerate(patches_m):
                if (part := reach.within(number, block)) is not None:
                    used = tables if part == slice(0, block.stop - block.start) else tables[part]
                    weights = beams and beams[block][part]
                    image[number] += engine.form(used, patch_m, beams=weights, **setting.form_options) / self.count
        return image

    def contributions(self, row: ArrayLike, column: ArrayLike) -> list[NDArray[np.complex128]]:
        """Return the contributions of the illuminating pulses at each fractional pixel, (pulse,) complex128.

        Contributions are computed by the sum over the subcarriers of a history, or by band-limited interpolation of
        profiles.
        """
        points_m = self.positions_at(np.atleast_1d(row), np.atleast_1d(column))
        terms_of: list[list[NDArray[np.complex128]]] = [[np.empty(0, np.complex128)] for _ in points_m]
        for pulses, parts in self.illuminating_pulses(points_m):
            inputs = self.summed[pulses]
            for part, inside in parts:
                terms = _terms(inputs[part], points_m[inside], self.beams and self.beams[pulses][part])
                for point, of_point in zip(np.flatnonzero(inside), terms.T, strict=True):
                    terms_of[point].append(of_point[of_point != 0])
        return [np.concatenate(terms) for terms in terms_of]

    def spectra(self, row: ArrayLike, column: ArrayLike) -> NDArray[np.complex128]:
        """Return the spectrum of the image at each fractional pixel, (point, subcarrier) complex128, without window.

        It is the sum of the transfer functions without the phase of the path over a sample of up to 4096 pulses. The
        result contains no points if only profiles are available. Source: docs/theory/focus.md, "Focus in range".
        """
        points_m = self.positions_at(np.atleast_1d(row), np.atleast_1d(column))
        if self.history is None:
            return np.zeros((0, 0), np.complex128)
        total = np.zeros((len(points_m), len(self.history.frequency_hz)), np.complex128)
        for group in spread(len(self.history), groups=64, each=64):
            pulses = slice(int(group[0]), int(group[-1]) + 1)
            history = self.history[pulses]
            transfer, frequency_hz = np.asarray(history.transfer), history.frequency_hz
            delay_s = history.aperture.path(points_m) / history.wave_speed_m_s - history.reference_delay_s[:, None]
            weights = None if self.beams is None else self.beams[pulses].weight(history.aperture, points_m)
            for point, of_point in enumerate(delay_s.T):
                terms = remove_path(transfer, frequency_hz, delay_s=of_point)
                total[point] += terms.sum(axis=0) if weights is None else weights[:, point] @ terms
        return total

    def illuminating_pulses(
        self, points_m: NDArray[np.float64]
    ) -> Iterator[tuple[slice, list[tuple[slice, NDArray[np.bool_]]]]]:
        """Yield pulse blocks to read, each with the sub-blocks that may illuminate points and masks of these points.

        Parameters
        ----------
        points_m
            (point, 3) float64, metres.
        """
        aperture, beams = self.profiles.aperture, self.beams
        mask = illumination_mask(beams, aperture, points_m, np.zeros(len(points_m)), pulses=PULSES)
        for first in range(0, len(aperture), PULSES_READ):
            block = slice(first, min(first + PULSES_READ, len(aperture)))
            length = block.stop - block.start
            rows = mask[first // PULSES : -(-block.stop // PULSES)]
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
            raise ValueError(f"engine {setting.engine} requires a phase history; only profiles are available")
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
            weighing=Weighing(self.beams, summed, self.plan.count, self.variant_counts),
        )


def _terms(
    inputs: PhaseHistory | Profiles, points_m: NDArray[np.float64], beams: Beams | None
) -> NDArray[np.complex128]:
    if isinstance(inputs, PhaseHistory):
        return reference.terms(inputs, points_m, beams)
    return band_limited_terms(inputs, points_m, beams=beams)


def _exact_sum(
    inputs: PhaseHistory | Profiles, points_m: NDArray[np.float64], beams: Beams | None
) -> NDArray[np.complex128]:
    if isinstance(inputs, PhaseHistory):
        return reference.form(inputs, points_m, beams=beams)
    return band_limited_image(inputs, points_m, beams=beams)
