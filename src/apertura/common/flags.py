"""Flags that were raised: name → what was measured; one way to merge those of several parts.

Apart from `apertura.common.flag_table`, which only pages and summaries import: other words there make no image again.
"""

from collections.abc import Iterable, Mapping
from functools import cache
from pkgutil import resolve_name
from typing import Any, Self


@cache
def _rows() -> Any:
    return resolve_name(f"{__package__}.flag_table:FLAGS")  # by name: their texts are no code of what raises a flag


class Flags(dict[str, str]):
    """Flags of a stage or an image: name in `apertura.common.flag_table.FLAGS` → one line of what was measured.

    Raises
    ------
    KeyError
        If a name is no row of that table, however it is set.

    Examples
    --------
    >>> found = Flags.merged({"fix_poor": "3 of 90 pulses of uav1"}, {"fix_poor": "7 of 90 pulses of uav2"})
    >>> found["fix_poor"]
    '3 of 90 pulses of uav1; 7 of 90 pulses of uav2'
    >>> Flags.merged(found, found) == found
    True
    >>> Flags({"fix_pour": "9 of 90 pulses of uav1"})
    Traceback (most recent call last):
    KeyError: 'fix_pour is no row of apertura.common.flag_table.FLAGS'
    """

    def __init__(self, flags: Mapping[str, str] | Iterable[tuple[str, str]] = ()) -> None:
        super().__init__()
        for name, line in dict(flags).items():
            self[name] = line

    def __setitem__(self, name: str, line: str) -> None:
        if name not in _rows():
            raise KeyError(f"{name} is no row of apertura.common.flag_table.FLAGS")
        super().__setitem__(name, line)

    @classmethod
    def merged(cls, *several: Mapping[str, str]) -> Self:
        """Return all flags of several parts, in their order; where two raise one, both of their lines stand.

        A line that begins with another says the same and more, and takes its place.
        """
        found = cls()
        for flags in several:
            for name, line in flags.items():
                known = found.get(name, "")
                if line.startswith(known):
                    found[name] = line
                elif not known.startswith(line) and line not in known.split("; "):
                    found[name] = f"{known}; {line}"
        return found
