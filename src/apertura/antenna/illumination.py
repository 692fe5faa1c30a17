"""What beams make of a scene: how many pulses see each place."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.errors import CampaignError
from apertura.planning.models import Decision

_PULSES = 1024
_AT_ONCE = 64


@dataclass(frozen=True)
class Illumination:
    """How many pulses see each place of a net over the scene.

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


def illuminate(
    beams: Beams, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], place_m: NDArray[np.float64]
) -> Illumination:
    """Return how many pulses see each place.

    Parameters
    ----------
    beams
        Of every pulse.
    tx_m, rx_m
        (pulse, 3) float64, metres. Of more than 1024, evenly spread ones stand for all.
    place_m
        (place, 3) float64, metres.
    """
    some = slice(None, None, -(-len(tx_m) // _PULSES))
    few, tx_m, rx_m, pulses = beams.at(some), tx_m[some], rx_m[some], len(tx_m)
    seen = np.zeros(len(place_m), np.int64)
    for first in range(0, len(tx_m), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        seen += (few.weight(tx_m, rx_m, place_m, pulses=part) != 0).sum(axis=0)
    return Illumination(np.rint(seen * (pulses / len(tx_m))).astype(np.int64), pulses)


def decide_antennas(
    beams: Beams | None, illumination: Illumination | None, asked: Mapping[str, Any]
) -> tuple[list[Decision], dict[str, str]]:
    """Return the decision `antenna` and the flag `beam_misses`; neither without beams.

    Parameters
    ----------
    beams, illumination
        Of the job.
    asked
        Choice → value that a person asks for.

    Raises
    ------
    CampaignError
        If a choice that beams forbid is asked for: virtual pulses and midpoints have no antenna of their own.
    """
    if beams is None or illumination is None:
        return [], {}
    for name, allowed in (("pulse_thinning", 1), ("midpoint", False)):
        if asked.get(name, allowed) != allowed:
            raise CampaignError(
                f"{name} is {asked[name]}, and the antennas have beams",
                where=f"config/config.yaml: processing.{name}",
                expected=f"{allowed} or auto: every pulse is weighed by the antennas that sent and received it",
                remedy=f"Leave {name} to the planner, or set the nodes' antennas to null.",
            )
    looking = [name for name in ("transmit", "receive") if getattr(beams, name) is not None]
    misses = f"{100 * illumination.unseen:.1f} % of the scene is seen by no pulse: its pixels are zero"
    return (
        [Decision("antenna", ", ".join(looking), illumination.line)],
        {"beam_misses": misses} if illumination.unseen else {},
    )
