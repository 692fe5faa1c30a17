"""Transmitted waveforms: OFDM symbols and sampled pulses, and the sections that specify them."""

from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator
from pydantic.dataclasses import dataclass
from scipy import fft

from apertura.common.arrays import Floats
from apertura.core.echo.constellation import constellation
from apertura.core.echo.frame_format import FrameFormat
from apertura.simulation.impairments import STRICT_KEYS


@plain_dataclass(frozen=True)
class TransmitWaveform:
    """OFDM waveform, one symbol per pulse: s(t) = Σ c_n exp(j2πnΔf(t − T_cp)) for 0 ≤ t < T_cp + T.

    Attributes
    ----------
    codes
        (subcarrier,) complex128, c_n; or (frame, subcarrier), repeated after the last frame.
    carrier_hz
        RF frequency of subcarrier n = 0, which is baseband zero.
    carrier_is
        n = 0…N−1 (`band_start`) or −N/2…N/2−1 (`band_centre`).
    subcarrier_spacing_hz, symbol_s, cyclic_prefix_s, sample_rate_hz
        Δf, T, T_cp and f_s.

    Examples
    --------
    >>> paper = TransmitWaveform(np.ones(4096), 1.2e9, "band_start", 100e3, 12.5e-6, 3.125e-6, 1.024e9, 100.0)
    >>> paper.dft_samples, paper.prefix_samples, paper.capture_samples
    (10240, 3200, 16000)
    """

    codes: NDArray[np.complex128]
    carrier_hz: float
    carrier_is: Literal["band_start", "band_centre"]
    subcarrier_spacing_hz: float
    symbol_s: float
    cyclic_prefix_s: float
    sample_rate_hz: float
    prf_hz: float

    @property
    def first_subcarrier(self) -> int:
        """Smallest subcarrier number n."""
        return 0 if self.carrier_is == "band_start" else -(self.subcarriers // 2)

    @property
    def subcarriers(self) -> int:
        """Number of subcarriers."""
        return int(self.codes.shape[-1])

    def codes_at(self, frames: NDArray[np.integer] | int) -> NDArray[np.complex128]:
        """Return the code symbols of frames, (frame, subcarrier), or (subcarrier,) of one frame."""
        return np.asarray(np.atleast_2d(self.codes)[np.asarray(frames) % len(np.atleast_2d(self.codes))])

    @property
    def baseband_hz(self) -> Floats:
        """Baseband frequencies nΔf, (subcarrier,) float64, Hz."""
        numbers = self.first_subcarrier + np.arange(self.subcarriers)
        return np.asarray(numbers * self.subcarrier_spacing_hz, np.float64)

    @property
    def frequency_hz(self) -> Floats:
        """RF frequencies, (subcarrier,) float64, Hz."""
        return self.carrier_hz + self.baseband_hz

    @property
    def duration_s(self) -> float:
        """Duration of the pulse T_cp + T, seconds."""
        return self.cyclic_prefix_s + self.symbol_s

    @property
    def dft_samples(self) -> int:
        """Number of samples of one period 1/Δf."""
        return round(self.sample_rate_hz / self.subcarrier_spacing_hz)

    @property
    def prefix_samples(self) -> int:
        """Number of samples of the cyclic prefix."""
        return round(self.cyclic_prefix_s * self.sample_rate_hz)

    @property
    def capture_samples(self) -> int:
        """Number of samples of a triggered capture: prefix and symbol."""
        return round(self.duration_s * self.sample_rate_hz)

    @property
    def mean_power(self) -> float:
        """Mean power E|s|² for codes of unit mean power."""
        return float(self.subcarriers)

    @property
    def noise_at_unit_snr(self) -> float:
        """Noise variance E|n|² of samples at which the noise of a DFT bin equals an echo of amplitude 1."""
        return float(self.dft_samples)

    @property
    def sent(self) -> tuple[str, NDArray[np.complex64]]:
        """Name and content of the file of the transmitted code."""
        return "codes.npy", self.codes.astype(np.complex64)

    def presence(self, arrival: Floats, rate_hz: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the first sample of each path in a capture and the first sample after its end, (path,) each.

        Parameters
        ----------
        arrival
            (path,) float64, arrival of the pulse, in samples of the capture, ascending.
        rate_hz
            Sampling rate of the receiver.
        """
        # 1e-6 samples: tolerance for rounding
        first, end = (np.ceil(arrival + extra - 1e-6).astype(int) for extra in (0.0, self.duration_s * rate_hz))
        return first, end


def qpsk_codes(count: int | tuple[int, ...], generator: Generator) -> NDArray[np.complex128]:
    """Draw random QPSK code symbols of unit modulus: a number of them, or an array of a shape.

    Examples
    --------
    >>> abs(qpsk_codes(3, np.random.default_rng(0))).round(12)
    array([1., 1., 1.])
    """
    return np.asarray(np.exp(1j * np.pi * (generator.integers(0, 4, count) / 2 + 0.25)))


def newman_codes(count: int) -> NDArray[np.complex128]:
    """Return the quadratic-phase code exp(jπn²/N), whose symbol has a nearly constant envelope, like a chirp.

    Notes
    -----
    Source: S. Boyd, "Multitone signals with low crest factor", IEEE Trans. Circuits Syst. 33 (1986).
    """
    return np.asarray(np.exp(1j * np.pi * np.arange(count) ** 2 / count))


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
        Bandwidth of the chirp, or chip rate; the sample rate must be an integer multiple of the chip rate.
    pulse_s
        Longest duration of the pulse, seconds.
    sample_rate_hz
        Complex samples per second.

    Raises
    ------
    ValueError
        If a chip is not a whole number of samples, or fewer than three chips fit.

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
        raise ValueError(f"{chips} chips of {repeat:g} samples; required: at least 3 chips of whole samples")
    code = _maximum_length(int(np.log2(chips + 1))) if name == "pn" else _golay(int(np.log2(chips)))
    return np.repeat(code, round(repeat)).astype(np.complex128)


def _maximum_length(bits: int) -> Floats:
    from scipy.signal import max_len_seq  # slow to import

    return np.asarray(1.0 - 2.0 * max_len_seq(bits)[0])


def _golay(doublings: int) -> Floats:
    first, second = np.ones(1), np.ones(1)
    for _ in range(doublings):
        first, second = np.concatenate([first, second]), np.concatenate([first, -second])
    return first


@plain_dataclass(frozen=True)
class TransmitPulse(TransmitWaveform):
    """Pulse that is sent once, represented by tones of a period so long that captures do not contain a repetition.

    Attributes
    ----------
    pulse
        (sample,) complex128.
    lead_s, listen_s
        Duration of the capture before the pulse, and longest delay whose echo is complete in the capture, seconds.
    band_hz
        Band of demodulation at baseband.

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
        """Return the pulse as tones c_k = S_k/M, with its start `lead_s` after that of the capture."""
        length = round((lead_s + listen_s) * sample_rate_hz) + len(pulse)
        # a period of twice this length, in which the ringing of a fractional delay at the edges of the pulse decays
        period = int(fft.next_fast_len(2 * (length + len(pulse)) // 2)) * 2
        numbers = np.arange(period) - period // 2
        codes = np.roll(fft.fft(pulse, period, norm="forward"), period // 2)
        codes = codes * np.exp(-2j * np.pi * numbers * lead_s * sample_rate_hz / period)
        spacing_hz = sample_rate_hz / period
        tones = codes, carrier_hz, "band_centre", spacing_hz, 1 / spacing_hz, 0.0, sample_rate_hz, prf_hz
        return cls(*tones, pulse, lead_s, listen_s, band_hz)  # type: ignore[arg-type]

    @property
    def capture_samples(self) -> int:
        """Number of samples of a triggered capture: time before the pulse, the pulse, and the longest delay."""
        return round((self.lead_s + self.listen_s) * self.sample_rate_hz) + len(self.pulse)

    @property
    def mean_power(self) -> float:
        """Mean power E|s|² during the pulse."""
        return float(np.mean(np.abs(self.pulse) ** 2))

    @property
    def noise_at_unit_snr(self) -> float:
        """Noise variance E|n|² of samples at which the noise equals an echo of amplitude 1 in an average bin."""
        length = self.capture_samples
        number = fft.fftfreq(length, 1 / self.sample_rate_hz)
        inside = (number >= self.band_hz[0]) & (number <= self.band_hz[1])
        return float(np.mean(np.abs(fft.fft(self.pulse, length)[inside]) ** 2) / length)

    @property
    def sent(self) -> tuple[str, NDArray[np.complex64]]:
        """Name and content of the file of the transmitted pulse."""
        return "pulse.npy", self.pulse.astype(np.complex64)

    def presence(self, arrival: Floats, rate_hz: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the first sample of each path and the first sample after its end, (path,) each.

        Each path occupies the whole capture, or no sample if it arrives outside the capture. The tones
        contain the edges of a pulse, including the ringing of a fractional delay beyond them.
        """
        lead = self.lead_s * rate_hz
        early, late = arrival < -lead - len(self.pulse), arrival >= self.capture_samples - lead
        return np.where(early, -1, np.where(late, _NEVER, 0)), np.where(early, -1, _NEVER)


_HEADER, _COUNTER_BITS = "1acffc1d", 16  # fields of simulated frames


@dataclass(frozen=True, config=STRICT_KEYS)
class WaveformSpecification:
    """Specification of an OFDM waveform, one symbol per pulse; docs/theory/simulate.md, eq. 3."""

    subcarriers: int = Field(gt=1, description="number of subcarriers N")
    carrier_hz: float = Field(gt=0, description="RF frequency of subcarrier n = 0, Hz")
    subcarrier_spacing_hz: float = Field(gt=0, description="subcarrier spacing Δf, Hz")
    symbol_s: float = Field(gt=0, description="duration of the symbol T without prefix, s")
    cyclic_prefix_s: float = Field(ge=0, description="cyclic prefix T_cp, s")
    sample_rate_hz: float = Field(gt=0, description="complex sample rate f_s, Hz")
    prf_hz: float = Field(gt=0, description="pulse repetition frequency, Hz")
    carrier_is: Literal["band_start", "band_centre"] = Field(
        default="band_start", description="n = 0…N-1 (band_start) or -N/2…N/2-1 (band_centre)"
    )
    code: Literal["newman", "qpsk", "16qam", "64qam", "256qam"] = Field(
        default="qpsk", description="random symbols of a constellation, or Newman's code of nearly constant envelope"
    )
    frames: int = Field(default=1, ge=1, description="number of frames of random symbols, after which they repeat")
    framed: bool = Field(
        default=False,
        description="the symbols carry frames: header 1acffc1d, counter of 16 bits, random data and CRC-16; the config "
        "states their format, not the symbols",
    )
    kind: Literal["ofdm"] = Field(default="ofdm", kw_only=True, repr=False)

    @model_validator(mode="after")
    def _dft_fits(self) -> Self:
        length = self.sample_rate_hz / self.subcarrier_spacing_hz
        if abs(length - round(length)) > 1e-6 * length or self.subcarriers > round(length):
            raise ValueError(
                f"sample_rate_hz/subcarrier_spacing_hz = {length:.6f}, the DFT length, must be an integer of at least "
                f"subcarriers={self.subcarriers}"
            )
        if self.symbol_s < (1 - 1e-9) / self.subcarrier_spacing_hz:
            raise ValueError(f"symbol_s={self.symbol_s:g} is shorter than 1/subcarrier_spacing_hz")
        if self.framed and (self.code == "newman" or self._format.data_bits < 0):
            raise ValueError("framed=true requires a constellation as code, and room for 64 bits in a symbol")
        return self

    @property
    def _format(self) -> FrameFormat:
        """Format of the frames, docs/theory/data_symbols.md, "Frames"."""
        header = np.unpackbits(np.frombuffer(bytes.fromhex(_HEADER), np.uint8))
        bits = self.subcarriers * constellation(self.code).bits_per_symbol
        return FrameFormat(header, _COUNTER_BITS, True, bits)

    def drawn(self, generator: Generator) -> TransmitWaveform:
        """Return the waveform with its code symbols, drawn if they are random."""
        shape = (self.frames, self.subcarriers) if self.frames > 1 else (self.subcarriers,)
        if self.framed:
            data = generator.integers(0, 2, (self.frames, self._format.data_bits), np.uint8)
            bits = self._format.bits(np.arange(self.frames) % (1 << _COUNTER_BITS), data)
            codes = constellation(self.code).symbols(bits).astype(np.complex128)
        elif self.code == "newman":
            codes = newman_codes(self.subcarriers)
        elif self.code == "qpsk":
            codes = qpsk_codes(shape, generator)
        else:
            points = constellation(self.code).points.astype(np.complex128)
            codes = points[generator.integers(0, len(points), shape)]
        names = {"subcarriers", "code", "frames", "framed", "kind"}
        parameters = {name: value for name, value in vars(self).items() if name not in names}
        return TransmitWaveform(codes, **parameters)

    def section(self, _: TransmitWaveform) -> dict[str, Any]:
        """Return the section `waveform` of the config."""
        names = {"code", "frames", "framed", "kind"}
        parameters = {name: value for name, value in vars(self).items() if name not in names}
        codes: str | dict[str, Any] = "raw/codes.npy"
        if self.framed:
            frame = {"header": _HEADER, "counter_bits": _COUNTER_BITS, "crc": True}
            codes = {"source": "sidelink", "constellation": self.code, "frame": frame}
        return {"kind": self.kind, "codes": codes, **parameters}


@dataclass(frozen=True, config=STRICT_KEYS)
class PulseSpecification:
    """Specification of a pulse that is sent once per trigger; docs/theory/waveforms.md, "Simulated"."""

    pulse: PulseName = Field(description="chirp, pn (maximum-length sequence) or golay")
    carrier_hz: float = Field(
        gt=0, description="RF frequency of baseband zero, the centre of the band of the pulse, Hz"
    )
    bandwidth_hz: float = Field(gt=0, description="bandwidth of the chirp, or chip rate, Hz")
    pulse_s: float = Field(gt=0, description="longest duration of the pulse, s")
    listen_s: float = Field(gt=0, description="longest delay whose echo is complete in a capture, s")
    sample_rate_hz: float = Field(gt=0, description="complex sample rate f_s, Hz")
    prf_hz: float = Field(gt=0, description="pulse repetition frequency, Hz")
    lead_s: float = Field(default=0.0, ge=0, description="time of a capture before the pulse, s")
    band_hz: tuple[float, float] | None = Field(default=None, description="as in the config; null: ±bandwidth_hz/2")
    filter: Literal["auto", "inverse", "matched"] = Field(default="auto", description="as in the config")
    kind: Literal["samples"] = Field(default="samples", kw_only=True, repr=False)

    @model_validator(mode="after")
    def _can_be_sampled(self) -> Self:
        if self.bandwidth_hz > self.sample_rate_hz:
            raise ValueError(f"bandwidth_hz={self.bandwidth_hz:g} exceeds sample_rate_hz={self.sample_rate_hz:g}")
        self._sampled()
        return self

    def _sampled(self) -> NDArray[np.complex128]:
        sizes = {name: getattr(self, name) for name in ("bandwidth_hz", "pulse_s", "sample_rate_hz")}
        return pulse_samples(self.pulse, **sizes)

    def drawn(self, _: Generator) -> TransmitPulse:
        """Return the pulse, which has no random part."""
        half = self.bandwidth_hz / 2
        names = ("carrier_hz", "sample_rate_hz", "prf_hz", "lead_s", "listen_s")
        parameters = {name: getattr(self, name) for name in names}
        return TransmitPulse.of(self._sampled(), **parameters, band_hz=self.band_hz or (-half, half))

    def section(self, sent: TransmitWaveform) -> dict[str, Any]:
        """Return the section `waveform` of the config for a drawn pulse."""
        if not isinstance(sent, TransmitPulse):
            raise TypeError("the waveform was drawn from another specification")
        names = ("carrier_hz", "sample_rate_hz", "prf_hz", "lead_s", "listen_s", "filter")
        parameters = {name: getattr(self, name) for name in names}
        pulse_s = len(sent.pulse) / self.sample_rate_hz
        return {
            "kind": self.kind,
            "pulse": "raw/pulse.npy",
            "pulse_s": pulse_s,
            "band_hz": list(sent.band_hz),
            **parameters,
        }


def _with_kind(value: Any) -> Any:
    """Add the default kind to the section of a waveform if it has none."""
    return {"kind": "ofdm", **value} if isinstance(value, dict) else value


TransmittedSpecification = Annotated[
    Annotated[WaveformSpecification | PulseSpecification, Field(discriminator="kind")], BeforeValidator(_with_kind)
]
"""Specification of a waveform, selected by `kind`; by default an OFDM symbol."""
