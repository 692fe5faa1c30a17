"""Filter of two images of one scene to the band that both sample: docs/theory/interferometry.md, section 8."""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.contracts import Window
from apertura.core.quality.measures import BlockRaster
from apertura.core.scene.looks import Lattice
from apertura.methods.interferometry.sensitivity import Legs, path_gradient

LEAST_LOOKS = 4.0
"""Minimum number of looks that a filter must leave in a window."""

_BLOCK_PX, _MARGIN_PX = 32, 16  # side of a block with one filter, and pixels beyond it that enter the filter
_SIDE_PX = _BLOCK_PX + 2 * _MARGIN_PX
_INNER = (slice(_MARGIN_PX, _MARGIN_PX + _BLOCK_PX),) * 2


@dataclass(frozen=True, eq=False)
class CommonBand:
    """Bands of two images on the ground, and the filter that leaves the band that both sample.

    Attributes
    ----------
    lattice
        Nodes at which the bands are known; between them, the gradients are interpolated.
    gradients
        (node row, node column, pulse, 2) float64 for each image, change of the total path per metre east and north
        along the terrain, for pulses spread over the aperture.
    frequency_hz, weight
        (subcarrier,) float64, frequencies in ascending order, and weights of both images over them.
    spacing_m, wave_speed_m_s
        Pixel spacing, and wave speed along the paths.

    Notes
    -----
    Source: docs/theory/interferometry.md, eqs. 17 and 18.
    """

    lattice: Lattice
    gradients: tuple[Floats, Floats]
    frequency_hz: Floats
    weight: Floats
    spacing_m: float
    wave_speed_m_s: float

    @classmethod
    def of(
        cls,
        lattice: Lattice,
        nodes_m: Floats,
        axes: Floats,
        legs: tuple[Legs, Legs],
        band: tuple[Floats, Floats],
        *,
        spacing_m: float,
        wave_speed_m_s: float,
    ) -> "CommonBand":
        """Return the bands of two images from the positions of their antennas.

        Parameters
        ----------
        lattice, spacing_m, wave_speed_m_s
            As for `CommonBand`.
        nodes_m, axes, legs
            Terrain at the nodes of the lattice, axes, and positions of both images' antennas, as for
            `apertura.methods.interferometry.sensitivity.sensitivity`.
        band
            Frequencies and weights.

        Examples
        --------
        The look directions of two tracks differ by 90°: no part of their bands is common, and the images are unchanged.

        >>> lattice = Lattice.of((32, 32))
        >>> nodes = np.stack(np.meshgrid([0, 4, 7.75], [7.75, 3.75, 0], [0]), axis=-1).reshape(9, 3)
        >>> track = np.linspace(-4, 4, 9)[:, None] * [1.0, 0, 0] + [0, -20.0, 20.0] + np.zeros((9, 1, 1))
        >>> other = track[..., [1, 0, 2]]
        >>> band = CommonBand.of(lattice, nodes, np.eye(3), ((track, track), (other, other)),
        ...     (1e9 + 4e6 * np.arange(64), np.ones(64)), spacing_m=0.25, wave_speed_m_s=3e8)
        >>> image = np.ones((32, 32), np.complex64)
        >>> bool((band.filtered(image, image, (slice(0, 32), slice(0, 32)), window=9)[0] == image).all())
        True
        """
        surface, along = nodes_m.reshape(*lattice.shape, 3), []
        for axis, direction in ((1, 1), (0, -1)):  # columns lead east, rows south
            at_m = direction * spacing_m * lattice.nodes[axis]
            along.append(np.gradient(surface, at_m, axis=axis) if len(at_m) > 1 else axes[1 - axis] + 0 * surface)
        tangents = np.stack(along, axis=-1).reshape(-1, 3, 2)
        first, second = ((path_gradient(nodes_m, image) @ tangents).reshape(*lattice.shape, -1, 2) for image in legs)
        return cls(lattice, (first, second), *band, spacing_m, wave_speed_m_s)

    def filtered(
        self, first: BlockRaster, second: BlockRaster, part: Window, *, window: int
    ) -> tuple[NDArray[np.complex64], NDArray[np.complex64], NDArray[np.float32]]:
        """Return a part of two images, filtered to their common band, and the looks of a window.

        A block is not filtered if fewer than `LEAST_LOOKS` looks would remain in the window.

        Parameters
        ----------
        first, second
            (y, x) complex64 on the grid of the lattice, NaN where no image was formed.
        part
            Part of the grid. Blocks are aligned with the grid, so that parts agree with the whole bit by bit.
        window
            Side of the window over which coherence is estimated, pixels.

        Returns
        -------
        one, other
            (y, x) complex64, NaN where the image is.
        looks
            (y, x) float32, independent samples in a whole window about each pixel (eq. 3).
        """
        corner, end = [at.start // _BLOCK_PX * _BLOCK_PX for at in part], [at.stop for at in part]
        padded = [_read(image, corner, end) for image in (first, second)]
        images, looks = [image.copy() for image in padded], np.empty(padded[0].shape, np.float32)
        for row in range(0, end[0] - corner[0], _BLOCK_PX):
            for column in range(0, end[1] - corner[1], _BLOCK_PX):
                inner = (
                    slice(row + _MARGIN_PX, row + _MARGIN_PX + _BLOCK_PX),
                    slice(column + _MARGIN_PX, column + _MARGIN_PX + _BLOCK_PX),
                )
                whole = slice(row, row + _SIDE_PX), slice(column, column + _SIDE_PX)
                filters, carrier, looks[inner] = self._filters((corner[0] + row, corner[1] + column), window)
                for image, source, band_filter in zip(images, padded, filters, strict=False):
                    block = source[whole]
                    spectrum = scipy.fft.fft2(np.where(np.isfinite(block), block, 0) * carrier.conj())
                    kept = np.where(np.isfinite(block), scipy.fft.ifft2(spectrum * band_filter) * carrier, np.nan)
                    image[inner] = kept[_INNER]
        rows, columns = (
            slice(at.start - low + _MARGIN_PX, at.stop - low + _MARGIN_PX) for at, low in zip(part, corner, strict=True)
        )
        return images[0][rows, columns], images[1][rows, columns], looks[rows, columns]

    def _filters(
        self, corner: tuple[int, int], window: int
    ) -> tuple[list[NDArray[np.float32]], NDArray[np.complex64], float]:
        """Return the filters of a block (eq. 18; none if too few looks remain), its carrier, and the looks left."""
        last = [int(nodes[-1]) for nodes in self.lattice.nodes]
        half, step_m = _BLOCK_PX // 2, self.spacing_m
        middle, low, high = (
            [min(at + offset, end) for at, end in zip(corner, last, strict=True)] for offset in (half, 0, _BLOCK_PX)
        )
        carrier = self._carrier(*middle)
        # The carrier changes over the block; the change is symmetric as the second derivative of a phase.
        east = (self._carrier(middle[0], high[1]) - self._carrier(middle[0], low[1])) / max(high[1] - low[1], 1)
        north = (self._carrier(low[0], middle[1]) - self._carrier(high[0], middle[1])) / max(high[0] - low[0], 1)
        change = np.stack([east, north]) / step_m
        offset_px = np.arange(_SIDE_PX) - _MARGIN_PX
        east_m, north_m = offset_px + corner[1] - middle[1], middle[0] - corner[0] - offset_px
        place_m = step_m * np.stack(np.meshgrid(east_m, north_m), axis=-1)
        cycles = place_m @ carrier + ((place_m @ (change + change.T)) * place_m).sum(-1) / 4
        frequency = np.fft.fftfreq(_SIDE_PX, step_m)
        wave = np.stack(np.meshgrid(frequency, -frequency), axis=-1) + carrier
        bands = [self._band(gradients, middle, wave) for gradients in self.gradients]
        common = np.minimum(*bands)
        if (looks := _looks(common, window)) < LEAST_LOOKS:
            return [], np.empty(0, np.complex64), float(np.sqrt(np.prod([_looks(band, window) for band in bands])))
        filters = [np.divide(common, band, out=np.zeros_like(band), where=band > 0) for band in bands]
        return filters, np.exp(2j * np.pi * (cycles % 1)).astype(np.complex64), looks

    def _carrier(self, row: int, column: int) -> Floats:
        """Return the mean carrier of both images at a pixel, cycles per metre east and north."""
        gradients = [self._at(values, row, column).mean(axis=0) for values in self.gradients]
        return np.asarray((gradients[0] + gradients[1]) / 2 * self.frequency_hz.mean() / self.wave_speed_m_s)

    def _at(self, values: Floats, row: int, column: int) -> Floats:
        return np.asarray(self.lattice.between(values, (slice(row, row + 1), slice(column, column + 1)))[0, 0])

    def _band(self, gradients: Floats, middle: list[int], wave: Floats) -> Floats:
        """Return the weights w of an image at spatial frequencies (y, x, 2), eq. 17; edges are one frequency wide."""
        gradient = self._at(gradients, *middle) / self.wave_speed_m_s
        mean = gradient.mean(axis=0)
        turn = np.array([[mean[0], -mean[1]], [mean[1], mean[0]]])  # angles are measured from the mean direction
        angles, of_wave = (np.arctan2(*(values @ turn)[..., ::-1].T).T for values in (gradient, wave))
        order, size = np.argsort(angles), np.linalg.norm(wave, axis=-1)
        per_hz = np.interp(of_wave, angles[order], np.linalg.norm(gradient, axis=-1)[order])
        step = 1 / (_SIDE_PX * self.spacing_m)
        in_angle = np.minimum(of_wave - angles.min(), angles.max() - of_wave) * size / step
        frequency = size / per_hz
        half_hz = (self.frequency_hz[-1] - self.frequency_hz[0]) / (len(self.frequency_hz) - 1) / 2
        edges = self.frequency_hz[0] - half_hz, self.frequency_hz[-1] + half_hz
        in_range = np.minimum(frequency - edges[0], edges[1] - frequency) * per_hz / step
        inside = np.clip(in_angle + 0.5, 0, 1) * np.clip(in_range + 0.5, 0, 1)
        return np.asarray(inside * np.interp(frequency, self.frequency_hz, self.weight / self.weight.max()))


def _looks(band: Floats, window: int) -> float:
    """Return the independent samples of a window (eq. 3) in an image with the given weights; 1 for an empty band."""
    correlation = np.abs(scipy.fft.ifft2(band**2)) ** 2
    lag = np.maximum(window - np.abs(np.fft.fftfreq(_SIDE_PX, 1 / _SIDE_PX)), 0)
    total = (correlation * np.multiply.outer(lag, lag)).sum()
    return float(window**4 * correlation[0, 0] / total) if total > 0 else 1.0


def _read(raster: BlockRaster, corner: list[int], end: list[int]) -> NDArray[np.complex64]:
    """Read the blocks of a raster from a corner to an end with their margins, NaN outside the raster."""
    sides = [-(-(last - at) // _BLOCK_PX) * _BLOCK_PX + 2 * _MARGIN_PX for at, last in zip(corner, end, strict=True)]
    starts = [at - _MARGIN_PX for at in corner]
    blocks = np.full(sides, np.nan, np.complex64)
    parts = [
        slice(max(0, start), min(size, start + side))
        for start, side, size in zip(starts, sides, raster.shape, strict=True)
    ]
    inside = tuple(slice(part.start - start, part.stop - start) for part, start in zip(parts, starts, strict=True))
    blocks[inside] = raster[parts[0], parts[1]]
    return blocks
