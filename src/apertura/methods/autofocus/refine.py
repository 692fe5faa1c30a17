"""Refinement of the tracks of a flight from the images of all its pairs and from reference points."""

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


_LEAST_RATIO = 30.0  # minimum peak-to-background power ratio of a point for a position measurement
_LEAST_STD_M = 0.01  # minimum std of positions between pairs, as bistatic scattering centres differ
_ZOOMS, _SIDE = 3, 9  # search for the position of a point: rounds, samples along a side
_MEDIAN_OF_TWO = 2 * np.log(2)  # median of the sum of two squared standard normal values
_ROUNDS = 3  # least-squares iterations in the gauge, each with a new linearisation


@dataclass(frozen=True, eq=False)
class _MeasuredPosition:
    """Position of a point in the image of a pair, east and north (m), its standard deviation, and its shifts.

    `shift_m` (2, mode) is the shift per unit of the gauge modes, `longer` (2, 1) the shift per metre of common path.
    """

    place_m: Floats
    std_m: float
    shift_m: Floats
    longer: Floats


def fix_gauge(
    problem: Problem, unknowns: Floats, points: Sequence[ReferencePoint], axes: Floats
) -> tuple[Floats, dict[str, Any]]:
    """Fix the gauge of the unknowns by points common to pairs and by reference points; return unknowns and report.

    Parameters
    ----------
    problem, unknowns
        Solved problem and its unknowns.
    points
        Reference points.
    axes
        (3, 3) float64, rows are east, north, up.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 15: least squares in the gauge alone, with the prior of the logs. A point has
    the same position in the images of all pairs.
    """
    if not len(problem.gauge.modes) or not (points or len(problem.pairs) > 1):
        return unknowns, {}
    known = [_patch_of(problem, point, axes) for point in points]
    echoes = [blocks.echoes(known) if known else [] for blocks in problem.pairs]
    modes = len(problem.gauge.modes)
    step: Floats = np.zeros(modes + len(problem.pairs) - 1)
    report: dict[str, Any] = {}
    for number in range(_ROUNDS):
        # S/σ and d/σ of eq. 15 at the tracks of the iteration: between pairs, and relative to reference points.
        tracks = problem.prior.tracks(unknowns + step[:modes] @ problem.gauge.modes)
        matrix, residuals = _pair_residuals(problem, tracks, axes)
        reference_rows, reference_residuals, position_errors = _reference_residuals(
            problem, points, echoes, tracks, axes
        )
        if not number:
            report = {"pairs_apart_sigma": _distance_sigma(residuals)} | (
                {"reference_points": position_errors} if points else {}
            )
        matrix = np.concatenate([matrix, reference_rows])
        residuals = np.concatenate([residuals, reference_residuals])
        # Normal equations of eq. 15, with the prior |y|². The shift due to previous iterations is added back
        # to `residuals`; because path offsets are not part of the tracks, the residuals still contain the effect of
        # path offsets.
        normal = matrix.T @ matrix + np.eye(len(step))
        target = matrix[:, :modes] @ step[:modes] - residuals
        step = np.asarray(np.linalg.solve(normal, matrix.T @ target), np.float64)
    std = np.sqrt(np.diag(np.linalg.inv(normal)))
    report["paths_longer_m"] = {
        blocks.record.pair: [round(float(PATH_STD_M * values[modes + number]), 4) for values in (step, std)]
        for number, blocks in enumerate(problem.pairs[1:])
    }
    return unknowns + step[:modes] @ problem.gauge.modes, report


def path_std_m(problem: Problem) -> dict[str, float]:
    """Return the standard deviation, due to log errors, of each pair's mean path relative to that of the first pair.

    The result is pair → metres at the first patch, estimated from random draws of the prior.
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
    """Return the residual disagreement between pairs (eq. 15).

    Returns
    -------
    tuple
        Half the residual of eq. 15, as an objective; and the residual distance of points between pairs in standard
        deviations.
    """
    matrix, residuals = _pair_residuals(problem, tracks, axes)
    step = np.linalg.solve(matrix.T @ matrix + np.eye(matrix.shape[1]), -matrix.T @ residuals)
    remaining_residuals = residuals + matrix @ step
    return 0.5 * float(step @ step + remaining_residuals @ remaining_residuals), _distance_sigma(remaining_residuals)


def _pair_residuals(problem: Problem, tracks: Tracks, axes: Floats) -> tuple[Floats, Floats]:
    """Return design rows and residuals, in standard deviations, of each pair's points relative to the first pair.

    Rows have a column for each mode of the gauge, and a column for the path offset of each pair except the first.
    """
    rows, residuals = [np.zeros((0, len(problem.gauge.modes) + len(problem.pairs) - 1))], [np.zeros(0)]
    modes = problem.prior.tracks(problem.gauge.modes)
    for number in range(len(problem.patches)):
        positions = [
            _measured_position(blocks, echoes[number], tracks, modes, axes)
            for blocks, echoes in zip(problem.pairs, problem.echoes, strict=True)
        ]
        first = positions[0]
        for at, other in enumerate(positions[1:], 1):
            if first is not None and other is not None:
                std_m = float(np.hypot(first.std_m, other.std_m))
                rows.append(np.hstack([other.shift_m - first.shift_m, _path_columns(other, at, problem)]) / std_m)
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
            position = _measured_position(blocks, echo, tracks, modes, axes)
            if position is not None:
                error_m = position.place_m - axes[:2] @ np.array(point.place_m)
                rows.append(np.hstack([position.shift_m, _path_columns(position, at, problem)]) / point.std_m)
                residuals.append(error_m / point.std_m)
                rounded = [round(float(value), 4) for value in error_m]
                report.append({"name": point.name, "pair": blocks.record.pair, "apart_m": rounded})
    return np.concatenate(rows), np.concatenate(residuals), report


def _path_columns(position: _MeasuredPosition, number: int, problem: Problem) -> Floats:
    """Return (2, pair), shift of a position per standard deviation of the path offset of each pair except the first."""
    columns = np.zeros((2, len(problem.pairs) - 1))
    if number:
        columns[:, number - 1] = PATH_STD_M * position.longer[:, 0]
    return columns


def _measured_position(
    blocks: Blocks, echo: PatchEcho, tracks: Tracks, modes: Tracks, axes: Floats
) -> _MeasuredPosition | None:
    """Measure the position of a patch's point in the image of a pair; None if no point is visible."""
    moved = blocks.moves(tracks)
    patch = blocks.contribution(echo, moved)
    image = patch.values.sum(axis=1)
    ratio = PatchImage.of(image).ratio
    if ratio < _LEAST_RATIO:
        return None
    # Shift of the point per unit of each mode, S of eq. 14, and per metre of path offset common to all pulses.
    modes_of = {node: blocks.average_of(modes[node]) for node in moved}
    _, shift_m = effects(patch, modes_of, axes)
    _, longer = effects_of_paths(patch, np.ones((patch.values.shape[1], 1)), axes)
    # Maximum of the image about the brightest pixel, on successively finer lattices.
    position_m, reach_m = echo.patch.pixels_m[int(np.abs(image).argmax())], _cell_m(echo) / 4
    for _ in range(_ZOOMS):
        side = np.linspace(-reach_m, reach_m, _SIDE)
        east, north = np.meshgrid(side, side)
        pixels = position_m + np.stack([east.ravel(), north.ravel()], axis=1) @ axes[:2]
        near = replace(echo, patch=Patch(echo.patch.place_m, pixels))
        position_m = pixels[int(np.abs(blocks.contribution(near, moved).values.sum(axis=1)).argmax())]
        reach_m *= 2 / (_SIDE - 1)
    std_m = float(np.hypot(_LEAST_STD_M, _cell_m(echo) / (np.pi * np.sqrt(ratio))))
    return _MeasuredPosition(axes[:2] @ position_m, std_m, shift_m, longer)


def _patch_of(problem: Problem, point: ReferencePoint, axes: Floats) -> Patch:
    smooth = min(node.smooth for node in problem.prior.nodes.values())
    correlation_s = smooth * float(problem.knots_s[1] - problem.knots_s[0])
    records = [blocks.record for blocks in problem.pairs]
    return patch_at(np.array(point.place_m), records, axes, correlation_s=correlation_s)


def _cell_m(echo: PatchEcho) -> float:
    """Return the resolution c/2B, metres."""
    return SPEED_OF_LIGHT_M_S / echo.profiles.bandwidth_hz / 2


def _distance_sigma(residuals: Floats) -> float:
    """Return the distance of points between pairs, in standard deviations; 0 without points.

    `residuals` contains two values per point. The median is robust against patches in which pairs measure different
    points of two neighbours.
    """
    if not residuals.size:
        return 0.0
    squared = (residuals.reshape(-1, 2) ** 2).sum(axis=1)
    return round(float(np.sqrt(np.median(squared) / _MEDIAN_OF_TWO)), 3)


# ---- Refinement of a flight's tracks --------------------------------------------------------------------------------


PATH_STD_M = 0.1
"""Prior standard deviation of path offsets between pairs due to causes other than the tracks, metres. The prior
prevents errors of path offsets of fractions of a wavelength from bending tracks, and hardly weakens the range
constraints between pairs.
"""

PATH_SIGMAS = 3.0
"""Number of standard deviations above which a path difference between pairs is not attributed to the tracks."""

_DRAWS = 200  # random draws of the prior for the standard deviation of a mean path

_KNOTS_PER_CORRELATION_TIME = 10  # minimum number of knots of corrections within the shortest correlation time
_LEAST_KNOTS = 64  # minimum number of knots of a flight
_FEW = 8  # number of patches; with fewer, every quarter of the patches is held out in turn
_LOST_TO_TIES_DB = 0.1  # largest loss of contrast due to fixing the gauge
_SLIPS = 3  # maximum number of searches from delays while subapertures have cycle slips
_STAGES = 3  # iterations of caching contributions and maximising sharpness

MOST_ROUNDS = 4
"""Maximum number of rounds. Each round detects bright points in the refined image, including points that errors have
hidden so far, and refines the tracks with all these points.
"""

LEAST_FURTHER_DB = 0.05
"""Minimum contrast gain of held-out patches over the previous round for another round, dB."""

_BETWEEN_KNOTS_RAD2 = 0.05
"""Phase variance due to errors between knots, which causes a loss of 0.2 dB."""

_MOST_KNOTS_PER_CORRELATION_TIME = (
    32  # sufficient for 4 cm at L-band; the error budget contains the residual of larger errors
)


def refine(
    records: Sequence[PairRecord],
    grid: SceneGrid,
    terrain: Terrain,
    errors: Mapping[str, TrackErrors],
    *,
    reference_points: Sequence[ReferencePoint] = (),
    causes: Sequence[Cause] = (),
) -> Refinement:
    """Estimate the corrections of a flight's tracks that maximise the sharpness of its images, and validate them.

    Parameters
    ----------
    records
        Records of all pairs.
    grid, terrain
        The scene.
    errors
        Node → error statistics of its log.
    reference_points
        Points of known position, which determine the position of the image.
    causes
        Possible errors of configured constants, tried if errors of the logs alone do not explain the images.

    Notes
    -----
    Source: docs/theory/autofocus.md. A rejected refinement contains its corrections, but images are formed without
    them.
    """
    logs_only = _Model.of(records, grid, terrain, errors)
    result = logs_only.refinement(errors, reference_points)
    cause = logs_only.search.cause(grid, terrain, errors, causes)
    if cause is None:
        return result
    with_cause = _Model.of([record.corrected(cause.correction) for record in records], grid, terrain, errors)
    rest = with_cause.refinement(errors, reference_points)
    evidence = with_cause.evidence_against(logs_only, cause)
    return result if evidence < LEAST_EVIDENCE else cause.with_rest(rest, evidence)


@dataclass(frozen=True, eq=False)
class _Model:
    """Search and results for an error model: errors of the logs alone or together with a cause."""

    search: "TrackSearch"
    best: "Round | None"
    by_speckle: Refinement | None

    @classmethod
    def of(
        cls, records: Sequence[PairRecord], grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]
    ) -> "_Model":
        search = TrackSearch.begin(records, grid, terrain, errors)
        best = search.rounds(grid, terrain, errors) if search.problem.patches else None
        # Refinement by speckle is tried if the tracks from few bright points are not accepted.
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
        residual = remaining(search.problem, state)
        unknowns, ties = search.fix_gauge(state, points, apart_sigma=evidence.apart_sigma)
        counts = {"patches": len(search.problem.patches), "rounds": self.best.number}
        wavenumber = 2 * np.pi / search.wavelength_m
        phases = {pair: round(wavenumber * std_m, 4) for pair, std_m in path_std_m(search.problem).items()}
        report = {**evidence.report, **residual.report, **ties, **counts, "pair_phase_std_rad": phases}
        correction = search.problem.correction(unknowns)
        flags = dict(evidence.flags)
        longer = ties.get("paths_longer_m", {}) if evidence.accepted else {}
        differing = [pair for pair, (longer_m, std_m) in longer.items() if abs(longer_m) > PATH_SIGMAS * std_m]
        if differing:
            lines = (f"{pair} by {100 * longer[pair][0]:+.1f} ± {100 * longer[pair][1]:.1f} cm" for pair in differing)
            flags["path_offsets_differ"] = f"relative to {search.problem.pairs[0].record.pair}: {', '.join(lines)}"
        return Refinement(correction, residual.std_m, evidence.accepted, evidence.reason, report, flags)

    def evidence_against(self, logs_only: "_Model", cause: CauseFit) -> float:
        """Return the reduction of the objective by the cause, relative to errors of the logs alone.

        Notes
        -----
        Source: docs/theory/autofocus.md, eq. 16b, evaluated over the bright points of both models, so that a cause must
        not blur points that are sharp along the logs.
        """
        if self.best is None or logs_only.best is None:
            return -np.inf
        # Tracks of both models, with and without the cause, at the points of each search.
        by_cause = cause.correction.moved_m
        rest, alone = self.best.state.tracks, logs_only.best.state.tracks
        total = {node: by_cause[node] + track for node, track in rest.items()}
        alone_less_cause = {node: track - by_cause[node] for node, track in alone.items()}
        logged = {node: np.zeros_like(track) for node, track in alone.items()}
        if logs_only.search.blur(total) > logs_only.search.blur(logged):
            return -np.inf
        searches = ((logs_only.best.search, alone, total), (self.best.search, alone_less_cause, rest))
        sharper = sum(search.blur(without) - search.blur(corrected) for search, without, corrected in searches)
        unknowns = logs_only.best.state.unknowns, self.best.state.unknowns
        energy = 0.5 * (float(unknowns[0] @ unknowns[0]) - float(unknowns[1] @ unknowns[1]))
        return sharper + energy - cause.energy


@dataclass(frozen=True, eq=False)
class Round:
    """Tracks fitted to the bright points that are visible along the tracks of the previous round.

    Attributes
    ----------
    search
        Search over these points.
    state, evidence
        Tracks fitted to all points; and the evidence for them, including held-out points.
    gain_db
        Contrast gain of held-out points relative to the tracks of the previous round; 0 in the first.
    number
        Number of rounds so far.
    """

    search: "TrackSearch"
    state: State
    evidence: Evidence
    gain_db: float
    number: int = 1


@dataclass(frozen=True, eq=False)
class TrackSearch:
    """Search for the tracks of a flight: the problem and its initial states.

    Attributes
    ----------
    problem
        Pairs, patches and prior.
    candidates
        Bright points.
    initial
        State along the logs.
    before
        State along the tracks of the previous round; None in the first.
    wavelength_m
        Wavelength at the band centre.
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
        """Start the search of a flight along its logs."""
        candidates = Candidates.of(records, grid, terrain, errors)
        knots_s = _knots(records, errors)
        prior = Prior({node: NodePrior.of(error, knots_s, candidates.axes) for node, error in sorted(errors.items())})
        pairs = [Blocks.of(record, knots_s) for record in records]
        wavelength_m = SPEED_OF_LIGHT_M_S / records[0].profiles.centre_frequency_hz
        return cls._over(Problem(pairs, [], knots_s, prior, Gauge.none(prior.size)), candidates, None, wavelength_m)

    @classmethod
    def _over(
        cls, problem: Problem, candidates: Candidates, unknowns: Floats | None, wavelength_m: float
    ) -> "TrackSearch":
        """Return the search over the candidates' patches; `unknowns` are those of the previous round."""
        pairs, prior = problem.pairs, problem.prior
        echoes = [blocks.echoes(candidates.patches) for blocks in pairs]
        values = [sum(echo.values for echo in of_pairs) for of_pairs in zip(*echoes, strict=True)]
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
        """Return the search over bright points in the image along refined tracks; None if there are no new points."""
        correction = self.problem.correction(state.unknowns)
        refined = [blocks.record.corrected(correction) for blocks in self.problem.pairs]
        candidates = Candidates.of(refined, grid, terrain, errors, looks=REFINED_LOOKS)
        if not candidates.patches or self._known(candidates):
            return None
        return self._over(self.problem, candidates, state.unknowns, self.wavelength_m)

    def rounds(self, grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]) -> Round:
        """Run rounds of detection and refinement; return the last round with a gain."""
        best = self.solve()
        # Tracks without a gain leave the image unchanged, so that another detection finds the same points.
        while best.number < MOST_ROUNDS and mean_gain(best.evidence.fitted_db).mean_db >= LEAST_FURTHER_DB:
            search = best.search.again(best.state, grid, terrain, errors)
            if search is None:
                break
            refined = replace(search.solve(), number=best.number + 1)
            if refined.gain_db < -LEAST_FURTHER_DB:
                break
            best = refined
            if refined.gain_db < LEAST_FURTHER_DB:
                break
        return best

    def _known(self, candidates: Candidates) -> bool:
        """Return True if the candidates are the points of this round, each in a separate patch."""
        patches = self.problem.patches
        if len(patches) != len(candidates.patches):
            return False
        candidates_m, points_m = (np.array([patch.place_m for patch in each]) for each in (candidates.patches, patches))
        distance_m = np.linalg.norm(candidates_m[:, None] - points_m, axis=2)
        half_m = [float(np.linalg.norm(patch.pixels_m - patch.place_m, axis=1).max()) / 2 for patch in patches]
        nearest = distance_m.argmin(axis=1)
        return len({*nearest.tolist()}) == len(patches) and bool(
            (distance_m.min(axis=1) < np.array(half_m)[nearest]).all()
        )

    @property
    def axes(self) -> Floats:
        """(3, 3) float64, rows are east, north, up."""
        return self.candidates.axes

    def solve(self) -> Round:
        """Return the tracks fitted to all patches, and the evidence from held-out patches."""
        problem, initial = self.problem, self.initial
        held_out_db = np.full((len(problem.pairs), len(problem.patches)), np.nan)
        round_gain_db = np.full_like(held_out_db, np.nan)
        everything, fold = np.ones(len(problem.patches), bool), np.arange(len(problem.patches)) % FOLDS
        few = len(problem.patches) < _FEW
        lowest = self.before if len(problem.patches) > 1 else self._fitted(everything)
        # Each quarter of the patches is held out of a fit in turn (eq. 16a); the fit of lowest objective is kept.
        for number in range(min(FOLDS, len(problem.patches)) if len(problem.patches) > 1 else 0):
            fitted = fold != (number + 2) % min(FOLDS, len(problem.patches))
            state = self._fitted(fitted)
            held_out_db[:, ~fitted] = gains_db(initial.statistics, state.statistics)[:, ~fitted]
            if self.before is not None:
                round_gain_db[:, ~fitted] = gains_db(self.before.statistics, state.statistics)[:, ~fitted]
            lowest = self._lowest([state] if lowest is None else [lowest, state], everything)
            if not few and mean_gain(held_out_db[:, np.isfinite(held_out_db[0])]).certain:
                break
        # Fit of all patches from the best of these fits; the search is repeated for cycle slips (eq. 16).
        assert lowest is not None  # set: a single patch is fitted directly, several patches have at least one fold
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
        measured = np.isfinite(round_gain_db)
        return Round(self, state, evidence, float(round_gain_db[measured].mean()) if measured.any() else 0.0)

    def fix_gauge(
        self, state: State, points: Sequence[ReferencePoint], *, apart_sigma: float
    ) -> tuple[Floats, dict[str, Any]]:
        """Fix the gauge of the unknowns by points, unless this blurs images or displaces points between pairs."""
        unknowns, report = fix_gauge(self.problem, state.unknowns, points, self.axes)
        if unknowns is state.unknowns:
            return unknowns, report
        after = self.problem.state(unknowns)
        lost_db = -float(gains_db(state.statistics, after.statistics).mean())
        if self._apart_sigma(after) > max(apart_sigma, 1.0) or lost_db > _LOST_TO_TIES_DB:
            return state.unknowns, {
                **report,
                "ties": "excluded: reference points would blur points or displace them between pairs",
            }
        return unknowns, report

    def _apart_sigma(self, state: State) -> float:
        """Return the distance of points between pairs, in standard deviations."""
        return pair_disagreement(self.problem, state.tracks, self.axes)[1]

    def _fitted(self, used: Bools) -> State:
        """Return the tracks fitted to the used patches, from the start with the lowest objective."""
        problem, initial = self.problem, self.initial
        starts = (initial, prominent_point_start(problem, initial, used, self.axes))
        best = self._lowest([problem.sharper(start, used) for start in starts], used)
        return problem.sharper(best, used, stages=_STAGES - 1)

    def _unslipped(self, state: State, used: Bools) -> tuple[State, RangeShifts]:
        """Repeat the search from tracks corrected by delays while there are cycle slips; return tracks and shifts."""
        problem = self.problem
        shifts = range_shifts(problem, state, self.axes)
        for _ in range(_SLIPS):
            slip_count = int(shifts.slipped(self.wavelength_m).sum())
            if not slip_count:
                break
            finer = range_shifts(problem, state, self.axes, parts=2 * PARTS)
            unslipped = problem.sharper(unslipped_start(problem, state, finer.by_point_m), used, stages=_STAGES - 1)
            after = range_shifts(problem, unslipped, self.axes)
            if int(after.slipped(self.wavelength_m).sum()) >= slip_count:
                break
            state, shifts = unslipped, after
        return state, shifts

    def _lowest(self, states: Sequence[State], used: Bools) -> State:
        """Return the state of lowest objective: sharp patches at the same positions in all pairs."""
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
        """Return the cause that explains the images best; its error is refined in rounds as points become visible."""
        if not causes or not self.problem.patches:
            return None
        fit = explained(self.problem, causes, self.axes, np.random.default_rng(0))
        if fit is None:
            return None
        for _ in range(MOST_ROUNDS - 1):
            corrected = [blocks.record.corrected(fit.correction) for blocks in self.problem.pairs]
            again = TrackSearch.begin(corrected, grid, terrain, errors)
            improved = fit.more(again.problem, again.axes) if again.problem.patches else fit
            if improved.gain_db - fit.gain_db < LEAST_FURTHER_DB:
                break
            fit = improved
        return fit

    def blur(self, tracks: Tracks) -> float:
        """Return the objective of tracks without the prior, at the points of this search."""
        value = self.problem.value(
            self.problem.at(tracks), np.ones(len(self.problem.patches), bool), self.initial.statistics
        )
        return value + pair_disagreement(self.problem, tracks, self.axes)[0]

    def by_speckle(self, grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]) -> Refinement | None:
        """Return the refinement by speckle; None for a single pair."""
        problem = self.problem
        if len(problem.pairs) < 2:
            return None
        correlation_s = min(error.correlation_s for error in errors.values())
        scene_tiles = tiles([blocks.record for blocks in problem.pairs], grid, terrain, correlation_s=correlation_s)
        pixels = sum(len(tile.patch.pixels_m) for tile in scene_tiles)
        every = 1 + pixels * len(problem.knots_s) * len(problem.pairs) // MOST_VALUES
        return refined_by_speckle(SpeckleTiles.of(problem.pairs, scene_tiles[::every]), problem.prior, problem.knots_s)


def _knots(records: Sequence[PairRecord], errors: Mapping[str, TrackErrors]) -> Floats:
    """Return equally spaced knot times: several within the correlation time, but not closer than the pulses."""
    first = min(float(record.time_s[0]) for record in records)
    last = max(float(record.time_s[-1]) for record in records)
    pulse_s = max(float(np.median(np.diff(record.time_s))) for record in records)
    correlations_s, phases_rad = zip(*(record.extreme_errors(errors) for record in records), strict=True)
    correlation_s, phase_rad = min(correlations_s), max(phases_rad)
    # White noise averaged over τ deviates from linear interpolation between knots spaced by Δ with variance σ²Δ/3τ.
    share = float(
        np.clip(
            3 * _BETWEEN_KNOTS_RAD2 / max(phase_rad**2, 1e-12),
            1 / _MOST_KNOTS_PER_CORRELATION_TIME,
            1 / _KNOTS_PER_CORRELATION_TIME,
        )
    )
    step_s = max(min(correlation_s * share, (last - first) / _LEAST_KNOTS), pulse_s)
    count = max(2, int(np.ceil((last - first) / step_s)))
    return first + (np.arange(count) + 0.5) * (last - first) / count
