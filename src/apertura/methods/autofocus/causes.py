"""One wrong quantity of the config as the only error of a flight: few unknowns, and what all points gain by them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from apertura.common.arrays import Floats
from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.methods.autofocus.inputs import Prior, Refinement
from apertura.methods.autofocus.solve import Gauge, Problem, State, prominent_point_start

# ---- Causes: how a wrong quantity moves the nodes of a flight -------------------------------------------------------

TIME_STD_S, ARM_STD_M, HEIGHT_STD_M = 0.3, 0.3, 3.0
"""Standard deviations of what may be wrong: as wide as hands err, so that the images decide and not the prior."""


@dataclass(frozen=True, eq=False)
class Cause:
    """A constant of the config, or a few, that may be wrong.

    Attributes
    ----------
    kind
        As of the hypotheses: time, lever arm or height.
    what
        Line for the reader, with a place for each value.
    std
        (unknown,) float64, standard deviation of each, in its unit.
    time_s
        (sample,) float64, seconds of the flight's clock.
    moved_m
        Node → (unknown, sample, 3) float64, by how much a unit of each moves the node, metres in the frame; nodes that
        are not named stay.

    Examples
    --------
    >>> time_s, flown_m = np.arange(3.0), np.array([[0.0, 0, 0], [5, 0, 0], [10, 0, 0]])
    >>> late = late_logs(["a"], {"a": (time_s, flown_m)})
    >>> late.moved_m["a"][0, :, 0], late.line(np.array([0.02]))
    (array([5., 5., 5.]), 'the times of the log of a are 0.020 s late')
    """

    kind: Literal["time", "lever arm", "height"]
    what: str
    std: Floats
    time_s: Floats
    moved_m: Mapping[str, Floats]

    def line(self, values: Floats) -> str:
        """Describe the wrong constant, with its size."""
        late, above = ("late", "above") if values[0] > 0 else ("early", "below")
        return self.what.format(*values, late=late, above=above, size=abs(float(values[0])))

    def prior(self, flight: Prior, knots_s: Floats) -> "CausePrior":
        """Return the prior of a flight with no other error."""
        shapes = {node: np.zeros((len(self.std), len(knots_s), 3)) for node in flight.nodes}
        for node, moved_m in self.moved_m.items():
            for number, of_unknown in enumerate(moved_m * self.std[:, None, None]):
                shapes[node][number] = np.stack([np.interp(knots_s, self.time_s, axis) for axis in of_unknown.T], -1)
        return CausePrior(flight.nodes, shapes)


def late_logs(nodes: Sequence[str], flown: Mapping[str, tuple[Floats, Floats]]) -> Cause:
    """Return the cause that the times of some logs are late by one delay.

    Parameters
    ----------
    nodes
        Whose logs.
    flown
        Node → (sample,) seconds and (sample, 3) metres: where its log has it.
    """
    time_s, moved = flown[nodes[0]][0], dict[str, Floats]()
    for node in nodes:  # logs differ in epochs: all at those of the first
        own_s, speed = flown[node][0], np.gradient(flown[node][1], flown[node][0], axis=0)
        moved[node] = np.stack([np.interp(time_s, own_s, axis) for axis in speed.T], axis=-1)[None]
    logs = f"the log of {nodes[0]}" if len(nodes) == 1 else "all logs"
    what = f"the times of {logs} are {{size:.3f}} s {{late}}"
    return Cause("time", what, np.array([TIME_STD_S]), time_s, moved)


def other_arm(node: str, time_s: Floats, body_axes: Floats) -> Cause:
    """Return the cause that a node's antennas lie elsewhere on the body, or the body is turned against its attitude.

    Parameters
    ----------
    node
        Its name.
    time_s, body_axes
        (sample,) seconds, and (sample, 3, 3): columns are forward, right and down in the frame.

    Notes
    -----
    A constant error δθ of attitude moves an antenna on the arm l as an arm that is wrong by δθ × l does.
    """
    what = f"lever arms of {node} are wrong by [{{0:+.3f}}, {{1:+.3f}}, {{2:+.3f}}] m, or its attitude by a constant"
    return Cause("lever arm", what, np.full(3, ARM_STD_M), time_s, {node: np.moveaxis(body_axes, -1, 0)})


def other_height(nodes: Sequence[str], time_s: Floats, up: Floats) -> Cause:
    """Return the cause that the ground lies higher than stated, as if all nodes flew lower; `up` (3,) in the frame."""
    moved = {node: np.broadcast_to(-up, (1, len(time_s), 3)) for node in nodes}
    what = "the ground lies {size:.2f} m {above} where the config has it"
    return Cause("height", what, np.array([HEIGHT_STD_M]), time_s, moved)


@dataclass(frozen=True, eq=False)
class CausePrior(Prior):
    """Tracks of a flight that only a cause moves.

    Attributes
    ----------
    shapes_m
        Node → (unknown, knot, 3) float64, metres for a standard deviation of each unknown.
    """

    shapes_m: Mapping[str, Floats]

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


# ---- Which cause explains what a flight lost ------------------------------------------------------------------------

LEAST_GAIN_DB = 0.5
"""Power of points that a cause must bring back to be named: less needs no explanation beyond the logs' errors."""

NEAR = 10.0
"""Objective by which two causes, or a cause and chance, must differ to be told apart."""

LEAST_EVIDENCE = 40.0
"""Objective by which a cause beside errors of the logs must lie below these alone: of 54 flights without a cause one
reached 26, at 4 cm and with three points; wrong arms of 20 cm reach 250 to 1300."""

CHANCES = 6
"""Wrong tracks drawn at random, each of three unknowns, as a lever arm has."""

_STAGES = 2  # of caching contributions and sharpening


@dataclass(frozen=True, eq=False)
class Explained:
    """The cause that alone explains most of what a flight lost.

    Attributes
    ----------
    cause, values
        What is wrong, and by how much: (unknown,) in its unit.
    alike
        Lines on other causes that explain as much: the images cannot tell them apart.
    correction
        Of the tracks.
    gain_db
        Power that points gain by it, mean over places and pairs.
    """

    cause: Cause
    values: Floats
    alike: Sequence[str]
    correction: TrackCorrection
    gain_db: float

    @property
    def what(self) -> str:
        """In one line."""
        return ", or ".join([self.cause.line(self.values), *self.alike])

    @property
    def energy(self) -> float:
        """Half the squared unknowns, in standard deviations."""
        return 0.5 * float(((self.values / self.cause.std) ** 2).sum())

    def further(self, values: Floats, correction: TrackCorrection, gain_db: float) -> "Explained":
        """Return the same cause with more of it."""
        total = self.correction.with_further(correction)
        return replace(self, values=self.values + values, correction=total, gain_db=self.gain_db + gain_db)

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
            "kind": self.cause.kind,
            "values": [round(float(value), 4) for value in self.values],
            "gain_db": round(self.gain_db, 2),
            "evidence": round(evidence, 1),
        }
        rejected = {"refinement_rejected", "refinement_no_bright_place"}  # then this is all there is to mend
        flags = {name: text for name, text in rest.flags.items() if name not in rejected} | {"cause_found": line}
        return Refinement(total, rest.std_m, True, f"{line}; {rest.why}", {**rest.report, "cause": report}, flags)


def explained(
    problem: Problem, causes: Sequence[Cause], axes: Floats, generator: np.random.Generator
) -> Explained | None:
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
    fits = [_Fit.of(problem, one, axes) for one in causes]
    lowest = min((fit.objective for fit in fits), default=np.inf)
    near = [fit for fit in fits if fit.objective < lowest + NEAR]
    best = min(near, key=lambda fit: (len(fit.values), fit.objective), default=None)
    if best is None or best.gain_db < LEAST_GAIN_DB:
        return None
    for _ in range(CHANCES):
        if _Fit.of(problem, _drawn(problem, generator), axes).objective < best.objective + NEAR:
            return None
    lines = [fit.cause.line(fit.values) for fit in near if fit is not best]
    return Explained(best.cause, best.values, lines, best.correction, best.gain_db)


def more_of(problem: Problem, found: Explained, axes: Floats) -> Explained:
    """Return a cause with what is left of it in a problem whose logs are corrected for it."""
    fit = _Fit.of(problem, found.cause, axes)
    return found.further(fit.values, fit.correction, fit.gain_db) if fit.gain_db > 0 else found


@dataclass(frozen=True, eq=False)
class _Fit:
    """A cause at the values, in its units, at which all places are sharpest; objective of eq. 11 and gain there."""

    cause: Cause
    values: Floats
    correction: TrackCorrection
    objective: float
    gain_db: float

    @classmethod
    def of(cls, problem: Problem, cause: Cause, axes: Floats) -> "_Fit":
        used, prior = np.ones(len(problem.patches), bool), cause.prior(problem.prior, problem.knots_s)
        alone = replace(problem, prior=prior, gauge=Gauge.none(prior.size))
        start = alone.state(np.zeros(prior.size))
        starts = (start, prominent_point_start(alone, start, used, axes))
        states = [alone.sharper(one, used, stages=_STAGES) for one in starts]
        values = [alone.value(state, used, start.statistics) for state in states]
        best = int(np.argmin(values))
        state = states[best]
        correction = TrackCorrection(problem.knots_s, state.tracks)
        return cls(cause, state.unknowns * cause.std, correction, values[best], _gain_db(start, state))


def _gain_db(start: State, state: State) -> float:
    """Return the dB by which points are stronger: of Σ|I|⁴, half; places from which the points move lose all."""
    fourth = [
        [np.sqrt(one.contrast) * one.energy for of_pair in each.statistics for one in of_pair]
        for each in (start, state)
    ]
    return float(10 * np.log10(np.maximum(fourth[1], 1e-9 * np.array(fourth[0])) / fourth[0]).mean())


def _drawn(problem: Problem, generator: np.random.Generator) -> Cause:
    """Return smooth wrong tracks of one node: offset, inclined and bent in directions that are drawn."""
    nodes = list(problem.prior.nodes)
    node, along = nodes[generator.integers(len(nodes))], np.linspace(-1, 1, len(problem.knots_s))
    periods, phase = generator.uniform(0.25, 1.5), generator.uniform(0, 2 * np.pi)
    shapes = np.stack([np.ones_like(along), along, np.sin(np.pi * periods * along + phase)])
    ways = generator.standard_normal((3, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    moved = shapes[:, :, None] * ways[:, None, :]
    return Cause("lever arm", "", np.full(3, ARM_STD_M), problem.knots_s, {node: moved})
