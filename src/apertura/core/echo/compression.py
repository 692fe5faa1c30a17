"""Range compression of transfer functions to profiles, referenced to the band centre and cropped to the swath."""

from collections.abc import Callable, Mapping

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.windowed_sinc import kaiser_window

# ---- Phasors over equally spaced frequencies


def unit_phasor(cycles: NDArray[np.float64]) -> NDArray[np.complex64]:
    """Return exp(j2π·cycles), complex64; integer cycles are removed in float64 before the evaluation in float32.

    Examples
    --------
    >>> unit_phasor(np.array([1e6 + 0.25])).round(6) + 0
    array([0.+1.j], dtype=complex64)
    """
    angle = ((cycles - np.rint(cycles)) * (2 * np.pi)).astype(np.float32)
    out = np.empty(angle.shape, np.complex64)
    np.cos(angle, out=out.real)
    np.sin(angle, out=out.imag)
    return out


def rotated(values: NDArray[np.number], cycles: NDArray[np.float64]) -> NDArray[np.complex64]:
    """Return values·exp(j2π·cycles), complex64."""
    return np.asarray(values * unit_phasor(cycles), np.complex64)


def phasors(cycles: NDArray[np.float64], count: int, *, first: float = 0.0) -> NDArray[np.complex64]:
    """Return the phasors exp(j2π·cycles·n) for n = first, first + 1, …, (pulse, count) complex64.

    Parameters
    ----------
    cycles
        (pulse,) float64, phase step from one n to the next, cycles.
    count
        Number of values of n.
    first
        The first n; may be fractional.

    Notes
    -----
    Phasors are computed as products of coarse and fine phasors, so that fewer exponentials are evaluated. Results are
    exact within the rounding error of complex64.

    Examples
    --------
    >>> phasors(np.array([0.25]), 4).round(6) + 0
    array([[ 1.+0.j,  0.+1.j, -1.+0.j,  0.-1.j]], dtype=complex64)
    """
    side = int(np.ceil(np.sqrt(count)))
    fine = unit_phasor(cycles[:, None] * np.arange(side))
    coarse = unit_phasor(cycles[:, None] * (first + side * np.arange(-(-count // side))))
    return (coarse[:, :, None] * fine[:, None]).reshape(len(cycles), -1)[:, :count]


# ---- Range compression

_PULSES_AT_ONCE = 32  # number of pulses per block, limited by the processor caches

_TAPS = 7
_ROOM = 2.0
"""Length of a decimated profile relative to the swath; with seven taps, the error is below complex64 rounding."""
_LARGEST_FACTOR = 64

WINDOWS: Mapping[str, Callable[[int], NDArray[np.float64]]] = {"hann": np.hanning, "none": np.ones}
"""Name of the window → function of the number of subcarriers; the Hann window is symmetric (docs/theory.md, eq. 4)."""


def window_weights(name: str, count: int) -> NDArray[np.float64]:
    """Return the weights of a window with the sum 1, so that the peak of a profile is the amplitude of the echo.

    Examples
    --------
    >>> window_weights("none", 4)
    array([0.25, 0.25, 0.25, 0.25])
    """
    weights = WINDOWS[name](count)
    return np.asarray(weights / weights.sum())


def centre_frequency(frequency_hz: NDArray[np.float64]) -> float:
    """Return the frequency f_mid of the subcarrier at band centre, to which profiles are referenced."""
    return float(frequency_hz[len(frequency_hz) // 2])


def range_step(
    frequency_hz: NDArray[np.float64], *, oversampling: float, wave_speed_m_s: float = SPEED_OF_LIGHT_M_S
) -> tuple[float, int]:
    """Return the spacing of range samples (total path, metres) and the corresponding length of the inverse DFT.

    `frequency_hz`, (subcarrier,), is equally spaced. With the wave speed v, `wave_speed_m_s`, the profile has at least
    `oversampling` samples per resolution cell v/B.

    Raises
    ------
    CampaignError
        If there is only one frequency, or if the frequencies do not ascend in steps that are equal within 1 %.

    Examples
    --------
    >>> range_step(1e9 + 1e6 * np.arange(100), oversampling=2)
    (1.49896229, 200)
    """
    steps = np.diff(frequency_hz)
    spacing = float(steps.mean()) if len(steps) else 0.0
    if not (spacing > 0 and (np.abs(steps - spacing) <= 0.01 * spacing).all()):
        raise CampaignError(
            f"{len(frequency_hz)} frequencies, in steps of {steps.min():.6g} to {steps.max():.6g} Hz"
            if len(steps)
            else f"{len(frequency_hz)} frequencies",
            where="frequency_hz",
            expected="two or more frequencies, ascending in equal steps",
            remedy="Sort the subcarriers by frequency, and fill missing subcarriers with zeros.",
        )
    length = scipy.fft.next_fast_len(int(np.ceil(oversampling * len(frequency_hz))))
    return wave_speed_m_s / (spacing * length), length


def compress(
    transfer: NDArray[np.complex64],
    frequency_hz: NDArray[np.float64],
    *,
    weight: NDArray[np.float64],
    reference_delay_s: NDArray[np.float64],
    start_m: NDArray[np.float64],
    count: int,
    oversampling: float = 2.0,
    wave_speed_m_s: float = SPEED_OF_LIGHT_M_S,
) -> NDArray[np.complex64]:
    """Return range profiles p(ρ) = Σ w_n H_n exp(+j2π(f_n-f_mid)ρ/v), sampled at total paths ρ from `start_m` on.

    Parameters
    ----------
    transfer
        (pulse, subcarrier) complex64: Σ a·exp(-j2πf(τ-reference_delay_s)).
    frequency_hz
        (subcarrier,) float64, RF frequencies, equally spaced.
    weight
        (subcarrier,) float64, window over the subcarriers.
    reference_delay_s
        (pulse,) float64, seconds; added to the delays, so that profiles have absolute delays.
    start_m
        (pulse,) float64, total path of sample 0, metres.
    count
        Number of samples per pulse.
    oversampling
        As for `range_step`, which returns the spacing of the samples.
    wave_speed_m_s
        Wave speed v along the paths.

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
    Source: docs/theory.md, eq. 4. Because profiles are referenced to the band centre, the bandwidth for interpolation
    is halved; backprojection applies the factor exp(+j2πf_mid·ρ/v). If the swath is only part of the unambiguous range,
    the subcarriers are first decimated (docs/theory.md, eq. 4a), with the accuracy of complex64.

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
        raise ValueError(f"{count=}: the unambiguous range contains {length} samples")
    middle, offset = len(frequency_hz) // 2, np.arange(count) - count // 2  # samples from the centre of the swath
    spacing_hz = float(frequency_hz[-1] - frequency_hz[0]) / (len(frequency_hz) - 1)
    cycles = (start_m / wave_speed_m_s - reference_delay_s) * spacing_hz + (count // 2) / length  # per subcarrier
    carrier = np.exp(-2j * np.pi * (frequency_hz[middle] * reference_delay_s % 1.0))
    filters, response = _decimation(len(frequency_hz), length, count)
    factor, blocks = len(filters), -(-len(frequency_hz) // len(filters))
    weighted = np.zeros((_PULSES_AT_ONCE, blocks * factor), np.complex64)
    profiles = np.empty((len(transfer), count), np.complex64)
    for first in range(0, len(transfer), _PULSES_AT_ONCE):
        pulses = slice(first, min(first + _PULSES_AT_ONCE, len(transfer)))
        block = weighted[: pulses.stop - first]
        np.multiply(transfer[pulses], weight.astype(np.float32), out=block[:, : len(frequency_hz)])
        # decimation (eq. 4a): after a shift to the centre of the swath, groups of `factor` subcarriers are summed
        taps = filters * phasors(cycles[pulses], factor)[:, :, None]
        sums = block.reshape(len(block), blocks, factor) @ taps
        start = rotated(carrier[pulses], -middle * cycles[pulses])
        sums *= (phasors(factor * cycles[pulses], blocks) * start[:, None])[:, :, None]
        spectrum = np.zeros((len(block), length // factor), np.complex64)
        for tap in range(filters.shape[1]):
            spectrum[:, tap : tap + blocks] += sums[:, :, tap]
        swath = scipy.fft.ifft(spectrum, axis=1, norm="forward", overwrite_x=True)
        profiles[pulses] = swath[:, offset % (length // factor)] * response
    return profiles


def _decimation(subcarriers: int, length: int, count: int) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
    """Return the decimation filter, (factor, tap), and the inverse of its response over the swath, (count,).

    The factor is the largest for which the unambiguous range after decimation is at least `_ROOM` times the swath. It
    is 1 if the swath fills the unambiguous range.
    """
    offset, middle = np.arange(count) - count // 2, subcarriers // 2
    factors = [factor for factor in range(4, _LARGEST_FACTOR + 1) if length % factor == 0]
    factors = [n for n in factors if length // n >= max(_ROOM * count, -(-subcarriers // n) + _TAPS - 1)]
    if not factors:
        return np.ones((1, 1), np.complex64), rotated(np.ones(count), -middle * offset / length)
    factor, reach = factors[-1], _TAPS // 2
    beta = np.pi * np.sqrt((_TAPS * (1 - 0.5 / _ROOM)) ** 2 - 0.8)  # Beatty et al. (2005), for this oversampling

    within = (np.arange(factor) - (factor - 1) / 2) / factor
    taps = kaiser_window((within[:, None] - np.arange(-reach, reach + 1)) / (_TAPS / 2), beta)
    nodes, weights = np.polynomial.legendre.leggauss(64)
    wave = np.cos(np.pi * _TAPS * np.outer(offset * factor / length, nodes))
    response = 1 / (wave @ (weights * _TAPS / 2 * kaiser_window(nodes, beta)))
    delay = (factor - 1) / 2 - middle - factor * reach
    return taps.astype(np.complex64), rotated(response, delay * offset / length)
