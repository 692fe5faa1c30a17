"""Images of a few places by parts of the aperture, and by even and odd pulses of each."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import reached
from apertura.core.focus.engines import ENGINES, load_engine
from apertura.core.focus.engines.engine import Engine
from apertura.core.focus.inputs import Profiles
from apertura.core.focus.reach import PULSES
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.formation import PULSES_READ

PARTS = 8
"""Parts of the aperture."""

PART_PX = 64
"""Places along a side."""

_MARGIN_SAMPLES = 16  # that engines need beyond the places


def part_images(
    profiles: Profiles, places: Sequence[NDArray[np.float64]], *, beams: Beams | None = None
) -> NDArray[np.complex64]:
    """Return patches of the image by parts of the aperture; their sum over parts is the image.

    Parameters
    ----------
    profiles
        Of every pulse.
    places
        Patches of (PART_PX, PART_PX, 3) float64 positions, metres, in the frame of the phase centres.
    beams
        Of the antennas; isotropic by default.

    Returns
    -------
    ndarray
        (patch, 2, part, y, x) complex64: by even and by odd pulses of each part. Nothing is made of fewer than four
        pulses a part.
    """
    images = np.zeros((len(places), 2, PARTS, PART_PX, PART_PX), np.complex64)
    aperture = profiles.aperture
    if len(profiles) < 4 * PARTS:
        return images[:0]
    engine = table_engine()
    for patch, where in enumerate(places):
        seen = _seeing(beams, aperture, where)
        for number, block in enumerate(aperture[seen].blocks(PARTS)):
            for first in range(seen.start + block.start, seen.start + block.stop, PULSES_READ):
                last = min(first + PULSES_READ, seen.start + block.stop)
                read = _around(profiles[first:last], where)
                for odd in range(min(2, last - first)):
                    tables = engine.prepare(read[odd::2])
                    weights = beams and beams[first + odd : last : 2]
                    images[patch, odd, number] += engine.form(tables, where, beams=weights) / len(profiles)
    return np.nan_to_num(images)


def _seeing(beams: Beams | None, aperture: Aperture, places: NDArray[np.float64]) -> slice:
    """Return the first to the last pulse that may see a patch."""
    middle = places[PART_PX // 2, PART_PX // 2]
    radius = np.linalg.norm(places - middle, axis=-1).max()
    lit = np.flatnonzero(reached(beams, aperture, middle[None], np.array([radius]), pulses=PULSES)[:, 0])
    return slice(int(lit[0]) * PULSES, min(int(lit[-1] + 1) * PULSES, len(aperture))) if lit.size else slice(0, 0)


def table_engine() -> Engine:
    """Return the first engine that reads profiles and runs here."""
    engines = (load_engine(name) for name in ENGINES)
    return next(engine for engine in engines if engine.READS == "profiles" and engine.available())


def _around(profiles: Profiles, places: NDArray[np.float64]) -> Profiles:
    """Return the samples of profiles that a patch needs."""
    corners = places[:: PART_PX - 1, :: PART_PX - 1].reshape(-1, 3)
    at = (profiles.aperture.path(corners) - profiles.start_m[:, None]) / profiles.step_m
    reach = 2 * np.linalg.norm(places[1, 1] - places[0, 0]) * PART_PX / 2 / profiles.step_m  # nadir inside the patch
    first = max(0, int(np.nanmin(at) - reach) - _MARGIN_SAMPLES)
    last = min(profiles.samples.shape[1], int(np.nanmax(at)) + _MARGIN_SAMPLES + 1)
    start_m = profiles.start_m + first * profiles.step_m
    return replace(profiles, samples=profiles.samples[:, first:last], start_m=start_m)
