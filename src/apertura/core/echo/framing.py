"""What is sent before each symbol: a preamble that triggers, and a payload that counts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apertura.core.echo.captures import Samples

ABSENT = -1
"""Frame number of a pulse whose payload was not read."""


@dataclass(frozen=True)
class Framing:
    """preamble | counter bits, most significant first, then inverted | guard | cyclic prefix, symbol.

    Attributes
    ----------
    preamble
        (chip,) int of ±1.
    chip_samples
        Samples per chip.
    centre_hz
        Baseband frequency on which the chips are keyed.
    sample_rate_hz
        Complex samples per second.
    counter_bits
        Width of the frame counter; 0 without payload.
    bit_chips
        Chips per payload bit, all of one sign: +1 for a one.
    guard_samples
        Silence between payload and cyclic prefix.
    """

    preamble: NDArray[np.int64]
    chip_samples: int
    centre_hz: float
    sample_rate_hz: float
    counter_bits: int = 16
    bit_chips: int = 15
    guard_samples: int = 0

    @property
    def payload_samples(self) -> int:
        """Samples of the counter and its inverse."""
        return 2 * self.counter_bits * self.bit_chips * self.chip_samples

    @property
    def lead_samples(self) -> int:
        """Samples from the start of the preamble to the start of the cyclic prefix."""
        return len(self.preamble) * self.chip_samples + self.payload_samples + self.guard_samples

    def template(self) -> NDArray[np.complex64]:
        """Return (sample,) complex64, the preamble as it arrives without delay."""
        return np.asarray(np.repeat(self.preamble, self.chip_samples) * self._carrier(0, len(self.preamble)))

    def read_counter(self, samples: Samples) -> int:
        """Return the frame number of a capture that starts with its preamble, -1 where a bit is not certain.

        Parameters
        ----------
        samples
            (sample, 2), at least preamble and payload.

        Examples
        --------
        >>> framing = Framing(np.array([1, 1, -1, 1, -1]), 2, 0.0, 1e6, counter_bits=2, bit_chips=3)
        >>> chips = np.concatenate([framing.preamble, np.repeat([1, -1, -1, 1], 3)])
        >>> capture = np.stack([np.repeat(chips, 2) * 100, np.zeros(34, int)], -1).astype(np.int16)
        >>> framing.read_counter(capture), framing.read_counter(capture[:-8])
        (2, -1)
        """
        keyed = len(self.preamble) * self.chip_samples
        if self.counter_bits == 0 or len(samples) < keyed + self.payload_samples:
            return ABSENT
        iq = samples[: keyed + self.payload_samples, 0] + 1j * samples[: keyed + self.payload_samples, 1]
        phase = np.vdot(self.template(), iq[:keyed])
        if phase == 0:
            return ABSENT
        carrier = self._carrier(len(self.preamble), 2 * self.counter_bits * self.bit_chips)
        sums = (iq[keyed:] * carrier.conj()).reshape(2 * self.counter_bits, -1).sum(1)
        soft, inverse = np.split(np.real(sums * phase.conj()) / np.abs(phase) ** 2 * keyed, 2)
        expected = self.bit_chips * self.chip_samples  # if noise is left out
        bits = soft > inverse
        if (np.sign(soft) == np.sign(inverse)).any() or (np.abs(soft - inverse) < expected).any():
            return ABSENT
        return int("".join("1" if bit else "0" for bit in bits), 2)

    def _carrier(self, first_chip: int, chips: int) -> NDArray[np.complex64]:
        sample = np.arange(first_chip * self.chip_samples, (first_chip + chips) * self.chip_samples)
        return np.asarray(np.exp(2j * np.pi * self.centre_hz / self.sample_rate_hz * sample), np.complex64)
