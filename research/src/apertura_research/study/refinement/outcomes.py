"""What errors of the tracks cost, with and without refinement, per kind of scene."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.inputs import Refinement, TrackErrors
from apertura.methods.autofocus.refine import refine
from apertura_research.study.refinement.cases import Case, case
from apertura_research.study.refinement.measures import UNCORRECTED, judge
from apertura_research.study.refinement.scenes import GRID

KINDS: Mapping[str, str] = {
    "five": "the paper's five points",
    "forty": "forty points",
    "texture": "texture",
    "dense": "fully developed speckle",
}
"""Rows of `SCENES` that are tried → how charts call them."""

SIGMAS_CM = (0.0, 0.5, 1.0, 2.0, 3.0, 5.0)
SEEDS = (1, 2, 3)
SNR_DB = 10.0

LEAST_STATED_M = 0.005
"""Logs without error are said to have this: with less no refinement is asked for."""

ACCEPTED, FLAGGED, REFUSED, TOO_FEW = "accepted", "accepted with a flag", "refused", "refused: too few points"
SAID = (ACCEPTED, FLAGGED, REFUSED, TOO_FEW)


@dataclass(frozen=True)
class Outcome:
    """What errors of one size did to one case, mono- and bistatic pair together: a row of the CSV.

    Attributes
    ----------
    loss_db, product_loss_db, found_loss_db
        Mean over the probes, which no refinement sees, against the true tracks; positive where peaks are too low:
        of the logs, of what the product makes the image from, and of what was found, accepted or not.
    said
        One of `SAID`.
    flags, why
        As the product wrote them.
    """

    scene: str
    sigma_cm: float
    seed: int
    loss_db: float
    product_loss_db: float
    found_loss_db: float
    said: str
    flags: str
    why: str


def run_kind(scene: str, *, sigmas_cm: Sequence[float] = SIGMAS_CM, seeds: Sequence[int] = SEEDS) -> Iterator[Outcome]:
    """Yield the outcome of each size and seed on one scene of `KINDS`, both pairs past it together.

    Tracks of a seed are the same in every scene and in every size but for their scale.
    """
    for sigma_cm in sigmas_cm:
        for seed in seeds:
            one = drawn(scene, sigma_cm, seed)
            yield outcome_of(one, refined(one))


def drawn(scene: str, sigma_cm: float, seed: int) -> Case:
    """Return one case of the sweep."""
    return case(scene, "straight", "joint", sigma_cm / 100, SNR_DB, seed)


def refined(one: Case) -> Refinement:
    """Return what the product makes of a case whose errors are stated as they are."""
    return refine(one.records, GRID, FlatGround(0.0), {node: _stated(known) for node, known in one.errors.items()})


def _stated(known: TrackErrors) -> TrackErrors:
    east, north, up = (max(std_m, LEAST_STATED_M) for std_m in known.std_m)
    return replace(known, std_m=(east, north, up))


def outcome_of(one: Case, found: Refinement) -> Outcome:
    """Return what a refinement leaves of a case's loss, and what was said of it."""
    before, after = (0.0 - judge(one, tracks).probe_loss_db for tracks in (UNCORRECTED, found.correction))
    return Outcome(
        scene=one.name[0],
        sigma_cm=round(100 * one.name[3], 6),
        seed=one.name[5],
        loss_db=round(before, 4),
        product_loss_db=round(after if found.accepted else before, 4),
        found_loss_db=round(after, 4),
        said=said_of(found),
        flags=" ".join(found.flags),
        why=found.why,
    )


def said_of(found: Refinement) -> str:
    """Return what the product said of a refinement, one of `SAID`.

    Examples
    --------
    >>> import numpy as np
    >>> from apertura.core.geometry.phase_centres import TrackCorrection
    >>> nothing = TrackCorrection(np.zeros(1), {})
    >>> said_of(Refinement(nothing, {}, True, "", flags={"prior_inconsistent": "twice as large"}))
    'accepted with a flag'
    """
    if found.accepted:
        return FLAGGED if found.flags else ACCEPTED
    return TOO_FEW if "refinement_too_few_patches" in found.flags else REFUSED
