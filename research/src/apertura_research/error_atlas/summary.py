"""The error atlas as a study: its parts, its tables of losses and flags, and its charts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from apertura.common.tables import write_table
from apertura_research.error_atlas.causes import CAUSES
from apertura_research.error_atlas.outcomes import ErrorAtlasRow, draws_of, run_draw
from apertura_research.sweep import Study, crossing, draw_table, order_sizes, panels, with_unit

HARMFUL_DB, HARMFUL_CELLS = 1.0, 0.5
"""Peak loss or displacement above which an image is wrong; a wrong image without a flag counts as a missed alarm."""

HARMLESS_DB, HARMLESS_CELLS, HARMLESS_RAD, HARMLESS_GHOST_DB = 0.3, 0.1, 0.3, 3.0
"""An image below all these limits is right; a right image with a flag counts as a false alarm."""

_MEASURABLE_DB = 0.5
"""Smallest loss for which the ratio of expected to measured loss is computed."""


@dataclass(frozen=True)
class CauseSummary:
    """Result of the sweep of one cause: a row of summary.csv.

    Attributes
    ----------
    size_at_1_db, expected_at_1_db
        Interpolated sizes at which the mean measured loss and the expected loss exceed 1 dB; NaN: not in the sweep.
    size_of_harm
        The first size at which most draws are wrong: more than 1 dB or half a resolution cell.
    size_of_flag
        The first size at which most draws have a flag.
    expected_over_measured
        Ratio of losses in dB, averaged over the sizes with a loss above 0.5 dB; if there are none, ratio of
        displacements, averaged over displacements of more than a tenth of a resolution cell.
    ratio_of
        Quantity of the ratio: loss, shift or nothing.
    wrong, missed
        Number of wrong draws, and the fraction of wrong draws without a flag.
    right, false
        Number of right draws, and the fraction of right draws with a flag.
    flags
        Flags raised at any size, separated by blanks.
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
    """Reliability of one flag as a warning: a row of flags.csv.

    Attributes
    ----------
    raised
        Number of draws of all causes with the flag.
    wrong, missed
        Number of wrong draws of the causes that raise the flag at any size, and the fraction of these draws without the
        flag.
    unflagged
        Fraction of these wrong draws without any flag.
    right, false
        Number of right draws of all causes, and the fraction of these draws with the flag.
    """

    flag: str
    raised: int
    wrong: int
    missed: float
    unflagged: float
    right: int
    false: float


def is_wrong(one: ErrorAtlasRow) -> bool:
    """Return True if the image of a draw should have a flag."""
    return one.loss_db > HARMFUL_DB or one.shift_m > HARMFUL_CELLS * one.cell_m


def is_right(one: ErrorAtlasRow) -> bool:
    """Return True if the image of a draw should have no flag."""
    return (
        one.loss_db < HARMLESS_DB
        and one.shift_m < HARMLESS_CELLS * one.cell_m
        and one.phase_rad < HARMLESS_RAD
        and one.ghost_db < HARMLESS_GHOST_DB
    )


def by_size(outcomes: Sequence[ErrorAtlasRow]) -> dict[float, list[ErrorAtlasRow]]:
    """Group draws by size, in the order of the sweep."""
    sizes = dict.fromkeys(one.size for one in outcomes)
    return {size: [one for one in outcomes if one.size == size] for size in sizes}


def mean_of(rows: Sequence[ErrorAtlasRow], name: str) -> float:
    """Return the mean of one column over the draws that were not refused; NaN if all were refused."""
    values = [value for row in rows if np.isfinite(value := getattr(row, name))]
    return float(np.mean(values)) if values else float("nan")


def summary_of(outcomes: Sequence[ErrorAtlasRow]) -> CauseSummary:
    """Summarise the draws of one cause.

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
    return CauseSummary(
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


def alarms(outcomes: Sequence[ErrorAtlasRow]) -> list[Alarm]:
    """Return the reliability of each flag as a warning, over every draw of every cause."""
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


def share(rows: Sequence[ErrorAtlasRow], condition: Callable[[ErrorAtlasRow], bool]) -> float:
    """Return the fraction of draws that meet a condition; NaN if there are no draws."""
    return _rounded(np.mean([condition(row) for row in rows])) if rows else float("nan")


def summarise(outcomes: Sequence[ErrorAtlasRow], folder: Path) -> None:
    """Write summary.csv and summary.png, a row per cause, and flags.csv, the reliability of each flag."""
    rows = [summary_of([one for one in outcomes if one.cause == cause]) for cause in CAUSES]
    write_table(folder / "flags.csv", alarms(outcomes))
    write_table(folder / "summary.csv", rows)
    draw_summary(rows, folder / "summary.png")


def _ratio(groups: dict[float, list[ErrorAtlasRow]]) -> tuple[float, str]:
    """Return the mean ratio of expected to measured effect, and the name of the quantity."""
    cell_m = next(iter(groups.values()))[0].cell_m
    for what, name, least in (("loss", "loss_db", _MEASURABLE_DB), ("shift", "shift_m", HARMLESS_CELLS * cell_m)):
        ratios = []
        for some in groups.values():
            measured = mean_of(some, name)
            if measured > least:
                ratios.append(mean_of(some, f"expected_{name}") / measured)
        if ratios:
            return float(np.mean(ratios)), what
    return float("nan"), "nothing"


def _raises(flag: str, one: ErrorAtlasRow) -> bool:
    return flag in one.flags.split()


def _first(groups: dict[float, list[ErrorAtlasRow]], condition: Callable[[ErrorAtlasRow], bool]) -> float:
    """Return the first size at which most draws meet a condition; NaN if there is none."""
    return next(
        (size for size, rows in groups.items() if np.mean([condition(row) for row in rows]) > 0.5), float("nan")
    )


def _rounded(value: float | np.floating) -> float:
    return float(f"{value:.4g}")


_MEASURED, _EXPECTED, _FLAGGED = "#0072b2", "#d55e00", "#cc0000"
_LEAST = {"loss_db": 0.01, "shift_m": 0.05, "phase_rad": 0.01}
"""Lower ends of the axes, in their units; smaller values are drawn there."""


def draw_cause(name: str, outcomes: Sequence[ErrorAtlasRow], path: Path) -> None:
    """Draw measured and expected loss, displacement and phase against the size of one cause, and mark raised flags."""
    cause, cell_m = CAUSES[name], outcomes[0].cell_m
    quantities = (
        ("loss_db", 1.0, "Loss of the coherent sum, dB" if cause.added else "Peak loss, dB", HARMFUL_DB, "1 dB"),
        ("shift_m", 100.0, "Horizontal displacement, cm", 100 * HARMFUL_CELLS * cell_m, "half a resolution cell"),
        ("phase_rad", 1.0, "Phase difference between the pairs, rad", None, ""),
    )
    names = " ".join(sorted({flag for one in outcomes for flag in one.flags.split()})) or "none"
    title = (
        f"{cause.title} — line of the error budget: {cause.stated}\n"
        f"flags: {names}; values below an axis are drawn at its lower end"
    )
    with panels(path, (12.5, 4.6), (1, len(quantities)), title=title) as every:
        for axes, (quantity, scale, label, limit, text) in zip(every, quantities, strict=True):
            _draw_panel(axes, outcomes, quantity, scale)
            axes.set_ylabel(label)
            axes.set_xlabel(with_unit(cause.title, cause.unit), fontsize=9)
            if limit is not None:
                axes.set_ylim(top=max(axes.get_ylim()[1], 2 * limit))
                axes.axhline(limit, color="0.4", linewidth=0.9, linestyle=":")
                axes.annotate(text, (0.01, limit), xycoords=("axes fraction", "data"), va="bottom", fontsize=8)


def _draw_panel(axes: Axes, outcomes: Sequence[ErrorAtlasRow], name: str, scale: float) -> None:
    groups, least = by_size([one for one in outcomes if np.isfinite(getattr(one, name))]), _LEAST[name]
    sizes = np.array(list(groups))
    drawn = [np.maximum(scale * np.array([getattr(one, name) for one in some]), least) for some in groups.values()]
    means = np.array([max(scale * mean_of(some, name), least) for some in groups.values()])
    ends = np.abs([[some.min(), some.max()] for some in drawn] - means[:, None]).T
    axes.errorbar(
        sizes, means, ends, color=_MEASURED, marker="o", capsize=3, label="measured: mean, minimum, maximum of draws"
    )
    expected = [mean_of(some, f"expected_{name}") for some in groups.values()]
    axes.plot(
        sizes,
        np.maximum(scale * np.array(expected), least),
        color=_EXPECTED,
        linestyle="--",
        zorder=3,
        label="expected by the budget",
    )
    shares = np.array([np.mean([bool(one.flags) for one in some]) for some in groups.values()])
    for most, label in ((True, "flag in most draws"), (False, "flag in fewer draws")):
        at = (shares > 0.5) if most else (shares > 0) & (shares <= 0.5)
        face = _FLAGGED if most else "none"
        axes.plot(
            sizes[at], means[at], "s", markersize=11, color=_FLAGGED, markerfacecolor=face, alpha=0.55, label=label
        )
    order_sizes(axes, sizes, logarithmic=True)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.8 * least)
    axes.set_xticks(sizes, [f"{size:g}" for size in sizes], fontsize=8)
    axes.set_xticks([], minor=True)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.grid(which="major", alpha=0.3)


def draw_summary(rows: Sequence[CauseSummary], path: Path) -> None:
    """Draw a table: per cause, sizes of first loss and first flag, expected over measured effect, and alarm rates."""
    headings = (
        "1 dB loss at", "1 dB expected at", "wrong from", "flag from", "expected /\nmeasured", "missed alarms",
        "false alarms",
    )  # fmt: skip
    draw_table(
        path,
        [_texts(row) for row in rows],
        [[_colour(row, column) for column in range(len(headings))] for row in rows],
        ([with_unit(CAUSES[row.cause].title, row.unit) for row in rows], headings),
        title="Causes of image errors and their flags. Wrong: more than 1 dB or half a resolution cell; right: less\n"
        "than 0.3 dB, a tenth of a cell, 0.3 rad and 3 dB of ghosts. Missed: wrong, no flag; false: right with a flag.",
    )


def _texts(row: CauseSummary) -> list[str]:
    def size(value: float) -> str:
        return "—" if np.isnan(value) else f"{float(f'{value:.3g}'):g}"

    def rate(value: float, count: int) -> str:
        return "—" if not count else f"{100 * value:.0f} % of {count}"

    ratio = "—" if np.isnan(row.expected_over_measured) else f"{row.expected_over_measured:.2f} ({row.ratio_of})"
    sizes = (row.size_at_1_db, row.expected_at_1_db, row.size_of_harm, row.size_of_flag)
    return [*map(size, sizes), ratio, rate(row.missed, row.wrong), rate(row.false, row.right)]


def _colour(row: CauseSummary, column: int) -> float:
    """Return the rating of a table cell, 0…1; NaN for columns without a rating."""
    ratio = row.expected_over_measured
    if column == 4 and ratio > 0:
        return float(np.clip(1 - abs(np.log(ratio)) / np.log(3), 0, 1))
    if column == 4 and ratio == 0:
        return 0.0
    return {5: 1 - row.missed, 6: 1 - row.false}.get(column, float("nan"))


STUDY = Study(
    row=ErrorAtlasRow,
    charts={cause: (cause,) for cause in CAUSES},
    cases=draws_of,
    run=run_draw,
    draw=draw_cause,
    summaries=("summary.csv", "summary.png", "flags.csv"),
    summarise=summarise,
    digits=6,
)
"""A part is a cause; a case is a draw, at every size of the cause."""
