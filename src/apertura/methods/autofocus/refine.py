"""Tracks of a flight refined by the images of all its pairs, and by reference points of known place."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from apertura.common.arrays import Bools, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain
from apertura.methods.autofocus.cause_fit import LEAST_EVIDENCE, CauseFit, explained
from apertura.methods.autofocus.evidence import (
    FOLDS,
    MOST_RATIO,
    PARTS,
    Evidence,
    RangeShifts,
    gains_db,
    mean_gain,
    range_shifts,
    remaining,
    unsteady,
)
from apertura.methods.autofocus.ground_coherence import SpeckleTiles, refined_by_speckle, tiles
from apertura.methods.autofocus.inputs import NodePrior, PairRecord, Prior, ReferencePoint, Refinement, TrackErrors
from apertura.methods.autofocus.objective import Blocks, PatchEcho, PatchImage, Tracks
from apertura.methods.autofocus.patches import (
    MOST_VALUES,
    REFINED_LOOKS,
    Candidates,
    Patch,
    count_in_memory,
    patch_at,
)
from apertura.methods.autofocus.solve import (
    Gauge,
    Problem,
    State,
    effects,
    effects_of_paths,
    find_gauge,
    prominent_point_start,
    unslipped_start,
)
from apertura.methods.causes import Cause

# ---- Gauge fixed by points common to pairs and by reference points --------------------------------------------------


_LEAST_RATIO = 30.0  # peak power of a point over its surroundings, for a measured place
_LEAST_STD_M = 0.01  # of a point's place between pairs: bistatic scattering centres differ
_ZOOMS, _SIDE = 3, 9  # of the search for a point's place: rounds, samples along a side
_MEDIAN_OF_TWO = 2 * np.log(2)  # of the sum of two squared standard normal values
_ROUNDS = 3  # of least squares in the gauge, linearised anew


@dataclass(frozen=True, eq=False)
class _MeasuredPlace:
    """A point's place in a pair's image, east and north (m), its deviation, and its shift.

    By the gauge's modes (2, mode), and per metre by which all paths are longer (2, 1).
    """

    place_m: Floats
    std_m: float
    shift_m: Floats
    longer: Floats


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
    modes = len(problem.gauge.modes)
    step: Floats = np.zeros(modes + len(problem.pairs) - 1)
    report: dict[str, Any] = {}
    for number in range(_ROUNDS):
        # S/σ and d/σ of eq. 15 about the tracks of the round: between pairs, and against reference points.
        tracks = problem.prior.tracks(unknowns + step[:modes] @ problem.gauge.modes)
        matrix, residuals = _pair_residuals(problem, tracks, axes)
        reference_rows, reference_residuals, position_errors = _reference_residuals(
            problem, points, echoes, tracks, axes
        )
        if not number:
            report = {"pairs_apart_sigma": _apart(residuals)} | (
                {"reference_points": position_errors} if points else {}
            )
        matrix = np.concatenate([matrix, reference_rows])
        residuals = np.concatenate([residuals, reference_residuals])
        # Normal equations of eq. 15, with the prior |y|². `residuals` already hold the shift by the modes so far, which
        # is added back; path lengths are no part of the tracks, so what they explain is still in the residuals.
        normal = matrix.T @ matrix + np.eye(len(step))
        target = matrix[:, :modes] @ step[:modes] - residuals
        step = np.asarray(np.linalg.solve(normal, matrix.T @ target), np.float64)
    std = np.sqrt(np.diag(np.linalg.inv(normal)))
    report["paths_longer_m"] = {
        blocks.record.pair: [round(float(PATH_STD_M * one[modes + number]), 4) for one in (step, std)]
        for number, blocks in enumerate(problem.pairs[1:])
    }
    return unknowns + step[:modes] @ problem.gauge.modes, report


def path_std_m(problem: Problem) -> dict[str, float]:
    """Return the deviation of the mean path of each pair but the first from the first's by errors of the logs.

    Standard deviations at the first patch, metres, over draws from the prior.
    """
    draws = problem.prior.tracks(np.random.default_rng(0).standard_normal((_DRAWS, problem.prior.size)))
    paths = []
    for blocks, echoes in zip(problem.pairs, problem.echoes, strict=True):
        moved = blocks.moves(problem.prior.tracks(np.zeros(problem.prior.size)))
        patch = blocks.contribution(echoes[0], moved)
        averaged = {node: blocks.average_of(draws[node])[:, patch.blocks] for node in patch.slopes}
        path = sum(np.einsum("bi,mbi->m", slope, averaged[node]) for node, slope in patch.slopes.items())
        paths.append(np.asarray(path) / max(1, patch.values.shape[1]))
    return {
        blocks.record.pair: float((path - paths[0]).std())
        for blocks, path in zip(problem.pairs[1:], paths[1:], strict=True)
    }


def pair_disagreement(problem: Problem, tracks: Tracks, axes: Floats) -> tuple[float, float]:
    """Return the residual of eq. 15 between pairs.

    Returns
    -------
    tuple
        Half of it, as an objective; and how far pairs are still apart, in standard deviations.
    """
    matrix, residuals = _pair_residuals(problem, tracks, axes)
    step = np.linalg.solve(matrix.T @ matrix + np.eye(matrix.shape[1]), -matrix.T @ residuals)
    left = residuals + matrix @ step
    return 0.5 * float(step @ step + left @ left), _apart(left)


def _pair_residuals(problem: Problem, tracks: Tracks, axes: Floats) -> tuple[Floats, Floats]:
    """Return rows and misses, in standard deviations, of each pair's points against those of the first.

    Rows have a column for each mode of the gauge, and one for the paths of each pair but the first.
    """
    rows, residuals = [np.zeros((0, len(problem.gauge.modes) + len(problem.pairs) - 1))], [np.zeros(0)]
    modes = problem.prior.tracks(problem.gauge.modes)
    for number in range(len(problem.patches)):
        places = [
            _measured_place(blocks, echoes[number], tracks, modes, axes)
            for blocks, echoes in zip(problem.pairs, problem.echoes, strict=True)
        ]
        first = places[0]
        for at, other in enumerate(places[1:], 1):
            if first is not None and other is not None:
                std_m = float(np.hypot(first.std_m, other.std_m))
                rows.append(np.hstack([other.shift_m - first.shift_m, _of_pair(other, at, problem)]) / std_m)
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
    rows, residuals, report = [np.zeros((0, len(problem.gauge.modes) + len(problem.pairs) - 1))], [np.zeros(0)], []
    modes = problem.prior.tracks(problem.gauge.modes)
    for at, (blocks, of_pair) in enumerate(zip(problem.pairs, echoes, strict=True)):
        for point, echo in zip(points, of_pair, strict=True):
            place = _measured_place(blocks, echo, tracks, modes, axes)
            if place is not None:
                error_m = place.place_m - axes[:2] @ np.array(point.place_m)
                rows.append(np.hstack([place.shift_m, _of_pair(place, at, problem)]) / point.std_m)
                residuals.append(error_m / point.std_m)
                rounded = [round(float(one), 4) for one in error_m]
                report.append({"name": point.name, "pair": blocks.record.pair, "apart_m": rounded})
    return np.concatenate(rows), np.concatenate(residuals), report


def _of_pair(place: _MeasuredPlace, number: int, problem: Problem) -> Floats:
    """Return the shift of a place per deviation of the paths of each pair but the first, (2, pair)."""
    columns = np.zeros((2, len(problem.pairs) - 1))
    if number:
        columns[:, number - 1] = PATH_STD_M * place.longer[:, 0]
    return columns


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
    # Shift of the point per unit of each mode, S of eq. 14, and per metre of path that is common to all pulses.
    modes_of = {node: blocks.average_of(modes[node]) for node in moved}
    _, shift_m = effects(patch, modes_of, axes)
    _, longer = effects_of_paths(patch, np.ones((patch.values.shape[1], 1)), axes)
    # Maximum of the image about the brightest pixel, on ever finer lattices.
    place, reach_m = echo.patch.pixels_m[int(np.abs(image).argmax())], _cell_m(echo) / 4
    for _ in range(_ZOOMS):
        side = np.linspace(-reach_m, reach_m, _SIDE)
        east, north = np.meshgrid(side, side)
        pixels = place + np.stack([east.ravel(), north.ravel()], axis=1) @ axes[:2]
        near = replace(echo, patch=Patch(echo.patch.place_m, pixels))
        place = pixels[int(np.abs(blocks.contribution(near, moved).values.sum(axis=1)).argmax())]
        reach_m *= 2 / (_SIDE - 1)
    std_m = float(np.hypot(_LEAST_STD_M, _cell_m(echo) / (np.pi * np.sqrt(ratio))))
    return _MeasuredPlace(axes[:2] @ place, std_m, shift_m, longer)


def _patch_of(problem: Problem, point: ReferencePoint, axes: Floats) -> Patch:
    smooth = min(node.smooth for node in problem.prior.nodes.values())
    correlation_s = smooth * float(problem.knots_s[1] - problem.knots_s[0])
    records = [blocks.record for blocks in problem.pairs]
    return patch_at(np.array(point.place_m), records, axes, correlation_s=correlation_s)


def _cell_m(echo: PatchEcho) -> float:
    """Return the resolution c/2B, metres."""
    return SPEED_OF_LIGHT_M_S / echo.profiles.bandwidth_hz / 2


def _apart(residuals: Floats) -> float:
    """Return the distance of pairs, in standard deviations, from two residuals a point; 0 where there is none.

    By the median over points: two neighbours in a patch, of which either pair shows another, are one point.
    """
    if not residuals.size:
        return 0.0
    squared = (residuals.reshape(-1, 2) ** 2).sum(axis=1)
    return round(float(np.sqrt(np.median(squared) / _MEDIAN_OF_TWO)), 3)


# ---- Refinement of a flight's tracks --------------------------------------------------------------------------------


PATH_STD_M = 0.1
"""Metres of path by which one pair may differ from another for other reasons than tracks: offsets wrong by fractions of
a wavelength must not bend tracks, and of ties between pairs along range little is lost."""

PATH_SIGMAS = 3.0
"""Standard deviations beyond which a difference of paths between pairs is none of the tracks."""

_DRAWS = 200  # of the prior, from which the deviation of a mean path is taken

_KNOTS_PER_CORRELATION_TIME = 10  # of corrections, by the shortest correlation time of an error
_LEAST_KNOTS = 64  # of a flight
_FEW = 8  # patches: with fewer, each quarter is left out of one fit
_LOST_TO_TIES_DB = 0.1  # contrast that fixing the gauge may cost
_SLIPS = 3  # searches from delays where parts of the tracks are a wavelength off
_STAGES = 3  # of caching contributions and sharpening

MOST_ROUNDS = 4
"""Of searching the refined image for bright places, which errors may have hidden, and refining with them all."""

LEAST_FURTHER_DB = 0.05
"""Contrast that places which were not fitted must gain on the round before, for another round."""

_BETWEEN_KNOTS_RAD2 = 0.05
"""Variance of the phase that errors make between knots: 0.2 dB."""

_MOST_KNOTS_PER_CORRELATION_TIME = 32  # which 4 cm at L-band want; what errors beyond leave is said in the budget


def refine(
    records: Sequence[PairRecord],
    grid: SceneGrid,
    terrain: Terrain,
    errors: Mapping[str, TrackErrors],
    *,
    reference_points: Sequence[ReferencePoint] = (),
    causes: Sequence[Cause] = (),
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
    causes
        Constants of the config that may be wrong, tried where errors of the logs alone do not explain the images.

    Notes
    -----
    Source: docs/theory/autofocus.md. A rejected refinement keeps its corrections; images are formed without them.
    """
    plain = _Model.of(records, grid, terrain, errors)
    found = plain.refinement(errors, reference_points)
    cause = plain.search.cause(grid, terrain, errors, causes)
    if cause is None:
        return found
    other = _Model.of([one.corrected(cause.correction) for one in records], grid, terrain, errors)
    rest = other.refinement(errors, reference_points)
    evidence = other.evidence_against(plain, cause)
    return found if evidence < LEAST_EVIDENCE else cause.with_rest(rest, evidence)


@dataclass(frozen=True, eq=False)
class _Model:
    """Errors of the logs as the only ones, or beside a cause: the search, and where it ended."""

    search: "TrackSearch"
    best: "Round | None"
    by_speckle: Refinement | None

    @classmethod
    def of(
        cls, records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]
    ) -> "_Model":
        search = TrackSearch.begin(records, grid, terrain, errors)
        best = search.rounds(grid, terrain, errors) if search.problem.patches else None
        # Speckle is tried where few bright places give no accepted tracks.
        if best is not None and (best.evidence.accepted or len(best.search.problem.patches) >= _FEW):
            return cls(search, best, None)
        return cls(search, best, search.by_speckle(grid, terrain, errors))

    def refinement(self, errors: Mapping[str, TrackErrors], points: Sequence[ReferencePoint]) -> Refinement:
        """Return the refinement of the tracks, accepted or not."""
        if self.by_speckle is not None and self.by_speckle.accepted:
            return self.by_speckle
        if self.best is None:
            return self.search.candidates.rejected(errors, self.by_speckle)
        search, state, evidence = self.best.search, self.best.state, self.best.evidence
        left = remaining(search.problem, state)
        unknowns, ties = search.fix_gauge(state, points, apart_sigma=evidence.apart_sigma)
        found = {"patches": len(search.problem.patches), "rounds": self.best.number}
        turn = 2 * np.pi / search.wavelength_m
        phases = {pair: round(turn * std_m, 4) for pair, std_m in path_std_m(search.problem).items()}
        report = {**evidence.report, **left.report, **ties, **found, "pair_phase_std_rad": phases}
        correction = search.problem.correction(unknowns)
        flags = dict(evidence.flags)
        longer = ties.get("paths_longer_m", {}) if evidence.accepted else {}
        differing = [one for one, (longer_m, std_m) in longer.items() if abs(longer_m) > PATH_SIGMAS * std_m]
        if differing:
            lines = (f"{one} by {100 * longer[one][0]:+.1f} ± {100 * longer[one][1]:.1f} cm" for one in differing)
            flags["path_offsets_differ"] = f"against {search.problem.pairs[0].record.pair}: {', '.join(lines)}"
        return Refinement(correction, left.std_m, evidence.accepted, evidence.why, report, flags)

    def evidence_against(self, plain: "_Model", cause: CauseFit) -> float:
        """Return the objective of the logs' errors alone less that of these beside a cause.

        Notes
        -----
        Source: docs/theory/autofocus.md, eq. 16b: over the places that either model sees; what is sharp along the logs
        must not be given up for others.
        """
        if self.best is None or plain.best is None:
            return -np.inf
        # Tracks of both models over the places of either search: with the cause, and without.
        moved = cause.correction.moved_m
        rest, alone = self.best.state.tracks, plain.best.state.tracks
        both = {node: moved[node] + track for node, track in rest.items()}
        less = {node: track - moved[node] for node, track in alone.items()}
        still = {node: np.zeros_like(track) for node, track in alone.items()}
        if plain.search.blur(both) > plain.search.blur(still):
            return -np.inf
        searches = ((plain.best.search, alone, both), (self.best.search, less, rest))
        sharper = sum(search.blur(one) - search.blur(other) for search, one, other in searches)
        unknowns = plain.best.state.unknowns, self.best.state.unknowns
        energy = 0.5 * (float(unknowns[0] @ unknowns[0]) - float(unknowns[1] @ unknowns[1]))
        return sharper + energy - cause.energy


@dataclass(frozen=True, eq=False)
class Round:
    """Tracks fitted to the bright places that were visible from the tracks of the round before.

    Attributes
    ----------
    search
        The problem of these places.
    state, evidence
        Tracks fitted to all of them; what those show that were not fitted.
    further_db
        Contrast that places gained, while they were not fitted, on the tracks of the round before; 0 in the first.
    number
        Of rounds so far.
    """

    search: "TrackSearch"
    state: State
    evidence: Evidence
    further_db: float
    number: int = 1


@dataclass(frozen=True, eq=False)
class TrackSearch:
    """The problem, its state along the logs, and that of the round before.

    Attributes
    ----------
    problem
        Pairs, patches, prior.
    candidates
        Bright places.
    initial
        The patches imaged along the logs.
    before
        The same along the tracks of the round before; None in the first.
    wavelength_m
        Of the band's middle.
    """

    problem: Problem
    candidates: Candidates
    initial: State
    before: State | None
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
        wavelength_m = SPEED_OF_LIGHT_M_S / records[0].profiles.centre_frequency_hz
        return cls._over(Problem(pairs, [], knots_s, prior, Gauge.none(prior.size)), candidates, None, wavelength_m)

    @classmethod
    def _over(
        cls, problem: Problem, candidates: Candidates, unknowns: Floats | None, wavelength_m: float
    ) -> "TrackSearch":
        """Return the search over some patches; `unknowns` of the round before."""
        pairs, prior = problem.pairs, problem.prior
        echoes = [blocks.echoes(candidates.patches) for blocks in pairs]
        values = [sum(one.values for one in of_pairs) for of_pairs in zip(*echoes, strict=True)]
        problem = replace(problem, echoes=echoes).of(range(count_in_memory(values)))
        initial = problem.state(np.zeros(prior.size))
        before = None if unknowns is None else problem.state(unknowns)
        if problem.patches:
            gauge = find_gauge(pairs, (before or initial).cached, prior, problem.knots_s, candidates.axes)
            problem = replace(problem, gauge=gauge)
        return cls(problem, candidates, initial, before, wavelength_m)

    def again(
        self, state: State, grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]
    ) -> "TrackSearch | None":
        """Return the search over the places that are bright in the image of refined tracks; None where none is."""
        correction = self.problem.correction(state.unknowns)
        refined = [blocks.record.corrected(correction) for blocks in self.problem.pairs]
        candidates = Candidates.of(refined, grid, terrain, errors, looks=REFINED_LOOKS)
        if not candidates.patches or self._known(candidates):
            return None
        return self._over(self.problem, candidates, state.unknowns, self.wavelength_m)

    def rounds(self, grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]) -> Round:
        """Return the last round that was worth it."""
        best = self.solve()
        # Tracks that sharpen nothing leave the image as it is: looking for places in it again would find the same ones.
        while best.number < MOST_ROUNDS and mean_gain(best.evidence.fitted_db).mean_db >= LEAST_FURTHER_DB:
            search = best.search.again(best.state, grid, terrain, errors)
            if search is None:
                break
            found = replace(search.solve(), number=best.number + 1)
            if found.further_db < -LEAST_FURTHER_DB:
                break
            best = found
            if found.further_db < LEAST_FURTHER_DB:
                break
        return best

    def _known(self, candidates: Candidates) -> bool:
        """Test whether some bright places are those of this round: each in a patch of its own."""
        patches = self.problem.patches
        if len(patches) != len(candidates.patches):
            return False
        apart_m = np.linalg.norm(
            np.array([one.place_m for one in candidates.patches])[:, None] - np.array([one.place_m for one in patches]),
            axis=2,
        )
        half_m = [float(np.linalg.norm(one.pixels_m - one.place_m, axis=1).max()) / 2 for one in patches]
        nearest = apart_m.argmin(axis=1)
        return len({*nearest.tolist()}) == len(patches) and bool(
            (apart_m.min(axis=1) < np.array(half_m)[nearest]).all()
        )

    @property
    def axes(self) -> Floats:
        """(3, 3) float64, rows are east, north, up."""
        return self.candidates.axes

    def solve(self) -> Round:
        """Return the tracks fitted to all patches, and the evidence of patches that were not fitted."""
        problem, initial = self.problem, self.initial
        held_out_db = np.full((len(problem.pairs), len(problem.patches)), np.nan)
        further_db = np.full_like(held_out_db, np.nan)
        everything, fold = np.ones(len(problem.patches), bool), np.arange(len(problem.patches)) % FOLDS
        few = len(problem.patches) < _FEW
        lowest = self.before if len(problem.patches) > 1 else self._fitted(everything)
        # Each quarter of the patches is left out of a fit, in turn (eq. 16a); the fit of lowest objective is kept.
        for number in range(min(FOLDS, len(problem.patches)) if len(problem.patches) > 1 else 0):
            fitted = fold != (number + 2) % min(FOLDS, len(problem.patches))
            state = self._fitted(fitted)
            held_out_db[:, ~fitted] = gains_db(initial.statistics, state.statistics)[:, ~fitted]
            if self.before is not None:
                further_db[:, ~fitted] = gains_db(self.before.statistics, state.statistics)[:, ~fitted]
            lowest = self._lowest([state] if lowest is None else [lowest, state], everything)
            if not few and mean_gain(held_out_db[:, np.isfinite(held_out_db[0])]).certain:
                break
        # All patches, from the best of these fits; parts a wavelength off are searched again (eq. 16).
        assert lowest is not None  # one place is fitted, of more some are
        state = problem.sharper(lowest, everything, stages=_STAGES - 1 if few else 1)
        state, shifts = self._unslipped(state, everything)
        apart_sigma = self._apart_sigma(state)
        information = 2 * sum(min(image.ratio, MOST_RATIO) for images in state.statistics for image in images)
        evidence = Evidence(
            fitted_db=gains_db(initial.statistics, state.statistics),
            held_out_db=held_out_db[:, np.isfinite(held_out_db[0])],
            settled=problem.gauge.settled(state.unknowns, information=information),
            before=range_shifts(problem, initial, self.axes),
            after=shifts,
            wavelength_m=self.wavelength_m,
            steady=unsteady(initial, state),
            apart_sigma=apart_sigma,
        )
        measured = np.isfinite(further_db)
        return Round(self, state, evidence, float(further_db[measured].mean()) if measured.any() else 0.0)

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

    def _unslipped(self, state: State, used: Bools) -> tuple[State, RangeShifts]:
        """Return the tracks, searched again from where delays put them while parts are a wavelength off, and shifts."""
        problem = self.problem
        shifts = range_shifts(problem, state, self.axes)
        for _ in range(_SLIPS):
            wrong = int(shifts.slipped(self.wavelength_m).sum())
            if not wrong:
                break
            finer = range_shifts(problem, state, self.axes, parts=2 * PARTS)
            other = problem.sharper(unslipped_start(problem, state, finer.by_point_m), used, stages=_STAGES - 1)
            after = range_shifts(problem, other, self.axes)
            if int(after.slipped(self.wavelength_m).sum()) >= wrong:
                break
            state, shifts = other, after
        return state, shifts

    def _lowest(self, states: Sequence[State], used: Bools) -> State:
        """Return the state of lowest objective: sharp patches, at one place in all pairs."""
        problem = self.problem
        values = [
            problem.value(state, used, (self.before or self.initial).statistics)
            + pair_disagreement(problem, state.tracks, self.axes)[0]
            for state in states
        ]
        return states[int(np.argmin(values))]

    def cause(
        self, grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors], causes: Sequence[Cause]
    ) -> CauseFit | None:
        """Return the cause that explains most of what a flight lost, its size found in rounds as places come out."""
        if not causes or not self.problem.patches:
            return None
        found = explained(self.problem, causes, self.axes, np.random.default_rng(0))
        if found is None:
            return None
        for _ in range(MOST_ROUNDS - 1):
            moved = [blocks.record.corrected(found.correction) for blocks in self.problem.pairs]
            again = TrackSearch.begin(moved, grid, terrain, errors)
            improved = found.more(again.problem, again.axes) if again.problem.patches else found
            if improved.gain_db - found.gain_db < LEAST_FURTHER_DB:
                break
            found = improved
        return found

    def blur(self, tracks: Tracks) -> float:
        """Return the objective of some tracks without their prior, as seen at the places of this search."""
        value = self.problem.value(
            self.problem.at(tracks), np.ones(len(self.problem.patches), bool), self.initial.statistics
        )
        return value + pair_disagreement(self.problem, tracks, self.axes)[0]

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
    of_pairs = [one.turned(errors) for one in records]
    correlation_s, turned = min(lasts for lasts, _ in of_pairs), max(turned for _, turned in of_pairs)
    # White noise averaged over τ bends between knots Δ apart by σ²Δ/3τ.
    lasts = float(
        np.clip(
            3 * _BETWEEN_KNOTS_RAD2 / max(turned**2, 1e-12),
            1 / _MOST_KNOTS_PER_CORRELATION_TIME,
            1 / _KNOTS_PER_CORRELATION_TIME,
        )
    )
    step_s = max(min(correlation_s * lasts, (last - first) / _LEAST_KNOTS), pulse_s)
    count = max(2, int(np.ceil((last - first) / step_s)))
    return first + (np.arange(count) + 0.5) * (last - first) / count
