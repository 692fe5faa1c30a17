"""Noise power of a pulse, measured at the Doppler farthest from the scene's: by sums with alternating signs."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import illumination_mask
from apertura.core.focus.contributions import band_limited_image
from apertura.core.focus.inputs import Profiles
from apertura.core.focus.reach import PULSES

PLACES, BLOCKS = 64, 32
"""Random places, and blocks of 64 pulses at most, that the noise is measured at."""

_FEWEST = 16  # pulses of a block at least
_LEAST_WEIGHT = 0.1  # of the largest weight of a block at a place: places with less are left out


def noise_power(profiles: Profiles, places_m: NDArray[np.float64], *, beams: Beams | None = None) -> float:
    """Return σ², the power of the noise of one pulse at a place, in units of the profiles.

    Parameters
    ----------
    profiles
        Of every pulse; some are read.
    places_m
        (place, 3) float64, metres: spread over the scene.
    beams
        Weights of the pulses.

    Returns
    -------
    float
        NaN where no block illuminates a place. An upper bound where pulses are so sparse that echoes of every other
        pulse alias.

    Notes
    -----
    Source: docs/theory/layers.md, eq. 3.
    """
    starts, places = np.arange(0, len(profiles), PULSES), np.zeros(len(places_m))
    illuminated = illumination_mask(beams, profiles.aperture, places_m, places, pulses=PULSES)
    illuminating = starts[illuminated.any(axis=1) & (np.minimum(starts + PULSES, len(profiles)) - starts >= _FEWEST)]
    if not illuminating.size:
        return float("nan")
    chosen = illuminating[np.unique(np.linspace(0, len(illuminating) - 1, BLOCKS).round().astype(int))]
    power, weight = np.empty((2, len(chosen), len(places_m)))
    for number, first in enumerate(chosen.tolist()):
        block = slice(first, min(first + PULSES, len(profiles)))
        power[number], weight[number] = _alternating_power(profiles[block], places_m, beams and beams[block])
    enough = weight > _LEAST_WEIGHT * weight.max()
    return float(np.median(power[enough] / weight[enough]) / np.log(2)) if enough.any() else float("nan")


def _alternating_power(
    profiles: Profiles, places_m: NDArray[np.float64], beams: Beams | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the power at places of the sum of pulses with alternating signs, and Σ of their squared weights."""
    count = len(profiles)
    taper = np.hanning(count + 2)[1:-1] * np.where(np.arange(count) % 2, -1.0, 1.0)
    alternating = replace(profiles, samples=np.asarray(profiles.samples * taper[:, None], np.complex64))
    weight = np.ones((count, len(places_m))) if beams is None else beams.weight(profiles.aperture, places_m)
    image = band_limited_image(alternating, places_m, beams=beams)
    return np.abs(image) ** 2, taper**2 @ weight**2
