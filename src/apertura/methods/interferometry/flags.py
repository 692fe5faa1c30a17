"""Where the method ends: what an interferogram cannot tell, measured, in one line each."""

from dataclasses import dataclass

from apertura.common.flags.raised import Flags


@dataclass(frozen=True)
class Measured:
    """What was counted on one interferogram.

    Attributes
    ----------
    common
        Pixels that both images see plainly.
    coherent
        Of them, those more coherent than chance; `sensitive`: those whose phase a height turns enough.
    coherence, chance
        Median of the common pixels as measured, and the mean where there is none.
    overlap
        Median share of the spectrum that both images sample.
    ambiguity_m
        Median height of one turn, metres.
    told
        Pixels whose phase was unwrapped; `apart`: those of them in parts that the level does not hold for.
    residues, loops, jumps, by
        As of `apertura.methods.interferometry.unwrapping.Unwrapped`.
    folded
        As of `apertura.methods.interferometry.heights.Placed`.
    points
        Points of known height that give the level.
    """

    common: int
    coherent: int
    sensitive: int
    coherence: float
    chance: float
    overlap: float
    ambiguity_m: float
    told: int = 0
    apart: int = 0
    residues: int = 0
    loops: int = 0
    jumps: int = 0
    by: str = ""
    folded: int = 0
    points: int = 0


MOST_INCOHERENT = 0.5
"""Share of the common pixels that may be as incoherent as chance."""

MOST_RESIDUES = 1e-3
"""Residues per loop of four pixels."""

MOST_FOLDED = 0.01
"""Share of the pixels told whose places several pixels show."""


def raised(measured: Measured) -> Flags:
    """Return the limits that an interferogram exceeds: flag → what was measured.

    Examples
    --------
    >>> sorted(raised(Measured(100, 10, 100, 0.2, 0.18, 0.0, 2.0)))
    ['interferogram_decorrelated']
    """
    one, flags = measured, Flags()
    if one.common - one.coherent > MOST_INCOHERENT * one.common or not one.common:
        beyond = ": the tracks lie further apart than any coherence reaches" if one.overlap == 0 else ""
        flags["interferogram_decorrelated"] = (
            f"{one.coherent} of {one.common} pixels that both images see are more coherent than chance; in the median "
            f"coherence is {one.coherence:.2f} where chance makes {one.chance:.2f} and geometry leaves "
            f"{one.overlap:.2f} of the spectrum in common{beyond}"
        )
    if one.sensitive < one.common:
        flags["height_insensitive"] = (
            f"at {one.common - one.sensitive} of {one.common} pixels one turn of the phase is more height than the "
            "range is long: the tracks lie too close together for a height"
        )
    ambiguous = []
    if one.apart:
        ambiguous.append(f"{one.apart} of {one.told} pixels lie in parts apart, whole turns from the others: left out")
    if one.jumps and not one.by:
        ambiguous.append(
            f"snaphu is not installed and the phase jumps by a turn at {one.jumps} places: heights are known up to "
            f"multiples of {one.ambiguity_m:.3g} m"
        )
    if ambiguous:
        flags["height_ambiguous"] = "; ".join(ambiguous)
    if one.residues > MOST_RESIDUES * one.loops or one.folded > MOST_FOLDED * one.told:
        folded = f"; {one.folded} places are shown by several pixels and left out" if one.folded else ""
        flags["unwrapping_inconsistent"] = (
            f"around {one.residues} of {one.loops} loops of four pixels the phase does not come back to itself, "
            f"heights may err by multiples of {one.ambiguity_m:.3g} m{folded}"
        )
    if one.told and not one.points:
        flags["height_relative"] = (
            "no point of known height shows: the median of the phase is taken for the height that the terrain has, and "
            "an error of it is another height wherever one turn is another height"
        )
    return flags
