"""Figures of a pair: geometry, pulses over time, and range profiles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.gridspec import GridSpec
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.errors import number_of
from apertura.formats.export.map_layout import from_origin, number, round_length, round_origin
from apertura.views.report.sheet import BLUE, GREEN, GREY, ORANGE, RED, column_of, over, sheet, thinned

_STYLES: Mapping[str, Any] = {
    "transmitter": {"color": BLUE, "linestyle": "-", "linewidth": 1.6},
    "receiver": {"color": ORANGE, "linestyle": "--", "linewidth": 1.6},
}
_MARGIN, _BELOW = 0.18, 0.1
"""Margin of the plan view around tracks and scene, and downward shift of the view for the scale bar, both relative to
the longer side of tracks and scene."""


@dataclass(frozen=True, eq=False)
class FlownGeometry:
    """Geometry of a pair for the geometry figure.

    Attributes
    ----------
    time_s
        (pulse,) float64, times of the drawn pulses, seconds since the first pulse.
    tracks_m
        Antenna (transmitter, receiver) → (pulse, 3) float64, easting, northing and height in map coordinates, metres.
    bounds_m
        West, south, east and north bounds of the scene.
    ground_m
        Terrain height at the scene centre, in the height reference of the tracks.
    target_m
        (3,) float64, position of the brightest target in map coordinates, metres.
    footprint
        Rings around the imaged area, (vertex, 2) in map coordinates, metres.
    crs_name
        Name of the CRS of the map.
    local
        True if the frame is local, without georeference.
    counted
        True if `time_s` counts pulses, because the recording has no times.
    """

    time_s: NDArray[np.float64]
    tracks_m: Mapping[str, NDArray[np.float64]]
    bounds_m: tuple[float, float, float, float]
    ground_m: float
    target_m: NDArray[np.float64]
    footprint: Sequence[NDArray[np.float64]]
    crs_name: str
    local: bool = False
    counted: bool = False

    @property
    def middle_m(self) -> NDArray[np.float64]:
        """Scene centre on the terrain, (3,) float64 in map coordinates, metres."""
        west, south, east, north = self.bounds_m
        return np.array([(west + east) / 2, (south + north) / 2, self.ground_m])

    @property
    def towards(self) -> NDArray[np.float64]:
        """Horizontal unit vector from the mean track position to the target, (2,) float64."""
        tracks = np.concatenate([track[:, :2] for track in self.tracks_m.values()])
        vector = self.target_m[:2] - tracks.mean(axis=0)
        length = float(np.hypot(*vector))
        return np.asarray(vector / length) if length else np.array([0.0, 1.0])


def draw_geometry(path: Path, flown: FlownGeometry, *, title: str, tags: Mapping[str, str]) -> None:
    """Plot the geometry of a pair as a PNG: plan view, side view, and heights over time.

    Parameters
    ----------
    path
        ``….png``; replaced atomically.
    flown
        Tracks and scene.
    title
        Flight and pair.
    tags
        Provenance, stored in the file.
    """
    with sheet(path, 5.6, title=title, tags=tags) as figure:
        grid = GridSpec(2, 2, figure=figure, height_ratios=(2.2, 1))
        _draw_plan(figure.add_subplot(grid[0, 0]), flown)
        _draw_side(figure.add_subplot(grid[0, 1]), flown)
        axes = figure.add_subplot(grid[1, :])
        for name, track in flown.tracks_m.items():
            axes.plot(flown.time_s, track[:, 2] - flown.ground_m, label=name, **_STYLES[name])
        axes.set(
            title=f"height above the scene centre (terrain height {number(round(flown.ground_m, 2))} m)",
            xlabel=over(counted=flown.counted),
            ylabel="height, m",
        )
        axes.margins(x=0)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=5, frameon=False)


def _draw_plan(axes: Axes, flown: FlownGeometry) -> None:
    west, south, east, north = flown.bounds_m
    corners = np.array([[west, south], [east, north]])
    points = np.concatenate([corners, *(track[:, :2] for track in flown.tracks_m.values())])
    low, high = points.min(axis=0), points.max(axis=0)
    side = float((high - low).max())
    half, (x, y) = (0.5 + _MARGIN) * side, (low + high) / 2
    y -= _BELOW * side
    axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal", title="plan")
    scene = Rectangle((west, south), east - west, north - south, facecolor="0.93", edgecolor=GREY, label="scene")
    axes.add_patch(scene)
    for index, ring in enumerate(flown.footprint):
        axes.plot(*ring.T, color=GREEN, linewidth=1.0, linestyle=":", label="" if index else "footprint")
    for name, track in flown.tracks_m.items():
        axes.plot(*track[:, :2].T, label=name, **_STYLES[name])
        axes.plot(*track[0, :2], "o", color=_STYLES[name]["color"], markersize=4)
    axes.plot(*flown.target_m[:2], "*", color=RED, markersize=9, label="brightest target")
    names = ("x", "y") if flown.local else ("Easting", "Northing")
    for name, axis, at in zip(names, (axes.xaxis, axes.yaxis), (x, y), strict=True):
        origin = round_origin(at - half, at + half)
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(FuncFormatter(partial(from_origin, origin)))
        axis.set_label_text(f"{name} − {number(origin)}, m" if origin else f"{name}, m")
    _draw_scale_and_north(axes, north=not flown.local)
    axes.set_xlabel(f"{axes.get_xlabel()}\n{flown.crs_name}")


def _draw_scale_and_north(axes: Axes, *, north: bool) -> None:
    """Draw, in the lower corners, a scale bar of a round length and, with `north`, an arrow to grid north."""
    low, high = axes.get_xlim()
    metres = round_length((high - low) / 4)
    part = metres / (high - low)
    axes.add_patch(Rectangle((0.05, 0.04), part, 0.015, transform=axes.transAxes, facecolor="black", zorder=5))
    axes.text(0.05 + part / 2, 0.07, f"{number(metres)} m", transform=axes.transAxes, ha="center", fontsize=7)
    if not north:
        return
    arrow = {"arrowstyle": "-|>", "color": "black"}
    axes.annotate("", (0.94, 0.13), (0.94, 0.02), xycoords="axes fraction", arrowprops=arrow)
    axes.text(0.94, 0.13, "N", transform=axes.transAxes, ha="center", fontsize=8, weight="bold")


def _draw_side(axes: Axes, flown: FlownGeometry) -> None:
    """Draw the side view: heights over the horizontal distance towards the target, both axes on the same scale."""
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
    axes.set(title="side view", xlabel="distance in the target's direction, m", ylabel="height above the scene, m")
    axes.set_aspect("equal", adjustable="datalim")
    axes.xaxis.set_major_locator(MaxNLocator(5))


_BINS = 60


@dataclass(frozen=True, eq=False)
class PulseRecord:
    """Pulses of a pair and their sidelink measurements for the pulse figure.

    Attributes
    ----------
    sent_s
        (sent,) float64, transmission times, seconds since the first pulse.
    kept
        (sent,) bool, True for pulses used in the image.
    reasons
        Reason for exclusion → number of excluded pulses, as in image.json.
    time_s
        (pulse,) float64, times of the used pulses, seconds since the first transmitted pulse.
    snr_db
        (pulse,) float64, sidelink SNR per subcarrier; None without a sidelink.
    delay_m
        (pulse,) float64, sidelink delay (in metres) minus the sidelink length from the logs; None without a sidelink.
    counted
        True if times count pulses, because the recording has no times.
    """

    sent_s: Floats
    kept: NDArray[np.bool_]
    reasons: Mapping[str, int]
    time_s: Floats = field(default_factory=lambda: np.empty(0))
    snr_db: Floats | None = None
    delay_m: Floats | None = None
    counted: bool = False


def draw_pulses(path: Path, record: PulseRecord, *, title: str, tags: Mapping[str, str]) -> None:
    """Plot numbers of used and excluded pulses and, if available, SNR and delay of the sidelink as a PNG.

    Parameters
    ----------
    path
        ``….png``; replaced atomically.
    record
        Pulses and sidelink measurements.
    title
        Flight and pair.
    tags
        Provenance, stored in the file.
    """
    series = [
        (values, label, heading)
        for values, label, heading in (
            (record.snr_db, "SNR, dB", "sidelink SNR per subcarrier"),
            (record.delay_m, "delay − length, m", "sidelink delay minus sidelink length"),
        )
        if values is not None and np.isfinite(values).any()
    ]
    with sheet(path, 2.0 + 1.7 * len(series), title=title, tags=tags) as figure:
        first, *others = column_of(figure, 1 + len(series))
        _draw_counts(first, record)
        for axes, (values, label, heading) in zip(others, series, strict=True):
            drawn = thinned(len(values))
            median = float(np.nanmedian(values))
            axes.plot(record.time_s[drawn], values[drawn], ".", color=BLUE, markersize=2, rasterized=True)
            axes.axhline(median, color=GREY, linewidth=0.8, linestyle="--")
            spread = 1.4826 * float(np.nanmedian(np.abs(values - median)))
            unlocked = int(np.isnan(values).sum())
            lost = f"; {number_of(unlocked, 'pulse')} without lock" if unlocked else ""
            unit = label.rpartition(", ")[2]
            axes.set(title=f"{heading}: median {median:.3g} {unit}, spread {spread:.2g} {unit}{lost}", ylabel=label)
        [first, *others][-1].set_xlabel(over(counted=record.counted, first="first transmitted pulse"))
        first.set_xlim(0.0, max(float(record.sent_s.max(initial=0.0)), 1e-3))


def _draw_counts(axes: Axes, record: PulseRecord) -> None:
    last = float(record.sent_s.max()) if record.sent_s.size else 0.0
    interval = float(np.median(np.diff(record.sent_s))) if last else 1.0
    # bin width: integer number of pulse intervals; for other widths, the number of pulses per bin would alternate
    width = interval * _pulses_per_bin(round(last / interval) + 1)
    edges = np.arange(-interval / 2, last + width, width)
    kept, excluded = (np.histogram(record.sent_s[selected], edges)[0] for selected in (record.kept, ~record.kept))
    axes.stairs(kept, edges, fill=True, color=BLUE, label=f"used: {int(record.kept.sum())}")
    axes.stairs(
        kept + excluded,
        edges,
        baseline=kept,
        fill=True,
        facecolor=RED,
        edgecolor="white",
        hatch="////",
        linewidth=0,
        label=f"excluded: {int((~record.kept).sum())}{_reasons_text(record.reasons)}",
    )
    label = f"pulses per {width:.0f} transmitted" if record.counted else f"pulses per {width:.2g} s"
    axes.set(title="pulses", ylabel=label, ylim=(0, 1.45 * max(1, (kept + excluded).max())))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.legend(loc="upper right", ncols=2)


def _pulses_per_bin(slots: int) -> int:
    """Return the number of pulses per histogram bin for which the last bin contains as many pulses as possible.

    Examples
    --------
    >>> _pulses_per_bin(40), _pulses_per_bin(302)  # 302 = 37·8 + 6
    (1, 8)
    """
    least = max(1, -(-slots // _BINS))
    return max(range(least, 2 * least + 1), key=lambda count: ((slots - 1) % count + 1) / count)


def _reasons_text(reasons: Mapping[str, int]) -> str:
    """Format the numbers of excluded pulses for each reason, in brackets.

    Examples
    --------
    >>> _reasons_text({"unpaired": 9, "sidelink_lost": 2}), _reasons_text({})
    (' (9 unpaired, 2 sidelink lost)', '')
    """
    counts = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in reasons.items())
    return f" ({counts})" if counts else ""


TIMES, PATHS = 560, 700
"""Maximum numbers of bins of the waterfall plot in time and in path."""

_RANGE_DB = 50.0


class Waterfall:
    """Mean power of range profiles in bins of time and path, accumulated block by block.

    Parameters
    ----------
    start_m
        (pulse,) float64, total path of sample 0, metres.
    step_m
        Interval of the total path between samples, metres.
    samples
        Number of samples in a profile.

    Examples
    --------
    >>> waterfall = Waterfall(np.array([10.0, 10.5]), 0.5, 2)
    >>> waterfall.add(0, np.array([[1, 2], [3, 4]], np.complex64))
    >>> waterfall.mean.tolist(), waterfall.span_m
    ([[1.0, nan], [4.0, 9.0], [nan, 16.0]], (10.0, 11.5))
    """

    def __init__(self, start_m: NDArray[np.float64], step_m: float, samples: int) -> None:
        first = float(start_m.min())
        self._offset = (start_m - first) / step_m
        whole = int(np.ceil(self._offset.max() - 1e-9)) + samples
        self._together = -(-whole // PATHS)
        self._pulses = -(-len(start_m) // TIMES)
        shape = -(-whole // self._together), -(-len(start_m) // self._pulses)
        self._sum, self._count = np.zeros(shape), np.zeros(shape)
        self.span_m = first, first + shape[0] * self._together * step_m

    def add(self, first: int, profiles: NDArray[np.complex64]) -> None:
        """Add profiles, (pulse, sample) complex64, of consecutive pulses starting at index `first`."""
        power = np.abs(profiles.astype(np.complex128)) ** 2
        size = self._sum.shape[0]
        for row, line in enumerate(power):
            at = self._offset[first + row] + np.arange(line.size)
            lower = np.floor(at + 1e-9).astype(np.int64)
            upper = np.clip(at - lower, 0, 1)  # linear interpolation, because start paths lie between cells
            for cells, share in ((lower, 1 - upper), (lower + 1, upper)):
                into = np.minimum(cells // self._together, size - 1)
                column = (first + row) // self._pulses
                self._sum[:, column] += np.bincount(into, share * line, minlength=size)
                self._count[:, column] += np.bincount(into, share, minlength=size)

    @property
    def mean(self) -> NDArray[np.float64]:
        """(path, time) float64 mean power; NaN in bins without samples."""
        return np.where(self._count > 0, self._sum / np.maximum(self._count, 1), np.nan)

    def times(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the edges of the time bins, (bin + 1,) float64 seconds, computed from the times of all pulses."""
        starts = time_s[:: self._pulses]
        last = time_s[-1] + (time_s[-1] - time_s[0]) / max(1, len(time_s) - 1)
        return np.append(starts, last if last > starts[-1] else starts[-1] + 1.0)


def draw_waterfall(
    path: Path,
    waterfall: Waterfall,
    time_s: NDArray[np.float64],
    target_path_m: NDArray[np.float64],
    *,
    title: str,
    tags: Mapping[str, str],
    counted: bool = False,
) -> None:
    """Plot a waterfall of range profiles and the total path to the brightest target, as a PNG.

    Parameters
    ----------
    path
        ``….png``; replaced atomically.
    waterfall
        Waterfall that contains all profiles.
    time_s, target_path_m
        (pulse,) float64, time in seconds since the first pulse, and total path to the target in metres.
    title
        Flight and pair.
    tags
        Provenance, stored in the file.
    counted
        True if `time_s` counts pulses, because the recording has no times.
    """
    mean = waterfall.mean
    top = float(np.nanmax(mean)) if np.isfinite(mean).any() else 1.0
    decibel = 10 * np.log10(np.maximum(mean / (top or 1.0), 1e-12))
    with sheet(path, 3.6, title=title, tags=tags) as figure:
        axes = figure.add_subplot()
        edges = np.linspace(*waterfall.span_m, mean.shape[0] + 1)
        cells = np.ma.masked_invalid(decibel)
        drawn = axes.pcolormesh(
            waterfall.times(time_s), edges, cells, cmap="viridis", vmin=-_RANGE_DB, vmax=0, rasterized=True
        )
        drawn_pulses = np.linspace(0, len(time_s) - 1, min(len(time_s), 60)).round().astype(int)
        axes.plot(time_s[drawn_pulses], target_path_m[drawn_pulses], ":", color="white", linewidth=0.9)
        title = "range profiles; the dotted line is the path to the brightest target"
        axes.set(title=title, xlabel=over(counted=counted), ylabel="total path, m")
        axes.yaxis.set_major_locator(MaxNLocator(7))
        axes.grid(visible=False)
        figure.colorbar(drawn, ax=axes, extend="min", pad=0.02).set_label("power relative to the maximum, dB")
