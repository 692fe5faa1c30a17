"""Waveforms that enter as transfer functions: phase history of other radars, beat signals of FMCW."""

from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from apertura.formats.names import PHASE_HISTORIES
from apertura.pipeline.config.section import WAVEFORM_KINDS, Section

_MOST_SAMPLES = 1_000_000
"""Of a sweep; ramps of real radars have 100 to 100 000."""

_LONGEST_REFERENCE_M = 1e6


def _formats(kind: str) -> list[str]:
    return [name for name, row in PHASE_HISTORIES.items() if row.waveform == kind]


def _known(name: str, kind: str) -> str:
    if name not in _formats(kind):
        raise ValueError(f"no such format; choose {', '.join(_formats(kind))}")
    return name


class PhaseHistoryWaveform(Section):
    """Frequency-domain samples with antenna positions, recorded by another radar."""

    kind: Literal["phase_history"] = Field(description=WAVEFORM_KINDS)
    format: str = Field(
        description=f"format of the files raw/<flight>/<node>.*: {', '.join(_formats('phase_history'))}",
        examples=["hdf5"],
        json_schema_extra={"enum": [*_formats("phase_history")]},
    )

    channel: str | None = Field(None, description="of a CPHD file with several channels the one to image")

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, name: str) -> str:
        return _known(name, "phase_history")

    @model_validator(mode="after")
    def _channels_are_of_cphd(self) -> Self:
        if self.channel is not None and self.format != "cphd":
            raise ValueError(f"channel={self.channel!r} is of format cphd, and not of {self.format}")
        return self


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

    kind: Literal["fmcw"] = Field(description=WAVEFORM_KINDS)
    format: str = Field(
        description=f"format of the files raw/<flight>/<node>.*: {', '.join(_formats('fmcw'))}",
        examples=["beat_npy"],
        json_schema_extra={"enum": [*_formats("fmcw")]},
    )
    start_hz: float = Field(
        gt=0, description="RF frequency at the first sample of a sweep, or at its trigger, Hz", examples=[2.2e9]
    )
    bandwidth_hz: float = Field(
        description="what frequency rises by in sweep_s, Hz; negative: sweeps that fall", examples=[400e6]
    )
    sweep_s: float = Field(gt=0, description="how long a sweep is linear, s", examples=[20e-6])
    sample_rate_hz: float = Field(gt=0, description="of the beat signal, Hz", examples=[25e6])
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
