"""The points of the speed-accuracy chart, a setting each: the Pareto front among them, as CSV and as PNG."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from apertura.core.focus.engines import ENGINES
from apertura.views.chart.png import save_png

_COLOURS = ("#0072b2", "#e69f00", "#000000", "#cc79a7", "#56b4e9", "#009e73")
_MARKERS = "osD^vP"


@dataclass(frozen=True)
class Point:
    """One setting: seconds are for the whole image on one thread, from what its part took.

    `error_db` is an upper bound at 95 % confidence; None of the double sum, which errors are measured against.
    """

    engine: str
    setting: str
    presum: int
    seconds: float
    pixel_pulses_per_s: float
    error_db: float | None
    predicted_seconds: float
    predicted_error_db: float
    on_front: bool
    planned: bool


def with_front(points: Sequence[Point]) -> list[Point]:
    """Return points, fastest first, marked where nothing faster is as exact: the Pareto front."""
    best, marked = float("inf"), []
    for point in points:
        error_db = -np.inf if point.error_db is None else point.error_db
        marked.append(replace(point, on_front=error_db < best))
        best = min(best, error_db)
    return marked


def draw_points(points: Sequence[Point], path: Path, *, title: str, accuracy_db: float) -> None:
    """Draw error against seconds of points, fastest first, and the accuracy that the campaign asks for, as PNG."""
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    axes = figure.subplots()
    for engine, colour, marker in zip(ENGINES, cycle(_COLOURS), cycle(_MARKERS), strict=False):
        places = _places([point for point in points if point.engine == engine and not point.planned])
        if places[0]:
            axes.plot(*places, linestyle="none", color=colour, marker=marker, alpha=0.6, label=engine)
    front = [point for point in points if point.on_front]
    axes.plot(*_places(front), color="0.4", drawstyle="steps-post", zorder=0, label="Pareto front")
    for point in points:
        if point.error_db is None:
            chosen = "planner's choice: " if point.planned else ""
            label = f"{chosen}the double sum, which errors are measured against"
            axes.axvline(point.seconds, color="0.4", linestyle=":", label=label)
        elif point.planned:
            thin = f", {point.presum}:1 pulses" if point.presum > 1 else ""
            label = f"planner's choice: {point.setting}{thin}"
            axes.plot(point.seconds, point.error_db, "*", color="#d55e00", markersize=17, label=label)
    axes.axhline(accuracy_db, color="#009e73", linestyle="--", label=f"asked: {accuracy_db:g} dB")
    axes.set_xscale("log")
    axes.set_xlabel("Seconds of tables and sums for the whole image, one thread")
    axes.set_ylabel("Error against the double sum: upper bound at 95 %, dB")
    axes.set_title(title, fontsize=11)
    axes.grid(which="both", alpha=0.25)
    axes.legend(fontsize=9)
    save_png(figure, path)


def _places(points: Sequence[Point]) -> tuple[list[float], list[float]]:
    places = [(point.seconds, point.error_db) for point in points if point.error_db is not None]
    return [seconds for seconds, _ in places], [error_db for _, error_db in places]
