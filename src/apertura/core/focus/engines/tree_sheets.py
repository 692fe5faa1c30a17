"""Ground that no polynomial follows: a tile formed on several sheets, one above the other, and read between them.

docs/theory/tree.md, "Sheets".
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.focus.engines.tree_nodes import nodes, pixel_places, supports, weights
from apertura.core.focus.engines.tree_surface import Surface
from apertura.core.focus.engines.tree_view import nodes_for
from apertura.core.geometry.aperture import Aperture

MOST_SHEETS = 32

_TABLE = 8192  # heights between the sheets for which weights are there
_SAMPLED = 64  # pulses that are looked at


@dataclass(frozen=True, eq=False)
class Relief:
    """How the pixels of a tile lie off its surface.

    Attributes
    ----------
    pixels
        (y, x, 3) float64, their places, metres.
    up
        (3,) unit vector along which they leave the surface.
    off_m
        (y, x) float64, by how much.
    aside_m
        RMS of what they leave it by across that.
    """

    pixels: NDArray[np.float64]
    up: NDArray[np.float64]
    off_m: NDArray[np.float64]
    aside_m: float

    @classmethod
    def of(cls, surface: Surface, pixels: NDArray[np.float64]) -> "Relief":
        """Return that of pixels with places.

        Examples
        --------
        >>> flat = np.stack(np.meshgrid(np.arange(3.0), np.arange(2.0), 0.0), -1)[:, :, 0]
        >>> plane = np.zeros((2, 2, 3))
        >>> plane[0, 0], plane[0, 1, 0], plane[1, 0, 1] = (1, 0.5, 0), 1, 0.5
        >>> rough = flat + [[[0, 0, 1], [0, 0, -1], [0, 0, 2]]]
        >>> abs(Relief.of(Surface(plane, plane[0, 0], np.array([0, 0, 1.0]), 1.0), rough).off_m[0])
        array([1., 1., 2.])
        """
        degree = len(surface.coefficients) - 1
        along, across = (np.polynomial.legendre.legvander(pixel_places(size), degree) for size in pixels.shape[1::-1])
        rest = pixels - np.tensordot(across, along @ surface.coefficients, 1)
        flat = rest.reshape(-1, 3)
        power, axes = np.linalg.eigh(flat.T @ flat / len(flat))
        return cls(pixels, axes[:, -1], rest @ axes[:, -1], float(np.sqrt(max(0.0, power[:2].sum()))))

    @property
    def span_m(self) -> tuple[float, float]:
        """Middle and half of the heights."""
        low, high = float(self.off_m.min()), float(self.off_m.max())
        return (low + high) / 2, (high - low) / 2

    def band_rad(self, aperture: Aperture, *, wavenumber_rad_m: float, band_rad_m: float) -> float:
        """Return the half width of the band along `up`, rad per half of the heights, against the middle pulse.

        Notes
        -----
        Source: docs/theory/tree.md, eq. 11.
        """
        corners = self.pixels[[0, 0, -1, -1, self.pixels.shape[0] // 2], [0, -1, 0, -1, self.pixels.shape[1] // 2]]
        rate = aperture[aperture.sample(_SAMPLED)].path_gradient(corners) @ self.up
        against = aperture[len(aperture) // 2 : len(aperture) // 2 + 1].path_gradient(corners)[0] @ self.up
        turns = wavenumber_rad_m * np.abs(rate - against).max() + band_rad_m * np.abs(rate).max()
        return float(self.span_m[1] * turns)


@dataclass(frozen=True, eq=False)
class Sheets:
    """Sheets between which a tile is read.

    Attributes
    ----------
    relief
        Of the tile.
    heights_m
        (sheet,) float64, above the surface.
    error_db
        What reading between them may err by.
    """

    relief: Relief
    heights_m: NDArray[np.float64]
    error_db: int

    @classmethod
    def of(cls, relief: Relief, band_rad: float, error_db: int) -> "Sheets":
        """Return as few sheets as hold a band."""
        middle, half = relief.span_m
        return cls(relief, middle + half * nodes(sheets_for(band_rad, error_db), error_db), error_db)

    @property
    def pixels(self) -> NDArray[np.float64]:
        """Places of the pixels on each sheet, (sheets · y, x, 3) float64, metres."""
        relief = self.relief
        moved = (self.heights_m[:, None, None] - relief.off_m)[..., None] * relief.up
        return np.ascontiguousarray((relief.pixels + moved).reshape(-1, *relief.pixels.shape[1:]))

    @property
    def windows(self) -> list[Window]:
        """Each sheet in `pixels`."""
        rows, columns = self.relief.off_m.shape
        return [(slice(n * rows, (n + 1) * rows), slice(0, columns)) for n in range(len(self.heights_m))]

    def read(self, images: NDArray[np.complex64], pulse: Aperture, wavenumber_rad_m: float) -> NDArray[np.complex64]:
        """Return the image at the pixels, (y, x) complex64, from that on `pixels`; `pulse` is the one referred to."""
        relief, (middle, half) = self.relief, self.relief.span_m
        place = (np.clip((relief.off_m - middle) / (half or 1.0), -1, 1) + 1) * (_TABLE / 2)
        number = np.minimum(place.astype(np.int64), _TABLE - 1)
        part = (place - number).astype(np.float32)
        table = _weights(len(self.heights_m), self.error_db)
        legs = []
        for leg in pulse.legs:
            away = relief.pixels - leg[0]
            legs.append((np.einsum("yxk,yxk->yx", away, away), 2 * (away @ relief.up)))
        image = np.zeros(relief.off_m.shape, np.complex64)
        for sheet, (height, window) in enumerate(zip(self.heights_m, self.windows, strict=True)):
            rise = height - relief.off_m
            further = np.zeros_like(rise)
            for square, slope in legs:
                added = rise * (slope + rise)
                further += added / (np.sqrt(square) + np.sqrt(square + added))
            turn = (-wavenumber_rad_m * further).astype(np.float32)
            share = table[sheet, number] * (1 - part) + table[sheet, number + 1] * part
            image += images[window] * (share * (np.cos(turn) + 1j * np.sin(turn)))
        return image


def sheets_for(band_rad: float, error_db: int) -> int:
    """Return how many sheets hold a band."""
    return int(nodes_for(np.array([band_rad]), error_db)[0])


@lru_cache(maxsize=64)
def _weights(count: int, error_db: int) -> NDArray[np.float32]:
    """Return the weights of sheets at evenly spaced heights, (sheet, height) float32."""
    at = np.linspace(-1, 1, _TABLE + 1)
    return np.ascontiguousarray(weights(count, at, error_db, float(supports(error_db)[count])).T, np.float32)
