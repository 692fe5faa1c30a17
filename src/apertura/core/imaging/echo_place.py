"""Whether the strongest echo of the pulses comes from the scene at all."""

import numpy as np
from numpy.typing import NDArray

from apertura.core.echo.compression import compress, range_step
from apertura.core.focus.inputs import PhaseHistory
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import swath
from apertura.core.scene.terrain import Terrain

ELSEWHERE_DB = 20.0
"""An echo this much stronger than all from the scene says that the scene is not where the echo is."""

UNGATHERED_DB = 25.0
"""An echo so far above the median of the scene's ranges is a point's, which some place must gather; speckle has 10."""

LEAST_PULSES = 64
"""Fewer are not enough to tell whether a point dominates its cell."""

_MOST_PULSES = 64
_NEAR_CELLS = 4  # about the direct path and at the swath's edges, where responses have their sidelobes


def echo_elsewhere(history: PhaseHistory, grid: SceneGrid, terrain: Terrain) -> str | None:
    """Return one line where pulses hold a strong echo that an image without bright points does not gather; None if not.

    Parameters
    ----------
    history
        Of every pulse; some of them are looked at.
    grid, terrain
        The scene.

    Notes
    -----
    Source: docs/theory/focus.md, "Echo elsewhere". The direct path between the antennas does not count.
    """
    some = history[history.aperture.sample(_MOST_PULSES)]
    step_m, length = range_step(some.frequency_hz, oversampling=1.0)
    path_m, power = _profiles(some, step_m, length)
    nearest, farthest = swath(grid, terrain, some.aperture)
    span_m = step_m * length
    margin = _NEAR_CELLS * step_m
    beyond = (path_m - (nearest[:, None] - margin)) % span_m > (farthest - nearest)[:, None] + 2 * margin
    direct = np.linalg.norm(some.aperture.tx_m - some.aperture.rx_m, axis=1)
    apart = (path_m - direct[:, None] + span_m / 2) % span_m - span_m / 2
    beside = np.where(beyond & (np.abs(apart) > margin), power, 0.0)
    outside = beside.max(axis=1)
    within = np.where(beyond, np.nan, power)
    inside = np.nanmax(within, axis=1)
    scene = f"the scene's are {nearest.min():.1f} to {farthest.max():.1f} m"
    above_db = _median_db(outside / np.maximum(inside, 1e-30))
    if min(above_db, _median_db(outside / np.maximum(np.median(power, axis=1), 1e-30))) > ELSEWHERE_DB:
        at_m = float(np.median(path_m[np.arange(len(some)), beside.argmax(axis=1)]))
        return (
            f"the strongest echo, {above_db:.0f} dB above all from the scene, has a total path of {at_m:.1f} m, while "
            f"{scene}: heights, positions or path offsets are wrong, or something bright stands elsewhere"
        )
    alone_db = _median_db(inside / np.maximum(np.nanmedian(within, axis=1), 1e-30))
    if len(history) >= LEAST_PULSES and alone_db > UNGATHERED_DB:
        return (
            f"pulses hold an echo {alone_db:.0f} dB above the median of the scene's ranges, and no place of the image "
            "gathers it: times, positions or heights are wrong, or it comes from beside the scene"
        )
    return None


def _median_db(ratio: NDArray[np.float64]) -> float:
    return 10 * float(np.log10(max(float(np.median(ratio)), 1e-30)))


def _profiles(history: PhaseHistory, step_m: float, length: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return total paths and powers (pulse, range) over the whole unambiguous range."""
    samples = compress(
        history.transfer,
        history.frequency_hz,
        weight=history.weight,
        reference_delay_s=history.reference_delay_s,
        start_m=np.zeros(len(history)),
        count=length,
        oversampling=1.0,
    )
    path_m = np.broadcast_to(step_m * np.arange(length), samples.shape)
    return path_m, np.abs(samples).astype(np.float64) ** 2
