"""How a tree would see a job: numbers of nodes, samples and pulses of some tiles and chunks, before anything is formed.

The same counts as native/tree_plan.hpp makes for every tile, taken at a few.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.core.focus.engines.native_structs import TREE_FEWER, TREE_MORE
from apertura.core.focus.engines.tree_nodes import MOST_NODES, supports
from apertura.core.focus.engines.tree_surface import Surface
from apertura.core.focus.engines.tree_track import DEGREES, LEAF, leaf_roughness, leaves_of
from apertura.core.geometry.aperture import Aperture

_FEW, _MANY = 4, 8  # places along an axis at which a tile is looked at
_NEARBY = 0.5  # of the nearest antenna's distance that a plane tile's half diagonal may be for few
_AIRY = 3.0  # units of eq. 4b
_WEIGHTED = 1.5  # rad that weights add to a band: native/tree_job.hpp
_LOOKED_AT = 3  # subapertures of a level, at most


@dataclass(frozen=True, eq=False)
class Looks:
    """One tile seen from one chunk of pulses.

    Attributes
    ----------
    bands_rad
        (2,) float64 of each level that can be held: half width of the band along columns and rows, rad per half tile.
    turn_rad
        By how much the carrier turns within half a leaf, at most, against the tile's centre.
    rough_rad
        (curve,) RMS phase by which pulses leave curves of growing degree.
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


def look(
    aperture: Aperture, surface: Surface, sizes: tuple[int, ...], *, wavenumber_rad_m: float, band_rad_m: float
) -> Looks:
    """Return how one tile is seen from one chunk of pulses.

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
        for start in starts[np.unique(np.linspace(0, len(starts) - 1, _LOOKED_AT).astype(int))]:
            part = aperture[start : start + size]
            some = np.unique(np.linspace(0, len(part) - 1, 3 if size == LEAF else 9).astype(int))
            here, _ = slopes.of(part[some])
            _, reference = slopes.of(part[(len(part) - 1) // 2 : (len(part) - 1) // 2 + 1])
            width = k * np.abs(here - reference - mixed) + b * np.abs(here)
            most = np.maximum(most, highest(width.max(axis=0)))
        bands.append(most)
    turn, rough = _leaf(aperture, slopes, k + b)
    return Looks(tuple(bands), turn, rough, 2 * float(np.abs(here).sum(axis=1).max()), phase_rad)


def highest(band_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the widest bands along columns and rows of any place, (2,), from those at some places, (2, row, column).

    Where one peaks between places a parabola tells how high; along its own axis such a peak has content beyond it.

    Notes
    -----
    Source: docs/theory/tree.md, eq. 4b.

    Examples
    --------
    >>> flat = np.tile([1.0, 5.0, 5.0, 1.0], (4, 1))
    >>> highest(np.stack([flat, flat])).round(2)
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
    """Return how far the carrier turns within half a leaf, and by what pulses leave smooth curves."""
    starts = np.arange(0, max(1, len(aperture) - LEAF + 1), LEAF)
    turn, rough = 0.0, 0.0
    for start in starts[np.unique(np.linspace(0, len(starts) - 1, _LOOKED_AT).astype(int))]:
        leaf = aperture[start : start + LEAF]
        three = leaf[np.array([0, (len(leaf) - 1) // 2, len(leaf) - 1])]
        first, middle, last = three.path(slopes.places_m) - three.path(slopes.centre_m[None])
        turn = max(turn, float((0.5 * np.abs(last - first) + np.abs(first + last - 2 * middle)).max()))
        nearest = min(float(np.linalg.norm(leg[len(leaf) // 2] - slopes.centre_m)) for leg in leaf.legs)
        rough = max(rough, slopes.radius_m / nearest / np.sqrt(3))
    return wavenumber_rad_m * turn, wavenumber_rad_m * rough * _roughest(aperture)


@lru_cache(maxsize=64)
def _roughest(aperture: Aperture) -> NDArray[np.float64]:
    """Return (curve,) by how much the pulses of any leaf leave curves of growing degree."""
    return np.asarray(leaf_roughness(*(leaves_of(leg) for leg in aperture.legs)).max(axis=0))


class _Slopes:
    """Derivatives of paths along the columns and rows of a tile."""

    def __init__(self, surface: Surface, side: int):
        degree, self._side = len(surface.coefficients) - 1, side
        seen = np.append(np.linspace(-1, 1, side), 0.0)
        basis = np.polynomial.legendre.legvander(seen, degree)
        rate = np.stack([_derivative(seen, n) for n in range(degree + 1)], -1)

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
    """Return the least numbers of nodes that hold bands; more than `MOST_NODES` where none does.

    Examples
    --------
    >>> nodes_for(np.array([0.0, 20.0, 1000.0]), -74)
    array([  2,  20, 129])
    """
    return np.maximum(2, np.searchsorted(supports(error_db), band_rad))


@dataclass(frozen=True)
class Counts:
    """What one tile takes of one chunk.

    Attributes
    ----------
    nodes
        (2,) of each level, along columns and rows; fewer levels where the higher ones hold too many. None: no tree.
    fewer
        Pulses that stand for those of a leaf; 0: each for itself.
    presum_rad
        What those of a leaf err by for which fewer stand, RMS.
    """

    nodes: tuple[tuple[int, int], ...]
    fewer: int
    presum_rad: float


def counts_of(looks: Looks, *, nodes_db: int, presum_db: float, weighted: bool) -> Counts:
    """Return the numbers of nodes of each level, and of pulses that stand for those of a leaf."""
    more = _WEIGHTED if weighted else 0.0
    levels: list[tuple[int, int]] = []
    for band in looks.bands_rad:
        along, across = nodes_for(band + more, nodes_db)
        if max(along, across) > MOST_NODES:
            break
        levels.append((int(along), int(across)))
    smooth = np.flatnonzero(looks.rough_rad <= 10 ** (presum_db / 20))
    if len(smooth):
        turned = int(nodes_for(np.array([looks.turn_rad + more]), nodes_db)[0])
        fewer = max(DEGREES[smooth[0]] + TREE_MORE, turned)
        if fewer <= TREE_FEWER:
            followed = np.searchsorted(DEGREES, fewer - TREE_MORE, "right") - 1
            return Counts(tuple(levels), fewer, float(looks.rough_rad[followed]))
    return Counts(tuple(levels), 0, 0.0)
