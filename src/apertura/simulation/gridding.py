"""The gridded sum over thousands of scatterers: each echo over a few samples of range, one transform per pulse.

H_n = Σ_j a_j·exp(-j2πf_n ρ_j/c) at equally spaced f_n is a Fourier sum at uneven delays: with the carrier of band
centre left on each echo, its delay is spread over `_TAPS` of the samples of a range twice as long as the subcarriers
ask for, and the spectrum is divided by that of the spread. Right to 3e-6.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.windowed_sinc import kaiser_window

_TAPS = 8
_OVERSAMPLING = 2
_BETA = np.pi * np.sqrt((_TAPS * (1 - 0.5 / _OVERSAMPLING)) ** 2 - 0.8)  # Beatty's choice
_ENTRIES = 2048  # of the spread, between two samples
_TURNS = 4096  # of a table of phasors


def gridded_sum(
    points: tuple[Floats, NDArray[np.complex128]],
    legs: tuple[Floats, Floats],
    frequency_hz: Floats,
    longer_m: Floats,
    *,
    spreading: bool,
) -> NDArray[np.complex128]:
    """Return (pulse, subcarrier) complex128, as `apertura.simulation.scatterers.transfer` defines it.

    Parameters
    ----------
    points
        Positions (scatterer, 3) float64, metres, and amplitudes (scatterer,) complex128.
    legs
        Transmitter and receiver, (pulse, 3) float64, metres.
    frequency_hz, longer_m, spreading
        As of `transfer`.
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
    """Return (entry, tap): weights of the samples 1-_TAPS/2 … _TAPS/2 from an echo that lies entry/_ENTRIES after 0."""
    at = np.arange(1 - _TAPS // 2, _TAPS // 2 + 1) - np.arange(_ENTRIES + 1)[:, None] / _ENTRIES
    return np.asarray(kaiser_window(at / (_TAPS / 2), _BETA))


def _response(count: int) -> Floats:
    """Return (subcarrier,): the Fourier transform of the spread at each subcarrier's distance from band centre."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    turns = (np.arange(count) - count // 2) / (_OVERSAMPLING * count) * _TAPS / 2
    return np.asarray(np.cos(2 * np.pi * np.outer(turns, nodes)) @ (weights * _TAPS / 2 * kaiser_window(nodes, _BETA)))


@numba.njit(cache=True, fastmath=True)
def _add(ranges, points, paths, per_m, tables, spreading):  # type: ignore[no-untyped-def]
    """Add the echoes of all scatterers to the ranges (pulse, sample), of which the last taps are the first again."""
    positions, amplitude = points
    tx, rx, longer = paths
    samples_per_m, turns_per_m = per_m
    spread, phasors = tables
    taps, entries, fine = spread.shape[1], spread.shape[0] - 1, len(phasors)
    length = ranges.shape[1] - taps
    for pulse in range(len(tx)):
        for one in range(len(positions)):
            there, back = 0.0, 0.0
            for axis in range(3):
                there += (positions[one, axis] - tx[pulse, axis]) ** 2
                back += (positions[one, axis] - rx[pulse, axis]) ** 2
            there, back = np.sqrt(there), np.sqrt(back)
            path = there + back + longer[pulse]
            turns = path * turns_per_m
            turns = (turns - np.floor(turns)) * fine
            nearest = int(turns)
            small = -2 * np.pi * (turns - nearest) / fine
            # the phasor of the remainder, less than 1.6 mrad, to the third order
            echo = phasors[nearest] * complex(1 - small * small / 2, small - small**3 / 6)
            echo *= amplitude[one] / (there * back) if spreading else amplitude[one]
            place = path * samples_per_m
            sample = int(np.floor(place))
            between = (place - sample) * entries
            entry = int(between)
            above = between - entry
            first = (sample + 1 - taps // 2) % length
            for tap in range(taps):
                weight = spread[entry, tap] + above * (spread[entry + 1, tap] - spread[entry, tap])
                ranges[pulse, first + tap] += weight * echo
