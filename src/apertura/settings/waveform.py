"""Section `waveform`: what was transmitted."""

from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from apertura.ingest import PHASE_HISTORIES
from apertura.settings.section import Section

_MOST_SAMPLES = 1_000_000
"""Of a sweep; ramps of real radars have 100 to 100 000."""

_LONGEST_REFERENCE_M = 1e6


class OfdmWaveform(Section):
    """One OFDM symbol per pulse."""

    kind: Literal["ofdm"] = Field(description="ofdm, or phase_history for recorded frequency-domain samples")
    codes: str = Field("raw/codes.npy", description="transmitted code symbols, complex64 (subcarriers,)")
    carrier_hz: float = Field(gt=0, description="RF carrier, Hz", examples=[1.2e9])
    carrier_is: Literal["band_start", "band_centre"] = Field(
        "band_start", description="which subcarrier the carrier is: n = 0…N-1 (band_start) or -N/2…N/2-1 (band_centre)"
    )
    subcarriers: int = Field(gt=1, description="number of subcarriers N", examples=[4096])
    subcarrier_spacing_hz: float = Field(gt=0, description="subcarrier spacing Δf, Hz", examples=[100e3])
    symbol_s: float = Field(gt=0, description="transmitted symbol T without prefix, s", examples=[12.5e-6])
    cyclic_prefix_s: float = Field(ge=0, description="cyclic prefix T_cp, s", examples=[3.125e-6])
    sample_rate_hz: float = Field(gt=0, description="complex sample rate f_s, Hz", examples=[1.024e9])
    prf_hz: float = Field(gt=0, description="pulse repetition frequency, Hz", examples=[100.0])

    @model_validator(mode="after")
    def _dft_fits(self) -> Self:
        length = self.sample_rate_hz / self.subcarrier_spacing_hz
        if abs(length - round(length)) > 1e-6 * length:
            raise ValueError(
                f"sample_rate_hz/subcarrier_spacing_hz = {length:.6f} must be an integer: it is the DFT length"
            )
        if self.subcarriers > round(length):
            raise ValueError(f"subcarriers={self.subcarriers} exceed the DFT length {round(length)}")
        if self.symbol_s < (1 - 1e-9) / self.subcarrier_spacing_hz:
            raise ValueError(
                f"symbol_s={self.symbol_s:g} is shorter than the DFT window 1/subcarrier_spacing_hz = "
                f"{1 / self.subcarrier_spacing_hz:g} s"
            )
        return self


def _formats(kind: str) -> list[str]:
    return [name for name, row in PHASE_HISTORIES.items() if row.waveform == kind]


def _known(name: str, kind: str) -> str:
    if name not in _formats(kind):
        raise ValueError(f"no such format; choose {', '.join(_formats(kind))}")
    return name


class PhaseHistoryWaveform(Section):
    """Frequency-domain samples with antenna positions, recorded by another radar."""

    kind: Literal["phase_history"] = Field(description="recorded frequency-domain samples with antenna positions")
    format: str = Field(
        description=f"format of the files raw/<flight>/<node>.*: {', '.join(_formats('phase_history'))}",
        json_schema_extra={"enum": [*_formats("phase_history")]},
    )

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, name: str) -> str:
        return _known(name, "phase_history")


class Trigger(Section):
    """Where sweeps begin in a .wav file."""

    sync_channel: int = Field(1, ge=1, le=64, description="channel of the sync pulses, counted from 1")
    beat_channel: int = Field(2, ge=1, le=64, description="channel of the beat signal, counted from 1")
    edge: Literal["rising", "falling"] = Field("rising", description="of the sync pulses, where a sweep begins")
    threshold: float = Field(
        0.3, gt=0, lt=1, description="how far beyond the middle of its levels sync must go, of half their distance"
    )


class FmcwWaveform(Section):
    """Linear sweeps, mixed with their echoes when received: the beat signal was recorded."""

    kind: Literal["fmcw"] = Field(description="beat signals of linear sweeps, dechirped when received")
    format: str = Field(
        description=f"format of the files raw/<flight>/<node>.*: {', '.join(_formats('fmcw'))}",
        json_schema_extra={"enum": [*_formats("fmcw")]},
    )
    start_hz: float = Field(gt=0, description="RF frequency at the first sample of a sweep, or at its trigger, Hz")
    bandwidth_hz: float = Field(description="what frequency rises by in sweep_s, Hz; negative: sweeps that fall")
    sweep_s: float = Field(gt=0, description="how long a sweep is linear, s")
    sample_rate_hz: float = Field(gt=0, description="of the beat signal, Hz")
    iq: Literal["real", "complex", "conjugate"] = Field(
        "real",
        description="real: one mixer; complex: I+jQ of echo times conjugate sweep, whose beats are negative in a "
        "sweep that rises; conjugate: the other way about",
    )
    settle_s: float = Field(0.0, ge=0, description="left out at the beginning of every sweep, s")
    reference_path_m: float = Field(0.0, ge=0, description="path of the sweep to the mixer inside the radar, m")
    prf_hz: float | None = Field(None, ge=1e-3, description="sweeps per second, Hz; null: files hold times or triggers")
    start_utc: str | None = Field(
        None,
        description="when files without times began, ISO 8601 in UTC by the recorder; null: 1970, config/clocks.tsv "
        "says the rest",
    )
    trigger: Trigger = Field(default_factory=Trigger, description="where sweeps begin in a .wav file")

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, name: str) -> str:
        return _known(name, "fmcw")

    @model_validator(mode="after")
    def _sweeps_hold_samples(self) -> Self:
        if not self.bandwidth_hz or self.start_hz + self.bandwidth_hz <= 0:
            raise ValueError(
                f"bandwidth_hz={self.bandwidth_hz:g} from start_hz={self.start_hz:g} is no band above 0 Hz"
            )
        if not 8 <= (self.sweep_s - self.settle_s) * self.sample_rate_hz <= _MOST_SAMPLES:
            raise ValueError(
                f"(sweep_s - settle_s)*sample_rate_hz = {(self.sweep_s - self.settle_s) * self.sample_rate_hz:g} "
                f"samples per sweep: must be 8 to {_MOST_SAMPLES}"
            )
        if self.reference_path_m > _LONGEST_REFERENCE_M:
            raise ValueError(f"reference_path_m={self.reference_path_m:g}: at most {_LONGEST_REFERENCE_M:g}")
        if self.prf_hz is not None and self.prf_hz * self.sweep_s > 1 + 1e-9:
            raise ValueError(f"sweep_s={self.sweep_s:g} is longer than 1/prf_hz = {1 / self.prf_hz:g} s")
        return self


Waveform = Annotated[OfdmWaveform | PhaseHistoryWaveform | FmcwWaveform, Field(discriminator="kind")]
