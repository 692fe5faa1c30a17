"""What goes before the symbol: a PN preamble for the trigger and a payload that counts frames.

preamble chips | counter bits, then the same inverted | guard | cyclic prefix, symbol
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import max_len_seq

from apertura.simulation.radar import Floats, Waveform

Chips = NDArray[np.int8]


@dataclass(frozen=True)
class Framing:
    """Binary phase shift keying at band centre, as strong on average as the symbol.

    Attributes
    ----------
    register_bits
        Length of the shift register: 2^k − 1 chips of preamble.
    chip_samples
        Samples per chip; the sampling rate over it must stay inside the band.
    counter_bits
        Width of the frame counter; it wraps at 2^counter_bits.
    bit_chips
        Chips per payload bit, all of one sign: +1 for a one.
    guard_samples
        Silence before the prefix, longer than the longest echo.
    level_db
        Power against the mean power of the symbol.

    Examples
    --------
    >>> framing = Framing(register_bits=3, chip_samples=2, counter_bits=2, bit_chips=3)
    >>> framing.preamble()
    array([ 1,  1,  1, -1,  1, -1, -1], dtype=int8)
    >>> framing.payload(6)  # counts 2: bits 1 0, inverted 0 1
    array([ 1,  1,  1, -1, -1, -1, -1, -1, -1,  1,  1,  1], dtype=int8)
    """

    register_bits: int = 10
    chip_samples: int = 4
    counter_bits: int = 16
    bit_chips: int = 15
    guard_samples: int = 256
    level_db: float = 0.0

    def preamble(self) -> Chips:
        """Return (chip,) int8 of ±1: a maximum-length sequence."""
        return np.asarray(2 * max_len_seq(self.register_bits)[0].astype(np.int8) - 1)

    def counted(self, frame: int) -> int:
        """Return the number that the payload of frame `frame` says."""
        return int(frame % 2**self.counter_bits)

    def payload(self, frame: int) -> Chips:
        """Return (chip,) int8 of ±1: the counter, most significant bit first, then its complement."""
        number = self.counted(frame)
        bits = np.array([(number >> place) & 1 for place in reversed(range(self.counter_bits))], np.int8)
        return np.repeat(2 * np.concatenate([bits, 1 - bits]) - 1, self.bit_chips)

    @property
    def lead_samples(self) -> int:
        """Samples from the start of the preamble to the start of the cyclic prefix."""
        chips = 2**self.register_bits - 1 + 2 * self.counter_bits * self.bit_chips
        return int(chips * self.chip_samples + self.guard_samples)

    def centre_hz(self, waveform: Waveform) -> float:
        """Return the baseband frequency of the chips' carrier: the middle subcarrier."""
        return float(waveform.baseband_hz[len(waveform.codes) // 2])

    def signal(self, waveform: Waveform, frame: int, time_s: Floats) -> NDArray[np.complex128]:
        """Return the preamble and payload as sent, at baseband.

        Parameters
        ----------
        waveform
            Gives sampling rate, band centre and power.
        frame
            Number before it wraps.
        time_s
            (...,) float64, seconds after the start of the cyclic prefix (negative).
        """
        chips = np.concatenate([self.preamble(), self.payload(frame)])
        rate = waveform.sample_rate_hz
        # a millionth of a sample is rounding, not an earlier chip
        index = np.floor((time_s * rate + self.lead_samples + 1e-6) / self.chip_samples).astype(int)
        inside = (index >= 0) & (index < len(chips))
        level = np.sqrt((np.abs(waveform.codes) ** 2).sum()) * 10 ** (self.level_db / 20)
        keyed = np.where(inside, chips[np.clip(index, 0, len(chips) - 1)], 0)
        return np.asarray(level * keyed * np.exp(2j * np.pi * self.centre_hz(waveform) * time_s))
