"""Tracks of a flight refined by the images of all its pairs together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.geometry.track_correction import TrackCorrection
from apertura.refinement.agreement import Ground
from apertura.refinement.blocks import Blocks, PatchEcho
from apertura.refinement.candidates import bright_places, east_north_up
from apertura.refinement.evidence import Evidence, gains_db, range_shifts
from apertura.refinement.gauge import Gauge, find_gauge
from apertura.refinement.inputs import ReferencePoint, Sighting, TrackErrors
from apertura.refinement.outcome import Refinement
from apertura.refinement.patches import Patch, patch_at, spread_out
from apertura.refinement.prior import NodePrior, Prior
from apertura.refinement.prominent import prominent
from apertura.refinement.solve import Problem, State
from apertura.refinement.speckle import refined_by_speckle
from apertura.refinement.ties import disagreement, tied
from apertura.refinement.tiles import tiles
from apertura.refinement.uncertainty import MOST_RATIO, remaining
from apertura.scene.grid import SceneGrid
from apertura.scene.terrain import Terrain

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEAST_PATCHES = 4
LEAST_RATIO = 5.0
"""Power of a place against what lies about it, summed over parts of the aperture: less is no point."""

HELPFUL_RATIO = 3.5
"""Where there are points, places that stand out less help too."""

FOLDS = 4
"""A quarter of the patches is not fitted, and tells whether the others are to be believed."""

MOST_BYTES = 2**30
"""Of what blocks add to patches: with more, fewer patches are looked at."""

_SHARE_OF_CLEAREST = 0.05  # beside clear points faint places are their sidelobes
_APART = 0.6  # of half a patch, at least, lie patches apart
_BYTES = 8  # of a complex64
_KNOTS_A_LASTING = 10  # to an error's correlation time
_LEAST_KNOTS = 64
_FEW = 8  # patches: each quarter of so few is held out once
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
        return found if found is not None and found.accepted else search.refused(errors, found)
    state, evidence = search.judged()
    left = remaining(search.problem, state)
    unknowns, ties = tied(search.problem, state.unknowns, reference_points, search.axes)
    report = {**evidence.report, **left.report, **ties, "patches": len(search.problem.patches)}
    correction = search.problem.correction(unknowns)
    return Refinement(correction, left.std_m, evidence.accepted, evidence.why, report, evidence.flags)


@dataclass(frozen=True, eq=False)
class Search:
    """The problem, and what its patches show from the logs."""

    problem: Problem
    axes: Floats
    begun: State
    points: int
    wavelength_m: float

    @classmethod
    def begin(
        cls, sightings: Sequence[Sighting], grid: SceneGrid, terrain: Terrain, errors: Mapping[str, TrackErrors]
    ) -> "Search":
        """Return the problem of a flight, as its logs have it."""
        lasting_s = min(one.correlation_s for one in errors.values())
        places_m, ratio = bright_places(sightings, grid, terrain, lasting_s=lasting_s)
        axes = east_north_up(grid, places_m)
        knots_s = _knots(sightings, errors)
        prior = Prior({node: NodePrior.of(one, knots_s, axes) for node, one in sorted(errors.items())})
        pairs = [Blocks.of(sighting, knots_s) for sighting in sightings]
        patches = _patches(sightings, places_m, ratio, lasting_s, axes) if _points(ratio) >= LEAST_PATCHES else []
        echoes = [blocks.echoes(patches) for blocks in pairs]
        problem = Problem(pairs, echoes, knots_s, prior, Gauge.none(prior.size))
        problem = problem.of(range(_affordable(echoes)))
        begun = problem.state(np.zeros(prior.size))
        if len(problem.patches) >= LEAST_PATCHES:
            problem = replace(problem, gauge=find_gauge(pairs, begun.cached, prior, knots_s, axes))
        wavelength_m = SPEED_OF_LIGHT_M_S / sightings[0].profiles.centre_frequency_hz
        return cls(problem, axes, begun, _points(ratio), wavelength_m)

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
        state = self._lowest([lowest, problem.sharper(lowest, everything)], everything)
        known = 2 * sum(min(one.ratio, MOST_RATIO) for seen in state.seen for one in seen)
        evidence = Evidence(
            fitted_db=gains_db(begun.seen, state.seen),
            held_out_db=held_out_db[:, np.isfinite(held_out_db[0])],
            settled=problem.gauge.settled(state.unknowns, known=known),
            before=range_shifts(problem, begun, self.axes),
            after=range_shifts(problem, state, self.axes),
            wavelength_m=self.wavelength_m,
            apart_sigma=disagreement(problem, state.tracks, self.axes)[1],
        )
        return state, evidence

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
        every = 1 + _BYTES * pixels * len(problem.knots_s) * len(problem.pairs) // MOST_BYTES
        return refined_by_speckle(Ground.of(problem.pairs, found[::every]), problem.prior, problem.knots_s)

    def refused(self, errors: Mapping[str, TrackErrors], by_speckle: Refinement | None) -> Refinement:
        """Return that too few points stand out, and that the ground between them does not help either."""
        line = (
            f"{self.points} places of the scene stand {10 * np.log10(LEAST_RATIO):.0f} dB out of what lies about them, "
            f"{LEAST_PATCHES} are needed"
        )
        knots_s = self.problem.knots_s
        nothing = {node: np.zeros((len(knots_s), 3)) for node in errors}
        std_m = {
            node: np.tile(np.abs(np.array(one.std_m) @ self.axes), (len(knots_s), 1)) for node, one in errors.items()
        }
        report: dict[str, Any] = {"patches": self.points}
        if by_speckle is not None:
            line, report = f"{line}; {by_speckle.why}", {**report, "speckle": dict(by_speckle.report)}
        flags = {"refinement_too_few_patches": line}
        return Refinement(TrackCorrection(knots_s, nothing), std_m, False, line, report, flags)


def _affordable(echoes: Sequence[Sequence[PatchEcho]]) -> int:
    """Return how many patches may be kept in memory: those of a long flight have many blocks."""
    values = np.sum([[len(one.patch.pixels_m) * len(one.profiles) for one in pair] for pair in echoes], axis=0)
    affordable = np.flatnonzero(_BYTES * np.cumsum(values) <= MOST_BYTES)
    return max(len(affordable), min(LEAST_PATCHES, len(values)))


def _knots(sightings: Sequence[Sighting], errors: Mapping[str, TrackErrors]) -> Floats:
    """Return equally spaced times: several to an error's correlation time, none closer than pulses."""
    first = min(float(one.time_s[0]) for one in sightings)
    last = max(float(one.time_s[-1]) for one in sightings)
    pulse_s = max(float(np.median(np.diff(one.time_s))) for one in sightings)
    lasting_s = min(one.correlation_s for one in errors.values())
    step_s = max(min(lasting_s / _KNOTS_A_LASTING, (last - first) / _LEAST_KNOTS), pulse_s)
    count = max(2, int(np.ceil((last - first) / step_s)))
    return first + (np.arange(count) + 0.5) * (last - first) / count


def _points(ratio: Floats) -> int:
    """Return how many places are points."""
    return len(np.flatnonzero(ratio > LEAST_RATIO))


def _patches(
    sightings: Sequence[Sighting], places_m: Floats, ratio: Floats, lasting_s: float, axes: Floats
) -> list[Patch]:
    typical = patch_at(places_m[0], sightings, axes, correlation_s=lasting_s)
    apart_m = _APART * float(np.abs((typical.pixels_m - typical.place_m) @ axes[:2].T).max())
    helpful = ratio > max(HELPFUL_RATIO, _SHARE_OF_CLEAREST * float(ratio.max()))
    chosen = spread_out(places_m[helpful], ratio[helpful], axes, apart_m=apart_m)
    return [patch_at(place, sightings, axes, correlation_s=lasting_s) for place in chosen]
