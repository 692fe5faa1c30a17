"""The captures of a pair, read in blocks of pulses, and what they tell before anything is computed: saturation."""

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

Samples = NDArray[np.int16 | np.float32]
Pulses = NDArray[np.int64]

Read = Callable[[Pulses], Mapping[str, Samples]]
"""Numbers of captures, ascending → channel → (capture, sample, 2), I and Q from the start of the prefix."""

AT_ONCE = 64
"""Captures in work at a time: the caches hold them."""

SATURATED_SHARE = 1e-4
"""Share of the samples at the converter's end stops; a symbol 12 dB below them reaches its extremes once or twice."""


def blocks_of(pulses: Pulses, size: int = AT_ONCE) -> Iterator[Pulses]:
    """Yield numbers of pulses, `size` at a time.

    Examples
    --------
    >>> [some.tolist() for some in blocks_of(np.arange(5), 2)]
    [[0, 1], [2, 3], [4]]
    """
    for first in range(0, len(pulses), size):
        yield pulses[first : first + size]


def spread(count: int, *, groups: int, each: int) -> list[Pulses]:
    """Return groups of neighbouring pulses, one amid each equal part of a flight; all pulses where that is no more.

    What a flight repeats in every pulse is known well from some thousand of them, however long it lasts.

    Examples
    --------
    >>> [[some.tolist() for some in spread(count, groups=2, each=3)] for count in (100, 5)]
    [[[23, 24, 25], [73, 74, 75]], [[0, 1, 2], [3, 4]]]
    """
    if count <= groups * each:
        return np.array_split(np.arange(count), max(1, min(groups, count)))
    middles = (np.arange(groups) + 0.5) * count / groups
    return [np.arange(int(middle - each / 2), int(middle - each / 2) + each) for middle in middles]


class Saturation:
    """Samples at a converter's end stops, counted block by block.

    Notes
    -----
    A converter that clips piles samples up at its end stops, whatever its number of bits; without clipping the extreme
    values occur once or twice.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> waves = rng.normal(0, 3000, (4, 5000, 2))
    >>> for recorded in (waves, waves.clip(-8191, 8191)):
    ...     saturation = Saturation()
    ...     for block in recorded.astype(np.int16):
    ...         saturation.count({"radar": block[None]})
    ...     print({name: round(share, 4) for name, share in saturation.shares.items()})
    {'radar': 0.0}
    {'radar': 0.0054}
    """

    def __init__(self) -> None:
        self._extremes: dict[str, list[_Extreme]] = {}
        self._samples: dict[str, int] = {}

    def count(self, iq: Mapping[str, Samples]) -> None:
        """Count some captures, channel → (capture, sample, 2)."""
        for name, samples in iq.items():
            self._samples[name] = self._samples.get(name, 0) + samples.size
            extremes = self._extremes.setdefault(name, [_Extreme(+1), _Extreme(-1)])
            for extreme, value in zip(extremes, (samples.max().item(), samples.min().item()), strict=True):
                extreme.count(samples, value)

    @property
    def shares(self) -> dict[str, float]:
        """Share of each channel's samples that repeat the largest or the smallest value that occurs."""
        return {  # each of the two occurs once anyway
            name: (sum(extreme.times for extreme in self._extremes[name]) - 2) / count
            for name, count in self._samples.items()
        }

    @property
    def flags(self) -> dict[str, str]:
        """A flag for each channel whose converter clipped."""
        return {
            f"saturated_{name}": f"{share:.2%} of the samples of channel {name} sit at the converter's end stops"
            for name, share in self.shares.items()
            if share > SATURATED_SHARE
        }


class _Extreme:
    """The largest or, with `sign` -1, the smallest value so far, and how often it occurred."""

    def __init__(self, sign: int) -> None:
        self.sign, self.value, self.times = sign, -sign * np.inf, 0

    def count(self, samples: Samples, value: float) -> None:
        if self.sign * value < self.sign * self.value:
            return
        known = self.times if value == self.value else 0
        self.value, self.times = value, known + int(np.count_nonzero(samples == value))
