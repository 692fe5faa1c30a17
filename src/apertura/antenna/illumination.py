"""What beams make of a scene: how many pulses see each place."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.geometry.aperture import Aperture

_PULSES = 1024
_AT_ONCE = 64


@dataclass(frozen=True)
class Illumination:
    """How many pulses see each point of a grid over the scene.

    Attributes
    ----------
    seen
        (place,) int64.
    pulses
        How many there are.

    Examples
    --------
    >>> Illumination(np.array([0, 20, 40, 60]), 100).line
    'of 100 pulses a place of the scene is seen by 0 to 60 (median 30); 25 % of places are seen by none'
    """

    seen: NDArray[np.int64]
    pulses: int

    @property
    def unseen(self) -> float:
        """Share of the places that no pulse sees."""
        return float((self.seen == 0).mean())

    @property
    def counts(self) -> dict[str, int]:
        """Least, median and most pulses that see a place."""
        least, median, most = np.quantile(self.seen, [0, 0.5, 1]).round().astype(int)
        return {"least": int(least), "median": int(median), "most": int(most)}

    @property
    def line(self) -> str:
        """All of it in a few words."""
        least, median, most = self.counts.values()
        line = f"of {self.pulses} pulses a place of the scene is seen by {least} to {most} (median {median})"
        return f"{line}; {100 * self.unseen:.0f} % of places are seen by none" if self.unseen else line


def illuminate(beams: Beams, aperture: Aperture, place_m: NDArray[np.float64]) -> Illumination:
    """Return how many pulses see each place.

    Parameters
    ----------
    beams
        Of every pulse.
    aperture
        Of more than 1024 pulses, evenly spread ones stand for all.
    place_m
        (place, 3) float64, metres.
    """
    some = slice(None, None, -(-len(aperture) // _PULSES))
    few, beams = aperture[some], beams[some]
    seen = np.zeros(len(place_m), np.int64)
    for first in range(0, len(few), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        seen += (beams[part].weight(few[part], place_m) != 0).sum(axis=0)
    return Illumination(np.rint(seen * (len(aperture) / len(few))).astype(np.int64), len(aperture))


def decide_antennas(
    beams: Beams | None, illumination: Illumination | None
) -> tuple[list[tuple[str, str]], dict[str, str]]:
    """Return which antennas have beams and what they see, in one line, and the flag `beam_misses`; neither without."""
    if beams is None or illumination is None:
        return [], {}
    looking = [name for name in ("transmit", "receive") if getattr(beams, name) is not None]
    misses = f"{100 * illumination.unseen:.1f} % of the scene is seen by no pulse: its pixels are zero"
    return (
        [(", ".join(looking), illumination.line)],
        {"beam_misses": misses} if illumination.unseen else {},
    )
