"""What a refinement leaves unknown of the tracks."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.core.quality.budget import noise_loss
from apertura.methods.autofocus.solve import Problem, State

Floats = NDArray[np.float64]

MOST_RATIO = 1e3
"""A point's neighbours, not its noise, bound what its phase tells."""


@dataclass(frozen=True, eq=False)
class Remaining:
    """Errors that are expected to be left.

    Attributes
    ----------
    std_m
        Node → (knot, 3) float64, metres, along the axes of the frame.
    phase_rad
        RMS of what is left of the phase at the patches.
    shift_m
        By which the log alone, or reference points, leave the image to be moved, rms over patches.
    """

    std_m: Mapping[str, Floats]
    phase_rad: float
    shift_m: float

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "left_rad": round(self.phase_rad, 4),
            "left_db": round(noise_loss(self.phase_rad**2).loss_db, 3),
            "gauge_shift_m": round(self.shift_m, 4),
        }


def remaining(problem: Problem, state: State) -> Remaining:
    """Return what is left unknown: per knot the log's errors and all phases seen while they last, together.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 18. What the gauge leaves is added to the standard deviations.
    """
    nodes, knots = problem.prior.nodes, len(problem.knots_s)
    column = {node: slice(3 * number, 3 * number + 3) for number, node in enumerate(nodes)}
    known = np.zeros((knots, 3 * len(nodes), 3 * len(nodes)))
    for node, prior in nodes.items():
        known[:, column[node], column[node]] += prior.axes.T @ np.diag(1 / prior.std_m**2) @ prior.axes
    rows: list[tuple[slice, Floats]] = []
    smooth = max(prior.smooth for prior in nodes.values())
    for patches, seen in zip(state.cached, state.seen, strict=True):
        for patch, now in zip(patches, seen, strict=True):
            ratio = min(now.ratio, MOST_RATIO)
            row = np.zeros((patch.blocks.stop - patch.blocks.start, 3 * len(nodes)))
            for node, slope in patch.slopes.items():
                row[:, column[node]] = patch.wavenumber * slope
            if len(row):
                known[patch.blocks] += 2 * ratio / len(row) * smooth * row[:, :, None] * row[:, None, :]
                rows.append((patch.blocks, row))
    covariance = np.linalg.inv(known)
    phases = [np.einsum("bi,bij,bj->b", row, covariance[blocks], row).mean() for blocks, row in rows]
    moved = problem.prior.tracks(problem.gauge.modes)
    std_m = {
        node: np.sqrt(np.diagonal(covariance[:, part, part], axis1=1, axis2=2) + (moved[node] ** 2).sum(axis=0))
        for node, part in column.items()
    }
    return Remaining(std_m, float(np.sqrt(np.mean(phases))) if phases else float("nan"), problem.gauge.std_m)
