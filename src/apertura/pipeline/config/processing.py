"""Sections `processing`, how to compute, and `calibration`, path offsets from a flight over a reflector."""

import re
from typing import Literal

from pydantic import Field, field_validator

from apertura.core.imaging.choices import ImagingChoices
from apertura.pipeline.config.section import Metres3, Name, Section


class Fusion(Section):
    """How the images of a flight's pairs are added up."""

    align_phase: bool = Field(
        False, description="take a constant phase between pairs, measured at bright points, off before they are added"
    )


class Processing(ImagingChoices):
    """How to compute; every key has a default."""

    sidelink: Literal["auto", "divide", "wiener", "gated", "two_parameter"] = Field(
        "auto", description="correction of a secondary node by its sidelink; auto takes the cheapest adequate"
    )
    fusion: Fusion = Field(default_factory=Fusion, description="how the images of a flight's pairs are added up")
    autofocus: Literal["auto", "on", "off"] = Field(
        "auto",
        description="tracks refined by the images themselves; auto: where errors of position that are stated cost more "
        "than they should",
    )
    autofocus_method: Literal["auto", "tracks", "phase_gradient", "minimum_entropy"] = Field(
        "auto",
        description="what is refined: tracks, or one phase per pulse and pair by either method; auto: one phase, by "
        "minimum_entropy, where all of the scene sees errors of position alike, else tracks",
    )
    scheduler: str = Field(
        "threads",
        description="who forms the tiles: threads of the step, or the dask scheduler at tcp://host:port, if whoever "
        "runs this names the same in DASK_SCHEDULER_ADDRESS",
    )
    false_alarms_per_s: float = Field(
        1e-3, gt=0, description="how often noise alone may trigger in a continuous recording, per second"
    )

    @field_validator("autofocus", mode="before")
    @classmethod
    def _yaml_reads_on_and_off_as_truth(cls, word: object) -> object:
        return {True: "on", False: "off"}[word] if isinstance(word, bool) else word

    @field_validator("scheduler")
    @classmethod
    def _scheduler_is_an_address(cls, text: str) -> str:
        if text != "threads" and not re.fullmatch(r"tcp://[A-Za-z0-9_.-]+:[0-9]{1,5}", text):
            raise ValueError("neither threads nor an address tcp://host:port")
        return text


class Calibration(Section):
    """Which flight the path offsets come from."""

    flight: Name = Field(description="flight of kind calibration whose offsets the imaging flights use")
    reflector_m: Metres3 = Field(description="reflector: easting, northing in scene.crs, ellipsoidal height, m")
    search_m: float = Field(10.0, gt=0, description="offsets of either sign up to this are considered, m")
