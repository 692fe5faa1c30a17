"""The double sum over pulses and subcarriers in float64: slow, and what every other engine answers to."""

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.image.history import Spectra

_PULSES_AT_ONCE = 16


def prepare(spectra: Spectra) -> Spectra:
    """Return the spectra as they are: the double sum needs no table."""
    return spectra


def form(spectra: Spectra, pixels: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the matched filter ΣΣ w_n H_n exp(+j2πf_n(τ-τ_ref)) at each pixel.

    Parameters
    ----------
    spectra
        Calibrated transfer functions, subcarriers equally spaced.
    pixels
        (..., 3) float64, metres, in the frame of the phase centres.

    Returns
    -------
    ndarray
        (...,) complex128.

    Notes
    -----
    Source: docs/theory.md, eq. 5. The sum over subcarriers is a polynomial in exp(j2πΔfτ), evaluated by
    Horner's rule: one rounding per term, 1e-12 for thousands of them, and no table or interpolation.

    Examples
    --------
    >>> f = 1e9 + 1e6 * np.arange(8)
    >>> tx = np.array([[0.0, 0.0, 10.0]])
    >>> echo = np.exp(-2j * np.pi * f * 20 / SPEED_OF_LIGHT_M_S).astype(np.complex64)[None]
    >>> spectra = Spectra(echo, f, np.full(8, 1 / 8), np.zeros(1), tx, tx)
    >>> form(spectra, np.zeros((1, 1, 3))).round(6) + 0.0
    array([[1.+0.j]])
    """
    flat = pixels.reshape(-1, 3)
    image = np.zeros(len(flat), np.complex128)
    weighted = spectra.transfer * spectra.weight
    lowest, step = spectra.frequency_hz[0], _spacing(spectra.frequency_hz)
    for first in range(0, len(weighted), _PULSES_AT_ONCE):
        block = slice(first, first + _PULSES_AT_ONCE)
        path = sum(
            np.linalg.norm(flat - centre[block, None], axis=-1)
            for centre in (spectra.tx_position_m, spectra.rx_position_m)
        )
        delay = path / SPEED_OF_LIGHT_M_S - spectra.reference_delay_s[block, None]
        turn = np.exp(2j * np.pi * (step * delay % 1.0))
        total = np.zeros_like(turn)
        for subcarrier in range(weighted.shape[1] - 1, -1, -1):
            total *= turn
            total += weighted[block, subcarrier, None]
        image += (total * np.exp(2j * np.pi * (lowest * delay % 1.0))).sum(axis=0)
    return image.reshape(pixels.shape[:-1])


def _spacing(frequency_hz: NDArray[np.float64]) -> float:
    return float(frequency_hz[-1] - frequency_hz[0]) / (len(frequency_hz) - 1)
