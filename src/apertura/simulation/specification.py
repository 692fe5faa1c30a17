"""A campaign before it is simulated: the values that a YAML specification holds, and what is drawn of them first."""

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
from apertura.simulation.targets import GaussianBeam, Origin, Target, Track, Trajectory, Vector
from apertura.simulation.waveform import TransmittedSpecification, TransmitWaveform

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.]*$")]


@dataclass(frozen=True, config=STRICT_KEYS)
class SimulatedNode:
    """One UAV: what it carries, how it logs, and what is wrong with it."""

    lever_arms_m: Mapping[AntennaPoint, Vector] = Field(
        default_factory=dict, description="forward, right, down from the logged point to each antenna, m; missing: zero"
    )
    path_offset_m: Mapping[ChannelName, float] = Field(
        default_factory=dict, description="true electrical path beyond geometry as receiver, m; missing: zero"
    )
    stated_path_offset_m: Mapping[ChannelName, float] | None = Field(
        default=None, description="what the config says instead; null: the truth"
    )
    attitude: Literal["log", "course", "none"] = Field(default="log", description="what the config says of attitude")
    log_format: Literal["csv", "pos", "pos_utc"] = Field(
        default="csv", description="csv with attitude, pos (RTKLIB in GPST) or pos_utc"
    )
    log_rate_hz: float = Field(default=10.0, gt=0, description="epochs of the log per second, Hz")
    position_std_m: float | None = Field(
        default=None, gt=0, description="what the config says of the log's errors, per axis, m; null: nothing"
    )
    impairments: Impairments = Field(default=Impairments(), description="what is wrong with it")
    radio: Radio | None = Field(
        default=None,
        description="power, gains and receiver: amplitudes of targets are then roots of their cross-sections in m²",
    )
    antennas: Mapping[RadarPoint, GaussianBeam] = Field(
        default_factory=dict, description="beams of the radar antennas; missing: the same in all directions"
    )


def _utc_text(value: Any) -> Any:
    """Return a time that YAML has read as one as ISO 8601 again, in UTC and without saying so."""
    if not isinstance(value, datetime):
        return value
    return (value.astimezone(UTC) if value.tzinfo else value).replace(tzinfo=None).isoformat()


@dataclass(frozen=True, config=STRICT_KEYS)
class SimulatedFlight:
    """One line of flights.tsv, and what flies."""

    name: Name = Field(description="as in flights.tsv")
    transmitter: str = Field(description="node that transmits, and receives as the others do")
    tracks: Mapping[Name, Track] = Field(min_length=1, description="track of each node that records, by its name")
    pulses: int = Field(gt=0, description="number of pulses")
    start_utc: Annotated[
        str, BeforeValidator(_utc_text), Field(pattern=r"^\d{4}-\d\d-\d\d(T\d\d:\d\d(:[\d.]+)?)?$")
    ] = Field(default="2025-05-14T09:30:00", description="UTC of the first pulse, ISO 8601")
    kind: Literal["image", "calibration", "bench"] = Field(default="image", description="as in flights.tsv")
    framing: Framing | None = Field(default=None, description="preamble and frame counter; null: no frame numbers")
    first_frame: int = Field(default=0, ge=0, description="number of the first frame")
    continuous: bool = Field(default=False, description="recorders run through instead of being triggered")
    targets: tuple[Target, ...] | None = Field(default=None, description="what stands there in this flight only")
    segments: Mapping[str, tuple[tuple[float, float], ...]] = Field(
        default_factory=dict,
        description="pair → start and end of what images it, s after the first pulse; missing: all",
    )

    @model_validator(mode="after")
    def _transmitter_flies(self) -> Self:
        if self.transmitter not in self.tracks:
            raise ValueError(f"transmitter {self.transmitter!r} has no track; tracks are of {', '.join(self.tracks)}")
        return self


@dataclass(frozen=True, config=STRICT_KEYS)
class ImageGrid:
    """The `scene` section of the config."""

    crs: str = Field(pattern=r"^EPSG:\d+$", description="projected CRS, EPSG:…")
    half_width_m: float | None = Field(
        default=None, gt=0, description="half the width of a square about the origin, m, instead of bounds_m"
    )
    bounds_m: tuple[float, float, float, float] | Literal["auto"] = Field(
        default="auto", description="outer pixel edges, m"
    )
    spacing_m: float | Literal["auto"] = Field(default="auto", description="pixel spacing, m, or auto")
    height_m: float | None = Field(default=None, description="ellipsoidal height, m; null: that of the origin")

    @model_validator(mode="after")
    def _square_has_a_spacing(self) -> Self:
        if self.half_width_m is not None and (self.spacing_m == "auto" or self.bounds_m != "auto"):
            raise ValueError("half_width_m needs spacing_m in metres, and no bounds_m")
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
    """Everything that, with the seed, decides the bytes of a simulated campaign."""

    campaign: str = Field(description="name of the campaign")
    origin: Origin = Field(description="where east, north and up are counted from")
    waveform: TransmittedSpecification = Field(description="what is transmitted")
    targets: tuple[Target, ...] = Field(description="what stands in the scene")
    nodes: Mapping[Name, SimulatedNode] = Field(min_length=1, description="one section per UAV")
    flights: tuple[SimulatedFlight, ...] = Field(description="who flies what, one after the other")
    scene: ImageGrid = Field(description="the grid on which the campaign is imaged")
    atmosphere: Literal["standard", "vacuum"] | Annotated[float, Field(ge=0, le=LARGEST_REFRACTIVITY)] = Field(
        default="standard",
        description="air that all paths fly through: standard, at the origin's height, 50 % humidity; vacuum; or the "
        "refractivity at the origin, (n - 1)·10⁶, which the config then states; it thins with height",
    )
    bench: Mapping[str, float | bool] = Field(
        default_factory=dict, description="what the config says of the set-up of flights of kind bench, as it has it"
    )
    synthesis: Literal["exact", "periodic"] = Field(
        default="exact",
        description="true edges of every echo, or fast, for long flights: as if echoes did not begin or end",
    )

    @property
    def air(self) -> TrueAir | None:
        """True air between positions in ECEF; None: vacuum."""
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
        stated = [name for name, node in self.nodes.items() if node.radio is not None]
        if stated and len(stated) < len(self.nodes):
            raise ValueError(f"radio is stated of {', '.join(stated)} alone: state it of every node, or of none")
        noisy = [name for name in stated if self.nodes[name].impairments.radar_snr_db is not None]
        if noisy:
            raise ValueError(f"{noisy[0]} has a radio, with noise by noise_figure_db, and radar_snr_db as well")
        return self

    @model_validator(mode="after")
    def _nodes_fly(self) -> Self:
        flown = {name for flight in self.flights for name in flight.tracks}
        if flown != set(self.nodes):
            raise ValueError(f"nodes are {', '.join(sorted(self.nodes))}, but tracks are of {', '.join(sorted(flown))}")
        once = self.waveform.kind == "samples"
        if once and (
            self.synthesis == "periodic" or any(flight.continuous or flight.framing for flight in self.flights)
        ):
            raise ValueError("a pulse that is sent once needs synthesis: exact, and neither framing nor continuous")
        if not self.flights or len({flight.name for flight in self.flights}) < len(self.flights):
            raise ValueError("flights must be one or more, each with a name of its own")
        return self


def read_specification(path: Path) -> CampaignSpecification:
    """Return the specification in a YAML file.

    Raises
    ------
    CampaignError
        If it is not there, or with every key that is wrong and the nearest valid one.
    """
    remedy = "`apertura simulate --print-spec demo` prints one to start from."
    document = read_yaml(path, expected="a YAML specification of a simulation", remedy=remedy)
    expected = "keys and values such as `apertura simulate --print-spec demo` prints"
    return validated(CampaignSpecification, document, where=path, expected=expected)


def specification_text(specification: CampaignSpecification) -> str:
    """Return a specification as YAML, without what is at its default; `read_specification` reads it back exactly."""
    return yaml.safe_dump(_plain(specification), sort_keys=False, default_flow_style=None, width=120)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        fields: dict[str, FieldInfo] = type(value).__pydantic_fields__  # type: ignore[union-attr]
        own = {name: getattr(value, name) for name in fields}
        # keyword-only: `kind`, which says to a reader of YAML what the rest is
        return {
            name: _plain(own[name])
            for name, field in sorted(fields.items(), key=lambda item: not item[1].kw_only)
            if field.kw_only or own[name] != field.get_default(call_default_factory=True)
        }
    if isinstance(value, Mapping):
        return {key: _plain(own) for key, own in value.items()}
    if isinstance(value, tuple):
        return [_plain(own) for own in value]
    if isinstance(value, complex):
        return str(value) if value.imag else value.real
    return value


@dataclasses.dataclass(frozen=True)
class DrawnCampaign:
    """A specification with its code symbols and trajectories, (flight, node) → how the node flies, drawn."""

    specification: CampaignSpecification
    waveform: TransmitWaveform
    trajectories: Mapping[tuple[str, str], Trajectory]

    def pulse_times(self, flight: SimulatedFlight) -> Floats:
        """Return (pulse,) float64, seconds from the first pulse."""
        return np.arange(flight.pulses) / self.waveform.prf_hz


def draw_campaign(specification: CampaignSpecification, generator: Generator) -> DrawnCampaign:
    """Draw code symbols, then the wobble of each track in order, each from its own stream."""
    tracks = {(flight.name, node): (flight, node) for flight in specification.flights for node in flight.tracks}
    codes, *streams = independent_streams(generator, 1 + len(tracks))
    trajectories = {}
    for (key, (flight, node)), stream in zip(tracks.items(), streams, strict=True):
        track = flight.tracks[node]
        path, duration_s = track.intended(), (flight.pulses - 1) / specification.waveform.prf_hz
        trajectories[key] = path if track.wobble is None else track.wobble.around(path, duration_s, stream)
    return DrawnCampaign(specification, specification.waveform.drawn(codes), trajectories)
