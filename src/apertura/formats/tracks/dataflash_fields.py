"""Extraction of positions, attitude and parameters from a DataFlash log, binary or text; run by `read_isolated`."""

import math
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.formats.tracks.damage import Span, foreign_bytes, without

COLUMNS = {
    "GPS": ("TimeUS", "I", "Status", "GMS", "GWk", "Lat", "Lng", "Alt", "Spd", "GCrs", "VZ"),
    "GPA": ("TimeUS", "I", "HAcc", "VAcc", "VV", "AEl"),
    "ATT": ("TimeUS", "Roll", "Pitch", "Yaw"),
}
"""Message → columns that are read; NaN for columns that the version of ArduPilot does not log."""

NEEDED = tuple(name for name in COLUMNS["GPS"] if name != "I")
"""GPS columns that every version since 3.3 logs; a missing column indicates a damaged log."""

_SECOND = {"GPS2": "GPS", "GPA2": "GPA"}  # second receiver in older versions; newer versions log it as I = 1
_BINARY = b"\xa3\x95"
_FMT, _FMT_BYTES = 128, 89
DAMAGE = {"bytes": "damage/bytes", "lines": "damage/lines"}
"""Spans of bytes or text lines that are not valid messages, then (0, total number)."""


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Read ``message/column`` → float64 values of all messages, and ``PARM/name`` → its last value.

    Bytes or lines that are not valid messages are skipped and reported (`DAMAGE`).

    Parameters
    ----------
    path
        A log; its first bytes determine whether it is binary or text.

    Raises
    ------
    ValueError
        If the file is neither a binary nor a text log, or its GPS messages lack required columns such as the GPS week.
    """
    from pymavlink.DFReader import DFReader_binary, DFReader_text

    data = path.read_bytes()
    is_text = b"FMT," in data[:8192]
    is_binary = not is_text and _BINARY in data[:8192]
    if not is_binary and not is_text:
        raise ValueError("no FMT message at the start of the file")
    with ExitStack() as stack:
        name = str(path)
        if is_binary:
            spans, ended = _foreign(data)
            if spans:  # the parser stops at an unknown type, and reads only from files
                file = stack.enter_context(tempfile.NamedTemporaryFile())
                file.write(without(data[:ended], spans))
                file.flush()
                name = file.name
            unit, size = "bytes", len(data)
            log = stack.enter_context(DFReader_binary(name))
        else:
            spans, size = _wrong_lines(data)
            unit = "lines"
            log = stack.enter_context(DFReader_text(name))
        arrays = _columns(log)
    return {**arrays, DAMAGE[unit]: np.array([*spans, (0, size)], np.int64)}


def _columns(log: Any) -> dict[str, NDArray[Any]]:
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


def _foreign(data: bytes) -> tuple[list[Span], int]:
    """Find the spans of a binary log that are not valid messages, and the end of the last message."""
    lengths = {_FMT: _FMT_BYTES}

    def message_bytes(at: int) -> int:
        return lengths.get(data[at + 2], 0) if data[at : at + 2] == _BINARY and at + 2 < len(data) else 0

    def note(at: int) -> None:
        if data[at + 2] == _FMT:
            lengths[data[at + 3]] = data[at + 4]

    return foreign_bytes(data, 0, len(data), message_bytes, note=note)


def _wrong_lines(data: bytes) -> tuple[list[Span], int]:
    """Find the lines of a text log, numbered from 1, with unknown type or too few columns, and count all lines."""
    columns, wrong = {"FMT": 5}, list[Span]()
    lines = data[data.find(b"FMT,") :].splitlines()
    for number, line in enumerate(lines, 1 + data[: data.find(b"FMT,")].count(b"\n")):
        cells = [cell.strip() for cell in line.decode("utf-8", errors="replace").split(",")]
        if cells[0] == "FMT" and len(cells) > 4:
            columns[cells[3]] = len(cells[4])
        if line.strip() and number < len(lines) and len(cells) - 1 < columns.get(cells[0], 1 << 16):
            wrong.append((number, number + 1))
    return wrong, len(lines)


def _row(message: Any, kind: str) -> list[float]:
    """Return the columns of a message; NaN for columns missing in this version of ArduPilot."""
    fields = set(message.get_fieldnames())
    if len(message.fmt.columns) != len(message.fmt.format):
        raise ValueError(
            f"{message.get_type()} has {len(message.fmt.columns)} columns but format {message.fmt.format!r}"
        )
    missing = [name for name in NEEDED if kind == "GPS" and name not in fields]
    if missing:
        raise ValueError(f"{message.get_type()} messages without {', '.join(missing)}")
    values = {"I": float(message.get_type() in _SECOND), **{name: getattr(message, name) for name in fields}}
    return [float(values.get(name, math.nan)) for name in COLUMNS[kind]]
