"""Raised flags: mapping from flag name to lines with measured values, and the merging of flags from several sources."""

import re
from collections.abc import Iterable, Mapping
from typing import Any, Self

from apertura.common.flag_table import FLAGS


class Flags(dict[str, str]):
    """Flags of a stage or an image: name in `apertura.common.flag_table.FLAGS` → text with measured values.

    The text of a flag consists of one line per source (node, pair, image) that raised it, joined by "; ". A line may
    itself contain "; ".

    Raises
    ------
    KeyError
        If a name is not in the flag table.

    Examples
    --------
    >>> merged = Flags.merged({"fix_quality_low": "3 of 90 pulses of a"}, {"fix_quality_low": "7 of 90 pulses of b"})
    >>> merged["fix_quality_low"]
    '3 of 90 pulses of a; 7 of 90 pulses of b'
    >>> Flags.merged(merged, merged) == merged
    True
    >>> Flags({"fix_pour": "9 of 90 pulses of uav1"})
    Traceback (most recent call last):
    KeyError: 'fix_pour is not in apertura.common.flag_table.FLAGS'
    """

    def __init__(self, flags: Mapping[str, str] | Iterable[tuple[str, str]] = ()) -> None:
        super().__init__()
        self._lines: dict[str, list[str]] = {}
        for name, line in dict(flags).items():
            self[name] = line

    def __setitem__(self, name: str, line: str) -> None:
        self._set(name, [line])

    def _set(self, name: str, lines: list[str]) -> None:
        if name not in FLAGS:
            raise KeyError(f"{name} is not in apertura.common.flag_table.FLAGS")
        self._lines[name] = lines
        super().__setitem__(name, "; ".join(lines))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (dict(self),)

    @classmethod
    def merged(cls, *several: Mapping[str, str]) -> Self:
        """Merge flags from several sources, in order; a flag raised by several sources has the lines of each source.

        A line is omitted if another line contains the whole line, followed by "; ", " (" or the end of the text.
        """
        merged = cls()
        for flags in several:
            for name, text in flags.items():
                lines = merged._lines.get(name, [])
                for line in flags._lines[name] if isinstance(flags, Flags) else [text]:
                    if not any(_repeats(known, line) for known in lines):
                        lines = [*(known for known in lines if not _repeats(line, known)), line]
                merged._set(name, lines)
        return merged


def _repeats(line: str, part: str) -> bool:
    """Return True if a line equals `part`, or contains the whole of `part`, delimited by "; " or " ("."""
    return re.search(rf"(?:^|; ){re.escape(part)}(?:$|; | \()", line) is not None
