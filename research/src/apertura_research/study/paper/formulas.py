"""Closed forms of the source paper: waveform, clocks, timing, resolution and coherence.

Source of all: docs/theory/study.md, "Closed forms", unless a function says otherwise.
"""

import numpy as np

from apertura.common.constants import SPEED_OF_LIGHT_M_S

HALF_POWER_OF_SINC = 0.886
"""−3 dB width of |sinc(x)|²."""

HALF_POWER_OF_HANN = 1.441
"""−3 dB width of the response of a Hann window, in the same unit 1/B.

Source: F. J. Harris, "On the use of windows for harmonic analysis with the DFT", Proc. IEEE 66 (1978), table I.
"""


def sfo_limit_hz(sample_rate_hz: float, bandwidth_hz: float, symbol_s: float) -> float:
    """Return f_s(1 − 1/(1 + 1/(BT))): the last subcarrier drifts by one turn over the symbol.

    Examples
    --------
    >>> round(sfo_limit_hz(1.024e9, 409.6e6, 12.5e-6))
    199961
    """
    return sample_rate_hz * (1 - 1 / (1 + 1 / (bandwidth_hz * symbol_s)))


def cfo_limit_hz(subcarrier_spacing_hz: float) -> float:
    """Return Δf/10, which costs 20·lg sinc(0.1) = −0.14 dB.

    Examples
    --------
    >>> cfo_limit_hz(100e3)
    10000.0
    """
    return subcarrier_spacing_hz / 10


def ground_range_resolution_m(
    bandwidth_hz: float, ground_range_m: float, height_m: float, *, half_power: float = HALF_POWER_OF_SINC
) -> float:
    """Return half_power·c/2B·R/r_g, the −3 dB width on the ground abreast of the track.

    Examples
    --------
    >>> [round(100 * ground_range_resolution_m(409.6e6, r, 10.0), 1) for r in (5.0, 25.0)]
    [72.5, 34.9]
    """
    slant_m = np.hypot(ground_range_m, height_m)
    return float(half_power * SPEED_OF_LIGHT_M_S / (2 * bandwidth_hz) * slant_m / ground_range_m)


def cross_range_resolution_m(frequency_hz: float, slant_range_m: float, aperture_m: float) -> float:
    """Return 0.886·λR/2L, the −3 dB width along the track of a short aperture.

    Examples
    --------
    >>> round(100 * cross_range_resolution_m(1.40475e9, 12.51, 3.4), 1)
    34.8
    """
    wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz
    return HALF_POWER_OF_SINC * wavelength_m * slant_range_m / (2 * aperture_m)


def coherence_of_snr(snr: float, pulses: int) -> float:
    """Return Γ = (SNR + 1/M)/(SNR + 1) of M equal echoes in white noise of a given power SNR per compressed pulse.

    Examples
    --------
    >>> round(coherence_of_snr(1e3, 200), 4)
    0.999
    """
    return (snr + 1 / pulses) / (snr + 1)


def snr_of_coherence_factor(coherence: float, pulses: int) -> float:
    """Return the power SNR of one compressed pulse at which M equal echoes in white noise are so coherent.

    Notes
    -----
    Source: docs/theory/study.md, "Coherence factor": Γ = E|Σs|²/(M·E Σ|s|²) = (SNR + 1/M)/(SNR + 1).

    Examples
    --------
    >>> [round(10 * float(np.log10(snr_of_coherence_factor(g, 200))), 1) for g in (0.986, 0.9995, 0.9999)]
    [18.5, 33.0, 40.0]
    """
    return (coherence - 1 / pulses) / (1 - coherence)
