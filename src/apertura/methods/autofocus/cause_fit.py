"""One wrong quantity as the only error of a flight, fitted to all its bright places against errors of the logs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from apertura.common.arrays import Floats
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.methods.autofocus.inputs import Prior, Refinement
from apertura.methods.autofocus.solve import Gauge, Problem, prominent_point_start
from apertura.methods.causes import ARM, LEAST_GAIN_DB, Cause

NEAR = 10.0
"""Objective by which two causes, or a cause and chance, must differ to be told apart."""

LEAST_EVIDENCE = 40.0
"""Objective by which a cause beside errors of the logs must lie below these alone: of 54 flights without a cause one
reached 26, at 4 cm and with three points; wrong arms of 20 cm reach 250 to 1300."""

CHANCES = 6
"""Wrong tracks drawn at random, each of three unknowns, as a lever arm has."""

_STAGES = 2  # of caching contributions and sharpening


@dataclass(frozen=True, eq=False)
class CausePrior(Prior):
    """Tracks of a flight that only a cause moves.

    Attributes
    ----------
    shapes_m
        Node → (unknown, knot, 3) float64, metres for a standard deviation of each unknown.
    """

    shapes_m: Mapping[str, Floats]

    @classmethod
    def of(cls, cause: Cause, flight: Prior, knots_s: Floats) -> "CausePrior":
        """Return the prior of a flight whose only error is a cause."""
        shapes = {node: np.zeros((len(cause.std), len(knots_s), 3)) for node in flight.nodes}
        for node, moved_m in cause.moved_m.items():
            for number, of_unknown in enumerate(moved_m * cause.std[:, None, None]):
                shapes[node][number] = np.stack([np.interp(knots_s, cause.time_s, axis) for axis in of_unknown.T], -1)
        return cls(flight.nodes, shapes)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(next(iter(self.shapes_m.values())))

    def tracks(self, unknowns: Floats) -> dict[str, Floats]:
        """Return node → (..., knot, 3) float64 corrections, metres, of (..., size) unknowns."""
        return {node: np.tensordot(unknowns, shape, axes=(-1, 0)) for node, shape in self.shapes_m.items()}

    def adjoint(self, gradient: Mapping[str, Floats]) -> Floats:
        """Return (..., size) derivatives by the unknowns of what has those by the corrections of each node."""
        return np.asarray(
            sum(np.tensordot(gradient[node], shape, axes=((-2, -1), (1, 2))) for node, shape in self.shapes_m.items())
        )


@dataclass(frozen=True, eq=False)
class CauseFit:
    """A cause at the values at which all places are sharpest.

    Attributes
    ----------
    cause, values
        What is wrong, and by how much: (unknown,) in its unit.
    correction
        Of the tracks.
    objective
        Of eq. 11.
    gain_db
        Power that points gain by it, mean over places and pairs.
    alike
        Lines on other causes that explain as much: the images cannot tell them apart.
    """

    cause: Cause
    values: Floats
    correction: TrackCorrection
    objective: float
    gain_db: float
    alike: Sequence[str] = ()

    @classmethod
    def of(cls, problem: Problem, cause: Cause, axes: Floats) -> "CauseFit":
        """Fit a cause to a problem; `axes` are rows east, north, up."""
        used, prior = np.ones(len(problem.patches), bool), CausePrior.of(cause, problem.prior, problem.knots_s)
        alone = replace(problem, prior=prior, gauge=Gauge.none(prior.size))
        start = alone.state(np.zeros(prior.size))
        starts = (start, prominent_point_start(alone, start, used, axes))
        states = [alone.sharper(one, used, stages=_STAGES) for one in starts]
        values = [alone.value(state, used, start.statistics) for state in states]
        best = int(np.argmin(values))
        state = states[best]
        # dB by which points are stronger: of Σ|I|⁴, half; places from which the points move lose all
        before, after = (
            np.array([np.sqrt(one.contrast) * one.energy for of_pair in each.statistics for one in of_pair])
            for each in (start, state)
        )
        gain_db = float(10 * np.log10(np.maximum(after, 1e-9 * before) / before).mean())
        correction = TrackCorrection(problem.knots_s, state.tracks)
        return cls(cause, state.unknowns * cause.std, correction, values[best], gain_db)

    @property
    def what(self) -> str:
        """In one line."""
        return ", or ".join([self.cause.line(self.values), *self.alike])

    @property
    def energy(self) -> float:
        """Half the squared unknowns, in standard deviations."""
        return 0.5 * float(((self.values / self.cause.std) ** 2).sum())

    def more(self, problem: Problem, axes: Floats) -> "CauseFit":
        """Return the cause with what is left of it in a problem whose logs are corrected for it."""
        left = CauseFit.of(problem, self.cause, axes)
        if left.gain_db <= 0:
            return self
        correction, gain_db = self.correction.with_further(left.correction), self.gain_db + left.gain_db
        return replace(self, values=self.values + left.values, correction=correction, gain_db=gain_db)

    def with_rest(self, rest: Refinement, evidence: float) -> Refinement:
        """Return the refinement by this cause and what was refined, or not, of logs corrected for it.

        Parameters
        ----------
        rest
            Of logs corrected for the cause.
        evidence
            By which the objective of errors of the logs alone lies above that of these beside the cause.
        """
        total = self.correction.with_further(rest.correction) if rest.accepted else self.correction
        line = f"{self.what}: points gain {self.gain_db:.1f} dB by that alone"
        report = {
            "what": self.what,
            "kind": self.cause.quantity.kind,
            "values": [round(float(value), 4) for value in self.values],
            "gain_db": round(self.gain_db, 2),
            "evidence": round(evidence, 1),
        }
        rejected = {"refinement_rejected", "refinement_no_bright_point"}  # then this is all there is to mend
        flags = {name: text for name, text in rest.flags.items() if name not in rejected} | {"cause_corrected": line}
        return Refinement(total, rest.std_m, True, f"{line}; {rest.why}", {**rest.report, "cause": report}, flags)


def explained(
    problem: Problem, causes: Sequence[Cause], axes: Floats, generator: np.random.Generator
) -> CauseFit | None:
    """Return the cause that explains more than others, of equals the one of fewest unknowns; None where chance does.

    Parameters
    ----------
    problem
        Bright places of all pairs along the logs, with the prior of their errors.
    causes
        That may be.
    axes
        (3, 3) float64, rows are east, north, up.
    generator
        Draws wrong tracks.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 16b. A cause has at most three unknowns and stands against all places of all
    pairs: by how much wrong tracks of as many unknowns gain is measured, not derived.
    """
    fits = [CauseFit.of(problem, one, axes) for one in causes]
    lowest = min((fit.objective for fit in fits), default=np.inf)
    near = [fit for fit in fits if fit.objective < lowest + NEAR]
    best = min(near, key=lambda fit: (len(fit.values), fit.objective), default=None)
    if best is None or best.gain_db < LEAST_GAIN_DB:
        return None
    for _ in range(CHANCES):
        if CauseFit.of(problem, _drawn(problem, generator), axes).objective < best.objective + NEAR:
            return None
    lines = [fit.cause.line(fit.values) for fit in near if fit is not best]
    return replace(best, alike=lines)


def _drawn(problem: Problem, generator: np.random.Generator) -> Cause:
    """Return smooth wrong tracks of one node: offset, inclined and bent in directions that are drawn."""
    nodes = list(problem.prior.nodes)
    node, along = nodes[generator.integers(len(nodes))], np.linspace(-1, 1, len(problem.knots_s))
    periods, phase = generator.uniform(0.25, 1.5), generator.uniform(0, 2 * np.pi)
    shapes = np.stack([np.ones_like(along), along, np.sin(np.pi * periods * along + phase)])
    ways = generator.standard_normal((3, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    moved = shapes[:, :, None] * ways[:, None, :]
    return Cause(ARM, problem.knots_s, {node: moved})
