"""The tables of the atlas: what each cause costs, when its flag comes, and how often flags are missing or false."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from apertura.common.tables import read_table, write_table
from apertura_research.error_atlas.causes import CAUSES
from apertura_research.error_atlas.outcomes import Outcome
from apertura_research.study.stability.summary import crossing

HARMFUL_DB, HARMFUL_CELLS = 1.0, 0.5
"""An image that lost more, or lies further off, is wrong: without a flag, an alarm is missed."""

HARMLESS_DB, HARMLESS_CELLS, HARMLESS_RAD, HARMLESS_GHOST_DB = 0.3, 0.1, 0.3, 3.0
"""An image with less of all of these is right: with a flag, an alarm is false."""

_TELLING_DB = 0.5
"""Losses above which the ratio of expected to measured loss is formed."""


@dataclass(frozen=True)
class Summary:
    """What the sweep of one cause came to: a row of summary.csv.

    Attributes
    ----------
    size_at_1_db, expected_at_1_db
        Where the mean loss measured, and the loss expected, pass 1 dB, interpolated; NaN: nowhere in the sweep.
    size_of_harm
        The first size at which most draws are wrong: more than 1 dB or half a cell.
    size_of_flag
        The first size at which most draws have a flag.
    expected_over_measured
        Of the losses in dB, mean over the sizes that cost more than 0.5 dB; of the shifts where none does: more than a
        tenth of a cell.
    ratio_of
        loss, shift or nothing.
    wrong, missed
        Draws that are wrong, and the share of them without a flag.
    right, false
        Draws that are right, and the share of them with a flag.
    flags
        Raised at any size, with blanks between.
    """

    cause: str
    unit: str
    size_at_1_db: float
    expected_at_1_db: float
    size_of_harm: float
    size_of_flag: float
    expected_over_measured: float
    ratio_of: str
    wrong: int
    missed: float
    right: int
    false: float
    flags: str
    draws: int


@dataclass(frozen=True)
class Alarm:
    """How well one flag tells: a row of flags.csv.

    Attributes
    ----------
    raised
        Draws of all causes with it.
    wrong, missed
        Draws that are wrong by causes that raise it at some size, and the share of them without it.
    unsaid
        The share of the same without any flag.
    right, false
        Draws of all causes that are right, and the share of them with it.
    """

    flag: str
    raised: int
    wrong: int
    missed: float
    unsaid: float
    right: int
    false: float


def is_wrong(one: Outcome) -> bool:
    """Return whether the image of a draw should have a flag."""
    return one.loss_db > HARMFUL_DB or one.shift_m > HARMFUL_CELLS * one.cell_m


def is_right(one: Outcome) -> bool:
    """Return whether the image of a draw should have none."""
    return (
        one.loss_db < HARMLESS_DB
        and one.shift_m < HARMLESS_CELLS * one.cell_m
        and one.phase_rad < HARMLESS_RAD
        and one.ghost_db < HARMLESS_GHOST_DB
    )


def by_size(outcomes: Sequence[Outcome]) -> dict[float, list[Outcome]]:
    """Return size → its draws, in the order of the sweep."""
    sizes = dict.fromkeys(one.size for one in outcomes)
    return {size: [one for one in outcomes if one.size == size] for size in sizes}


def mean_of(some: Sequence[Outcome], name: str) -> float:
    """Return the mean of one column over draws that were not refused; NaN without any."""
    values = [value for one in some if np.isfinite(value := getattr(one, name))]
    return float(np.mean(values)) if values else float("nan")


def summary_of(outcomes: Sequence[Outcome]) -> Summary:
    """Return what the draws of one cause come to.

    Parameters
    ----------
    outcomes
        Every draw of every size of one cause, sizes in the order of the sweep in each draw.
    """
    first, groups = outcomes[0], by_size(outcomes)
    sizes = np.array(list(groups))
    measured, expected = (
        np.array([mean_of(some, name) for some in groups.values()]) for name in ("loss_db", "expected_loss_db")
    )
    ratio, ratio_of = _ratio(groups)
    wrong, right = [one for one in outcomes if is_wrong(one)], [one for one in outcomes if is_right(one)]
    return Summary(
        first.cause,
        first.unit,
        _rounded(crossing(sizes, measured, 1.0, logarithmic=True)),
        _rounded(crossing(sizes, expected, 1.0, logarithmic=True)),
        _first(groups, is_wrong),
        _first(groups, lambda one: bool(one.flags)),
        round(ratio, 3),
        ratio_of,
        len(wrong),
        share(wrong, lambda one: not one.flags),
        len(right),
        share(right, lambda one: bool(one.flags)),
        " ".join(sorted({flag for one in outcomes for flag in one.flags.split()})),
        len(outcomes),
    )


def alarms(outcomes: Sequence[Outcome]) -> list[Alarm]:
    """Return how well each flag tells, over every draw of every cause."""
    right = [one for one in outcomes if is_right(one)]
    rows = []
    for flag in sorted({flag for one in outcomes for flag in one.flags.split()}):
        raises = partial(_raises, flag)
        raised = [one for one in outcomes if raises(one)]
        causes = {one.cause for one in raised}
        wrong = [one for one in outcomes if one.cause in causes and is_wrong(one)]
        rows.append(
            Alarm(
                flag,
                len(raised),
                len(wrong),
                1 - share(wrong, raises),
                share(wrong, lambda one: not one.flags),
                len(right),
                share(right, raises),
            )
        )
    return rows


def share(some: Sequence[Outcome], holds: Callable[[Outcome], bool]) -> float:
    """Return the share of draws of which something holds; NaN without any."""
    return _rounded(np.mean([holds(one) for one in some])) if some else float("nan")


def part_path(folder: Path, cause: str) -> Path:
    """Return where one job of the atlas writes."""
    return folder / "parts" / f"{cause}.csv"


def write_summary(folder: Path) -> list[Summary]:
    """Write summary.csv and flags.csv from the tables of every cause, and return the rows of the first."""
    parts = {cause: read_table(part_path(folder, cause), Outcome) for cause in CAUSES}
    rows = [summary_of(outcomes) for outcomes in parts.values()]
    write_table(folder / "flags.csv", alarms([one for outcomes in parts.values() for one in outcomes]))
    write_table(folder / "summary.csv", rows)
    return rows


def _ratio(groups: dict[float, list[Outcome]]) -> tuple[float, str]:
    """Return expected over measured, and of what."""
    cell_m = next(iter(groups.values()))[0].cell_m
    for what, name, least in (("loss", "loss_db", _TELLING_DB), ("shift", "shift_m", HARMLESS_CELLS * cell_m)):
        ratios = []
        for some in groups.values():
            measured = mean_of(some, name)
            if measured > least:
                ratios.append(mean_of(some, f"expected_{name}") / measured)
        if ratios:
            return float(np.mean(ratios)), what
    return float("nan"), "nothing"


def _raises(flag: str, one: Outcome) -> bool:
    return flag in one.flags.split()


def _first(groups: dict[float, list[Outcome]], holds: Callable[[Outcome], bool]) -> float:
    """Return the first size at which most draws hold; NaN where none does."""
    return next((size for size, some in groups.items() if np.mean([holds(one) for one in some]) > 0.5), float("nan"))


def _rounded(value: float | np.floating) -> float:
    return float(f"{value:.4g}")
