"""From which level heights count: a constant phase between two images tells nothing, so something else must."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.methods.interferometry.unwrapping import Unwrapped


@dataclass(frozen=True)
class Known:
    """A point of known height, where the images show it.

    Attributes
    ----------
    name
        What it is called.
    row, column
        The pixel nearest to where it shows.
    phase_rad
        The phase that its height alone would have there.
    measured_rad
        The phase that is measured there, within a turn; NaN where none is.
    """

    name: str
    row: int
    column: int
    phase_rad: float
    measured_rad: float = float("nan")


@dataclass(frozen=True)
class Level:
    """What was taken off the phase.

    Attributes
    ----------
    phase_rad
        The constant.
    part
        The part of the unwrapped phase that it holds for; heights of others are unknown by whole turns.
    points
        The points of known height that tell it; none: the median of the phase does.
    spread_rad
        Largest distance of such a point from the constant; None of fewer than two.
    """

    phase_rad: float
    part: int
    points: tuple[str, ...] = ()
    spread_rad: float | None = None


def level(phase: Unwrapped, known: Sequence[Known]) -> Level | None:
    """Return the constant between two images, docs/theory/interferometry.md, eq. 15; None where no phase is valid.

    Parameters
    ----------
    phase
        Unwrapped.
    known
        Points of known height; those whose own phase is not known do not count.

    Examples
    --------
    >>> phase = np.array([[0.1, 0.2, 0.6]], np.float32)
    >>> told = Unwrapped(phase, np.ones((1, 3), np.uint32), "", 0, 0, 0)
    >>> level(told, []).phase_rad, round(level(told, [Known("mast", 0, 2, 0.5, 0.7)]).phase_rad, 3)
    (0.2, 0.2)
    """
    valid = np.argwhere(np.isfinite(phase.phase) & (phase.part > 0))
    if not len(valid):
        return None
    told = [(one, *_unwrapped(one, phase, valid)) for one in known if np.isfinite(one.measured_rad)]
    if not told:
        sizes = np.bincount(phase.part[tuple(valid.T)])
        part = int(np.argmax(sizes[1:])) + 1
        return Level(round(float(np.median(phase.phase[phase.part == part])), 6), part)
    parts = [part for *_, part in told]
    part = max(sorted(set(parts)), key=parts.count)
    apart = {one.name: value - one.phase_rad for one, value, of in told if of == part}
    constant = float(np.median(list(apart.values())))
    spread = max(abs(value - constant) for value in apart.values()) if len(apart) > 1 else None
    return Level(round(constant, 6), part, tuple(apart), spread)


def _unwrapped(one: Known, phase: Unwrapped, valid: NDArray[np.int64]) -> tuple[float, int]:
    """Return the phase measured at a point, by the turns and in the part of the valid pixel nearest to it."""
    near = tuple(valid[np.argmin(((valid - (one.row, one.column)) ** 2).sum(axis=1))])
    turns = np.round((float(phase.phase[near]) - one.measured_rad) / (2 * np.pi))
    return float(one.measured_rad + 2 * np.pi * turns), int(phase.part[near])


def levelled(phase: Unwrapped, told: Level) -> NDArray[np.float32]:
    """Return the phase that height alone has, (y, x) float32 rad: of one part, within half a turn if nobody unwrapped.

    Examples
    --------
    >>> phase = Unwrapped(np.array([[3.0]], np.float32), np.ones((1, 1), np.uint32), "", 0, 0, 1)
    >>> levelled(phase, Level(-1.0, 1)).round(3)
    array([[-2.283]], dtype=float32)
    """
    own = np.where(phase.part == told.part, phase.phase - told.phase_rad, np.nan).astype(np.float32)
    return own if phase.by or not phase.jumps else np.angle(np.exp(1j * own)).astype(np.float32)
