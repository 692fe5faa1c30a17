"""The double sum over pulses and subcarriers in float64: slow, and what every other engine answers to."""

import numba
import numpy as np
from numpy.typing import NDArray

from apertura.antenna.beam import Beams
from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.focus.inputs import Spectra

_PULSES_AT_ONCE = 16


def prepare(spectra: Spectra) -> Spectra:
    """Return the spectra as they are: the double sum needs no table."""
    return spectra


def form(spectra: Spectra, pixels: NDArray[np.float64], *, beams: Beams | None = None) -> NDArray[np.complex128]:
    """Return the matched filter ΣΣ w_n H_n exp(+j2πf_n(τ-τ_ref)) over pulses and subcarriers at each pixel.

    Parameters
    ----------
    spectra
        Calibrated transfer functions, subcarriers equally spaced.
    pixels
        (..., 3) float64, metres, in the frame of the phase centres.
    beams
        Weight of each pulse at each pixel by its antennas; none by default.

    Returns
    -------
    ndarray
        (...,) complex128.

    Notes
    -----
    Source: docs/theory.md, eq. 5.

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
    for first in range(0, len(spectra.transfer), _PULSES_AT_ONCE):
        pulses = slice(first, first + _PULSES_AT_ONCE)
        image += terms(spectra, flat, beams, pulses=pulses).sum(axis=0)
    return image.reshape(pixels.shape[:-1])


def terms(
    spectra: Spectra, pixels: NDArray[np.float64], beams: Beams | None = None, *, pulses: slice = slice(None)
) -> NDArray[np.complex128]:
    """Return what each pulse adds at each pixel: the sum over subcarriers alone.

    Parameters
    ----------
    spectra
        As `form`.
    pixels
        (pixel, 3) float64, metres.
    beams
        As `form`.
    pulses
        Which pulses; all by default.

    Returns
    -------
    ndarray
        (pulse, pixel) complex128.

    Notes
    -----
    The sum is a polynomial in exp(j2πΔfτ), evaluated by Horner's rule: one rounding per term, 1e-12 for
    thousands of them, and no table or interpolation.
    """
    frequency = spectra.frequency_hz
    step = float(frequency[-1] - frequency[0]) / (len(frequency) - 1)
    weighted = spectra.transfer[pulses] * spectra.weight
    path = sum(
        np.linalg.norm(pixels - centre[pulses, None], axis=-1)
        for centre in (spectra.tx_position_m, spectra.rx_position_m)
    )
    delay = path / SPEED_OF_LIGHT_M_S - spectra.reference_delay_s[pulses, None]
    total = _polynomial(weighted.astype(np.complex128, copy=False), np.exp(2j * np.pi * (step * delay % 1.0)))
    total *= np.exp(2j * np.pi * (frequency[0] * delay % 1.0))
    if beams is not None:
        total *= beams.weight(spectra.tx_position_m, spectra.rx_position_m, pixels, pulses=pulses)
    return np.asarray(total)


@numba.njit(cache=True, nogil=True)
def _polynomial(coefficients, argument):  # type: ignore[no-untyped-def]
    """Return Σ_n coefficients[p, n]·argument[p, i]**n, (pulse, pixel): Horner, all pixels of a pulse side by side."""
    pulses, count = argument.shape
    real, imag = np.zeros((pulses, count)), np.zeros((pulses, count))
    for p in range(pulses):
        z_real, z_imag = argument[p].real.copy(), argument[p].imag.copy()
        for n in range(coefficients.shape[1] - 1, -1, -1):
            c_real, c_imag = coefficients[p, n].real, coefficients[p, n].imag
            for i in range(count):
                turned = real[p, i] * z_real[i] - imag[p, i] * z_imag[i] + c_real
                imag[p, i] = real[p, i] * z_imag[i] + imag[p, i] * z_real[i] + c_imag
                real[p, i] = turned
    return real + 1j * imag
