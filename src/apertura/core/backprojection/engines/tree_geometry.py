"""Geometry of trees: nodes along the axes of a tile, surface of a tile, leaves of the track, and height layers.

Source: docs/theory/tree.md, "Nodes" (6), "Surface" (2), "Leaves" (7) and (8b), "Height layers" (9) and (11).
"""

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.backprojection.engines.native_binding import TREE, TreeJob, TreeTile, call
from apertura.core.geometry.aperture import Aperture

# ---- Nodes along an axis of a tile, and interpolation between them
#
# docs/theory/tree.md, "Nodes".

_NOISE_DB = -20.0  # white noise assumed in the design of weights, dB relative to the tolerated error


@lru_cache(maxsize=4096)
def nodes(count: int, error_db: int) -> NDArray[np.float64]:
    """Return node positions, (count,) float64, in -1…1: Chebyshev nodes mapped to nearly equidistant nodes.

    Parameters
    ----------
    count
        Number of nodes, at least 1.
    error_db
        Tolerated error of one interpolation, dB.

    Notes
    -----
    Source: D. Kosloff, H. Tal-Ezer, J. Comput. Phys. 104 (1993) 457, eq. 2.1 and 3.8.

    Examples
    --------
    >>> nodes(4, -74).round(3)
    array([-0.923, -0.38 ,  0.38 ,  0.923])
    """
    if count == 1:
        return np.zeros(1)
    alpha = float(np.clip(1 / np.cosh(-error_db / 20 * np.log(10) / count), 0.05, 0.9999))
    even = np.cos(np.pi * (np.arange(count)[::-1] + 0.5) / count)
    return np.asarray(np.arcsin(alpha * even) / np.arcsin(alpha))


def weights(count: int, places: NDArray[np.float64], error_db: int, band_rad: float) -> NDArray[np.float64]:
    """Return least-squares interpolation weights from nodes to target positions for a flat band.

    Parameters
    ----------
    count, error_db
        Number of nodes, and tolerated error.
    places
        (target,) float64, positions in -1…1.
    band_rad
        Highest wavenumber, rad per half tile.

    Returns
    -------
    ndarray
        (target, count) float64.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 6.

    Examples
    --------
    >>> at = np.array([-0.3, 0.8])
    >>> wave = weights(12, at, -62, 6.0) @ np.exp(5j * nodes(12, -62))
    >>> bool(np.abs(wave - np.exp(5j * at)).max() < 1e-3)
    True
    """
    positions = nodes(count, error_db)
    covariance = _sinc(band_rad, positions, positions) + 10 ** ((error_db + _NOISE_DB) / 10) * np.eye(count)
    return np.asarray(np.linalg.solve(covariance, _sinc(band_rad, positions, places)).T)


@lru_cache
def supports(error_db: int) -> NDArray[np.float64]:
    """Return the widest band supported by each number of nodes, (TREE.nodes + 1,) rad per half tile.

    The values are read from tree_supports.csv.

    Examples
    --------
    >>> supports(-74)[[8, 9, 10, 128]]
    array([  4.82,   4.82,   7.28, 187.58])
    """
    text = (
        (files("apertura.core.backprojection.engines") / "tree_supports.csv")
        .read_text(encoding="utf-8")
        .splitlines()[1:]
    )
    column = text[0].split(",").index(str(error_db))
    band_rad = np.zeros(TREE.nodes + 1)
    for line in text[1:]:
        values = line.split(",")
        band_rad[int(values[0]) :] = float(values[column])
    return band_rad


@lru_cache(maxsize=4096)
def matrices(
    count: int, target: int, error_db: int, *, pixels: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return interpolation weights from nodes to other nodes or to pixels, in the layout of the compiled tree.

    Parameters
    ----------
    count, error_db
        Number of nodes, and tolerated error.
    target
        Number of target nodes or pixels.
    pixels
        True if the targets are equidistant pixels with the outermost pixels at -1 and 1.

    Returns
    -------
    spread
        (count, 2·padded) float32, each weight repeated for real and imaginary parts; zero in the padding.
    mix
        (target, count) float32.
    """
    band = float(supports(error_db)[count])
    places = pixel_places(target) if pixels else nodes(target, error_db)
    weight = weights(count, places, error_db, band).astype(np.float32)
    spread = np.zeros((count, -(-target // 8) * 8, 2), np.float32)
    spread[:, :target] = weight.T[..., None]
    return spread.reshape(count, -1), np.ascontiguousarray(weight)


def pixel_places(count: int) -> NDArray[np.float64]:
    """Return pixel positions along a tile in -1…1, (count,) float64.

    Examples
    --------
    >>> pixel_places(3), pixel_places(1)
    (array([-1.,  0.,  1.]), array([0.]))
    """
    return np.linspace(-1, 1, count) if count > 1 else np.zeros(1)


def _sinc(band_rad: float, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sinc(band_rad / np.pi * (a[:, None] - b)))


def nodes_for(band_rad: NDArray[np.float64], error_db: int) -> NDArray[np.int64]:
    """Return the smallest numbers of nodes that support bands; `TREE.nodes` + 1 if no permitted number suffices.

    Examples
    --------
    >>> nodes_for(np.array([0.0, 20.0, 1000.0]), -74)
    array([  2,  20, 129])
    """
    return np.maximum(2, np.searchsorted(supports(error_db), band_rad))


# ---- Tiles, and smooth surfaces through the pixels of tiles

_PLANE_M = 2e-5  # largest RMS distance of pixels from a plane, up to which the plane is used as the surface, metres
_THIN = 20  # largest number of pixels along a side that are used in the fit of a surface


@dataclass(frozen=True, eq=False)
class Surface:
    """Smooth surface through the pixels of a tile.

    Attributes
    ----------
    coefficients
        (degree + 1, degree + 1, 3) float64, coefficients of Legendre polynomials along rows and columns, metres; the
        variables are -1…1 from the first to the last pixel.
    centre_m
        (3,) float64, position at (0, 0).
    up
        (3,) float64, unit vector normal to the surface.
    rough_m
        RMS distance of the pixels from the surface; infinite if a pixel has no finite position.
    """

    coefficients: NDArray[np.float64]
    centre_m: NDArray[np.float64]
    up: NDArray[np.float64]
    rough_m: float


def windows(shape: tuple[int, ...], side_px: int) -> Iterator[Window]:
    """Yield windows with sides of at most `side_px` pixels, into which a block is divided as evenly as possible.

    Examples
    --------
    >>> list(windows((100, 150), 128))
    [(slice(0, 100, None), slice(0, 75, None)), (slice(0, 100, None), slice(75, 150, None))]
    """
    counts = [-(-size // side_px) for size in shape]
    rows, columns = (
        [round(n * size / count) for n in range(count + 1)] for size, count in zip(shape, counts, strict=True)
    )
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            yield slice(top, bottom), slice(left, right)


def surfaces_of(pixels: NDArray[np.float64], parts: list[Window]) -> list[Surface]:
    """Fit surfaces to the pixels of tiles; planes are used if sufficiently accurate.

    Parameters
    ----------
    pixels
        (y, x, 3) float64, metres, contiguous.
    parts
        Windows of the tiles.

    Notes
    -----
    Source: docs/theory/tree.md, "Surface".

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(40.0), np.arange(30.0))
    >>> surfaces_of(np.stack([x, y, 0.001 * x * x], -1), [(slice(0, 30), slice(0, 40))])[0].rough_m < 1e-9
    True
    """
    surfaces = [Surface(np.zeros((1, 1, 3)), np.zeros(3), np.zeros(3), np.inf)] * len(parts)
    remaining = list(range(len(parts)))
    for degree in (1, TREE.degree):
        fitted = [_fit(pixels[parts[number]], degree) for number in remaining]
        residuals = _residuals(pixels, [parts[number] for number in remaining], fitted)
        for number, coefficients, residual in zip(remaining, fitted, residuals, strict=True):
            if np.isfinite(residual):
                at_0 = np.polynomial.legendre.legvander(np.zeros(1), degree)[0]
                centre = np.einsum("a,abk,b->k", at_0, coefficients, at_0)
                surfaces[number] = Surface(coefficients, centre, _normal(coefficients), float(np.sqrt(residual)))
        remaining = [number for number in remaining if _PLANE_M < surfaces[number].rough_m < np.inf]
        if not remaining:
            break
    return surfaces


def _fit(pixels: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return the coefficients of the surface fitted to pixels of a tile."""
    middle = pixels[pixels.shape[0] // 2, pixels.shape[1] // 2]
    (rows, fit_rows), (columns, fit_columns) = (_fitting(size, degree) for size in pixels.shape[:2])
    offsets = pixels[np.ix_(rows, columns)] - middle  # subtracted for accuracy because positions may be geocentric
    coefficients = np.tensordot(fit_rows, fit_columns @ offsets, 1)
    coefficients[0, 0] += middle
    return np.ascontiguousarray(coefficients)


def _residuals(
    pixels: NDArray[np.float64], parts: list[Window], surfaces: list[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return the mean squared distance of the pixels of tiles from surfaces; NaN if a pixel has no position."""
    tiles = (TreeTile * len(parts))()
    for tile, (rows, columns), surface in zip(tiles, parts, surfaces, strict=True):
        tile.surface, tile.degree = surface.ctypes.data, len(surface) - 1
        tile.pixels = pixels.ctypes.data + 24 * (rows.start * pixels.shape[1] + columns.start)
        tile.rows, tile.columns = rows.stop - rows.start, columns.stop - columns.start
    call("apertura_rest_tree", TreeJob(tiles=ctypes.addressof(tiles), count=len(parts), stride=pixels.shape[1]))
    return np.array([tile.rest for tile in tiles])


@lru_cache(maxsize=64)
def _fitting(size: int, degree: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the pixels along a side that are used in the fit of a surface, and the matrix of the fit."""
    position = np.linspace(-1, 1, size) if size > 1 else np.zeros(1)
    indices: NDArray[np.int64] = np.unique(
        np.round(np.linspace(0, size - 1, min(size, 4 if degree == 1 else _THIN))).astype(np.int64)
    )
    return indices, np.asarray(np.linalg.pinv(np.polynomial.legendre.legvander(position[indices], degree)))


def _normal(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit normal of a surface from the linear coefficients."""
    normal = np.cross(coefficients[0, 1], coefficients[1, 0])
    length = np.linalg.norm(normal)
    return np.asarray(normal / length if length else np.array([0.0, 0.0, 1.0]))


# ---- Leaves and larger subapertures

LEAF = TREE.leaf
"""Number of pulses of a leaf, which are presummed to virtual pulses if possible, and summed at the nodes of the leaf.
"""

DEGREES = (5, 9, 14, 20)
"""Candidate degrees of the curve fitted to the track of a leaf, on which virtual pulses lie."""

_SECOND = 256  # number of pulses of a subaperture at the second level


def subaperture_sizes(chunk: int) -> tuple[int, ...]:
    """Return the number of pulses of a subaperture at each level, in ascending order.

    Examples
    --------
    >>> subaperture_sizes(1024), subaperture_sizes(256), subaperture_sizes(64)
    ((64, 256, 1024), (64, 256), (64,))
    """
    return tuple(sorted({size for size in (LEAF, _SECOND, chunk) if size <= chunk}))


def leaves_of(places_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions, (leaf, pulse, 3); the last position is repeated to complete the last leaf."""
    count = -(-len(places_m) // LEAF)
    filling = np.repeat(places_m[-1:], count * LEAF - len(places_m), axis=0)
    return np.concatenate([places_m, filling]).reshape(count, LEAF, 3)


def parabola_deviation(leaves_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest distance, (leaf,) metres, of pulses from the parabola through first, middle and last pulse."""
    x, nodes_of_parabola = np.linspace(-1, 1, LEAF), [0, (LEAF - 1) // 2, LEAF - 1]
    to_all = np.vander(x, 3) @ np.linalg.inv(np.vander(x[nodes_of_parabola], 3))
    residual = leaves_m - to_all @ leaves_m[:, nodes_of_parabola]
    return np.asarray(np.linalg.norm(residual, axis=-1).max(axis=1))


def tracks(leaves_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the coefficients of the track of each leaf in orthonormal polynomials of the pulse number.

    The result is (leaf, term, 3) float64.
    """
    return np.asarray(_polynomials()[0].T @ leaves_m)


def leaf_roughness(one_m: NDArray[np.float64], other_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the deviation of tracks from fitted curves of increasing degree, in the worst direction.

    Parameters
    ----------
    one_m, other_m
        (leaf, pulse, 3) float64, phase centres of the two antennas, which may be on the same platform.

    Returns
    -------
    ndarray
        (leaf, curve) float64, RMS deviation of both one-way paths together, metres.

    Examples
    --------
    >>> jitter = 1e-3 * np.random.default_rng(1).standard_normal((2, 1, 64, 3))
    >>> independent, common = (leaf_roughness(jitter[0], other)[0, 0] for other in (jitter[1], jitter[0]))
    >>> bool(1.2e-3 < independent < 1.8e-3 < common < 2.4e-3)
    True
    """
    variance = _widest(one_m) + _widest(other_m)
    return np.asarray(np.sqrt(np.maximum(variance, _widest(one_m + other_m))))


def _widest(leaves_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest variance, (leaf, curve), in any direction of deviations from curves of increasing degree."""
    shifted, widest = leaves_m - leaves_m[:, :1], np.empty((len(leaves_m), len(DEGREES)))
    terms = tracks(shifted)
    for number, degree in enumerate(DEGREES):
        residual = shifted - _polynomials()[0][:, : degree + 1] @ terms[:, : degree + 1]
        widest[:, number] = np.linalg.eigvalsh(residual.swapaxes(1, 2) @ residual / LEAF)[:, -1]
    return np.maximum(widest, 0)


@cache
def curve(count: int, nodes_db: int) -> NDArray[np.float64]:
    """Return the polynomials of `tracks` at the virtual pulses of a leaf, (virtual pulse, term) float64.

    Examples
    --------
    >>> bends = np.linspace(-1, 1, 64)[None, :, None] ** 3 * np.ones(3)
    >>> smooth = curve(9, -74) @ tracks(bends)[0]
    >>> bool(np.abs(smooth[:, 0] - nodes(9, -74) ** 3).max() < 1e-12)
    True
    """
    legendre = np.polynomial.legendre.legvander(nodes(count, nodes_db), TREE.terms - 1)
    return np.ascontiguousarray(legendre @ _polynomials()[1])


@cache
def _polynomials() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return orthonormal polynomials, (pulse, term), and their coefficients in Legendre polynomials."""
    basis, triangle = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, LEAF), TREE.terms - 1))
    return basis, np.linalg.inv(triangle)


# ---- Rough terrain: tiles are formed on several height layers and interpolated between the layers
#
# docs/theory/tree.md, "Height layers".

MOST_LAYERS = 32  # largest number of layers of a tile; with a larger number, the direct sum is faster

_TABLE = 8192  # number of heights for which weights are tabulated
_SAMPLED = 64  # number of pulses sampled for the band


@dataclass(frozen=True, eq=False)
class SurfaceResidual:
    """Deviation of the pixels of a tile from its surface.

    Attributes
    ----------
    pixels
        (y, x, 3) float64, pixel positions, metres.
    up
        (3,) float64, unit vector in the direction of the largest deviations.
    off_m
        (y, x) float64, deviation along `up`, metres.
    aside_m
        RMS deviation perpendicular to `up`, metres.
    """

    pixels: NDArray[np.float64]
    up: NDArray[np.float64]
    off_m: NDArray[np.float64]
    aside_m: float

    @classmethod
    def of(cls, surface: Surface, pixels: NDArray[np.float64]) -> "SurfaceResidual":
        """Return the deviation of pixels with finite positions.

        Examples
        --------
        >>> flat = np.stack(np.meshgrid(np.arange(3.0), np.arange(2.0), 0.0), -1)[:, :, 0]
        >>> plane = np.zeros((2, 2, 3))
        >>> plane[0, 0], plane[0, 1, 0], plane[1, 0, 1] = (1, 0.5, 0), 1, 0.5
        >>> rough = flat + [[[0, 0, 1], [0, 0, -1], [0, 0, 2]]]
        >>> abs(SurfaceResidual.of(Surface(plane, plane[0, 0], np.array([0, 0, 1.0]), 1.0), rough).off_m[0])
        array([1., 1., 2.])
        """
        degree = len(surface.coefficients) - 1
        along, across = (np.polynomial.legendre.legvander(pixel_places(size), degree) for size in pixels.shape[1::-1])
        residual = pixels - np.tensordot(across, along @ surface.coefficients, 1)
        flat = residual.reshape(-1, 3)
        power, axes = np.linalg.eigh(flat.T @ flat / len(flat))
        return cls(pixels, axes[:, -1], residual @ axes[:, -1], float(np.sqrt(max(0.0, power[:2].sum()))))

    @property
    def span_m(self) -> tuple[float, float]:
        """Midpoint and half span of the deviations, metres."""
        low, high = float(self.off_m.min()), float(self.off_m.max())
        return (low + high) / 2, (high - low) / 2

    def band_rad(self, aperture: Aperture, *, wavenumber_rad_m: float, band_rad_m: float) -> float:
        """Return the half width of the band along `up` relative to the middle pulse, rad per half span of heights.

        Notes
        -----
        Source: docs/theory/tree.md, eq. 11.
        """
        corners = self.pixels[[0, 0, -1, -1, self.pixels.shape[0] // 2], [0, -1, 0, -1, self.pixels.shape[1] // 2]]
        g = aperture[aperture.sample(_SAMPLED)].path_gradient(corners) @ self.up
        g_s = aperture[len(aperture) // 2 : len(aperture) // 2 + 1].path_gradient(corners)[0] @ self.up
        return float(self.span_m[1] * (wavenumber_rad_m * np.abs(g - g_s).max() + band_rad_m * np.abs(g).max()))


@dataclass(frozen=True, eq=False)
class HeightLayers:
    """Height layers between which a tile of rough terrain is interpolated.

    Attributes
    ----------
    relief
        Deviation of the pixels of the tile from its surface.
    heights_m
        (layer,) float64, heights above the surface, metres.
    error_db
        Tolerated error of the interpolation between layers, dB.
    """

    relief: SurfaceResidual
    heights_m: NDArray[np.float64]
    error_db: int

    @classmethod
    def of(cls, relief: SurfaceResidual, band_rad: float, error_db: int) -> "HeightLayers":
        """Return the minimum number of layers required for a band, at the nodes (eq. 6) of the height range."""
        middle, half = relief.span_m
        return cls(relief, middle + half * nodes(layers_for(band_rad, error_db), error_db), error_db)

    @property
    def pixels(self) -> NDArray[np.float64]:
        """Pixel positions on each layer, (layers · y, x, 3) float64, metres."""
        relief = self.relief
        displacement = (self.heights_m[:, None, None] - relief.off_m)[..., None] * relief.up
        return np.ascontiguousarray((relief.pixels + displacement).reshape(-1, *relief.pixels.shape[1:]))

    @property
    def windows(self) -> list[Window]:
        """Windows of the layers in `pixels`."""
        rows, columns = self.relief.off_m.shape
        return [(slice(n * rows, (n + 1) * rows), slice(0, columns)) for n in range(len(self.heights_m))]

    def read(self, images: NDArray[np.complex64], pulse: Aperture, wavenumber_rad_m: float) -> NDArray[np.complex64]:
        """Interpolate the image on the layers to the pixels, (y, x) complex64; `pulse` is s of eq. 11.

        Notes
        -----
        Source: docs/theory/tree.md, eq. 11.
        """
        relief, (middle, half) = self.relief, self.relief.span_m
        # A_m(h): weights of the layers, interpolated linearly in a table over heights.
        position = (np.clip((relief.off_m - middle) / (half or 1.0), -1, 1) + 1) * (_TABLE / 2)
        number = np.minimum(position.astype(np.int64), _TABLE - 1)
        part = (position - number).astype(np.float32)
        table = _layer_weights(len(self.heights_m), self.error_db)
        # |w|² and 2w·up for each antenna, with w the vector from the antenna to the pixel.
        legs = []
        for leg in pulse.legs:
            away = relief.pixels - leg[0]
            legs.append((np.einsum("yxk,yxk->yx", away, away), 2 * (away @ relief.up)))
        image = np.zeros(relief.off_m.shape, np.complex64)
        for layer, (height, window) in enumerate(zip(self.heights_m, self.windows, strict=True)):
            # R_s(x + h_m up) - R_s(x + h up) by eq. 2, with d = (h_m - h) up.
            rise = height - relief.off_m
            extra_path_m = np.zeros_like(rise)
            for square, slope in legs:
                added = rise * (slope + rise)
                extra_path_m += added / (np.sqrt(square) + np.sqrt(square + added))
            phase = (-wavenumber_rad_m * extra_path_m).astype(np.float32)
            weight = table[layer, number] * (1 - part) + table[layer, number + 1] * part
            image += images[window] * (weight * (np.cos(phase) + 1j * np.sin(phase)))
        return image


def layers_for(band_rad: float, error_db: int) -> int:
    """Return the number of layers that support a band."""
    return int(nodes_for(np.array([band_rad]), error_db)[0])


@lru_cache(maxsize=64)
def _layer_weights(count: int, error_db: int) -> NDArray[np.float32]:
    """Return the weights of layers at equidistant heights, (layer, height) float32."""
    heights = np.linspace(-1, 1, _TABLE + 1)
    return np.ascontiguousarray(weights(count, heights, error_db, float(supports(error_db)[count])).T, np.float32)
