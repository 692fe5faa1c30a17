"""Presumming of pulses of an oversampled aperture by a low-pass filter, with pulses aligned to the scene centre.

Decimation without a filter would alias noise and echoes into the image. In presumming, all pulses contribute: the value
of a pulse at a pixel is interpolated from virtual pulses at every k-th position. The sum over the virtual pulses,
weighted by this interpolation, then equals the sum over all pulses (docs/theory/planner.md, "Pulses").
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.units import decibels
from apertura.core.backprojection.inputs import Profiles
from apertura.core.geometry.aperture import Aperture
from apertura.core.windowed_sinc import kaiser_beta, kaiser_sinc, kaiser_window

if TYPE_CHECKING:
    from scipy import sparse

PRESUM_S = 8.0e-8
"""Computing time of presumming per pulse and range sample on one core, seconds."""

_HALF_TAPS = 10
_KAISER_BETA = 10.0


@dataclass(frozen=True)
class Presum:
    """Presumming filter.

    Attributes
    ----------
    factor
        Pulses per virtual pulse.
    at
        (virtual,) float64, positions of the virtual pulses in pulse numbers; some are beyond the ends.
    weight
        (virtual, pulse) sparse, interpolation filter.
    """

    factor: int
    at: NDArray[np.float64]
    weight: "sparse.csr_array"

    def part(self, virtual: slice) -> tuple["Presum", slice]:
        """Return the filter of a slice of virtual pulses, and the pulses that it requires."""
        weight = self.weight[virtual]
        first, last = int(weight.indices.min(initial=weight.shape[1] - 1)), int(weight.indices.max(initial=0))
        at = self.at[virtual]
        # a position between two pulses requires both pulses; a position beyond an end is extrapolated from the two
        # outermost pulses
        first = max(0, min(first, int(at[0]), weight.shape[1] - 2))
        last = min(weight.shape[1], max(last, int(at[-1]) + 1, 1) + 1)
        return Presum(self.factor, at - first, weight[:, first:last]), slice(first, last)


def design(pulses: int, factor: int, *, widest_cycles: float, error_db: float = -72.0) -> Presum | None:
    """Design the filter for a factor; None if the Doppler band of the scene is too wide for the factor.

    Parameters
    ----------
    pulses
        Number of pulses.
    factor
        Pulses per virtual pulse.
    widest_cycles
        Largest phase rate of a pixel relative to the scene centre, cycles per pulse.
    error_db
        Tolerated error of the filter, dB.

    Examples
    --------
    >>> presum = design(1000, 4, widest_cycles=0.02)
    >>> len(presum.at) < 270, bool(np.allclose(presum.weight.sum(axis=0), 1, atol=5e-4))
    (True, True)
    >>> design(1000, 4, widest_cycles=0.2) is None
    True
    """
    transition = 1 / factor - 2 * widest_cycles
    if factor < 2 or transition <= 0.4 / factor:
        return None
    from scipy import sparse

    stop_db = 12.0 - error_db
    beta = kaiser_beta(stop_db)
    half = int(np.ceil((stop_db - 7.95) / (14.36 * transition) / 2))
    margin = half // factor + 1
    at = factor * np.arange(-margin, (pulses - 1) // factor + margin + 2, dtype=np.float64)
    pulse = np.arange(pulses)
    first = np.clip(np.searchsorted(at, pulse - half), 0, len(at))
    rows = first[:, None] + np.arange(2 * half // factor + 2)
    distance = (at[np.minimum(rows, len(at) - 1)] - pulse[:, None]) / half
    taps = np.sinc(distance * half / factor) * kaiser_window(distance, beta)
    inside = (np.abs(distance) <= 1) & (rows < len(at))
    columns = np.broadcast_to(pulse[:, None], rows.shape)
    weight = sparse.csr_array((taps[inside], (rows[inside], columns[inside])), shape=(len(at), pulses))
    return Presum(factor, at, weight)


def presum_error_db(presum: Presum, aperture: Aperture, place_m: NDArray[np.float64], *, highest_hz: float) -> float:
    """Return the RMS error of the interpolated values over all pulses and a grid of points, dB.

    Parameters
    ----------
    presum
        Filter from `design`.
    aperture
        Aperture of all pulses.
    place_m
        (point, 3) float64, grid of points over the scene, metres; the central element of the array is the scene centre.
    highest_hz
        Upper band edge, at which phases change most rapidly.
    """
    k = 2 * np.pi * highest_hz / SPEED_OF_LIGHT_M_S
    paths = (each.path(place_m) for each in (aperture, _virtual(aperture, presum)))
    # Paths relative to the scene centre.
    real, virtual = (path_m - path_m[:, [path_m.shape[1] // 2]] for path_m in paths)
    interpolated = presum.weight.T @ np.exp(1j * k * virtual)
    return decibels(float((np.abs(interpolated - np.exp(1j * k * real)) ** 2).mean()) + 1e-16)


def _virtual(aperture: Aperture, presum: Presum) -> Aperture:
    return Aperture(*(_positions(leg, presum.at) for leg in aperture.legs))


def _positions(position_m: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions at fractional pulse numbers, linearly extrapolated beyond the ends."""
    last = len(position_m) - 1
    inside = np.clip(at, 0, last)
    lower = np.minimum(inside.astype(int), max(0, last - 1))
    part = (inside - lower)[:, None]
    between = position_m[lower] * (1 - part) + position_m[np.minimum(lower + 1, last)] * part
    slopes = (position_m[1] - position_m[0], position_m[-1] - position_m[-2]) if last else (np.zeros(3), np.zeros(3))
    return np.asarray(between + np.minimum(at, 0)[:, None] * slopes[0] + np.maximum(at - last, 0)[:, None] * slopes[1])


def presummed(profiles: Profiles, presum: Presum, middle_m: NDArray[np.float64]) -> Profiles:
    """Return range profiles of the virtual pulses, the sum over which equals the sum over all pulses.

    Parameters
    ----------
    profiles
        Profiles with a margin of ten samples or more at both ends.
    presum
        Filter from `design`.
    middle_m
        (3,) float64, point to which pulses are aligned, metres.

    Notes
    -----
    Source: docs/theory/planner.md, "Pulses".
    """
    k = profiles.wavenumber_rad_m
    aperture = _virtual(profiles.aperture, presum)
    real, virtual = profiles.aperture.path(middle_m), aperture.path(middle_m)
    start = profiles.start_m - real
    first, last = start.min(), start.max()
    count = profiles.samples.shape[1] + int(np.ceil((last - first) / profiles.step_m))
    aligned = _shifted(profiles.samples, (first - start) / profiles.step_m, count)
    aligned *= np.exp(1j * np.remainder(k * real, 2 * np.pi))[:, None].astype(np.complex64)
    samples = presum.weight.astype(np.float32) @ aligned
    samples = samples * np.exp(-1j * np.remainder(k * virtual, 2 * np.pi))[:, None]
    return Profiles(
        np.asarray(samples, np.complex64),
        virtual + first,
        profiles.step_m,
        profiles.centre_frequency_hz,
        profiles.oversampling,
        aperture,
        profiles.wave_speed_m_s,
    )


def _shifted(samples: NDArray[np.complex64], shift: NDArray[np.float64], count: int) -> NDArray[np.complex64]:
    """Return samples at i + shift of each pulse, i = 0…count-1, by a windowed sinc; zero beyond the ends."""
    shifted = np.zeros((len(samples), count), np.complex64)
    first = np.floor(shift).astype(int)
    taps = np.arange(1 - _HALF_TAPS, _HALF_TAPS + 1)
    distance = (shift - first)[:, None] - taps
    filters = kaiser_sinc(distance, half=_HALF_TAPS, beta=_KAISER_BETA).astype(np.float32)
    for pulse, (row, start, weights) in enumerate(zip(samples, first, filters, strict=True)):
        padded = np.concatenate([np.zeros(_HALF_TAPS - 1, np.complex64), row, np.zeros(_HALF_TAPS, np.complex64)])
        refined = np.convolve(padded, weights[::-1], "valid")  # refined[i] = row at i + fraction
        begin, end = max(0, -start), min(count, len(refined) - start)
        shifted[pulse, begin:end] = refined[begin + start : end + start]
    return shifted
