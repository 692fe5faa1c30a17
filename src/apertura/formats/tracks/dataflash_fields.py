"""Positions, attitude and parameters in an ArduPilot DataFlash log, binary or text; run by `read_isolated`."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

COLUMNS = {
    "GPS": ("TimeUS", "I", "Status", "GMS", "GWk", "Lat", "Lng", "Alt", "Spd", "GCrs", "VZ"),
    "GPA": ("TimeUS", "I", "HAcc", "VAcc", "VV", "AEl"),
    "ATT": ("TimeUS", "Roll", "Pitch", "Yaw"),
}
"""Message → its columns that are read; those that a version of ArduPilot does not log are NaN."""

NEEDED = tuple(name for name in COLUMNS["GPS"] if name != "I")
"""Columns of GPS that every version since 3.3 logs; one that is not there was damaged."""

_SECOND = {"GPS2": "GPS", "GPA2": "GPA"}  # the second receiver, before it became I = 1 of the same message
_BINARY = b"\xa3\x95"


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Return ``message/column`` → float64 values of every message, and ``PARM/name`` → its last value.

    Parameters
    ----------
    path
        A log, binary or text by its first bytes.

    Raises
    ------
    ValueError
        If it is neither kind, or its GPS messages are of a version without time by week.
    """
    from pymavlink.DFReader import DFReader_binary, DFReader_text

    with path.open("rb") as stream:
        begins = stream.read(8192)
    if not begins.startswith(_BINARY) and b"FMT," not in begins:
        raise ValueError("no FMT message at its beginning")
    log = DFReader_binary(str(path)) if begins.startswith(_BINARY) else DFReader_text(str(path))
    rows: dict[str, list[list[float]]] = {kind: [] for kind in COLUMNS}
    parameters: dict[str, float] = {}
    while (message := log.recv_match(type=[*COLUMNS, *_SECOND, "PARM"], strict=True)) is not None:
        if message.get_type() == "PARM":
            parameters[str(message.Name)] = float(message.Value)
        else:
            kind = _SECOND.get(message.get_type(), message.get_type())
            rows[kind].append(_row(message, kind))
    arrays = {kind: np.array(rows[kind], np.float64).reshape(-1, len(names)) for kind, names in COLUMNS.items()}
    named = {f"{kind}/{name}": arrays[kind][:, n] for kind, names in COLUMNS.items() for n, name in enumerate(names)}
    return {**named, **{f"PARM/{name}": np.array([value]) for name, value in parameters.items()}}


def _row(message: Any, kind: str) -> list[float]:
    """Return the columns of a message; NaN where its version has none."""
    there = set(message.get_fieldnames())
    if len(message.fmt.columns) != len(message.fmt.format):
        raise ValueError(f"{message.get_type()} has {len(message.fmt.columns)} columns of {message.fmt.format!r}")
    lacking = [name for name in NEEDED if kind == "GPS" and name not in there]
    if lacking:
        raise ValueError(f"{message.get_type()} messages without {', '.join(lacking)}")
    values = {"I": float(message.get_type() in _SECOND), **{name: getattr(message, name) for name in there}}
    return [float(values.get(name, math.nan)) for name in COLUMNS[kind]]
