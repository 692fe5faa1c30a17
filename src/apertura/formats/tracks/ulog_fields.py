"""Positions, attitude and what places them in time in a PX4 ULog; run by `read_isolated`."""

import io
import itertools
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.formats.tracks.damage import Span, foreign_bytes, without

RECEIVERS, FUSED, ATTITUDE = ("vehicle_gps_position", "sensor_gps"), "vehicle_global_position", "vehicle_attitude"

DELAY = "EKF2_GPS_DELAY"
"""Parameter: by how many milliseconds the autopilot takes its receiver to be late."""

DAMAGE, DROPOUTS, CORRUPT = "damage", "dropouts", "corrupt"
"""Spans of bytes that are no messages, then (0, bytes in all); milliseconds of each dropout of the logger; whether
pyulog finds damage besides."""

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
_UNKNOWN = 1 << 16


def read_fields(path: Path) -> dict[str, NDArray[Any]]:
    """Return ``topic:instance/field`` → values of every message, and `DELAY` where it is logged.

    Bytes that are no messages are left out (`DAMAGE`), and reading resumes behind them.

    Parameters
    ----------
    path
        A ULog.

    Raises
    ------
    ValueError
        If fields of a topic do not belong together.
    """
    from pyulog import ULog

    data = path.read_bytes()
    second = data.find(_MAGIC, 1)
    if second > 0:  # whose subscriptions would replace those of the first, and their messages with them
        raise ValueError(f"another log begins at byte {second}: separate logs that were joined")
    spans, unread = _foreign(data)
    # where every byte is a message the parser reads the file by itself, data that were appended included
    left_out = sorted([*spans, *unread])
    source: Any = io.BytesIO(without(_joined(data), left_out)) if left_out else str(path)
    log = ULog(source, message_name_filter_list=[*RECEIVERS, FUSED, ATTITUDE])
    fields: dict[str, list[NDArray[Any]]] = {}
    for topic in log.data_list:
        for name, values in topic.data.items():
            fields.setdefault(f"{topic.name}:{topic.multi_id}/{name}", []).append(values)
    arrays = {name: np.concatenate(parts) for name, parts in fields.items()}
    for name, values in arrays.items():
        if values.size != arrays.get(f"{name.partition('/')[0]}/timestamp", values[:0]).size:
            raise ValueError(f"{name} has {values.size} values, its topic's timestamp another number")
    delay = log.initial_parameters.get(DELAY)
    return {
        **arrays,
        **({DELAY: np.array([delay], np.float64)} if isinstance(delay, float) else {}),
        DAMAGE: np.array([*spans, (0, len(data))], np.int64),
        DROPOUTS: np.array([dropout.duration for dropout in log.dropouts], np.int64),
        CORRUPT: np.array([bool(log.file_corruption)]),
    }


def _foreign(data: bytes) -> tuple[list[Span], list[Span]]:
    """Return the spans of a ULog that are no messages, and what its sections end with: data may have been appended."""
    sizes, formats = dict[int, tuple[int, int]](), dict[str, list[tuple[str, int, str]]]()

    def message_bytes(at: int) -> int:
        if at + _MESSAGE + 2 > len(data):
            return 0
        size, kind = data[at] | data[at + 1] << 8, chr(data[at + 2])
        first, second = data[at + 3], data[at + 4]
        least, most = sizes.get(first | second << 8, (0, _UNKNOWN)) if kind == "D" else (0, 0)
        good = {
            "D": least + 2 <= size <= most + 2,
            "L": size > 9 and 0x30 <= first <= 0x37,  # a level, "0" to "7"
            "S": size == 8,
            "O": size == 2,
            "I": 1 < first + 1 < size,  # the length of a key, and the key
            "P": 1 < first + 1 < size,
            "M": 1 < second + 2 < size,
            "Q": 1 < second + 2 < size,
        }.get(kind, kind.isascii() and kind.isupper() and 0 < size <= _LONGEST)
        if kind not in "LSOIPMQFAB" and most in {
            0,
            _UNKNOWN,
        }:  # of no known size: judged by what follows
            following = data[at + _MESSAGE + size + 2 : at + 2 * _MESSAGE + size]
            good = good and (not following or following.isupper())
        return size + _MESSAGE if good else 0

    def note(at: int) -> None:
        kind, text = data[at + 2], data[at + _MESSAGE : at + message_bytes(at)]
        if kind == ord("F"):
            name, _, described = text.decode("latin-1").partition(":")
            formats[name] = [_field(one) for one in described.split(";") if one]
        elif kind == ord("A") and len(text) > 3:
            size = _sizes(text[3:].decode("latin-1"), formats)
            if size is not None:
                sizes[text[1] | text[2] << 8] = size

    edges = [_HEADER, *_appended(data), len(data)]
    spans, unread = list[Span](), list[Span]()
    for first, end in itertools.pairwise(edges):
        found, ended = foreign_bytes(data, first, end, message_bytes, note=note)
        spans += found
        unread += [(ended, end)] if ended < end else []
    return spans, unread


def _field(text: str) -> tuple[str, int, str]:
    """Return type, count and name of a field."""
    kind, _, name = text.partition(" ")
    kind, bracket, count = kind.partition("[")
    return kind, int(count.rstrip("]")) if bracket and count.rstrip("]").isdigit() else 1, name


def _sizes(name: str, formats: dict[str, list[tuple[str, int, str]]], depth: int = 0) -> tuple[int, int] | None:
    """Return the bytes of a topic's fields, without and with padding at the end; None where they are not known."""
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
    """Return where data were appended, as the first message states."""
    flags = data[_HEADER + _MESSAGE :][:_FLAGS_BYTES]
    if data[_HEADER + 2 : _HEADER + 3] != b"B" or len(flags) < _FLAGS_BYTES or not flags[8] & 1:
        return []
    offsets = struct.unpack("<3Q", flags[16:])
    return [one for one in offsets if _HEADER < one < len(data)]


def _joined(data: bytes) -> bytes:
    """Return a ULog that states no appended data: those follow the others once foreign bytes are left out."""
    if not _appended(data):
        return data
    at = _HEADER + _MESSAGE
    flags = bytes([data[at + 8] & 0xFE]) + data[at + 9 : at + 16] + bytes(24)
    return data[: at + 8] + flags + data[at + _FLAGS_BYTES :]
