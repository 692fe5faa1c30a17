"""Images side by side on one scale of dB: two pairs and what they add up to."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.gridspec import GridSpec
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from apertura.formats.export.map_layout import number, round_length
from apertura.formats.export.quicklook import below_peak
from apertura.views.report.sheet import GREY, SKY, sheet

_RANGE_DB = 40.0
_COLUMNS = 2


def draw_panels(
    path: Path,
    powers: Mapping[str, NDArray[np.float64]],
    *,
    size_m: tuple[float, float],
    target_m: tuple[float, float],
    title: str,
    tags: Mapping[str, str],
    local: bool = False,
) -> None:
    """Draw images of one scene as a PNG, each in dB below its own peak, all over the same range of dB.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    powers
        What a panel is called → (row, column) float64 mean power, north-up, NaN where nothing was formed.
    size_m
        Of the scene, east and north, metres.
    target_m
        Brightest target, metres east and north of the lower left corner.
    title
        Of the flight.
    tags
        Provenance; lies in the file.
    local
        Whether the scene has no place on Earth: its axes are x and y.
    """
    across, up = ("x", "y") if local else ("east", "north")
    rows = -(-len(powers) // _COLUMNS)
    high = 2.75 * min(1.6, max(0.45, size_m[1] / size_m[0]))
    with sheet(path, 0.5 + rows * (high + 0.45), title=title, tags=tags) as figure:
        grid = GridSpec(rows, _COLUMNS, figure=figure)
        drawn = []
        for place, (name, power) in enumerate(powers.items()):
            axes = figure.add_subplot(grid[place // _COLUMNS, place % _COLUMNS])
            drawn.append((axes, _draw(axes, power, size_m)))
            axes.set_title(f"({'abcdefgh'[place % 8]}) {name}")
            axes.plot(*target_m, "o", markersize=10, markerfacecolor="none", markeredgecolor=SKY, markeredgewidth=1.2)
            if place % _COLUMNS == 0:
                axes.set_ylabel(f"{up} of the corner, m")
            if place >= len(powers) - _COLUMNS:
                axes.set_xlabel(f"{across} of the corner, m")
        _draw_scale(drawn[0][0], size_m, north=not local)
        bar = figure.colorbar(drawn[0][1], ax=[axes for axes, _ in drawn], extend="both", shrink=0.8, pad=0.02)
        bar.set_label("power re peak of the panel, dB")


def _draw(axes: Axes, power: NDArray[np.float64], size_m: tuple[float, float]) -> AxesImage:
    decibel, _ = below_peak(power)
    axes.grid(visible=False)
    axes.set_facecolor("white")
    return axes.imshow(
        np.ma.masked_invalid(decibel),
        extent=(0, size_m[0], 0, size_m[1]),
        cmap="inferno",
        vmin=-_RANGE_DB,
        vmax=0,
        interpolation="nearest",
    )


def _draw_scale(axes: Axes, size_m: tuple[float, float], *, north: bool) -> None:
    metres = round_length(size_m[0] / 4)
    axes.add_patch(
        Rectangle((0.05 * size_m[0], 0.05 * size_m[1]), metres, 0.015 * size_m[1], facecolor="white", edgecolor=GREY)
    )
    at = 0.05 * size_m[0] + metres / 2, 0.085 * size_m[1]
    axes.text(*at, f"{number(metres)} m", color="white", ha="center", fontsize=7)
    if not north:
        return
    arrow = {"arrowstyle": "-|>", "color": "white"}
    axes.annotate("", (0.94, 0.19), (0.94, 0.05), xycoords="axes fraction", arrowprops=arrow)
    axes.text(0.94, 0.2, "N", transform=axes.transAxes, color="white", ha="center", weight="bold")
