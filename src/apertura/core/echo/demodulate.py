"""Demodulation of captured symbols by a DFT over one period 1/Δf, and removal of path delays.

Subcarrier n of the symbol s(t) = Σ c_n exp(j2πnΔf(t-T_cp)) is received over a path of delay τ as
c_n·exp(-j2π(f_c+nΔf)τ), provided that τ is shorter than the cyclic prefix (docs/theory.md, eqs. 1 and 2).
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.core.echo.compression import phasors, unit_phasor

_PULSES_AT_ONCE = 64


@dataclass(frozen=True)
class Numerology:
    """Sampling of the transmitted signal: a periodic OFDM symbol, or a pulse without repetition.

    Attributes
    ----------
    carrier_hz, sample_rate_hz
        Nominal RF frequency at baseband zero; and number of complex samples per second.
    numbers
        (subcarrier,) int64, number n of each subcarrier, in multiples of Δf from the carrier, ascending.
    prefix_samples
        T_cp·f_s, start of the DFT window.
    dft_samples
        f_s/Δf, length of the DFT window.
    longest_samples
        Largest delay, samples, at which captures contain the complete echo of a pulse without repetition. None: symbol
        with the period 1/Δf, for which echoes are complete at delays up to the length of the prefix.
    """

    carrier_hz: float
    sample_rate_hz: float
    numbers: NDArray[np.int64]
    prefix_samples: int
    dft_samples: int
    longest_samples: int | None = None

    @property
    def spacing_hz(self) -> float:
        """Subcarrier spacing Δf, Hz."""
        return self.sample_rate_hz / self.dft_samples

    @property
    def middle_hz(self) -> float:
        """Baseband frequency at the centre of the occupied band, Hz."""
        return float(self.numbers[0] + self.numbers[-1]) / 2 * self.spacing_hz

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """(subcarrier,) float64, RF frequency of each subcarrier."""
        return np.asarray(self.carrier_hz + self.numbers * self.spacing_hz, np.float64)

    @property
    def repeats(self) -> bool:
        """True if the transmitted signal has the period 1/Δf."""
        return self.longest_samples is None

    @property
    def delay_cells(self) -> int:
        """Number of delay cells of 1/B with complete echoes; for a symbol, the cells within the cyclic prefix."""
        samples = self.prefix_samples if self.longest_samples is None else self.longest_samples
        return round(samples * self.numbers.size / self.dft_samples)


def subcarrier_numbers(count: int, *, carrier_is: str) -> NDArray[np.int64]:
    """Return the number n of each subcarrier, ascending: 0…N-1 for band_start, or -N/2…N/2-1 for band_centre.

    Examples
    --------
    >>> subcarrier_numbers(4, carrier_is="band_centre")
    array([-2, -1,  0,  1])
    """
    return np.arange(count) - (count // 2 if carrier_is == "band_centre" else 0)


def demodulate(captures: NDArray[np.complex64], numerology: Numerology) -> NDArray[np.complex64]:
    """Return the received code symbols c_n·H_n, (pulse, subcarrier) complex64 in ADC counts per subcarrier.

    Parameters
    ----------
    captures
        (pulse, sample) complex64, ADC counts; sample 0 is the start of the cyclic prefix.
    numerology
        Numerology of the symbol.

    Raises
    ------
    ValueError
        If a capture is shorter than the cyclic prefix and the DFT window together.

    Notes
    -----
    Source: docs/theory.md, eq. 2. The length of the DFT is f_s/Δf, not N.

    Examples
    --------
    >>> tone = 1000 * np.exp(2j * np.pi * 3 * np.arange(16) / 16).astype(np.complex64)
    >>> symbols = demodulate(tone[None], Numerology(1e9, 16e6, np.arange(8), prefix_samples=0, dft_samples=16))
    >>> abs(symbols[0]).round().astype(int).tolist()
    [0, 0, 0, 1000, 0, 0, 0, 0]
    """
    pulses, samples = captures.shape
    start, stop = numerology.prefix_samples, numerology.prefix_samples + numerology.dft_samples
    if samples < stop:
        raise ValueError(f"{samples=}: a capture must have at least {stop} samples (prefix and DFT window)")
    symbols = np.empty((pulses, numerology.numbers.size), np.complex64)
    count, lowest = numerology.numbers.size, int(numerology.numbers[0]) % numerology.dft_samples
    # number of bins with negative frequencies; the other frequencies start at bin 0
    below = min(count, numerology.dft_samples - lowest)
    for first in range(0, pulses, _PULSES_AT_ONCE):
        spectrum = scipy.fft.fft(captures[first : first + _PULSES_AT_ONCE, start:stop], axis=1, norm="forward")
        rows = slice(first, first + len(spectrum))
        symbols[rows, :below] = spectrum[:, lowest : lowest + below]
        symbols[rows, below:] = spectrum[:, : count - below]
    return symbols


def remove_path(
    transfer: NDArray[np.complex64], frequency_hz: NDArray[np.float64], *, delay_s: NDArray[np.float64]
) -> NDArray[np.complex64]:
    """Remove the delay of each pulse from transfer functions, (pulse, subcarrier), by the factor exp(+j2πf·delay).

    `frequency_hz`, (subcarrier,), ascends in equal steps.

    Examples
    --------
    >>> remove_path(np.ones((1, 2), np.complex64), np.array([1e9, 2e9]), delay_s=np.array([0.25e-9])).round(6) + 0
    array([[ 0.+1.j, -1.+0.j]], dtype=complex64)
    """
    count = len(frequency_hz)
    spacing_hz = (frequency_hz[-1] - frequency_hz[0]) / max(count - 1, 1)
    along = phasors(delay_s * spacing_hz, count)
    return transfer * along * unit_phasor(delay_s * frequency_hz[0])[:, None]
