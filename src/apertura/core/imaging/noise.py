"""Noise of a pulse: measured at Doppler frequencies that no echo of the scene has, and what a sidelink adds to it."""

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import illumination_mask
from apertura.core.backprojection.contributions import Echoes
from apertura.core.backprojection.inputs import PhaseHistory, Profiles
from apertura.core.backprojection.reach import PULSES
from apertura.core.echo.sidelink import METHODS
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import Terrain

_PLACES, _BLOCKS = 64, 8
"""Random places, and blocks of 64 pulses at most, that the noise is measured at."""

_MARGIN, _BAND = 2.0, (0.25, 0.4375)
"""Doppler frequencies left to echoes: twice those of the scene, for what lies beside it, and limits, cycles a pulse."""

_LEAKED_DB = 0.6
"""dB by which echoes beside the scene raise the noise measured where pulses are too sparse for that margin: images of
five flights of 40 pulses a second with 18 Hz of Doppler, +0.1 to +0.6 dB against their own noise."""

_LEAK = 1e-5
"""Share of a taper's energy within that band, at most."""

_GROUPS, _ALIKE = 16, 8  # of pulses on which the noise of a sidelink is drawn: those of a group see a place alike
_BLOCKS_DRAWN = 16  # of each
_FEWEST = 16  # pulses of a block at least
_LEAST_WEIGHT = 0.1  # of the largest weight of a block at a place: places with less are left out


def noise_places(grid: SceneGrid, terrain: Terrain) -> NDArray[np.float64]:
    """Return the places at which the noise of a scene is measured, (place, 3) float64, metres: random ones."""
    rows, columns = np.random.default_rng(0).integers(0, grid.shape, (_PLACES, 2)).T
    return terrain.positions_at(grid, rows, columns)


class PulseNoise(NamedTuple):
    """σ², the noise of one pulse at a place, in units of the profiles, and its standard deviation, dB; NaN: unknown."""

    power: float
    std_db: float


def noise_power(
    profiles: Profiles,
    places_m: NDArray[np.float64],
    *,
    time_s: NDArray[np.float64] | None = None,
    beams: Beams | None = None,
) -> PulseNoise:
    """Return the noise of one pulse at a place, measured where no echo of the scene is: at other Doppler frequencies.

    Parameters
    ----------
    profiles
        Of every pulse; some are read.
    places_m
        (place, 3) float64, metres: spread over the scene.
    time_s
        (pulse,) float64, seconds, by which pulses that are missing are counted; by default none is.
    beams
        Weights of the pulses.

    Returns
    -------
    PulseNoise
        NaN where no block illuminates a place. An upper bound where pulses are so sparse that echoes of every other
        pulse alias; where twice the scene's Doppler fills the band, the deviation holds what echoes beside it may add.

    Notes
    -----
    Source: docs/theory/layers.md, eq. 3.
    """
    starts, places = np.arange(0, len(profiles), PULSES), np.zeros(len(places_m))
    illuminated = illumination_mask(beams, profiles.aperture, places_m, places, pulses=PULSES)
    illuminating = starts[illuminated.any(axis=1) & (np.minimum(starts + PULSES, len(profiles)) - starts >= _FEWEST)]
    if not illuminating.size:
        return PulseNoise(float("nan"), float("nan"))
    chosen = illuminating[np.unique(np.linspace(0, len(illuminating) - 1, _BLOCKS).round().astype(int))]
    power, weight = list[NDArray[np.float64]](), list[NDArray[np.float64]]()
    sparse = False
    for first in chosen.tolist():
        block = slice(first, min(first + PULSES, len(profiles)))
        aperture, number = profiles.aperture[block], _numbers(block, time_s)
        spread, _ = aperture.phase_rates(places_m, wavelength_m=profiles.wavelength_m)
        tapers = _tapers(tuple(number.tolist()), round(float(np.clip(_MARGIN * spread, *_BAND)), 2))
        sparse |= _MARGIN * spread > _BAND[1]
        terms, _ = Echoes.read(profiles, [block]).at(places_m)
        seen = np.ones(terms.shape) if beams is None else beams[block].weight(aperture, places_m)
        power.extend(np.abs(tapers @ (seen * terms)) ** 2)
        weight.extend(tapers**2 @ seen**2)
    powers, weights = np.array(power), np.array(weight)
    enough = weights > _LEAST_WEIGHT * weights.max()
    if not enough.any():
        return PulseNoise(float("nan"), float("nan"))
    each = np.where(enough, powers / np.where(enough, weights, 1.0), np.nan)
    # tapers are orthogonal and blocks apart, so their noise is independent; that of places in one cell is not
    levels = np.array([np.nanmedian(one) for one in each if np.isfinite(one).any()])
    apart = float(levels.std(ddof=1) / levels.mean() / np.sqrt(len(levels))) if len(levels) > 1 else 1.0
    std_db = float(np.hypot(10 / np.log(10) * apart, _LEAKED_DB if sparse else 0.0))
    return PulseNoise(float(np.nanmedian(each) / np.log(2)), std_db)


def _numbers(block: slice, time_s: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return which pulse each of a block was, counted from its first, missing ones too."""
    if time_s is None:
        return np.arange(float(block.stop - block.start))
    step_s = np.diff(time_s[block])
    return np.cumsum(np.concatenate([[0.0], np.maximum(1.0, np.rint(step_s / max(float(np.median(step_s)), 1e-9)))]))


@lru_cache(maxsize=8)
def _tapers(number: tuple[float, ...], band: float) -> NDArray[np.float64]:
    """Return tapers over pulses, (taper, pulse) float64 of norm 1, that see next to nothing of |f| < band per pulse.

    At least one, the best.
    """
    leak, taper = np.linalg.eigh(2 * band * np.sinc(2 * band * np.subtract.outer(number, number)))
    return np.asarray(taper[:, leak <= max(_LEAK, float(leak[0]))].T)


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
    starts = np.unique(np.linspace(0, max(0, len(history) - _ALIKE), _GROUPS).astype(int)).tolist()
    groups, generator = [slice(first, min(first + _ALIKE, len(history))) for first in starts], np.random.default_rng(0)
    pulses = np.concatenate([np.arange(one.start, one.stop) for one in groups])
    some = replace(
        history,
        transfer=np.concatenate([history.transfer[one] for one in groups]),
        reference_delay_s=history.reference_delay_s[pulses],
        aperture=history.aperture[pulses],
    )
    draws = generator.standard_normal((*some.transfer.shape, 2)) @ np.array([1, 1j])
    noisy = 1 + draws * 10 ** (-snr_db / 20) / np.sqrt(2)
    left = METHODS[method](np.ones(noisy.shape, np.complex64), noisy.astype(np.complex64))
    left -= left.mean()
    # The echoes hold such noise already, which is not to be counted twice.
    left /= np.sqrt(1 + np.mean(np.abs(left) ** 2))
    profiles = range_compress(replace(some, transfer=some.transfer * left), grid, terrain)
    at = np.rint((some.aperture.path(places_m) - profiles.start_m[:, None]) / profiles.step_m).astype(np.int64)
    power = np.abs(np.take_along_axis(profiles.samples, np.clip(at, 0, profiles.samples.shape[1] - 1), axis=1)) ** 2
    weight = np.ones(power.shape) if beams is None else beams[pulses].weight(some.aperture, places_m) ** 2
    local, seen = (np.array([part.mean(axis=0) for part in np.array_split(of, len(groups))]) for of in (power, weight))
    if not seen.any():
        return 0.0
    local = local[seen > _LEAST_WEIGHT * seen.max()]
    # Summed over a block of pulses it is exponential about this mean; of all, the median is what is measured.
    return float(np.median(local * generator.exponential(size=(_BLOCKS_DRAWN, *local.shape))) / np.log(2))
