"""Motion captures exported by OptiTrack's Motive (CSV): rigid bodies in a room, the local frame of the campaign."""

import csv
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.documents import read_text
from apertura.common.errors import CampaignError, quoted
from apertura.formats.tracks.csv_track import LARGEST_LOG, number
from apertura.formats.tracks.log_options import DEFAULT_OPTIONS, LogOptions
from apertura.formats.tracks.track import make_track, start_time, unstated

_METRES = {"meters": 1.0, "centimeters": 0.01, "millimeters": 0.001}
_NEEDED = [("Rotation", axis) for axis in "XYZW"] + [("Position", axis) for axis in "XYZ"]
_HEADING_LINES = 12
_UNIT = 0.01
_EXPECTED = "Motive's CSV: rigid bodies with rotation (quaternion) and position, global coordinates"
_REMEDY = "Export the take with these settings."

_ENU_FROM_MOTIVE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rows are east, north and up in Motive's x, y (up) and z."""

_NED_FROM_MOTIVE = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rows are the north, east and down axes in Motive's x, y (up) and z. They coincide with the forward, right and down
axes of the body if it was level and facing north when the rigid body was defined."""


def read_optitrack(path: Path, *, node: str, options: LogOptions = DEFAULT_OPTIONS) -> xr.Dataset:
    """Read a rigid body of a motion capture as `track` stage; options.body selects one of several bodies.

    The frame is 'local': east is Motive's x, north is −z, up is y. The body axes forward, right and down are Motive's
    −z, x and −y at the time when the body was defined. Times are options.start_utc plus the seconds of the take,
    because the Capture Start Time of a take is local time without a zone. Frames in which the body was not tracked are
    excluded and counted.

    Raises
    ------
    CampaignError
        If the file is not a Motive table, the body is missing or not selected, a line is incomplete, or start_utc is
        not configured.

    Notes
    -----
    Source: equations in docs/theory/logs.md, "Motion capture". Motive's documentation, "Data Export: CSV".
    """
    text = read_text(path, expected=_EXPECTED, remedy=_REMEDY, largest=LARGEST_LOG // 2)
    lines = text.splitlines()
    try:
        heading = list(csv.reader(lines[:_HEADING_LINES]))
    except csv.Error as error:
        raise _error(f"header: {error}", path) from error
    first = next((row for row, cells in enumerate(heading) if cells[:1] == ["Frame"]), None)
    if first is None:
        raise _error("no line that starts with Frame", path)
    scale = _metres(heading[0], path)
    columns = _columns(heading[: first + 1], options.body, node=node, where=path)
    cut = text[-1] not in "\r\n" and len(lines) > first + 1
    time_s, values = _numbers(lines[first + 1 : len(lines) - cut], len(heading[first]), columns, first + 2, path)
    tracked = np.isfinite(values).all(axis=1)
    if (np.isfinite(values).any(axis=1) & ~tracked).any():
        row = int(np.flatnonzero(np.isfinite(values).any(axis=1) & ~tracked)[0])
        raise _error(f"incomplete pose at {time_s[row]:g} s", path)
    quaternion, position = values[tracked, :4], values[tracked, 4:] * scale
    if (np.abs(np.linalg.norm(quaternion, axis=1) - 1) > _UNIT).any():
        raise _error("a rotation that is not a unit quaternion", path)
    found = "seconds since the start of the capture, which is local time without a zone"
    start = start_time(options, found, node=node, where=path)
    counts = {"body not tracked": int((~tracked).sum()), "truncated line": int(cut)}
    return make_track(
        start + np.round(time_s[tracked] * 1e9).astype("timedelta64[ns]"),
        position @ _ENU_FROM_MOTIVE.T,
        frame="local",
        attitude_deg=_attitude_deg(quaternion),
        dropped={reason: count for reason, count in counts.items() if count},
        node=node,
        where=path,
    )


def _metres(cells: list[str], path: Path) -> float:
    """Return the length unit of the take in metres; check the other fields of its first line."""
    fields = dict(zip(cells[::2], cells[1::2], strict=False))
    for key, valid in (("Rotation Type", ["quaternion"]), ("Coordinate Space", ["global"]), ("Length Units", _METRES)):
        if fields.get(key, "").lower() not in valid:
            raise _error(f"{key} {quoted(fields.get(key, ''))}, not {' or '.join(valid)}", path)
    return _METRES[fields["Length Units"].lower()]


def _columns(heading: list[list[str]], body: str | None, *, node: str, where: Path) -> list[int]:
    """Return the columns of time, quaternion (x, y, z, w) and position of a rigid body."""
    width = len(heading[-1])
    rows = [row for row in heading[1:] if len(row) == width]
    titled = {row[1]: row for row in rows if row[0] == ""}
    kinds, names, quantities, axes = titled.get("Type"), titled.get("Name"), titled.get(""), heading[-1]
    if kinds is None or names is None or quantities is None or axes[1] != "Time (Seconds)":
        raise _error("header lines Type, Name, Rotation and Position, or Time (Seconds) missing", where)
    column_of = {
        (name, quantity, axis): column
        for column, (kind, name, quantity, axis) in enumerate(zip(kinds, names, quantities, axes, strict=True))
        if kind == "Rigid Body"
    }
    bodies = list(dict.fromkeys(name for name, _, _ in column_of))
    listed = ", ".join(quoted(name, 40) for name in bodies)
    if body is None and len(bodies) != 1:
        raise unstated("body", f"rigid bodies {listed}" if bodies else "no rigid body", node=node, where=where)
    chosen = body if body is not None else bodies[0]
    if chosen not in bodies:
        raise _error(f"no rigid body {quoted(chosen, 40)} among {listed}", where)
    missing = [f"{quantity} {axis}" for quantity, axis in _NEEDED if (chosen, quantity, axis) not in column_of]
    is_repeated = names.count(chosen) != len([key for key in column_of if key[0] == chosen])
    if missing or is_repeated:
        raise _error(f"{missing[0] if missing else 'columns'} of body {quoted(chosen, 40)} missing or repeated", where)
    return [1, *(column_of[chosen, quantity, axis] for quantity, axis in _NEEDED)]


def _numbers(
    lines: list[str], width: int, columns: list[int], first: int, path: Path
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Parse seconds (frame,) and poses (frame, 7), NaN for empty cells; `first` is the number of the first line."""
    rows = []
    for line, text in enumerate(lines, first):
        if not text.strip():
            continue
        cells = text.split(",")
        if len(cells) != width:
            raise _error(f"line {line} has {len(cells)} cells, the header {width}", path)
        try:
            rows.append([number(cells[column].strip()) if cells[column].strip() else np.nan for column in columns])
        except ValueError as error:
            raise _error(f"line {line}: {error}", path) from error
    values = np.array(rows).reshape(-1, len(columns))
    beyond = np.flatnonzero(~(np.abs(values[:, 0]) < 1e6))
    if beyond.size:
        raise _error(f"a time of {values[beyond[0], 0]:g} s, beyond ±1e6 s", path)
    return values[:, 0], values[:, 1:]


def _attitude_deg(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert quaternions (frame, 4) x, y, z, w to roll, pitch and yaw: Rz(yaw)·Ry(pitch)·Rx(roll) = N·Q·Nᵀ."""
    from scipy.spatial.transform import Rotation  # slow to import

    ned_from_body = _NED_FROM_MOTIVE @ Rotation.from_quat(quaternion).as_matrix() @ _NED_FROM_MOTIVE.T
    return np.asarray(Rotation.from_matrix(ned_from_body).as_euler("ZYX", degrees=True)[:, ::-1])


def _error(found: str, path: Path) -> CampaignError:
    return CampaignError(found, path, _EXPECTED, _REMEDY)
