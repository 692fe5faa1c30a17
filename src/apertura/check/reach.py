"""Check that nodes, scene and reflector are within range and beams, and that images can be planned."""

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

_TAGS = 256  # of a pair at which distances are taken
_POINTS = 9  # along each side of the scene
_CURVATURE = 0.99  # of a straight path: ground under a scene of unknown height bends away from the track
_LEAST_M = 1e-3  # above the ground: an antenna at its height lies in it at every other pulse
_MOSTLY = 0.9  # of the distance: then it is one of heights
_CHECK = (
    "Check scene.crs and scene.bounds_m (easting before northing), the place in the logs, waveform.{key} and "
    "nodes.<node>.path_offset_m."
)
_HORIZON_M = 4.12e3
"""Radio horizon over a smooth Earth with refraction, metres per square root of the height in metres."""

_LEAST_HEIGHT_M = 1000.0  # at which nodes are taken to be at least: heights count from the ellipsoid, not the ground

HIGHEST_M = 30e3
"""Above the ground of the scene no node flies higher."""

_STILL_M = 0.05  # that the log of a node scatters by while it stands
_SOME_TIME = np.timedelta64(1, "s")  # of a recording that would show whether a node flies

_CALIBRATION = f"{CONFIG}: calibration"


def check_nodes_apart(examined: Examination) -> Iterator[CampaignError]:
    """Yield nodes of one flight between whose logs no wave goes straight: the Earth is between them."""
    for flight in examined.campaign.flights if examined.waveform else ():
        for node in flight.nodes:
            key, other = (flight.name, flight.transmitter), (flight.name, node)
            if node == flight.transmitter or not {key, other} <= examined.logs.keys():
                continue
            logs = [examined.logs[one] for one in (key, other)]
            distance_m = float(np.linalg.norm(logs[0].middle_m - logs[1].middle_m))
            middles = [log.middle_geodetic for log in logs if log.middle_geodetic is not None]
            if len(middles) < 2:
                continue
            horizon_m = _HORIZON_M * sum(np.sqrt(max(height_m, _LEAST_HEIGHT_M)) for *_, height_m in middles)
            if distance_m > horizon_m:
                (a, b, _), (c, d, _) = middles
                yield CampaignError(
                    f"{distance_m / 1e3:.0f} km from {flight.transmitter}: latitude {c:.4f}, longitude {d:.4f} and "
                    f"latitude {a:.4f}, longitude {b:.4f}",
                    where=examined.campaign.track_file(*other),
                    expected=f"nodes in sight of each other, at most {horizon_m / 1e3:.0f} km apart",
                    remedy="Check latitude and longitude of both logs (not swapped, signs, degrees), and their flight.",
                )


def check_distance(examined: Examination) -> Iterator[CampaignError]:
    """Yield image flights from which no echo of the scene arrives inside the cyclic prefix of any pulse."""
    waveform = examined.waveform
    if waveform is None or examined.grid is None:
        return
    for flight in examined.campaign.image_flights:
        pairs = [(node, _reach(examined, flight, node, waveform)) for node in flight.nodes]
        far = [(f"{flight.transmitter}-{node}", *found) for node, found in pairs if found and found[1] > found[2]]
        if not far:
            continue
        _, distance_m, path_m, limit_m = min(far, key=lambda row: row[2])
        yield CampaignError(
            f"the scene lies {_length(distance_m)} from the track of {flight.name} {', '.join(row[0] for row in far)}: "
            f"no echo travels less than {_length(path_m)}",
            where=f"{CONFIG}: scene",
            expected=f"a total path of at most {_length(limit_m)}, what waveform.{waveform.delay_key} holds",
            remedy=_height_remedy(examined, distance_m)
            or likely_place(examined)
            or _CHECK.format(key=waveform.delay_key),
        )


def _height_remedy(examined: Examination, distance_m: float) -> str:
    """Return the remedy where the height keeps scene and track apart; else ''."""
    if examined.middle_m is None or examined.ground is None or examined.ground.dem:
        return ""
    above_m = float(geodetic_from_ecef(examined.middle_m)[2]) - examined.level_m
    if abs(above_m) < _MOSTLY * distance_m:
        return ""
    default = ", which is 0 m, as by default" if examined.campaign.settings.scene.height_is_default else ""
    return (
        f"The track is {above_m:.0f} m above the ground: check heights in the logs (metres, not feet, above the "
        f"ellipsoid) and scene.height_m{default}."
    )


def _reach(
    examined: Examination, flight: Flight, node: str, waveform: SampledWaveform
) -> tuple[float, float, float] | None:
    """Return distance from track to scene, shortest total path and the longest that the prefix holds, metres.

    The first two are never longer, the last is never shorter than any pulse's.
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
    """Return the positions of both nodes of a pair at some of its pulses, without lever arms; None without logs."""
    key, other = (flight.name, flight.transmitter), (flight.name, node)
    if not {key, other} <= examined.tracks.keys() & examined.recordings.keys():
        return None
    times = expected_pulses(examined.recordings[key], examined.recordings[other], waveform.prf_hz)
    times = times[np.unique(np.linspace(0, len(times) - 1, _TAGS).astype(int))]
    return Aperture(*(_positions(examined, one, times) for one in (key, other)))


def _positions(examined: Examination, key: Key, times: Times) -> NDArray[np.float64]:
    """Return (time, 3) float64 ECEF positions of a log, straight between epochs."""
    track = examined.tracks[key]
    epochs = track.time.values
    at_s, epoch_s = seconds_since(times, epochs[0]), seconds_since(epochs, epochs[0])
    return np.stack([np.interp(at_s, epoch_s, axis) for axis in track.position.values.T], axis=-1)


def scene_points(examined: Examination) -> tuple[NDArray[np.float64], float]:
    """Return (point, 3) float64 positions (m) on the scene, and the radius (m) about them that holds all its pixels.

    Where the ground's height is not one number, they lie as high as the track: so no other ground is nearer to it.
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
    """Yield pairs of image flights whose nodes stand still, by their logs, in reach of the scene."""
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
                    f"flight {flight.name}, pair {flight.transmitter}-{node}: no aperture, its nodes moved "
                    f"{100 * moved_m:.2g} cm: is this a bench recording?",
                    where=examined.campaign.root / FLIGHTS,
                    expected=f"a flight past the scene, of more than a wavelength ({100 * wavelength_m:.0f} cm)",
                    remedy="Set its kind to bench and run `apertura bench`, or check the logs of its nodes.",
                )


def check_ground(examined: Examination) -> Iterator[CampaignError]:
    """Yield image flights of which a node is in or below the ground at most pulses, or higher than 30 km above it."""
    waveform, grid, ground = examined.waveform, examined.grid, examined.ground
    if grid is None or ground is None:
        return
    terrain: Terrain = ground.dem or FlatGround(examined.level_m)
    for flight in examined.campaign.image_flights:
        places: dict[str, NDArray[np.float64]] = {}
        for node in flight.nodes:
            if waveform is None:  # pulses carry their times in files that are not read here: all epochs, then
                track = examined.tracks.get((flight.name, node))
                places |= {} if track is None else {node: track.position.values}
                continue
            aperture = pair_aperture(examined, flight, node, waveform)
            places |= dict(zip((flight.transmitter, node), aperture.legs, strict=True)) if aperture else {}
        wrong = {}
        for node, positions in places.items():
            above, below = clearance(grid, terrain, positions)
            known = np.isfinite(above)
            arms = examined.campaign.settings.nodes[node].lever_arms_m
            arm_m = float(np.linalg.norm([arms.radar_tx, arms.radar_rx, arms.sidelink], axis=1).max())
            if known.any() and not _LEAST_M - arm_m < np.median(above[known]) <= HIGHEST_M:
                wrong[node] = (float(np.median(above[known])), float(np.median(below[known])))
        if wrong:
            yield _problem(flight.name, wrong, dem=ground.dem is not None)


def _problem(flight: str, wrong: dict[str, tuple[float, float]], *, dem: bool) -> CampaignError:
    key, source = ("scene.dem", "DEM") if dem else ("scene.height_m", "ground")
    check = "scene.dem (metres, not feet) and scene.dem_datum" if dem else "scene.height_m and scene.height_datum"
    above_m, ground_m = next(iter(wrong.values()))
    return CampaignError(
        f"flight {flight}, {', '.join(wrong)}: {above_m:.1f} m above the ground of the scene at the median of its "
        f"pulses, the log has {above_m + ground_m:.1f} m where the {source} has {ground_m:.1f} m",
        where=f"{CONFIG}: {key}",
        expected=f"a node above the ground, by at most {HIGHEST_M / 1e3:.0f} km",
        remedy=f"Check {check}, and the heights in the flight log (logs may count from the geoid).",
    )


def check_calibration(examined: Examination) -> Iterator[CampaignError]:
    """Yield a calibration flight that is none, pairs that it does not have, a reflector out of reach of the prefix."""
    campaign = examined.campaign
    stated, kinds = campaign.settings.calibration, {flight.name: flight for flight in campaign.flights}
    if stated is None:
        flown = [flight.name for flight in campaign.flights if flight.kind == "calibration"]
        if flown:
            yield CampaignError(
                f"no section calibration, and {FLIGHTS} has flight {flown[0]} of kind calibration",
                where=CONFIG,
                expected="calibration.flight and calibration.reflector_m",
                remedy="Say where the reflector stands, or take the flight out.",
            )
        return
    flight = kinds.get(stated.flight)
    if flight is None or flight.kind != "calibration":
        named = [name for name, one in kinds.items() if one.kind == "calibration"]
        yield CampaignError(
            f"flight {stated.flight} is {'not in the table' if flight is None else 'of kind image'}",
            where=f"{_CALIBRATION}.flight",
            expected=f"a flight of kind calibration in {FLIGHTS}, which has {', '.join(named) or 'none'}",
            remedy="Correct the name or the flight's kind.",
        )
        return
    for image in campaign.image_flights:
        missing = [pair for pair in image.pairs if pair not in flight.pairs]
        if missing:
            yield CampaignError(
                f"flight {image.name} has pairs {', '.join(missing)}, which {flight.name} did not calibrate",
                where=f"{_CALIBRATION}.flight",
                expected=f"the pairs of {flight.name}: {', '.join(flight.pairs)}",
                remedy="Fly the calibration with the same transmitter and nodes, or take out config: calibration.",
            )
    yield from _reflector(examined, flight, stated)


def _reflector(examined: Examination, flight: Flight, stated: CalibrationSettings) -> Iterator[CampaignError]:
    """Yield a reflector from which no echo arrives while a capture lasts."""
    waveform = examined.waveform
    aperture = waveform and pair_aperture(examined, flight, flight.transmitter, waveform)
    if not waveform or not aperture or examined.crs is None:
        return
    place = frame_from_map(examined.crs, *(np.array(value) for value in stated.reflector_m))
    distance_m = float(np.linalg.norm(aperture.tx_m - place, axis=1).min())
    reach_m = SPEED_OF_LIGHT_M_S * waveform.capture_s
    if distance_m > reach_m:
        yield CampaignError(
            f"{list(stated.reflector_m)} is {distance_m / 1e3:.1f} km from the track of {flight.name}",
            where=f"{_CALIBRATION}.reflector_m",
            expected=f"a reflector within {reach_m / 1e3:.1f} km: easting, northing in {examined.crs}, height",
            remedy="Correct reflector_m (easting before northing), or the place in the log.",
        )


def check_patterns(examined: Examination) -> Iterator[CampaignError]:
    """Yield patterns that are none."""
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
    """Raise for a file of measured constants that is none, or holds no pair of the campaign."""
    campaign = examined.campaign
    path = campaign.calibration_file
    if path is None or not path.is_file() or path.stat().st_size == 0:
        return ()
    from apertura.stages.radiometry import check_pairs, read_constants

    check_pairs(read_constants(path), campaign, path)
    return ()


_MOST_PAIRS = 16  # 0.2 s each; what is wrong with others, their own steps say
_MOST_PIXELS = 1_000_000  # of a scene whose heights are read here, 0.5 s; of a larger one by step `terrain`


def check_imaging(examined: Examination) -> Iterator[CampaignError]:
    """Yield the errors that steps `echo`, `scene`, `profile` and `image` would raise for the first pairs."""
    from apertura.stages.planning import job_of, ranges_of

    campaign, problems = examined.campaign, list[CampaignError]()
    pairs, scene = _opened(examined, problems)
    yield from problems
    if scene is None:
        return
    # A calibration flight may find paths to be longer than the config says by as much as it searches for.
    search_m = campaign.settings.calibration.search_m if campaign.settings.calibration else 0.0
    for pair in pairs:
        try:
            ranges_of(campaign, replace(pair, path_limits_m=pair.path_limits_m + search_m), scene)
            if pair.beams is not None:
                job_of(campaign, pair, scene)
        except CampaignError as problem:
            yield problem


def check_plan(examined: Examination) -> Iterator[CampaignError]:
    """Yield choices of the config that overrule the planner where it cannot follow: engines, models, sums of pulses."""
    from apertura.stages.planning import accuracy_of, job_of, plan_job

    campaign, problems = examined.campaign, list[CampaignError]()
    if all(value in (None, "auto", {}) for value in campaign.settings.processing.planned.values()):
        return
    pairs, scene = _opened(examined, problems)
    yield from problems
    if scene is not None:  # of one pair: the config is one for all
        job, accuracy = job_of(campaign, pairs[0], scene), accuracy_of(campaign, pairs[0], scene)
        plan_job(campaign, job, accuracy_db=float(accuracy.value))


def _opened(examined: Examination, problems: list[CampaignError]) -> tuple[list["OpenPair"], "OpenScene | None"]:
    """Return the first pairs as logs and headers have them, and the scene; add why others are not open.

    Of phase history what is small. No scene where it hangs on a flight of which nothing is open, or on a large DEM.
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
    """Return the tags of pulses that surely found a partner; None of phase history, whose pulses are its own."""
    if examined.waveform is None:
        return None
    tx, rx = (examined.recordings[flight.name, node] for node in pair.split("-"))
    return expected_pulses(tx, rx, examined.waveform.prf_hz)
