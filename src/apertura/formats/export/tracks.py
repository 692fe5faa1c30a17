"""Tracks as refined, for other programs: RTKLIB solutions, tables, and a picture of what was moved and how sure."""

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
_MOVED, _STATED = "#0072B2", "#D55E00"  # told apart also by who does not see red and green (Okabe and Ito)
_CM = 100.0
_DOTS = 4000  # of a series that are drawn; more would cover each other


@dataclass(frozen=True, eq=False)
class RefinedLog:
    """A node's log with the corrections of a refinement, epoch by epoch.

    Attributes
    ----------
    node
        Its name.
    track
        Stage `track`: the logged point, not an antenna, in the frame of the log.
    moved_m
        (epoch, 3) float64, metres in that frame, to be added to the logged point.
    left_m
        (epoch, 3) float64, metres along the axes of that frame: standard deviation of what the refinement leaves; NaN
        where it did not estimate the node's error.
    stated_m
        (epoch, 3) float64, metres east, north and up: standard deviation that log or config state of the log; NaN
        where neither does.

    Examples
    --------
    >>> begun = np.datetime64("2025-05-14T09:30", "ns")
    >>> track = xr.Dataset(
    ...     {"time": ("epoch", begun + np.arange(2)), "position": (("epoch", "axis"), np.zeros((2, 3)))},
    ...     attrs={"frame": "local"},
    ... )
    >>> moved_m, left_m = np.full((2, 3), 0.03), np.array([[0.01] * 3, [np.nan] * 3])
    >>> RefinedLog("uav1", track, moved_m, left_m, np.full((2, 3), 0.04)).std_m  # the second epoch has no pulses
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
        """True if positions have no place on Earth."""
        return bool(self.track.attrs["frame"] == LOCAL)

    @property
    def refined(self) -> NDArray[np.bool_]:
        """(epoch,) bool, whether images were evaluated there to find the node's error."""
        return np.asarray(np.isfinite(self.left_m).all(axis=1))

    @property
    def position_m(self) -> Floats:
        """(epoch, 3) float64, the logged point as corrected, metres in the frame."""
        return np.asarray(self.track.position.values + self.moved_m)

    @property
    def geodetic(self) -> Floats:
        """(epoch, 3) float64, the same as latitude and longitude (degrees) and metres above the ellipsoid."""
        return geodetic_from_ecef(self.position_m)

    @property
    def correction_m(self) -> Floats:
        """(epoch, 3) float64, metres east, north and up by which the logged point was moved."""
        return np.asarray(np.einsum("nai,na->ni", self._enu, self.moved_m))

    @property
    def std_m(self) -> Floats:
        """(epoch, 3) float64, metres east, north and up: standard deviation of the positions; NaN where nobody knows.

        Notes
        -----
        Source: docs/theory/logs.md, eq. 6 where the images were evaluated, eq. 7 elsewhere.
        """
        turned = np.sqrt(np.einsum("nai,na->ni", self._enu**2, self.left_m**2))
        return np.where(self.refined[:, None], turned, np.hypot(self.stated_m, self.correction_m))

    @property
    def fix(self) -> NDArray[np.int8]:
        """(epoch,) int8, kinds of solution as the log states them, 0 where it does not."""
        return np.asarray(self.track.fix.values) if "fix" in self.track else np.zeros(len(self.moved_m), np.int8)

    @property
    def time_s(self) -> Floats:
        """(epoch,) float64, seconds since the first epoch."""
        times = self.track.time.values
        return seconds_since(times, times[0])

    @property
    def _enu(self) -> Floats:
        """(epoch, axis, 3) float64: east, north and up in the frame, as columns."""
        shape = (len(self.moved_m), 3, 3)
        ned = np.broadcast_to(LOCAL_NED, shape) if self.local else ned_axes(self.track.position.values)
        return np.asarray(ned[..., _NED_OF_ENU] * np.array([1.0, 1.0, -1.0]))


def write_pos(path: Path, log: RefinedLog, *, outcome: str, version: str) -> None:
    """Write a log as refined as an RTKLIB solution by GPS time.

    Parameters
    ----------
    path
        ``….pos``; complete or absent.
    log
        Of a node whose frame has a place on Earth.
    outcome
        Whether tracks were refined, or why they are as logged: a line.
    version
        Of apertura.
    """
    unrefined = int((~log.refined).sum())
    beyond = f"; {unrefined} of {len(log.refined)} epochs lie beyond the pulses, where the nearest correction is held"
    remarks = [
        outcome,
        f"the logged point of {log.node}, no antenna{beyond if log.refined.any() else ''}",
        "deviation 0: nobody states it; Q 5: also for kinds of solution that are not logged",
        "ns, age, ratio and covariances 0: not known, for images moved the positions; Q is the log's; filter by none",
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
    """Write a log as refined as a table, which is itself a log: attitude as logged, and what was added to it.

    Parameters
    ----------
    path
        ``….csv``; complete or absent.
    log
        Of a node, in either frame.
    """
    std_m, correction_m, attitude = log.std_m, log.correction_m, log.track.attitude.values
    further: dict[str, NDArray[np.generic]] = {
        f"std_{axis}_m": std_m[:, _AXES.index(axis)] for axis in ("north", "east", "up")
    }
    if log.fix.any():
        kinds = {number: name for name, number in FIXES.items()}
        further["quality"] = np.array([kinds.get(number, "") for number in log.fix.tolist()])
    further |= {f"correction_{axis}_m": column for axis, column in zip(_AXES, correction_m.T, strict=True)}
    further["refined"] = log.refined.astype(np.int8)
    with replacement(path) as temporary:
        write_csv_log(
            temporary,
            coarsened(log.track.time.values),
            log.position_m if log.local else log.geodetic,
            None if np.isnan(attitude).all() else attitude,
            local=log.local,
            further=further,
        )


def write_picture(path: Path, logs: Sequence[RefinedLog], *, title: str, outcome: str, tags: Mapping[str, str]) -> None:
    """Draw the correction of each log to east, north and up over time with its deviation, as a PNG.

    Where no log was corrected, the logs themselves: their course over ground, and their heights over time.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    logs
        Of a flight: a column each.
    title
        Whose tracks these are.
    outcome
        Whether they were refined, or why they are as logged.
    tags
        Provenance, name → text; lies in the file.
    """
    with matplotlib.style.context("default"), matplotlib.rc_context({"font.size": 8, "text.parse_math": False}):
        corrected = any(log.refined.any() or log.moved_m.any() for log in logs)
        size = (max(6.4, 0.6 + 3.0 * len(logs)), 5.6) if corrected else (6.4, 3.6)
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        if corrected:
            drawn = figure.subplots(3, len(logs), sharex="col", sharey=True, squeeze=False)
            for column, log in zip(drawn.T, logs, strict=True):
                _draw(column, log)
            for axes, name in zip(drawn[:, 0], _AXES, strict=True):
                axes.set_ylabel(f"{name}, cm")
            handles, labels = drawn[0, 0].get_legend_handles_labels()
        else:
            handles, labels = _draw_logged(figure, logs)
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
        wrapped = textwrap.fill(outcome, int(figure.get_figwidth() * 13))
        figure.suptitle(f"{title}\n{wrapped}", fontsize=9)
        with replacement(path) as temporary:
            figure.savefig(temporary, dpi=DPI, metadata={"Title": title, **dict(sorted(tags.items()))})


def _draw_logged(figure: Figure, logs: Sequence[RefinedLog]) -> tuple[list[Any], list[str]]:
    """Draw the course of logs over ground, and their heights; return lines and names for a legend."""
    ground, height = figure.subplots(1, 2)
    first = logs[0].track.position.values[0]
    axes_m = LOCAL_NED if logs[0].local else ned_axes(first[None])[0]
    for log in logs:
        some = np.unique(np.linspace(0, len(log.time_s) - 1, min(len(log.time_s), _DOTS)).round().astype(int))
        north, east, down = ((log.track.position.values[some] - first) @ axes_m).T
        (line,) = ground.plot(east, north, linewidth=1.2, label=log.node)
        ground.plot(east[-1:], north[-1:], "o", color=line.get_color(), markersize=4)
        since_s = seconds_since(log.track.time.values[some], logs[0].track.time.values[0])
        height.plot(since_s, -down, linewidth=1.2, color=line.get_color())
    ground.set_aspect("equal", adjustable="datalim")
    began = np.datetime_as_string(logs[0].track.time.values[0], "s")
    ground.set(xlabel=f"east of the first epoch of {logs[0].node}, m", ylabel="north, m", title="course, dot: end")
    height.set(xlabel=f"time after {began}Z, s", ylabel="height above that epoch, m", title="height")
    for axes in (ground, height):
        axes.grid(visible=True, color="0.9", linewidth=0.6)
    handles, labels = ground.get_legend_handles_labels()
    return list(handles), list(labels)


def _draw(column: Sequence[Axes], log: RefinedLog) -> None:
    """Draw the three axes of a node one below the other: over the refined epochs, if there are any, else the log."""
    time_s, refined = log.time_s, log.refined
    shown = np.flatnonzero(refined) if refined.any() else np.arange(len(time_s))
    margin_s = 0.04 * float(time_s[shown[-1]] - time_s[shown[0]])
    low_s, high_s = time_s[shown[0]] - margin_s, time_s[shown[-1]] + margin_s
    near = np.flatnonzero((time_s >= low_s) & (time_s <= high_s))
    some = near[np.unique(np.linspace(0, len(near) - 1, min(len(near), _DOTS)).round().astype(int))]
    at_s, moved, std, stated = (
        values[some] for values in (time_s, _CM * log.correction_m, _CM * log.std_m, _CM * log.stated_m)
    )
    for number, axes in enumerate(column):
        line, band = moved[:, number], std[:, number]
        axes.fill_between(
            at_s, line - band, line + band, color=_MOVED, alpha=0.25, lw=0, label="± 1 standard deviation"
        )
        axes.plot(at_s, line, color=_MOVED, linewidth=1.0, label="correction of the log")
        for side in (-1, 1):
            label = "± standard deviation stated of the log" if side > 0 else None
            axes.plot(at_s, side * stated[:, number], ":", color=_STATED, linewidth=1.0, label=label)
        for begin, end in stretches(~refined[some]) if refined.any() else ():
            axes.axvspan(at_s[begin], at_s[min(end, len(at_s) - 1)], color="0.92", lw=0, zorder=0)
        axes.grid(visible=True, color="0.9", linewidth=0.6)
        axes.margins(x=0)
    column[0].set_title(log.node, fontsize=9)
    began = np.datetime_as_string(log.track.time.values[0], "ms")
    beyond = "\n(grey: beyond the pulses)" if refined.any() else ""
    column[-1].set_xlabel(f"time after {began}Z, s{beyond}")
