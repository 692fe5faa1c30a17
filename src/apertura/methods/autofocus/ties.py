"""The image tied down where sharpness leaves it free: pairs to each other, and all to points whose places are known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.methods.autofocus.blocks import Blocks, PatchEcho, Tracks
from apertura.methods.autofocus.gauge import effects
from apertura.methods.autofocus.inputs import ReferencePoint
from apertura.methods.autofocus.objective import Seen
from apertura.methods.autofocus.patches import Patch, bandwidth_hz, patch_at
from apertura.methods.autofocus.solve import Problem

Floats = NDArray[np.float64]

_LEAST_RATIO = 30.0  # peak power of a point against its surroundings
_LEAST_STD_M = 0.01  # of a point's place in one pair against another: what scatters need not be the same spot
_ZOOMS, _SIDE = 3, 9
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class _Place:
    """Where a pair shows a point, east and north (m), how surely, and how the gauge's modes move it."""

    place_m: Floats
    std_m: float
    shift_m: Floats


def tied(
    problem: Problem, unknowns: Floats, points: Sequence[ReferencePoint], axes: Floats
) -> tuple[Floats, dict[str, Any]]:
    """Return the unknowns with their gauge settled, and what was found.

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
    Source: docs/theory/autofocus.md, eq. 15: least squares in the gauge alone, with the log's prior. All pairs see one
    scene, so that they show a point at one place.
    """
    if not len(problem.gauge.modes) or not (points or len(problem.pairs) > 1):
        return unknowns, {}
    known = [_patch_of(problem, point, axes) for point in points]
    echoes = [blocks.echoes(known) if known else [] for blocks in problem.pairs]
    settled: Floats = np.zeros(len(problem.gauge.modes))
    report: dict[str, Any] = {}
    for number in range(_ROUNDS):
        tracks = problem.prior.tracks(unknowns + settled @ problem.gauge.modes)
        matrix, misses = _between(problem, tracks, axes)
        rows, apart, found = _from_known(problem, points, echoes, tracks, axes)
        if not number:
            report = {"pairs_apart_sigma": _rms(misses)} | ({"reference_points": found} if points else {})
        matrix, misses = np.concatenate([matrix, rows]), np.concatenate([misses, apart])
        normal = matrix.T @ matrix + np.eye(len(settled))
        settled = np.asarray(np.linalg.solve(normal, matrix.T @ (matrix @ settled - misses)), np.float64)
    return unknowns + settled @ problem.gauge.modes, report


def disagreement(problem: Problem, tracks: Tracks, axes: Floats) -> tuple[float, float]:
    """Return what is left of eq. 15 where pairs are tied to each other.

    Returns
    -------
    tuple
        Half of it, as an objective; and the rms of what pairs are still apart, in standard deviations.
    """
    matrix, misses = _between(problem, tracks, axes)
    settled = np.linalg.solve(matrix.T @ matrix + np.eye(matrix.shape[1]), -matrix.T @ misses)
    left = misses + matrix @ settled
    return 0.5 * float(settled @ settled + left @ left), _rms(left)


def _between(problem: Problem, tracks: Tracks, axes: Floats) -> tuple[Floats, Floats]:
    """Return rows and misses, in standard deviations, of each pair's points against those of the first."""
    rows, misses = [np.zeros((0, len(problem.gauge.modes)))], [np.zeros(0)]
    modes = problem.prior.tracks(problem.gauge.modes)
    for number in range(len(problem.patches)):
        seen = [
            _place(blocks, echoes[number], tracks, modes, axes)
            for blocks, echoes in zip(problem.pairs, problem.echoes, strict=True)
        ]
        first = seen[0]
        for other in seen[1:]:
            if first is not None and other is not None:
                std_m = float(np.hypot(first.std_m, other.std_m))
                rows.append((other.shift_m - first.shift_m) / std_m)
                misses.append((other.place_m - first.place_m) / std_m)
    return np.concatenate(rows), np.concatenate(misses)


def _from_known(
    problem: Problem,
    points: Sequence[ReferencePoint],
    echoes: Sequence[Sequence[PatchEcho]],
    tracks: Tracks,
    axes: Floats,
) -> tuple[Floats, Floats, list[dict[str, Any]]]:
    """Return rows and misses of points whose places are known, and where each was found."""
    rows, misses, report = [np.zeros((0, len(problem.gauge.modes)))], [np.zeros(0)], []
    modes = problem.prior.tracks(problem.gauge.modes)
    for blocks, of_pair in zip(problem.pairs, echoes, strict=True):
        for point, echo in zip(points, of_pair, strict=True):
            seen = _place(blocks, echo, tracks, modes, axes)
            if seen is not None:
                apart_m = seen.place_m - axes[:2] @ np.array(point.place_m)
                rows.append(seen.shift_m / point.std_m)
                misses.append(apart_m / point.std_m)
                rounded = [round(float(one), 4) for one in apart_m]
                report.append({"name": point.name, "pair": blocks.sighting.pair, "apart_m": rounded})
    return np.concatenate(rows), np.concatenate(misses), report


def _place(blocks: Blocks, echo: PatchEcho, tracks: Tracks, modes: Tracks, axes: Floats) -> _Place | None:
    """Return where a pair shows the point of a patch; None where it shows none."""
    moved = blocks.moves(tracks)
    patch = blocks.contribution(echo, moved)
    image = patch.values.sum(axis=1)
    ratio = Seen.of(image).ratio
    if ratio < _LEAST_RATIO:
        return None
    modes_of = {node: blocks.average_of(modes[node]) for node in moved}
    _, shift_m = effects(patch, modes_of, axes)
    place, reach_m = echo.patch.pixels_m[int(np.abs(image).argmax())], _cell_m(echo) / 4
    for _ in range(_ZOOMS):
        side = np.linspace(-reach_m, reach_m, _SIDE)
        east, north = np.meshgrid(side, side)
        pixels = place + np.stack([east.ravel(), north.ravel()], axis=1) @ axes[:2]
        near = replace(echo, patch=Patch(echo.patch.place_m, pixels))
        place = pixels[int(np.abs(blocks.contribution(near, moved).values.sum(axis=1)).argmax())]
        reach_m *= 2 / (_SIDE - 1)
    std_m = float(np.hypot(_LEAST_STD_M, _cell_m(echo) / (np.pi * np.sqrt(ratio))))
    return _Place(axes[:2] @ place, std_m, shift_m)


def _patch_of(problem: Problem, point: ReferencePoint, axes: Floats) -> Patch:
    lasting = min(node.smooth for node in problem.prior.nodes.values())
    lasting_s = lasting * float(problem.knots_s[1] - problem.knots_s[0])
    sightings = [blocks.sighting for blocks in problem.pairs]
    return patch_at(np.array(point.place_m), sightings, axes, correlation_s=lasting_s)


def _cell_m(echo: PatchEcho) -> float:
    """Return the resolution c/2B, metres."""
    return SPEED_OF_LIGHT_M_S / bandwidth_hz(echo.profiles) / 2


def _rms(misses: Floats) -> float:
    """Return the rms of how far pairs are apart, in standard deviations; 0 where there is nothing to compare."""
    return round(float(np.sqrt((misses**2).sum() / max(misses.size, 1))), 3)
