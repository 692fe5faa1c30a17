"""What is transmitted in a simulation: the values of its section, and the waveform drawn from them."""

from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator
from pydantic.dataclasses import dataclass

from apertura.simulation.impairments import STRICT_KEYS
from apertura.simulation.pulse import PulseName, TransmitPulse, pulse_samples
from apertura.simulation.radar import TransmitWaveform, newman_codes, qpsk_codes


@dataclass(frozen=True, config=STRICT_KEYS)
class WaveformSpecification:
    """One OFDM symbol per pulse; docs/theory/simulate.md, eq. 3."""

    subcarriers: int = Field(gt=1, description="number of subcarriers N")
    carrier_hz: float = Field(gt=0, description="RF frequency of subcarrier n = 0, Hz")
    subcarrier_spacing_hz: float = Field(gt=0, description="subcarrier spacing Δf, Hz")
    symbol_s: float = Field(gt=0, description="transmitted symbol T without prefix, s")
    cyclic_prefix_s: float = Field(ge=0, description="cyclic prefix T_cp, s")
    sample_rate_hz: float = Field(gt=0, description="complex sample rate f_s, Hz")
    prf_hz: float = Field(gt=0, description="pulse repetition frequency, Hz")
    carrier_is: Literal["band_start", "band_centre"] = Field(
        default="band_start", description="n = 0…N-1 (band_start) or -N/2…N/2-1 (band_centre)"
    )
    code: Literal["qpsk", "newman"] = Field(default="qpsk", description="random QPSK, or Newman's flat symbol")
    kind: Literal["ofdm"] = Field(default="ofdm", kw_only=True, repr=False)

    @model_validator(mode="after")
    def _dft_fits(self) -> Self:
        length = self.sample_rate_hz / self.subcarrier_spacing_hz
        if abs(length - round(length)) > 1e-6 * length or self.subcarriers > round(length):
            raise ValueError(
                f"sample_rate_hz/subcarrier_spacing_hz = {length:.6f}, the DFT length, must be an integer "
                f"not below subcarriers={self.subcarriers}"
            )
        if self.symbol_s < (1 - 1e-9) / self.subcarrier_spacing_hz:
            raise ValueError(f"symbol_s={self.symbol_s:g} is shorter than 1/subcarrier_spacing_hz")
        return self

    def drawn(self, generator: Generator) -> TransmitWaveform:
        """Return the waveform with its code symbols."""
        codes = qpsk_codes(self.subcarriers, generator) if self.code == "qpsk" else newman_codes(self.subcarriers)
        sent = {name: value for name, value in vars(self).items() if name not in {"subcarriers", "code", "kind"}}
        return TransmitWaveform(codes, **sent)

    def section(self, _: TransmitWaveform) -> dict[str, Any]:
        """Return the section `waveform` of the config."""
        stated = {name: value for name, value in vars(self).items() if name not in {"code", "kind"}}
        return {"kind": self.kind, "codes": "raw/codes.npy", **stated}


@dataclass(frozen=True, config=STRICT_KEYS)
class PulseSpecification:
    """A pulse that is sent once per trigger; docs/theory/waveforms.md, "Simulated"."""

    pulse: PulseName = Field(description="chirp, pn (maximum-length sequence) or golay")
    carrier_hz: float = Field(gt=0, description="RF frequency of baseband zero, the middle of the pulse's band, Hz")
    bandwidth_hz: float = Field(gt=0, description="swept by the chirp, or rate of the chips, Hz")
    pulse_s: float = Field(gt=0, description="how long it lasts, at most, s")
    listen_s: float = Field(gt=0, description="longest delay whose echo a capture holds whole, s")
    sample_rate_hz: float = Field(gt=0, description="complex sample rate f_s, Hz")
    prf_hz: float = Field(gt=0, description="pulse repetition frequency, Hz")
    lead_s: float = Field(default=0.0, ge=0, description="how long before the pulse captures begin, s")
    band_hz: tuple[float, float] | None = Field(default=None, description="as in the config; null: ±bandwidth_hz/2")
    filter: Literal["auto", "inverse", "matched"] = Field(default="auto", description="as in the config")
    kind: Literal["samples"] = Field(default="samples", kw_only=True, repr=False)

    @model_validator(mode="after")
    def _can_be_sampled(self) -> Self:
        if self.bandwidth_hz > self.sample_rate_hz:
            raise ValueError(f"bandwidth_hz={self.bandwidth_hz:g} is beyond sample_rate_hz={self.sample_rate_hz:g}")
        self._sampled()
        return self

    def _sampled(self) -> NDArray[np.complex128]:
        sizes = {name: getattr(self, name) for name in ("bandwidth_hz", "pulse_s", "sample_rate_hz")}
        return pulse_samples(self.pulse, **sizes)

    def drawn(self, _: Generator) -> TransmitPulse:
        """Return the pulse; nothing of it is random."""
        half = self.bandwidth_hz / 2
        names = ("carrier_hz", "sample_rate_hz", "prf_hz", "lead_s", "listen_s")
        stated = {name: getattr(self, name) for name in names}
        return TransmitPulse.of(self._sampled(), **stated, band_hz=self.band_hz or (-half, half))

    def section(self, sent: TransmitWaveform) -> dict[str, Any]:
        """Return the section `waveform` of the config, for the pulse as it was drawn."""
        if not isinstance(sent, TransmitPulse):
            raise TypeError("drawn from another specification")
        names = ("carrier_hz", "sample_rate_hz", "prf_hz", "lead_s", "listen_s", "filter")
        stated = {name: getattr(self, name) for name in names}
        pulse_s = len(sent.pulse) / self.sample_rate_hz
        return {
            "kind": self.kind,
            "pulse": "raw/pulse.npy",
            "pulse_s": pulse_s,
            "band_hz": list(sent.band_hz),
            **stated,
        }


def _with_kind(value: Any) -> Any:
    """Return what a document says of a waveform, with the kind that it is of where it does not say."""
    return {"kind": "ofdm", **value} if isinstance(value, dict) else value


TransmittedSpecification = Annotated[
    Annotated[WaveformSpecification | PulseSpecification, Field(discriminator="kind")], BeforeValidator(_with_kind)
]
"""By `kind`; an OFDM symbol where a specification does not say."""
