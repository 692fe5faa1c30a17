"""How pulses are grouped into leaves and larger subapertures of a tree, and how smooth the track over a leaf is."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from apertura.core.focus.engines.native_structs import TREE_GROUP, TREE_TERMS
from apertura.core.focus.engines.tree_nodes import nodes

LEAF = TREE_GROUP
"""Pulses that a leaf makes fewer, and sums at its nodes."""

DEGREES = (5, 9, 14, 20)
"""Of curves over a leaf that fewer pulses may follow: native/tree_plan.hpp, kCurves."""

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
    """Return (leaf, pulse, 3) places; the last one fills its leaf up."""
    count = -(-len(places_m) // LEAF)
    filling = np.repeat(places_m[-1:], count * LEAF - len(places_m), axis=0)
    return np.concatenate([places_m, filling]).reshape(count, LEAF, 3)


def stray(leaves_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (leaf,) how far pulses lie from the parabola through the first, middle and last one, metres."""
    x, three = np.linspace(-1, 1, LEAF), [0, (LEAF - 1) // 2, LEAF - 1]
    to_all = np.vander(x, 3) @ np.linalg.inv(np.vander(x[three], 3))
    rest = leaves_m - np.einsum("pt,ntc->npc", to_all, leaves_m[:, three])
    return np.asarray(np.linalg.norm(rest, axis=-1).max(axis=1))


def tracks(leaves_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (leaf, term, 3) float64: the track over each leaf as orthonormal polynomials of the pulses' numbers."""
    return np.asarray(np.einsum("pt,npc->ntc", _polynomials()[0], leaves_m))


def leaf_roughness(one_m: NDArray[np.float64], other_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how much the legs of pulses leave curves of growing degree through them, along the worst direction.

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
    >>> apart, together = (leaf_roughness(jitter[0], other)[0, 0] for other in (jitter[1], jitter[0]))
    >>> bool(1.2e-3 < apart < 1.8e-3 < together < 2.4e-3)
    True
    """
    apart = _widest(one_m) + _widest(other_m)
    return np.asarray(np.sqrt(np.maximum(apart, _widest(one_m + other_m))))


def _widest(leaves_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (leaf, curve) the largest variance along any direction, of what leaves curves of growing degree."""
    shifted, widest = leaves_m - leaves_m[:, :1], np.empty((len(leaves_m), len(DEGREES)))
    terms = tracks(shifted)
    for number, degree in enumerate(DEGREES):
        rest = shifted - np.einsum("pt,ntc->npc", _polynomials()[0][:, : degree + 1], terms[:, : degree + 1])
        widest[:, number] = np.linalg.eigvalsh(np.einsum("npc,npd->ncd", rest, rest) / LEAF)[:, -1]
    return np.maximum(widest, 0)


@cache
def curve(fewer: int, nodes_db: int) -> NDArray[np.float64]:
    """Return the polynomials of `tracks` at the pulses that stand for those of a leaf, (pulse, term) float64.

    Examples
    --------
    >>> bends = np.linspace(-1, 1, 64)[None, :, None] ** 3 * np.ones(3)
    >>> smooth = curve(9, -74) @ tracks(bends)[0]
    >>> bool(np.abs(smooth[:, 0] - nodes(9, -74) ** 3).max() < 1e-12)
    True
    """
    seen = np.polynomial.legendre.legvander(nodes(fewer, nodes_db), TREE_TERMS - 1)
    return np.ascontiguousarray(seen @ _polynomials()[1])


@cache
def _polynomials() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (pulse, term) orthonormal polynomials, and what makes them of Legendre's."""
    basis, triangle = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, LEAF), TREE_TERMS - 1))
    return basis, np.linalg.inv(triangle)
