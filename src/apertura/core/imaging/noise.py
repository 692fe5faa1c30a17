"""Noise power of a pulse: measured at the Doppler farthest from the scene's, and what a sidelink adds to it."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import illumination_mask
from apertura.core.echo.sidelink import METHODS
from apertura.core.focus.contributions import band_limited_image
from apertura.core.focus.inputs import PhaseHistory, Profiles
from apertura.core.focus.reach import PULSES
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain

PLACES, BLOCKS = 64, 32
"""Random places, and blocks of 64 pulses at most, that the noise is measured at."""

_DRAWN = 128  # pulses on which the noise of a sidelink is drawn, or up to twice as many
_ALIKE, _BLOCKS_DRAWN = 8, 16  # of them that see a place alike; blocks drawn of each
_FEWEST = 16  # pulses of a block at least
_LEAST_WEIGHT = 0.1  # of the largest weight of a block at a place: places with less are left out


def noise_places(grid: SceneGrid, terrain: Terrain) -> NDArray[np.float64]:
    """Return the places at which the noise of a scene is measured, (place, 3) float64, metres: random ones."""
    rows, columns = np.random.default_rng(0).integers(0, grid.shape, (PLACES, 2)).T
    return terrain.positions_at(grid, rows, columns)


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


def noise_std_db(pulses: int) -> float:
    """Return the standard deviation of `noise_power` of so many pulses, dB: that of the median of exponential powers.

    Examples
    --------
    >>> round(noise_std_db(4096), 2), round(noise_std_db(100), 2)
    (0.14, 0.78)
    """
    values = PLACES * min(BLOCKS, max(1, pulses // PULSES))
    return float(10 / np.log(10) / np.log(2) / np.sqrt(values))


def sidelink_noise(
    history: PhaseHistory,
    grid: SceneGrid,
    terrain: Terrain,
    places_m: NDArray[np.float64],
    *,
    beams: Beams | None = None,
    method: str,
    snr_db: float,
) -> float:
    """Return the power that the noise of a sidelink has in a range profile: that of its correction, on the echoes.

    Parameters
    ----------
    history
        Transfer functions as they were corrected, with noise and all; some are read.
    grid, terrain
        The scene.
    places_m, beams
        As of `noise_power`, which measures it together with all other noise.
    method
        A key of `apertura.core.echo.sidelink.METHODS`, by which they were corrected.
    snr_db
        Of the sidelink, per subcarrier.

    Notes
    -----
    Source: docs/theory/radiometry.md, eq. 8a. Noise is drawn and goes through the correction itself, so that what each
    method keeps, and where, is its own.
    """
    some_pulses, generator = history.aperture.sample(_DRAWN), np.random.default_rng(0)
    some = history[some_pulses]
    draws = generator.standard_normal((*some.transfer.shape, 2)) @ np.array([1, 1j])
    noisy = 1 + draws * 10 ** (-snr_db / 20) / np.sqrt(2)
    left = METHODS[method](np.ones(noisy.shape, np.complex64), noisy.astype(np.complex64))
    left -= left.mean()
    # The echoes hold such noise already, which is not to be counted twice.
    left /= np.sqrt(1 + np.mean(np.abs(left) ** 2))
    profiles = range_compress(replace(some, transfer=some.transfer * left), grid, terrain)
    at = np.rint((some.aperture.path(places_m) - profiles.start_m[:, None]) / profiles.step_m).astype(np.int64)
    power = np.abs(np.take_along_axis(profiles.samples, np.clip(at, 0, profiles.samples.shape[1] - 1), axis=1)) ** 2
    weight = np.ones(power.shape) if beams is None else beams[some_pulses].weight(some.aperture, places_m) ** 2
    parts = max(1, len(power) // _ALIKE)
    local, seen = (np.array([part.mean(axis=0) for part in np.array_split(of, parts)]) for of in (power, weight))
    if not seen.any():
        return 0.0
    local = local[seen > _LEAST_WEIGHT * seen.max()]
    # Summed over a block of pulses it is exponential about this mean; of all, the median is what is measured.
    return float(np.median(local * generator.exponential(size=(_BLOCKS_DRAWN, *local.shape))) / np.log(2))
