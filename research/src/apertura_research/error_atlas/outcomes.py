"""What each size of a cause did to the images of the atlas, what the budget had expected, and which flags came."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.pipeline.opening.plan import arithmetic_line
from apertura_research.error_atlas.causes import CAUSES
from apertura_research.error_atlas.flight import GRID, PAIRS, Flight, Heard, Told
from apertura_research.error_atlas.images import Seen, decibels, look


@dataclass(frozen=True)
class Outcome:
    """One draw of one size of one cause: a row of the CSV.

    Attributes
    ----------
    pair
        For which the budget expects more, the monostatic where it expects nothing: losses and shifts are its.
    loss_db, shift_m
        Mean over the five targets, against the same draw with nothing wrong.
    phase_rad
        Between both pairs halfway between their peaks, against the same draw with nothing wrong.
    ghost_db
        How much brighter, against the brightest target, the brightest pixel became that is 1.5 m from all of them.
    cell_m
        Resolution cell.
    expected_loss_db, expected_shift_m, expected_phase_rad
        By the budget when the size is stated; arithmetic as measured.
    flags
        Names of what was raised on either pair, with blanks between; `refused`: an error instead of an image, whose
        losses are NaN.
    """

    cause: str
    unit: str
    size: float
    draw: int
    pair: str
    loss_db: float
    shift_m: float
    phase_rad: float
    ghost_db: float
    cell_m: float
    expected_loss_db: float
    expected_shift_m: float
    expected_phase_rad: float
    flags: str


def run_cause(name: str, *, seed: int = 1) -> Iterator[Outcome]:
    """Yield every draw at each size of one of `CAUSES`; every size meets the same random numbers."""
    cause = CAUSES[name]
    flown = cause.flight()
    for draw in range(cause.draws):
        generator = np.random.default_rng([seed, draw])
        heard = {pair: flown.hear(pair, generator) for pair in PAIRS}
        right = look(flown, flown.truth, heard)
        for size in cause.sizes:
            told = cause.tell(flown, size, np.random.default_rng([seed, draw, 1]))
            yield _outcome(name, size, draw, right, _looked(flown, told, heard))


def _looked(flown: Flight, told: Told, heard: dict[str, Heard]) -> dict[str, Seen] | None:
    try:
        return look(flown, told, heard)
    except CampaignError:
        return None


def _outcome(name: str, size: float, draw: int, right: dict[str, Seen], wrong: dict[str, Seen] | None) -> Outcome:
    cause = CAUSES[name]
    effects = {pair: cause.expect(cause.flight(), pair, size) for pair in PAIRS}
    pair = min(PAIRS, key=lambda one: (effects[one].loss_db, -effects[one].shift_m))
    loss_db, shift_m, phase_rad, ghost_db = (np.nan,) * 4 if wrong is None else _harm(right, wrong, pair)
    arithmetic_db = 0.0 if wrong is None else arithmetic_line(wrong[pair].error_db).effect.loss_db
    flags = {"refused"} if wrong is None else {flag for one in wrong.values() for flag in one.flags}
    return Outcome(
        cause=name,
        unit=cause.unit,
        size=float(size),
        draw=draw,
        pair=pair,
        loss_db=_sum_loss_db(right, wrong) if cause.added and wrong else loss_db,
        shift_m=shift_m,
        phase_rad=phase_rad,
        ghost_db=ghost_db,
        cell_m=right[pair].focus["cell_m"],
        expected_loss_db=-effects[pair].loss_db - arithmetic_db,
        expected_shift_m=effects[pair].shift_m,
        expected_phase_rad=max(effect.phase_rad for effect in effects.values()),
        flags=" ".join(sorted(flags)),
    )


def _harm(right: dict[str, Seen], wrong: dict[str, Seen], pair: str) -> tuple[float, float, float, float]:
    """Return loss (dB), shift (m), phase (rad) and rise of ghosts (dB)."""
    loss_db = -float(decibels(wrong[pair].peaks[:, 2] / right[pair].peaks[:, 2]).mean())
    moved = (wrong[pair].peaks - right[pair].peaks)[:, :2] * GRID.spacing_m
    before, after = _phasors(right), _phasors(wrong)
    turned = ((after[1] * after[0].conj()) * (before[1] * before[0].conj()).conj()).sum()
    ghost_db = max(wrong[one].ghost_db - right[one].ghost_db for one in PAIRS)
    return loss_db, float(np.hypot(*moved.T).mean()), float(abs(np.angle(turned))), ghost_db


def _sum_loss_db(right: dict[str, Seen], wrong: dict[str, Seen]) -> float:
    """Return the loss of the coherent sum of both pairs, dB, mean over the targets."""
    before, after = (np.abs(_phasors(seen).sum(axis=0)) for seen in (right, wrong))
    return -float(decibels(after / before).mean())


def _phasors(seen: dict[str, Seen]) -> NDArray[np.complex128]:
    """Return (pair, target) complex128, both images halfway between their peaks."""
    middle = np.mean([one.peaks[:, :2] for one in seen.values()], axis=0)
    return np.array([one.at(middle[:, :1], middle[:, 1:])[:, 0] for one in seen.values()], np.complex128)
