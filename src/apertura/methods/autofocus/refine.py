"""Tracks of a flight refined by the images of all its pairs, and by reference points of known place."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from apertura.common.arrays import Bools, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain
from apertura.methods.autofocus.evidence import (
    MOST_APART_SIGMA,
    MOST_RATIO,
    Evidence,
    gains_db,
    range_shifts,
    remaining,
)
from apertura.methods.autofocus.inputs import NodePrior, PairRecord, Prior, ReferencePoint, Refinement, TrackErrors
from apertura.methods.autofocus.objective import Blocks, PatchEcho, PatchImage, Tracks
from apertura.methods.autofocus.patches import (
    LEAST_PATCHES,
    MOST_VALUES,
    Candidates,
    Patch,
    bandwidth_hz,
    count_in_memory,
    patch_at,
)
from apertura.methods.autofocus.solve import Gauge, Problem, State, effects, find_gauge, prominent_point_start
from apertura.methods.autofocus.speckle import SpeckleTiles, refined_by_speckle, tiles

# ---- Gauge fixed by points common to pairs and by reference points --------------------------------------------------


_LEAST_RATIO = 30.0  # peak power of a point over its surroundings, for a measured place
_LEAST_STD_M = 0.01  # of a point's place between pairs: bistatic scattering centres differ
_ZOOMS, _SIDE = 3, 9  # of the search for a point's place: rounds, samples along a side
_ROUNDS = 3  # of least squares in the gauge, linearised anew


@dataclass(frozen=True, eq=False)
class _MeasuredPlace:
    """A point's place in a pair's image, east and north (m), its deviation, and its shift by the gauge's modes."""

    place_m: Floats
    std_m: float
    shift_m: Floats


def fix_gauge(
    problem: Problem, unknowns: Floats, points: Sequence[ReferencePoint], axes: Floats
) -> tuple[Floats, dict[str, Any]]:
    """Return the unknowns with their gauge fixed by points, and a report.

    Parameters
    ----------
    problem, unknowns
        As solved.
    points
        Reference points.
    axes
        (3, 3) float64, rows are east, north, up.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 15: least squares in the gauge alone, with the log's prior. All pairs image
    one scene, so that a point has one place.
    """
    if not len(problem.gauge.modes) or not (points or len(problem.pairs) > 1):
        return unknowns, {}
    known = [_patch_of(problem, point, axes) for point in points]
    echoes = [blocks.echoes(known) if known else [] for blocks in problem.pairs]
    step: Floats = np.zeros(len(problem.gauge.modes))
    report: dict[str, Any] = {}
    for number in range(_ROUNDS):
        tracks = problem.prior.tracks(unknowns + step @ problem.gauge.modes)
        matrix, residuals = _pair_residuals(problem, tracks, axes)
        rows, errors_sigma, measured = _reference_residuals(problem, points, echoes, tracks, axes)
        if not number:
            report = {"pairs_apart_sigma": _rms(residuals)} | ({"reference_points": measured} if points else {})
        matrix, residuals = np.concatenate([matrix, rows]), np.concatenate([residuals, errors_sigma])
        normal = matrix.T @ matrix + np.eye(len(step))
        step = np.asarray(np.linalg.solve(normal, matrix.T @ (matrix @ step - residuals)), np.float64)
    return unknowns + step @ problem.gauge.modes, report


def pair_disagreement(problem: Problem, tracks: Tracks, axes: Floats) -> tuple[float, float]:
    """Return the residual of eq. 15 between pairs.

    Returns
    -------
    tuple
        Half of it, as an objective; and the rms of what pairs are still apart, in standard deviations.
    """
    matrix, residuals = _pair_residuals(problem, tracks, axes)
    step = np.linalg.solve(matrix.T @ matrix + np.eye(matrix.shape[1]), -matrix.T @ residuals)
    left = residuals + matrix @ step
    return 0.5 * float(step @ step + left @ left), _rms(left)


def _pair_residuals(problem: Problem, tracks: Tracks, axes: Floats) -> tuple[Floats, Floats]:
    """Return rows and misses, in standard deviations, of each pair's points against those of the first."""
    rows, residuals = [np.zeros((0, len(problem.gauge.modes)))], [np.zeros(0)]
    modes = problem.prior.tracks(problem.gauge.modes)
    for number in range(len(problem.patches)):
        statistics = [
            _measured_place(blocks, echoes[number], tracks, modes, axes)
            for blocks, echoes in zip(problem.pairs, problem.echoes, strict=True)
        ]
        first = statistics[0]
        for other in statistics[1:]:
            if first is not None and other is not None:
                std_m = float(np.hypot(first.std_m, other.std_m))
                rows.append((other.shift_m - first.shift_m) / std_m)
                residuals.append((other.place_m - first.place_m) / std_m)
    return np.concatenate(rows), np.concatenate(residuals)


def _reference_residuals(
    problem: Problem,
    points: Sequence[ReferencePoint],
    echoes: Sequence[Sequence[PatchEcho]],
    tracks: Tracks,
    axes: Floats,
) -> tuple[Floats, Floats, list[dict[str, Any]]]:
    """Return design rows and residuals of reference points, and their position errors as JSON values."""
    rows, residuals, report = [np.zeros((0, len(problem.gauge.modes)))], [np.zeros(0)], []
    modes = problem.prior.tracks(problem.gauge.modes)
    for blocks, of_pair in zip(problem.pairs, echoes, strict=True):
        for point, echo in zip(points, of_pair, strict=True):
            statistics = _measured_place(blocks, echo, tracks, modes, axes)
            if statistics is not None:
                apart_m = statistics.place_m - axes[:2] @ np.array(point.place_m)
                rows.append(statistics.shift_m / point.std_m)
                residuals.append(apart_m / point.std_m)
                rounded = [round(float(one), 4) for one in apart_m]
                report.append({"name": point.name, "pair": blocks.record.pair, "apart_m": rounded})
    return np.concatenate(rows), np.concatenate(residuals), report


def _measured_place(
    blocks: Blocks, echo: PatchEcho, tracks: Tracks, modes: Tracks, axes: Floats
) -> _MeasuredPlace | None:
    """Return the measured place of a patch's point in a pair's image; None where none is visible."""
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
    return _MeasuredPlace(axes[:2] @ place, std_m, shift_m)


def _patch_of(problem: Problem, point: ReferencePoint, axes: Floats) -> Patch:
    smooth = min(node.smooth for node in problem.prior.nodes.values())
    correlation_s = smooth * float(problem.knots_s[1] - problem.knots_s[0])
    records = [blocks.record for blocks in problem.pairs]
    return patch_at(np.array(point.place_m), records, axes, correlation_s=correlation_s)


def _cell_m(echo: PatchEcho) -> float:
    """Return the resolution c/2B, metres."""
    return SPEED_OF_LIGHT_M_S / bandwidth_hz(echo.profiles) / 2


def _rms(residuals: Floats) -> float:
    """Return the rms of how far pairs are apart, in standard deviations; 0 where there is nothing to compare."""
    return round(float(np.sqrt((residuals**2).sum() / max(residuals.size, 1))), 3)


# ---- Refinement of a flight's tracks --------------------------------------------------------------------------------


FOLDS = 4
"""Of cross-validation: a quarter of the patches is left out of the fit and decides on acceptance."""

_KNOTS_PER_CORRELATION_TIME = 10  # of corrections, by the shortest correlation time of an error
_LEAST_KNOTS = 64  # of a flight
_FEW = 8  # patches: with fewer, each quarter is left out of one fit
_LOST_TO_TIES_DB = 0.1  # contrast that fixing the gauge may cost
_STAGES = 3  # of caching contributions and sharpening


def refine(
    records: Sequence[PairRecord],
    grid: SceneGrid,
    terrain: Terrain,
    errors: Mapping[str, TrackErrors],
    *,
    reference_points: Sequence[ReferencePoint] = (),
) -> Refinement:
    """Return the corrections of a flight's tracks that make its images sharpest, and whether they are accepted.

    Parameters
    ----------
    records
        Of every pair.
    grid, terrain
        The scene.
    errors
        Node → error statistics of its log.
    reference_points
        Points of known place, which fix the image's position.

    Notes
    -----
    Source: docs/theory/autofocus.md. A rejected refinement keeps its corrections; images are formed without them.
    """
    search = TrackSearch.begin(records, grid, terrain, errors)
    if len(search.problem.patches) < LEAST_PATCHES:
        by_speckle = search.by_speckle(grid, terrain, errors)
        return (
            by_speckle
            if by_speckle is not None and by_speckle.accepted
            else search.candidates.rejected(errors, by_speckle)
        )
    state, evidence = search.solve()
    left = remaining(search.problem, state)
    unknowns, ties = search.fix_gauge(state, reference_points, apart_sigma=evidence.apart_sigma)
    report = {**evidence.report, **left.report, **ties, "patches": len(search.problem.patches)}
    correction = search.problem.correction(unknowns)
    return Refinement(correction, left.std_m, evidence.accepted, evidence.why, report, evidence.flags)


@dataclass(frozen=True, eq=False)
class TrackSearch:
    """The problem, and its initial state along the logs."""

    problem: Problem
    candidates: Candidates
    initial: State
    wavelength_m: float

    @classmethod
    def begin(
        cls, records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]
    ) -> "TrackSearch":
        """Return the search of a flight, started along its logs."""
        candidates = Candidates.of(records, grid, terrain, errors)
        knots_s = _knots(records, errors)
        prior = Prior({node: NodePrior.of(one, knots_s, candidates.axes) for node, one in sorted(errors.items())})
        pairs = [Blocks.of(record, knots_s) for record in records]
        echoes = [blocks.echoes(candidates.patches) for blocks in pairs]
        problem = Problem(pairs, echoes, knots_s, prior, Gauge.none(prior.size))
        values = [sum(one.values for one in of_pairs) for of_pairs in zip(*echoes, strict=True)]
        problem = problem.of(range(count_in_memory(values)))
        initial = problem.state(np.zeros(prior.size))
        if len(problem.patches) >= LEAST_PATCHES:
            problem = replace(problem, gauge=find_gauge(pairs, initial.cached, prior, knots_s, candidates.axes))
        wavelength_m = SPEED_OF_LIGHT_M_S / records[0].profiles.centre_frequency_hz
        return cls(problem, candidates, initial, wavelength_m)

    @property
    def axes(self) -> Floats:
        """(3, 3) float64, rows are east, north, up."""
        return self.candidates.axes

    def solve(self) -> tuple[State, Evidence]:
        """Return the tracks fitted to all patches, and the evidence of patches that were not fitted."""
        problem, initial = self.problem, self.initial
        held_out_db = np.full((len(problem.pairs), len(problem.patches)), np.nan)
        everything, fold = np.ones(len(problem.patches), bool), np.arange(len(problem.patches)) % FOLDS
        few = len(problem.patches) < _FEW
        states = [] if not few else [self._fitted(everything)]
        for number in range(FOLDS if few else 1):
            fitted = fold != (number + 2) % FOLDS
            states.append(self._fitted(fitted))
            held_out_db[:, ~fitted] = gains_db(initial.statistics, states[-1].statistics)[:, ~fitted]
        lowest = self._lowest(states, everything)
        state = problem.sharper(lowest, everything)
        apart_sigma = self._apart_sigma(state)
        if apart_sigma > MOST_APART_SIGMA:
            state, apart_sigma = lowest, self._apart_sigma(lowest)
        known = 2 * sum(min(one.ratio, MOST_RATIO) for statistics in state.statistics for one in statistics)
        evidence = Evidence(
            fitted_db=gains_db(initial.statistics, state.statistics),
            held_out_db=held_out_db[:, np.isfinite(held_out_db[0])],
            settled=problem.gauge.settled(state.unknowns, known=known),
            before=range_shifts(problem, initial, self.axes),
            after=range_shifts(problem, state, self.axes),
            wavelength_m=self.wavelength_m,
            apart_sigma=apart_sigma,
        )
        return state, evidence

    def fix_gauge(
        self, state: State, points: Sequence[ReferencePoint], *, apart_sigma: float
    ) -> tuple[Floats, dict[str, Any]]:
        """Return the unknowns with the gauge fixed by points, unless that blurs images or separates pairs."""
        unknowns, report = fix_gauge(self.problem, state.unknowns, points, self.axes)
        if unknowns is state.unknowns:
            return unknowns, report
        after = self.problem.state(unknowns)
        lost_db = -float(gains_db(state.statistics, after.statistics).mean())
        if self._apart_sigma(after) > max(apart_sigma, 1.0) or lost_db > _LOST_TO_TIES_DB:
            return state.unknowns, {**report, "ties": "left out: they blurred points or parted pairs"}
        return unknowns, report

    def _apart_sigma(self, state: State) -> float:
        """Return the distance of points between pairs, in standard deviations of their places."""
        return pair_disagreement(self.problem, state.tracks, self.axes)[1]

    def _fitted(self, used: Bools) -> State:
        """Return the tracks fitted to some patches, from the start with the lowest objective."""
        problem, initial = self.problem, self.initial
        starts = (initial, prominent_point_start(problem, initial, used, self.axes))
        best = self._lowest([problem.sharper(start, used) for start in starts], used)
        return problem.sharper(best, used, stages=_STAGES - 1)

    def _lowest(self, states: Sequence[State], used: Bools) -> State:
        """Return the state of lowest objective: sharp patches, at one place in all pairs."""
        problem = self.problem
        values = [
            problem.value(state, used, self.initial.statistics) + pair_disagreement(problem, state.tracks, self.axes)[0]
            for state in states
        ]
        return states[int(np.argmin(values))]

    def by_speckle(self, grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]) -> Refinement | None:
        """Return the refinement by speckle; None of one pair alone."""
        problem = self.problem
        if len(problem.pairs) < 2:
            return None
        correlation_s = min(one.correlation_s for one in errors.values())
        scene_tiles = tiles([blocks.record for blocks in problem.pairs], grid, terrain, correlation_s=correlation_s)
        pixels = sum(len(tile.patch.pixels_m) for tile in scene_tiles)
        every = 1 + pixels * len(problem.knots_s) * len(problem.pairs) // MOST_VALUES
        return refined_by_speckle(SpeckleTiles.of(problem.pairs, scene_tiles[::every]), problem.prior, problem.knots_s)


def _knots(records: Sequence[PairRecord], errors: Mapping[str, TrackErrors]) -> Floats:
    """Return equally spaced times: several to an error's correlation time, none closer than pulses."""
    first = min(float(one.time_s[0]) for one in records)
    last = max(float(one.time_s[-1]) for one in records)
    pulse_s = max(float(np.median(np.diff(one.time_s))) for one in records)
    correlation_s = min(one.correlation_s for one in errors.values())
    step_s = max(min(correlation_s / _KNOTS_PER_CORRELATION_TIME, (last - first) / _LEAST_KNOTS), pulse_s)
    count = max(2, int(np.ceil((last - first) / step_s)))
    return first + (np.arange(count) + 0.5) * (last - first) / count
