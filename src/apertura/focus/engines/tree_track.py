"""How pulses are grouped into leaves and larger subapertures of a tree, and how smooth the track over a leaf is."""

import numpy as np
from numpy.typing import NDArray

from apertura.focus.engines.native_structs import TREE_GROUP

LEAF = TREE_GROUP
"""Pulses that a leaf makes fewer, and sums at its nodes."""

DEGREES = (5, 9, 14, 20)
"""Of curves over a leaf that fewer pulses may follow: native/tree_plan.hpp, kCurves."""

SMOOTH = 1.0
"""Of what an interpolation may err by: how far pulses may leave such a curve, RMS. What they leave it by errs more than
itself: fewer pulses neither show it nor leave it out."""

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


def leaf_roughness(leaves_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (leaf, curve) RMS distance of pulses from curves of growing degree through them, metres."""
    basis = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, LEAF), DEGREES[-1]))[0]
    terms = np.einsum("pt,npc->ntc", basis, leaves_m - leaves_m[:, :1])
    power = ((leaves_m - leaves_m[:, :1]) ** 2).sum((1, 2))[:, None] - np.cumsum((terms**2).sum(-1), axis=1)
    return np.asarray(np.sqrt(np.maximum(power[:, DEGREES], 0) / LEAF))
