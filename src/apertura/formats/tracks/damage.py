"""Bytes of a binary log that are no messages: found by walking from message to message, and left out.

Parsers stop at such bytes, or read on behind them, without a word: pyulog at the first message that reaches beyond the
file, pymavlink at the first type that it does not know.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

_CHAIN = 3
"""Messages that must follow each other where reading resumes: chance makes one header of 256 a plausible one."""

Span = tuple[int, int]
"""First byte, and that behind the last."""


def foreign_bytes(
    data: bytes, first: int, end: int, message_bytes: Callable[[int], int], *, note: Callable[[int], None]
) -> tuple[list[Span], int]:
    """Return the spans of a log that are no messages, and where the last message ends.

    A message before such a span is part of it: it may have been cut, so that its last bytes are foreign ones. A message
    that the end of the log cuts off, and bytes of one value behind the last message, are no damage.

    Parameters
    ----------
    data
        The log.
    first, end
        Where messages begin and end in it.
    message_bytes
        Length of the message at an offset, its header included; 0 where none begins.
    note
        Called with the offset of each message that is read, in order: what `message_bytes` must know of it.

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
        resumed = next((place for place in range(last + 1, end) if _chain(place, end, message_bytes)), end)
        tail = data[at:end]
        if resumed == end and (size or tail == tail[:1] * len(tail)):
            break
        spans.append((last, resumed))
        at = last = resumed
    return spans, at


def _chain(at: int, end: int, message_bytes: Callable[[int], int]) -> bool:
    """Test whether messages follow each other from an offset on."""
    for _ in range(_CHAIN):
        size = message_bytes(at)
        if not size or at + size > end:
            return False
        at += size
        if at == end:
            return True
    return True


def without(data: bytes, spans: Sequence[Span]) -> bytes:
    """Return a log without some of its bytes.

    Examples
    --------
    >>> without(b"abcdef", [(1, 3), (4, 5)])
    b'adf'
    """
    view, edges = memoryview(data), [0, *(edge for span in spans for edge in span), len(data)]
    return b"".join(view[begin:stop] for begin, stop in zip(edges[::2], edges[1::2], strict=True))


def damage_of(spans: NDArray[np.int64], unit: str = "bytes") -> str:
    """Describe the parts of a log that are no messages, in one line; '' where there are none.

    Parameters
    ----------
    spans
        (span, 2) int64: first byte or line, and that behind the last; the last row is the whole log.
    unit
        What is counted.

    Examples
    --------
    >>> damage_of(np.array([[5120, 5320], [0, 40000]]))
    '200 of 40000 bytes are no messages, from byte 5120 on; epochs there are lost'
    """
    if len(spans) < 2:
        return ""
    lost = int(np.diff(spans[:-1], axis=1).sum())
    places = f", in {len(spans) - 1} places" if len(spans) > 2 else ""
    first = f"{unit.removesuffix('s')} {int(spans[0, 0])}"
    return f"{lost} of {int(spans[-1, 1])} {unit} are no messages{places}, from {first} on; epochs there are lost"
