"""The config as a whole."""

from typing import Self

from pydantic import Field, model_validator

from apertura.settings.calibration import Calibration
from apertura.settings.names import Name
from apertura.settings.node import Node
from apertura.settings.processing import Processing
from apertura.settings.scene import Scene
from apertura.settings.section import Section
from apertura.settings.waveform import PhaseHistoryWaveform, Waveform


class Settings(Section):
    """config/config.yaml."""

    campaign: str = Field(description="name of the campaign", examples=["my_campaign"])
    waveform: Waveform = Field(description="what was transmitted")
    nodes: dict[Name, Node] = Field(min_length=1, description="one section per UAV, named as in flights.tsv")
    scene: Scene = Field(default_factory=Scene, description="the grid of every raster of the campaign")
    processing: Processing = Field(default_factory=Processing, description="how to compute")
    calibration: Calibration | None = Field(
        None, description="path offsets from a calibration flight: flight, reflector_m, search_m; null: as stated above"
    )

    @model_validator(mode="after")
    def _calibration_needs_a_place(self) -> Self:
        if self.calibration is not None and self.scene.crs == "auto":
            raise ValueError("calibration.reflector_m is in scene.crs, which is auto: give the CRS")
        return self

    @model_validator(mode="after")
    def _beams_need_a_log(self) -> Self:
        named = [name for name, node in self.nodes.items() if node.antennas.any()]
        if named and isinstance(self.waveform, PhaseHistoryWaveform):
            raise ValueError(
                f"nodes.{named[0]}.antennas has a beam, but phase history carries no attitude: set it to null"
            )
        return self
