"""Opened flight plan: antenna positions at each pulse, pairs, grid and terrain."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config import CONFIG, FmcwWaveform, SampledWaveform, check_interferometry
from apertura.campaign.folder import Campaign
from apertura.common.arrays import Floats
from apertura.common.confined import ConfinedPath
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import (
    LOCAL,
    LOCAL_NED,
    ecef_from_geodetic,
    frame_from_map,
    map_from_frame,
    ned_axes,
)
from apertura.core.geometry.sector import TAPER
from apertura.core.scene.auto_grid import utm_crs
from apertura.core.scene.clearance import check_antennas
from apertura.core.scene.geoid import geoid_file, undulation
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import GridHeights
from apertura.formats.phase_histories.fmcw import sweep_of
from apertura.formats.tracks.missions import read_mission
from apertura.formats.tracks.track import FIXES, make_track
from apertura.simulation.targets import Straight, Wobble
from apertura.stages.node_log import NodeLog, shortest_wave
from apertura.stages.pair import OpenPair, expected_pair
from apertura.stages.planning import integration_of
from apertura.stages.scene import ConfiguredGround, Flown, OpenScene, settled
from apertura.stages.transmitted import transmitted
from apertura.tools.design.flight_plan import (
    BesideTrack,
    CircleTrack,
    FlightPlan,
    LineTrack,
    MissionTrack,
    Moved,
    PlannedFlight,
    RacetrackTrack,
)

LEAD_S = 2.0
"""Extension of a track before and after its imaged part, seconds, so that the spline covers every pulse."""

_START = np.datetime64("2025-01-01T12:00:00", "ns")  # start time of every plan; results do not depend on it
_CORNER_S = 0.5  # standard deviation of the smoothing of mission corners: multirotors do not turn instantaneously
_TURN_S = 4.0  # length of the Bézier handles of a turn between two legs, seconds of flight
_TURN_POINTS = 33
_ARC_S = 0.05  # interval between points of a circle
_MOST_EPOCHS = 2_000_000
_MOST_PULSES = 5_000_000
_IMAGED_POINTS = 65  # points per leg that represent a track in the computation of a common displacement
_RADIAL = 0.25  # tracks surround the scene if |mean offset| / mean distance from the scene centre is below this ratio
_SEED = 31  # seed of the random deviation from the track: the same plan gives the same results


@dataclass(frozen=True, eq=False)
class Course:
    """Planned course of a node.

    Attributes
    ----------
    time_s
        (epoch,) float64, seconds from the first pulse, extended at both ends by `LEAD_S`.
    place_m
        (epoch, 3) float64: easting, northing, height above the ellipsoid (z in a local frame), metres.
    imaged_s
        Start and end of each imaged part, seconds.
    home_m
        (3,) float64, coordinates as in `place_m`: take-off and landing point of a mission; None without such a point.
    transit_m_s
        Horizontal speed between home and the track.
    """

    time_s: Floats
    place_m: Floats
    imaged_s: tuple[tuple[float, float], ...]
    home_m: Floats | None = None
    transit_m_s: float = math.inf

    def imaged_legs_m(self) -> list[Floats]:
        """Return evenly spread positions on each imaged leg, (point, 3) float64 metres."""
        times = [np.linspace(*span, _IMAGED_POINTS) for span in self.imaged_s]
        return [np.stack([np.interp(time_s, self.time_s, axis) for axis in self.place_m.T], -1) for time_s in times]

    @property
    def imaged_m(self) -> float:
        """Length of the imaged part, metres."""
        return float(sum(np.linalg.norm(np.diff(leg, axis=0), axis=1).sum() for leg in self.imaged_legs_m()))

    @property
    def length_s(self) -> float:
        """Duration from the first pulse to the end of the flight, seconds."""
        return float(self.time_s[-1]) - LEAD_S

    def transfer_s(self, climb_m_s: float) -> float:
        """Return the duration of take-off, transit from and to home, and landing, seconds; 0 without a home."""
        if self.home_m is None:
            return 0.0
        ends = [[np.interp(end_s, self.time_s, axis) for axis in self.place_m.T] for end_s in (0.0, self.length_s)]
        from_home_m = np.array(ends) - self.home_m
        horizontal_s = np.linalg.norm(from_home_m[:, :2], axis=1).sum() / self.transit_m_s
        return float(horizontal_s + np.abs(from_home_m[:, 2]).sum() / climb_m_s)


@dataclass(frozen=True, eq=False)
class OpenPlan:
    """Flight plan with the pipeline's inputs that are available before a recording.

    Attributes
    ----------
    plan
        The flight plan.
    campaign
        Settings and flights; its root is the plan's folder.
    scene
        Grid and terrain.
    pairs
        Pairs of all flights.
    courses
        Flight → node → planned course.
    """

    plan: FlightPlan
    campaign: Campaign
    scene: OpenScene
    pairs: tuple[OpenPair, ...]
    courses: Mapping[str, Mapping[str, Course]]

    def coarse(self, count: int) -> "OpenPlan":
        """Return the plan on a grid of `count` pixels along the longer side, with the integration of the fine grid."""
        processing = self.campaign.settings.processing
        if processing.integration == "auto":
            first = {pair.flight: pair for pair in reversed(self.pairs)}
            sectors = [integration_of(self.campaign, pair, self.scene).sector for pair in first.values()]
            spacing_m = self.scene.grid.spacing_m * (1 + TAPER)
            integration: Any = {"integration": {"resolution_m": spacing_m} if any(sectors) else "all"}
            processing = type(processing).model_validate(processing.model_dump(exclude_unset=True) | integration)
        settings = self.campaign.settings.model_copy(update={"processing": processing})
        grid, terrain = self.scene.grid.coarse(count), self.scene.terrain
        if isinstance(terrain, GridHeights):
            terrain = GridHeights(grid, terrain.heights(grid))
        scene = replace(self.scene, grid=grid, terrain=terrain)
        return replace(self, campaign=replace(self.campaign, settings=settings), scene=scene)


def open_plan(plan: FlightPlan, root: Path) -> OpenPlan:
    """Open a flight plan.

    Parameters
    ----------
    plan
        The flight plan.
    root
        Folder of the files named in the plan.

    Raises
    ------
    CampaignError
        If a track passes below the terrain or beyond the DEM, nodes come too close to each other, or no pulse is sent.
    """
    with errors_of_the_plan():
        return _opened(plan, Campaign(ConfinedPath.at(root), plan.settings, plan.image_flights, planned=True))


@contextmanager
def errors_of_the_plan() -> Iterator[None]:
    """Convert errors of campaign checks into errors of the plan, which contains the keys of the config."""
    try:
        yield
    except CampaignError as error:
        where, expected, remedy = (
            part.replace(str(CONFIG), "the plan").replace("the flight log", "the planned track")
            for part in (error.where, error.expected, error.remedy)
        )
        raise CampaignError(error.found, where, expected, remedy) from None


def _opened(plan: FlightPlan, campaign: Campaign) -> OpenPlan:
    campaign.check_radio()
    images = [f"{flight.name}/{pair}" for flight in campaign.flights for pair in flight.pairs]
    check_interferometry(campaign.settings.interferometry, images, where=Path("the plan"))
    crs = _crs(plan, campaign)
    ground = ConfiguredGround.of(campaign.settings.scene, campaign.height_files(), crs=crs)
    courses = {name: _courses(plan, campaign, name, ground) for name in plan.flights}
    courses = _displaced(courses, plan)
    for name, planned in plan.flights.items():
        _check_separation(name, planned, courses[name])
    frequency_hz, delay_s, prf_hz = _radar(campaign)
    pairs = []
    for flight in campaign.flights:
        flown = plan.flights[flight.name]
        times = _pulses(courses[flight.name][flight.transmitter], prf_hz, where=f"flights.{flight.name}")
        logs = {
            name: _log(campaign, (flight.name, name), flown, course, (crs, shortest_wave(frequency_hz)))
            for name, course in courses[flight.name].items()
        }
        for node in flight.nodes:
            legs = logs[flight.transmitter], logs[node]
            pair = expected_pair(campaign, flight.name, legs, times, frequency_hz=frequency_hz, delay_s=delay_s)
            spline = {
                leg: {"interpolation_m": log.checked.interpolation_m}
                for leg, log in zip(("tx", "rx"), legs, strict=True)
            }
            pairs.append(replace(pair, report={"positions": spline}))
    first = [pair.flown for pair in pairs if pair.flight == campaign.flights[0].name]
    grid, configured, chosen = settled(campaign, lambda: Flown.together(first))
    level = configured.level(grid)
    terrain = level if configured.dem is None else GridHeights(grid, _heights(configured, grid))
    scene = OpenScene(grid, level, terrain, (), configured.inputs, chosen)
    for pair in pairs:
        check_antennas(grid, terrain, pair.aperture, where=f"flight {pair.flight}, pair {pair.name}")
    return OpenPlan(plan, campaign, scene, tuple(pairs), courses)


def _radar(campaign: Campaign) -> tuple[NDArray[np.float64], float, float]:
    """Return the frequencies of the band, the longest delay of completely recorded echoes, and the pulse rate."""
    waveform = campaign.settings.waveform
    if isinstance(waveform, SampledWaveform):
        frequency_hz = transmitted(campaign, waveform).numerology.frequency_hz
        if np.ptp(frequency_hz) > frequency_hz.mean():  # twice the fractional bandwidth of the widest UWB radars
            raise CampaignError(
                f"carrier_hz {waveform.carrier_hz:g} with a bandwidth of {np.ptp(frequency_hz):.4g} Hz",
                "the plan: waveform",
                "a bandwidth below the centre frequency; frequencies in Hz",
                "Give carrier_hz in Hz, for example 1.3e+9 for 1.3 GHz.",
            )
        return frequency_hz, waveform.longest_delay_s, waveform.prf_hz
    if isinstance(waveform, FmcwWaveform) and waveform.prf_hz is not None:
        sweep = sweep_of(waveform.model_dump())
        return sweep.frequency_hz, sweep.path_limit_m / SPEED_OF_LIGHT_M_S, waveform.prf_hz
    raise CampaignError(
        f"a waveform of kind {waveform.kind}" + (" without prf_hz" if isinstance(waveform, FmcwWaveform) else ""),
        "the plan: waveform",
        "ofdm, samples, or fmcw with its prf_hz",
        "Configure the transmitted waveform.",
    )


def _heights(ground: ConfiguredGround, grid: SceneGrid) -> Floats:
    """Return the heights of a DEM at every pixel."""
    if ground.dem is None:
        raise TypeError("flat ground")
    heights = ground.dem.heights(grid)
    voids = int((~np.isfinite(heights)).sum())
    if voids:
        raise CampaignError(
            f"no height at {voids} of {heights.size} pixels of the scene",
            ground.dem.path,
            "a DEM without voids in the scene",
            "Fill the voids, or make scene.bounds_m smaller.",
        )
    return heights


def _crs(plan: FlightPlan, campaign: Campaign) -> str:
    if plan.scene.crs != "auto":
        return plan.scene.crs
    track = next(
        track for flight in plan.flights.values() for track in flight.tracks.values() if isinstance(track, MissionTrack)
    )
    latitude, longitude, height = read_mission(campaign.file(track.file, "flights")).place.T
    return utm_crs(ecef_from_geodetic(latitude, longitude, height).mean(axis=0))  # in ECEF: longitudes jump at 180°


# ---- Courses of nodes -----------------------------------------------------------------------------------------------


def _courses(plan: FlightPlan, campaign: Campaign, name: str, ground: ConfiguredGround) -> dict[str, Course]:
    """Return the planned course of each node of a flight, without the displacement `moved`."""
    flight = plan.flights[name]
    if plan.scene.bounds_m == "auto":
        level_m = ground.flat_m
    else:  # mean terrain height of the scene
        xmin, ymin, xmax, ymax = plan.scene.bounds_m
        side_m = min(xmax - xmin, ymax - ymin) / 33
        grid = SceneGrid.from_bounds(ground.crs, plan.scene.bounds_m, spacing_m=side_m)
        level_m = ground.level(grid).height_m
    tracks = dict(flight.tracks)
    if flight.formation is not None:
        followers = [node for node in flight.participants if node not in tracks]
        for node, (ahead, right, up) in zip(followers, flight.formation.offsets(len(followers)), strict=True):
            of = flight.formation.leader
            tracks[node] = BesideTrack(kind="beside", of=of, ahead_m=ahead, right_m=right, up_m=up)
    courses = dict[str, Course]()
    for node, track in sorted(tracks.items(), key=lambda item: isinstance(item[1], BesideTrack)):
        where = f"flights.{name}.tracks.{node}"
        if isinstance(track, BesideTrack):
            courses[node] = _follower(courses[track.of], track, plan.moved.spacing)
        elif isinstance(track, MissionTrack):
            courses[node] = _mission(track, campaign, flight, ground, where)
        else:
            time_s, position, imaged = _vertices(track)
            course = _sampled(time_s, position, imaged, flight.log_rate_hz, where)
            constant = level_m if track.above == "ground" else 0.0
            base = (
                _terrain_below(ground, course.place_m[:, :2], course.time_s) if track.above == "terrain" else constant
            )
            courses[node] = replace(course, place_m=course.place_m + np.multiply.outer(base, [0.0, 0.0, 1.0]))
    return courses


def _terrain_below(ground: ConfiguredGround, place_m: Floats, time_s: Floats) -> Floats:
    """Return the terrain height below positions, sampled once a second and interpolated linearly."""
    if ground.dem is None:
        return np.full(len(place_m), ground.height_at(*map(float, place_m[0])))
    every = max(1, round(1 / np.diff(time_s).mean()))
    sampled = np.unique(np.append(np.arange(0, len(place_m), every), len(place_m) - 1))
    heights = [ground.height_at(*map(float, place_m[index])) for index in sampled]
    return np.interp(time_s, time_s[sampled], heights)


_Vertices = tuple[Floats, Floats, tuple[tuple[float, float], ...]]


def _vertices(track: LineTrack | RacetrackTrack | CircleTrack) -> _Vertices:
    """Return times and positions of a track's vertices, and its imaged parts; heights relative to `above`."""
    if isinstance(track, CircleTrack):
        length_s = float(np.radians(abs(track.turn_deg))) * track.radius_m / track.speed_m_s
        time_s = np.linspace(-LEAD_S, length_s + LEAD_S, 2 + int((length_s + 2 * LEAD_S) / _ARC_S))
        turn_sign = np.sign(track.turn_deg) or 1.0
        azimuth = np.radians(track.start_deg) + turn_sign * time_s * track.speed_m_s / track.radius_m
        centre = np.array([*track.centre_m, track.height_m])
        radial = np.stack([np.sin(azimuth), np.cos(azimuth), np.zeros(len(time_s))], -1)
        return time_s, centre + track.radius_m * radial, ((0.0, length_s),)
    first, last = (np.array([*end, track.height_m]) for end in (track.start_m, track.end_m))
    if isinstance(track, LineTrack):
        return *_timed([first, last], track.speed_m_s), ((0.0, float(np.linalg.norm(last - first)) / track.speed_m_s),)
    along = (last - first) / np.linalg.norm(last - first)
    step = np.array([along[1], -along[0], 0.0]) * track.spacing_m + [0.0, 0.0, track.climb_m]
    vertices, ends = [first, last], [0, 1]
    for leg in range(1, track.legs):
        begin, end = (first, last) if leg % 2 == 0 else (last, first)
        turn = _turn(vertices[-1], begin + leg * step, along if leg % 2 else -along, track.speed_m_s)
        vertices += [*turn, end + leg * step]
        ends += [len(vertices) - 2, len(vertices) - 1]
    time_s, position = _timed(vertices, track.speed_m_s)
    return (
        time_s,
        position,
        tuple((float(time_s[a]), float(time_s[b])) for a, b in zip(ends[::2], ends[1::2], strict=True)),
    )


def _turn(begin: Floats, end: Floats, along: Floats, speed_m_s: float) -> list[Floats]:
    """Return points of a turn that starts in a direction and ends in the opposite direction: a cubic Bézier curve."""
    handle = along * max(_TURN_S * speed_m_s, float(np.linalg.norm(end - begin)))
    share = np.linspace(0, 1, _TURN_POINTS)[1:, None]
    corners = begin, begin + handle, end + handle, end
    weights = (1 - share) ** 3, 3 * share * (1 - share) ** 2, 3 * share**2 * (1 - share), share**3
    return list(np.sum([weight * corner for weight, corner in zip(weights, corners, strict=True)], axis=0))


def _timed(vertices: list[Floats], speed_m_s: float) -> tuple[Floats, Floats]:
    steps = [np.linalg.norm(b - a) for a, b in pairwise(vertices)]
    return np.concatenate([[0.0], np.cumsum(steps)]) / speed_m_s, np.array(vertices)


def _sampled(
    time_s: Floats, place_m: Floats, imaged_s: tuple[tuple[float, float], ...], rate_hz: float, where: str
) -> Course:
    """Return a course at the epochs of a log, extrapolated linearly at both ends."""
    length_s = float(imaged_s[-1][1] if time_s[0] < 0 else time_s[-1])
    if (length_s + 2 * LEAD_S) * rate_hz > _MOST_EPOCHS:
        longest_s = _MOST_EPOCHS / rate_hz - 2 * LEAD_S
        expected = f"at most {longest_s:.4g} s at {rate_hz:g} Hz (log_rate_hz)"
        raise CampaignError(f"{length_s:.4g} s of flight", where, expected, "Increase the speed, or shorten the track.")
    epochs = np.arange(int((length_s + 2 * LEAD_S) * rate_hz) + 2) / rate_hz - LEAD_S
    if time_s[0] >= 0:
        ends = [
            place_m[end] + 2 * LEAD_S * (place_m[end] - place_m[inner]) / abs(time_s[end] - time_s[inner])
            for end, inner in ((0, 1), (-1, -2))
        ]
        time_s = np.concatenate([[time_s[0] - 2 * LEAD_S], time_s, [time_s[-1] + 2 * LEAD_S]])
        place_m = np.concatenate([[ends[0]], place_m, [ends[1]]])
    return Course(epochs, np.stack([np.interp(epochs, time_s, axis) for axis in place_m.T], -1), imaged_s)


def _mission(
    track: MissionTrack, campaign: Campaign, flight: PlannedFlight, ground: ConfiguredGround, where: str
) -> Course:
    """Return the course of a mission: straight lines between waypoints, with rounded corners."""
    from scipy.ndimage import gaussian_filter1d

    path = campaign.file(track.file, where)
    mission = read_mission(path)
    if ground.crs == LOCAL:
        remedy = "Set scene.crs to an EPSG code, or to auto."
        raise CampaignError("a mission in a local frame", where, "a georeferenced scene.crs", remedy)
    speed = mission.speed_m_s if track.speed_m_s is None else np.full(len(mission.place), track.speed_m_s)
    if not (speed[1:] > 0).all():
        remedy = f"Set {where}.speed_m_s."
        raise CampaignError("no speed", path, f"a speed in the mission, or {where}.speed_m_s", remedy)
    latitude, longitude, height = mission.place.T
    flat = map_from_frame(ground.crs, ecef_from_geodetic(latitude, longitude, np.zeros(len(height))))[:, :2]
    home = mission.home_deg or (float(latitude[0]), float(longitude[0]))
    base: Floats
    home_m = map_from_frame(ground.crs, ecef_from_geodetic(*(np.array(coordinate) for coordinate in (*home, 0.0))))
    if mission.reference == "home":
        base = np.full(len(flat), ground.height_at(float(home_m[0]), float(home_m[1])))
    elif mission.reference == "ground":
        base = np.array([ground.height_at(float(x), float(y)) for x, y in flat])
    elif mission.reference == "sea":
        grid = geoid_file("egm96", campaign.height_files().get("geoid"))
        base = undulation(grid, longitude, latitude)
    else:
        base = np.zeros(len(flat))
    waypoints = np.column_stack([flat, height + base])
    steps = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    is_distinct = np.concatenate([[True], steps > 1e-3])
    waypoints, steps, speed = waypoints[is_distinct], steps[is_distinct[1:]], speed[is_distinct]
    if len(waypoints) < 2:
        found, remedy = "all waypoints at the same point", "Export the mission again."
        raise CampaignError(found, path, "a mission with at least two different waypoints", remedy)
    time_s = np.concatenate([[0.0], np.cumsum(steps / speed[1:])])
    first, last = track.image or (1, len(waypoints))
    if not 1 <= first < last <= len(waypoints):
        expected = f"first and last of the waypoints 1 to {len(waypoints)}"
        raise CampaignError(f"image: [{first}, {last}]", where, expected, "Correct the numbers of the waypoints.")
    imaged = ((float(time_s[first - 1]), float(time_s[last - 1])),)
    course = _sampled(time_s, waypoints, imaged, flight.log_rate_hz, where)
    if mission.reference == "home" and mission.home_deg is not None:
        landed_m = np.array([home_m[0], home_m[1], base[0]])
        course = replace(course, home_m=landed_m, transit_m_s=float(np.median(speed[1:])))
    if len(waypoints) == 2:
        return course
    rounded = gaussian_filter1d(course.place_m - waypoints[0], _CORNER_S * flight.log_rate_hz, axis=0, mode="nearest")
    return replace(course, place_m=rounded + waypoints[0])


def _follower(leader: Course, track: BesideTrack, spacing: float) -> Course:
    velocity = np.gradient(leader.place_m, leader.time_s, axis=0)[:, :2]
    ahead = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9)
    right = np.stack([ahead[:, 1], -ahead[:, 0]], -1)
    horizontal = spacing * (ahead * track.ahead_m + right * track.right_m)
    up = np.full((len(horizontal), 1), spacing * track.up_m)
    return replace(leader, place_m=leader.place_m + np.hstack([horizontal, up]))


def _displaced(courses: dict[str, dict[str, Course]], plan: FlightPlan) -> dict[str, dict[str, Course]]:
    """Return courses with the common displacement of the plan: rotated, displaced from the scene centre, and raised."""
    moved = plan.moved
    if moved.model_copy(update={"spacing": 1.0}) == Moved():
        return courses
    every = [leg[:, :2] for nodes in courses.values() for course in nodes.values() for leg in course.imaged_legs_m()]
    if plan.scene.bounds_m == "auto":
        middle = np.concatenate(every).mean(axis=0)
    else:
        xmin, ymin, xmax, ymax = plan.scene.bounds_m
        middle = np.array([xmin + xmax, ymin + ymax]) / 2
    cosine, sine = np.cos(np.radians(moved.heading_deg)), np.sin(np.radians(moved.heading_deg))
    rotation = np.array([[cosine, -sine], [sine, cosine]])  # of row vectors, clockwise
    result = {}
    for name, nodes in courses.items():
        away = np.concatenate([leg for course in nodes.values() for leg in course.imaged_legs_m()])[:, :2] - middle
        mean, far_m = away.mean(axis=0), float(np.linalg.norm(away, axis=1).mean())
        # tracks that surround the scene are scaled about its centre, others are translated
        surrounds = float(np.linalg.norm(mean)) < _RADIAL * far_m
        shift = np.zeros(2) if surrounds else moved.offset_m * mean / np.linalg.norm(mean)
        scale = max(1 + moved.offset_m / far_m, 0.1) if surrounds else 1.0
        result[name] = {
            node: replace(
                course,
                place_m=np.column_stack(
                    [
                        middle + ((course.place_m[:, :2] - middle) * scale + shift) @ rotation,
                        course.place_m[:, 2] + moved.height_m,
                    ]
                ),
            )
            for node, course in nodes.items()
        }
    return result


def _check_separation(name: str, flight: PlannedFlight, courses: Mapping[str, Course]) -> None:
    """Raise CampaignError if the separation of two nodes falls below the minimum."""
    for first, second in combinations(courses, 2):
        length = min(len(courses[first].time_s), len(courses[second].time_s))
        separation_m = np.linalg.norm(courses[first].place_m[:length] - courses[second].place_m[:length], axis=1)
        nearest = int(separation_m.argmin())
        if separation_m[nearest] < flight.separation_m:
            nearest_s = courses[first].time_s[nearest]
            raise CampaignError(
                f"separation of {first} and {second} falls to {separation_m[nearest]:.2f} m at {nearest_s:.1f} s",
                f"flights.{name}",
                f"at least {flight.separation_m:g} m between any two nodes (separation_m)",
                "Increase the separation of these nodes, or reduce separation_m.",
            )


# ---- Pulses and logs of a plan --------------------------------------------------------------------------------------


_Frame = tuple[str, float]  # CRS of the map, and the shortest wavelength, m


def _pulses(course: Course, prf_hz: float, *, where: str) -> NDArray[np.datetime64]:
    """Return the times of the imaged pulses."""
    parts = [begin + np.arange(int((end - begin) * prf_hz + 1e-9) + 1) / prf_hz for begin, end in course.imaged_s]
    time_s = np.concatenate(parts)
    if not 2 <= len(time_s) <= _MOST_PULSES:
        expected = f"2 to {_MOST_PULSES} pulses in a flight"
        raise CampaignError(f"{len(time_s)} pulses", where, expected, "Correct speed, length or waveform.prf_hz.")
    return np.asarray(_START + np.round(time_s * 1e9).astype("timedelta64[ns]"))


def _log(campaign: Campaign, at: tuple[str, str], flight: PlannedFlight, course: Course, frame: _Frame) -> NodeLog:
    """Simulate the log of a node: its course with the wobble; `at` contains flight and node."""
    (name, node), (crs, wave_m) = at, frame
    local = crs == LOCAL
    place, attitude = course.place_m, np.zeros_like(course.place_m)
    if flight.wobble is not None:
        wobble = Wobble(**flight.wobble.model_dump())
        stationary = Straight((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        generator = np.random.default_rng([_SEED, *f"{name}/{node}".encode()])
        deviation = wobble.around(stationary, course.length_s, generator)
        place, attitude = place + deviation.position(course.time_s), deviation.attitude(course.time_s)
    position = frame_from_map(crs, *place.T)
    intended = frame_from_map(crs, *course.place_m.T)
    axes = np.broadcast_to(LOCAL_NED, (len(place), 3, 3)) if local else ned_axes(intended)
    velocity = np.einsum("nad,na->nd", axes, np.gradient(intended, course.time_s, axis=0))
    attitude[:, 2] += np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    attitude_deg = np.degrees(attitude)
    attitude_deg[:, 2] = (attitude_deg[:, 2] + 180) % 360 - 180
    track = make_track(
        _START + np.round(course.time_s * 1e9).astype("timedelta64[ns]"),
        position,
        frame="local" if local else "ecef",
        attitude_deg=attitude_deg,
        fix=np.full(len(place), FIXES[flight.solution], np.int8),
        node=node,
        where=Path(f"flights.{name}.tracks.{node}"),
    )
    return NodeLog(node, campaign.node(name, node), track, f"flights.{name}.tracks.{node}", wave_m)
