"""How well several echoes gather at one place: what hypotheses about a campaign's geometry are compared by."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apertura.core.echo.compression import range_step
from apertura.core.focus.inputs import PhaseHistory
from apertura.core.imaging.parts import table_engine
from apertura.core.imaging.range_profiles import GUARD_SAMPLES, OVERSAMPLING, RangeWindow, range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround

_EVERY = 8  # points along a side that tell which paths a piece of ground spans


def gathered(histories: Sequence[PhaseHistory], grid: SceneGrid, height_m: float) -> float:
    """Return how much of their echoes several pairs gather at the place where they do so best together.

    Parameters
    ----------
    histories
        Of pairs that see one scene.
    grid
        Places to look at; level ground.
    height_m
        Of the ground above the ellipsoid (z in a local frame).

    Returns
    -------
    float
        Power against that of an echo that holds all the energy of its pulses, half of it added pair by pair, half with
        their phases; two hypotheses about one recording compare by its ratio.

    Raises
    ------
    ValueError
        If the places are deeper than the unambiguous range.

    Notes
    -----
    Source: docs/theory/focus.md, "Hypotheses".

    Examples
    --------
    >>> from apertura.core.geometry.aperture import Aperture
    >>> frequency = 1.2e9 + 1e6 * np.arange(128)
    >>> track = np.stack([np.linspace(-4, 4, 64), np.full(64, -20.0), np.full(64, 10.0)], -1)
    >>> flown = Aperture(track, track)
    >>> echo = np.exp(-2j * np.pi * frequency * flown.path(np.zeros((1, 3))) / 299792458.0).astype(np.complex64)
    >>> history = PhaseHistory(echo, frequency, np.full(128, 1 / 128), np.zeros(64), flown)
    >>> gathered([history], SceneGrid("local", -3.2, 3.2, 0.1, (64, 64)), 0.0) > 0.9
    True
    """
    engine, ground = table_engine(), FlatGround(height_m)
    places = ground.positions(grid)
    power, total = np.zeros(grid.shape), np.zeros(grid.shape, np.complex128)
    for history in histories:
        tables = engine.prepare(range_compress(history, grid, ground, window=_window(history, places)))
        image = np.nan_to_num(engine.form(tables, places)) / (len(history) * np.sqrt(_echo_power(history)))
        power += np.abs(image) ** 2
        total += image
    return float((power / len(histories) + np.abs(total / len(histories)) ** 2).max() / 2)


def _window(history: PhaseHistory, places: NDArray[np.float64]) -> RangeWindow:
    """Return total paths that hold those of a small piece of ground, from some of its points."""
    every = max(1, min(places.shape[:2]) // _EVERY)
    some = places[::every, ::every]
    paths = history.aperture.path(some).reshape(len(history), -1)
    between = 2 * float(np.linalg.norm(some[1, 1] - some[0, 0]))  # a path grows by two metres per metre at most
    step, length = range_step(history.frequency_hz, oversampling=OVERSAMPLING)
    first = paths.min(axis=1) - between - GUARD_SAMPLES * step
    samples = int(np.ceil((np.ptp(paths, axis=1).max() + 2 * between) / step)) + 2 * GUARD_SAMPLES + 1
    return RangeWindow(first, samples, step, length, paths.max(axis=1))


def _echo_power(history: PhaseHistory) -> float:
    """Return the power of the profile of an echo that held all the energy of a pulse, mean over the pulses."""
    power: NDArray[np.float64] = (np.abs(history.transfer) ** 2).astype(np.float64) @ history.weight
    return float(power.mean()) * float(history.weight.sum())
