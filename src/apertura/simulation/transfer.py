"""Transfer functions of point scatterers along an aperture, for simulations, studies, benchmarks and tests.

The exact sum costs one matrix product per pulse; for thousands of scatterers there is a gridded one.
"""

import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.geometry.aperture import Aperture
from apertura.simulation.impairments import Floats
from apertura.simulation.scene import Scatterers

_BLOCK = 64  # subcarriers that share one exponential
_TERMS = 2**22  # exponentials held at once by the exact sum
_SAMPLES = 2**20  # of range, held at once by the gridded one


def transfer(
    scatterers: Scatterers,
    aperture: Aperture,
    frequency_hz: Floats,
    *,
    longer_m: Floats | None = None,
    spreading: bool = True,
    gridded: bool = False,
) -> NDArray[np.complex64]:
    """Return H_pn = Σ_j a_j/(R_t·R_r)·exp(-j2πf_n(R_t + R_r + x_p)/c), the echo of scatterers per pulse and subcarrier.

    R_t and R_r are the distances of scatterer j from transmitter and receiver at pulse p.

    Parameters
    ----------
    scatterers
        Positions (scatterer, 3) in the frame of the aperture, metres, and complex amplitudes at 1 m × 1 m.
    aperture
        True phase centres, (pulse, 3) metres each; nothing moves within a pulse.
    frequency_hz
        (subcarrier,) float64, f_n at RF, equally spaced.
    longer_m
        (pulse,) float64, x_p, metres by which the paths of a pulse are longer than geometry; None: zero.
    spreading
        Divide by R_t·R_r; otherwise every scatterer is as strong at any distance.
    gridded
        Spread echoes over samples of range instead of summing exactly: fast for thousands of scatterers, right to 3e-6.

    Returns
    -------
    ndarray
        (pulse, subcarrier) complex64.

    Notes
    -----
    Source: docs/theory/simulate.md, eqs. 1 and 2.

    Examples
    --------
    >>> point = Scatterers(np.array([[0.0, 3.0, 0.0]]), np.array([1.0 + 0j]))
    >>> bistatic = Aperture(np.zeros((1, 3)), np.array([[4.0, 0.0, 0.0]]))
    >>> abs(transfer(point, bistatic, 1e9 + 1e6 * np.arange(2))).round(4)  # 1 / (3 m × 5 m)
    array([[0.0667, 0.0667]], dtype=float32)
    """
    longer = np.zeros(len(aperture)) if longer_m is None else longer_m
    form = _gridded if gridded else _summed
    out = np.empty((len(aperture), len(frequency_hz)), np.complex64)
    at_once = _pulses_at_once(len(scatterers.amplitude), len(frequency_hz), gridded=gridded)
    for first in range(0, len(out), at_once):
        part = slice(first, first + at_once)
        out[part] = form(scatterers, aperture[part], frequency_hz, longer[part], spreading=spreading)
    return out


def spectrum(delay_s: Floats, amplitude: NDArray[np.complex128], frequency_hz: Floats) -> NDArray[np.complex128]:
    """Return Σ a·exp(-j2πf_nτ) over the last axis: (..., path) → (..., subcarrier) complex128.

    Parameters
    ----------
    delay_s
        (..., path) float64, τ, seconds.
    amplitude
        (..., path) complex128, a.
    frequency_hz
        (subcarrier,) float64, f_n at RF, equally spaced.

    Notes
    -----
    Source: docs/theory/simulate.md, eq. 2. The exponential of subcarrier n = 64i + j is the product of two small ones,
    so that many points cost one matrix product.

    Examples
    --------
    >>> np.angle(spectrum(np.array([0.25e-6]), np.array([1.0 + 0j]), 1e9 + 1e6 * np.arange(4))).round(3) + 0.0
    array([ 0.   , -1.571, -3.142,  1.571])
    """
    count = len(frequency_hz)
    spacing_hz = (frequency_hz[-1] - frequency_hz[0]) / max(count - 1, 1)
    coarse, fine = frequency_hz[::_BLOCK], np.arange(_BLOCK) * spacing_hz
    left = amplitude[..., None, :] * np.exp(-2j * np.pi * coarse[:, None] * delay_s[..., None, :])
    right = np.exp(-2j * np.pi * fine * delay_s[..., :, None])
    return np.asarray((left @ right).reshape(*delay_s.shape[:-1], -1)[..., :count])


def _pulses_at_once(scatterers: int, subcarriers: int, *, gridded: bool) -> int:
    if gridded:
        return max(1, _SAMPLES // (2 * subcarriers))
    return max(1, _TERMS // (max(scatterers, 1) * (_BLOCK + -(-subcarriers // _BLOCK))))


def _summed(
    scatterers: Scatterers, aperture: Aperture, frequency_hz: Floats, longer_m: Floats, *, spreading: bool
) -> NDArray[np.complex128]:
    there, back = (np.linalg.norm(leg[:, None] - scatterers.position_m, axis=-1) for leg in aperture.legs)
    amplitude = np.broadcast_to(scatterers.amplitude / (there * back if spreading else 1.0), there.shape)
    return spectrum((there + back + longer_m[:, None]) / SPEED_OF_LIGHT_M_S, amplitude, frequency_hz)


def _gridded(
    scatterers: Scatterers, aperture: Aperture, frequency_hz: Floats, longer_m: Floats, *, spreading: bool
) -> NDArray[np.complex128]:
    from apertura.simulation.gridding import gridded_sum  # numba is slow to import, and few scatterers need none of it

    points = scatterers.position_m, scatterers.amplitude
    return gridded_sum(points, aperture.legs, frequency_hz, longer_m, spreading=spreading)
