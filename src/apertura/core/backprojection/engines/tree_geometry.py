"""Geometry of trees: nodes along the axes of a tile, its surface, leaves of the track, and height layers.

docs/theory/tree.md: "Nodes" (6), "Surface" (2), "Leaves" (7) and (8b), "Height layers" (9) and (11).
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

_NOISE_DB = -20.0  # white noise in the design of weights, relative to the error they are designed for


@lru_cache(maxsize=4096)
def nodes(count: int, error_db: int) -> NDArray[np.float64]:
    """Return the places of so many nodes, (count,) float64, in -1…1: Chebyshev's, mapped to be nearly even.

    Parameters
    ----------
    count
        At least 1.
    error_db
        Tolerated error of one interpolation.

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
    """Return the weights of nodes at some places: least squares over a flat band.

    Parameters
    ----------
    count, error_db
        Of the nodes.
    places
        (place,) float64, in -1…1.
    band_rad
        Highest wavenumber, rad per half tile.

    Returns
    -------
    ndarray
        (place, count) float64.

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
    here = nodes(count, error_db)
    covariance = _sinc(band_rad, here, here) + 10 ** ((error_db + _NOISE_DB) / 10) * np.eye(count)
    return np.asarray(np.linalg.solve(covariance, _sinc(band_rad, here, places)).T)


@lru_cache
def supports(error_db: int) -> NDArray[np.float64]:
    """Return the widest band that up to so many nodes support, (TREE.nodes + 1,) rad per half tile: tree_supports.csv.

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
    """Return the weights of nodes at other nodes or at pixels, in the layout of the compiled tree.

    Parameters
    ----------
    count, error_db
        Of the nodes.
    target
        How many nodes or pixels there are to be interpolated to.
    pixels
        Whether they are pixels, evenly apart, the outermost at -1 and 1.

    Returns
    -------
    spread
        (count, 2·padded) float32: each weight twice, for real and imaginary part; zero beyond the target.
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
    """Return where so many pixels lie along a tile, (count,) float64.

    Examples
    --------
    >>> pixel_places(3), pixel_places(1)
    (array([-1.,  0.,  1.]), array([0.]))
    """
    return np.linspace(-1, 1, count) if count > 1 else np.zeros(1)


def _sinc(band_rad: float, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sinc(band_rad / np.pi * (a[:, None] - b)))


def nodes_for(band_rad: NDArray[np.float64], error_db: int) -> NDArray[np.int64]:
    """Return the least numbers of nodes that support bands; more than `TREE.nodes` where none does.

    Examples
    --------
    >>> nodes_for(np.array([0.0, 20.0, 1000.0]), -74)
    array([  2,  20, 129])
    """
    return np.maximum(2, np.searchsorted(supports(error_db), band_rad))


# ---- Tiles, and the smooth surface through their pixels

_PLANE_M = 2e-5  # RMS distance of pixels from a plane that counts as one
_THIN = 20  # pixels along a side that a surface is fitted to, at most


@dataclass(frozen=True, eq=False)
class Surface:
    """Smooth surface through the pixels of a tile.

    Attributes
    ----------
    coefficients
        (degree + 1, degree + 1, 3) float64, metres: of Legendre polynomials along rows and columns, of -1…1 from the
        first pixel to the last.
    centre_m
        (3,) float64, the place at 0, 0.
    up
        (3,) float64, unit vector across the surface there.
    rough_m
        RMS distance of the pixels from it; infinite if a pixel has no finite position.
    """

    coefficients: NDArray[np.float64]
    centre_m: NDArray[np.float64]
    up: NDArray[np.float64]
    rough_m: float


def windows(shape: tuple[int, ...], side_px: int) -> Iterator[Window]:
    """Yield windows of at most `side_px` pixels a side that divide a block of pixels as evenly as possible.

    Examples
    --------
    >>> list(windows((100, 150), 128))
    [(slice(0, 100, None), slice(0, 75, None)), (slice(0, 100, None), slice(75, 150, None))]
    """
    parts = [-(-size // side_px) for size in shape]
    rows, columns = (
        [round(n * size / count) for n in range(count + 1)] for size, count in zip(shape, parts, strict=True)
    )
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            yield slice(top, bottom), slice(left, right)


def surfaces_of(pixels: NDArray[np.float64], parts: list[Window]) -> list[Surface]:
    """Return the surfaces through the pixels of tiles: planes where these are close enough.

    Parameters
    ----------
    pixels
        (y, x, 3) float64, metres, contiguous.
    parts
        The tiles.

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
    left = list(range(len(parts)))
    for degree in (1, TREE.degree):
        fitted = [_fit(pixels[parts[number]], degree) for number in left]
        rests = _residuals(pixels, [parts[number] for number in left], fitted)
        for number, coefficients, rest in zip(left, fitted, rests, strict=True):
            if np.isfinite(rest):
                at_0 = np.polynomial.legendre.legvander(np.zeros(1), degree)[0]
                centre = np.einsum("a,abk,b->k", at_0, coefficients, at_0)
                surfaces[number] = Surface(coefficients, centre, _across(coefficients), float(np.sqrt(rest)))
        left = [number for number in left if _PLANE_M < surfaces[number].rough_m < np.inf]
        if not left:
            break
    return surfaces


def _fit(pixels: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return the coefficients of the surface through some pixels of a tile."""
    middle = pixels[pixels.shape[0] // 2, pixels.shape[1] // 2]
    (rows, fit_rows), (columns, fit_columns) = (_fitting(size, degree) for size in pixels.shape[:2])
    offsets = pixels[np.ix_(rows, columns)] - middle  # places may be those of the Earth's centre
    coefficients = np.tensordot(fit_rows, fit_columns @ offsets, 1)
    coefficients[0, 0] += middle
    return np.ascontiguousarray(coefficients)


def _residuals(
    pixels: NDArray[np.float64], parts: list[Window], surfaces: list[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return the mean squared distance of the pixels of tiles from surfaces; NaN where one has no place."""
    tiles = (TreeTile * len(parts))()
    for tile, (rows, columns), surface in zip(tiles, parts, surfaces, strict=True):
        tile.surface, tile.degree = surface.ctypes.data, len(surface) - 1
        tile.pixels = pixels.ctypes.data + 24 * (rows.start * pixels.shape[1] + columns.start)
        tile.rows, tile.columns = rows.stop - rows.start, columns.stop - columns.start
    call("apertura_rest_tree", TreeJob(tiles=ctypes.addressof(tiles), count=len(parts), stride=pixels.shape[1]))
    return np.array([tile.rest for tile in tiles])


@lru_cache(maxsize=64)
def _fitting(size: int, degree: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return pixels along a side that a surface is fitted to, and the matrix that fits it."""
    place = np.linspace(-1, 1, size) if size > 1 else np.zeros(1)
    some: NDArray[np.int64] = np.unique(
        np.round(np.linspace(0, size - 1, min(size, 4 if degree == 1 else _THIN))).astype(np.int64)
    )
    return some, np.asarray(np.linalg.pinv(np.polynomial.legendre.legvander(place[some], degree)))


def _across(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vector across a surface: that of its linear part."""
    across = np.cross(coefficients[0, 1], coefficients[1, 0])
    length = np.linalg.norm(across)
    return np.asarray(across / length if length else np.array([0.0, 0.0, 1.0]))


# ---- Leaves and larger subapertures

LEAF = TREE.leaf
"""Pulses of a leaf, which virtual pulses may replace, and which are summed at its nodes."""

DEGREES = (5, 9, 14, 20)
"""Degrees of the curves through a leaf's track that virtual pulses may lie on."""

_SECOND = 256  # pulses of a subaperture of leaves


def subaperture_sizes(chunk: int) -> tuple[int, ...]:
    """Return the pulses of the subapertures of each level, the largest last.

    Examples
    --------
    >>> subaperture_sizes(1024), subaperture_sizes(256), subaperture_sizes(64)
    ((64, 256, 1024), (64, 256), (64,))
    """
    return tuple(sorted({size for size in (LEAF, _SECOND, chunk) if size <= chunk}))


def leaves_of(places_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (leaf, pulse, 3) places; the last place is repeated to fill its leaf."""
    count = -(-len(places_m) // LEAF)
    filling = np.repeat(places_m[-1:], count * LEAF - len(places_m), axis=0)
    return np.concatenate([places_m, filling]).reshape(count, LEAF, 3)


def parabola_deviation(leaves_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (leaf,) largest distance of pulses from the parabola through the first, middle and last one, metres."""
    x, three = np.linspace(-1, 1, LEAF), [0, (LEAF - 1) // 2, LEAF - 1]
    to_all = np.vander(x, 3) @ np.linalg.inv(np.vander(x[three], 3))
    rest = leaves_m - to_all @ leaves_m[:, three]
    return np.asarray(np.linalg.norm(rest, axis=-1).max(axis=1))


def tracks(leaves_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (leaf, term, 3) float64: the track over each leaf as orthonormal polynomials of the pulses' numbers."""
    return np.asarray(_polynomials()[0].T @ leaves_m)


def leaf_roughness(one_m: NDArray[np.float64], other_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the deviation of legs from curves of growing degree through them, along the worst direction.

    Parameters
    ----------
    one_m, other_m
        (leaf, pulse, 3) float64: phase centres of the two antennas, which may share a platform.

    Returns
    -------
    ndarray
        (leaf, curve) float64, metres RMS, of both legs together.

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
    """Return (leaf, curve) the largest variance along any direction of deviations from curves of growing degree."""
    shifted, widest = leaves_m - leaves_m[:, :1], np.empty((len(leaves_m), len(DEGREES)))
    terms = tracks(shifted)
    for number, degree in enumerate(DEGREES):
        rest = shifted - _polynomials()[0][:, : degree + 1] @ terms[:, : degree + 1]
        widest[:, number] = np.linalg.eigvalsh(rest.swapaxes(1, 2) @ rest / LEAF)[:, -1]
    return np.maximum(widest, 0)


@cache
def curve(count: int, nodes_db: int) -> NDArray[np.float64]:
    """Return the polynomials of `tracks` at so many virtual pulses of a leaf, (virtual pulse, term) float64.

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
    """Return (pulse, term) orthonormal polynomials, and their coefficients in Legendre's."""
    basis, triangle = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, LEAF), TREE.terms - 1))
    return basis, np.linalg.inv(triangle)


# ---- Rough ground: a tile formed on several height layers, interpolated between them
#
# docs/theory/tree.md, "Height layers".

MOST_LAYERS = 32  # of a tile: more cost more than the direct sum

_TABLE = 8192  # heights between the layers with tabulated weights
_SAMPLED = 64  # pulses that are evaluated


@dataclass(frozen=True, eq=False)
class SurfaceResidual:
    """Deviation of the pixels of a tile from its surface.

    Attributes
    ----------
    pixels
        (y, x, 3) float64, their places, metres.
    up
        (3,) unit vector across the surface.
    off_m
        (y, x) float64, deviation along `up`, metres.
    aside_m
        RMS deviation across `up`, metres.
    """

    pixels: NDArray[np.float64]
    up: NDArray[np.float64]
    off_m: NDArray[np.float64]
    aside_m: float

    @classmethod
    def of(cls, surface: Surface, pixels: NDArray[np.float64]) -> "SurfaceResidual":
        """Return the deviation of pixels with positions.

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
        rest = pixels - np.tensordot(across, along @ surface.coefficients, 1)
        flat = rest.reshape(-1, 3)
        power, axes = np.linalg.eigh(flat.T @ flat / len(flat))
        return cls(pixels, axes[:, -1], rest @ axes[:, -1], float(np.sqrt(max(0.0, power[:2].sum()))))

    @property
    def span_m(self) -> tuple[float, float]:
        """Middle and half span of the heights, metres."""
        low, high = float(self.off_m.min()), float(self.off_m.max())
        return (low + high) / 2, (high - low) / 2

    def band_rad(self, aperture: Aperture, *, wavenumber_rad_m: float, band_rad_m: float) -> float:
        """Return the half width of the band along `up`, rad per half of the heights, against the middle pulse.

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
    """Height layers between which a tile of rough ground is interpolated.

    Attributes
    ----------
    relief
        Of the tile.
    heights_m
        (layer,) float64, above the surface.
    error_db
        Tolerated error of the interpolation between them.
    """

    relief: SurfaceResidual
    heights_m: NDArray[np.float64]
    error_db: int

    @classmethod
    def of(cls, relief: SurfaceResidual, band_rad: float, error_db: int) -> "HeightLayers":
        """Return the fewest layers that support a band, at the nodes (6) of the tile's heights."""
        middle, half = relief.span_m
        return cls(relief, middle + half * nodes(layers_for(band_rad, error_db), error_db), error_db)

    @property
    def pixels(self) -> NDArray[np.float64]:
        """Places of the pixels on each layer, (layers · y, x, 3) float64, metres."""
        relief = self.relief
        moved = (self.heights_m[:, None, None] - relief.off_m)[..., None] * relief.up
        return np.ascontiguousarray((relief.pixels + moved).reshape(-1, *relief.pixels.shape[1:]))

    @property
    def windows(self) -> list[Window]:
        """Window of each layer in `pixels`."""
        rows, columns = self.relief.off_m.shape
        return [(slice(n * rows, (n + 1) * rows), slice(0, columns)) for n in range(len(self.heights_m))]

    def read(self, images: NDArray[np.complex64], pulse: Aperture, wavenumber_rad_m: float) -> NDArray[np.complex64]:
        """Return the image at the pixels, (y, x) complex64, from that on `pixels`; `pulse` is s of (11).

        Notes
        -----
        Source: docs/theory/tree.md, eq. 11.
        """
        relief, (middle, half) = self.relief, self.relief.span_m
        # A_m(h): weights of the layers, linear in a table over the heights.
        place = (np.clip((relief.off_m - middle) / (half or 1.0), -1, 1) + 1) * (_TABLE / 2)
        number = np.minimum(place.astype(np.int64), _TABLE - 1)
        part = (place - number).astype(np.float32)
        table = _layer_weights(len(self.heights_m), self.error_db)
        # |w|² and 2w·up of each leg, w from the antenna to the pixel.
        legs = []
        for leg in pulse.legs:
            away = relief.pixels - leg[0]
            legs.append((np.einsum("yxk,yxk->yx", away, away), 2 * (away @ relief.up)))
        image = np.zeros(relief.off_m.shape, np.complex64)
        for layer, (height, window) in enumerate(zip(self.heights_m, self.windows, strict=True)):
            # R_s(x + h_m up) - R_s(x + h up) by (2), d = (h_m - h) up.
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
    """Return the weights of layers at evenly spaced heights, (layer, height) float32."""
    at = np.linspace(-1, 1, _TABLE + 1)
    return np.ascontiguousarray(weights(count, at, error_db, float(supports(error_db)[count])).T, np.float32)
