"""Flags that were raised: name → what was measured; one way to bring those of several parts together.

Apart from the table of what flags mean, which only pages and summaries read: other words there make no image again.
"""

from collections.abc import Mapping
from typing import Self


class Flags(dict[str, str]):
    """Flags of a stage or an image: name in `apertura.common.flags.FLAGS` → one line of what was measured.

    Examples
    --------
    >>> found = Flags.merged({"fix_lost": "3 of 90 pulses of uav1"}, {"fix_lost": "7 of 90 pulses of uav2"})
    >>> found["fix_lost"]
    '3 of 90 pulses of uav1; 7 of 90 pulses of uav2'
    >>> Flags.merged(found, found) == found
    True
    """

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
