"""Weights of antennas and sectors over the tiles of a tree: a polynomial for each pulse, where that will do."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.antenna.illumination import reached
from apertura.focus.engines.native_structs import TREE_GROUP
from apertura.focus.engines.tree_surface import Surface
from apertura.geometry.aperture import Aperture

BY_TREE, DIRECTLY, SILENTLY = range(3)
"""How a group of pulses is taken over a tile: native/tree_job.hpp, TreeWay."""

_TERMS = 4  # of ξ and of η
_PLACES = np.cos(np.pi * (np.arange(_TERMS) + 0.5) / _TERMS)
_BETWEEN = np.array([-1.0, -0.65, 0.0, 0.65, 1.0])
_CURVE = 5  # degree of weights over the pulses of a leaf
_CHECKED = 8  # pulses of which one is looked at between the places


def weights_over(
    beams: Beams, aperture: Aperture, surface: Surface, error_db: float
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the weight of each pulse over a tile, how groups of pulses are taken, and which cannot be made fewer.

    Parameters
    ----------
    beams, aperture
        Of the same pulses.
    surface
        Of the tile.
    error_db
        What polynomials may err by, relative to the largest weight.

    Returns
    -------
    weights
        (pulse, 16) float32: factor of ξ^a η^b at 4·b + a.
    way
        (group of 64 pulses,) uint8: by tree where polynomials hold, silently where no pulse weighs anything.
    each
        (group,) uint8: 1 where weights change from pulse to pulse otherwise than smoothly, so that no pulse can stand
        for others.

    Notes
    -----
    Source: docs/theory/tree.md, "Weights".
    """
    at, between, to_terms, terms_between = _matrices()
    values = beams.weight(aperture, _positions(surface, at))
    terms = values @ to_terms.T
    some = slice(_CHECKED // 2, None, _CHECKED) if len(aperture) > _CHECKED else slice(None)
    checked = beams[some].weight(aperture[some], _positions(surface, between))
    error = np.abs(terms[some] @ terms_between.T - checked).max(axis=1)
    radius_m = np.linalg.norm(_positions(surface, _BETWEEN) - surface.centre_m, axis=-1).max(keepdims=True)
    lit = reached(beams, aperture, surface.centre_m[None], radius_m, pulses=TREE_GROUP)[:, 0]
    way = np.where(lit, BY_TREE, SILENTLY).astype(np.uint8)
    limit = 10 ** (error_db / 20) * 3  # the largest of an error is about three times its RMS
    for group in np.flatnonzero(lit):
        pulses = slice(group * TREE_GROUP, (group + 1) * TREE_GROUP)
        here = slice(group * TREE_GROUP // _CHECKED, (group + 1) * TREE_GROUP // _CHECKED)
        # A beam may be narrower than what lies between the places.
        if not values[pulses].any() or not (error[here] <= limit * values[pulses].max()).all():
            way[group] = DIRECTLY
    each = np.array([not _smooth(values[at : at + TREE_GROUP], limit) for at in range(0, len(values), TREE_GROUP)])
    return np.ascontiguousarray(terms, np.float32), way, each.astype(np.uint8)


def _smooth(values: NDArray[np.float64], limit: float) -> bool:
    """Return whether the weights of a group of pulses follow a curve of low degree."""
    curve = _curves(len(values))
    rest = values - curve @ (curve.T @ values)
    return bool(np.abs(rest).max() <= limit * values.max())


@lru_cache
def _curves(pulses: int) -> NDArray[np.float64]:
    basis = np.polynomial.legendre.legvander(np.linspace(-1, 1, pulses), min(_CURVE, pulses - 1))
    return np.asarray(np.linalg.qr(basis)[0])


def _positions(surface: Surface, places: NDArray[np.float64]) -> NDArray[np.float64]:
    basis = np.polynomial.legendre.legvander(places, len(surface.coefficients) - 1)
    return np.asarray(np.einsum("ia,abk,jb->ijk", basis, surface.coefficients, basis).reshape(-1, 3))


@lru_cache
def _matrices() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return places along an axis, those between them, values → terms, and terms → values between."""
    powers, between = (np.vander(at, _TERMS, increasing=True) for at in (_PLACES, _BETWEEN))
    inverse = np.linalg.inv(powers)
    return _PLACES, _BETWEEN, np.asarray(np.kron(inverse, inverse)), np.asarray(np.kron(between, between))
