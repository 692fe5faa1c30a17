"""Echo paths and transfer functions of point scatterers, for simulations, studies, benchmarks and tests.

The exact sum takes one matrix product per pulse; a gridded sum is available for thousands of scatterers.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.geometry.aperture import Aperture, distance
from apertura.core.geometry.atmosphere import Atmosphere
from apertura.simulation.targets import Scatterers

_BLOCK = 64  # subcarriers with a common coarse exponential
_TERMS = 2**22  # exponentials computed together in the exact sum
_SAMPLES = 2**20  # range samples computed together in the gridded sum


def transfer(
    scatterers: Scatterers,
    aperture: Aperture,
    frequency_hz: Floats,
    *,
    longer_m: Floats | None = None,
    spreading: bool = True,
    gridded: bool = False,
) -> NDArray[np.complex64]:
    """Compute the echo of scatterers, H_pn = Σ_j a_j/(R_t·R_r)·exp(-j2πf_n(R_t + R_r + x_p)/c).

    R_t and R_r are the distances of scatterer j from transmitter and receiver at pulse p; n is the subcarrier.

    Parameters
    ----------
    scatterers
        Positions (scatterer, 3) in the frame of the aperture, metres, and complex amplitudes at 1 m × 1 m.
    aperture
        True phase centres, (pulse, 3) metres each, constant within a pulse.
    frequency_hz
        (subcarrier,) float64, f_n at RF, equally spaced.
    longer_m
        (pulse,) float64, x_p, path of each pulse in addition to the geometric path, metres; None: zero.
    spreading
        True to divide by R_t·R_r; otherwise the echo does not depend on the distance.
    gridded
        True to use the gridded instead of the exact sum: fast for thousands of scatterers, relative error 3e-6.

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
    compute = _gridded if gridded else _summed
    out = np.empty((len(aperture), len(frequency_hz)), np.complex64)
    at_once = _pulses_at_once(len(scatterers.amplitude), len(frequency_hz), gridded=gridded)
    for first in range(0, len(out), at_once):
        pulses = slice(first, first + at_once)
        out[pulses] = compute(scatterers, aperture[pulses], frequency_hz, longer[pulses], spreading=spreading)
    return out


def spectrum(delay_s: Floats, amplitude: NDArray[np.complex128], frequency_hz: Floats) -> NDArray[np.complex128]:
    """Sum Σ a·exp(-j2πf_nτ) over the last axis: (..., path) → (..., subcarrier) complex128.

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
    Source: docs/theory/simulate.md, eq. 2. The exponential of subcarrier n = 64i + j is the product of a coarse and a
    fine one, so that the sum over paths is a matrix product.

    Examples
    --------
    >>> np.angle(spectrum(np.array([0.25e-6]), np.array([1.0 + 0j]), 1e9 + 1e6 * np.arange(4))).round(3) + 0.0
    array([ 0.   , -1.571, -3.142,  1.571])
    """
    count = len(frequency_hz)
    spacing_hz = (frequency_hz[-1] - frequency_hz[0]) / max(count - 1, 1)
    coarse_hz, fine_hz = frequency_hz[::_BLOCK], np.arange(_BLOCK) * spacing_hz
    coarse = amplitude[..., None, :] * np.exp(-2j * np.pi * coarse_hz[:, None] * delay_s[..., None, :])
    fine = np.exp(-2j * np.pi * fine_hz * delay_s[..., :, None])
    return np.asarray((coarse @ fine).reshape(*delay_s.shape[:-1], -1)[..., :count])


def _pulses_at_once(scatterers: int, subcarriers: int, *, gridded: bool) -> int:
    if gridded:
        return max(1, _SAMPLES // (2 * subcarriers))
    return max(1, _TERMS // (max(scatterers, 1) * (_BLOCK + -(-subcarriers // _BLOCK))))


def _summed(
    scatterers: Scatterers, aperture: Aperture, frequency_hz: Floats, longer_m: Floats, *, spreading: bool
) -> NDArray[np.complex128]:
    tx_range, rx_range = (distance(position_m[:, None], scatterers.position_m) for position_m in aperture.legs)
    amplitude = np.broadcast_to(scatterers.amplitude / (tx_range * rx_range if spreading else 1.0), tx_range.shape)
    return spectrum((tx_range + rx_range + longer_m[:, None]) / SPEED_OF_LIGHT_M_S, amplitude, frequency_hz)


def _gridded(
    scatterers: Scatterers, aperture: Aperture, frequency_hz: Floats, longer_m: Floats, *, spreading: bool
) -> NDArray[np.complex128]:
    from apertura.simulation.gridding import gridded_sum  # numba is slow to import, and not required for the exact sum

    points = scatterers.position_m, scatterers.amplitude
    return gridded_sum(points, aperture.legs, frequency_hz, longer_m, spreading=spreading)


@dataclass(frozen=True)
class Paths:
    """Paths from the transmitter to one receiving channel, each array (pulse, path).

    Attributes
    ----------
    delay_s, delay_rate
        float64, delays at the start of the pulse, seconds, and their rates of change; zero: stop-and-go approximation.
    amplitude
        complex128.
    """

    delay_s: Floats
    amplitude: NDArray[np.complex128]
    delay_rate: Floats

    def and_also(self, other: "Paths") -> "Paths":
        """Return the union of both sets of paths."""
        arrays = zip(vars(self).values(), vars(other).values(), strict=True)
        return Paths(*(np.concatenate(pair, axis=1) for pair in arrays))

    def at(self, pulses: slice | NDArray[np.intp]) -> "Paths":
        """Return the paths at the selected pulses."""
        return Paths(self.delay_s[pulses], self.amplitude[pulses], self.delay_rate[pulses])


@dataclass(frozen=True)
class TrueAir:
    """True atmosphere along each one-way path, from the heights of its ends.

    Attributes
    ----------
    atmosphere
        Refractivity as a function of height.
    height
        Function from positions (..., 3), metres, to heights (...), metres.
    """

    atmosphere: Atmosphere
    height: Callable[[Floats], Floats]

    def index(self, antenna_m: Floats, points_m: Floats) -> Floats:
        """Return the mean refractive index (pulse, point) from antennas (pulse, 3) to points (point, 3)."""
        ends = self.height(antenna_m)[:, None], self.height(points_m)[None]
        return np.asarray(1 + 1e-6 * self.atmosphere.mean_n(*ends))

    def index_between(self, one_m: Floats, other_m: Floats) -> Floats:
        """Return the mean refractive index (pulse, 1) between antennas (pulse, 3) each."""
        mean_n = self.atmosphere.mean_n(self.height(one_m), self.height(other_m))
        return np.asarray(1 + 1e-6 * mean_n)[:, None]


def echo_paths(
    tx_position_m: Floats,
    rx_position_m: Floats,
    scatterers: Scatterers,
    *,
    path_offset_m: float = 0.0,
    air: TrueAir | None = None,
    tx_velocity_m_s: Floats | float = 0.0,
    rx_velocity_m_s: Floats | float = 0.0,
) -> Paths:
    """Return the echo paths of scatterers: delay (n_tx·R_tx + n_rx·R_rx + offset)/c, amplitude a/(R_tx·R_rx).

    Parameters
    ----------
    tx_position_m, rx_position_m
        (pulse, 3) float64, phase centres in the Cartesian frame of the scatterers, metres.
    path_offset_m
        Electrical path of the receiving channel in addition to the geometric path, metres.
    air
        Atmosphere along the paths; None: vacuum.
    tx_velocity_m_s, rx_velocity_m_s
        (pulse, 3) float64, velocities for Doppler within the pulse; zero: no Doppler.

    Notes
    -----
    Source: docs/theory/simulate.md, eq. 1.

    Examples
    --------
    >>> point = Scatterers(np.array([[0.0, 3.0, 0.0]]), np.array([1.0 + 0j]))
    >>> paths = echo_paths(np.zeros((1, 3)), np.array([[4.0, 0.0, 0.0]]), point)
    >>> paths.delay_s * 299792458, paths.amplitude.real.round(4)
    (array([[8.]]), array([[0.0667]]))
    """
    tx_range, tx_rate = _range_and_rate(tx_position_m, tx_velocity_m_s, scatterers.position_m)
    rx_range, rx_rate = _range_and_rate(rx_position_m, rx_velocity_m_s, scatterers.position_m)
    amplitude = scatterers.amplitude / (tx_range * rx_range)
    if air is not None:
        tx_n, rx_n = (air.index(antenna_m, scatterers.position_m) for antenna_m in (tx_position_m, rx_position_m))
        tx_range, rx_range, tx_rate, rx_rate = tx_range * tx_n, rx_range * rx_n, tx_rate * tx_n, rx_rate * rx_n
    return Paths(
        (tx_range + rx_range + path_offset_m) / SPEED_OF_LIGHT_M_S,
        amplitude,
        (tx_rate + rx_rate) / SPEED_OF_LIGHT_M_S,
    )


def direct_path(
    tx_position_m: Floats,
    rx_position_m: Floats,
    *,
    path_offset_m: float = 0.0,
    air: TrueAir | None = None,
    relative_velocity_m_s: Floats | float = 0.0,
) -> Paths:
    """Return the direct path from antenna to antenna: delay (n·R + offset)/c, amplitude 1/R, constant below 1 m.

    Parameters
    ----------
    tx_position_m, rx_position_m, path_offset_m, air
        As for `echo_paths`.
    relative_velocity_m_s
        (pulse, 3) float64, velocity of the transmitter relative to the receiver.

    Examples
    --------
    >>> direct_path(np.zeros((1, 3)), np.array([[4.0, 0.0, 0.0]])).amplitude
    array([[0.25+0.j]])
    """
    distance, rate = _range_and_rate(tx_position_m - rx_position_m, relative_velocity_m_s, np.zeros((1, 3)))
    index = 1.0 if air is None else air.index_between(tx_position_m, rx_position_m)
    delay, rate = (distance * index + path_offset_m) / SPEED_OF_LIGHT_M_S, rate * index / SPEED_OF_LIGHT_M_S
    return Paths(delay, 1 / np.maximum(distance, 1.0).astype(np.complex128), rate)


def _range_and_rate(antenna_m: Floats, velocity_m_s: Floats | float, points_m: Floats) -> tuple[Floats, Floats]:
    """Return range (m) and range rate (m/s) between antennas (pulse, 3) and points (point, 3), (pulse, point) each."""
    offset_m = antenna_m[:, None, :] - points_m[None, :, :]
    range_m = np.sqrt(np.einsum("pki,pki->pk", offset_m, offset_m))
    velocity = np.broadcast_to(np.asarray(velocity_m_s, np.float64), antenna_m.shape)
    return range_m, np.einsum("pki,pi->pk", offset_m, velocity) / np.maximum(range_m, 1e-9)
