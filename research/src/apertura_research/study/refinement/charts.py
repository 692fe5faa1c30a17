"""Loss of peak against sigma of the tracks' errors, with and without refinement, per kind of scene."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from apertura.views.chart.png import save_png
from apertura_research.study.refinement.outcomes import ACCEPTED, FLAGGED, KINDS, REFUSED, SNR_DB, TOO_FEW, Outcome

_LOGS, _PRODUCT = "#000000", "#0072b2"
_SAID = {
    ACCEPTED: ("o", "#0072b2", "#0072b2"),
    FLAGGED: ("D", "#0072b2", "#e69f00"),
    REFUSED: ("X", "#d55e00", "#d55e00"),
    TOO_FEW: ("s", "#d55e00", "none"),
}
_LEVELS_DB = (0, 0.1, 0.3, 1, 3, 10)
_LINEAR_DB = 0.3  # below it the axis is linear: losses may be zero, or a little less
_BESIDE = 0.06  # of the marks of a size's seeds, cm: they do not hide each other


def draw_losses(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw a panel per scene: means over the seeds from logs and as the product leaves it, and what it said of each."""
    scenes = [scene for scene in KINDS if any(one.scene == scene for one in outcomes)]
    figure = Figure(figsize=(4 * len(scenes) + 1, 5.6), layout="constrained")
    panels = figure.subplots(1, len(scenes), sharey=True, squeeze=False)[0]
    for axes, scene in zip(panels, scenes, strict=True):
        rows = [one for one in outcomes if one.scene == scene]
        _draw_scene(axes, rows)
        _mark_said(axes, rows)
        axes.set_title(f"{KINDS[scene]}\n{tally(rows)}", fontsize=10)
        axes.set_xlabel("σ of each log per axis, over 1 s, cm")
    _scale(panels[0], outcomes)
    seeds = len({one.seed for one in outcomes})
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    figure.suptitle(
        f"Loss at 15 places that no refinement sees, both pairs, SNR {SNR_DB:g} dB; lines: mean of {seeds} draws",
        fontsize=11,
    )
    save_png(figure, path)


def _draw_scene(axes: Axes, rows: Sequence[Outcome]) -> None:
    sizes = sorted({one.sigma_cm for one in rows})
    for name, colour, style, label in (
        ("loss_db", _LOGS, "--", "from the logs"),
        ("product_loss_db", _PRODUCT, "-", "as the product leaves it"),
    ):
        means = [np.mean([getattr(one, name) for one in rows if one.sigma_cm == size]) for size in sizes]
        axes.plot(sizes, means, color=colour, linestyle=style, marker="_", markersize=12, zorder=1, label=label)
    axes.set_xticks(sizes, [f"{size:g}" for size in sizes])
    axes.grid(alpha=0.3)


def _mark_said(axes: Axes, rows: Sequence[Outcome]) -> None:
    """Mark each draw by what was said of it; where it was refused also what it would have become."""
    seeds = sorted({one.seed for one in rows})
    beside = {seed: _BESIDE * (number - (len(seeds) - 1) / 2) for number, seed in enumerate(seeds)}
    for said, (marker, edge, face) in _SAID.items():
        some = [one for one in rows if one.said == said]
        places = [one.sigma_cm + beside[one.seed] for one in some]
        losses = [one.product_loss_db for one in some]
        axes.plot(places, losses, marker, color=edge, markerfacecolor=face, markersize=7, alpha=0.75, label=said)
    spurned = [one for one in rows if one.said == REFUSED]
    axes.plot(
        [one.sigma_cm + beside[one.seed] for one in spurned],
        [one.found_loss_db for one in spurned],
        "x", color="0.45", markersize=6, label="what was refused",
    )  # fmt: skip


def tally(rows: Sequence[Outcome]) -> str:
    """Return how many refinements were accepted, and how many of those did harm.

    Examples
    --------
    >>> tally([Outcome("five", 1.0, seed, 1.2, 0.1, 0.1, ACCEPTED, "", "") for seed in (1, 2)])
    '2 of 2 accepted, 0 of them worse than the logs'
    """
    accepted = [one for one in rows if one.said in (ACCEPTED, FLAGGED)]
    worse = [one for one in accepted if one.product_loss_db > one.loss_db]
    return f"{len(accepted)} of {len(rows)} accepted, {len(worse)} of them worse than the logs"


def _scale(axes: Axes, outcomes: Sequence[Outcome]) -> None:
    losses = [loss for one in outcomes for loss in (one.loss_db, one.product_loss_db, one.found_loss_db)]
    axes.set_yscale("symlog", linthresh=_LINEAR_DB, linscale=0.6)
    axes.set_yticks(_LEVELS_DB, [f"{level:g}" for level in _LEVELS_DB])
    axes.set_yticks([], minor=True)
    axes.set_ylim(min(-0.05, *losses), 1.2 * max(3.0, *losses))
    axes.set_ylabel("Loss of peak, dB (linear below 0.3)")
