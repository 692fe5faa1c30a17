"""Previews of tracks, recordings, phase histories, height rasters, and the times of a campaign."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter
from numpy.typing import NDArray

from apertura.check.times import LOST_CAPTURE, Span, gaps, interval_s, utc
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import number_of, shown
from apertura.common.units import seconds_since
from apertura.core.geometry.geodesy import geodetic_from_ecef, ned_axes
from apertura.core.geometry.track_checks import LONG_GAP
from apertura.formats.tracks.track import FIXES

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from apertura.formats.recordings.recording import Recording

_COLOURS = {
    "not stated": "0.4",
    "fix": "tab:green",
    "float": "tab:olive",
    "sbas": "tab:orange",
    "dgps": "tab:orange",
    "single": "tab:red",
    "ppp": "tab:blue",
}
_ROWS = 256  # maximum number of pulses or captures drawn
_COLUMNS = 1024
_FLOOR_DB = -60.0

Floats = NDArray[np.floating[Any]]


def draw_log(track: "xr.Dataset", name: str) -> Figure:
    """Plot a track in plan view, and its heights and epoch intervals over time.

    Colours distinguish fix types; gaps are red.
    """
    figure = _figure(name, (11, 6))
    grid = figure.add_gridspec(2, 2)
    plan, height = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    steps = figure.add_subplot(grid[1, 1], sharex=height)
    position, times, frame = track.position.values, track.time.values, track.attrs["frame"]
    local_m, time_s = east_north_up(position, frame, np.median(position, axis=0)), seconds_since(times, times[0])
    for fix, epochs in _by_fix(track).items():
        label, colour = f"{fix}, {number_of(int(epochs.sum()), 'epoch')}", _COLOURS[fix]
        plan.plot(local_m[epochs, 0], local_m[epochs, 1], ".", color=colour, label=label, markersize=2.5)
        height.plot(time_s[epochs], local_m[epochs, 2], ".", color=colour, markersize=2.5)
    for number, epoch in enumerate(gaps(times, LONG_GAP)):
        ends = slice(epoch - 1, epoch + 1)
        plan.plot(*local_m[ends, :2].T, "r--", linewidth=1, label="gap" if number == 0 else None)
        height.axvspan(*time_s[ends], color="red", alpha=0.2)
    plan.plot(*local_m[0, :2], "k^", label="first epoch")
    earth = frame == "ecef"
    _named(plan, "east of the median, m" if earth else "x, m", "north of the median, m" if earth else "y, m")
    plan.set_aspect("equal", adjustable="datalim")
    plan.legend(loc="best", fontsize="small")
    _named(height, "", "height above the ellipsoid, m" if earth else "z, m")
    _intervals(steps, time_s[1:], times)
    _named(steps, f"seconds since {utc(times[0])}", "interval to the previous epoch, s")
    return figure


def east_north_up(position_m: NDArray[np.float64], frame: str, middle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert (n, 3) positions to metres east and north of a reference point and height above the ellipsoid.

    Positions in a local frame are returned unchanged.

    Examples
    --------
    >>> east_north_up(np.array([[6378147.0, 30.0, 40.0]]), "ecef", np.array([6378137.0, 0.0, 0.0])).round(3)[:, :2]
    array([[30., 40.]])
    """
    if frame != "ecef":
        return position_m
    north_east = ((position_m - middle) @ ned_axes(middle))[:, :2]
    return np.column_stack([north_east[:, ::-1], geodetic_from_ecef(position_m)[:, 2]])


def _intervals(axes: "Axes", across: NDArray[Any], times: NDArray[np.datetime64]) -> None:
    """Plot intervals between consecutive times, s; on a log scale if intervals differ by more than a factor of 10."""
    steps = np.diff(times) / np.timedelta64(1, "s")
    axes.plot(across, steps, "k.", markersize=2.5)
    if steps.max() > 10 * steps.min():
        axes.set_yscale("log")
    else:
        axes.set_ylim(0, 1.2 * float(steps.max()))


def _by_fix(track: "xr.Dataset") -> dict[str, NDArray[np.bool_]]:
    """Return fix type → (epoch,) bool, True for epochs of that type."""
    kinds = track.fix.values if "fix" in track else np.zeros(track.sizes["epoch"], np.int8)
    masks = {"fix" if kind == 1 else name: kinds == kind for name, kind in FIXES.items()}
    masks["not stated"] = ~np.isin(kinds, list(FIXES.values()))
    return {name: mask for name, mask in masks.items() if mask.any()}


def draw_recording(recording: "Recording", samples: NDArray[np.complex64], name: str) -> Figure:
    """Plot the intervals between captures and the amplitude of the first captures in each channel."""
    several = len(recording.captures.time) > 1
    count = len(recording.channels) + several
    figure = _figure(name, (11, 0.5 + 2.7 * count))
    axes = list(np.ravel(figure.subplots(count, 1)))
    if several:
        _captures(axes.pop(0), recording.captures.time)
    length_us = samples.shape[1] / recording.sample_rate_hz * 1e6
    for channel, panel, values in zip(recording.channels, axes, np.moveaxis(samples, 2, 0), strict=True):
        level_db, label = _decibels(values), f"dB relative to the maximum, {shown(channel)}"
        if several:
            _image(panel, level_db, (0.0, length_us), label)
            _named(panel, "time in the capture, µs", "capture")
        else:
            panel.plot(np.linspace(0, length_us, level_db.shape[1], endpoint=False), level_db[0], "k", linewidth=0.6)
            _named(panel, f"time since {utc(recording.captures.time[0])}, µs", label)
    return figure


def _captures(axes: "Axes", times: NDArray[np.datetime64]) -> None:
    """Plot the intervals between captures; red lines mark missing captures."""
    _intervals(axes, np.arange(1, len(times)), times)
    for capture in gaps(times, LOST_CAPTURE)[:_ROWS]:
        axes.axvline(capture, color="red", linewidth=0.6)
    typical_s = interval_s(times)
    axes.axhline(typical_s, color="tab:blue", linewidth=0.8, label=f"typical: {typical_s:.6g} s")
    axes.legend(loc="lower right", fontsize="small")
    label = f"capture number, first capture at {utc(times[0])}; red: first capture after a gap"
    _named(axes, label, "interval to the previous capture, s")


def draw_history(echo: "xr.Dataset", name: str) -> Figure:
    """Plot range profiles of pulses at regular intervals over the flight, and the antenna positions in plan view."""
    placed = "tx_position" in echo
    figure = _figure(name, (11, 5))
    grid = figure.add_gridspec(1, 1 + placed, width_ratios=(1.6, 1)[: 1 + placed])
    profiles = figure.add_subplot(grid[0])
    pulses = np.unique(np.linspace(0, echo.sizes["pulse"] - 1, _ROWS).astype(int))
    transfer, frequency = np.asarray(echo.transfer[pulses].values), echo.frequency.values
    window = np.hanning(frequency.size + 2)[1:-1]
    profile = np.fft.fftshift(np.fft.ifft(transfer * window, axis=1), axes=1)
    reach_m = SPEED_OF_LIGHT_M_S * (frequency.size - 1) / max(float(np.ptp(frequency)), 1.0) / 2
    count = echo.sizes["pulse"]
    _image(profiles, _decibels(profile), (-reach_m, reach_m), "dB relative to the maximum", rows=count)
    _named(profiles, "path relative to the reference, m", f"pulse ({len(pulses)} of {count} drawn)")
    if placed:
        plan = figure.add_subplot(grid[1])
        frame, middle = echo.attrs["frame"], np.median(echo.tx_position.values, axis=0)
        for leg, style, size in (("tx", "k.", 5), ("rx", "r.", 2)):
            local_m = east_north_up(echo[f"{leg}_position"].values, frame, middle)
            plan.plot(local_m[:, 0], local_m[:, 1], style, markersize=size, label=leg)
        _named(plan, *(("east of the median, m", "north of the median, m") if frame == "ecef" else ("x, m", "y, m")))
        plan.set_aspect("equal", adjustable="datalim")
        plan.legend(loc="best", fontsize="small")
    return figure


def draw_heights(heights: NDArray[np.float32], extent: tuple[float, ...], name: str, *, unit: str) -> Figure:
    """Plot a raster of heights (in `unit`) as a map; `extent` is left, bottom, right, top in the CRS of the raster."""
    figure = _figure(name, (7, 6))
    axes = figure.subplots()
    left, bottom, right, top = extent
    drawn = axes.imshow(
        heights, extent=(left, right, bottom, top), cmap="terrain", aspect="auto", interpolation="nearest"
    )
    figure.colorbar(drawn, ax=axes, label=f"height in the datum of the raster, {unit}")
    _named(axes, "x in the CRS of the raster", "y in the CRS of the raster")
    return figure


def draw_campaign(spans: Mapping[tuple[str, str], Mapping[str, Span]], name: str) -> Figure:
    """Plot the time spans of recording and log of each node, in seconds since the first time of each flight."""
    flights = list(dict.fromkeys(flight for flight, _ in spans)) or [""]
    figure = _figure(name, (10, 1.5 + 1.2 * len(spans)))
    for axes, flight in zip(np.ravel(figure.subplots(len(flights), 1)), flights, strict=True):
        nodes = {node: node_spans for (span_flight, node), node_spans in spans.items() if span_flight == flight}
        start = min(
            (first for node_spans in nodes.values() for first, _ in node_spans.values()),
            default=np.datetime64("NaT", "ns"),
        )
        for row, node_spans in enumerate(nodes.values()):
            for kind, (first, last) in node_spans.items():
                start_s, length_s = (float(step / np.timedelta64(1, "s")) for step in (first - start, last - first))
                colour, lift = ("tab:blue", 0.05) if kind == "recorded" else ("tab:green", -0.35)
                axes.barh(row + lift, length_s, left=start_s, height=0.3, align="edge", color=colour)
        axes.set_yticks(range(len(nodes)), [shown(node) for node in nodes])
        since = "" if np.isnat(start) else f", seconds since {utc(start)}"
        _named(axes, f"{shown(flight)}{since}; blue: recorded, green: logged", "")
    return figure


def _figure(name: str, size: tuple[float, float]) -> Figure:
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(shown(name, 100), parse_math=False)
    return figure


def _named(axes: "Axes", across: str, up: str) -> None:
    axes.set_xlabel(across, parse_math=False)
    axes.set_ylabel(up, parse_math=False)
    axes.grid(visible=True, linewidth=0.3)
    for axis in (axes.xaxis, axes.yaxis):
        digits = axis.get_major_formatter()
        if isinstance(digits, ScalarFormatter):
            digits.set_useOffset(False)


def _decibels(values: NDArray[np.complexfloating]) -> Floats:
    """Return amplitudes in dB relative to the maximum, reduced to at most `_COLUMNS` columns by block maxima."""
    amplitude = np.abs(values)
    fold = -(-amplitude.shape[1] // _COLUMNS)
    padded = np.pad(amplitude, ((0, 0), (0, -amplitude.shape[1] % fold)))
    coarse = padded.reshape(len(amplitude), -1, fold).max(axis=2)
    largest = float(coarse.max()) or 1.0
    return np.asarray(20 * np.log10(np.maximum(coarse / largest, 10 ** (_FLOOR_DB / 20))))


def _image(axes: "Axes", level_db: Floats, across: tuple[float, float], label: str, *, rows: int | None = None) -> None:
    """Draw levels as an image; `rows` is the number of rows on the vertical axis if only some rows are drawn."""
    extent = (*across, rows or len(level_db), 0)
    drawn = axes.imshow(level_db, extent=extent, aspect="auto", cmap="viridis", vmin=_FLOOR_DB, vmax=0)
    axes.figure.colorbar(drawn, ax=axes, label=label)
