"""Section `waveform`: the transmitted signal, and the kind of recording (samples or transfer functions)."""

from abc import abstractmethod
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from apertura.campaign.config.section import WAVEFORM_KINDS, Section
from apertura.formats.names import PHASE_HISTORIES

# ---- Waveforms recorded as samples: OFDM symbols, sampled pulses ----------------------------------------------------


class SampledWaveform(Section):
    """Waveform with one pulse per trigger, recorded as samples: interface from captures to transfer functions.

    `file_key` is the key that names the file of the transmitted signal. `delay_key` and `limit_name` are the key and
    the name of the interval in which echoes must arrive.
    """

    file_key: ClassVar[str]
    delay_key: ClassVar[str]
    limit_name: ClassVar[str]

    kind: str = Field(description=WAVEFORM_KINDS)
    carrier_hz: float = Field(
        gt=0, description="RF carrier, the RF frequency that corresponds to zero at baseband, Hz", examples=[1.2e9]
    )
    sample_rate_hz: float = Field(gt=0, description="complex sample rate f_s, Hz", examples=[1.024e9])
    prf_hz: float = Field(gt=0, description="pulse repetition frequency, Hz", examples=[100.0])
    iq: Literal["complex", "swapped", "conjugate"] = Field(
        "complex",
        description="complex: I+jQ; swapped: the recorder wrote Q before I; conjugate: the local oscillator lies above "
        "the band",
    )

    @property
    @abstractmethod
    def longest_delay_s(self) -> float:
        """Longest delay for which an echo is recorded completely, seconds."""

    @property
    @abstractmethod
    def middle_s(self) -> float:
        """Mid-time of the measured part of the pulse, seconds after the start of the pulse."""

    @property
    @abstractmethod
    def capture_s(self) -> float:
        """Used duration of a capture, seconds; later samples are not used."""

    @property
    @abstractmethod
    def needed_samples(self) -> int:
        """Minimum number of samples in a capture."""

    @property
    @abstractmethod
    def most_subcarriers(self) -> int:
        """Maximum number of frequencies at which an echo is measured."""

    @property
    @abstractmethod
    def widest_band_hz(self) -> float:
        """Maximum bandwidth, Hz."""

    @property
    def capture_samples(self) -> int:
        """Number of samples in the used duration of a capture."""
        return round(self.capture_s * self.sample_rate_hz)


class GeneratedCodes(Section):
    """Code symbols that carry the bits of a pseudo-noise sequence, frame after frame."""

    generator: Literal["pn"] = Field(description="pn: sequence of a linear feedback shift register")
    polynomial: tuple[Annotated[int, Field(ge=1, le=24)], ...] = Field(
        min_length=2,
        description="exponents of the primitive polynomial other than 0, e.g. [23, 18] for x^23 + x^18 + 1",
        examples=[[23, 18]],
    )
    seed: int = Field(1, ge=1, description="first bits of the sequence as a number, most significant bit first")
    constellation: Literal["qpsk", "16qam", "64qam", "256qam"] = Field(
        "qpsk", description="constellation of the symbols; the Gray code of I precedes that of Q"
    )
    frames: int | None = Field(
        None, ge=1, description="number of frames after which the sequence starts again; null: it continues"
    )


class FrameFields(Section):
    """Fields of the bits of a pulse: header, counter, data, check sum, in ascending order of the data subcarriers."""

    header: str = Field(
        "1acffc1d", description="known bits at the start of a frame, hexadecimal", pattern="^([0-9a-fA-F]{2})+$"
    )
    counter_bits: int = Field(16, ge=1, le=48, description="length of the frame counter after the header, bits")
    crc: bool = Field(True, description="the last 16 bits are the CRC-16 (x^16 + x^12 + x^5 + 1) of counter and data")


class SidelinkCodes(Section):
    """Code symbols that no file lists, decided from the sidelink of a receiver."""

    source: Literal["sidelink"] = Field(description="sidelink: symbols are decided from the received direct path")
    constellation: Literal["qpsk", "16qam", "64qam", "256qam"] = Field(
        description="constellation of the symbols; the Gray code of I precedes that of Q", examples=["qpsk"]
    )
    pilots: str | None = Field(
        None,
        description="known symbols, complex64 (subcarriers,), 0 at data symbols; null: the channel is estimated from "
        "the data",
    )
    frame: FrameFields | None = Field(
        None, description="format of the bits; null: bits are not read, and monostatic images need pilots"
    )
    node: str | None = Field(
        None,
        description="node whose sidelink gives the symbols of monostatic images; null: the first receiver, or the "
        "transmitter of a flight without receivers",
    )


class OfdmWaveform(SampledWaveform):
    """Waveform with one OFDM symbol per pulse."""

    file_key, delay_key, limit_name = "codes", "cyclic_prefix_s", "the cyclic prefix"

    kind: Literal["ofdm"] = Field(description=WAVEFORM_KINDS)
    codes: str | GeneratedCodes | SidelinkCodes = Field(
        "raw/codes.npy",
        description="transmitted code symbols, complex64: .npy file or .zarr folder of shape (subcarriers,), or "
        "(frames, subcarriers) if they change from pulse to pulse; or the parameters of a generator; or "
        "source: sidelink, if the symbols are unknown",
    )
    carrier_is: Literal["band_start", "band_centre"] = Field(
        "band_start",
        description="position of the carrier in the band: subcarrier numbers n are 0…N-1 (band_start) or -N/2…N/2-1 "
        "(band_centre)",
    )
    subcarriers: int = Field(gt=1, description="number of subcarriers N", examples=[4096])
    subcarrier_spacing_hz: float = Field(gt=0, description="subcarrier spacing Δf, Hz", examples=[100e3])
    symbol_s: float = Field(
        gt=0, description="duration T of the transmitted symbol without prefix, s", examples=[12.5e-6]
    )
    cyclic_prefix_s: float = Field(ge=0, description="duration T_cp of the cyclic prefix, s", examples=[3.125e-6])

    @property
    def longest_delay_s(self) -> float:
        """Duration of the cyclic prefix."""
        return self.cyclic_prefix_s

    @property
    def middle_s(self) -> float:
        """Mid-time of the symbol."""
        return self.cyclic_prefix_s + self.symbol_s / 2

    @property
    def capture_s(self) -> float:
        """Duration of prefix and symbol."""
        return self.cyclic_prefix_s + self.symbol_s

    @property
    def prefix_samples(self) -> int:
        """Number of samples of the cyclic prefix, T_cp·f_s."""
        return round(self.cyclic_prefix_s * self.sample_rate_hz)

    @property
    def dft_samples(self) -> int:
        """DFT length, f_s/Δf."""
        return round(self.sample_rate_hz / self.subcarrier_spacing_hz)

    @property
    def needed_samples(self) -> int:
        """Number of samples of the prefix and of one period 1/Δf."""
        return self.prefix_samples + self.dft_samples

    @property
    def most_subcarriers(self) -> int:
        """Number of subcarriers, N."""
        return self.subcarriers

    @property
    def widest_band_hz(self) -> float:
        """Bandwidth of all subcarriers, NΔf."""
        return self.subcarriers * self.subcarrier_spacing_hz

    @model_validator(mode="after")
    def _dft_fits(self) -> Self:
        length = self.sample_rate_hz / self.subcarrier_spacing_hz
        if abs(length - round(length)) > 1e-6 * length:
            raise ValueError(f"the DFT length sample_rate_hz/subcarrier_spacing_hz = {length:.6f} must be an integer")
        if self.subcarriers > round(length):
            raise ValueError(f"subcarriers={self.subcarriers} exceeds the DFT length {round(length)}")
        if self.symbol_s < (1 - 1e-9) / self.subcarrier_spacing_hz:
            raise ValueError(
                f"symbol_s={self.symbol_s:g} is shorter than the DFT window 1/subcarrier_spacing_hz = "
                f"{1 / self.subcarrier_spacing_hz:g} s"
            )
        return self


class PulseWaveform(SampledWaveform):
    """Waveform given by its samples and transmitted once per trigger: a chirp, a code, or a loop-back recording."""

    file_key, delay_key, limit_name = "pulse", "listen_s", "the listening time"

    kind: Literal["samples"] = Field(description=WAVEFORM_KINDS)
    pulse: str = Field(
        "raw/pulse.npy",
        description=".npy file of the pulse sampled at sample_rate_hz: (sample,) complex, or (sample, 2) integers",
    )
    pulse_s: float = Field(gt=0, description="pulse duration, equal to that of the whole file, s", examples=[1e-6])
    lead_s: float = Field(0.0, ge=0, description="time from the start of a capture to the pulse, s")
    listen_s: float = Field(
        gt=0, description="longest delay for which a capture contains the complete echo, s", examples=[2e-6]
    )
    band_hz: tuple[float, float] | None = Field(
        None,
        description="baseband frequencies used for imaging, [lowest, highest], Hz; null: the band that contains the "
        "energy of the pulse",
    )
    filter: Literal["auto", "inverse", "matched"] = Field(
        "auto",
        description="range filter: inverse (only the sidelobes of the window) or matched (minimum noise); auto: "
        "inverse, unless the spectrum is flat or has too many gaps",
    )

    @property
    def longest_delay_s(self) -> float:
        """Configured listening time."""
        return self.listen_s

    @property
    def middle_s(self) -> float:
        """Mid-time of the pulse."""
        return self.pulse_s / 2

    @property
    def capture_s(self) -> float:
        """Sum of lead time, pulse duration and listening time."""
        return self.lead_s + self.pulse_s + self.listen_s

    @property
    def needed_samples(self) -> int:
        """Number of samples of a whole capture, which ends with the end of the last echo."""
        return self.capture_samples

    @property
    def most_subcarriers(self) -> int:
        """Maximum number of DFT frequencies within the band."""
        return min(self.capture_samples, int(self.widest_band_hz / self.sample_rate_hz * self.capture_samples) + 1)

    @property
    def widest_band_hz(self) -> float:
        """Configured bandwidth; the sample rate if no band is configured."""
        return self.sample_rate_hz if self.band_hz is None else self.band_hz[1] - self.band_hz[0]

    @model_validator(mode="after")
    def _fits_its_samples(self) -> Self:
        if self.band_hz is not None:
            low, high = self.band_hz
            half = self.sample_rate_hz / 2
            if not -half <= low < high <= half:
                raise ValueError(
                    f"band_hz={[low, high]} must be ascending and within ±sample_rate_hz/2 = ±{half:g} Hz; higher "
                    "frequencies are aliased"
                )
        if self.capture_s * self.prf_hz > 1:
            raise ValueError(
                f"lead_s + pulse_s + listen_s = {self.capture_s:g} s is longer than 1/prf_hz = {1 / self.prf_hz:g} s"
            )
        return self


# ---- Waveforms as transfer functions: phase histories, beat signals of FMCW -----------------------------------------

_MOST_SAMPLES = 1_000_000
"""Maximum number of samples in a sweep; sweeps of real radars have 100 to 100 000 samples."""

_LONGEST_REFERENCE_M = 1e6


def _formats(kind: str) -> list[str]:
    return [name for name, row in PHASE_HISTORIES.items() if row.waveform == kind]


def _known(name: str, kind: str) -> str:
    if name not in _formats(kind):
        raise ValueError(f"unknown format; choose {', '.join(_formats(kind))}")
    return name


class PhaseHistoryWaveform(Section):
    """Phase history: frequency-domain samples with antenna positions, recorded by another radar."""

    kind: Literal["phase_history"] = Field(description=WAVEFORM_KINDS)
    format: str = Field(
        description=f"format of the files raw/<flight>/<node>.*: {', '.join(_formats('phase_history'))}",
        examples=["hdf5"],
        json_schema_extra={"enum": [*_formats("phase_history")]},
    )

    air: Literal["auto", "measured", "point", "corrected"] = Field(
        "auto",
        description="atmospheric delay in the files: measured (delays as recorded), point (samples are referred to "
        "a point at a stated distance; only the excess path is delayed), corrected (delay already removed); "
        "auto: point for afrl_mat and cphd, otherwise measured",
    )
    channel: str | None = Field(None, description="channel to be imaged, for CPHD files with several channels")
    corrections: Literal["none", "stored"] = Field(
        "none",
        description="phase corrections contained in afrl_mat files (data.af): none (not applied) or stored (applied)",
    )
    iq: Literal["complex", "conjugate"] = Field(
        "complex",
        description="complex: samples as recorded; conjugate: complex conjugates of the samples, for files with the "
        "opposite sign of phase",
    )

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, name: str) -> str:
        return _known(name, "phase_history")

    @model_validator(mode="after")
    def _keys_are_of_their_format(self) -> Self:
        if self.channel is not None and self.format != "cphd":
            raise ValueError(f"channel={self.channel!r} applies to format cphd, not to {self.format}")
        if self.corrections != "none" and self.format != "afrl_mat":
            raise ValueError(f"corrections={self.corrections!r} applies to format afrl_mat, not to {self.format}")
        return self


class Trigger(Section):
    """Detection of sweep starts in a .wav file."""

    sync_channel: int = Field(1, ge=1, le=64, description="channel of the sync pulses, counted from 1")
    beat_channel: int = Field(2, ge=1, le=64, description="channel of the beat signal, counted from 1")
    edge: Literal["rising", "falling"] = Field("rising", description="edge of the sync pulses at which a sweep starts")
    threshold: float = Field(
        0.3,
        gt=0,
        lt=1,
        description="trigger level of the sync signal relative to the mean of its two levels, as a fraction of half "
        "the difference between the levels",
    )


class FmcwWaveform(Section):
    """FMCW waveform: linear sweeps; the beat signals of sweeps and echoes were recorded."""

    kind: Literal["fmcw"] = Field(description=WAVEFORM_KINDS)
    format: str = Field(
        description=f"format of the files raw/<flight>/<node>.*: {', '.join(_formats('fmcw'))}",
        examples=["beat_npy"],
        json_schema_extra={"enum": [*_formats("fmcw")]},
    )
    start_hz: float = Field(
        gt=0, description="RF frequency at the first sample, or at the trigger, of a sweep, Hz", examples=[2.2e9]
    )
    bandwidth_hz: float = Field(
        description="frequency change during sweep_s, Hz; negative for falling sweeps", examples=[400e6]
    )
    sweep_s: float = Field(gt=0, description="duration of the linear sweep, s", examples=[20e-6])
    sample_rate_hz: float = Field(gt=0, description="sample rate of the beat signal, Hz", examples=[25e6])
    iq: Literal["real", "complex", "conjugate"] = Field(
        "real",
        description="real: samples of a single mixer; complex: I+jQ of the echo times the conjugate sweep, with "
        "negative beat frequencies for rising sweeps; conjugate: I+jQ with the opposite sign of frequency",
    )
    settle_s: float = Field(0.0, ge=0, description="settling time excluded at the start of each sweep, s")
    reference_path_m: float = Field(
        0.0, ge=0, description="length of the internal local-oscillator path to the mixer, m"
    )
    prf_hz: float | None = Field(
        None, ge=1e-3, description="sweep repetition frequency, Hz; null: the files contain times or triggers"
    )
    start_utc: str | None = Field(
        None,
        description="start of recordings without times according to the recorder's clock, ISO 8601 in UTC; null: "
        "1970-01-01, corrected by config/clocks.tsv",
    )
    trigger: Trigger = Field(default_factory=Trigger, description="sweep trigger in a .wav file")

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, name: str) -> str:
        return _known(name, "fmcw")

    @model_validator(mode="after")
    def _sweeps_hold_samples(self) -> Self:
        if not self.bandwidth_hz or self.start_hz + self.bandwidth_hz <= 0:
            raise ValueError(
                f"bandwidth_hz={self.bandwidth_hz:g} with start_hz={self.start_hz:g} is not a band above 0 Hz"
            )
        if not 8 <= (self.sweep_s - self.settle_s) * self.sample_rate_hz <= _MOST_SAMPLES:
            raise ValueError(
                f"(sweep_s - settle_s)*sample_rate_hz = {(self.sweep_s - self.settle_s) * self.sample_rate_hz:g} "
                f"samples per sweep; must be between 8 and {_MOST_SAMPLES}"
            )
        if self.reference_path_m > _LONGEST_REFERENCE_M:
            raise ValueError(f"reference_path_m={self.reference_path_m:g} must be at most {_LONGEST_REFERENCE_M:g}")
        if self.prf_hz is not None and self.prf_hz * self.sweep_s > 1 + 1e-9:
            raise ValueError(f"sweep_s={self.sweep_s:g} is longer than 1/prf_hz = {1 / self.prf_hz:g} s")
        return self


# ---- Section `waveform` ----------------------------------------------------------------------------------------------

Waveform = Annotated[OfdmWaveform | PulseWaveform | PhaseHistoryWaveform | FmcwWaveform, Field(discriminator="kind")]
