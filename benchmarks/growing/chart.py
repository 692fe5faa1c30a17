"""Chart of the growth benchmark: run time against image size, and error against run time on one scene."""

from pathlib import Path
from typing import Any

import numpy as np

from growing.table import Row, label, ladder, power_law

_COLOURS = {
    "native": "C0",
    "tree": "C2",
    "numba": "C7",
    "fastsar FFBP": "C3",
    "fastsar exact": "C1",
    "fastsar points": "C4",
}
_LINES = {-40.0: ":", -80.0: "--"}
_SHOWN = ("monostatic", "flat", 4096, 8192)
_SECONDS = "CPU seconds of one thread, from echoes to image"


def draw(rows: list[Row], path: Path) -> None:
    """Draw a PNG with three panels: time against size for both geometries, and error against time for one scene."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(17, 6), layout="constrained")
    for axis, geometry in zip(axes, ("monostatic", "bistatic"), strict=False):
        _growth(axis, ladder(rows, geometry), geometry)
    lowest, highest = zip(*(axis.get_ylim() for axis in axes[:2]), strict=True)
    for axis in axes[:2]:
        axis.set_ylim(min(lowest), max(highest))
    shown = [row for row in rows if tuple(row[key] for key in ("geometry", "surface", "size", "pulses")) == _SHOWN]
    _accuracy(axes[2], shown)
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)


def _growth(axis: Any, by_contestant: dict[str, list[Row]], geometry: str) -> None:
    """Draw medians with minimum and maximum, and the power law fitted to them."""
    for name, rows in by_contestant.items():
        size, seconds = (np.array([row[key] for row in rows], float) for key in ("size", "seconds_from_echoes"))
        spread = np.abs(np.array([row["spread"] for row in rows]).T - seconds)
        fitted, style = power_law(rows), _style(rows[0])
        points = {"marker": _marker(rows[0]), "markersize": 5, "color": style["color"], "linestyle": ""}
        axis.errorbar(size, seconds, yerr=spread, capsize=2, **points)
        line = seconds if fitted is None else np.exp(fitted[1]) * size ** fitted[0]
        exponent = "" if fitted is None else f": size$^{{{fitted[0]:.2f}}}$"
        axis.plot(size, line, label=name + exponent, linewidth=1.2, **style)
    axis.set(xscale="log", yscale="log", xlabel="pixels per side; twice as many pulses", ylabel=_SECONDS)
    axis.set_title(f"{geometry}, flat terrain: measured points, fitted lines")
    sizes = sorted({row["size"] for rows in by_contestant.values() for row in rows})
    axis.set_xticks(sizes, [str(size) for size in sizes])
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)


def _accuracy(axis: Any, rows: list[Row]) -> None:
    for row in rows:
        place = (row["seconds_from_echoes"], row["error_db"])
        axis.plot(*place, marker=_marker(row), color=_style(row)["color"])
        below = row["name"] == "native"  # separates the label from that of the tree at -80 dB
        axis.annotate(label(row), place, xytext=(6, -11 if below else 4), textcoords="offset points", fontsize=8)
    axis.set(xscale="log", xlabel=_SECONDS, ylabel="RMS error, dB (more accurate upwards)")
    geometry, surface, size, pulses = _SHOWN
    axis.set_title(f"{size}² × {pulses}, {geometry}, {surface}")
    axis.margins(x=0.32, y=0.1)
    axis.xaxis.set_major_formatter("{x:g}")
    axis.invert_yaxis()
    axis.grid(alpha=0.3)


def _style(row: Row) -> dict[str, Any]:
    colour = next((value for name, value in _COLOURS.items() if row["name"].startswith(name)), "k")
    return {"color": colour, "linestyle": ":" if _marker(row) == "s" else _LINES.get(row["aim_db"], "-")}


def _marker(row: Row) -> str:
    return "s" if row["name"].startswith("fastsar FFBP ") else "o"
