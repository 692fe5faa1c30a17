"""Check that nodes, scene and reflector are within range and in the antenna beams, and that images can be planned."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config import (
    CONFIG,
    FLIGHTS,
    CalibrationSettings,
    Flight,
    SampledWaveform,
)
from apertura.check.examination import Examination, Key
from apertura.check.georeferencing import likely_place
from apertura.check.times import expected_pulses, recorded_span
from apertura.common.arrays import Times
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.common.units import seconds_since
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import frame_from_map, geodetic_from_ecef
from apertura.core.scene.clearance import clearance
from apertura.core.scene.terrain import FlatGround, Terrain

if TYPE_CHECKING:
    from apertura.stages.pair import OpenPair
    from apertura.stages.scene import OpenScene

_TAGS = 256  # largest number of time tags of a pair at which distances are computed
_POINTS = 9  # points along each side of the scene
_CURVATURE = 0.99  # factor on path lengths: on the curved Earth, terrain below the track's height may be closer
_LEAST_M = (
    1e-3  # minimum height above the terrain; an antenna at terrain height is below the terrain at half the pulses
)
_MOSTLY = 0.9  # fraction of the distance from which a height difference is reported as the cause of the distance
_CHECK = (
    "Check scene.crs and scene.bounds_m (easting before northing), the positions in the logs, waveform.{key} and "
    "nodes.<node>.path_offset_m."
)
_HORIZON_M = 4.12e3
"""Distance to the radio horizon over a smooth Earth with refraction, metres per square root of the height in metres."""

_LEAST_HEIGHT_M = 1000.0  # minimum height for the horizon, because heights refer to the ellipsoid, not to the terrain

HIGHEST_M = 30e3
"""Largest accepted height of a node above the terrain, metres."""

_STILL_M = 0.05  # largest scatter of the logged positions of a stationary node
_SOME_TIME = np.timedelta64(1, "s")  # duration of the shortest recording in which motion of a node is detectable

_CALIBRATION = f"{CONFIG}: calibration"


def check_nodes_apart(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem for nodes of one flight that are beyond each other's radio horizon, according to their logs."""
    for flight in examined.campaign.flights if examined.waveform else ():
        for node in flight.nodes:
            key, other = (flight.name, flight.transmitter), (flight.name, node)
            if node == flight.transmitter or not {key, other} <= examined.logs.keys():
                continue
            logs = [examined.logs[node_key] for node_key in (key, other)]
            distance_m = float(np.linalg.norm(logs[0].middle_m - logs[1].middle_m))
            middles = [log.middle_geodetic for log in logs if log.middle_geodetic is not None]
            if len(middles) < 2:
                continue
            horizon_m = _HORIZON_M * sum(np.sqrt(max(height_m, _LEAST_HEIGHT_M)) for *_, height_m in middles)
            if distance_m > horizon_m:
                (a, b, _), (c, d, _) = middles
                yield CampaignError(
                    f"the track is {distance_m / 1e3:.0f} km from the track of {flight.transmitter}: latitude {c:.4f}, "
                    f"longitude {d:.4f} and latitude {a:.4f}, longitude {b:.4f}",
                    where=examined.campaign.track_file(*other),
                    expected=f"nodes in line of sight, within a distance of {horizon_m / 1e3:.0f} km",
                    remedy="Check latitude and longitude in both logs (order, signs, unit), and check that both logs "
                    "belong to the same flight.",
                )


def check_distance(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem for each image flight in which all echoes of the scene arrive after the cyclic prefix."""
    waveform = examined.waveform
    if waveform is None or examined.grid is None:
        return
    for flight in examined.campaign.image_flights:
        pairs = [(node, _reach(examined, flight, node, waveform)) for node in flight.nodes]
        far = [(f"{flight.transmitter}-{node}", *reach) for node, reach in pairs if reach and reach[1] > reach[2]]
        if not far:
            continue
        _, distance_m, path_m, limit_m = min(far, key=lambda row: row[2])
        yield CampaignError(
            f"the scene is {_length(distance_m)} from the track of {flight.name} {', '.join(row[0] for row in far)}: "
            f"the shortest total path is {_length(path_m)}",
            where=f"{CONFIG}: scene",
            expected=f"a total path of at most {_length(limit_m)}, the limit set by waveform.{waveform.delay_key}",
            remedy=_height_remedy(examined, distance_m)
            or likely_place(examined)
            or _CHECK.format(key=waveform.delay_key),
        )


def _height_remedy(examined: Examination, distance_m: float) -> str:
    """Return the remedy if the distance between scene and track is mainly a height difference; '' otherwise."""
    if examined.middle_m is None or examined.ground is None or examined.ground.dem:
        return ""
    above_m = float(geodetic_from_ecef(examined.middle_m)[2]) - examined.level_m
    if abs(above_m) < _MOSTLY * distance_m:
        return ""
    default = " (0 m by default)" if examined.campaign.settings.scene.height_is_default else ""
    return (
        f"The track is {above_m:.0f} m above the terrain: check the heights in the logs (metres, not feet, above the "
        f"ellipsoid) and scene.height_m{default}."
    )


def _reach(
    examined: Examination, flight: Flight, node: str, waveform: SampledWaveform
) -> tuple[float, float, float] | None:
    """Return distance from track to scene, shortest total path, and longest total path within the prefix, metres.

    The first two values are lower bounds over all pulses; the last value is an upper bound.
    """
    aperture, grid = pair_aperture(examined, flight, node, waveform), examined.grid
    if aperture is None or grid is None:
        return None
    points, radius_m = scene_points(examined)
    tx_m, rx_m = aperture.legs
    steps_m = sum(float(np.linalg.norm(np.diff(leg, axis=0), axis=1).max(initial=0.0)) for leg in aperture.legs)
    paths = aperture.path(points).min() * _CURVATURE - 2 * radius_m - steps_m
    distance_m = max(0.0, float(np.linalg.norm(points - tx_m[:, None], axis=-1).min()) - radius_m)
    stated = examined.campaign.settings.nodes[node].path_offset_m
    beyond_m = stated.radar
    if node != flight.transmitter:
        beyond_m -= stated.sidelink + float(np.linalg.norm(tx_m - rx_m, axis=1).max())
    arms = [examined.campaign.settings.nodes[name].lever_arms_m for name in (flight.transmitter, node)]
    arms_m = sum(float(np.linalg.norm([arm.radar_tx, arm.radar_rx, arm.sidelink], axis=1).max()) for arm in arms)
    calibration = examined.campaign.settings.calibration
    search_m = calibration.search_m if calibration else 0.0
    return distance_m, float(paths), SPEED_OF_LIGHT_M_S * waveform.longest_delay_s - beyond_m + 2 * arms_m + search_m


def pair_aperture(examined: Examination, flight: Flight, node: str, waveform: SampledWaveform) -> Aperture | None:
    """Return the positions of both nodes of a pair at sampled pulses, without lever arms; None without logs."""
    key, other = (flight.name, flight.transmitter), (flight.name, node)
    if not {key, other} <= examined.tracks.keys() & examined.recordings.keys():
        return None
    times = expected_pulses(examined.recordings[key], examined.recordings[other], waveform.prf_hz)
    times = times[np.unique(np.linspace(0, len(times) - 1, _TAGS).astype(int))]
    return Aperture(*(_positions(examined, node_key, times) for node_key in (key, other)))


def _positions(examined: Examination, key: Key, times: Times) -> NDArray[np.float64]:
    """Return (time, 3) float64 ECEF positions of a log, interpolated linearly between epochs."""
    track = examined.tracks[key]
    epochs = track.time.values
    at_s, epoch_s = seconds_since(times, epochs[0]), seconds_since(epochs, epochs[0])
    return np.stack([np.interp(at_s, epoch_s, axis) for axis in track.position.values.T], axis=-1)


def scene_points(examined: Examination) -> tuple[NDArray[np.float64], float]:
    """Return points of the scene, (point, 3) float64 m, and the radius (m) around each point that covers all pixels.

    With a DEM, the points have the height of the track, so that their distance is a lower bound for any terrain.
    """
    grid = examined.grid
    if grid is None:
        raise ValueError("no grid")
    points = grid.sample_points(_POINTS, examined.level_m).reshape(-1, 3)
    side_m = max(grid.shape) * grid.spacing_m / (_POINTS - 1)
    return points, float(np.hypot(side_m, side_m) / 2)


def _length(metres: float) -> str:
    return f"{metres / 1e3:.0f} km" if metres >= 1e4 else f"{metres:.1f} m"


def check_aperture(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem for each pair within range of the scene whose nodes, according to the logs, do not move."""
    waveform, transmitted = examined.waveform, examined.transmitted
    if waveform is None or transmitted is None:
        return
    wavelength_m = SPEED_OF_LIGHT_M_S / float(transmitted.numerology.frequency_hz.mean())
    for flight in examined.campaign.image_flights:
        for node in flight.nodes:
            aperture, reach = pair_aperture(examined, flight, node, waveform), _reach(examined, flight, node, waveform)
            if aperture is None or (reach and reach[1] > reach[2]):
                continue
            first, last = recorded_span(examined.recordings[flight.name, node])
            if last - first < _SOME_TIME:
                continue
            moved_m = max(float(np.linalg.norm(leg - leg[0], axis=1).max()) for leg in aperture.legs)
            if moved_m < max(wavelength_m, _STILL_M):
                yield CampaignError(
                    f"flight {flight.name}, pair {flight.transmitter}-{node}: no aperture, because the nodes moved by "
                    f"only {100 * moved_m:.2g} cm (possibly a bench recording)",
                    where=examined.campaign.root / FLIGHTS,
                    expected=f"a flight past the scene, longer than a wavelength ({100 * wavelength_m:.0f} cm)",
                    remedy="Set the kind of the flight to bench and run `apertura bench`, or check its flight logs.",
                )


def check_ground(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem for each image flight with a node mostly below the terrain, or more than 30 km above it."""
    waveform, grid, ground = examined.waveform, examined.grid, examined.ground
    if grid is None or ground is None:
        return
    terrain: Terrain = ground.dem or FlatGround(examined.level_m)
    for flight in examined.campaign.image_flights:
        positions_of: dict[str, NDArray[np.float64]] = {}
        for node in flight.nodes:
            if waveform is None:  # use all epochs, because phase histories, which contain the pulse times, are not read
                track = examined.tracks.get((flight.name, node))
                positions_of |= {} if track is None else {node: track.position.values}
                continue
            aperture = pair_aperture(examined, flight, node, waveform)
            positions_of |= dict(zip((flight.transmitter, node), aperture.legs, strict=True)) if aperture else {}
        wrong = {}
        for node, positions in positions_of.items():
            above, below = clearance(grid, terrain, positions)
            known = np.isfinite(above)
            arms = examined.campaign.settings.nodes[node].lever_arms_m
            arm_m = float(np.linalg.norm([arms.radar_tx, arms.radar_rx, arms.sidelink], axis=1).max())
            if known.any() and not _LEAST_M - arm_m < np.median(above[known]) <= HIGHEST_M:
                wrong[node] = (float(np.median(above[known])), float(np.median(below[known])))
        if wrong:
            yield _height_problem(flight.name, wrong, dem=ground.dem is not None)


def _height_problem(flight: str, wrong: dict[str, tuple[float, float]], *, dem: bool) -> CampaignError:
    key, source = ("scene.dem", "DEM") if dem else ("scene.height_m", "ground")
    check = "scene.dem (metres, not feet) and scene.dem_datum" if dem else "scene.height_m and scene.height_datum"
    above_m, ground_m = next(iter(wrong.values()))
    return CampaignError(
        f"flight {flight}, {', '.join(wrong)}: median height above the terrain {above_m:.1f} m (log "
        f"{above_m + ground_m:.1f} m, {source} {ground_m:.1f} m)",
        where=f"{CONFIG}: {key}",
        expected=f"a node at most {HIGHEST_M / 1e3:.0f} km above the terrain, and not below the terrain",
        remedy=f"Check {check}, and the heights in the flight log (which may refer to the geoid).",
    )


def check_calibration(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem if the calibration flight is invalid, lacks required pairs, or has the reflector out of range."""
    campaign = examined.campaign
    settings, flights = campaign.settings.calibration, {flight.name: flight for flight in campaign.flights}
    calibrating = [flight.name for flight in campaign.flights if flight.kind == "calibration"]
    if settings is None:
        if calibrating:
            yield CampaignError(
                f"no section calibration, although flight {calibrating[0]} in {FLIGHTS} is of kind calibration",
                where=CONFIG,
                expected="calibration.flight and calibration.reflector_m",
                remedy="Configure the position of the reflector, or remove the flight.",
            )
        return
    flight = flights.get(settings.flight)
    if flight is None or flight.kind != "calibration":
        yield CampaignError(
            f"flight {settings.flight} is {'not in the table' if flight is None else f'of kind {flight.kind}'}",
            where=f"{_CALIBRATION}.flight",
            expected=f"a flight of kind calibration in {FLIGHTS} ({', '.join(calibrating) or 'none present'})",
            remedy="Correct the name or the flight's kind.",
        )
        return
    for image in campaign.image_flights:
        missing = [pair for pair in image.pairs if pair not in flight.pairs]
        if missing:
            yield CampaignError(
                f"flight {image.name} has pairs {', '.join(missing)}, which are not calibrated by {flight.name}",
                where=f"{_CALIBRATION}.flight",
                expected=f"only pairs that occur in {flight.name}: {', '.join(flight.pairs)}",
                remedy="Repeat the calibration with the same transmitter and nodes, or remove section calibration.",
            )
    yield from _reflector(examined, flight, settings)


def _reflector(examined: Examination, flight: Flight, settings: CalibrationSettings) -> Iterator[CampaignError]:
    """Yield a problem if the echo of the reflector arrives after the end of a capture."""
    waveform = examined.waveform
    aperture = waveform and pair_aperture(examined, flight, flight.transmitter, waveform)
    if not waveform or not aperture or examined.crs is None:
        return
    reflector_m = frame_from_map(examined.crs, *(np.array(value) for value in settings.reflector_m))
    distance_m = float(np.linalg.norm(aperture.tx_m - reflector_m, axis=1).min())
    reach_m = SPEED_OF_LIGHT_M_S * waveform.capture_s
    if distance_m > reach_m:
        yield CampaignError(
            f"reflector {list(settings.reflector_m)} is {distance_m / 1e3:.1f} km from the track of {flight.name}",
            where=f"{_CALIBRATION}.reflector_m",
            expected=f"a reflector within {reach_m / 1e3:.1f} km: easting and northing in {examined.crs}, height",
            remedy="Correct reflector_m (easting before northing), or the positions in the log.",
        )


def check_patterns(examined: Examination) -> Iterator[CampaignError]:
    """Yield the problems of invalid antenna pattern files."""
    campaign = examined.campaign
    pairs = (pair for flight in campaign.image_flights for pair in flight.pairs)
    paths = {path for pair in pairs for path in campaign.pattern_files(pair).values()}
    for path in sorted(paths):
        if not path.is_file() or path.stat().st_size == 0:
            continue
        from apertura.formats.beam_pattern import read_beam_pattern

        try:
            read_beam_pattern(path)
        except CampaignError as problem:
            yield problem


def check_constants(examined: Examination) -> Iterable[CampaignError]:
    """Raise CampaignError if the file of measured constants is invalid, or contains no pair of the campaign."""
    campaign = examined.campaign
    path = campaign.calibration_file
    if path is None or not path.is_file() or path.stat().st_size == 0:
        return ()
    from apertura.stages.radiometry import check_pairs, read_constants

    check_pairs(read_constants(path), campaign, path)
    return ()


_MOST_PAIRS = 16  # number of pairs opened, which takes 0.2 s each; steps report the problems of the other pairs
_MOST_PIXELS = 1_000_000  # pixels of the largest scene whose DEM heights are read here, which takes 0.5 s


def check_imaging(examined: Examination) -> Iterator[CampaignError]:
    """Yield the errors that the steps `echo`, `scene`, `profile` and `image` would raise for the first pairs."""
    from apertura.stages.planning import gated, job_of, ranges_of

    campaign, problems = examined.campaign, list[CampaignError]()
    pairs, scene = _opened(examined, problems)
    yield from problems
    if scene is None:
        return
    # A calibration may increase path offsets by up to its search range.
    search_m = campaign.settings.calibration.search_m if campaign.settings.calibration else 0.0
    for pair in pairs:
        try:
            recorded = gated(campaign, replace(pair, path_limits_m=pair.path_limits_m + search_m), scene)
            ranges_of(campaign, recorded, scene)
            if pair.beams is not None:
                job_of(campaign, recorded, scene)
        except CampaignError as problem:
            yield problem


def check_plan(examined: Examination) -> Iterator[CampaignError]:
    """Yield the problems of configured engine, terrain model or presumming that the planner cannot comply with."""
    from apertura.stages.planning import accuracy_of, job_of, plan_job

    campaign, problems = examined.campaign, list[CampaignError]()
    if all(value in (None, "auto", {}) for value in campaign.settings.processing.planned.values()):
        return
    pairs, scene = _opened(examined, problems)
    yield from problems
    if scene is not None:  # one pair suffices: the configuration applies to all pairs
        job, accuracy = job_of(campaign, pairs[0], scene), accuracy_of(campaign, pairs[0], scene)
        plan_job(campaign, job, accuracy_db=float(accuracy.value))


def _opened(examined: Examination, problems: list[CampaignError]) -> tuple[list["OpenPair"], "OpenScene | None"]:
    """Open the first pairs, from logs and headers, and the scene; append the problems of pairs that cannot be opened.

    Large phase histories are omitted. The scene is None if no pair of the first image flight can be opened, or if the
    grid is too large for reading the DEM.
    """
    from apertura.core.scene.terrain import GridHeights
    from apertura.stages.pair import open_pair
    from apertura.stages.scene import Flown, expected_scene

    flights = examined.campaign.image_flights
    pairs = ((flight, pair) for flight in flights for pair in flight.pairs if examined.opens(flight.name, pair))
    opened = []
    for flight, pair in islice(pairs, _MOST_PAIRS):
        try:
            opened.append(open_pair(examined.campaign, flight.name, pair, recorded=_recorded(examined, flight, pair)))
        except CampaignError as problem:
            problems.append(problem)
    first = [pair.flown for pair in opened if pair.flight == flights[0].name]
    if not first:
        return opened, None
    scene = expected_scene(
        replace(examined.campaign, outdated=frozenset(examined.stale)), lambda: Flown.together(first)
    )
    if examined.campaign.settings.scene.dem is None:
        return opened, scene
    if scene.grid.shape[0] * scene.grid.shape[1] > _MOST_PIXELS:
        return opened, None
    return opened, replace(scene, terrain=GridHeights(scene.grid, scene.terrain.heights(scene.grid)))


def _recorded(examined: Examination, flight: Flight, pair: str) -> Times | None:
    """Return time tags of the pulses recorded by both nodes; None for phase histories, which contain their times."""
    if examined.waveform is None:
        return None
    tx, rx = (examined.recordings[flight.name, node] for node in pair.split("-"))
    return expected_pulses(tx, rx, examined.waveform.prf_hz)
