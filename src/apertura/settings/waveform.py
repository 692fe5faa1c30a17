"""Section `waveform`: what was transmitted."""

from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from apertura.ingest import PHASE_HISTORIES
from apertura.settings.section import Section


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


class PhaseHistoryWaveform(Section):
    """Frequency-domain samples with antenna positions, recorded by another radar."""

    kind: Literal["phase_history"] = Field(description="recorded frequency-domain samples with antenna positions")
    format: str = Field(
        description=f"format of the files raw/<flight>/<node>.*: {', '.join(PHASE_HISTORIES)}",
        json_schema_extra={"enum": [*PHASE_HISTORIES]},
    )

    channel: str | None = Field(None, description="of a CPHD file with several channels the one to image")

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, name: str) -> str:
        if name not in PHASE_HISTORIES:
            raise ValueError(f"no such format; choose {', '.join(PHASE_HISTORIES)}")
        return name

    @model_validator(mode="after")
    def _channels_are_of_cphd(self) -> Self:
        if self.channel is not None and self.format != "cphd":
            raise ValueError(f"channel={self.channel!r} is of format cphd, and not of {self.format}")
        return self


Waveform = Annotated[OfdmWaveform | PhaseHistoryWaveform, Field(discriminator="kind")]
