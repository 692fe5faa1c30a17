"""The speed-accuracy chart as a PNG: a point per setting, the Pareto front, the planner's choice."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from matplotlib.figure import Figure

from apertura.study.charts import save

LOOKS = {
    "native": ("#0072b2", "o"),
    "numba": ("#e69f00", "s"),
    "reference": ("#000000", "D"),
}


class Charted(Protocol):
    """What a point must have."""

    @property
    def engine(self) -> str: ...  # noqa: D102
    @property
    def setting(self) -> str: ...  # noqa: D102
    @property
    def pulse_thinning(self) -> int: ...  # noqa: D102
    @property
    def seconds(self) -> float: ...  # noqa: D102
    @property
    def error_db(self) -> float: ...  # noqa: D102
    @property
    def on_front(self) -> bool: ...  # noqa: D102
    @property
    def planned(self) -> bool: ...  # noqa: D102


def draw_points(points: Sequence[Charted], path: Path, *, title: str, accuracy_db: float) -> None:
    """Draw error against seconds.

    Parameters
    ----------
    points
        Fastest first.
    path
        PNG to write.
    title
        Of the chart.
    accuracy_db
        What the campaign asks for.
    """
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    axes = figure.subplots()
    for engine, (colour, marker) in LOOKS.items():
        some = [point for point in points if point.engine == engine and not point.planned]
        axes.plot(
            [point.seconds for point in some],
            [point.error_db for point in some],
            linestyle="none",
            color=colour,
            marker=marker,
            alpha=0.6,
            label=engine,
        )
    front = [point for point in points if point.on_front]
    axes.plot(
        [point.seconds for point in front],
        [point.error_db for point in front],
        color="0.4",
        drawstyle="steps-post",
        zorder=0,
        label="Pareto front",
    )
    for point in points:
        if point.planned:
            thin = f", {point.pulse_thinning}:1 pulses" if point.pulse_thinning > 1 else ""
            label = f"planner's choice: {point.setting}{thin}"
            axes.plot(point.seconds, point.error_db, "*", color="#d55e00", markersize=17, label=label)
    axes.axhline(accuracy_db, color="#009e73", linestyle="--", label=f"asked: {accuracy_db:g} dB")
    axes.set_xscale("log")
    axes.set_xlabel("Seconds for the whole image, one thread")
    axes.set_ylabel("Error on random pixels against the double sum, dB")
    axes.set_title(title, fontsize=11)
    axes.grid(which="both", alpha=0.25)
    axes.legend(fontsize=9)
    save(figure, path)
