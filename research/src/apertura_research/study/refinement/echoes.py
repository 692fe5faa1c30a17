"""Echoes of many scatterers: each spread over a few samples of range, one transform per pulse to the subcarriers.

H_n = Σ_j a_j/(d_t d_r)·exp(-j2πf_n ρ_j/c) at equally spaced f_n is a Fourier sum at uneven delays: with the carrier of
band centre left on each echo, its delay is spread over `_TAPS` of the samples of a range twice as long as the
subcarriers ask for, and the spectrum is divided by that of the spread.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.geometry.aperture import Aperture
from apertura.core.interpolation import kaiser_window
from apertura_research.study.refinement.scenes import Scatterers

_TAPS = 8
_ROOM = 2
_BETA = np.pi * np.sqrt((_TAPS * (1 - 0.5 / _ROOM)) ** 2 - 0.8)  # Beatty's choice
_ENTRIES = 2048  # of the spread, between two samples
_TURNS = 4096  # of a table of phasors
_PULSES_AT_ONCE = 500


def transfer(
    scatterers: Scatterers,
    flown: Aperture,
    frequency_hz: NDArray[np.float64],
    *,
    further_m: NDArray[np.float64] | None = None,
) -> NDArray[np.complex64]:
    """Return the transfer functions (pulse, subcarrier) of scatterers, whose echoes fall off with both distances.

    Parameters
    ----------
    scatterers
        What echoes.
    flown
        The true phase centres.
    frequency_hz
        (subcarrier,) float64, equally spaced.
    further_m
        (pulse,) float64, metres by which all paths of a pulse are longer than geometry.

    Returns
    -------
    ndarray
        (pulse, subcarrier) complex64.
    """
    count = len(frequency_hz)
    middle, length = count // 2, _ROOM * count
    longer = np.zeros(len(flown)) if further_m is None else further_m
    per_m = np.diff(frequency_hz).mean() * length / SPEED_OF_LIGHT_M_S, frequency_hz[middle] / SPEED_OF_LIGHT_M_S
    tables = _spread_table(), np.exp(-2j * np.pi * np.arange(_TURNS) / _TURNS)
    response = _response(count)
    out = np.empty((len(flown), count), np.complex64)
    for first in range(0, len(flown), _PULSES_AT_ONCE):
        part = slice(first, first + _PULSES_AT_ONCE)
        legs = tuple(np.ascontiguousarray(leg[part]) for leg in flown.legs)
        ranges = np.zeros((len(legs[0]), length + _TAPS), np.complex128)
        _add(ranges, (scatterers.places_m, scatterers.amplitude), legs, longer[part], per_m, tables)
        ranges[:, :_TAPS] += ranges[:, length:]
        spectrum = np.fft.fft(ranges[:, :length], axis=1)
        out[part] = spectrum[:, (np.arange(count) - middle) % length] / response
    return out


def _spread_table() -> NDArray[np.float64]:
    """Return (entry, tap): weights of the samples 1-_TAPS/2 … _TAPS/2 from an echo that lies entry/_ENTRIES after 0."""
    at = np.arange(1 - _TAPS // 2, _TAPS // 2 + 1) - np.arange(_ENTRIES + 1)[:, None] / _ENTRIES
    return np.asarray(kaiser_window(at / (_TAPS / 2), _BETA))


def _response(count: int) -> NDArray[np.float64]:
    """Return (subcarrier,): the Fourier transform of the spread at each subcarrier's distance from band centre."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    turns = (np.arange(count) - count // 2) / (_ROOM * count) * _TAPS / 2
    return np.asarray(np.cos(2 * np.pi * np.outer(turns, nodes)) @ (weights * _TAPS / 2 * kaiser_window(nodes, _BETA)))


@numba.njit(cache=True, fastmath=True)
def _add(ranges, scatterers, legs, further, per_m, tables):  # type: ignore[no-untyped-def]
    """Add the echoes of all scatterers to the ranges (pulse, sample), of which the last taps are the first again."""
    places, amplitude = scatterers
    tx, rx = legs
    samples_per_m, turns_per_m = per_m
    spread, phasors = tables
    taps, entries, fine = spread.shape[1], spread.shape[0] - 1, len(phasors)
    length = ranges.shape[1] - taps
    for pulse in range(len(tx)):
        for one in range(len(places)):
            there, back = 0.0, 0.0
            for axis in range(3):
                there += (places[one, axis] - tx[pulse, axis]) ** 2
                back += (places[one, axis] - rx[pulse, axis]) ** 2
            there, back = np.sqrt(there), np.sqrt(back)
            path = there + back + further[pulse]
            turns = path * turns_per_m
            turns = (turns - np.floor(turns)) * fine
            nearest = int(turns)
            small = -2 * np.pi * (turns - nearest) / fine
            # the phasor of the remainder, less than 1.6 mrad, to the third order
            echo = phasors[nearest] * complex(1 - small * small / 2, small - small**3 / 6)
            echo *= amplitude[one] / (there * back)
            place = path * samples_per_m
            sample = int(place)
            between = (place - sample) * entries
            entry = int(between)
            above = between - entry
            first = (sample + 1 - taps // 2) % length
            for tap in range(taps):
                weight = spread[entry, tap] + above * (spread[entry + 1, tap] - spread[entry, tap])
                ranges[pulse, first + tap] += weight * echo
