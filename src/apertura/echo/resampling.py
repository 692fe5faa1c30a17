"""Captures of a clock that runs off, as a clock that runs true would have taken them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Complexes = NDArray[np.complex64]
Floats = NDArray[np.float64]

_REJECTION_DB = 100.0


@dataclass(frozen=True)
class Waveform:
    """What of the waveform a clock correction needs.

    Attributes
    ----------
    carrier_hz, sample_rate_hz
        Nominal RF frequency at baseband zero and complex samples per second.
    numbers
        (subcarrier,) int64, the n of each subcarrier in multiples of Δf from the carrier, ascending.
    prefix_samples, dft_samples
        T_cp·f_s and f_s/Δf.
    """

    carrier_hz: float
    sample_rate_hz: float
    numbers: NDArray[np.int64]
    prefix_samples: int
    dft_samples: int

    @property
    def spacing_hz(self) -> float:
        """Δf."""
        return self.sample_rate_hz / self.dft_samples

    @property
    def middle_hz(self) -> float:
        """Baseband frequency at the middle of the occupied band."""
        return float(self.numbers[0] + self.numbers[-1]) / 2 * self.spacing_hz


def correct_clock(samples: Complexes, waveform: Waveform, *, cfo_hz: Floats, sfo_ppm: float) -> Complexes:
    """Return captures as a receiver with the transmitter's clock would have sampled them.

    Parameters
    ----------
    samples
        (pulse, sample) complex64 from the start of the cyclic prefix; radar and sidelink each in their turn.
    waveform
        As transmitted.
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
    >>> waveform = Waveform(1e9, 64e6, np.arange(32), prefix_samples=16, dft_samples=64)
    >>> turning = np.exp(-2j * np.pi * 5e3 * np.arange(100) / 64e6)[None].astype(np.complex64)
    >>> bool(np.allclose(correct_clock(turning, waveform, cfo_hz=np.array([5e3]), sfo_ppm=0.0), 1, atol=1e-5))
    True
    """
    count = waveform.prefix_samples + waveform.dft_samples
    rate_hz = waveform.sample_rate_hz * (1 + sfo_ppm * 1e-6)
    taken_s, wanted_s = np.arange(samples.shape[1]) / rate_hz, np.arange(count) / waveform.sample_rate_hz
    place, taps = _fractional_taps(wanted_s * rate_hz, waveform)
    # beyond the capture the symbol goes on as one period before
    place = np.where(place >= samples.shape[1], place - waveform.dft_samples, place)
    place = np.where(place < 0, place + waveform.dft_samples, place)
    back = np.exp(2j * np.pi * waveform.middle_hz * wanted_s)
    corrected = np.empty((len(samples), count), np.complex64)
    for pulse, capture in enumerate(samples):
        centred = capture * np.exp(2j * np.pi * (cfo_hz[pulse] - waveform.middle_hz) * taken_s)
        corrected[pulse] = np.einsum("kt,kt->k", centred[place], taps) * back
    return corrected


def _fractional_taps(position: Floats, waveform: Waveform) -> tuple[NDArray[np.int64], Floats]:
    """Return (wanted, tap) sample numbers and weights that interpolate at fractional `position`."""
    occupied = waveform.numbers.size / waveform.dft_samples
    length = (_REJECTION_DB - 8) / (2.285 * 2 * np.pi * max(1 - occupied, 0.05))  # Kaiser's rule
    half = int(np.ceil(length / 2)) + 1
    whole = np.floor(position).astype(np.int64)
    place = whole[:, None] + np.arange(1 - half, half + 1)
    distance = position[:, None] - place
    beta = 0.1102 * (_REJECTION_DB - 8.7)
    taper = np.i0(beta * np.sqrt(np.clip(1 - (distance / half) ** 2, 0, None))) / np.i0(beta)
    return place, np.sinc(distance) * taper
