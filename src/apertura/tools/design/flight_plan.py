"""A flight plan: a campaign before it is flown, in the keys of its config, with tracks that are meant to be flown."""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from apertura.campaign.config.config import Settings
from apertura.campaign.config.flights import Flight
from apertura.campaign.config.section import Name, Section
from apertura.common import documents
from apertura.common.documents import read_yaml
from apertura.common.errors import CampaignError

Positive = Annotated[float, Field(gt=0)]
Place = tuple[float, float]
Above = Literal["ground", "terrain", "ellipsoid"]

_MOST_LEGS = 500


class _Track(Section):
    """Settings shared by tracks that do not follow another node."""

    speed_m_s: Positive = Field(description="over the ground, m/s")
    height_m: float = Field(description="above what `above` says, m")
    above: Above = Field(
        "ground",
        description="what height_m counts from: ground, the scene's mean; terrain, the ground below each point; "
        "ellipsoid",
    )


class _Leg(_Track):
    """Straight track from one place to another."""

    start_m: Place = Field(description="where the first leg begins: easting, northing in scene.crs, m")
    end_m: Place = Field(description="where it ends, m")

    @model_validator(mode="after")
    def _goes_somewhere(self) -> Self:
        if self.start_m == self.end_m:
            raise ValueError("start_m and end_m are one place: a hover makes no image")
        return self


class LineTrack(_Leg):
    """Straight from one place to another."""

    kind: Literal["line"]


class RacetrackTrack(_Leg):
    """There and back on parallel legs; turns between them are flown and not imaged."""

    kind: Literal["racetrack"]
    legs: int = Field(2, ge=1, le=_MOST_LEGS, description="number of legs, every other one flown back")
    spacing_m: float = Field(0.0, description="of a leg to the right of the one before, seen along the first, m")
    climb_m: float = Field(0.0, description="of a leg above the one before, m")


class CircleTrack(_Track):
    """Around a place."""

    kind: Literal["circle"]
    centre_m: Place = Field(description="easting, northing in scene.crs, m")
    radius_m: Positive = Field(description="m")
    start_deg: float = Field(0.0, description="where it begins, clockwise from north seen from the centre, deg")
    turn_deg: float = Field(360.0, description="how far it goes round, clockwise; negative: anticlockwise, deg")


class MissionTrack(Section):
    """A mission as a ground station has it."""

    kind: Literal["mission"]
    file: str = Field(description="beside the plan: .plan, .waypoints, .kml or .csv")
    speed_m_s: Positive | None = Field(None, description="over the ground, m/s; null: as the mission says")
    image: tuple[int, int] | None = Field(
        None, description="first and last waypoint between which pulses make the image, from 1; null: all"
    )


class BesideTrack(Section):
    """Track beside another node, by its course."""

    kind: Literal["beside"]
    of: Name = Field(description="node that it follows")
    ahead_m: float = Field(0.0, description="of that node, along its course, m")
    right_m: float = Field(0.0, description="of that node, m")
    up_m: float = Field(0.0, description="above that node, m")


PlannedTrack = Annotated[
    LineTrack | RacetrackTrack | CircleTrack | MissionTrack | BesideTrack, Field(discriminator="kind")
]


class FormationSettings(Section):
    """Positions of nodes without a track of their own: behind, beside or above the leader, equally separated."""

    shape: Literal["column", "row", "vee", "stack"] = Field(
        description="column: one behind the other; row: to the right; vee: behind, right and left in turn; stack: above"
    )
    leader: Name = Field(description="node with a track of its own")
    spacing_m: Positive = Field(description="between neighbours, m; of a vee in both axes")

    def offsets(self, followers: int) -> list[tuple[float, float, float]]:
        """Return ahead, right and up of the leader for each follower, metres.

        Examples
        --------
        >>> FormationSettings(shape="vee", leader="a", spacing_m=3.0).offsets(3)
        [(-3.0, 3.0, 0.0), (-3.0, -3.0, 0.0), (-6.0, 6.0, 0.0)]
        """
        step, numbers = self.spacing_m, range(1, followers + 1)
        if self.shape == "vee":
            return [(-step * ((n + 1) // 2), step * ((n + 1) // 2) * (1 if n % 2 else -1), 0.0) for n in numbers]
        direction = {"column": (-1.0, 0.0, 0.0), "row": (0.0, 1.0, 0.0), "stack": (0.0, 0.0, 1.0)}[self.shape]
        return [(n * step * direction[0] + 0.0, n * step * direction[1], n * step * direction[2]) for n in numbers]


class WobbleSettings(Section):
    """Smooth random motion about what is meant to be flown, as wind and a position controller leave it."""

    sigma_m: tuple[float, float, float] = Field(
        (0.03, 0.05, 0.04), description="standard deviation east, north and up, m"
    )
    attitude_sigma_deg: tuple[float, float, float] = Field((2.0, 2.0, 3.0), description="of roll, pitch and yaw, deg")
    smoothing_s: Positive = Field(1.0, description="standard deviation of the Gaussian that smooths it, s")


class PlannedFlight(Section):
    """One line of flights.tsv, and what is to be flown."""

    transmitter: Name = Field(description="node that transmits")
    receivers: tuple[Name, ...] = Field(min_length=1, description="nodes that receive: a pair each")
    tracks: dict[Name, PlannedTrack] = Field(
        min_length=1, description="node → line, racetrack, circle, mission, beside"
    )
    formation: FormationSettings | None = Field(
        None, description="where nodes without a track fly; null: every node has one"
    )
    separation_m: float = Field(2.0, ge=0, description="least distance between any two nodes, m")
    climb_m_s: Positive = Field(
        2.0, description="vertical speed of take-off and landing, m/s; counts in flight_s of a mission with a home"
    )
    wobble: WobbleSettings | None = Field(None, description="by wind; null: none")
    log_rate_hz: Positive = Field(10.0, description="epochs of the flight logs per second, Hz")
    solution: Literal["fix", "float", "single"] = Field(
        "fix", description="of the receivers: what positions err by where nodes.<n>.position_std_m is null"
    )

    @property
    def participants(self) -> tuple[str, ...]:
        """Nodes that fly."""
        return tuple(dict.fromkeys((self.transmitter, *self.receivers)))


class ExpectedScene(Section):
    """Reference targets that the predicted SNR is for."""

    sigma0_db: float | None = Field(-15.0, description="backscattering coefficient of the ground, dB; null: not asked")
    rcs_dbsm: float | None = Field(0.0, description="radar cross-section of a point, dB of 1 m²; null: not asked")


class Requirements(Section):
    """Requirements, to be met by 95 % of the visible scene; null: no requirement."""

    resolution_m: Positive | None = Field(None, description="−3 dB width of a point in its coarsest direction, m")
    nesz_db: float | None = Field(None, description="σ⁰ that equals the noise, at most, dB")
    snr_db: float | None = Field(None, description="of ground of expect.sigma0_db, at least, dB")
    point_snr_db: float | None = Field(None, description="of a point of expect.rcs_dbsm, at least, dB")
    coverage: Annotated[float, Field(gt=0, le=1)] | None = Field(
        None, description="share of the scene that is seen, without shadow and layover, before the prefix ends"
    )
    loss_db: Annotated[float, Field(ge=0)] | None = Field(
        None, description="of a point's peak by all expected errors, at most, dB"
    )
    ambiguity: Positive | None = Field(
        None, description="echo of the rest of the scene that folds onto a place, as share of its own, at most"
    )
    coherence: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        None, description="of the images that interferometry.pairs names, at least"
    )
    flight_s: Positive | None = Field(None, description="time in the air of one flight, at most, s")
    recorded_gb: Positive | None = Field(None, description="samples of all nodes and flights, at most, GB")


Range = tuple[float, float]


class Moved(Section):
    """Common displacement of the tracks as drawn; `--optimise` writes its result here."""

    height_m: float = Field(0.0, description="up, m")
    offset_m: float = Field(0.0, description="away from the middle of the scene, m")
    spacing: float = Field(1.0, gt=0, description="factor of separations between nodes")
    heading_deg: float = Field(0.0, description="turned about the middle of the scene, clockwise, deg")


class Bounds(Section):
    """Within what `--optimise` moves tracks: lowest and highest value of each key of `moved`."""

    height_m: Range = Field((-20.0, 40.0), description="m")
    offset_m: Range = Field((-20.0, 40.0), description="m")
    spacing: Range = Field((0.5, 4.0), description="factor")
    heading_deg: Range = Field((-90.0, 90.0), description="deg")

    @model_validator(mode="after")
    def _rise(self) -> Self:
        for name in type(self).model_fields:
            low, high = getattr(self, name)
            if low >= high:
                raise ValueError(f"{name}=[{low:g}, {high:g}]: the lowest value first")
        if self.spacing[0] <= 0:
            raise ValueError(f"spacing={list(self.spacing)}: a factor above 0")
        return self


class FlightPlan(Settings):
    """PLAN.yaml: the keys of config/config.yaml, and what is to be flown, seen and required."""

    flights: dict[Name, PlannedFlight] = Field(min_length=1, description="flights that become images")
    expect: ExpectedScene = Field(default_factory=ExpectedScene, description="what is to be seen")
    require: Requirements = Field(default_factory=Requirements, description="what the flight must give")
    moved: Moved = Field(default_factory=Moved, description="tracks moved from where they are drawn")
    bounds: Bounds = Field(default_factory=Bounds, description="of what --optimise tries")

    @property
    def settings(self) -> Settings:
        """The config of the later campaign."""
        return Settings.model_validate({name: getattr(self, name) for name in Settings.model_fields})

    @property
    def document(self) -> dict[str, Any]:
        """Config of the later campaign as plain values, without what is at its default."""
        return self.settings.model_dump(mode="json", exclude_unset=True)

    @property
    def image_flights(self) -> tuple[Flight, ...]:
        """Lines of flights.tsv."""
        return tuple(
            Flight(name, "image", flight.transmitter, flight.receivers) for name, flight in self.flights.items()
        )

    @model_validator(mode="after")
    def _nodes_fly(self) -> Self:
        for name, flight in self.flights.items():
            unknown = [node for node in (*flight.participants, *flight.tracks) if node not in self.nodes]
            if unknown:
                raise ValueError(f"flights.{name}: node {unknown[0]!r} is not in nodes: {', '.join(self.nodes)}")
            if len(set(flight.receivers)) < len(flight.receivers):
                raise ValueError(f"flights.{name}: receivers {', '.join(flight.receivers)}: each once")
            without = [node for node in flight.participants if node not in flight.tracks]
            if without and flight.formation is None:
                raise ValueError(f"flights.{name}: {without[0]} has no track, and there is no formation")
            self._check_leaders(name, flight)
        if self.scene.crs == "auto" and any(
            not isinstance(track, MissionTrack | BesideTrack)
            for flight in self.flights.values()
            for track in flight.tracks.values()
        ):
            raise ValueError("scene.crs is auto, but places of tracks are in it: give the CRS")
        return self

    @staticmethod
    def _check_leaders(name: str, flight: PlannedFlight) -> None:
        followed = {node: track.of for node, track in flight.tracks.items() if isinstance(track, BesideTrack)}
        if flight.formation is not None:
            followed["formation.leader"] = flight.formation.leader
        for node, leader in followed.items():
            if leader not in flight.tracks or leader in followed:
                raise ValueError(f"flights.{name}: {node} follows {leader}, which needs a track of its own")


def read_flight_plan(path: Path) -> FlightPlan:
    """Return the flight plan in a YAML file.

    Raises
    ------
    CampaignError
        If it is not there, is no YAML, or with every key that is wrong and the nearest valid one.
    """
    remedy = "docs/howto/design.md shows one."
    if path.suffix.lower() in {".plan", ".waypoints", ".kml"}:
        raise CampaignError(
            "a mission, not a flight plan",
            where=path,
            expected="a plan in YAML, which also states radar, nodes and scene",
            remedy=f"Name the mission in its tracks, {{kind: mission, file: {path.name}}}: {remedy}",
        )
    document = read_yaml(path, expected="a flight plan in YAML", remedy=remedy)
    return documents.validated(FlightPlan, document, where=path, expected="keys of a flight plan, docs/howto/design.md")
