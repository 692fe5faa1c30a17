"""Specification of a simulated campaign in YAML, and the draw of its code symbols and trajectories."""

import dataclasses
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import yaml
from numpy.random import Generator
from pydantic import BeforeValidator, Field, model_validator
from pydantic.dataclasses import dataclass
from pydantic.fields import FieldInfo

from apertura.common.arrays import Floats
from apertura.common.constants import LARGEST_REFRACTIVITY
from apertura.common.documents import read_yaml, validated
from apertura.core.geometry.atmosphere import Atmosphere
from apertura.core.geometry.geodesy import geodetic_from_ecef, projected_from_ecef
from apertura.simulation.continuous import Framing
from apertura.simulation.impairments import (
    STRICT_KEYS,
    AntennaPoint,
    ChannelName,
    Impairments,
    RadarPoint,
    Radio,
    independent_streams,
)
from apertura.simulation.scatterers import TrueAir
from apertura.simulation.targets import (
    GaussianBeam,
    Origin,
    Target,
    TargetChange,
    Track,
    Trajectory,
    Vector,
)
from apertura.simulation.waveform import TransmittedSpecification, TransmitWaveform

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.]*$")]


@dataclass(frozen=True, config=STRICT_KEYS)
class SimulatedNode:
    """Simulated UAV: antennas, log, radio and impairments."""

    lever_arms_m: Mapping[AntennaPoint, Vector] = Field(
        default_factory=dict, description="forward, right, down from the logged point to each antenna, m; missing: zero"
    )
    path_offset_m: Mapping[ChannelName, float] = Field(
        default_factory=dict,
        description="true electrical path of the receiver in addition to the geometric path, m; missing: zero",
    )
    stated_path_offset_m: Mapping[ChannelName, float] | None = Field(
        default=None, description="path offset in the config; null: the true one"
    )
    attitude: Literal["log", "course", "none"] = Field(default="log", description="attitude in the config")
    log_format: Literal["csv", "pos", "pos_utc"] = Field(
        default="csv", description="csv with attitude, pos (RTKLIB in GPST) or pos_utc"
    )
    log_rate_hz: float = Field(default=10.0, gt=0, description="epochs of the log per second, Hz")
    position_std_m: float | None = Field(
        default=None, gt=0, description="position accuracy in the config, per axis, m; null: not configured"
    )
    impairments: Impairments = Field(default=Impairments(), description="impairments of the node")
    radio: Radio | None = Field(
        default=None,
        description="power, gains and receiver; target amplitudes are then square roots of cross-sections in m²",
    )
    antennas: Mapping[RadarPoint, GaussianBeam] = Field(
        default_factory=dict, description="beams of the radar antennas; missing: isotropic"
    )


def _utc_text(value: Any) -> Any:
    """Convert a time that the YAML reader has parsed back to ISO 8601 text, in UTC without a suffix."""
    if not isinstance(value, datetime):
        return value
    return (value.astimezone(UTC) if value.tzinfo else value).replace(tzinfo=None).isoformat()


@dataclass(frozen=True, config=STRICT_KEYS)
class SimulatedFlight:
    """Simulated flight: its row of flights.tsv, tracks and recording mode."""

    name: Name = Field(description="name in flights.tsv")
    transmitter: str = Field(description="node that transmits; it also receives")
    tracks: Mapping[Name, Track] = Field(min_length=1, description="track of each recording node, by its name")
    pulses: int = Field(gt=0, description="number of pulses")
    start_utc: Annotated[
        str, BeforeValidator(_utc_text), Field(pattern=r"^\d{4}-\d\d-\d\d(T\d\d:\d\d(:[\d.]+)?)?$")
    ] = Field(default="2025-05-14T09:30:00", description="UTC of the first pulse, ISO 8601")
    kind: Literal["image", "calibration", "bench"] = Field(default="image", description="kind in flights.tsv")
    framing: Framing | None = Field(default=None, description="preamble and frame counter; null: no frame numbers")
    first_frame: int = Field(default=0, ge=0, description="number of the first frame")
    continuous: bool = Field(default=False, description="continuous instead of triggered recordings")
    targets: tuple[Target, ...] | None = Field(
        default=None, description="targets of this flight instead of those of the campaign"
    )
    changes: tuple[TargetChange, ...] = Field(
        default=(), description="targets of the campaign that differ in this flight: displaced, turned or absent"
    )
    segments: Mapping[str, tuple[tuple[float, float], ...]] = Field(
        default_factory=dict,
        description="pair → start and end of the imaged segments, s after the first pulse; missing: all pulses",
    )

    @model_validator(mode="after")
    def _transmitter_flies(self) -> Self:
        if self.transmitter not in self.tracks:
            raise ValueError(
                f"transmitter {self.transmitter!r} has no track; nodes with a track: {', '.join(self.tracks)}"
            )
        if self.targets is not None and self.changes:
            raise ValueError("changes refer to the targets of the campaign, which `targets` of the flight replace")
        return self


@dataclass(frozen=True, config=STRICT_KEYS)
class ImageGrid:
    """Grid of the scene, section `scene` of the config."""

    crs: str = Field(pattern=r"^EPSG:\d+$", description="projected CRS, EPSG:…")
    half_width_m: float | None = Field(
        default=None, gt=0, description="half width of a square about the origin, m, instead of bounds_m"
    )
    bounds_m: tuple[float, float, float, float] | Literal["auto"] = Field(
        default="auto", description="outer pixel edges, m"
    )
    spacing_m: float | Literal["auto"] = Field(default="auto", description="pixel spacing, m, or auto")
    height_m: float | None = Field(default=None, description="ellipsoidal height, m; null: that of the origin")

    @model_validator(mode="after")
    def _square_has_a_spacing(self) -> Self:
        if self.half_width_m is not None and (self.spacing_m == "auto" or self.bounds_m != "auto"):
            raise ValueError("half_width_m requires spacing_m in metres, and excludes bounds_m")
        return self

    def bounds(self, origin: Origin) -> tuple[float, ...] | Literal["auto"]:
        """Return xmin, ymin, xmax, ymax (m); a square is anchored at a multiple of the spacing.

        Examples
        --------
        >>> ImageGrid("EPSG:32632", 1.0, spacing_m=0.05).bounds(Origin(48.0, 9.0, 500.0))
        (499999.0, 5316299.2, 500001.0, 5316301.2)
        """
        if self.half_width_m is None or self.spacing_m == "auto":
            return self.bounds_m
        centre = projected_from_ecef(self.crs, origin.ecef(np.zeros(3)))
        x, y = (round(float(value) / self.spacing_m) * self.spacing_m for value in centre[:2])
        half = self.half_width_m
        return tuple(round(value, 6) for value in (x - half, y - half, x + half, y + half))


@dataclass(frozen=True, config=STRICT_KEYS)
class CampaignSpecification:
    """Specification that, together with the seed, determines all files of a simulated campaign."""

    campaign: str = Field(description="name of the campaign")
    origin: Origin = Field(description="origin of the east, north and up coordinates")
    waveform: TransmittedSpecification = Field(description="transmitted waveform")
    targets: tuple[Target, ...] = Field(description="targets of the scene")
    nodes: Mapping[Name, SimulatedNode] = Field(min_length=1, description="one section per UAV")
    flights: tuple[SimulatedFlight, ...] = Field(description="flights, one after the other")
    scene: ImageGrid = Field(description="the grid on which the campaign is imaged")
    atmosphere: Literal["standard", "vacuum"] | Annotated[float, Field(ge=0, le=LARGEST_REFRACTIVITY)] = Field(
        default="standard",
        description="atmosphere along all paths: standard (at the height of the origin, 50 % humidity), vacuum, or the "
        "refractivity at the origin, (n - 1)·10⁶, which decreases with height and is written to the config",
    )
    bench: Mapping[str, float | bool] = Field(
        default_factory=dict, description="section `bench` of the config, for flights of kind bench"
    )
    stack: Mapping[str, str | tuple[str, ...] | int] = Field(
        default_factory=dict, description="section `stack` of the config, for several flights over one scene"
    )
    synthesis: Literal["exact", "periodic"] = Field(
        default="exact",
        description="exact, with the edges of each echo; or periodic, fast for long flights, with continuous echoes",
    )

    @property
    def air(self) -> TrueAir | None:
        """True atmosphere between positions in ECEF; None: vacuum."""
        if self.atmosphere == "vacuum":
            return None
        ground_m = self.origin.height_m
        if self.atmosphere == "standard":
            atmosphere = Atmosphere.standard(ground_m)
        else:
            atmosphere = Atmosphere.stated(float(self.atmosphere), ground_m=ground_m)
        return TrueAir(atmosphere, lambda position: np.asarray(geodetic_from_ecef(position)[..., 2]))

    @model_validator(mode="after")
    def _radios_are_of_all(self) -> Self:
        with_radio = [name for name, node in self.nodes.items() if node.radio is not None]
        if with_radio and len(with_radio) < len(self.nodes):
            raise ValueError(f"radio is specified only for {', '.join(with_radio)}: specify it for all nodes or none")
        conflicting = [name for name in with_radio if self.nodes[name].impairments.radar_snr_db is not None]
        if conflicting:
            raise ValueError(
                f"{conflicting[0]} has both a radio, whose noise follows from noise_figure_db, and radar_snr_db"
            )
        return self

    @model_validator(mode="after")
    def _nodes_fly(self) -> Self:
        with_track = {name for flight in self.flights for name in flight.tracks}
        if with_track != set(self.nodes):
            raise ValueError(
                f"the nodes are {', '.join(sorted(self.nodes))}, but the nodes with a track are "
                f"{', '.join(sorted(with_track))}"
            )
        single_pulse = self.waveform.kind == "samples"
        if single_pulse and (
            self.synthesis == "periodic" or any(flight.continuous or flight.framing for flight in self.flights)
        ):
            raise ValueError("a pulse that is sent once requires synthesis: exact, without framing or continuous")
        if not self.flights or len({flight.name for flight in self.flights}) < len(self.flights):
            raise ValueError("there must be at least one flight, and flights must have different names")
        last = len(self.targets) - 1
        for flight in self.flights:
            if wrong := [change.target for change in flight.changes if change.target > last]:
                raise ValueError(f"flight {flight.name} changes target {wrong[0]}; the last target is number {last}")
        return self


def read_specification(path: Path) -> CampaignSpecification:
    """Read a specification from a YAML file.

    Raises
    ------
    CampaignError
        If the file is missing or invalid; the error lists all wrong keys and the nearest valid keys.
    """
    remedy = "Start from the output of `apertura simulate --print-spec demo`."
    document = read_yaml(path, expected="a YAML specification of a simulation", remedy=remedy)
    expected = "keys and values as in the output of `apertura simulate --print-spec demo`"
    return validated(CampaignSpecification, document, where=path, expected=expected)


def specification_text(specification: CampaignSpecification) -> str:
    """Return a specification as YAML without default values; `read_specification` restores it exactly."""
    return yaml.safe_dump(_plain(specification), sort_keys=False, default_flow_style=None, width=120)


def _plain(value: Any) -> Any:
    """Convert a part of a specification to plain YAML values, without defaults."""
    if dataclasses.is_dataclass(value):
        fields: dict[str, FieldInfo] = type(value).__pydantic_fields__  # type: ignore[union-attr]
        values = {name: getattr(value, name) for name in fields}
        # the keyword-only field `kind` comes first, because it determines the other keys
        return {
            name: _plain(values[name])
            for name, field in sorted(fields.items(), key=lambda item: not item[1].kw_only)
            if field.kw_only or values[name] != field.get_default(call_default_factory=True)
        }
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, complex):
        return str(value) if value.imag else value.real
    return value


@dataclasses.dataclass(frozen=True)
class DrawnCampaign:
    """Specification with drawn code symbols and drawn trajectories, (flight, node) → trajectory."""

    specification: CampaignSpecification
    waveform: TransmitWaveform
    trajectories: Mapping[tuple[str, str], Trajectory]

    def pulse_times(self, flight: SimulatedFlight) -> Floats:
        """Return the times of the pulses, (pulse,) float64, seconds from the first pulse."""
        return np.arange(flight.pulses) / self.waveform.prf_hz


def draw_campaign(specification: CampaignSpecification, generator: Generator) -> DrawnCampaign:
    """Draw the code symbols and the wobble of each track, each from its own random stream."""
    tracks = {(flight.name, node): (flight, node) for flight in specification.flights for node in flight.tracks}
    codes, *streams = independent_streams(generator, 1 + len(tracks))
    trajectories = {}
    for (key, (flight, node)), stream in zip(tracks.items(), streams, strict=True):
        track = flight.tracks[node]
        path, duration_s = track.intended(), (flight.pulses - 1) / specification.waveform.prf_hz
        trajectories[key] = path if track.wobble is None else track.wobble.around(path, duration_s, stream)
    return DrawnCampaign(specification, specification.waveform.drawn(codes), trajectories)
