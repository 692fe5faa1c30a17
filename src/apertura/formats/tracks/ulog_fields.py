"""Extraction of positions, attitude and timing fields from a PX4 ULog; run by `read_isolated`."""

import io
import itertools
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.formats.tracks.damage import Span, foreign_bytes, without

RECEIVERS, FUSED, ATTITUDE = ("vehicle_gps_position", "sensor_gps"), "vehicle_global_position", "vehicle_attitude"

DELAY = "EKF2_GPS_DELAY"
"""Parameter: latency of the receiver assumed by the autopilot, ms."""

DAMAGE, DROPOUTS, CORRUPT = "damage", "dropouts", "corrupt"
"""Names of three arrays: spans of bytes that are not valid messages, then (0, total bytes); duration of each logger
dropout, ms; True if pyulog reports damage."""

_BYTES = {
    **dict.fromkeys(("int8_t", "uint8_t", "bool", "char"), 1),
    **dict.fromkeys(("int16_t", "uint16_t"), 2),
    **dict.fromkeys(("int32_t", "uint32_t", "float"), 4),
    **dict.fromkeys(("int64_t", "uint64_t", "double"), 8),
}
_MAGIC = b"ULog\x01\x12\x35"
_HEADER, _MESSAGE = 16, 3
_FLAGS_BYTES = 40
_DEEPEST = 8
_LONGEST = 10_000


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Read ``topic:instance/field`` → values of all messages, and `DELAY` if logged.

    Bytes that are not valid messages are skipped and reported (`DAMAGE`).

    Parameters
    ----------
    path
        A ULog.

    Raises
    ------
    ValueError
        If the fields of a topic have different numbers of values, or the file contains a second log.
    """
    from pyulog import ULog

    data = path.read_bytes()
    second = data.find(_MAGIC, 1)
    if second > 0:  # subscriptions of the second log would replace those of the first log
        raise ValueError(f"a second log starts at byte {second}: separate concatenated logs")
    spans, unread = _foreign(data)
    # the parser reads an undamaged file directly, including appended data
    skipped = sorted([*spans, *unread])
    source: Any = io.BytesIO(without(_joined(data), skipped)) if skipped else str(path)
    log = ULog(source, message_name_filter_list=[*RECEIVERS, FUSED, ATTITUDE])
    fields: dict[str, list[NDArray[Any]]] = {}
    for topic in log.data_list:
        for name, values in topic.data.items():
            fields.setdefault(f"{topic.name}:{topic.multi_id}/{name}", []).append(values)
    arrays = {name: np.concatenate(parts) for name, parts in fields.items()}
    for name, values in arrays.items():
        timestamps = arrays.get(f"{name.partition('/')[0]}/timestamp", values[:0]).size
        if values.size != timestamps:
            raise ValueError(f"{name} has {values.size} values, but its topic {timestamps} timestamps")
    delay = log.initial_parameters.get(DELAY)
    return {
        **arrays,
        **({DELAY: np.array([delay], np.float64)} if isinstance(delay, float) else {}),
        DAMAGE: np.array([*spans, (0, len(data))], np.int64),
        DROPOUTS: np.array([dropout.duration for dropout in log.dropouts], np.int64),
        CORRUPT: np.array([bool(log.file_corruption)]),
    }


def _keyed(data: bytes, at: int, size: int) -> bool:
    """Return True if a payload starts with the length of a key and the key."""
    return 0 < data[at] < size and data[at + 1 : at + 1 + data[at]].isascii()


def _levelled(data: bytes, at: int, size: int) -> bool:
    """Return True if a payload may be a logged text message: level "0" to "7", time stamp, text."""
    return size > 9 and 0x30 <= data[at] <= 0x37


_PLAUSIBLE: Mapping[str, Callable[[bytes, int, int], bool]] = {
    "B": lambda _, at, size: at == _HEADER + _MESSAGE and size >= _FLAGS_BYTES,
    "F": lambda data, at, size: size > 2 and b":" in data[at : at + size] and data[at : at + size].isascii(),
    "I": _keyed,
    "P": _keyed,
    "M": lambda data, at, size: _keyed(data, at + 1, size - 1),
    "Q": lambda data, at, size: _keyed(data, at + 1, size - 1),
    "A": lambda data, at, size: size > 3 and data[at + 3 : at + size].isascii(),
    "R": lambda _, __, size: size == 2,
    "L": _levelled,
    "C": _levelled,
    "S": lambda _, __, size: size == 8,
    "O": lambda _, __, size: size == 2,
}
"""Message type other than data → predicate(data, offset, size) that a payload is plausible."""


class _Messages:
    """Message formats and topics of a ULog that are defined before the current offset."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._formats: dict[str, list[tuple[str, int, str]]] = {}
        self._sizes: dict[int, tuple[int, int]] = {}

    def note(self, at: int) -> None:
        """Store the format or topic that a message defines."""
        kind, text = self._data[at + 2], self._data[at + _MESSAGE : at + self.size(at)]
        if kind == ord("F"):
            name, _, listed = text.decode("latin-1").partition(":")
            self._formats[name] = [_field(field) for field in listed.split(";") if field]
        elif kind == ord("A"):
            size = _sizes(text[3:].decode("latin-1"), self._formats)
            if size is not None:
                self._sizes[text[1] | text[2] << 8] = size

    def size(self, at: int) -> int:
        """Return the length of a message with header; an unknown type or topic must be followed by a known message."""
        size = self._known(at)
        if size or at + _MESSAGE + 2 > len(self._data):
            return size
        kind, size = self._data[at + 2], (self._data[at] | self._data[at + 1] << 8) + _MESSAGE
        is_topic = kind == ord("D") and self._topic(at) not in self._sizes
        unknown = is_topic or (0x41 <= kind <= 0x5A and kind != ord("D") and chr(kind) not in _PLAUSIBLE)
        followed = at + size >= len(self._data) or self._known(at + size) > 0
        return size if unknown and _MESSAGE < size <= _LONGEST and followed else 0

    def _known(self, at: int) -> int:
        """Return the length of a message if it is valid for its type, otherwise 0."""
        if at + _MESSAGE + 2 > len(self._data):
            return 0
        size, kind = self._data[at] | self._data[at + 1] << 8, chr(self._data[at + 2])
        if kind == "D":
            least, most = self._sizes.get(self._topic(at), (1, 0))
            return size + _MESSAGE if least <= size - 2 <= most else 0
        plausible = _PLAUSIBLE.get(kind)
        return size + _MESSAGE if plausible is not None and plausible(self._data, at + _MESSAGE, size) else 0

    def _topic(self, at: int) -> int:
        return self._data[at + _MESSAGE] | self._data[at + _MESSAGE + 1] << 8


def _foreign(data: bytes) -> tuple[list[Span], list[Span]]:
    """Return the spans of a ULog that are not valid messages, and the unread ends of its sections (appended data)."""
    messages, edges = _Messages(data), [_HEADER, *_appended(data), len(data)]
    spans, unread = list[Span](), list[Span]()
    for first, end in itertools.pairwise(edges):
        foreign, ended = foreign_bytes(data, first, end, messages.size, note=messages.note)
        spans += foreign
        unread += [(ended, end)] if ended < end else []
    return spans, unread


def _field(text: str) -> tuple[str, int, str]:
    """Parse type, count and name of a field."""
    kind, _, name = text.partition(" ")
    kind, bracket, count = kind.partition("[")
    return kind, int(count.rstrip("]")) if bracket and count.rstrip("]").isdigit() else 1, name


def _sizes(name: str, formats: dict[str, list[tuple[str, int, str]]], depth: int = 0) -> tuple[int, int] | None:
    """Return the size of a topic's fields in bytes, without and with trailing padding; None if unknown."""
    if name not in formats or depth > _DEEPEST:
        return None
    total = padded = 0
    for kind, count, field in formats[name]:
        inner = _BYTES.get(kind) or (_sizes(kind, formats, depth + 1) or (None, None))[1]
        if inner is None:
            return None
        padded += inner * count
        total = total if field.startswith("_padding") else padded
    return total, padded


def _appended(data: bytes) -> list[int]:
    """Return the offsets of appended data stated in the first message."""
    flags = data[_HEADER + _MESSAGE :][:_FLAGS_BYTES]
    if data[_HEADER + 2 : _HEADER + 3] != b"B" or len(flags) < _FLAGS_BYTES or not flags[8] & 1:
        return []
    offsets = struct.unpack("<3Q", flags[16:])
    return [offset for offset in offsets if _HEADER < offset < len(data)]


def _joined(data: bytes) -> bytes:
    """Remove the offsets of appended data from a ULog from which foreign bytes, and thus gaps, are to be removed."""
    if not _appended(data):
        return data
    at = _HEADER + _MESSAGE
    flags = bytes([data[at + 8] & 0xFE]) + data[at + 9 : at + 16] + bytes(24)
    return data[: at + 8] + flags + data[at + _FLAGS_BYTES :]
