"""Section `nodes`: what each UAV carries."""

from typing import Literal, Self

from pydantic import Field, model_validator

from apertura.settings.antennas import Antennas
from apertura.settings.section import Metres3, Section


class LeverArms(Section):
    """From the logged point to each phase centre, body axes forward-right-down."""

    radar_tx: Metres3 = Field((0.0, 0.0, 0.0), description="transmitting radar antenna, m")
    radar_rx: Metres3 = Field((0.0, 0.0, 0.0), description="receiving radar antenna, m")
    sidelink: Metres3 = Field((0.0, 0.0, 0.0), description="sidelink antenna, m")

    def any(self) -> bool:
        """Return whether one of them is not zero."""
        return any(any(arm) for arm in (self.radar_tx, self.radar_rx, self.sidelink))


class PathOffsets(Section):
    """Electrical path beyond geometry, metres of total path, of the receiving node."""

    radar: float = Field(0.0, description="radar channel, m")
    sidelink: float = Field(0.0, description="sidelink channel, m")


class Node(Section):
    """One UAV."""

    lever_arms_m: LeverArms = Field(default_factory=LeverArms, description="logged point → phase centres, body axes")
    antennas: Antennas = Field(default_factory=Antennas, description="beams: where the antennas look, in body axes")
    path_offset_m: PathOffsets = Field(
        default_factory=PathOffsets, description="electrical path beyond geometry, as receiver"
    )
    attitude: Literal["log", "course", "none"] = Field(
        "none", description="where attitude comes from: the log, the course over ground, or none"
    )

    @model_validator(mode="after")
    def _lever_arm_needs_attitude(self) -> Self:
        if self.attitude == "none" and self.lever_arms_m.any():
            raise ValueError(
                "lever_arms_m is not zero but attitude is none: body axes cannot be turned to north-east-down; "
                "set attitude to log or course, or the lever arms to zero"
            )
        if self.attitude == "none" and self.antennas.any():
            raise ValueError(
                "antennas has a beam but attitude is none: body axes cannot be turned to north-east-down; "
                "set attitude to log or course, or the beam to null"
            )
        return self
