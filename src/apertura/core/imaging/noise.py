"""Noise power of a pulse, measured outside the Doppler band of the scene, and noise added by sidelink and symbols."""

from collections.abc import Callable
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
"""Number of random points at which the noise is measured, and largest number of 64-pulse blocks used."""

_MARGIN, _BAND = 2.0, (0.25, 0.4375)
"""Ratio of the width of the excluded Doppler band to that of the scene, chosen to exclude echoes from the surroundings.
Lower and upper limits of the half-width of the excluded band, cycles per pulse (W in docs/theory/layers.md, eq. 2b)."""

_LEAKED_DB = 0.6
"""Increase (dB) of the measured noise by echoes outside the scene if the PRF is too low for the margin of the excluded
band: +0.1 to +0.6 dB in images of five flights at a PRF of 40 Hz with a Doppler bandwidth of 18 Hz."""

_LEAK = 1e-5
"""Largest fraction of the energy of a taper within the excluded band."""

# number of groups for which sidelink noise is drawn, and pulses per group, within which the geometry is constant
_GROUPS, _ALIKE = 16, 8
_BLOCKS_DRAWN = 16  # random draws per group
_FEWEST = 16  # minimum number of pulses in a block
_LEAST_WEIGHT = 0.1  # minimum weight of a block at a point, relative to the largest weight; lower weights are excluded


def noise_places(grid: SceneGrid, terrain: Terrain) -> NDArray[np.float64]:
    """Draw the points at which the noise of a scene is measured, (point, 3) float64, metres."""
    rows, columns = np.random.default_rng(0).integers(0, grid.shape, (_PLACES, 2)).T
    return terrain.positions_at(grid, rows, columns)


class PulseNoise(NamedTuple):
    """Noise power σ² of a pulse at a point, in units of the profiles, and its standard deviation, dB; NaN: unknown."""

    power: float
    std_db: float


def noise_power(
    profiles: Profiles,
    places_m: NDArray[np.float64],
    *,
    time_s: NDArray[np.float64] | None = None,
    beams: Beams | None = None,
) -> PulseNoise:
    """Measure the noise power of one pulse at a point, at Doppler frequencies without echoes of the scene.

    Parameters
    ----------
    profiles
        Profiles of all pulses; only a sample of the pulses is read.
    places_m
        (point, 3) float64, metres, distributed over the scene.
    time_s
        (pulse,) float64, seconds, for the detection of missing pulses (default: no pulse is missing).
    beams
        Weights of the pulses.

    Returns
    -------
    PulseNoise
        NaN if no block illuminates a point. The power is an upper bound if the phase rates of the scene spread over
        more than half a cycle per pulse, so that echoes alias into the measured band. If the excluded band reaches its
        upper limit, the standard deviation includes the effect of echoes from outside the scene.

    Notes
    -----
    Source: docs/theory/layers.md, eq. 3.
    """
    starts, radius_m = np.arange(0, len(profiles), PULSES), np.zeros(len(places_m))
    illuminated = illumination_mask(beams, profiles.aperture, places_m, radius_m, pulses=PULSES)
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
        # The profiles contain the gate; the other weights multiply them.
        gated = np.ones(terms.shape) if beams is None else beams[block].weight(aperture, places_m)
        applied = beams[block].on_profiles if beams else None
        if applied is not None:
            terms = terms * applied.weight(aperture, places_m)
        power.extend(np.abs(tapers @ terms) ** 2)
        weight.extend(tapers**2 @ gated**2)
    powers, weights = np.array(power), np.array(weight)
    enough = weights > _LEAST_WEIGHT * weights.max()
    if not enough.any():
        return PulseNoise(float("nan"), float("nan"))
    each = np.where(enough, powers / np.where(enough, weights, 1.0), np.nan)
    # Orthogonal tapers and disjoint blocks have independent noise; points within one resolution cell do not.
    levels = np.array([np.nanmedian(values) for values in each if np.isfinite(values).any()])
    relative_std = float(levels.std(ddof=1) / levels.mean() / np.sqrt(len(levels))) if len(levels) > 1 else 1.0
    std_db = float(np.hypot(10 / np.log(10) * relative_std, _LEAKED_DB if sparse else 0.0))
    return PulseNoise(float(np.nanmedian(each) / np.log(2)), std_db)


def _numbers(block: slice, time_s: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the pulse numbers of a block relative to its first pulse, counting missing pulses."""
    if time_s is None:
        return np.arange(float(block.stop - block.start))
    step_s = np.diff(time_s[block])
    return np.cumsum(np.concatenate([[0.0], np.maximum(1.0, np.rint(step_s / max(float(np.median(step_s)), 1e-9)))]))


@lru_cache(maxsize=8)
def _tapers(number: tuple[float, ...], band: float) -> NDArray[np.float64]:
    """Return tapers over pulses, (taper, pulse) float64 of norm 1, that suppress |f| < band (cycles per pulse).

    At least one taper is returned, the one with the least leakage.
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
    """Estimate the noise power in a range profile that the correction by a sidelink adds to the echoes.

    Parameters
    ----------
    history
        Corrected transfer functions, including noise; only a sample of the pulses is read.
    grid, terrain
        The scene.
    places_m, beams
        As for `noise_power`, whose result includes this noise.
    method
        Correction method, a key of `apertura.core.echo.sidelink.METHODS`.
    snr_db
        SNR of the sidelink, per subcarrier.

    Notes
    -----
    Source: docs/theory/radiometry.md, eq. 8a. Simulated noise is processed by the correction method itself: the result
    accounts for the fraction of the noise that the method retains, and for its distribution over range.
    """

    def residual(shape: tuple[int, ...], generator: np.random.Generator) -> NDArray[np.complex64]:
        draws = generator.standard_normal((*shape, 2)) @ np.array([1, 1j])
        noisy = 1 + draws * 10 ** (-snr_db / 20) / np.sqrt(2)
        return np.asarray(METHODS[method](np.ones(noisy.shape, np.complex64), noisy.astype(np.complex64)))

    return _noise_of_factors(history, grid, terrain, places_m, beams, residual)


def symbols_noise(
    history: PhaseHistory,
    grid: SceneGrid,
    terrain: Terrain,
    places_m: NDArray[np.float64],
    *,
    beams: Beams | None = None,
    self_noise: float,
) -> float:
    """Estimate the noise power in a range profile from echo amplitudes that vary with the data of each pulse.

    Parameters
    ----------
    history, grid, terrain, places_m, beams
        As for `sidelink_noise`.
    self_noise
        Variance κ of the echo amplitude over the data.

    Notes
    -----
    Source: docs/theory/changing_codes.md, eq. 5, and docs/theory/radiometry.md, eq. 8a with v of variance κ.
    """

    def residual(shape: tuple[int, ...], generator: np.random.Generator) -> NDArray[np.complex64]:
        return np.asarray(np.sqrt(self_noise) * generator.standard_normal(shape), np.complex64)

    return _noise_of_factors(history, grid, terrain, places_m, beams, residual)


def _noise_of_factors(
    history: PhaseHistory,
    grid: SceneGrid,
    terrain: Terrain,
    places_m: NDArray[np.float64],
    beams: Beams | None,
    draw: Callable[[tuple[int, ...], np.random.Generator], NDArray[np.complex64]],
) -> float:
    """Return the noise power in a profile from random factors of the transfer functions, drawn by `draw`."""
    starts = np.unique(np.linspace(0, max(0, len(history) - _ALIKE), _GROUPS).astype(int)).tolist()
    groups, generator = [slice(first, min(first + _ALIKE, len(history))) for first in starts], np.random.default_rng(0)
    pulses = np.concatenate([np.arange(group.start, group.stop) for group in groups])
    sampled = replace(
        history,
        transfer=np.concatenate([history.transfer[group] for group in groups]),
        reference_delay_s=history.reference_delay_s[pulses],
        aperture=history.aperture[pulses],
    )
    residual = draw(sampled.transfer.shape, generator)
    residual -= residual.mean()
    # The echoes already contain such noise, which must not be counted twice.
    residual /= np.sqrt(1 + np.mean(np.abs(residual) ** 2))
    profiles = range_compress(replace(sampled, transfer=sampled.transfer * residual), grid, terrain)
    at = np.rint((sampled.aperture.path(places_m) - profiles.start_m[:, None]) / profiles.step_m).astype(np.int64)
    power = np.abs(np.take_along_axis(profiles.samples, np.clip(at, 0, profiles.samples.shape[1] - 1), axis=1)) ** 2
    weight = np.ones(power.shape) if beams is None else beams[pulses].weight(sampled.aperture, places_m) ** 2
    local, weights = (
        np.array([part.mean(axis=0) for part in np.array_split(values, len(groups))]) for values in (power, weight)
    )
    if not weights.any():
        return 0.0
    local = local[weights > _LEAST_WEIGHT * weights.max()]
    # The power of a sum over a pulse block is exponentially distributed with this mean; `noise_power` uses the median.
    return float(np.median(local * generator.exponential(size=(_BLOCKS_DRAWN, *local.shape))) / np.log(2))
