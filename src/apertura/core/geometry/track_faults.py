"""What is wrong with single epochs of a flight log: spikes and steps.

Each test asks the log itself. An epoch is compared with the cubic through two epochs on either side; a fault is what,
once it is taken out, leaves its neighbours smooth. Movement that the log samples badly does not become smooth that
way, and is left alone.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MATTERS_M = 5e-3
"""Errors of single epochs below this are the log's noise, whatever it is."""

GRAIN_M = 0.01
"""Of the coarsest log that resolves centimetres."""

_SIGMA = 10.0  # a fault is as many times the log's own scatter
_SMOOTHER = {1: 7.0, 2: 12.0, 3: 20.0}  # epochs taken out → how many times smoother their neighbours must become
_STEP_SMOOTHER = 10.0
_AGILE_M_S2 = 10.0  # a node may have flown a step that takes no more than this, forth and back within an interval
_CHI3_MEDIAN = 1.538  # median length of a vector of three standard normal components
_MOST_ROUNDS = 20


class Fault(NamedTuple):
    """Epochs first…last that are wrong by `size_m`; a step lies between them."""

    first: int
    last: int
    size_m: float


def misfits(time_s: Floats, position_m: Floats) -> Floats:
    """Return how far each epoch lies from the cubic through two epochs on either side.

    Parameters
    ----------
    time_s
        (epoch,) float64, seconds, ascending.
    position_m
        (epoch, axis) float64, metres.

    Returns
    -------
    ndarray
        (epoch, axis) float64, metres; zero at the first and last two.

    Notes
    -----
    Source: docs/theory/tracks.md, "Misfit of an epoch".

    Examples
    --------
    >>> misfits(np.arange(7.0), np.array([[0.0], [0], [0], [6], [0], [0], [0]])).ravel()
    array([ 0.,  0., -4.,  6., -4.,  0.,  0.])
    """
    result = np.zeros_like(position_m)
    if len(time_s) < 5:
        return result
    at = np.arange(2, len(time_s) - 2)
    nodes = at[:, None] + np.array([-2, -1, 1, 2])
    result[at] = position_m[at] - np.einsum("ek,eka->ea", _lagrange(time_s[nodes], time_s[at]), position_m[nodes])
    return result


def scatter_m(misfit_m: Floats) -> float:
    """Return the robust scatter of an axis of `misfits`, metres; a log that mostly stands still does not hide it.

    Where most epochs repeat a coarse position exactly, the few that move tell its grain.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (5000, 3))
    >>> round(scatter_m(noise), 3)
    0.01
    """
    size = np.linalg.norm(misfit_m[2:-2], axis=1)
    moved = size[size > 1e-7]
    if not moved.size:
        return 0.0
    return max(float(np.median(size)), min(float(np.median(moved)), GRAIN_M)) / _CHI3_MEDIAN


def find_spikes(time_s: Floats, position_m: Floats) -> list[Fault]:
    """Return one to three epochs in a row that stand out of their neighbours.

    Notes
    -----
    Source: docs/theory/tracks.md, "Spikes and steps".

    Examples
    --------
    >>> time_s = np.arange(60) * 0.1
    >>> flown = np.stack([5 * time_s, np.sin(time_s), 0 * time_s], -1)
    >>> flown[30, 2] += 0.2
    >>> [(spike.first, spike.last, round(spike.size_m, 2)) for spike in find_spikes(time_s, flown)]
    [(30, 30, 0.2)]
    """
    index, found = np.arange(len(time_s)), []
    for _ in range(_MOST_ROUNDS):
        time, place = time_s[index], position_m[index]
        misfit = misfits(time, place)
        scatter = scatter_m(misfit)
        here = [_spike(time, place, suspect, scatter) for suspect in _suspects(misfit, scatter)]
        spikes = [spike for spike in here if spike is not None]
        if not spikes:
            break
        found += [Fault(int(index[first]), int(index[last]), size) for first, last, size in spikes]
        index = np.delete(index, np.concatenate([np.arange(first, last + 1) for first, last, _ in spikes]))
    return sorted(found)


def find_steps(time_s: Floats, position_m: Floats) -> list[Fault]:
    """Return pairs of epochs between which all positions are shifted at once, as when a receiver fixes anew.

    Examples
    --------
    >>> time_s = np.arange(60) * 0.1
    >>> flown = np.stack([5 * time_s, np.sin(time_s), np.where(time_s < 2.95, 0, 0.2)], -1)
    >>> [(step.first, step.last, round(step.size_m, 2)) for step in find_steps(time_s, flown)]
    [(29, 30, 0.2)]
    """
    misfit = misfits(time_s, position_m)
    scatter, found = scatter_m(misfit), []
    for suspect in _suspects(misfit, scatter):
        tried = [_step(time_s, misfit, before, scatter) for before in (suspect - 1, suspect)]
        steps = [step for step in tried if step is not None]
        if steps:
            found.append(max(steps, key=lambda step: step.size_m))
    return sorted(found)


def _lagrange(nodes: Floats, at: Floats) -> Floats:
    """Return (epoch, node) weights of the polynomial through `nodes` (epoch, node) at `at` (epoch,)."""
    weights = np.ones_like(nodes)
    for own in range(nodes.shape[1]):
        for other in range(nodes.shape[1]):
            if other != own:
                weights[:, own] *= (at - nodes[:, other]) / (nodes[:, own] - nodes[:, other])
    return weights


def _suspects(misfit_m: Floats, scatter: float) -> list[int]:
    """Return epochs whose misfit is large, and larger than within six epochs either way."""
    size = np.linalg.norm(misfit_m, axis=1)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(size, 6), 13).max(axis=1)
    return np.flatnonzero((size > max(0.6 * _SIGMA * scatter, 0.6 * MATTERS_M)) & (size >= around)).tolist()


def _spike(time_s: Floats, position_m: Floats, suspect: int, scatter: float) -> Fault | None:
    """Return the fewest epochs about a suspect without which its neighbours are smooth."""
    for count, smoother in _SMOOTHER.items():
        for first in range(suspect - count, suspect + 2):
            last = first + count - 1
            if first < 6 or last > len(time_s) - 7:
                continue
            near = np.r_[first - 6 : first, last + 1 : last + 7]
            group = np.arange(first, last + 1)
            nodes = np.tile([first - 2, first - 1, last + 1, last + 2], (count, 1))
            apart = position_m[group] - np.einsum(
                "ek,eka->ea", _lagrange(time_s[nodes], time_s[group]), position_m[nodes]
            )
            worst = apart[np.argmax(np.linalg.norm(apart, axis=1))]
            size = float(np.linalg.norm(worst))
            left = misfits(time_s[near], position_m[near])[4:8] @ (worst / max(size, 1e-12))
            if size > max(_SIGMA * scatter, MATTERS_M, smoother * float(np.sqrt(np.mean(left**2)))):
                return Fault(first, last, size)
    return None


def _step(time_s: Floats, misfit_m: Floats, before: int, scatter: float) -> Fault | None:
    near = np.arange(max(before - 5, 0), min(before + 7, len(time_s)))
    pattern = misfits(time_s[near], (near > before)[:, None].astype(float))[2:-2, 0]
    power = float(pattern @ pattern)
    if power == 0:
        return None
    step = pattern @ misfit_m[near][2:-2] / power
    size = float(np.linalg.norm(step))
    left = misfit_m[near][2:-2] @ (step / max(size, 1e-12)) - size * pattern
    rough = _STEP_SMOOTHER * float(np.sqrt(np.mean(left**2) / power))
    flown = _AGILE_M_S2 * float(time_s[before + 1] - time_s[before]) ** 2 / 4
    return Fault(before, before + 1, size) if size > max(_SIGMA * scatter, 3 * GRAIN_M, rough, flown) else None
