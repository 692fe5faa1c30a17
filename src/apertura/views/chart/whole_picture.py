"""The picture of the whole chain: what is lost, expected and measured, and numerical error, against seconds."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from apertura.views.chart.png import save_png

_FLOOR_DB = -110.0
_LONGEST_DB = 20.0
_MARKS = {
    "o": "numerical error, certified; seconds from least to most",
    "s": "expected by the budget: power lost from a peak",
    "^": "measured at bright points: the same, ± σ",
}


@dataclass(frozen=True)
class Whole:
    """What one setting takes from raw samples to GeoTIFFs, and errs; of the pair that is worse.

    Attributes
    ----------
    seconds, least_seconds, most_seconds
        Of the processor over the repeats, which other work on the machine stretches little.
    wall_seconds
        By the clock on the wall, mean.
    load
        Mean load of the machine, processes that want to run.
    expected_loss_db
        By the lines of the budget that somebody stated, arithmetic included, 0 or less.
    measured_loss_db, measured_std_db
        At bright points; NaN where they cannot tell.
    numerical_error_db
        As certified.
    flags
        Of the pairs, with blanks between.
    """

    setting: str
    seconds: float
    least_seconds: float
    most_seconds: float
    wall_seconds: float
    repeats: int
    load: float
    expected_loss_db: float
    measured_loss_db: float
    measured_std_db: float
    numerical_error_db: float
    flags: str


def spread_db(loss_db: float) -> float:
    """Return the share of a peak's power that a loss has spread around it, dB.

    Examples
    --------
    >>> round(spread_db(-1.0), 1), spread_db(0.0)
    (-6.9, -110.0)
    """
    return float(10 * np.log10(max(1 - 10 ** (min(loss_db, 0.0) / 10), 10 ** (_FLOOR_DB / 10))))


def draw_whole(rows: Sequence[Whole], path: Path, *, title: str, refused: Collection[str]) -> None:
    """Draw each setting's errors one above the other at its seconds, as PNG; settings that were refused are named."""
    figure = Figure(figsize=(13, 7), layout="constrained")
    axes, beside = figure.subplots(1, 2, width_ratios=(3.2, 1))
    ordered = sorted(rows, key=lambda row: row.seconds)
    for number, row in enumerate(ordered):
        _draw_row(axes, row, f"C{number % 10}", str(number + 1))
    for marker, label in _MARKS.items():
        axes.plot([], [], marker, color="0.3", label=label)
    axes.set_xlabel("Processor seconds from raw samples to GeoTIFFs")
    axes.set_ylabel("Error, dB")
    axes.grid(alpha=0.25)
    axes.margins(y=0.1)
    figure.suptitle(title, fontsize=10)
    figure.legend(loc="outside lower center", ncols=len(_MARKS), fontsize=9)
    lines = [f"{number}  {row.setting}: {row.wall_seconds:.1f} s" for number, row in enumerate(ordered, 1)]
    lines += [f"–  {name}: refused" for name in refused]
    names = sorted({flag for row in rows for flag in row.flags.split()})
    beside.text(0, 1, "\n".join(["wall clock", *lines, "", "flags", *(names or ["none"])]), va="top", fontsize=9)
    beside.axis("off")
    save_png(figure, path)


def _draw_row(axes: Axes, row: Whole, colour: str, number: str) -> None:
    """Draw one setting: seconds with their spread, and each kind of error."""
    lost = [row.measured_loss_db + way * row.measured_std_db for way in (0, 1, -1)]
    heights = dict(zip(_MARKS, map(float, (row.numerical_error_db, spread_db(row.expected_loss_db))), strict=False))
    axes.hlines(row.numerical_error_db, row.least_seconds, row.most_seconds, color=colour)
    if np.isfinite(row.measured_loss_db):
        heights["^"], low, high = map(spread_db, lost)
        axes.vlines(row.seconds, max(low, heights["^"] - _LONGEST_DB), high, color=colour)
    for marker, height in heights.items():
        axes.plot(row.seconds, height, marker, color=colour)
    axes.vlines(row.seconds, min(heights.values()), max(heights.values()), color=colour, linewidth=0.5, alpha=0.5)
    place = (row.seconds, row.numerical_error_db)
    axes.annotate(number, place, xytext=(0, -16), textcoords="offset points", ha="center", color=colour)
