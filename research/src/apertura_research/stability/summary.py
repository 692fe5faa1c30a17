"""The stability study: effect of every impairment under every correction, with tables of tolerance and charts."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from apertura.common.tables import write_table
from apertura.core.echo.sidelink import METHODS
from apertura_research.stability.outcomes import StabilityRow, run_size, sizes_of
from apertura_research.stability.sweeps import CHOICES, SWEEPS, UNKNOWN
from apertura_research.sweep import Study, crossing, draw_table, order_sizes, panels, with_unit

LEVELS_DB = (1.0, 3.0)

EXPECTED = {
    "divide": "SNR < 6 dB: gain −4 dB at 0 dB, −20 dB at −10 dB",
    "wiener": "floor 5 to 9 dB better than divide below 6 dB, biases the peak",
    "gated": "noise within ±16 cells remains",
    "two_parameter": "works down to −20 dB",
    UNKNOWN: "decisions down to 7 dB, division below",
    "auto": "within 0.2 dB of the best",
}
"""Method → prediction of an independent model."""


@dataclass(frozen=True)
class Tolerance:
    """Tolerance of one correction to one impairment: a row of summary.csv.

    Attributes
    ----------
    size_at_1_db, size_at_3_db
        Interpolated sizes at which the peak error, of either sign, reaches 1 and 3 dB; NaN if it does not.
    first_size, last_size
        Range of the simulated sizes.
    """

    impairment: str
    unit: str
    method: str
    size_at_1_db: float
    size_at_3_db: float
    first_size: float
    last_size: float
    draws: int
    seed: int


def tolerance_of(outcomes: Sequence[StabilityRow]) -> Tolerance:
    """Return the sizes at which one impairment under one correction changes the peaks by 1 and 3 dB."""
    first, last = outcomes[0], outcomes[-1]
    sizes, losses = (np.array([getattr(one, name) for one in outcomes]) for name in ("size", "loss_db"))
    logarithmic = SWEEPS[first.impairment].logarithmic
    at = [round(crossing(sizes, np.abs(losses), level, logarithmic=logarithmic), 6) for level in LEVELS_DB]
    return Tolerance(
        first.impairment, first.unit, first.method, at[0], at[1], first.size, last.size, first.draws, first.seed
    )


def summarise(outcomes: Sequence[StabilityRow], folder: Path) -> None:
    """Write summary.csv and summary.png, the tolerances of each correction, and the sidelink tables."""
    by_key = {
        (name, method): [one for one in outcomes if (one.impairment, one.method) == (name, method)]
        for name in SWEEPS
        for method in CHOICES
    }
    tolerances = [tolerance_of(rows) for rows in by_key.values()]
    write_table(folder / "summary.csv", tolerances)
    _draw_tolerances(tolerances, folder / "summary.png")
    write_sidelink_tables([one for one in outcomes if one.impairment == "sidelink_noise"], folder)


def _of_method(outcomes: Sequence[StabilityRow], method: str) -> list[StabilityRow]:
    return [outcome for outcome in outcomes if outcome.method == method]


def write_sidelink_tables(outcomes: Sequence[StabilityRow], folder: Path) -> None:
    """Write sidelink.csv: the loss of each method at each sidelink SNR, the best method, and the excess loss of `auto`.

    sidelink_methods.csv lists the SNR at which each method fails.
    """
    write_table(folder / "sidelink.csv", _snr_rows(outcomes, list(METHODS)))
    write_table(folder / "sidelink_methods.csv", [_method_row(_of_method(outcomes, method)) for method in CHOICES[1:]])


def _snr_rows(outcomes: Sequence[StabilityRow], methods: Sequence[str]) -> list[dict[str, object]]:
    loss = {(one.method, one.size): one.loss_db for one in outcomes}
    rows: list[dict[str, object]] = []
    for snr_db, chosen in sorted((one.size, one.chosen) for one in _of_method(outcomes, "auto")):
        best = min(methods, key=lambda method: abs(loss[method, snr_db]))
        row: dict[str, object] = {"sidelink_snr_db": snr_db}
        row |= {f"{method}_loss_db": loss[method, snr_db] for method in methods}
        gap = round(abs(loss["auto", snr_db]) - abs(loss[best, snr_db]), 4)
        rows.append(row | {"best": best, "auto": chosen, "auto_behind_best_db": gap})
    return rows


def _method_row(outcomes: Sequence[StabilityRow]) -> dict[str, object]:
    tolerance = tolerance_of(outcomes)
    floors = {one.size: one.floor_db for one in outcomes}
    return {
        "method": tolerance.method,
        "snr_at_1_db_loss": tolerance.size_at_1_db,
        "snr_at_3_db_loss": tolerance.size_at_3_db,
        **{f"floor_db_at_{snr:g}_db": floors[snr] for snr in (10.0, 0.0, -10.0, -20.0)},
        "independent_model": EXPECTED[tolerance.method],
    }


LOSS_RANGE_DB = (-1.0, 25.0)
_STYLES = {
    "none": ("#000000", "o", "--"),
    "divide": ("#0072b2", "s", "-"),
    "wiener": ("#56b4e9", "^", "-"),
    "two_parameter": ("#d55e00", "D", "-"),
    "gated": ("#009e73", "v", "-"),
    UNKNOWN: ("#e69f00", "x", "-"),
    "auto": ("#cc79a7", "", "-"),
}


def draw_impairment(impairment: str, outcomes: Sequence[StabilityRow], path: Path) -> None:
    """Draw loss, coherence factor and widths against the size of one impairment."""
    sweep = SWEEPS[impairment]
    quantities = (
        ("loss_db", 1.0, "Peak loss, dB (mean of five targets)"),
        ("coherence_factor", 1.0, "Coherence factor"),
        ("cross_width_m", 100.0, "Cross-range width at −3 dB, cm"),
        ("floor_db", 1.0, "Error floor relative to the peaks, dB"),
    )
    with panels(path, (10, 7.5), (2, 2), title=sweep.title, legend_columns=len(CHOICES), sharex=True) as every:
        for axes, (name, scale, label) in zip(every, quantities, strict=True):
            for method in CHOICES:
                rows = _of_method(outcomes, method)
                _draw_line(axes, method, [one.size for one in rows], [scale * getattr(one, name) for one in rows])
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
        _mark_losses(every[0])
        every[1].set_ylim(0, 1.03)
        every[3].set_ylim(top=5)
        order_sizes(every[0], sweep.sizes, logarithmic=sweep.logarithmic)
        for axes in every[2:]:
            axes.set_xlabel(with_unit(sweep.title, sweep.unit))


def _draw_line(axis: Axes, method: str, sizes: list[float], values: list[float]) -> None:
    colour, marker, style = _STYLES[method]
    below = method == "auto"  # drawn as a broad line below the line of the selected method
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


def _draw_tolerances(tolerances: Sequence[Tolerance], path: Path) -> None:
    """Draw the table of sizes with 1 dB and 3 dB of peak error, coloured by the fraction of the sweep below 1 dB."""
    table = [tolerances[first : first + len(CHOICES)] for first in range(0, len(tolerances), len(CHOICES))]
    draw_table(
        path,
        [[_text(one) for one in row] for row in table],
        [[_share(one) for one in row] for row in table],
        ([with_unit(sweep.title, sweep.unit) for sweep in SWEEPS.values()], CHOICES),
        title="Size at which the peak error reaches 1 dB | 3 dB (> or <: not within the sweep)",
        scale="Fraction of the sweep below 1 dB",
    )


def _share(tolerance: Tolerance) -> float:
    """Return the fraction of the sweep with a loss below 1 dB, 0…1."""
    if np.isnan(tolerance.size_at_1_db):
        return 1.0
    sweep = SWEEPS[tolerance.impairment]
    ends = np.array([sweep.sizes[0], tolerance.size_at_1_db, sweep.sizes[-1]], np.float64)
    first, at, last = np.log(ends) if sweep.logarithmic else ends
    return float((at - first) / (last - first))


def _text(tolerance: Tolerance) -> str:
    falling = tolerance.first_size > tolerance.last_size
    sizes = [
        f"{'<' if falling else '>'} {tolerance.last_size:g}" if np.isnan(size) else f"{size:.3g}"
        for size in (tolerance.size_at_1_db, tolerance.size_at_3_db)
    ]
    return sizes[0] if sizes[0] == sizes[1] and np.isnan(tolerance.size_at_1_db) else " | ".join(sizes)


STUDY = Study(
    row=StabilityRow,
    charts={name: tuple(f"{name}.{method}" for method in CHOICES) for name in SWEEPS},
    cases=sizes_of,
    run=run_size,
    draw=draw_impairment,
    summaries=("summary.csv", "summary.png", "sidelink.csv", "sidelink_methods.csv"),
    summarise=summarise,
)
"""A part is an impairment under a correction, `IMPAIRMENT.METHOD`; a case is a size."""
