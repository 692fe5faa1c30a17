"""Where the antennas flew: in plan over the scene, from the side, and their heights over time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.gridspec import GridSpec
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from apertura.formats.export.map_layout import from_origin, number, round_length, round_origin
from apertura.views.report.sheet import BLUE, GREEN, GREY, ORANGE, RED, sheet

_STYLES: Mapping[str, Any] = {
    "transmitter": {"color": BLUE, "linestyle": "-", "linewidth": 1.6},
    "receiver": {"color": ORANGE, "linestyle": "--", "linewidth": 1.6},
}
_MARGIN, _BELOW = 0.18, 0.1
"""Left free in plan around tracks and scene, and how much of it below them for scale and north, of their side."""


@dataclass(frozen=True, eq=False)
class FlownGeometry:
    """What a drawing of a pair's geometry needs.

    Attributes
    ----------
    time_s
        (pulse,) float64, of some pulses, seconds from the first.
    tracks_m
        Antenna (transmitter, receiver) → (pulse, 3) float64, easting, northing and height on the map, metres.
    bounds_m
        West, south, east, north of the scene.
    ground_m
        Height of the ground in its middle, as the tracks' heights count.
    target_m
        (3,) float64, the brightest target on the map, metres.
    footprint
        Rings (vertex, 2) of map metres about what the pulses make.
    crs_name
        Of the map.
    """

    time_s: NDArray[np.float64]
    tracks_m: Mapping[str, NDArray[np.float64]]
    bounds_m: tuple[float, float, float, float]
    ground_m: float
    target_m: NDArray[np.float64]
    footprint: Sequence[NDArray[np.float64]]
    crs_name: str

    @property
    def middle_m(self) -> NDArray[np.float64]:
        """Middle of the scene on its ground, (3,) float64 metres of the map."""
        west, south, east, north = self.bounds_m
        return np.array([(west + east) / 2, (south + north) / 2, self.ground_m])

    @property
    def towards(self) -> NDArray[np.float64]:
        """Direction over ground from the middle of the tracks to the target, (2,) float64 of length one."""
        tracks = np.concatenate([track[:, :2] for track in self.tracks_m.values()])
        vector = self.target_m[:2] - tracks.mean(axis=0)
        length = float(np.hypot(*vector))
        return np.asarray(vector / length) if length else np.array([0.0, 1.0])


def draw_geometry(path: Path, flown: FlownGeometry, *, title: str, tags: Mapping[str, str]) -> None:
    """Draw a pair's geometry as a PNG: plan, view from the side, heights over time.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    flown
        Tracks and scene.
    title
        Flight and pair.
    tags
        Provenance; lies in the file.
    """
    with sheet(path, 5.6, title=title, tags=tags) as figure:
        grid = GridSpec(2, 2, figure=figure, height_ratios=(2.2, 1))
        _draw_plan(figure.add_subplot(grid[0, 0]), flown)
        _draw_side(figure.add_subplot(grid[0, 1]), flown)
        _draw_heights(figure.add_subplot(grid[1, :]), flown)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=5, frameon=False)


def _draw_plan(axes: Axes, flown: FlownGeometry) -> None:
    west, south, east, north = flown.bounds_m
    corners = np.array([[west, south], [east, north]])
    places = np.concatenate([corners, *(track[:, :2] for track in flown.tracks_m.values())])
    low, high = places.min(axis=0), places.max(axis=0)
    side = float((high - low).max())
    half, (x, y) = (0.5 + _MARGIN) * side, (low + high) / 2
    y -= _BELOW * side
    axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal", title="plan")
    scene = Rectangle((west, south), east - west, north - south, facecolor="0.93", edgecolor=GREY, label="scene")
    axes.add_patch(scene)
    for number_of, ring in enumerate(flown.footprint):
        axes.plot(*ring.T, color=GREEN, linewidth=1.0, linestyle=":", label="" if number_of else "footprint")
    for name, track in flown.tracks_m.items():
        axes.plot(*track[:, :2].T, label=name, **_STYLES[name])
        axes.plot(*track[0, :2], "o", color=_STYLES[name]["color"], markersize=4)
    axes.plot(*flown.target_m[:2], "*", color=RED, markersize=9, label="brightest target")
    for name, axis, at in (("Easting", axes.xaxis, x), ("Northing", axes.yaxis, y)):
        origin = round_origin(at - half, at + half)
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(FuncFormatter(partial(from_origin, origin)))
        axis.set_label_text(f"{name} − {number(origin)}, m" if origin else f"{name}, m")
    _draw_scale_and_north(axes)
    axes.set_xlabel(f"{axes.get_xlabel()}\n{flown.crs_name}")


def _draw_scale_and_north(axes: Axes) -> None:
    """Draw a bar of a round length and an arrow to grid north, inside the lower corners."""
    low, high = axes.get_xlim()
    metres = round_length((high - low) / 4)
    part = metres / (high - low)
    axes.add_patch(Rectangle((0.05, 0.04), part, 0.015, transform=axes.transAxes, facecolor="black", zorder=5))
    axes.text(0.05 + part / 2, 0.07, f"{number(metres)} m", transform=axes.transAxes, ha="center", fontsize=7)
    arrow = {"arrowstyle": "-|>", "color": "black"}
    axes.annotate("", (0.94, 0.13), (0.94, 0.02), xycoords="axes fraction", arrowprops=arrow)
    axes.text(0.94, 0.13, "N", transform=axes.transAxes, ha="center", fontsize=8, weight="bold")


def _draw_side(axes: Axes, flown: FlownGeometry) -> None:
    """Draw what is seen along the flight: heights over the distance towards the target, in true proportions."""
    origin = flown.target_m[:2]
    ends = np.array([[x, y] for x in flown.bounds_m[::2] for y in flown.bounds_m[1::2]])
    reach = (ends - origin) @ flown.towards
    axes.plot([reach.min(), reach.max()], [0, 0], color=GREY, linewidth=3, solid_capstyle="butt", label="scene")
    for name, track in flown.tracks_m.items():
        away, height = (track[:, :2] - origin) @ flown.towards, track[:, 2] - flown.ground_m
        axes.plot(away, height, label=name, **_STYLES[name])
        sight = float(np.median(away)), float(np.median(height))
        axes.plot([sight[0], 0], [sight[1], flown.target_m[2] - flown.ground_m], color=_STYLES[name]["color"], lw=0.6)
    axes.plot(0, flown.target_m[2] - flown.ground_m, "*", color=RED, markersize=9, label="brightest target")
    axes.set(title="from the side", xlabel="distance towards the target, m", ylabel="height above the scene, m")
    axes.set_aspect("equal", adjustable="datalim")


def _draw_heights(axes: Axes, flown: FlownGeometry) -> None:
    for name, track in flown.tracks_m.items():
        axes.plot(flown.time_s, track[:, 2] - flown.ground_m, label=name, **_STYLES[name])
    axes.set(
        title=f"height above the scene, whose ground lies at {number(round(flown.ground_m, 2))} m",
        xlabel="time from the first pulse, s",
        ylabel="height, m",
    )
    axes.margins(x=0)
