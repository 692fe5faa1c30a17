"""From phase within a turn to phase that goes on from pixel to pixel; and how often the first contradicts itself."""

from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from numpy.typing import NDArray

_LEAST_SHARE = 0.01  # of all pixels that a part is made of: the library's own, so that a speck is no part


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """Phase without jumps of a turn, part by part.

    Attributes
    ----------
    phase
        (y, x) float32, rad; NaN where it is not known.
    part
        (y, x) uint32, 0 outside; between two parts any number of turns may lie.
    by
        The library and its version; empty: nobody unwrapped, the phase is within half a turn of its reference.
    residues
        Loops of four pixels around which the wrapped phase does not come back to itself.
    loops
        Loops of four valid pixels.
    jumps
        Neighbours whose wrapped phases lie more than half a turn apart: turns that unwrapping must decide on.
    """

    phase: NDArray[np.float32]
    part: NDArray[np.uint32]
    by: str
    residues: int
    loops: int
    jumps: int


def unwrap(phase: NDArray[np.float32], coherence: NDArray[np.float32], *, looks: float) -> Unwrapped:
    """Return the phase unwrapped by snaphu, where that is installed; else as it is, within a turn.

    Parameters
    ----------
    phase
        (y, x) float32, rad, NaN where it is not to be trusted.
    coherence
        (y, x) float32, 0 to 1.
    looks
        Independent samples that one phase is the mean of.

    Notes
    -----
    Source: docs/theory/interferometry.md, section 6; C. W. Chen and H. A. Zebker, J. Opt. Soc. Am. A 18, 338 (2001).

    Examples
    --------
    >>> ramp = np.angle(np.exp(0.4j * np.arange(40.0))) * np.ones((24, 1))
    >>> told = unwrap(ramp.astype(np.float32), np.full((24, 40), 0.9, np.float32), looks=9.0)
    >>> told.residues, told.jumps
    (0, 48)
    """
    valid = np.isfinite(phase)
    residues, loops, jumps = contradictions(phase)
    by = _library()
    if not by or not jumps:
        return Unwrapped(phase, valid.astype(np.uint32), by, residues, loops, jumps)
    import snaphu

    wrapped = np.where(valid, np.exp(1j * np.where(valid, phase, 0)), 0).astype(np.complex64)
    weight = np.where(valid, coherence, 0).astype(np.float32)
    whole, part = snaphu.unwrap(
        wrapped, weight, max(1.0, looks), cost="smooth", mask=valid, min_conncomp_frac=_LEAST_SHARE
    )
    known = valid & (part > 0)
    # its own phase is rounded: whole turns are taken from it, and the phase that was measured stays
    turns = np.round((np.where(known, whole, 0) - np.where(known, phase, 0)) / (2 * np.pi))
    return Unwrapped(
        np.where(known, phase + 2 * np.pi * turns, np.nan).astype(np.float32),
        np.where(known, part, 0).astype(np.uint32),
        by,
        residues,
        loops,
        jumps,
    )


def contradictions(phase: NDArray[np.float32]) -> tuple[int, int, int]:
    """Return residues, loops of four valid pixels, and neighbours more than half a turn apart.

    Examples
    --------
    >>> contradictions(np.array([[0.0, 2.0], [-2.0, 4.0]], np.float32))
    (1, 1, 1)
    """
    down, right = np.diff(phase, axis=0), np.diff(phase, axis=1)
    turns_down, turns_right = (np.round(step / (2 * np.pi)) for step in (down, right))
    around = turns_right[:-1] + turns_down[:, 1:] - turns_right[1:] - turns_down[:, :-1]
    there = np.isfinite(around)
    jumps = sum(int(np.count_nonzero(turns[np.isfinite(turns)])) for turns in (turns_down, turns_right))
    return int(np.count_nonzero(around[there])), int(there.sum()), jumps


def _library() -> str:
    """Return name and version of the library that unwraps; nothing where it is not installed."""
    try:
        return f"snaphu {version('snaphu')}"
    except PackageNotFoundError:
        return ""
