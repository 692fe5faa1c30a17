"""Phasors along a band of equal steps: exp(j2πφn) for many n, cheaper than so many exponentials."""

import numpy as np
from numpy.typing import NDArray


def turned(values: NDArray[np.number], turns: NDArray[np.float64]) -> NDArray[np.complex64]:
    """Return values·exp(j2π·turns), complex64; whole turns are taken off in float64."""
    return np.asarray(values * np.exp(2j * np.pi * (turns % 1.0)), np.complex64)


def phasors(turns: NDArray[np.float64], count: int, *, first: float = 0.0) -> NDArray[np.complex64]:
    """Return (pulse, count) complex64, exp(j2π·turns·n) for n = first, first + 1, ….

    Parameters
    ----------
    turns
        (pulse,) float64, from one n to the next.
    count
        How many n.
    first
        The first n, whole or not.

    Notes
    -----
    Products of coarse and fine ones, right to the rounding of complex64: exponentials cost most.

    Examples
    --------
    >>> phasors(np.array([0.25]), 4).round(6) + 0
    array([[ 1.+0.j,  0.+1.j, -1.+0.j,  0.-1.j]], dtype=complex64)
    """
    side = int(np.ceil(np.sqrt(count)))
    fine = turned(np.ones(1), turns[:, None] * np.arange(side))
    coarse = turned(np.ones(1), turns[:, None] * (first + side * np.arange(-(-count // side))))
    return (coarse[:, :, None] * fine[:, None]).reshape(len(turns), -1)[:, :count]
