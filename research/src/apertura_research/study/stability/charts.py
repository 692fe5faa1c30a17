"""Charts of the stability study: one per impairment, and one of them all."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from apertura.views.chart.png import save_png
from apertura_research.study.stability.outcomes import Outcome
from apertura_research.study.stability.summary import LEVELS_DB, Tolerance
from apertura_research.study.stability.sweeps import CHOICES, SWEEPS

LOSS_RANGE_DB = (-1.0, 25.0)
_STYLES = {
    "none": ("#000000", "o", "--"),
    "divide": ("#0072b2", "s", "-"),
    "wiener": ("#56b4e9", "^", "-"),
    "two_parameter": ("#d55e00", "D", "-"),
    "gated": ("#009e73", "v", "-"),
    "auto": ("#cc79a7", "", "-"),
}


def draw_impairment(impairment: str, outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw loss, coherence factor and widths against the size of one impairment."""
    sweep = SWEEPS[impairment]
    figure = Figure(figsize=(10, 7.5), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    panels = (
        ("loss_db", 1.0, "Peak loss, dB (mean of five targets)"),
        ("coherence_factor", 1.0, "Coherence factor"),
        ("cross_width_m", 100.0, "Cross-range width at −3 dB, cm"),
        ("floor_db", 1.0, "Error floor against the peaks, dB"),
    )
    for axis, (name, scale, label) in zip(axes.flat, panels, strict=True):
        for method in CHOICES:
            rows = [one for one in outcomes if one.method == method]
            _draw_line(axis, method, [one.size for one in rows], [scale * getattr(one, name) for one in rows])
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    _mark_losses(axes[0, 0])
    axes[0, 1].set_ylim(0, 1.03)
    axes[1, 1].set_ylim(top=5)
    if sweep.logarithmic:
        axes[0, 0].set_xscale("log")
    if sweep.sizes[0] > sweep.sizes[-1]:
        axes[0, 0].invert_xaxis()
    for axis in axes[1]:
        axis.set_xlabel(f"{sweep.title}, {sweep.unit}" if sweep.unit != "1" else sweep.title)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(CHOICES))
    figure.suptitle(sweep.title)
    save_png(figure, path)


def _draw_line(axis: Axes, method: str, sizes: list[float], values: list[float]) -> None:
    colour, marker, style = _STYLES[method]
    below = method == "auto"  # a broad band under the method it takes
    axis.plot(
        sizes,
        values,
        color=colour,
        marker=marker,
        linestyle=style,
        linewidth=7 if below else 1.5,
        alpha=0.45 if below else 1.0,
        zorder=1 if below else 2,
        markersize=5,
        markerfacecolor="none",
        label=method,
    )


def _mark_losses(axis: Axes) -> None:
    axis.set_ylim(*LOSS_RANGE_DB)
    for level in LEVELS_DB:
        axis.axhline(level, color="0.5", linewidth=0.8, linestyle=":")
        axis.annotate(f"{level:g} dB", (0.01, level + 0.1), xycoords=("axes fraction", "data"), fontsize=7, color="0.4")


def draw_summary(tolerances: Sequence[Tolerance], path: Path) -> None:
    """Draw a table of where each correction loses 1 dB and 3 dB, coloured by the share of the sweep below 1 dB."""
    figure = Figure(figsize=(13, 0.42 * len(SWEEPS) + 1.8), layout="constrained")
    axes = figure.subplots()
    by_key = {(one.impairment, one.method): one for one in tolerances}
    shares = np.array([[_share(by_key[name, method]) for method in CHOICES] for name in SWEEPS])
    picture = axes.imshow(shares, cmap="RdYlGn", vmin=0, vmax=1, aspect="auto", alpha=0.75)
    for row, name in enumerate(SWEEPS):
        for column, method in enumerate(CHOICES):
            axes.text(column, row, _words(by_key[name, method]), ha="center", va="center", fontsize=8)
    axes.set_xticks(range(len(CHOICES)), CHOICES)
    units = [f", {sweep.unit}" if sweep.unit != "1" else "" for sweep in SWEEPS.values()]
    axes.set_yticks(range(len(SWEEPS)), [s.title + unit for s, unit in zip(SWEEPS.values(), units, strict=True)])
    axes.tick_params(labeltop=True, labelbottom=False, length=0)
    axes.set_title("Size at which the peaks are wrong by 1 dB | 3 dB (> or <: not within the sweep)", pad=24)
    figure.colorbar(picture, ax=axes, label="Share of the sweep below 1 dB", pad=0.01, fraction=0.03)
    save_png(figure, path)


def _share(tolerance: Tolerance) -> float:
    """Return how far along its sweep the impairment gets before the loss passes 1 dB, 0…1."""
    if np.isnan(tolerance.size_at_1_db):
        return 1.0
    sweep = SWEEPS[tolerance.impairment]
    ends = np.array([sweep.sizes[0], tolerance.size_at_1_db, sweep.sizes[-1]], np.float64)
    first, at, last = np.log(ends) if sweep.logarithmic else ends
    return float((at - first) / (last - first))


def _words(tolerance: Tolerance) -> str:
    falling = tolerance.first_size > tolerance.last_size
    sizes = [
        f"{'<' if falling else '>'} {tolerance.last_size:g}" if np.isnan(size) else f"{size:.3g}"
        for size in (tolerance.size_at_1_db, tolerance.size_at_3_db)
    ]
    return sizes[0] if sizes[0] == sizes[1] and np.isnan(tolerance.size_at_1_db) else " | ".join(sizes)
