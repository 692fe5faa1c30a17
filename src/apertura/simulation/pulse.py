"""Pulses that are sent once, given by their samples: a chirp, a maximum-length sequence, a Golay code."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from apertura.common.arrays import Floats
from apertura.simulation.radar import TransmitWaveform

Complex = NDArray[np.complex128]
_NEVER = 1 << 40  # samples, beyond any capture
PulseName = Literal["chirp", "pn", "golay"]


def pulse_samples(name: PulseName, *, bandwidth_hz: float, pulse_s: float, sample_rate_hz: float) -> Complex:
    """Return the samples of a pulse of unit modulus, (sample,) complex128.

    Parameters
    ----------
    name
        chirp: a linear sweep over the bandwidth. pn, golay: chips of ±1 at the rate of the bandwidth, a maximum-length
        sequence of 2^k - 1 or one of a complementary pair of 2^k, the longest that fits.
    bandwidth_hz
        Of codes: one of its whole parts is the sample rate's, so that chips are whole samples.
    pulse_s
        How long it lasts, at most.
    sample_rate_hz
        Complex samples per second.

    Raises
    ------
    ValueError
        If chips are no whole samples, or fewer than three fit.

    Notes
    -----
    Source: M. J. E. Golay, "Complementary series", IRE Trans. Inf. Theory 7 (1961).

    Examples
    --------
    >>> pulse_samples("golay", bandwidth_hz=1e6, pulse_s=9e-6, sample_rate_hz=1e6).real
    array([ 1.,  1.,  1., -1.,  1.,  1., -1.,  1.])
    """
    count = round(pulse_s * sample_rate_hz)
    if name == "chirp":
        time_s = (np.arange(count) - (count - 1) / 2) / sample_rate_hz
        return np.asarray(np.exp(1j * np.pi * bandwidth_hz / pulse_s * time_s**2))
    repeat = sample_rate_hz / bandwidth_hz
    chips = count // max(1, round(repeat))
    if abs(repeat - round(repeat)) > 1e-6 or repeat < 0.5 or chips < 3:
        raise ValueError(f"{chips} chips of {repeat:g} samples: at least 3, of whole samples each, are needed")
    code = _maximum_length(int(np.log2(chips + 1))) if name == "pn" else _golay(int(np.log2(chips)))
    return np.repeat(code, round(repeat)).astype(np.complex128)


def _maximum_length(bits: int) -> Floats:
    from scipy.signal import max_len_seq  # slow to import

    return np.asarray(1.0 - 2.0 * max_len_seq(bits)[0])


def _golay(doublings: int) -> Floats:
    one, other = np.ones(1), np.ones(1)
    for _ in range(doublings):
        one, other = np.concatenate([one, other]), np.concatenate([one, -other])
    return one


@dataclass(frozen=True)
class TransmitPulse(TransmitWaveform):
    """A pulse that is sent once, as the tones of a period so long that a capture hears nothing of its repetition.

    Attributes
    ----------
    pulse
        (sample,) complex128.
    lead_s, listen_s
        How long a capture begins before the pulse, and the longest delay whose echo it holds whole.
    band_hz
        Baseband frequencies that it is demodulated at.

    Notes
    -----
    Source: docs/theory/waveforms.md, "Simulated".
    """

    pulse: Complex
    lead_s: float
    listen_s: float
    band_hz: tuple[float, float]

    @classmethod
    def of(
        cls,
        pulse: Complex,
        *,
        carrier_hz: float,
        sample_rate_hz: float,
        prf_hz: float,
        lead_s: float,
        listen_s: float,
        band_hz: tuple[float, float],
    ) -> "TransmitPulse":
        """Return the pulse as tones c_k = S_k/M, which begin `lead_s` after the capture."""
        held = round((lead_s + listen_s) * sample_rate_hz) + len(pulse)
        # twice over: what a fractional delay leaves around the edges of a pulse has faded before it comes again
        period = int(fft.next_fast_len(2 * (held + len(pulse)) // 2)) * 2
        numbers = np.arange(period) - period // 2
        codes = np.roll(fft.fft(pulse, period, norm="forward"), period // 2)
        codes = codes * np.exp(-2j * np.pi * numbers * lead_s * sample_rate_hz / period)
        spacing_hz = sample_rate_hz / period
        tones = codes, carrier_hz, "band_centre", spacing_hz, 1 / spacing_hz, 0.0, sample_rate_hz, prf_hz
        return cls(*tones, pulse, lead_s, listen_s, band_hz)  # type: ignore[arg-type]

    @property
    def capture_samples(self) -> int:
        """Samples of a triggered capture: what goes before the pulse, the pulse, and its longest delay."""
        return round((self.lead_s + self.listen_s) * self.sample_rate_hz) + len(self.pulse)

    @property
    def mean_power(self) -> float:
        """E|s|² while the pulse lasts."""
        return float(np.mean(np.abs(self.pulse) ** 2))

    @property
    def noise_at_unit_snr(self) -> float:
        """E|n|² of samples whose noise equals an echo of amplitude 1 in a bin of the band, on average."""
        length = self.capture_samples
        number = fft.fftfreq(length, 1 / self.sample_rate_hz)
        inside = (number >= self.band_hz[0]) & (number <= self.band_hz[1])
        return float(np.mean(np.abs(fft.fft(self.pulse, length)[inside]) ** 2) / length)

    @property
    def sent(self) -> tuple[str, NDArray[np.complex64]]:
        """Name and content of the file of what was sent."""
        return "pulse.npy", self.pulse.astype(np.complex64)

    def presence(self, arrival: Floats, rate_hz: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the samples of a capture between which paths are present: all, or none where it hears nothing.

        The edges of a pulse are in its tones; what a fractional delay leaves beyond them is heard, too.
        """
        lead = self.lead_s * rate_hz
        early, late = arrival < -lead - len(self.pulse), arrival >= self.capture_samples - lead
        return np.where(early, -1, np.where(late, _NEVER, 0)), np.where(early, -1, _NEVER)
