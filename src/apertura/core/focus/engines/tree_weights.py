"""Weights of antennas and sectors over the tiles of a tree: a polynomial for each pulse, where that will do."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import reached
from apertura.core.focus.engines.native_structs import TREE_GROUP
from apertura.core.focus.engines.tree_surface import Surface
from apertura.core.geometry.aperture import Aperture

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
    limit = 10 ** (error_db / 20) * 3  # the largest of an error is about three times its RMS
    groups = -(-len(values) // TREE_GROUP)
    largest, each = _by_group(values.max(axis=1)), np.zeros(groups, bool)
    full = len(values) // TREE_GROUP  # of a group not full each pulse goes for itself anyway
    each[:full] = _jumps(values[: full * TREE_GROUP]) > limit * largest[:full]
    each[full:] = True
    # Where weights jump every pulse is looked at: one between two that hold need not.
    some = np.flatnonzero(each[np.arange(len(values)) // TREE_GROUP] | (np.arange(len(values)) % _CHECKED == 0))
    error, checked = np.zeros(len(values)), beams[some].weight(aperture[some], _positions(surface, between))
    error[some] = np.abs(terms[some] @ terms_between.T - checked).max(axis=1)
    radius_m = np.linalg.norm(_positions(surface, _BETWEEN) - surface.centre_m, axis=-1).max(keepdims=True)
    lit = reached(beams, aperture, surface.centre_m[None], radius_m, pulses=TREE_GROUP)[:, 0]
    # A beam may be narrower than what lies between the places, and end between two of them.
    whole = _by_group(((values == 0).any(axis=1) & (values != 0).any(axis=1)).astype(float)) == 0
    holds = whole & (largest > 0) & (_by_group(error) <= limit * largest)
    way = np.where(lit, np.where(holds, BY_TREE, DIRECTLY), SILENTLY)
    return np.ascontiguousarray(terms, np.float32), way.astype(np.uint8), each.astype(np.uint8)


def _by_group(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest value of each group of pulses."""
    return np.asarray(np.maximum.reduceat(values, np.arange(0, len(values), TREE_GROUP)))


def _jumps(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how much the weights of groups of pulses leave a curve over them, at most: (group,)."""
    grouped = values.reshape(len(values) // TREE_GROUP, TREE_GROUP, values.shape[1])
    return np.asarray(np.abs(grouped - _curve() @ (_curve().T @ grouped)).max(axis=(1, 2)))


@lru_cache
def _curve() -> NDArray[np.float64]:
    basis = np.polynomial.legendre.legvander(np.linspace(-1, 1, TREE_GROUP), _CURVE)
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
