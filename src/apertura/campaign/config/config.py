"""Validation of config/config.yaml as `Settings`; a single message lists all errors."""

from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from apertura.campaign.config.nodes import Node
from apertura.campaign.config.processing import (
    BenchSettings,
    CalibrationSettings,
    Interferometry,
    Processing,
    Scene,
    Stack,
)
from apertura.campaign.config.section import Name, RawRoot, Section
from apertura.campaign.config.waveform import PhaseHistoryWaveform, SampledWaveform, Waveform
from apertura.common import documents
from apertura.common.attribution import Attribution, Title
from apertura.common.documents import read_yaml

CONFIG = Path("config/config.yaml")
"""Path of the config in a campaign folder."""


class Settings(Section):
    """Content of config/config.yaml."""

    campaign: Title = Field(description="name of the campaign", examples=["my_campaign"])
    waveform: Waveform = Field(description="transmitted waveform")
    raw_root: RawRoot | None = Field(
        None,
        description="absolute path of a folder that replaces raw/, for example on another disk; null: raw/",
    )
    nodes: dict[Name, Node] = Field(min_length=1, description="one section per node, with the name in flights.tsv")
    scene: Scene = Field(default_factory=Scene, description="output grid of the campaign")
    processing: Processing = Field(default_factory=Processing, description="processing settings")
    calibration: CalibrationSettings | None = Field(
        None,
        description="path offsets from a calibration flight: flight, reflector_m, search_m; null: "
        "nodes.<name>.path_offset_m",
    )
    bench: BenchSettings = Field(default_factory=BenchSettings, description="set-up of bench recordings")
    interferometry: Interferometry = Field(
        default_factory=Interferometry, description="pairs of images for interferometry: coherence and heights"
    )
    stack: Stack | None = Field(
        None,
        description="time stack of one pair: reference, flights, pair, window_px; null: no stack",
    )
    metadata: Attribution = Field(
        default_factory=Attribution,
        description="title, creators, institution, licence, platform, instrument and DOI, written to all products; "
        "polarisations are keys of nodes.<name>.antennas",
    )

    @model_validator(mode="after")
    def _calibration_needs_a_crs(self) -> Self:
        if self.calibration is not None and self.scene.crs == "auto":
            raise ValueError("calibration.reflector_m refers to scene.crs, which is auto: state the CRS")
        return self

    @model_validator(mode="after")
    def _node_iq_needs_samples(self) -> Self:
        nodes = [name for name, node in self.nodes.items() if node.iq is not None]
        if nodes and not isinstance(self.waveform, SampledWaveform):
            raise ValueError(
                f"nodes.{nodes[0]}.iq applies to recorded samples only (kinds ofdm and samples): set this key to null "
                "and use waveform.iq"
            )
        return self

    def iq_of(self, node: str) -> str:
        """Return the order of I and Q in recordings of a node: `nodes.<n>.iq` if configured, else `waveform.iq`."""
        return self.nodes[node].iq or self.waveform.iq

    @model_validator(mode="after")
    def _beams_need_attitude(self) -> Self:
        nodes = [name for name, node in self.nodes.items() if node.antennas.any()]
        if nodes and isinstance(self.waveform, PhaseHistoryWaveform):
            raise ValueError(
                f"nodes.{nodes[0]}.antennas has a beam, but phase histories contain no attitude: set the beam to null"
            )
        return self


def read_settings(path: Path) -> Settings:
    """Read the settings of a config file.

    Raises
    ------
    CampaignError
        If the file is missing, is not YAML, or is not valid.
    """
    remedy = "Create a commented config with `apertura init`."
    return validated(read_yaml(path, expected="a campaign folder", remedy=remedy), where=path)


def located(message: str) -> str:
    """Return a message with the path of the config as a prefix if it begins with a config key.

    Examples
    --------
    >>> located("scene.dem: no such file; ..."), located("scene.tif: no such file; ...")
    ('config/config.yaml: scene.dem: no such file; ...', 'scene.tif: no such file; ...')
    """
    section, _, key = message.partition(": ")[0].partition(".")
    field = Settings.model_fields.get(section)
    known = field is not None and (not key or key in getattr(field.annotation, "model_fields", {}))
    return f"{CONFIG}: {message}" if known else message


def validated(document: object, *, where: object) -> Settings:
    """Return `document` as Settings; a single message lists all invalid keys, each with the most similar valid key.

    Raises
    ------
    CampaignError
        If the document is not valid.

    Examples
    --------
    >>> validated({"campaing": "x"}, where="config.yaml")
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: config.yaml: campaing: unknown key (did you mean 'campaign'?); ...
    """
    expected = f"keys and values as in the {CONFIG} written by `apertura init`"
    return documents.validated(Settings, document, where=where, expected=expected)
