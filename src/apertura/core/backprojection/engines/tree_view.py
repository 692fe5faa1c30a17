"""Division of a job by a tree: leaves of its track, nodes and pulses of tiles and chunks, sheets over rough ground."""

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.common.contracts import Window
from apertura.core.backprojection.engines.native_binding import (
    TREE_FEWER,
    TREE_GROUP,
    TREE_MORE,
    TREE_TERMS,
    TREE_WEIGHTED,
)
from apertura.core.backprojection.engines.tree_nodes import MOST_NODES, Surface, nodes, pixel_places, supports, weights
from apertura.core.geometry.aperture import Aperture

# ---- Leaves and larger subapertures

LEAF = TREE_GROUP
"""Pulses of a leaf, which fewer may replace, and which are summed at its nodes."""

DEGREES = (5, 9, 14, 20)
"""Degrees of curves over a leaf on which fewer pulses may replace it: native/tree_plan.hpp, kCurves."""

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
def curve(fewer: int, nodes_db: int) -> NDArray[np.float64]:
    """Return the polynomials of `tracks` at the pulses that replace those of a leaf, (pulse, term) float64.

    Examples
    --------
    >>> bends = np.linspace(-1, 1, 64)[None, :, None] ** 3 * np.ones(3)
    >>> smooth = curve(9, -74) @ tracks(bends)[0]
    >>> bool(np.abs(smooth[:, 0] - nodes(9, -74) ** 3).max() < 1e-12)
    True
    """
    legendre = np.polynomial.legendre.legvander(nodes(fewer, nodes_db), TREE_TERMS - 1)
    return np.ascontiguousarray(legendre @ _polynomials()[1])


@cache
def _polynomials() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (pulse, term) orthonormal polynomials, and their coefficients in Legendre's."""
    basis, triangle = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, LEAF), TREE_TERMS - 1))
    return basis, np.linalg.inv(triangle)


# ---- Views of tiles from chunks of pulses: numbers of nodes and pulses
#
# The same counts as native/tree_plan.hpp makes for every tile, taken at a few.

_FEW, _MANY = 4, 8  # places along an axis at which a tile is evaluated
_NEARBY = 0.5  # of the nearest antenna's distance that a plane tile's half diagonal may be for few
_AIRY = 3.0  # units of eq. 4b
_SAMPLED_SUBAPERTURES = 3  # subapertures of a level, at most


@dataclass(frozen=True, eq=False)
class TileView:
    """Geometry of one tile from one chunk of pulses.

    Attributes
    ----------
    bands_rad
        (2,) float64 of each level: half width of the band along columns and rows, rad per half tile.
    turn_rad
        Largest phase change of the carrier within half a leaf against the tile's centre.
    rough_rad
        (curve,) RMS phase of deviations from curves of growing degree.
    span_m
        Total path across the tile.
    phase_rad
        RMS phase of its places against its centre.
    """

    bands_rad: tuple[NDArray[np.float64], ...]
    turn_rad: float
    rough_rad: NDArray[np.float64]
    span_m: float
    phase_rad: float


def view_of_tile(
    aperture: Aperture, surface: Surface, sizes: tuple[int, ...], *, wavenumber_rad_m: float, band_rad_m: float
) -> TileView:
    """Return the geometry of one tile from one chunk of pulses.

    Parameters
    ----------
    aperture
        Of the chunk.
    surface
        Of the tile.
    sizes
        Pulses of the subapertures of each level.
    wavenumber_rad_m, band_rad_m
        2πf_mid/c and πB/c.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 4.
    """
    k, b = wavenumber_rad_m, band_rad_m
    slopes = _slopes(aperture, surface)
    middle = len(aperture) // 2
    here, axes = slopes.of(aperture[middle : middle + 1])
    mixed = here - axes
    phase_rad = k * float(np.sqrt((here**2).mean(axis=(0, 2, 3)).sum() / 3))
    bands: list[NDArray[np.float64]] = []
    for size in sizes:
        starts, most = np.arange(0, len(aperture), size), np.zeros(2)
        for start in starts[np.unique(np.linspace(0, len(starts) - 1, _SAMPLED_SUBAPERTURES).astype(int))]:
            part = aperture[start : start + size]
            some = np.unique(np.linspace(0, len(part) - 1, 3 if size == LEAF else 9).astype(int))
            here, _ = slopes.of(part[some])
            _, reference = slopes.of(part[(len(part) - 1) // 2 : (len(part) - 1) // 2 + 1])
            width = k * np.abs(here - reference - mixed) + b * np.abs(here)
            most = np.maximum(most, peak_band(width.max(axis=0)))
        bands.append(most)
    turn, rough = _leaf(aperture, slopes, k + b)
    return TileView(tuple(bands), turn, rough, 2 * float(np.abs(here).sum(axis=1).max()), phase_rad)


def peak_band(band_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the widest bands along columns and rows of any place, (2,), from those at some places, (2, row, column).

    A peak between places is estimated by a parabola; along its own axis such a peak has content beyond it.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 4b.

    Examples
    --------
    >>> flat = np.tile([1.0, 5.0, 5.0, 1.0], (4, 1))
    >>> peak_band(np.stack([flat, flat])).round(2)
    array([10.45,  5.5 ])
    """
    most = band_rad.copy()
    units = (band_rad.shape[-1] - 1) ** 2 / 8
    for axis in (-1, -2):
        middle, rows = np.moveaxis(band_rad, axis, -1)[..., 1:-1], np.moveaxis(most, axis, -1)[..., 1:-1]
        before, behind = (np.moveaxis(band_rad, axis, -1)[..., part] for part in (slice(-2), slice(2, None)))
        second = 2 * middle - before - behind
        peaks = (second > 0) & (np.abs(behind - before) <= 2 * second)
        second = np.where(peaks, second, np.inf)
        rows += (behind - before) ** 2 / (8 * second)
        own = 0 if axis == -1 else 1
        rows[own] += _AIRY * np.cbrt(np.where(peaks, second, 0.0)[own] * units)
    return np.asarray(most.max(axis=(1, 2)))


def _slopes(aperture: Aperture, surface: Surface) -> "_Slopes":
    """Return slopes at few places, or at many where the surface bends or an antenna is near."""
    few = _Slopes(surface, _FEW)
    three = aperture[np.array([0, len(aperture) // 2, len(aperture) - 1])]
    nearest = min(float(np.linalg.norm(leg - surface.centre_m, axis=1).min()) for leg in three.legs)
    return _Slopes(surface, _MANY) if len(surface.coefficients) > 2 or few.radius_m > _NEARBY * nearest else few


def _leaf(aperture: Aperture, slopes: "_Slopes", wavenumber_rad_m: float) -> tuple[float, NDArray[np.float64]]:
    """Return the phase change of the carrier within half a leaf, and deviations of pulses from smooth curves, rad."""
    starts = np.arange(0, max(1, len(aperture) - LEAF + 1), LEAF)
    turn, rough = 0.0, 0.0
    for start in starts[np.unique(np.linspace(0, len(starts) - 1, _SAMPLED_SUBAPERTURES).astype(int))]:
        leaf = aperture[start : start + LEAF]
        three = leaf[np.array([0, (len(leaf) - 1) // 2, len(leaf) - 1])]
        first, middle, last = three.path(slopes.places_m) - three.path(slopes.centre_m[None])
        turn = max(turn, float((0.5 * np.abs(last - first) + np.abs(first + last - 2 * middle)).max()))
        nearest = min(float(np.linalg.norm(leg[len(leaf) // 2] - slopes.centre_m)) for leg in leaf.legs)
        rough = max(rough, slopes.radius_m / nearest / np.sqrt(3))
    return wavenumber_rad_m * turn, wavenumber_rad_m * rough * _roughest(aperture)


@lru_cache(maxsize=64)
def _roughest(aperture: Aperture) -> NDArray[np.float64]:
    """Return (curve,) the largest deviation of a leaf from curves of growing degree."""
    return np.asarray(leaf_roughness(*(leaves_of(leg) for leg in aperture.legs)).max(axis=0))


class _Slopes:
    """Derivatives of paths along the columns and rows of a tile."""

    def __init__(self, surface: Surface, side: int):
        degree, self._side = len(surface.coefficients) - 1, side
        samples = np.append(np.linspace(-1, 1, side), 0.0)
        basis = np.polynomial.legendre.legvander(samples, degree)
        rate = np.stack([_derivative(samples, n) for n in range(degree + 1)], -1)

        def at(eta: NDArray[np.float64], xi: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(np.einsum("ia,abk,jb->ijk", eta, surface.coefficients, xi))

        self.centre_m = surface.centre_m
        places, along, across = at(basis, basis), at(basis, rate), at(rate, basis)
        self.places_m = places[:side, :side].reshape(-1, 3)
        self._places_m, self._tangents = places, np.stack([along, across])
        self.radius_m = float(np.sqrt((along[side, side] ** 2 + across[side, side] ** 2).sum()))

    def of(self, aperture: Aperture) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return them over the tile, and along its two axes: (pulse, 2, row, column) metres per half tile."""
        side, gradient = self._side, aperture.path_gradient(self._places_m)
        slope = np.stack([(gradient * tangent).sum(-1) for tangent in self._tangents], 1)
        axes = np.empty_like(slope[:, :, :side, :side])
        axes[:, 0], axes[:, 1] = slope[:, 0, side:, :side], slope[:, 1, :side, side:]
        return slope[:, :, :side, :side], axes


def _derivative(place: NDArray[np.float64], order: int) -> NDArray[np.float64]:
    """Return the derivative of a Legendre polynomial."""
    return np.asarray(np.polynomial.legendre.Legendre.basis(order).deriv()(place) if order else np.zeros_like(place))


def nodes_for(band_rad: NDArray[np.float64], error_db: int) -> NDArray[np.int64]:
    """Return the least numbers of nodes that support bands; more than `MOST_NODES` where none does.

    Examples
    --------
    >>> nodes_for(np.array([0.0, 20.0, 1000.0]), -74)
    array([  2,  20, 129])
    """
    return np.maximum(2, np.searchsorted(supports(error_db), band_rad))


def widened_rad(slope: float, band_rad: NDArray[np.float64], nodes_db: float) -> NDArray[np.float64]:
    """Return by how much the edge of a sector widens bands, rad: native/tree_weight.hpp.

    Parameters
    ----------
    slope
        Change of the depth in the edge per half tile.
    band_rad
        Without it, rad per half tile.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 13.

    Examples
    --------
    >>> widened_rad(0.77, np.array([15.0]), -74).round(1)
    array([20.3])
    """
    content = np.maximum(band_rad, 1.0) * 10 ** (nodes_db / 10)
    return np.maximum(TREE_WEIGHTED, slope * (9 / (10 * np.pi) / content) ** 0.25)


@dataclass(frozen=True)
class Counts:
    """Numbers of nodes and pulses of one tile and one chunk.

    Attributes
    ----------
    nodes
        (2,) of each level, along columns and rows; fewer levels where the higher ones need too many. None: no tree.
    fewer
        Pulses that replace those of a leaf; 0: none do.
    presum_rad
        RMS error by replacing the pulses of a leaf.
    """

    nodes: tuple[tuple[int, int], ...]
    fewer: int
    presum_rad: float


def counts_of(
    view: TileView,
    *,
    nodes_db: int,
    presum_db: float,
    weighted: bool,
    slope: NDArray[np.floating] | None = None,
    each: bool = False,
) -> Counts:
    """Return the numbers of nodes of each level, and of pulses that replace those of a leaf.

    Parameters
    ----------
    view
        Of the tile.
    nodes_db, presum_db
        Tolerated errors.
    weighted
        By antennas.
    slope
        (3,) of the depth in the edge of a sector, as `Weighed.slope`; None: inside of it.
    each
        Whether the pulses of a leaf are summed one by one.
    """
    more = TREE_WEIGHTED if weighted else 0.0

    def wide(band_rad: NDArray[np.float64], *axes: int) -> NDArray[np.float64]:
        band_rad = band_rad + more
        if slope is None:
            return band_rad
        return band_rad + [
            float(widened_rad(slope[axis], band, nodes_db)) for axis, band in zip(axes, band_rad, strict=True)
        ]

    levels: list[tuple[int, int]] = []
    for band in view.bands_rad:
        along, across = nodes_for(wide(band, 0, 1), nodes_db)
        if max(along, across) > MOST_NODES:
            break
        levels.append((int(along), int(across)))
    smooth = np.flatnonzero(view.rough_rad <= 10 ** (presum_db / 20))
    if len(smooth) and not each:
        for_carrier = int(nodes_for(wide(np.array([view.turn_rad]), 2), nodes_db)[0])
        fewer = max(DEGREES[smooth[0]] + TREE_MORE, for_carrier)
        if fewer <= TREE_FEWER:
            curve_followed = np.searchsorted(DEGREES, fewer - TREE_MORE, "right") - 1
            return Counts(tuple(levels), fewer, float(view.rough_rad[curve_followed]))
    return Counts(tuple(levels), 0, 0.0)


# ---- Rough ground: a tile formed on several sheets, interpolated between them
#
# docs/theory/tree.md, "Sheets".

MOST_SHEETS = 32  # of a tile: more cost more than the direct sum

_TABLE = 8192  # heights between the sheets with tabulated weights
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
        rate = aperture[aperture.sample(_SAMPLED)].path_gradient(corners) @ self.up
        against = aperture[len(aperture) // 2 : len(aperture) // 2 + 1].path_gradient(corners)[0] @ self.up
        turns = wavenumber_rad_m * np.abs(rate - against).max() + band_rad_m * np.abs(rate).max()
        return float(self.span_m[1] * turns)


@dataclass(frozen=True, eq=False)
class Sheets:
    """Sheets between which a tile is interpolated.

    Attributes
    ----------
    relief
        Of the tile.
    heights_m
        (sheet,) float64, above the surface.
    error_db
        Tolerated error of the interpolation between them.
    """

    relief: SurfaceResidual
    heights_m: NDArray[np.float64]
    error_db: int

    @classmethod
    def of(cls, relief: SurfaceResidual, band_rad: float, error_db: int) -> "Sheets":
        """Return the fewest sheets that support a band."""
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
    """Return the number of sheets that support a band."""
    return int(nodes_for(np.array([band_rad]), error_db)[0])


@lru_cache(maxsize=64)
def _weights(count: int, error_db: int) -> NDArray[np.float32]:
    """Return the weights of sheets at evenly spaced heights, (sheet, height) float32."""
    at = np.linspace(-1, 1, _TABLE + 1)
    return np.ascontiguousarray(weights(count, at, error_db, float(supports(error_db)[count])).T, np.float32)
