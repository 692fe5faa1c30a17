"""The error budget of an image as bars, beside what its bright points measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.gridspec import GridSpec
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from apertura.core.quality.budget import is_stated
from apertura.views.report.sheet import BLUE, GREY, RED, sheet

_LEAST = {"loss_db": 1e-4, "shift_m": 1e-4, "phase_rad": 1e-4}
_LABELS = {"loss_db": "peak lost, dB", "shift_m": "targets shifted, m", "phase_rad": "phase of the image, rad"}
_STYLES: Mapping[bool, Any] = {
    True: {"color": BLUE, "label": "stated or measured"},
    False: {"facecolor": "white", "edgecolor": GREY, "hatch": "/////", "label": "not stated: of the size in the table"},
}


@dataclass(frozen=True)
class Measured:
    """What an image's bright points tell.

    Attributes
    ----------
    loss_db, std_db
        Lost of their peak, negative, and its standard deviation; None where no point is bright enough.
    expected_db
        What the budget expects to be lost; None where nothing is stated.
    """

    loss_db: float | None = None
    std_db: float | None = None
    expected_db: float | None = None


def draw_budget(
    path: Path, lines: Sequence[Mapping[str, Any]], measured: Measured, *, title: str, tags: Mapping[str, str]
) -> None:
    """Draw what each cause is expected to cost as a PNG; what nobody stated is hatched and counts for nothing.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    lines
        Of the budget in image.json: cause, stated, loss_db, shift_m, phase_rad, None where a cause does not do that.
    measured
        What the image itself tells.
    title
        Flight and pair.
    tags
        Provenance; lies in the file.
    """
    with sheet(path, 1.5 + 0.21 * max(4, len(lines)), title=title, tags=tags) as figure:
        grid = GridSpec(1, 3, figure=figure, width_ratios=(1.4, 1, 1))
        for place, measure in enumerate(_LABELS):
            axes = figure.add_subplot(grid[place])
            _draw(axes, lines, measure)
            axes.tick_params(labelleft=place == 0)
            if measure == "loss_db":
                _draw_measured(axes, measured)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)


def _draw(axes: Axes, lines: Sequence[Mapping[str, Any]], measure: str) -> None:
    least, places = _LEAST[measure], np.arange(len(lines))
    sizes = [abs(line[measure]) if line[measure] is not None else 0.0 for line in lines]
    highest = max([10 * least, *sizes])
    for stated, style in _STYLES.items():
        some = [place for place, line in enumerate(lines) if is_stated(line) == stated and sizes[place] > least]
        axes.barh(some, [sizes[place] for place in some], height=0.62, **style)
    for place, (size, line) in enumerate(zip(sizes, lines, strict=True)):
        if size <= least:
            words = "does not apply" if line[measure] is None else f"below {least:g}"
            axes.text(1.2 * least, place, words, va="center", fontsize=6, color=GREY)
    axes.set_yticks(places, [line["cause"] for line in lines])
    axes.set(xscale="log", xlim=(least, 2 * highest), ylim=(len(lines) - 0.4, -0.6), xlabel=_LABELS[measure])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _position: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_locator(LogLocator(numticks=5))
    axes.grid(visible=False, axis="y")


def _draw_measured(axes: Axes, measured: Measured) -> None:
    if measured.expected_db is not None:
        expected = max(abs(measured.expected_db), _LEAST["loss_db"])
        axes.axvline(expected, color=BLUE, linestyle=":", label="expected, all stated")
    if measured.loss_db is not None:
        loss = max(abs(measured.loss_db), _LEAST["loss_db"])
        axes.axvline(loss, color=RED, linewidth=1.4, label="measured at bright points")
        if measured.std_db:
            axes.axvspan(max(loss - measured.std_db, _LEAST["loss_db"]), loss + measured.std_db, color=RED, alpha=0.15)
