"""Tracks from the unwrapped phases of the patches' brightest points: another start of the search than the log."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.methods.autofocus.blocks import Blocks, Contribution
from apertura.methods.autofocus.objective import Tracks, phases
from apertura.methods.autofocus.solve import Problem, State, minimal

Floats = NDArray[np.float64]

SMOOTHED = (2.0, 1.5, 1.0)
"""Standard deviation, in blocks, of what smooths phases before they are unwrapped: one per round."""


def prominent(problem: Problem, start: State, used: NDArray[np.bool_], axes: Floats) -> State:
    """Return the tracks that explain the phases of the patches' brightest pixels, least squares with the prior.

    Notes
    -----
    Source: docs/theory/autofocus.md, "Sharpness".
    """
    state = start
    for smoothed in SMOOTHED:
        histories = [[_History.of(patch, smoothed, axes) for patch in patches] for patches in state.cached]
        fit = _Fit(problem.pairs, histories, state.tracks, used)
        state = problem.state(minimal(fit, problem.prior, problem.gauge, state.unknowns, iterations=40))
    return state


@dataclass(frozen=True, eq=False)
class _History:
    """The unwrapped phase of a patch's brightest pixel over the blocks, and what of it is place and constant."""

    patch: Contribution
    phase: Floats
    weight: Floats
    known: Floats

    @classmethod
    def of(cls, patch: Contribution, smoothed: float, axes: Floats) -> "_History":
        from scipy.ndimage import gaussian_filter1d

        brightest = patch.values[int(np.abs(patch.values.sum(axis=1)).argmax())].astype(np.complex128)
        smooth = gaussian_filter1d(brightest.real, smoothed) + 1j * gaussian_filter1d(brightest.imag, smoothed)
        power = np.abs(smooth) ** 2
        weight = 1 / np.sqrt(0.5 + 0.5 * np.median(power) / (power + 1e-30))
        ground = np.asarray(sum(patch.slopes.values())) @ axes[:2].T
        columns = np.concatenate([np.ones((len(ground), 1)), ground], axis=1) * weight[:, None]
        return cls(patch, np.unwrap(np.angle(smooth)), weight, np.linalg.qr(columns)[0])


@dataclass(frozen=True, eq=False)
class _Fit:
    """Half the squared phases that tracks leave, over pairs and patches."""

    pairs: Sequence[Blocks]
    histories: Sequence[Sequence[_History]]
    reference: Tracks
    used: NDArray[np.bool_]

    def __call__(self, tracks: Tracks) -> tuple[float, dict[str, Floats]]:
        total, gradient = 0.0, {node: np.zeros_like(track) for node, track in tracks.items()}
        for blocks, histories in zip(self.pairs, self.histories, strict=True):
            moved = blocks.moves({node: tracks[node] - self.reference[node] for node in blocks.sighting.nodes})
            for one, counts in zip(histories, self.used, strict=True):
                if not counts:
                    continue
                patch = one.patch
                left = one.weight * (phases(patch, moved) + one.phase)
                left -= one.known @ (one.known.T @ left)
                total += 0.5 * float(left @ left)
                for node, slope in patch.slopes.items():
                    by_block = np.zeros_like(moved[node])
                    by_block[patch.blocks] = patch.wavenumber * (one.weight * left)[:, None] * slope
                    gradient[node] += blocks.average.T @ by_block
        return total, gradient
