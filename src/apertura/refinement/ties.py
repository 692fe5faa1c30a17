"""The image tied to points whose places are known: what sharpness leaves open is settled by them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.focus.contributions import block_contributions
from apertura.focus.inputs import Profiles
from apertura.refinement.gauge import effects
from apertura.refinement.inputs import ReferencePoint
from apertura.refinement.patches import bandwidth_hz, patch_at
from apertura.refinement.solve import Problem

Floats = NDArray[np.float64]

_LEAST_RATIO = 30.0  # peak power of a reference point against its speckle
_ZOOMS, _SIDE = 5, 9
_ROUNDS = 3


def tied(
    problem: Problem, unknowns: Floats, points: Sequence[ReferencePoint], axes: Floats
) -> tuple[Floats, dict[str, Any]]:
    """Return the unknowns with their gauge settled by reference points, and what was found.

    Parameters
    ----------
    problem, unknowns
        As solved.
    points
        Whose places are known.
    axes
        (3, 3) float64, rows are east, north, up.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 15: least squares in the gauge alone, with the log's prior.
    """
    if not points or not len(problem.gauge.modes):
        return unknowns, {}
    settled: Floats = np.zeros(len(problem.gauge.modes))
    for _ in range(_ROUNDS):
        matrix, misses, report = _misses(problem, unknowns + settled @ problem.gauge.modes, points, axes)
        if not len(misses):
            return unknowns, {"reference_points": []}
        # Where the misses are linear in the modes: those of the log itself, from which the prior counts.
        normal = matrix.T @ matrix + np.eye(len(settled))
        settled = np.asarray(np.linalg.solve(normal, matrix.T @ (matrix @ settled - misses)), np.float64)
    return unknowns + settled @ problem.gauge.modes, {"reference_points": report}


def _misses(
    problem: Problem, unknowns: Floats, points: Sequence[ReferencePoint], axes: Floats
) -> tuple[Floats, Floats, list[dict[str, Any]]]:
    """Return how far points lie from where they belong, in their standard deviations, and how modes change that."""
    rows, apart, report = [np.zeros((0, len(problem.gauge.modes)))], [np.zeros(0)], []
    correction, tracks = problem.correction(unknowns), problem.prior.tracks(problem.gauge.modes)
    found_tracks = problem.prior.tracks(unknowns)
    for point in points:
        place = np.array(point.place_m)
        patch = patch_at(place, [blocks.sighting for blocks in problem.pairs], axes, correlation_s=_lasting_s(problem))
        for blocks in problem.pairs:
            [echo] = blocks.echoes([patch])
            seen = blocks.contribution(echo, blocks.moves(found_tracks))
            power = np.abs(seen.values.sum(axis=1)) ** 2
            if power.max() < _LEAST_RATIO * np.median(power) / np.log(2):
                continue
            moved = {node: blocks.average_of(tracks[node]) for node in dict.fromkeys(blocks.sighting.nodes)}
            _, shift = effects(seen, moved, axes)
            profiles = blocks.sighting.moved(correction)
            found = _peak(profiles, patch.pixels_m[int(power.argmax())], axes) - place
            rows.append(shift / point.std_m)
            apart.append(axes[:2] @ found / point.std_m)
            report.append({"name": point.name, "pair": blocks.sighting.pair, "apart_m": _rounded(axes[:2] @ found)})
    return np.concatenate(rows), np.concatenate(apart), report


def _lasting_s(problem: Problem) -> float:
    """Return how long errors last, seconds."""
    return min(node.smooth for node in problem.prior.nodes.values()) * float(problem.knots_s[1] - problem.knots_s[0])


def _peak(profiles: Profiles, start_m: Floats, axes: Floats) -> Floats:
    """Return the (3,) place of the brightest point near a place, at its height."""
    place, reach_m = start_m, SPEED_OF_LIGHT_M_S / bandwidth_hz(profiles) / 4
    whole = np.array([0, len(profiles)])
    for _ in range(_ZOOMS):
        side = np.linspace(-reach_m, reach_m, _SIDE)
        east, north = np.meshgrid(side, side)
        pixels = place + np.stack([east.ravel(), north.ravel()], axis=1) @ axes[:2]
        place = pixels[int(np.abs(block_contributions(profiles, pixels, edges=whole)[:, 0]).argmax())]
        reach_m *= 2 / (_SIDE - 1)
    return np.asarray(place)


def _rounded(values: Floats) -> list[float]:
    return [round(float(value), 4) for value in values]
