"""Detection and removal of bytes in a binary log that are not valid messages, by a walk from message to message.

Parsers stop at such bytes, or skip them, without a warning: pyulog at the first message that extends beyond the end of
the file, pymavlink at the first unknown type.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

_CHAIN = 3
"""Consecutive valid messages required to resume reading; a random header is plausible with probability 1/256."""

Span = tuple[int, int]
"""Offset of the first byte, and offset of the byte after the last."""


def foreign_bytes(
    data: bytes, first: int, end: int, message_bytes: Callable[[int], int], *, note: Callable[[int], None]
) -> tuple[list[Span], int]:
    """Find the spans of a log that are not valid messages, and the end of the last message.

    Each span includes the message before the invalid bytes, because that message may be truncated and end with foreign
    bytes. A message truncated by the end of the log, and padding after the last message, are not damage.

    Parameters
    ----------
    data
        The log.
    first, end
        Offsets of the first message and of the end of the messages.
    message_bytes
        Length of the message at an offset, including its header; 0 if no message starts there.
    note
        Called in order with the offset of each valid message, to update the state of `message_bytes`.

    Examples
    --------
    >>> log = b"aaabb" + bytes([0, 7, 9]) + b"aaabbaaa"
    >>> length = {ord("a"): 3, ord("b"): 2}
    >>> foreign_bytes(log, 0, 16, lambda at: length.get(log[at], 0), note=lambda at: None)
    ([(3, 8)], 16)
    """
    spans, at, last = list[Span](), first, first
    while at < end:
        size = message_bytes(at)
        if size and at + size <= end:
            note(at)
            at, last = at + size, at
            continue
        resumed = next((offset for offset in range(last + 1, end) if _chain(offset, end, message_bytes)), end)
        tail = data[at:end]
        if resumed == end and (size or tail == tail[:1] * len(tail)):
            break
        spans.append((last, resumed))
        at = last = resumed
    return spans, at


def _chain(at: int, end: int, message_bytes: Callable[[int], int]) -> bool:
    """Return True if consecutive messages start at an offset."""
    for _ in range(_CHAIN):
        size = message_bytes(at)
        if not size or at + size > end:
            return False
        at += size
        if at == end:
            return True
    return True


def without(data: bytes, spans: Sequence[Span]) -> bytes:
    """Remove spans of bytes from a log.

    Examples
    --------
    >>> without(b"abcdef", [(1, 3), (4, 5)])
    b'adf'
    """
    view, edges = memoryview(data), [0, *(edge for span in spans for edge in span), len(data)]
    return b"".join(view[begin:stop] for begin, stop in zip(edges[::2], edges[1::2], strict=True))


def damage_of(spans: NDArray[np.int64], unit: str = "bytes") -> str:
    """Describe the spans of a log that are not valid messages in one line; empty if there are none.

    Parameters
    ----------
    spans
        (span, 2) int64: first byte or line, and the byte or line after the last; the last row is the whole log.
    unit
        Unit of the spans, bytes or lines.

    Examples
    --------
    >>> damage_of(np.array([[5120, 5320], [0, 40000]]))
    '200 of 40000 bytes are not valid messages, from byte 5120 on; epochs in these bytes are lost'
    """
    if len(spans) < 2:
        return ""
    lost = int(np.diff(spans[:-1], axis=1).sum())
    blocks = f", in {len(spans) - 1} blocks" if len(spans) > 2 else ""
    first = f"{unit.removesuffix('s')} {int(spans[0, 0])}"
    return (
        f"{lost} of {int(spans[-1, 1])} {unit} are not valid messages{blocks}, from {first} on; "
        f"epochs in these {unit} are lost"
    )
