"""Section `nodes.<node>.antennas`: where antennas look and how widely."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from apertura.settings.section import Section

Beamwidth = Annotated[float, Field(gt=0, le=180)]


class Antenna(Section):
    """Where one antenna looks and how widely; its horizontal axis lies in the body's forward-right plane."""

    boresight_deg: tuple[Annotated[float, Field(ge=-180, le=360)], Annotated[float, Field(ge=-90, le=90)]] = Field(
        description="azimuth clockwise from forward, elevation above the forward-right plane (down is negative), deg"
    )
    beamwidth_deg: tuple[Beamwidth, Beamwidth] | None = Field(
        None, description="full width at -3 dB (one way) in azimuth and elevation of a Gaussian beam, deg"
    )
    pattern: str | None = Field(
        None,
        description="instead of beamwidth_deg a CSV of both cuts: columns cut (azimuth, elevation), angle_deg, gain_db",
    )
    cutoff_db: float = Field(
        -20.0, ge=-80, le=-3, description="gain below which a cut ends: pulses beyond are left out, dB under its peak"
    )

    @model_validator(mode="after")
    def _one_pattern(self) -> Self:
        if (self.beamwidth_deg is None) == (self.pattern is None):
            raise ValueError("give either beamwidth_deg, [azimuth, elevation], or pattern, a CSV file")
        return self


_BEAM = "null (alike in all directions), or boresight_deg with beamwidth_deg or pattern, and cutoff_db"


class Antennas(Section):
    """The beams of a node."""

    radar_tx: Antenna | None = Field(None, description=f"transmitting radar antenna: {_BEAM}")
    radar_rx: Antenna | None = Field(None, description=f"receiving radar antenna: {_BEAM}")

    def any(self) -> bool:
        """Return whether one of them is stated."""
        return self.radar_tx is not None or self.radar_rx is not None
