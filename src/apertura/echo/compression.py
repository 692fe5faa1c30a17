"""Range compression: transfer functions to range profiles, referenced to band centre and cropped to a swath."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from apertura.constants import SPEED_OF_LIGHT_M_S

_PULSES_AT_ONCE = 64

WINDOWS: Mapping[str, Callable[[int], NDArray[np.float64]]] = {"hann": np.hanning, "none": np.ones}
"""Name → weights of that many subcarriers."""


def window_weights(name: str, count: int) -> NDArray[np.float64]:
    """Return the weighting over the subcarriers, summing to 1 so that a profile peaks at the echo's amplitude.

    Parameters
    ----------
    name
        A key of `WINDOWS`.
    count
        Number of subcarriers.

    Examples
    --------
    >>> window_weights("none", 4)
    array([0.25, 0.25, 0.25, 0.25])
    """
    weights = WINDOWS[name](count)
    return np.asarray(weights / weights.sum())


def centre_frequency(frequency_hz: NDArray[np.float64]) -> float:
    """Return the subcarrier at the middle of the band, f_mid, to which profiles are referenced."""
    return float(frequency_hz[len(frequency_hz) // 2])


def range_step(frequency_hz: NDArray[np.float64], *, oversampling: float) -> tuple[float, int]:
    """Return the total path between range samples (m) and the length of the inverse DFT that gives it.

    Parameters
    ----------
    frequency_hz
        (subcarrier,) float64, equally spaced.
    oversampling
        At least this many samples per resolution cell c/B.

    Examples
    --------
    >>> range_step(1e9 + 1e6 * np.arange(100), oversampling=2)
    (1.49896229, 200)
    """
    spacing = float(frequency_hz[-1] - frequency_hz[0]) / (len(frequency_hz) - 1)
    length = fft.next_fast_len(int(np.ceil(oversampling * len(frequency_hz))))
    return SPEED_OF_LIGHT_M_S / (spacing * length), length


def compress(
    transfer: NDArray[np.complex64],
    frequency_hz: NDArray[np.float64],
    *,
    weight: NDArray[np.float64],
    reference_delay_s: NDArray[np.float64],
    start_m: NDArray[np.float64],
    count: int,
    oversampling: float = 2.0,
) -> NDArray[np.complex64]:
    """Return range profiles p(ρ) = Σ w_n H_n exp(+j2π(f_n-f_mid)ρ/c), sampled from `start_m` on.

    Parameters
    ----------
    transfer
        (pulse, subcarrier) complex64: Σ a·exp(-j2πf(τ-reference_delay_s)).
    frequency_hz
        (subcarrier,) float64, RF, equally spaced.
    weight
        (subcarrier,) float64.
    reference_delay_s
        (pulse,) float64; put back here, so that profiles stand for absolute delays.
    start_m
        (pulse,) float64, total path of sample 0.
    count
        Samples kept per pulse.
    oversampling
        As `range_step`, whose step this profile has.

    Returns
    -------
    ndarray
        (pulse, count) complex64.

    Raises
    ------
    ValueError
        If `count` exceeds the unambiguous range.

    Notes
    -----
    Source: docs/theory.md, eq. 4. Referring the profile to band centre halves the bandwidth an interpolator
    meets; exp(+j2πf_mid·ρ/c) remains for backprojection.

    Examples
    --------
    >>> f = 1e9 + 1e6 * np.arange(100)
    >>> echo = np.exp(-2j * np.pi * f * 60 / SPEED_OF_LIGHT_M_S).astype(np.complex64)[None]
    >>> profile = compress(echo, f, weight=np.full(100, 0.01), reference_delay_s=np.zeros(1),
    ...                    start_m=np.array([60.0]), count=4)
    >>> bool(abs(profile[0, 0] * np.exp(2j * np.pi * f[50] * 60 / SPEED_OF_LIGHT_M_S) - 1) < 1e-5)
    True
    """
    _, length = range_step(frequency_hz, oversampling=oversampling)
    if count > length:
        raise ValueError(f"{count=}: the unambiguous range holds {length} samples")
    middle = len(frequency_hz) // 2
    baseband = frequency_hz - frequency_hz[middle]
    bins = (np.arange(len(frequency_hz)) - middle) % length
    profiles = np.empty((len(transfer), count), np.complex64)
    for first in range(0, len(transfer), _PULSES_AT_ONCE):
        block = slice(first, first + _PULSES_AT_ONCE)
        delay = start_m[block] / SPEED_OF_LIGHT_M_S - reference_delay_s[block]
        turns = delay[:, None] * baseband - (frequency_hz[middle] * reference_delay_s[block])[:, None]
        spectrum = np.zeros((len(delay), length), np.complex64)
        spectrum[:, bins] = transfer[block] * (weight * np.exp(2j * np.pi * (turns % 1.0)))
        profiles[block] = fft.ifft(spectrum, axis=1, norm="forward", overwrite_x=True)[:, :count]
    return profiles
