"""Fewer pulses for an oversampled aperture: a low-pass sum over neighbours, aligned to the middle of the scene.

Leaving pulses out would fold noise and echoes from elsewhere into the image. Here every pulse is kept: the
value of a pulse at a pixel is interpolated from its values at every k-th, so the sum over k times fewer virtual
pulses equals the sum over all (docs/theory/planner.md, "Pulses").
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
"""Seconds per pulse and range sample, on one core."""

_HALF_TAPS = 10
_KAISER_BETA = 10.0


@dataclass(frozen=True)
class Presum:
    """A low-pass sum over pulses.

    Attributes
    ----------
    factor
        Pulses per virtual pulse.
    at
        (virtual,) float64, places of the virtual pulses in pulse numbers; some lie beyond both ends.
    weight
        (virtual, pulse) sparse: the interpolation filter.
    """

    factor: int
    at: NDArray[np.float64]
    weight: "sparse.csr_array"

    def part(self, virtual: slice) -> tuple["Presum", slice]:
        """Return the low-pass sum for some of the virtual pulses, and the pulses that it takes."""
        weight = self.weight[virtual]
        first, last = int(weight.indices.min(initial=weight.shape[1] - 1)), int(weight.indices.max(initial=0))
        at = self.at[virtual]
        # places between two pulses take both; those beyond an end go straight on from the two outermost
        first = max(0, min(first, int(at[0]), weight.shape[1] - 2))
        last = min(weight.shape[1], max(last, int(at[-1]) + 1, 1) + 1)
        return Presum(self.factor, at - first, weight[:, first:last]), slice(first, last)


def design(pulses: int, factor: int, *, widest_cycles: float, error_db: float = -72.0) -> Presum | None:
    """Return the filter for a factor, or None where the scene's Doppler band leaves no room for it.

    Parameters
    ----------
    pulses
        Number of pulses.
    factor
        Pulses per virtual pulse.
    widest_cycles
        Largest phase rate of a pixel against the scene's middle, cycles per pulse.
    error_db
        Tolerated error of the filter.

    Examples
    --------
    >>> presum = design(1000, 4, widest_cycles=0.02)
    >>> len(presum.at) < 270, bool(np.allclose(presum.weight.sum(axis=0), 1, atol=5e-4))
    (True, True)
    >>> design(1000, 4, widest_cycles=0.2) is None
    True
    """
    room = 1 / factor - 2 * widest_cycles
    if factor < 2 or room <= 0.4 / factor:
        return None
    from scipy import sparse

    stop_db = 12.0 - error_db
    beta = kaiser_beta(stop_db)
    half = int(np.ceil((stop_db - 7.95) / (14.36 * room) / 2))
    beyond = half // factor + 1
    at = factor * np.arange(-beyond, (pulses - 1) // factor + beyond + 2, dtype=np.float64)
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
    """Return the RMS error of the interpolated values at pixels, over all pulses and a grid of points, dB.

    Parameters
    ----------
    presum
        From `design`.
    aperture
        Of all pulses.
    place_m
        (place, 3) float64, metres: a grid of points over the scene, its middle at the middle of the array.
    highest_hz
        Upper edge of the band, where phases turn fastest.
    """
    k = 2 * np.pi * highest_hz / SPEED_OF_LIGHT_M_S
    paths = (one.path(place_m) for one in (aperture, _virtual(aperture, presum)))
    real, virtual = (path_m - path_m[:, [path_m.shape[1] // 2]] for path_m in paths)  # against the middle of the scene
    read = presum.weight.T @ np.exp(1j * k * virtual)
    return decibels(float((np.abs(read - np.exp(1j * k * real)) ** 2).mean()) + 1e-16)


def _virtual(aperture: Aperture, presum: Presum) -> Aperture:
    return Aperture(*(_positions(leg, presum.at) for leg in aperture.legs))


def _positions(position_m: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions at pulse numbers, straight on beyond the ends."""
    last = len(position_m) - 1
    inside = np.clip(at, 0, last)
    lower = np.minimum(inside.astype(int), max(0, last - 1))
    part = (inside - lower)[:, None]
    between = position_m[lower] * (1 - part) + position_m[np.minimum(lower + 1, last)] * part
    slopes = (position_m[1] - position_m[0], position_m[-1] - position_m[-2]) if last else (np.zeros(3), np.zeros(3))
    return np.asarray(between + np.minimum(at, 0)[:, None] * slopes[0] + np.maximum(at - last, 0)[:, None] * slopes[1])


def presummed(profiles: Profiles, presum: Presum, middle_m: NDArray[np.float64]) -> Profiles:
    """Return profiles of the virtual pulses, whose image has the same sum.

    Parameters
    ----------
    profiles
        With ten samples or more to spare at both ends.
    presum
        From `design`.
    middle_m
        (3,) float64, metres: the place to which pulses are aligned.

    Notes
    -----
    Source: docs/theory/planner.md, "Pulses".
    """
    k = profiles.wavenumber_rad_m
    aperture = _virtual(profiles.aperture, presum)
    real, virtual = profiles.aperture.path(middle_m), aperture.path(middle_m)
    begin = profiles.start_m - real
    first, last = begin.min(), begin.max()
    count = profiles.samples.shape[1] + int(np.ceil((last - first) / profiles.step_m))
    aligned = _shifted(profiles.samples, (first - begin) / profiles.step_m, count)
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
    """Return sample i + shift of each pulse, i = 0…count-1, by a windowed sinc; zero beyond the ends."""
    moved = np.zeros((len(samples), count), np.complex64)
    first = np.floor(shift).astype(int)
    taps = np.arange(1 - _HALF_TAPS, _HALF_TAPS + 1)
    distance = (shift - first)[:, None] - taps
    filters = kaiser_sinc(distance, half=_HALF_TAPS, beta=_KAISER_BETA).astype(np.float32)
    for pulse, (row, start, weights) in enumerate(zip(samples, first, filters, strict=True)):
        padded = np.concatenate([np.zeros(_HALF_TAPS - 1, np.complex64), row, np.zeros(_HALF_TAPS, np.complex64)])
        refined = np.convolve(padded, weights[::-1], "valid")  # refined[i] = row at i + fraction
        begin, end = max(0, -start), min(count, len(refined) - start)
        moved[pulse, begin:end] = refined[begin + start : end + start]
    return moved
