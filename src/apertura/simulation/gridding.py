"""Gridded sum over thousands of scatterers: echoes spread over range samples, and one FFT per pulse.

H_n = Σ_j a_j·exp(-j2πf_n ρ_j/c) at equally spaced f_n is a Fourier sum at non-uniform delays, evaluated as a
non-uniform FFT. Each echo, with the carrier phase at band centre, is spread over `_TAPS` samples of a range profile
with an oversampling of 2, and the spectrum is divided by that of the spreading function. The relative error is 3e-6.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.windowed_sinc import kaiser_window

_TAPS = 8
_OVERSAMPLING = 2
_BETA = np.pi * np.sqrt((_TAPS * (1 - 0.5 / _OVERSAMPLING)) ** 2 - 0.8)  # Beatty et al. (2005)
_ENTRIES = 2048  # table entries of the spreading function between two samples
_TURNS = 4096  # table entries of phasors in one cycle


def gridded_sum(
    points: tuple[Floats, NDArray[np.complex128]],
    legs: tuple[Floats, Floats],
    frequency_hz: Floats,
    longer_m: Floats,
    *,
    spreading: bool,
) -> NDArray[np.complex128]:
    """Return the transfer functions of scatterers, (pulse, subcarrier) complex128; see `scatterers.transfer`.

    Parameters
    ----------
    points
        Positions (scatterer, 3) float64, metres, and amplitudes (scatterer,) complex128.
    legs
        Positions of transmitter and receiver, (pulse, 3) float64, metres.
    frequency_hz, longer_m, spreading
        As for `transfer`.
    """
    count = len(frequency_hz)
    middle, length = count // 2, _OVERSAMPLING * count
    per_m = np.diff(frequency_hz).mean() * length / SPEED_OF_LIGHT_M_S, frequency_hz[middle] / SPEED_OF_LIGHT_M_S
    tables = _spread_table(), np.exp(-2j * np.pi * np.arange(_TURNS) / _TURNS)
    paths = (*(np.ascontiguousarray(leg) for leg in legs), longer_m)
    positions, amplitude = points
    ranges = np.zeros((len(longer_m), length + _TAPS), np.complex128)
    _add(ranges, (positions, amplitude.astype(np.complex128)), paths, per_m, tables, spreading)
    ranges[:, :_TAPS] += ranges[:, length:]
    samples = np.fft.fft(ranges[:, :length], axis=1)
    return np.asarray(samples[:, (np.arange(count) - middle) % length] / _response(count))


def _spread_table() -> Floats:
    """Return the weights of samples 1-_TAPS/2 … _TAPS/2 for an echo at position entry/_ENTRIES, (entry, tap)."""
    distance = np.arange(1 - _TAPS // 2, _TAPS // 2 + 1) - np.arange(_ENTRIES + 1)[:, None] / _ENTRIES
    return np.asarray(kaiser_window(distance / (_TAPS / 2), _BETA))


def _response(count: int) -> Floats:
    """Return the Fourier transform of the spreading function at each subcarrier, (subcarrier,)."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    cycles = (np.arange(count) - count // 2) / (_OVERSAMPLING * count) * _TAPS / 2
    return np.asarray(np.cos(2 * np.pi * np.outer(cycles, nodes)) @ (weights * _TAPS / 2 * kaiser_window(nodes, _BETA)))


@numba.njit(cache=True, fastmath=True)
def _add(ranges, points, paths, per_m, tables, spreading):  # type: ignore[no-untyped-def]
    """Add the echoes of all scatterers to the range profiles (pulse, sample), whose last taps wrap to the first."""
    positions, amplitude = points
    tx, rx, longer = paths
    samples_per_m, cycles_per_m = per_m
    spread, phasors = tables
    taps, entries, fine = spread.shape[1], spread.shape[0] - 1, len(phasors)
    length = ranges.shape[1] - taps
    for pulse in range(len(tx)):
        for scatterer in range(len(positions)):
            tx_range, rx_range = 0.0, 0.0
            for axis in range(3):
                tx_range += (positions[scatterer, axis] - tx[pulse, axis]) ** 2
                rx_range += (positions[scatterer, axis] - rx[pulse, axis]) ** 2
            tx_range, rx_range = np.sqrt(tx_range), np.sqrt(rx_range)
            path = tx_range + rx_range + longer[pulse]
            phase = path * cycles_per_m
            phase = (phase - np.floor(phase)) * fine
            nearest = int(phase)
            small = -2 * np.pi * (phase - nearest) / fine
            # phasor of the remaining phase, below 1.6 mrad, to the third order
            echo = phasors[nearest] * complex(1 - small * small / 2, small - small**3 / 6)
            echo *= amplitude[scatterer] / (tx_range * rx_range) if spreading else amplitude[scatterer]
            position = path * samples_per_m
            sample = int(np.floor(position))
            between = (position - sample) * entries
            entry = int(between)
            above = between - entry
            first = (sample + 1 - taps // 2) % length
            for tap in range(taps):
                weight = spread[entry, tap] + above * (spread[entry + 1, tap] - spread[entry, tap])
                ranges[pulse, first + tap] += weight * echo
