"""Weights of antennas and sectors over the tiles of a tree: a polynomial for each pulse, where that will do."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.focus.engines.native_structs import TREE_GROUP
from apertura.focus.engines.tree_surface import Surface
from apertura.geometry.aperture import Aperture

BY_TREE, DIRECTLY, SILENTLY = range(3)
"""How a group of pulses is taken over a tile: native/tree_job.hpp, TreeWay."""

_TERMS = 4  # of ξ and of η
_PLACES = np.cos(np.pi * (np.arange(_TERMS) + 0.5) / _TERMS)
_BETWEEN = np.array([-1.0, -0.65, 0.0, 0.65, 1.0])
_CHECKED = 8  # pulses of which one is looked at between the places


def weights_over(
    beams: Beams, aperture: Aperture, surface: Surface, error_db: float
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the weight of each pulse over a tile, and how groups of pulses are taken.

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
    groups = -(-len(aperture) // TREE_GROUP)
    way = np.full(groups, BY_TREE, np.uint8)
    limit = 10 ** (error_db / 20) * 3  # the largest of an error is about three times its RMS
    for group in range(groups):
        pulses = slice(group * TREE_GROUP, (group + 1) * TREE_GROUP)
        here = slice(group * TREE_GROUP // _CHECKED, (group + 1) * TREE_GROUP // _CHECKED)
        if not values[pulses].any():
            way[group] = DIRECTLY if checked[here].any() else SILENTLY
        elif not (error[here] <= limit * values[pulses].max()).all():
            way[group] = DIRECTLY
    return np.ascontiguousarray(terms, np.float32), way


def _positions(surface: Surface, places: NDArray[np.float64]) -> NDArray[np.float64]:
    basis = np.polynomial.legendre.legvander(places, len(surface.coefficients) - 1)
    return np.asarray(np.einsum("ia,abk,jb->ijk", basis, surface.coefficients, basis).reshape(-1, 3))


@lru_cache
def _matrices() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return places along an axis, those between them, values → terms, and terms → values between."""
    powers, between = (np.vander(at, _TERMS, increasing=True) for at in (_PLACES, _BETWEEN))
    inverse = np.linalg.inv(powers)
    return _PLACES, _BETWEEN, np.asarray(np.kron(inverse, inverse)), np.asarray(np.kron(between, between))
