"""Captures of a clock that runs off, as a clock that runs true would have taken them."""

import numpy as np
from numpy.typing import NDArray

from apertura.core.echo.demodulate import Numerology
from apertura.core.interpolation import kaiser_beta, kaiser_sinc

Complexes = NDArray[np.complex64]
Floats = NDArray[np.float64]

_REJECTION_DB = 100.0


def correct_clock(samples: Complexes, numerology: Numerology, *, cfo_hz: Floats, sfo_ppm: float) -> Complexes:
    """Return captures as a receiver with the transmitter's clock would have sampled them.

    Parameters
    ----------
    samples
        (pulse, sample) complex64 from the start of the cyclic prefix; radar and sidelink each in their turn.
    numerology
        Of the symbol.
    cfo_hz
        (pulse,) float64, receiver's oscillator minus transmitter's.
    sfo_ppm
        Receiver's sampling rate above nominal, parts per million.

    Returns
    -------
    ndarray
        (pulse, prefix_samples + dft_samples) complex64.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Clock": rotation, then a Kaiser-windowed sinc at the fractional places,
    with the occupied band moved to zero, where the sinc is shortest.

    Examples
    --------
    >>> numerology = Numerology(1e9, 64e6, np.arange(32), prefix_samples=16, dft_samples=64)
    >>> turning = np.exp(-2j * np.pi * 5e3 * np.arange(100) / 64e6)[None].astype(np.complex64)
    >>> bool(np.allclose(correct_clock(turning, numerology, cfo_hz=np.array([5e3]), sfo_ppm=0.0), 1, atol=1e-5))
    True
    """
    count = numerology.prefix_samples + numerology.dft_samples
    rate_hz = numerology.sample_rate_hz * (1 + sfo_ppm * 1e-6)
    taken_s, wanted_s = np.arange(samples.shape[1]) / rate_hz, np.arange(count) / numerology.sample_rate_hz
    place, taps = _fractional_taps(wanted_s * rate_hz, numerology)
    # beyond the capture the symbol goes on as one period before
    place = np.where(place >= samples.shape[1], place - numerology.dft_samples, place)
    place = np.where(place < 0, place + numerology.dft_samples, place)
    back = np.exp(2j * np.pi * numerology.middle_hz * wanted_s)
    corrected = np.empty((len(samples), count), np.complex64)
    for pulse, capture in enumerate(samples):
        centred = capture * np.exp(2j * np.pi * (cfo_hz[pulse] - numerology.middle_hz) * taken_s)
        corrected[pulse] = np.einsum("kt,kt->k", centred[place], taps) * back
    return corrected


def _fractional_taps(position: Floats, numerology: Numerology) -> tuple[NDArray[np.int64], Floats]:
    """Return (wanted, tap) sample numbers and weights that interpolate at fractional `position`."""
    occupied = numerology.numbers.size / numerology.dft_samples
    length = (_REJECTION_DB - 8) / (2.285 * 2 * np.pi * max(1 - occupied, 0.05))  # Kaiser's rule
    half = int(np.ceil(length / 2)) + 1
    place = np.floor(position).astype(np.int64)[:, None] + np.arange(1 - half, half + 1)
    return place, kaiser_sinc(position[:, None] - place, half=half, beta=kaiser_beta(_REJECTION_DB))
