"""Export of refined tracks: RTKLIB solutions, CSV tables, and a plot of corrections and standard deviations."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.atomic import replacement
from apertura.common.units import seconds_since
from apertura.core.geometry.geodesy import LOCAL, LOCAL_NED, geodetic_from_ecef, ned_axes
from apertura.core.geometry.track_checks import stretches
from apertura.formats.campaign_files import write_csv_log
from apertura.formats.export.map_layout import DPI
from apertura.formats.times import coarsened
from apertura.formats.tracks.rtklib import write_rtklib_pos
from apertura.formats.tracks.track import FIXES

_AXES = ("east", "north", "up")
_NED_OF_ENU = [1, 0, 2]
_CORRECTION, _STATED = "#0072B2", "#D55E00"  # distinguishable with red-green colour blindness (Okabe and Ito)
_CM = 100.0
_DOTS = 4000  # maximum number of plotted points of a series


@dataclass(frozen=True, eq=False)
class RefinedLog:
    """Log of a node with the correction of a refinement for each epoch.

    Attributes
    ----------
    node
        Name of the node.
    track
        Stage `track`: positions of the logged point, not of an antenna, in the frame of the log.
    moved_m
        (epoch, 3) float64: correction to be added to the logged point, metres in the frame of the log.
    left_m
        (epoch, 3) float64: standard deviation of the residual error along the axes of the frame, metres; NaN where the
        refinement did not estimate the error of the node.
    stated_m
        (epoch, 3) float64: logged or configured standard deviation of the log to east, north and up, metres; NaN if
        neither logged nor configured.

    Examples
    --------
    >>> start = np.datetime64("2025-05-14T09:30", "ns")
    >>> track = xr.Dataset(
    ...     {"time": ("epoch", start + np.arange(2)), "position": (("epoch", "axis"), np.zeros((2, 3)))},
    ...     attrs={"frame": "local"},
    ... )
    >>> correction_m, residual_m = np.full((2, 3), 0.03), np.array([[0.01] * 3, [np.nan] * 3])
    >>> RefinedLog("uav1", track, correction_m, residual_m, np.full((2, 3), 0.04)).std_m  # second epoch without pulses
    array([[0.01, 0.01, 0.01],
           [0.05, 0.05, 0.05]])
    """

    node: str
    track: xr.Dataset
    moved_m: Floats
    left_m: Floats
    stated_m: Floats

    @property
    def local(self) -> bool:
        """True if positions are in a local frame that is not georeferenced."""
        return bool(self.track.attrs["frame"] == LOCAL)

    @property
    def refined(self) -> NDArray[np.bool_]:
        """(epoch,) bool: True where the error of the node was estimated from images."""
        return np.asarray(np.isfinite(self.left_m).all(axis=1))

    @property
    def position_m(self) -> Floats:
        """(epoch, 3) float64: corrected positions of the logged point, metres in the frame."""
        return np.asarray(self.track.position.values + self.moved_m)

    @property
    def geodetic(self) -> Floats:
        """(epoch, 3) float64: corrected latitude and longitude (degrees), and metres above the ellipsoid."""
        return geodetic_from_ecef(self.position_m)

    @property
    def correction_m(self) -> Floats:
        """(epoch, 3) float64: correction of the logged point to east, north and up, metres."""
        return np.asarray(np.einsum("nai,na->ni", self._enu, self.moved_m))

    @property
    def std_m(self) -> Floats:
        """(epoch, 3) float64: standard deviation of the positions to east, north and up, metres; NaN where unknown.

        Notes
        -----
        Source: docs/theory/logs.md, eq. 6 at refined epochs, eq. 7 elsewhere.
        """
        residual_m = np.sqrt(np.einsum("nai,na->ni", self._enu**2, self.left_m**2))
        return np.where(self.refined[:, None], residual_m, np.hypot(self.stated_m, self.correction_m))

    @property
    def fix(self) -> NDArray[np.int8]:
        """(epoch,) int8: solution types of the log, 0 where not logged."""
        return np.asarray(self.track.fix.values) if "fix" in self.track else np.zeros(len(self.moved_m), np.int8)

    @property
    def time_s(self) -> Floats:
        """(epoch,) float64: seconds since the first epoch."""
        times = self.track.time.values
        return seconds_since(times, times[0])

    @property
    def _enu(self) -> Floats:
        """(epoch, axis, 3) float64: east, north and up in the frame, as columns."""
        shape = (len(self.moved_m), 3, 3)
        ned = np.broadcast_to(LOCAL_NED, shape) if self.local else ned_axes(self.track.position.values)
        return np.asarray(ned[..., _NED_OF_ENU] * np.array([1.0, 1.0, -1.0]))


def write_pos(path: Path, log: RefinedLog, *, outcome: str, version: str) -> None:
    """Write a refined log as an RTKLIB solution in GPS time.

    Parameters
    ----------
    path
        ``….pos``; complete or absent.
    log
        Refined log in a georeferenced frame.
    outcome
        Result of the refinement, or the reason for unchanged tracks, in one line.
    version
        Version of apertura.
    """
    unrefined = int((~log.refined).sum())
    outside = f"; {unrefined} of {len(log.refined)} epochs are before or after the pulses: nearest correction used"
    remarks = [
        outcome,
        f"logged point of {log.node}, not an antenna{outside if log.refined.any() else ''}",
        "standard deviation 0: unknown; Q 5: single, or solution type not logged",
        "ns, age, ratio and covariances 0: unknown (positions refined from images); Q as logged; not for filtering",
    ]
    with replacement(path) as temporary:
        write_rtklib_pos(
            temporary,
            log.track.time.values,
            log.geodetic,
            fix=log.fix,
            std_m=log.std_m[:, _NED_OF_ENU],
            header=(f"program   : apertura {version}",),
            remarks=remarks,
        )


def write_csv(path: Path, log: RefinedLog) -> None:
    """Write a refined log as a CSV log, with logged attitude, standard deviations and corrections.

    Parameters
    ----------
    path
        ``….csv``; complete or absent.
    log
        Refined log in either frame.
    """
    std_m, correction_m, attitude = log.std_m, log.correction_m, log.track.attitude.values
    columns: dict[str, NDArray[np.generic]] = {
        f"std_{axis}_m": std_m[:, _AXES.index(axis)] for axis in ("north", "east", "up")
    }
    if log.fix.any():
        kinds = {number: name for name, number in FIXES.items()}
        columns["quality"] = np.array([kinds.get(number, "") for number in log.fix.tolist()])
    columns |= {f"correction_{axis}_m": column for axis, column in zip(_AXES, correction_m.T, strict=True)}
    columns["refined"] = log.refined.astype(np.int8)
    with replacement(path) as temporary:
        write_csv_log(
            temporary,
            coarsened(log.track.time.values),
            log.position_m if log.local else log.geodetic,
            None if np.isnan(attitude).all() else attitude,
            local=log.local,
            extra_columns=columns,
        )


def write_picture(path: Path, logs: Sequence[RefinedLog], *, title: str, outcome: str, tags: Mapping[str, str]) -> None:
    """Plot the correction of each log to east, north and up over time with its standard deviation, as a PNG.

    If no log is corrected, plot the logs: horizontal tracks, and heights over time.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    logs
        Logs of a flight, one per column.
    title
        Title of the plot.
    outcome
        Result of the refinement, or the reason for unchanged tracks.
    tags
        Provenance, name → text; stored in the file.
    """
    with matplotlib.style.context("default"), matplotlib.rc_context({"font.size": 8, "text.parse_math": False}):
        corrected = any(log.refined.any() or log.moved_m.any() for log in logs)
        size = (max(6.4, 0.6 + 3.0 * len(logs)), 5.6) if corrected else (6.4, 3.6)
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        if corrected:
            panels = figure.subplots(3, len(logs), sharex="col", sharey=True, squeeze=False)
            for column, log in zip(panels.T, logs, strict=True):
                _draw(column, log)
            for axes, name in zip(panels[:, 0], _AXES, strict=True):
                axes.set_ylabel(f"{name}, cm")
            handles, labels = panels[0, 0].get_legend_handles_labels()
        else:
            handles, labels = _draw_logged(figure, logs)
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
        wrapped = textwrap.fill(outcome, int(figure.get_figwidth() * 13))
        figure.suptitle(f"{title}\n{wrapped}", fontsize=9)
        with replacement(path) as temporary:
            figure.savefig(temporary, dpi=DPI, metadata={"Title": title, **dict(sorted(tags.items()))})


def _draw_logged(figure: Figure, logs: Sequence[RefinedLog]) -> tuple[list[Any], list[str]]:
    """Plot horizontal tracks and heights of logs; return lines and labels for a legend."""
    ground, height = figure.subplots(1, 2)
    first = logs[0].track.position.values[0]
    axes_m = LOCAL_NED if logs[0].local else ned_axes(first[None])[0]
    for log in logs:
        epochs = np.unique(np.linspace(0, len(log.time_s) - 1, min(len(log.time_s), _DOTS)).round().astype(int))
        north, east, down = ((log.track.position.values[epochs] - first) @ axes_m).T
        (line,) = ground.plot(east, north, linewidth=1.2, label=log.node)
        ground.plot(east[-1:], north[-1:], "o", color=line.get_color(), markersize=4)
        since_s = seconds_since(log.track.time.values[epochs], logs[0].track.time.values[0])
        height.plot(since_s, -down, linewidth=1.2, color=line.get_color())
    ground.set_aspect("equal", adjustable="datalim")
    start = np.datetime_as_string(logs[0].track.time.values[0], "s")
    ground.set(xlabel=f"east of the first epoch of {logs[0].node}, m", ylabel="north, m", title="track (dot: end)")
    height.set(xlabel=f"time after {start}Z, s", ylabel="height above the first epoch, m", title="height")
    for axes in (ground, height):
        axes.grid(visible=True, color="0.9", linewidth=0.6)
    handles, labels = ground.get_legend_handles_labels()
    return list(handles), list(labels)


def _draw(column: Sequence[Axes], log: RefinedLog) -> None:
    """Plot the three axes of a node one below the other, over the refined epochs or else over the whole log."""
    time_s, refined = log.time_s, log.refined
    epochs = np.flatnonzero(refined) if refined.any() else np.arange(len(time_s))
    margin_s = 0.04 * float(time_s[epochs[-1]] - time_s[epochs[0]])
    low_s, high_s = time_s[epochs[0]] - margin_s, time_s[epochs[-1]] + margin_s
    near = np.flatnonzero((time_s >= low_s) & (time_s <= high_s))
    plotted = near[np.unique(np.linspace(0, len(near) - 1, min(len(near), _DOTS)).round().astype(int))]
    at_s, correction, std, stated = (
        values[plotted] for values in (time_s, _CM * log.correction_m, _CM * log.std_m, _CM * log.stated_m)
    )
    for number, axes in enumerate(column):
        line, band = correction[:, number], std[:, number]
        axes.fill_between(
            at_s, line - band, line + band, color=_CORRECTION, alpha=0.25, lw=0, label="± 1 standard deviation"
        )
        axes.plot(at_s, line, color=_CORRECTION, linewidth=1.0, label="correction of the log")
        for side in (-1, 1):
            label = "± standard deviation of the log (logged or configured)" if side > 0 else None
            axes.plot(at_s, side * stated[:, number], ":", color=_STATED, linewidth=1.0, label=label)
        for begin, end in stretches(~refined[plotted]) if refined.any() else ():
            axes.axvspan(at_s[begin], at_s[min(end, len(at_s) - 1)], color="0.92", lw=0, zorder=0)
        axes.grid(visible=True, color="0.9", linewidth=0.6)
        axes.margins(x=0)
    column[0].set_title(log.node, fontsize=9)
    start = np.datetime_as_string(log.track.time.values[0], "ms")
    legend = "\n(grey: no pulses)" if refined.any() else ""
    column[-1].set_xlabel(f"time after {start}Z, s{legend}")
