"""Fit of the error of one quantity to all bright points, and comparison with the explanation by errors of the logs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from apertura.common.arrays import Floats
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.methods.autofocus.inputs import Prior, Refinement
from apertura.methods.autofocus.solve import Gauge, Problem, prominent_point_start
from apertura.methods.causes import ARM, LEAST_GAIN_DB, Cause

NEAR = 10.0
"""Minimum difference of the objective that distinguishes two causes, or a cause from random tracks."""

LEAST_EVIDENCE = 40.0
"""Minimum reduction of the objective by a cause together with errors of the logs, relative to errors of the logs alone.
The largest reduction in 54 flights without such a cause was 26, with log errors of 4 cm and three points; lever-arm
errors of 20 cm give 250 to 1300."""

CHANCES = 6
"""Number of wrong tracks drawn at random for comparison, each with three unknowns, as a lever arm."""

_STAGES = 2  # iterations of caching contributions and maximising sharpness


@dataclass(frozen=True, eq=False)
class CausePrior(Prior):
    """Prior of a flight whose tracks are displaced by a cause only.

    Attributes
    ----------
    shapes_m
        Node → (unknown, knot, 3) float64, displacement in metres per standard deviation of each unknown.
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
        """Return node → (..., knot, 3) float64 corrections, metres, for (..., size) unknowns."""
        return {node: np.tensordot(unknowns, shape, axes=(-1, 0)) for node, shape in self.shapes_m.items()}

    def adjoint(self, gradient: Mapping[str, Floats]) -> Floats:
        """Convert derivatives with respect to node corrections to (..., size) derivatives with respect to unknowns."""
        return np.asarray(
            sum(np.tensordot(gradient[node], shape, axes=((-2, -1), (1, 2))) for node, shape in self.shapes_m.items())
        )


@dataclass(frozen=True, eq=False)
class CauseFit:
    """A cause with the errors at which all bright points are sharpest.

    Attributes
    ----------
    cause, values
        The wrong quantity; and its error, (unknown,) float64, in the unit of the quantity.
    correction
        Correction of the tracks.
    objective
        Objective of eq. 11.
    gain_db
        Mean power gain of points due to the correction, over points and pairs.
    alike
        Descriptions of other causes that explain the images equally well.
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
        all_used = np.ones(len(problem.patches), bool)
        prior = CausePrior.of(cause, problem.prior, problem.knots_s)
        alone = replace(problem, prior=prior, gauge=Gauge.none(prior.size))
        start = alone.state(np.zeros(prior.size))
        starts = (start, prominent_point_start(alone, start, all_used, axes))
        states = [alone.sharper(each, all_used, stages=_STAGES) for each in starts]
        values = [alone.value(state, all_used, start.statistics) for state in states]
        best = int(np.argmin(values))
        state = states[best]
        # Gain of points in dB, from √(Σ|I|⁴); the floor applies where points are displaced out of their patches.
        before, after = (
            np.array([np.sqrt(image.contrast) * image.energy for images in each.statistics for image in images])
            for each in (start, state)
        )
        gain_db = float(10 * np.log10(np.maximum(after, 1e-9 * before) / before).mean())
        correction = TrackCorrection(problem.knots_s, state.tracks)
        return cls(cause, state.unknowns * cause.std, correction, values[best], gain_db)

    @property
    def what(self) -> str:
        """Description of the cause and of equally good causes, one line."""
        return ", or ".join([self.cause.line(self.values), *self.alike])

    @property
    def energy(self) -> float:
        """Half the sum of the squared unknowns, in standard deviations."""
        return 0.5 * float(((self.values / self.cause.std) ** 2).sum())

    def more(self, problem: Problem, axes: Floats) -> "CauseFit":
        """Return this fit plus a fit of the residual error to a problem whose logs are corrected for this cause."""
        residual = CauseFit.of(problem, self.cause, axes)
        if residual.gain_db <= 0:
            return self
        correction, gain_db = self.correction.with_further(residual.correction), self.gain_db + residual.gain_db
        return replace(self, values=self.values + residual.values, correction=correction, gain_db=gain_db)

    def with_rest(self, rest: Refinement, evidence: float) -> Refinement:
        """Return the refinement by this cause, followed by the refinement of the corrected logs if accepted.

        Parameters
        ----------
        rest
            Refinement of logs corrected for the cause.
        evidence
            Reduction of the objective by the cause, relative to errors of the logs alone.
        """
        total = self.correction.with_further(rest.correction) if rest.accepted else self.correction
        line = f"{self.what}: correcting this alone raises the power of points by {self.gain_db:.1f} dB"
        report = {
            "what": self.what,
            "kind": self.cause.quantity.kind,
            "values": [round(float(value), 4) for value in self.values],
            "gain_db": round(self.gain_db, 2),
            "evidence": round(evidence, 1),
        }
        rejected = {"refinement_rejected", "refinement_no_bright_point"}  # then only the cause is corrected
        flags = {name: text for name, text in rest.flags.items() if name not in rejected} | {"cause_corrected": line}
        return Refinement(total, rest.std_m, True, f"{line}; {rest.reason}", {**rest.report, "cause": report}, flags)


def explained(
    problem: Problem, causes: Sequence[Cause], axes: Floats, generator: np.random.Generator
) -> CauseFit | None:
    """Return the cause that explains the images best; among equally good causes, the cause with the fewest unknowns.

    The result is None if no cause gains `LEAST_GAIN_DB`, or if random tracks explain the images equally well.

    Parameters
    ----------
    problem
        Bright points of all pairs, imaged along the logged tracks, with the prior of the log errors.
    causes
        Candidate causes.
    axes
        (3, 3) float64, rows are east, north, up.
    generator
        Random generator for the wrong tracks.

    Notes
    -----
    Source: docs/theory/autofocus.md, eq. 16b. A cause has at most three unknowns and is fitted to all bright points of
    all pairs; the gain of random tracks with the same number of unknowns is measured, not derived.
    """
    fits = [CauseFit.of(problem, cause, axes) for cause in causes]
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
    """Return smooth wrong tracks of a random node: offset, slope and undulation in random directions."""
    nodes = list(problem.prior.nodes)
    node, along = nodes[generator.integers(len(nodes))], np.linspace(-1, 1, len(problem.knots_s))
    periods, phase = generator.uniform(0.25, 1.5), generator.uniform(0, 2 * np.pi)
    shapes = np.stack([np.ones_like(along), along, np.sin(np.pi * periods * along + phase)])
    directions = generator.standard_normal((3, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    moved = shapes[:, :, None] * directions[:, None, :]
    return Cause(ARM, problem.knots_s, {node: moved})
