"""Flight plan: config keys of a future campaign, planned tracks, expected targets and requirements."""

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

    speed_m_s: Positive = Field(description="ground speed, m/s")
    height_m: float = Field(description="height above the reference `above`, m")
    above: Above = Field(
        "ground",
        description="reference of height_m: ground (mean terrain height of the scene), terrain (terrain below each "
        "point) or ellipsoid",
    )


class _Leg(_Track):
    """Straight track between two points."""

    start_m: Place = Field(description="start of the first leg: easting, northing in scene.crs, m")
    end_m: Place = Field(description="end of the first leg, m")

    @model_validator(mode="after")
    def _goes_somewhere(self) -> Self:
        if self.start_m == self.end_m:
            raise ValueError("start_m and end_m are identical: a hover gives no image")
        return self


class LineTrack(_Leg):
    """Straight line."""

    kind: Literal["line"]


class RacetrackTrack(_Leg):
    """Parallel legs in alternating directions; turns between them are flown but not imaged."""

    kind: Literal["racetrack"]
    legs: int = Field(2, ge=1, le=_MOST_LEGS, description="number of legs, alternating in direction")
    spacing_m: float = Field(
        0.0, description="offset of each leg to the right of the previous leg, as seen along the first leg, m"
    )
    climb_m: float = Field(0.0, description="height of each leg above the previous leg, m")


class CircleTrack(_Track):
    """Arc around a point."""

    kind: Literal["circle"]
    centre_m: Place = Field(description="easting, northing in scene.crs, m")
    radius_m: Positive = Field(description="m")
    start_deg: float = Field(0.0, description="azimuth of the start, clockwise from north as seen from the centre, deg")
    turn_deg: float = Field(360.0, description="angle of the arc, clockwise; negative: anticlockwise, deg")


class MissionTrack(Section):
    """Mission file of a ground station."""

    kind: Literal["mission"]
    file: str = Field(description="path relative to the plan: .plan, .waypoints, .kml or .csv")
    speed_m_s: Positive | None = Field(None, description="ground speed, m/s; null: speed of the mission")
    image: tuple[int, int] | None = Field(
        None, description="first and last waypoint of the imaged part, counted from 1; null: all waypoints"
    )


class BesideTrack(Section):
    """Track at constant offsets from another node, relative to its course."""

    kind: Literal["beside"]
    of: Name = Field(description="node that this node follows")
    ahead_m: float = Field(0.0, description="offset ahead of that node, along its course, m")
    right_m: float = Field(0.0, description="offset to the right of that node, m")
    up_m: float = Field(0.0, description="offset above that node, m")


PlannedTrack = Annotated[
    LineTrack | RacetrackTrack | CircleTrack | MissionTrack | BesideTrack, Field(discriminator="kind")
]


class FormationSettings(Section):
    """Positions of nodes without a track of their own: equally spaced behind, to the right of or above the leader."""

    shape: Literal["column", "row", "vee", "stack"] = Field(
        description="column: in line behind the leader; row: to the right; vee: behind, alternately right and left; "
        "stack: above"
    )
    leader: Name = Field(description="node with a track of its own")
    spacing_m: Positive = Field(description="distance between neighbouring nodes, m; for a vee, along both axes")

    def offsets(self, followers: int) -> list[tuple[float, float, float]]:
        """Return the offsets (ahead, right, up) of each follower from the leader, metres.

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
    """Smooth random deviation from the planned track, such as the residual of a position controller in wind."""

    sigma_m: tuple[float, float, float] = Field(
        (0.03, 0.05, 0.04), description="standard deviation east, north and up, m"
    )
    attitude_sigma_deg: tuple[float, float, float] = Field(
        (2.0, 2.0, 3.0), description="standard deviation of roll, pitch and yaw, deg"
    )
    smoothing_s: Positive = Field(1.0, description="standard deviation of the smoothing Gaussian, s")


class PlannedFlight(Section):
    """A row of flights.tsv, with planned tracks."""

    transmitter: Name = Field(description="node that transmits")
    receivers: tuple[Name, ...] = Field(min_length=1, description="nodes that receive, one pair each")
    tracks: dict[Name, PlannedTrack] = Field(
        min_length=1, description="node → line, racetrack, circle, mission, beside"
    )
    formation: FormationSettings | None = Field(
        None, description="formation of nodes without a track; null: every node has a track"
    )
    separation_m: float = Field(2.0, ge=0, description="minimum distance between any two nodes, m")
    climb_m_s: Positive = Field(
        2.0, description="vertical speed of take-off and landing, m/s, for flight_s of a mission with a home"
    )
    wobble: WobbleSettings | None = Field(None, description="deviation from the planned track due to wind; null: none")
    log_rate_hz: Positive = Field(10.0, description="epoch rate of the flight logs, Hz")
    solution: Literal["fix", "float", "single"] = Field(
        "fix",
        description="GNSS solution of the receivers, which gives the position accuracy if nodes.<n>.position_std_m "
        "is null",
    )

    @property
    def participants(self) -> tuple[str, ...]:
        """Nodes of the flight."""
        return tuple(dict.fromkeys((self.transmitter, *self.receivers)))


class ExpectedScene(Section):
    """Reference targets for the predicted SNR."""

    sigma0_db: float | None = Field(
        -15.0, description="backscattering coefficient of the terrain, dB; null: not computed"
    )
    rcs_dbsm: float | None = Field(
        0.0, description="radar cross-section of a point target, dB re 1 m²; null: not computed"
    )


class Requirements(Section):
    """Requirements for 95 % of the visible scene; null: no requirement."""

    resolution_m: Positive | None = Field(
        None, description="maximum −3 dB width of a point in its coarsest direction, m"
    )
    nesz_db: float | None = Field(None, description="maximum noise-equivalent σ⁰, dB")
    snr_db: float | None = Field(None, description="minimum SNR of terrain with expect.sigma0_db, dB")
    point_snr_db: float | None = Field(None, description="minimum SNR of a point with expect.rcs_dbsm, dB")
    coverage: Annotated[float, Field(gt=0, le=1)] | None = Field(
        None,
        description="minimum visible fraction of the scene: no shadow or layover, within the recorded range window",
    )
    loss_db: Annotated[float, Field(ge=0)] | None = Field(
        None, description="maximum peak loss of a point due to all expected errors, dB"
    )
    ambiguity: Positive | None = Field(
        None, description="maximum power of ambiguous echoes of the scene, relative to the echo of the pixel"
    )
    coherence: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        None, description="minimum coherence of the image pairs in interferometry.pairs"
    )
    flight_s: Positive | None = Field(None, description="maximum flight time of a flight, s")
    recorded_gb: Positive | None = Field(None, description="maximum recorded data volume, all nodes and flights, GB")


Range = tuple[float, float]


class Moved(Section):
    """Common displacement of the planned tracks; result of `--optimise`."""

    height_m: float = Field(0.0, description="upward displacement, m")
    offset_m: float = Field(0.0, description="displacement away from the scene centre, m")
    spacing: float = Field(1.0, gt=0, description="factor of the separations between nodes")
    heading_deg: float = Field(0.0, description="rotation about the scene centre, clockwise, deg")


class Bounds(Section):
    """Bounds of the search by `--optimise`: minimum and maximum of each key of `moved`."""

    height_m: Range = Field((-20.0, 40.0), description="m")
    offset_m: Range = Field((-20.0, 40.0), description="m")
    spacing: Range = Field((0.5, 4.0), description="factor")
    heading_deg: Range = Field((-90.0, 90.0), description="deg")

    @model_validator(mode="after")
    def _rise(self) -> Self:
        for name in type(self).model_fields:
            low, high = getattr(self, name)
            if low >= high:
                raise ValueError(f"{name}=[{low:g}, {high:g}]: the minimum must precede the maximum")
        if self.spacing[0] <= 0:
            raise ValueError(f"spacing={list(self.spacing)}: factors must be positive")
        return self


class FlightPlan(Settings):
    """PLAN.yaml: the keys of config/config.yaml, planned flights, expected targets and requirements."""

    flights: dict[Name, PlannedFlight] = Field(min_length=1, description="flights to be imaged")
    expect: ExpectedScene = Field(default_factory=ExpectedScene, description="reference targets for the predicted SNR")
    require: Requirements = Field(default_factory=Requirements, description="requirements of the images and the flight")
    moved: Moved = Field(default_factory=Moved, description="displacement of the planned tracks")
    bounds: Bounds = Field(default_factory=Bounds, description="bounds of the search by --optimise")

    @property
    def settings(self) -> Settings:
        """Config of the later campaign."""
        return Settings.model_validate({name: getattr(self, name) for name in Settings.model_fields})

    @property
    def document(self) -> dict[str, Any]:
        """Config of the later campaign as plain values, without defaults."""
        return self.settings.model_dump(mode="json", exclude_unset=True)

    @property
    def image_flights(self) -> tuple[Flight, ...]:
        """Rows of flights.tsv."""
        return tuple(
            Flight(name, "image", flight.transmitter, flight.receivers) for name, flight in self.flights.items()
        )

    @model_validator(mode="after")
    def _nodes_fly(self) -> Self:
        for name, flight in self.flights.items():
            unknown = [node for node in (*flight.participants, *flight.tracks) if node not in self.nodes]
            if unknown:
                raise ValueError(f"flights.{name}: node {unknown[0]!r} is not one of nodes: {', '.join(self.nodes)}")
            if len(set(flight.receivers)) < len(flight.receivers):
                raise ValueError(f"flights.{name}: receivers {', '.join(flight.receivers)} contain a duplicate")
            without = [node for node in flight.participants if node not in flight.tracks]
            if without and flight.formation is None:
                raise ValueError(f"flights.{name}: {without[0]} has no track, and there is no formation")
            self._check_leaders(name, flight)
        if self.scene.crs == "auto" and any(
            not isinstance(track, MissionTrack | BesideTrack)
            for flight in self.flights.values()
            for track in flight.tracks.values()
        ):
            raise ValueError("scene.crs is auto, but track coordinates require a CRS: set scene.crs")
        return self

    @staticmethod
    def _check_leaders(name: str, flight: PlannedFlight) -> None:
        followed = {node: track.of for node, track in flight.tracks.items() if isinstance(track, BesideTrack)}
        if flight.formation is not None:
            followed["formation.leader"] = flight.formation.leader
        for node, leader in followed.items():
            if leader not in flight.tracks or leader in followed:
                raise ValueError(f"flights.{name}: {node} follows {leader}, but {leader} has no track of its own")


def read_flight_plan(path: Path) -> FlightPlan:
    """Read a flight plan from a YAML file.

    Raises
    ------
    CampaignError
        If the file is missing or not YAML, or has invalid keys, which are listed with the nearest valid ones.
    """
    remedy = "docs/howto/design.md contains an example."
    if path.suffix.lower() in {".plan", ".waypoints", ".kml"}:
        raise CampaignError(
            "a mission, not a flight plan",
            where=path,
            expected="a plan in YAML, which contains radar, nodes and scene in addition to tracks",
            remedy=f"Write a plan with the track {{kind: mission, file: {path.name}}}; {remedy}",
        )
    document = read_yaml(path, expected="a flight plan in YAML", remedy=remedy)
    return documents.validated(FlightPlan, document, where=path, expected="keys of a flight plan, docs/howto/design.md")
