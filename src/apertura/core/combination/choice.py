"""Which images of a flight are added with their phases: those that were seen to be in phase, or made so."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol


class Phase(Protocol):
    """How a pair lies against the reference in phase."""

    @property
    def phase_rad(self) -> float: ...  # noqa: D102
    @property
    def phase_std_rad(self) -> float: ...  # noqa: D102
    @property
    def coherence(self) -> float: ...  # noqa: D102
    @property
    def points(self) -> int: ...  # noqa: D102
    @property
    def out_of_phase(self) -> bool: ...  # noqa: D102


LEAST_COHERENCE = 0.5
"""Phases of the points of two images that scatter more than this say nothing that a constant could mend."""


@dataclass(frozen=True)
class Fusion:
    """What the coherent sum holds.

    Attributes
    ----------
    phases_rad
        Pair → phase taken off before it is added; 0 where none was asked for or needed.
    left_out
        Pair → why it is only in the sums without phase.
    why
        Pair → why it is in, in one line.
    """

    phases_rad: Mapping[str, float]
    left_out: Mapping[str, str]
    why: Mapping[str, str]

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values."""
        phases = {pair: round(phase, 4) for pair, phase in self.phases_rad.items()}
        return {"phases_rad": phases, "left_out": dict(self.left_out), "why": dict(self.why)}


def choose_fusion(
    reference: str, found: Mapping[str, Phase | None], *, unfit: Mapping[str, str], align: bool
) -> Fusion:
    """Return which pairs add coherently to the reference.

    Parameters
    ----------
    reference
        The pair that others are measured against.
    found
        Every other pair → its phase against the reference at bright points; None where they share none.
    unfit
        Pairs that show other places than the reference → why.
    align
        Whether a constant phase is taken off.

    Examples
    --------
    >>> choose_fusion("a-a", {"a-b": None}, unfit={}, align=False).phases_rad
    {'a-a': 0.0, 'a-b': 0.0}
    """
    phases, left_out, why = {reference: 0.0}, {}, {reference: "the others are measured against it"}
    for pair, phase in found.items():
        if pair in unfit:
            left_out[pair] = unfit[pair]
        elif phase is None:
            phases[pair], why[pair] = 0.0, f"phase not measured: no bright point in common with {reference}"
        else:
            line = f"{phase.phase_rad:+.2f} ± {phase.phase_std_rad:.2f} rad at {phase.points} bright points"
            if phase.coherence < LEAST_COHERENCE:
                left_out[pair] = f"{line}, coherence {phase.coherence:.2f}: no common phase"
            elif align:
                phases[pair], why[pair] = phase.phase_rad, f"{line}, taken off"
            elif phase.out_of_phase:
                left_out[pair] = f"{line}; processing.fusion.align_phase takes it off"
            else:
                phases[pair], why[pair] = 0.0, line
    return Fusion(phases, left_out, why)
