"""Sums of the images of one flight: which pairs are added in phase, the sums, and how well they add up."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.units import decibels
from apertura.core.quality.agreement import OUT_OF_PHASE_RAD, Agreement

# ---- How well the images of a sum add up


@dataclass(frozen=True)
class InPhase:
    """Share of the power of its images that a coherent sum keeps at bright places.

    Attributes
    ----------
    coherence, std
        |Σ_i a_i|²/(n Σ_i |a_i|²) of the amplitudes a_i of n images, mean over the places by their power, and its
        standard deviation: 1 in phase, `chance` at random.
    chance
        1/n.
    places
        How many.
    """

    coherence: float
    std: float
    chance: float
    places: int

    @property
    def loss_db(self) -> float:
        """Power that the peaks of the sum lack because its images are not in phase, dB, 0 or less."""
        return decibels(max(self.coherence, 1e-6))

    @property
    def loss_std_db(self) -> float:
        """Standard deviation of `loss_db`."""
        return float(10 / np.log(10) * self.std / max(self.coherence, 1e-6))


def in_phase(amplitudes: NDArray[np.complex128], background: NDArray[np.float64]) -> InPhase:
    """Measure the share of power that the images of a sum have in phase at some places.

    Parameters
    ----------
    amplitudes
        (place, image) complex128, of images as they are added: peak-normalised, their phases taken off.
    background
        (place,) float64, power of the surroundings of each relative to its own.

    Notes
    -----
    Source: docs/theory/fusion.md, eq. 4. Places are to be found without the phases, in the non-coherent sum: at the
    maxima of the coherent one images agree by selection.

    Examples
    --------
    >>> told = in_phase(np.array([[1, 1j], [0.5, 0.5j]]), np.zeros(2))
    >>> round(told.coherence, 3), told.chance, round(told.loss_db, 2)
    (0.5, 0.5, -3.01)
    """
    count = amplitudes.shape[1]
    power = (np.abs(amplitudes) ** 2).sum(axis=1)
    each = np.abs(amplitudes.sum(axis=1)) ** 2 / (count * np.maximum(power, 1e-30))
    share = power / power.sum()
    mean = float((share * each).sum())
    # Scatter from place to place; one alone is as uncertain as its surroundings make it.
    scatter = ((each - mean) ** 2 + background**2 / 4) * share**2
    return InPhase(mean, float(np.sqrt(scatter.sum())), 1 / count, len(amplitudes))


def clutter_reduction_db(single_db: Sequence[float], coherent_db: float) -> float:
    """Return the reduction of clutter, against the peak, in a coherent sum relative to its images.

    Parameters
    ----------
    single_db
        (pair,) clutter of each image of the sum: its median power over its peak power, dB.
    coherent_db
        The same of the sum.

    Returns
    -------
    float
        dB; 10 lg of the number of images where the targets add in phase and the clutter does not, 0 where the images
        show one thing, less where targets do not add in phase.

    Raises
    ------
    ValueError
        If there is no image.

    Notes
    -----
    Source: docs/theory/fusion.md, eq. 3.

    Examples
    --------
    >>> round(clutter_reduction_db([-40.0, -40.0], -43.01), 2)
    3.01
    """
    if not single_db:
        raise ValueError("no image: a sum of nothing reduces nothing")
    return decibels(float(np.mean(10 ** (np.asarray(single_db) / 10)))) - coherent_db


# ---- Choice of the pairs that are added coherently: the largest set that agrees


MOST_SETS_OF = 12
"""Pairs of a flight of which every set is tried, 4096 in all; of more, those that agree with most others."""

_SURE = 3.09
"""Standard deviations of a normal number exceeded once in 1000: by so much a set must contradict itself to fail."""


@dataclass(frozen=True)
class CoherentSum:
    """The pairs of a coherent sum, and how the others differ from them.

    Attributes
    ----------
    reference
        The member that phases are counted from: the best of them.
    phases_rad
        Pair → phase removed before it is added; 0 where none was requested or needed.
    left_out
        Pair → why it is only in the sums without phase.
    why
        Pair → why it is in, in one line.
    agreeing
        The largest set of pairs whose differences in phase and place are measured and agree.
    apart
        Pair that was measured and is not of that set → how it lies against the set.
    unmeasured
        Pair that is added with phase 0 although nothing tells its phase → why nothing does.
    ties
        Other sets as large that agree in themselves and contradict this one: which is right, images do not show.
    misfit, freedom
        χ² of the set's differences about one phase and place per pair, and its degrees of freedom.
    """

    reference: str
    phases_rad: Mapping[str, float]
    left_out: Mapping[str, str]
    why: Mapping[str, str]
    agreeing: tuple[str, ...]
    apart: Mapping[str, Agreement]
    unmeasured: Mapping[str, str]
    ties: tuple[tuple[str, ...], ...]
    misfit: float
    freedom: int

    @property
    def report(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "phases_rad": {pair: round(phase, 4) for pair, phase in self.phases_rad.items()},
            "left_out": dict(self.left_out),
            "why": dict(self.why),
            "agreeing": list(self.agreeing),
            "aligning_phase_rad": {pair: round(-one.phase_rad, 4) for pair, one in self.apart.items() if one.alignable},
            "unmeasured": dict(self.unmeasured),
            "ties": [list(tie) for tie in self.ties],
            "misfit": round(self.misfit, 2),
            "freedom": self.freedom,
        }


def choose_fusion(
    rank: Mapping[str, tuple[float, ...]],
    between: Mapping[tuple[str, str], Agreement | None],
    *,
    hidden: Collection[tuple[str, str]] = (),
    coarse: str = "",
    align: bool,
) -> CoherentSum:
    """Choose the pairs that add coherently: the largest set that agrees in phase and place.

    Parameters
    ----------
    rank
        Every pair → how well its image is focused, lower is better; it chooses among sets of equal size.
    between
        Two pairs, in the order of `rank` → how the second lies against the first; None where nothing tells.
    hidden
        Two pairs of which the second shows none of the bright points of the first, as it should: added it would be
        noise.
    coarse
        Why no two images could be compared, where their pixels are too wide for that.
    align
        Whether a constant phase is removed: members may then have any.

    Notes
    -----
    Source: docs/theory/fusion.md, eqs. 7 and 8.

    Examples
    --------
    >>> alone = choose_fusion({"a-a": (0,), "a-b": (1,)}, {("a-a", "a-b"): None}, align=False)
    >>> alone.phases_rad, alone.unmeasured
    ({'a-a': 0.0, 'a-b': 0.0}, {'a-b': 'it shares nothing with a-a that tells a phase'})
    """
    pairs = list(rank)
    compared = {two: one for two, one in between.items() if one is not None}
    measured = {two: one for two, one in compared.items() if one.certain or one.shifted or one.incoherent}
    best, rivals = _largest(pairs, rank, measured, align=align)
    reference = min(best.pairs, key=lambda pair: (*rank[pair], pairs.index(pair)))
    agreeing = tuple(pair for pair in pairs if pair in best.pairs)
    line = " and ".join(pair for pair in agreeing if pair != reference)
    phases, left_out, apart, unmeasured = {reference: 0.0}, {}, {}, {}
    why = {reference: f"it agrees with {line}" if line else "the others are measured against it"}
    for pair in pairs:
        if pair == reference:
            continue
        found = best.against(pair, measured, reference)
        if pair in best.pairs and found is not None:
            removed = found.phase_rad if align else 0.0
            phases[pair] = removed
            why[pair] = f"{_phase_line(found, reference)}{', taken off' if align else ''}"
        elif found is not None:
            apart[pair] = found
            left_out[pair] = _reason(found, _named(agreeing), reference, align=align)
        elif blind := [one for one in best.pairs if (one, pair) in hidden]:
            left_out[pair] = f"shows none of the bright points of {_named(blind)} beyond those expected by chance"
        else:
            phases[pair], guess = 0.0, best.against(pair, compared, reference)
            unmeasured[pair] = (
                coarse or f"it shares nothing with {_named(agreeing)} that tells a phase"
                if guess is None
                else f"{_phase_line(guess, reference)} is not certain enough"
            )
            why[pair] = f"phase not measured: {unmeasured[pair]}"
    opposite = [one.pairs for one in rivals if one.contradicts(best, measured)]
    ties = tuple(sorted(tuple(sorted(some, key=pairs.index)) for some in opposite))
    ordered = {pair: phases[pair] for pair in pairs if pair in phases}
    return CoherentSum(reference, ordered, left_out, why, agreeing, apart, unmeasured, ties, best.misfit, best.freedom)


def _named(pairs: Collection[str]) -> str:
    return " and ".join(pairs)


def _phase_line(found: Agreement, reference: str) -> str:
    ground = " of ground" if found.by == "looks" else ""
    return f"{found.phase_rad:+.2f} ± {found.phase_std_rad:.2f} rad from {reference} at {found.evidence}{ground}"


def _reason(found: Agreement, agreeing: str, reference: str, *, align: bool) -> str:
    if found.shifted:
        return f"its bright points lie {100 * found.shift_m:.1f} cm from those of {agreeing}"
    line = _phase_line(found, reference)
    if found.incoherent:
        return f"{line}, coherence {found.coherence:.2f}: no common phase"
    if align:
        return f"{line}: its differences from {agreeing} contradict each other"
    return f"{line}; would align with {-found.phase_rad:+.2f} rad: processing.fusion.align_phase takes it off"


@dataclass(frozen=True)
class _Set:
    """Pairs with one phase and place each, by least squares over what was measured between them.

    Attributes
    ----------
    pairs
        Of the set.
    states
        Pair → phase (radians), metres east and north, against the first.
    misfit, freedom
        χ² of what was measured, and its degrees of freedom.
    """

    pairs: frozenset[str]
    states: Mapping[str, NDArray[np.float64]]
    misfit: float
    freedom: int

    @classmethod
    def of(cls, pairs: Sequence[str], measured: Mapping[tuple[str, str], Agreement], *, align: bool) -> "_Set | None":
        """Return the pairs as a set; None where they contradict each other, or are not all connected."""
        edges = {two: one for two, one in measured.items() if two[0] in pairs and two[1] in pairs}
        if any(one.shifted or one.incoherent for one in edges.values()):
            return None
        start = _along(pairs, edges)
        if start is None:
            return None
        states, misfit, deviation = _adjusted(pairs, edges, start)
        freedom = 3 * (len(edges) - len(pairs) + 1)
        if freedom and misfit > _chi2_limit(freedom):
            return None
        found = cls(frozenset(pairs), dict(zip(pairs, states, strict=True)), misfit, freedom)
        within = all(
            abs(_wrapped(states[j, 0] - states[i, 0])) <= OUT_OF_PHASE_RAD + 2 * deviation[i, j]
            for i in range(len(pairs))
            for j in range(i)
        )
        return found if align or within else None

    def against(self, pair: str, measured: Mapping[tuple[str, str], Agreement], reference: str) -> Agreement | None:
        """Return the agreement of a pair with the set's reference, by all that was measured between it and the set.

        Phase and place are weighted means over the members; None where it was measured against none.
        """
        if pair in self.states and pair != reference:
            direct = agreement_between(measured, reference, pair)
            turned = self.states[pair] - self.states[reference]
            known = direct or next(one for two, one in measured.items() if pair in two and {*two} <= self.pairs)
            return replace(known, phase_rad=_wrapped(float(turned[0])))
        of_members = [
            (one, self.states[member] - self.states[reference])
            for member in self.pairs
            if member != pair and (one := agreement_between(measured, member, pair)) is not None
        ]
        if not of_members:
            return None
        phases = np.array([one.phase_rad + state[0] for one, state in of_members])
        weights = np.array([1 / one.phase_std_rad**2 for one, _ in of_members])
        phase = float(np.angle((weights * np.exp(1j * phases)).sum()))
        # Members see the outlier's own noise alike: their mean is taken for no more certain than the best of them.
        elsewhere = sum(one.shifted for one, _ in of_members) > len(of_members) / 2
        nearest = min((one for one, _ in of_members if one.shifted == elsewhere), key=lambda one: one.phase_std_rad)
        return replace(nearest, phase_rad=phase)

    def contradicts(self, other: "_Set", measured: Mapping[tuple[str, str], Agreement]) -> bool:
        """Test whether something was measured between pairs that only one of two sets holds."""
        return any(
            agreement_between(measured, one, two) is not None
            for one in self.pairs - other.pairs
            for two in other.pairs - self.pairs
        )


def _largest(
    pairs: Sequence[str],
    rank: Mapping[str, tuple[float, ...]],
    measured: Mapping[tuple[str, str], Agreement],
    *,
    align: bool,
) -> tuple[_Set, list[_Set]]:
    """Return the largest set that agrees, the best focused of several, and the others as large."""
    if len(pairs) > MOST_SETS_OF:
        pairs = _without_the_worst(pairs, measured, align=align)
    for size in range(len(pairs), 0, -1):
        found = [one for some in combinations(pairs, size) if (one := _Set.of(some, measured, align=align)) is not None]
        if found:
            found.sort(key=lambda one: np.sum([rank[pair] for pair in one.pairs], axis=0).tolist())
            return found[0], found[1:]
    raise ValueError("no pair: there is nothing to add")


def _without_the_worst(
    pairs: Sequence[str], measured: Mapping[tuple[str, str], Agreement], *, align: bool
) -> list[str]:
    """Return `MOST_SETS_OF` pairs: those dropped agree with the fewest others, two by two."""
    agreeing = {
        pair: sum(_Set.of(two, measured, align=align) is not None for two in combinations(pairs, 2) if pair in two)
        for pair in pairs
    }
    kept = sorted(pairs, key=lambda pair: -agreeing[pair])[:MOST_SETS_OF]
    return [pair for pair in pairs if pair in kept]


def agreement_between(between: Mapping[tuple[str, str], Agreement | None], first: str, second: str) -> Agreement | None:
    """Return the agreement of a second pair with a first, in whichever order they were compared; None: unknown.

    Examples
    --------
    >>> agreement_between({("a-a", "a-b"): None}, "a-b", "a-a") is None
    True
    """
    found = between.get((second, first))
    return between.get((first, second)) or (found and found.reversed)


def _along(pairs: Sequence[str], edges: Mapping[tuple[str, str], Agreement]) -> NDArray[np.float64] | None:
    """Return phases of pairs against the first, along the most certain differences; None where these leave one out."""
    phases = {pairs[0]: 0.0}
    for _ in pairs[1:]:
        open_ends = [
            (one.phase_std_rad, phases[known] + sign * one.phase_rad, new)
            for (first, second), one in edges.items()
            for known, new, sign in ((first, second, 1), (second, first, -1))
            if known in phases and new not in phases
        ]
        if not open_ends:
            return None
        _, phase, new = min(open_ends)
        phases[new] = phase
    return np.array([phases[pair] for pair in pairs])


def _adjusted(
    pairs: Sequence[str], edges: Mapping[tuple[str, str], Agreement], start: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Return (pair, 3) phase and place of each, χ², and (pair, pair) deviations of phase differences."""
    count = len(pairs)
    matrix, measured, std = np.zeros((len(edges), count)), np.zeros((len(edges), 3)), np.zeros((len(edges), 3))
    for line, ((first, second), one) in enumerate(edges.items()):
        i, j = pairs.index(first), pairs.index(second)
        matrix[line, [i, j]] = -1, 1
        measured[line] = _wrapped(one.phase_rad - (start[j] - start[i])), one.shift_east_m, one.shift_north_m
        std[line] = one.phase_std_rad, one.shift_std_m, one.shift_std_m
    # Weighted least squares of eq. 7: phase, east and north apart, the first pair fixed at 0.
    states, misfit, covariance = np.zeros((count, 3)), 0.0, np.zeros((count, count))
    for part in range(3):
        weighted = matrix[:, 1:] / std[:, part : part + 1]
        normal = np.linalg.pinv(weighted.T @ weighted)
        states[1:, part] = normal @ weighted.T @ (measured[:, part] / std[:, part])
        misfit += float((((measured - matrix @ states)[:, part] / std[:, part]) ** 2).sum())
        if part == 0:
            covariance[1:, 1:] = normal  # of the phases
    states[:, 0] += start
    variance = np.diag(covariance)
    return states, misfit, np.sqrt(np.maximum(variance[:, None] + variance - 2 * covariance, 0.0))


def _wrapped(phase_rad: float) -> float:
    return float(np.angle(np.exp(1j * phase_rad)))


def _chi2_limit(freedom: int) -> float:
    """Return the χ² exceeded once in 1000, by the cube root that is nearly normal (Wilson and Hilferty)."""
    part = 2 / (9 * freedom)
    return float(freedom * (1 - part + _SURE * np.sqrt(part)) ** 3)


# ---- Sums


def coherent_sum(
    images: NDArray[np.complex64], peaks: NDArray[np.float64], phases_rad: NDArray[np.float64] | float = 0.0
) -> NDArray[np.complex64]:
    """Return the complex mean of peak-normalised images.

    Their spectra lie side by side, so the sum resolves finer than either: mono- and bistatic images add in phase
    once sidelink and path offsets are right (docs/theory.md, eq. 7).

    Parameters
    ----------
    images
        (pair, y, x) complex64 on one grid or a block of it, carriers kept; NaN where no pulse of a pair illuminates
        the pixel: it adds nothing.
    peaks
        (pair,) float64, largest magnitude of each whole image.
    phases_rad
        (pair,) float64, removed from each image first.

    Returns
    -------
    ndarray
        (y, x) complex64, 1 where every image peaks in phase, NaN where no pair illuminates the pixel.

    Raises
    ------
    ValueError
        If an image is empty.

    Examples
    --------
    >>> coherent_sum(np.array([[[2.0, 0.0]], [[4.0j, 0.0]]], np.complex64), np.array([2.0, 4.0])).round(3)
    array([[0.5+0.5j, 0. +0.j ]], dtype=complex64)
    """
    rotation = np.exp(-1j * np.asarray(phases_rad)).astype(np.complex64)
    return np.asarray(_mean(_normalised(images, peaks) * rotation.reshape(-1, 1, 1)), np.complex64)


def noncoherent_sum(images: NDArray[np.complex64], peaks: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the mean power of peak-normalised images: no gain in resolution, less speckle, no phase errors.

    Parameters and errors as `coherent_sum`; returns (y, x) float32, linear power.

    Examples
    --------
    >>> noncoherent_sum(np.array([[[2.0, 1.0]], [[4.0j, 0.0]]], np.complex64), np.array([2.0, 4.0]))
    array([[1.   , 0.125]], dtype=float32)
    """
    power = np.abs(_normalised(images, peaks)).astype(np.float64) ** 2
    return np.asarray(_mean(power), np.float32)


def magnitude_sum(images: NDArray[np.complex64], peaks: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the mean magnitude of peak-normalised images, the paper's sum without phase.

    Parameters and errors as `coherent_sum`; returns (y, x) float32.

    Examples
    --------
    >>> magnitude_sum(np.array([[[2.0, 1.0]], [[4.0j, 0.0]]], np.complex64), np.array([2.0, 4.0]))
    array([[1.  , 0.25]], dtype=float32)
    """
    return np.asarray(_mean(np.abs(_normalised(images, peaks))), np.float32)


def _mean(images: NDArray[Any]) -> NDArray[Any]:
    """Return the mean over all pairs; one without a value at a pixel counts as zero, and NaN if none has one."""
    missing = np.isnan(images)
    mean: NDArray[Any] = np.where(missing, 0, images).mean(axis=0)
    mean[missing.all(axis=0)] = np.nan
    return mean


def _normalised(images: NDArray[np.complex64], peaks: NDArray[np.float64]) -> NDArray[np.complex64]:
    if not (peaks > 0).all():
        raise ValueError(f"{peaks=}: an empty image adds nothing; leave its pair out")
    # Part by part: numpy would divide complex numbers of double precision, ten times as long, to the same values.
    parts = np.ascontiguousarray(images, np.complex64).view(np.float32)
    return (parts * (1 / np.asarray(peaks, np.float64))[:, None, None]).astype(np.float32).view(np.complex64)
