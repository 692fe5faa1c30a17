"""Real samples at an intermediate frequency become complex baseband: analytic signal, then mixing, at the same rate."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

SETTLING = 63
"""Samples on either side that the filter reaches: where it runs over the end of a capture, they are wrong."""

EDGE = 0.025
"""Of the sample rate: bands keep that far from both ends of their Nyquist zone; the mirror image is then -80 dB."""

_KAISER = 8.0


@dataclass(frozen=True)
class Mixing:
    """How real samples x are mixed: s = (x + j·H{x})·exp(-j2π·if_hz·n/f_s), with H the Hilbert transform.

    Attributes
    ----------
    if_hz
        Where baseband zero lies in the samples, before any aliasing; negative where the mixer mirrors the spectrum.
    sample_rate_hz
        Real samples per second, and complex ones afterwards.
    restarts
        The phase is zero (n = 0) at the first sample of every capture; else at that of the file.

    Notes
    -----
    Source: docs/theory/recordings.md, eq. 1 and 2.
    """

    if_hz: float
    sample_rate_hz: float
    restarts: bool

    @property
    def alias_hz(self) -> float:
        """Where baseband zero lies after aliasing, -f_s/2 to f_s/2."""
        half = self.sample_rate_hz / 2
        return (self.if_hz + half) % self.sample_rate_hz - half

    def baseband(self, real: NDArray[np.int16 | np.float32], first: int = 0) -> NDArray[np.float32]:
        """Return stretches of samples as I and Q; right but for `SETTLING` samples at either end.

        Parameters
        ----------
        real
            (stretch, sample, channel).
        first
            Number n of the first sample.

        Returns
        -------
        ndarray
            (stretch, sample, channel, 2) float32.

        Examples
        --------
        >>> tone = np.cos(2 * np.pi * 0.3 * np.arange(400))[None, :, None]
        >>> Mixing(0.25, 1.0, restarts=True).baseband(tone)[0, 205, 0].round(4)  # exp(j2π·0.05·205)
        array([0., 1.], dtype=float32)
        """
        from scipy.signal import oaconvolve

        if not real.shape[0] * real.shape[1]:
            return np.zeros((*real.shape, 2), np.float32)
        x = real.astype(np.float64)
        side = 1.0 if self.alias_hz >= 0 else -1.0
        quadrature = oaconvolve(x, _hilbert()[None, :, None], mode="full", axes=1)[:, SETTLING : SETTLING + x.shape[1]]
        turns = self.if_hz / self.sample_rate_hz * (first + np.arange(x.shape[1]))
        mixed = (x + 1j * side * quadrature) * np.exp(-2j * np.pi * (turns % 1.0))[None, :, None]
        return np.asarray(mixed.astype(np.complex64)[..., None].view(np.float32))

    def problem(self, lowest_hz: float, highest_hz: float, prefix_samples: int) -> str | None:
        """Return why a band about baseband zero cannot be had of these samples, or None.

        Parameters
        ----------
        lowest_hz, highest_hz
            Edges of the band, relative to baseband zero.
        prefix_samples
            At the start of each capture that nothing is measured in.

        Examples
        --------
        >>> Mixing(20e6, 64e6, restarts=True).problem(0.0, 16e6, 100)
        'the band lies at 20 to 36 MHz in samples at 64 MHz, within 1.6 MHz of an end of a Nyquist zone'
        """
        rate = self.sample_rate_hz
        low, high = self.if_hz + lowest_hz, self.if_hz + highest_hz
        zone = np.floor(2 * self.if_hz / rate)
        inside = low >= (zone / 2 + EDGE) * rate and high <= (zone / 2 + 0.5 - EDGE) * rate
        if not inside:
            return (
                f"the band lies at {low / 1e6:g} to {high / 1e6:g} MHz in samples at {rate / 1e6:g} MHz, "
                f"within {EDGE * rate / 1e6:g} MHz of an end of a Nyquist zone"
            )
        if self.restarts and prefix_samples < SETTLING:
            return f"a prefix of {prefix_samples} samples, in which the filter needs {SETTLING} to settle"
        return None


@cache
def _hilbert() -> NDArray[np.float64]:
    """Return the taps of H, (2·SETTLING+1,): 2/(πk) for odd k under a Kaiser window."""
    k = np.arange(-SETTLING, SETTLING + 1)
    taps = np.zeros(k.size)
    odd = k % 2 == 1
    taps[odd] = 2 / (np.pi * k[odd])
    return np.asarray(taps * np.kaiser(k.size, _KAISER))
