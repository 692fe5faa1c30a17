"""Tracks of a flight refined by the images of all its pairs together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain
from apertura.methods.autofocus.agreement import Ground
from apertura.methods.autofocus.blocks import Blocks
from apertura.methods.autofocus.candidates import Candidates
from apertura.methods.autofocus.evidence import MOST_APART, Evidence, gains_db, range_shifts
from apertura.methods.autofocus.gauge import Gauge, find_gauge
from apertura.methods.autofocus.inputs import ReferencePoint, Sighting, TrackErrors
from apertura.methods.autofocus.outcome import Refinement
from apertura.methods.autofocus.patches import LEAST_PATCHES, MOST_VALUES, affordable
from apertura.methods.autofocus.prior import NodePrior, Prior
from apertura.methods.autofocus.prominent import prominent
from apertura.methods.autofocus.solve import Problem, State
from apertura.methods.autofocus.speckle import refined_by_speckle
from apertura.methods.autofocus.ties import disagreement, tied
from apertura.methods.autofocus.tiles import tiles
from apertura.methods.autofocus.uncertainty import MOST_RATIO, remaining

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

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
    search = Search.begin(sightings, grid, terrain, errors)
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
class Search:
    """The problem, and what its patches show from the logs."""

    problem: Problem
    found: Candidates
    begun: State
    wavelength_m: float

    @classmethod
    def begin(
        cls, sightings: Sequence[Sighting], grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]
    ) -> "Search":
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
        return refined_by_speckle(Ground.of(problem.pairs, found[::every]), problem.prior, problem.knots_s)


def _knots(sightings: Sequence[Sighting], errors: Mapping[str, TrackErrors]) -> Floats:
    """Return equally spaced times: several to an error's correlation time, none closer than pulses."""
    first = min(float(one.time_s[0]) for one in sightings)
    last = max(float(one.time_s[-1]) for one in sightings)
    pulse_s = max(float(np.median(np.diff(one.time_s))) for one in sightings)
    lasting_s = min(one.correlation_s for one in errors.values())
    step_s = max(min(lasting_s / _KNOTS_A_LASTING, (last - first) / _LEAST_KNOTS), pulse_s)
    count = max(2, int(np.ceil((last - first) / step_s)))
    return first + (np.arange(count) + 0.5) * (last - first) / count
