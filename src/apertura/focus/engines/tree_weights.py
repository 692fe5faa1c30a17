"""Weights of antennas and sectors over the tiles of a tree: a polynomial for each pulse, where that will do."""

from collections.abc import Sequence
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
    beams: Beams, aperture: Aperture, surfaces: Sequence[Surface], error_db: float
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the weight of each pulse over tiles, how groups of pulses are taken, and which cannot be made fewer.

    Parameters
    ----------
    beams, aperture
        Of the same pulses.
    surfaces
        Of the tiles: for many at once a pulse takes a fifth of the time.
    error_db
        What polynomials may err by, relative to the largest weight.

    Returns
    -------
    weights
        (tile, pulse, 16) float32: factor of ξ^a η^b at 4·b + a.
    way
        (tile, group of 64 pulses) uint8: by tree where polynomials hold, silently where no pulse weighs anything.
    each
        (tile, group) uint8: 1 where weights change from pulse to pulse otherwise than smoothly, so that no pulse can
        stand for others.

    Notes
    -----
    Source: docs/theory/tree.md, "Weights".
    """
    at, between, to_terms, terms_between = _matrices()
    values = _seen(beams, aperture, surfaces, at)
    terms = values @ to_terms.T
    some = slice(_CHECKED // 2, None, _CHECKED) if len(aperture) > _CHECKED else slice(None)
    checked = _seen(beams[some], aperture[some], surfaces, between)
    error = np.abs(terms[some] @ terms_between.T - checked).max(axis=2)
    centres = np.stack([surface.centre_m for surface in surfaces])
    radii = [np.linalg.norm(_positions(surface, _BETWEEN) - surface.centre_m, axis=-1).max() for surface in surfaces]
    lit = reached(beams, aperture, centres, np.array(radii), pulses=TREE_GROUP)
    limit = 10 ** (error_db / 20) * 3  # the largest of an error is about three times its RMS
    largest, error = _by_group(values.max(axis=2), TREE_GROUP), _by_group(error, TREE_GROUP // _CHECKED)
    # A beam may be narrower than what lies between the places.
    holds = (largest > 0) & (error <= limit * largest)
    way = np.where(lit, np.where(holds, BY_TREE, DIRECTLY), SILENTLY).astype(np.uint8)
    each = np.zeros(lit.shape, np.uint8)
    full = len(values) // TREE_GROUP  # of a group not full each pulse goes for itself anyway
    each[:full] = _jumps(values[: full * TREE_GROUP]) > limit * largest[:full]
    return np.ascontiguousarray(terms.swapaxes(0, 1), np.float32), way.T.copy(), each.T.copy()


def _seen(
    beams: Beams, aperture: Aperture, surfaces: Sequence[Surface], places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the weights at some places of tiles, (pulse, tile, place)."""
    at = np.concatenate([_positions(surface, places) for surface in surfaces])
    return beams.weight(aperture, at).reshape(len(aperture), len(surfaces), -1)


def _by_group(values: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return the largest of each group of so many pulses, (group, tile); zero where there is none."""
    padded = np.pad(values, ((0, -len(values) % size), (0, 0)))
    return np.asarray(padded.reshape(-1, size, values.shape[1]).max(axis=1))


def _jumps(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how much weights leave a curve over the pulses of a group, at most: (group, tile)."""
    grouped = values.reshape(len(values) // TREE_GROUP, TREE_GROUP, values.shape[1] * values.shape[2])
    rest = np.abs(grouped - _curve() @ (_curve().T @ grouped)).max(axis=1)
    return np.asarray(rest.reshape(len(grouped), *values.shape[1:]).max(axis=2))


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
