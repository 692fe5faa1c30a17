"""Pictures of the atlas: one per cause, and one of them all."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from apertura.views.chart.png import save_png
from apertura_research.error_atlas.causes import CAUSES
from apertura_research.error_atlas.outcomes import Outcome
from apertura_research.error_atlas.summary import HARMFUL_CELLS, HARMFUL_DB, Summary, by_size, mean_of

_MEASURED, _EXPECTED, _FLAGGED = "#0072b2", "#d55e00", "#cc0000"
_LEAST = {"loss_db": 0.01, "shift_m": 0.05, "phase_rad": 0.01}
"""Smaller values are drawn at the lower edge, in the unit of the axis."""


def draw_cause(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw loss, shift and phase against the size of one cause: measured, expected, and where a flag came."""
    cause, cell_m = CAUSES[outcomes[0].cause], outcomes[0].cell_m
    figure = Figure(figsize=(12.5, 4.6), layout="constrained")
    panels = (
        ("loss_db", 1.0, "Loss of the coherent sum, dB" if cause.added else "Loss of peak, dB", HARMFUL_DB, "1 dB"),
        ("shift_m", 100.0, "Shift over ground, cm", 100 * HARMFUL_CELLS * cell_m, "half a cell"),
        ("phase_rad", 1.0, "Phase between the pairs, rad", None, ""),
    )
    every = figure.subplots(1, len(panels))
    for axes, (name, scale, label, limit, words) in zip(every, panels, strict=True):
        _draw_panel(axes, outcomes, name, scale)
        axes.set_ylabel(label)
        axes.set_xlabel(f"{cause.title}, {cause.unit}" if cause.unit != "1" else cause.title, fontsize=9)
        if limit is not None:
            axes.set_ylim(top=max(axes.get_ylim()[1], 2 * limit))
            axes.axhline(limit, color="0.4", linewidth=0.9, linestyle=":")
            axes.annotate(words, (0.01, limit), xycoords=("axes fraction", "data"), va="bottom", fontsize=8)
    figure.legend(*every[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    names = " ".join(sorted({flag for one in outcomes for flag in one.flags.split()})) or "none"
    figure.suptitle(
        f"{cause.title} — stated to the budget as: {cause.stated}\n"
        f"flags: {names}; what is too small for an axis stands on its edge",
        fontsize=10,
    )
    save_png(figure, path)


def _draw_panel(axes: Axes, outcomes: Sequence[Outcome], name: str, scale: float) -> None:
    groups, least = by_size([one for one in outcomes if np.isfinite(getattr(one, name))]), _LEAST[name]
    sizes = np.array(list(groups))
    drawn = [np.maximum(scale * np.array([getattr(one, name) for one in some]), least) for some in groups.values()]
    means = np.array([max(scale * mean_of(some, name), least) for some in groups.values()])
    ends = np.abs([[some.min(), some.max()] for some in drawn] - means[:, None]).T
    axes.errorbar(
        sizes, means, ends, color=_MEASURED, marker="o", capsize=3, label="measured: mean, least and most of the draws"
    )
    expected = [mean_of(some, f"expected_{name}") for some in groups.values()]
    axes.plot(
        sizes,
        np.maximum(scale * np.array(expected), least),
        color=_EXPECTED,
        linestyle="--",
        zorder=3,
        label="expected by budget",
    )
    shares = np.array([np.mean([bool(one.flags) for one in some]) for some in groups.values()])
    for most, label in ((True, "flag in most draws"), (False, "flag in some")):
        at = (shares > 0.5) if most else (shares > 0) & (shares <= 0.5)
        face = _FLAGGED if most else "none"
        axes.plot(
            sizes[at], means[at], "s", markersize=11, color=_FLAGGED, markerfacecolor=face, alpha=0.55, label=label
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.8 * least)
    axes.set_xticks(sizes, [f"{size:g}" for size in sizes], fontsize=8)
    axes.set_xticks([], minor=True)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.grid(which="major", alpha=0.3)
    if sizes[0] > sizes[-1]:
        axes.invert_xaxis()


def draw_summary(rows: Sequence[Summary], path: Path) -> None:
    """Draw a table: per cause where harm and flag begin, how well it was expected, which alarms fail."""
    figure = Figure(figsize=(14, 0.42 * len(rows) + 2.2), layout="constrained")
    axes = figure.subplots()
    headings = (
        "1 dB lost at", "1 dB expected at", "wrong from", "flag from", "expected /\nmeasured", "alarms missed",
        "alarms false",
    )  # fmt: skip
    axes.imshow(
        [[_colour(row, number) for number in range(len(headings))] for row in rows],
        cmap="RdYlGn", vmin=0, vmax=1, aspect="auto", alpha=0.7,
    )  # fmt: skip
    for number, row in enumerate(rows):
        for column, words in enumerate(_words(row)):
            axes.text(column, number, words, ha="center", va="center", fontsize=9)
    axes.set_xticks(range(len(headings)), headings)
    titles = [CAUSES[row.cause].title + (f", {row.unit}" if row.unit != "1" else "") for row in rows]
    axes.set_yticks(range(len(rows)), titles)
    axes.tick_params(labeltop=True, labelbottom=False, length=0)
    axes.set_title(
        "What spoils an image, and whether it is said. Wrong: more than 1 dB or half a cell; right: less than 0.3 dB,\n"
        "a tenth of a cell, 0.3 rad and 3 dB of ghosts. Missed: wrong without a flag; false: right with one.",
        fontsize=10, pad=14,
    )  # fmt: skip
    save_png(figure, path)


def _words(row: Summary) -> list[str]:
    def size(value: float) -> str:
        return "—" if np.isnan(value) else f"{float(f'{value:.3g}'):g}"

    def rate(value: float, count: int) -> str:
        return "—" if not count else f"{100 * value:.0f} % of {count}"

    ratio = "—" if np.isnan(row.expected_over_measured) else f"{row.expected_over_measured:.2f} ({row.ratio_of})"
    sizes = (row.size_at_1_db, row.expected_at_1_db, row.size_of_harm, row.size_of_flag)
    return [*map(size, sizes), ratio, rate(row.missed, row.wrong), rate(row.false, row.right)]


def _colour(row: Summary, column: int) -> float:
    """Return how good a cell is, 0…1; NaN where it is neither."""
    ratio = row.expected_over_measured
    if column == 4 and ratio > 0:
        return float(np.clip(1 - abs(np.log(ratio)) / np.log(3), 0, 1))
    if column == 4 and ratio == 0:
        return 0.0
    return {5: 1 - row.missed, 6: 1 - row.false}.get(column, float("nan"))
