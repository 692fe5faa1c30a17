"""Whether the strongest echo of the pulses comes from the scene at all."""

import numpy as np
from numpy.typing import NDArray

from apertura.echo.compression import compress, range_step
from apertura.focus.inputs import PhaseHistory
from apertura.scene.grid import SceneGrid
from apertura.scene.swath import swath
from apertura.scene.terrain import Terrain

ELSEWHERE_DB = 20.0
"""An echo this much stronger than all from the scene says that the scene is not where the echo is."""

_MOST_PULSES = 64
_NEAR_CELLS = 4  # about the direct path and at the swath's edges, where responses have their sidelobes


def echo_elsewhere(history: PhaseHistory, grid: SceneGrid, terrain: Terrain) -> str | None:
    """Return one line where pulses hold a far stronger echo beyond the scene's ranges than within; None if not.

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
    outside = np.where(beyond & (np.abs(apart) > margin), power, 0.0)
    inside = np.where(beyond, 0.0, power).max(axis=1)
    ratio_db = 10 * float(np.log10(np.median(outside.max(axis=1) / np.maximum(inside, 1e-30))))
    floor_db = 10 * float(np.log10(np.median(outside.max(axis=1) / np.maximum(np.median(power, axis=1), 1e-30))))
    if min(ratio_db, floor_db) <= ELSEWHERE_DB:
        return None
    at_m = float(np.median(path_m[np.arange(len(some)), outside.argmax(axis=1)]))
    return (
        f"the strongest echo, {ratio_db:.0f} dB above all from the scene, has a total path of {at_m:.1f} m, while the "
        f"scene's are {nearest.min():.1f} to {farthest.max():.1f} m: heights, positions or path offsets are wrong, "
        "or something bright stands elsewhere"
    )


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
