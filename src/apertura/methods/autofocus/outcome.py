"""What a refinement found, whether it is believed, and why."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.core.geometry.track_correction import TrackCorrection


@dataclass(frozen=True, eq=False)
class Refinement:
    """Corrections of a flight's tracks as its images ask for them.

    Attributes
    ----------
    correction
        What was found, accepted or not.
    std_m
        Node → (knot, 3) float64, metres: how well, along the axes of the frame.
    accepted
        Whether images are formed with it: as a whole or not at all.
    why
        One line.
    report
        As JSON values: what was measured.
    flags
        Edge crossed → what was found, in one line.
    """

    correction: TrackCorrection
    std_m: Mapping[str, NDArray[np.float64]]
    accepted: bool
    why: str
    report: Mapping[str, Any] = field(default_factory=dict)
    flags: Mapping[str, str] = field(default_factory=dict)
