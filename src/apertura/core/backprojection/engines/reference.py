"""Backprojection by the double sum over pulses and subcarriers in float64: the slow reference for all other engines."""

from collections.abc import Mapping
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray

from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines.engine import BEAM_S, EngineOptions, Setting, compiled_for
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.backprojection.job import Job

instruction_set = compiled_for
READS: Literal["phase_history"] = "phase_history"

_PULSES_AT_ONCE = 16
_SUBCARRIER_S = 5.3e-10  # seconds per pixel, pulse and subcarrier
_ERROR_DB = -140.0  # rounding of complex64 images


class Options(EngineOptions):
    """Options of the engine: none."""


def available() -> bool:
    """Return True, because the engine has no requirements."""
    return True


def candidates(job: Job, *, pulses: int, requested: Mapping[str, Any]) -> list[Setting]:  # noqa: ARG001
    """Return the only setting, as described in `apertura.core.backprojection.engines.engine.Engine`."""
    each = job.subcarriers * _SUBCARRIER_S + job.weights * BEAM_S
    return [Setting("reference", {}, {}, _ERROR_DB, job.pixels * pulses * job.share * each)]


def prepare(history: PhaseHistory) -> PhaseHistory:
    """Return the phase history unchanged, because the double sum requires no table."""
    return history


def form(history: PhaseHistory, pixels: NDArray[np.float64], *, beams: Beams | None = None) -> NDArray[np.complex128]:
    """Return the matched filter ΣΣ w_n H_n exp(+j2πf_n(τ-τ_ref)) over pulses and subcarriers at each pixel.

    Parameters
    ----------
    history
        Calibrated transfer functions with equally spaced subcarriers.
    pixels
        (..., 3) float64, metres, in the frame of the phase centres.
    beams
        Antenna weight of each pulse at each pixel (default: 1).

    Returns
    -------
    ndarray
        (...,) complex128.

    Notes
    -----
    Source: docs/theory.md, eq. 5.

    Examples
    --------
    >>> from apertura.core.geometry.aperture import Aperture
    >>> f = 1e9 + 1e6 * np.arange(8)
    >>> tx = np.array([[0.0, 0.0, 10.0]])
    >>> echo = np.exp(-2j * np.pi * f * 20 / 299792458.0).astype(np.complex64)[None]
    >>> history = PhaseHistory(echo, f, np.full(8, 1 / 8), np.zeros(1), Aperture(tx, tx))
    >>> form(history, np.zeros((1, 1, 3))).round(6) + 0.0
    array([[1.+0.j]])
    """
    flat = pixels.reshape(-1, 3)
    image = np.zeros(len(flat), np.complex128)
    for first in range(0, len(history), _PULSES_AT_ONCE):
        pulses = slice(first, first + _PULSES_AT_ONCE)
        image += terms(history[pulses], flat, beams and beams[pulses]).sum(axis=0)
    return image.reshape(pixels.shape[:-1])


def terms(history: PhaseHistory, pixels: NDArray[np.float64], beams: Beams | None = None) -> NDArray[np.complex128]:
    """Return the contribution of each pulse at each pixel, which is the sum over the subcarriers.

    Parameters
    ----------
    history, beams
        As for `form`.
    pixels
        (pixel, 3) float64, metres.

    Returns
    -------
    ndarray
        (pulse, pixel) complex128.

    Notes
    -----
    The sum is a polynomial in exp(j2πΔfτ), which is evaluated by Horner's rule without tables or interpolation. The
    rounding error for thousands of terms is 1e-12.
    """
    frequency = history.frequency_hz
    step = float(frequency[-1] - frequency[0]) / (len(frequency) - 1)
    weighted = history.transfer * history.weight
    delay = history.aperture.path(pixels) / history.wave_speed_m_s - history.reference_delay_s[:, None]
    total = polynomial(weighted.astype(np.complex128, copy=False), np.exp(2j * np.pi * (step * delay % 1.0)))
    total *= np.exp(2j * np.pi * (frequency[0] * delay % 1.0))
    if beams is not None:
        total *= beams.weight(history.aperture, pixels)
    return np.asarray(total)


@numba.njit(cache=True, nogil=True)
def polynomial(coefficients, argument):  # type: ignore[no-untyped-def]
    """Return Σ_n coefficients[p, n]·argument[p, i]**n, (pulse, pixel), by Horner's rule vectorised over pixels."""
    pulses, count = argument.shape
    real, imag = np.zeros((pulses, count)), np.zeros((pulses, count))
    for p in range(pulses):
        z_real, z_imag = argument[p].real.copy(), argument[p].imag.copy()
        for n in range(coefficients.shape[1] - 1, -1, -1):
            c_real, c_imag = coefficients[p, n].real, coefficients[p, n].imag
            for i in range(count):
                real_part = real[p, i] * z_real[i] - imag[p, i] * z_imag[i] + c_real
                imag[p, i] = real[p, i] * z_imag[i] + imag[p, i] * z_real[i] + c_imag
                real[p, i] = real_part
    return real + 1j * imag
