"""How noisy a pulse is, measured where nothing of the scene turns as fast."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import reached
from apertura.core.focus.contributions import band_limited_image
from apertura.core.focus.inputs import Profiles
from apertura.core.focus.reach import PULSES

PLACES, BLOCKS = 64, 32
"""At so many random places, by so many blocks of 64 pulses at most."""

_FEWEST = 16  # pulses of a block
_LIT = 0.1  # of the most that a block weighs at a place: places that weigh less do not count


def noise_power(profiles: Profiles, places_m: NDArray[np.float64], *, beams: Beams | None = None) -> float:
    """Return σ², the power of the noise of one pulse at a place, in units of the profiles.

    Parameters
    ----------
    profiles
        Of every pulse; some are read.
    places_m
        (place, 3) float64, metres: spread over the scene.
    beams
        What weighs the pulses.

    Returns
    -------
    float
        NaN where too few pulses see too little. An upper bound where pulses lie so wide that echoes of every other
        pulse alias.

    Notes
    -----
    Source: docs/theory/layers.md, eq. 3.
    """
    starts, places = np.arange(0, len(profiles), PULSES), np.zeros(len(places_m))
    lit = reached(beams, profiles.aperture, places_m, places, pulses=PULSES)
    seeing = starts[lit.any(axis=1) & (np.minimum(starts + PULSES, len(profiles)) - starts >= _FEWEST)]
    if not seeing.size:
        return float("nan")
    chosen = seeing[np.unique(np.linspace(0, len(seeing) - 1, BLOCKS).round().astype(int))]
    power, weight = np.empty((2, len(chosen), len(places_m)))
    for number, first in enumerate(chosen.tolist()):
        block = slice(first, min(first + PULSES, len(profiles)))
        power[number], weight[number] = _silent(profiles[block], places_m, beams and beams[block])
    enough = weight > _LIT * weight.max()
    return float(np.median(power[enough] / weight[enough]) / np.log(2)) if enough.any() else float("nan")


def _silent(
    profiles: Profiles, places_m: NDArray[np.float64], beams: Beams | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what pulses with alternating signs focus at places, as power, and Σ of their squared weights."""
    count = len(profiles)
    taper = np.hanning(count + 2)[1:-1] * np.where(np.arange(count) % 2, -1.0, 1.0)
    turned = replace(profiles, samples=np.asarray(profiles.samples * taper[:, None], np.complex64))
    weight = np.ones((count, len(places_m))) if beams is None else beams.weight(profiles.aperture, places_m)
    image = band_limited_image(turned, places_m, beams=beams)
    return np.abs(image) ** 2, taper**2 @ weight**2
