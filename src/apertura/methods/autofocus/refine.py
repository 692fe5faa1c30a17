"""Tracks of a flight refined by the images of all its pairs, tied to each other and to points of known place."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from apertura.common.arrays import Bools, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain
from apertura.methods.autofocus.evidence import MOST_APART, MOST_RATIO, Evidence, gains_db, range_shifts, remaining
from apertura.methods.autofocus.inputs import NodePrior, Prior, ReferencePoint, Refinement, Sighting, TrackErrors
from apertura.methods.autofocus.objective import Blocks, PatchEcho, PatchImage, Tracks
from apertura.methods.autofocus.patches import (
    LEAST_PATCHES,
    MOST_VALUES,
    Candidates,
    Patch,
    affordable,
    bandwidth_hz,
    patch_at,
)
from apertura.methods.autofocus.solve import Gauge, Problem, State, effects, find_gauge, prominent
from apertura.methods.autofocus.speckle import SpeckleTiles, refined_by_speckle, tiles

# ---- The image tied down where sharpness leaves it free: pairs to each other, and all to points whose places are
# known


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
    ratio = PatchImage.of(image).ratio
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


# ---- Tracks of a flight refined by the images of all its pairs together --------------------------------------------


FOLDS = 4
"""A quarter of the patches is not fitted, and tells whether the others are to be believed."""

_KNOTS_A_LASTING = 10  # to an error's correlation time
_LEAST_KNOTS = 64
_FEW = 8  # patches: each quarter of so few is held out once
_LOST_TO_TIES_DB = 0.1
_STAGES = 3  # of caching and sharpening


def refine(
    sightings: Sequence[Sighting],
    grid: SceneGrid,
    terrain: Terrain,
    errors: Mapping[str, TrackErrors],
    *,
    reference_points: Sequence[ReferencePoint] = (),
) -> Refinement:
    """Return the corrections of a flight's tracks that make its images sharpest, and whether they are to be believed.

    Parameters
    ----------
    sightings
        What every pair saw.
    grid, terrain
        The scene.
    errors
        Node → what is known of its log's errors.
    reference_points
        Points whose places are known, to which the image is tied.

    Notes
    -----
    Source: docs/theory/autofocus.md. A rejected refinement keeps what it found; images are formed without it.
    """
    search = TrackSearch.begin(sightings, grid, terrain, errors)
    if len(search.problem.patches) < LEAST_PATCHES:
        found = search.by_speckle(grid, terrain, errors)
        return found if found is not None and found.accepted else search.found.refused(errors, found)
    state, evidence = search.judged()
    left = remaining(search.problem, state)
    unknowns, ties = search.tied(state, reference_points, apart_sigma=evidence.apart_sigma)
    report = {**evidence.report, **left.report, **ties, "patches": len(search.problem.patches)}
    correction = search.problem.correction(unknowns)
    return Refinement(correction, left.std_m, evidence.accepted, evidence.why, report, evidence.flags)


@dataclass(frozen=True, eq=False)
class TrackSearch:
    """The problem, and what its patches show from the logs."""

    problem: Problem
    found: Candidates
    begun: State
    wavelength_m: float

    @classmethod
    def begin(
        cls, sightings: Sequence[Sighting], grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]
    ) -> "TrackSearch":
        """Return the problem of a flight, as its logs have it."""
        found = Candidates.of(sightings, grid, terrain, errors)
        knots_s = _knots(sightings, errors)
        prior = Prior({node: NodePrior.of(one, knots_s, found.axes) for node, one in sorted(errors.items())})
        pairs = [Blocks.of(sighting, knots_s) for sighting in sightings]
        echoes = [blocks.echoes(found.patches) for blocks in pairs]
        problem = Problem(pairs, echoes, knots_s, prior, Gauge.none(prior.size))
        values = [sum(one.values for one in of_pairs) for of_pairs in zip(*echoes, strict=True)]
        problem = problem.of(range(affordable(values)))
        begun = problem.state(np.zeros(prior.size))
        if len(problem.patches) >= LEAST_PATCHES:
            problem = replace(problem, gauge=find_gauge(pairs, begun.cached, prior, knots_s, found.axes))
        wavelength_m = SPEED_OF_LIGHT_M_S / sightings[0].profiles.centre_frequency_hz
        return cls(problem, found, begun, wavelength_m)

    @property
    def axes(self) -> Floats:
        """(3, 3) float64, rows are east, north, up."""
        return self.found.axes

    def judged(self) -> tuple[State, Evidence]:
        """Return the tracks that all patches ask for, and what those say of them that were not fitted."""
        problem, begun = self.problem, self.begun
        held_out_db = np.full((len(problem.pairs), len(problem.patches)), np.nan)
        everything, fold = np.ones(len(problem.patches), bool), np.arange(len(problem.patches)) % FOLDS
        few = len(problem.patches) < _FEW
        states = [] if not few else [self._fitted(everything)]
        for number in range(FOLDS if few else 1):
            fitted = fold != (number + 2) % FOLDS
            states.append(self._fitted(fitted))
            held_out_db[:, ~fitted] = gains_db(begun.seen, states[-1].seen)[:, ~fitted]
        lowest = self._lowest(states, everything)
        state = problem.sharper(lowest, everything)
        apart_sigma = self._apart_sigma(state)
        if apart_sigma > MOST_APART:
            state, apart_sigma = lowest, self._apart_sigma(lowest)
        known = 2 * sum(min(one.ratio, MOST_RATIO) for seen in state.seen for one in seen)
        evidence = Evidence(
            fitted_db=gains_db(begun.seen, state.seen),
            held_out_db=held_out_db[:, np.isfinite(held_out_db[0])],
            settled=problem.gauge.settled(state.unknowns, known=known),
            before=range_shifts(problem, begun, self.axes),
            after=range_shifts(problem, state, self.axes),
            wavelength_m=self.wavelength_m,
            apart_sigma=apart_sigma,
        )
        return state, evidence

    def tied(
        self, state: State, points: Sequence[ReferencePoint], *, apart_sigma: float
    ) -> tuple[Floats, dict[str, Any]]:
        """Return the unknowns tied down where sharpness leaves them free, unless ties blur or part the pairs."""
        unknowns, report = tied(self.problem, state.unknowns, points, self.axes)
        if unknowns is state.unknowns:
            return unknowns, report
        after = self.problem.state(unknowns)
        lost_db = -float(gains_db(state.seen, after.seen).mean())
        if self._apart_sigma(after) > max(apart_sigma, 1.0) or lost_db > _LOST_TO_TIES_DB:
            return state.unknowns, {**report, "ties": "left out: they blurred points or parted pairs"}
        return unknowns, report

    def _apart_sigma(self, state: State) -> float:
        """Return how far pairs show points apart, in standard deviations of their places."""
        return disagreement(self.problem, state.tracks, self.axes)[1]

    def _fitted(self, used: Bools) -> State:
        """Return the tracks that some patches ask for, from the start that leads lowest."""
        problem, begun = self.problem, self.begun
        starts = (begun, prominent(problem, begun, used, self.axes))
        best = self._lowest([problem.sharper(start, used) for start in starts], used)
        return problem.sharper(best, used, stages=_STAGES - 1)

    def _lowest(self, states: Sequence[State], used: Bools) -> State:
        """Return the state whose patches are sharpest and whose pairs agree on where they are."""
        problem = self.problem
        values = [
            problem.value(state, used, self.begun.seen) + disagreement(problem, state.tracks, self.axes)[0]
            for state in states
        ]
        return states[int(np.argmin(values))]

    def by_speckle(self, grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]) -> Refinement | None:
        """Return what the ground between points asks for; None where one pair alone saw it."""
        problem = self.problem
        if len(problem.pairs) < 2:
            return None
        lasting_s = min(one.correlation_s for one in errors.values())
        found = tiles([blocks.sighting for blocks in problem.pairs], grid, terrain, lasting_s=lasting_s)
        pixels = sum(len(tile.patch.pixels_m) for tile in found)
        every = 1 + pixels * len(problem.knots_s) * len(problem.pairs) // MOST_VALUES
        return refined_by_speckle(SpeckleTiles.of(problem.pairs, found[::every]), problem.prior, problem.knots_s)


def _knots(sightings: Sequence[Sighting], errors: Mapping[str, TrackErrors]) -> Floats:
    """Return equally spaced times: several to an error's correlation time, none closer than pulses."""
    first = min(float(one.time_s[0]) for one in sightings)
    last = max(float(one.time_s[-1]) for one in sightings)
    pulse_s = max(float(np.median(np.diff(one.time_s))) for one in sightings)
    lasting_s = min(one.correlation_s for one in errors.values())
    step_s = max(min(lasting_s / _KNOTS_A_LASTING, (last - first) / _LEAST_KNOTS), pulse_s)
    count = max(2, int(np.ceil((last - first) / step_s)))
    return first + (np.arange(count) + 0.5) * (last - first) / count
