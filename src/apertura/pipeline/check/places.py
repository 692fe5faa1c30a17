"""Whether scene and nodes lie where waves reach."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Times
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import geodetic_from_ecef
from apertura.pipeline.check.hints import likely_place
from apertura.pipeline.check.inspected import Inspected, Key
from apertura.pipeline.check.tags import paired, span
from apertura.pipeline.config import CONFIG, Flight, LeverArms, SampledWaveform

_TAGS = 256  # of a pair at which distances are taken
_POINTS = 9  # along each side of the scene
_CURVATURE = 0.99  # of a straight path: ground under a scene of unknown height bends away from the track
_MOSTLY = 0.9  # of the distance: then it is one of heights
_CHECK = (
    "Check scene.crs and scene.bounds_m (easting before northing), the place in the logs, waveform.{key} and "
    "nodes.<node>.path_offset_m."
)
_HORIZON_M = 4.12e3
"""Radio horizon over a smooth Earth with refraction, metres per square root of the height in metres."""

_LEAST_HEIGHT_M = 1000.0  # at which nodes are taken to be at least: heights count from the ellipsoid, not the ground


def check_nodes_apart(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield nodes of one flight between whose logs no wave goes straight: the Earth is between them."""
    for flight in inspected.campaign.flights if inspected.waveform else ():
        for node in flight.nodes:
            key, other = (flight.name, flight.transmitter), (flight.name, node)
            if node == flight.transmitter or not {key, other} <= inspected.geodetic.keys():
                continue
            places = [np.median(inspected.tracks[one].position.values, axis=0) for one in (key, other)]
            heights = [float(np.median(inspected.geodetic[one][:, 2])) for one in (key, other)]
            apart_m = float(np.linalg.norm(places[0] - places[1]))
            horizon_m = _HORIZON_M * sum(np.sqrt(max(height, _LEAST_HEIGHT_M)) for height in heights)
            if apart_m > horizon_m:
                (a, b), (c, d) = (np.median(inspected.geodetic[one][:, :2], axis=0) for one in (key, other))
                yield CampaignError(
                    f"{apart_m / 1e3:.0f} km from {flight.transmitter}: latitude {c:.4f}, longitude {d:.4f} and "
                    f"latitude {a:.4f}, longitude {b:.4f}",
                    where=inspected.campaign.track_file(*other),
                    expected=f"nodes in sight of each other, at most {horizon_m / 1e3:.0f} km apart",
                    remedy="Check latitude and longitude of both logs (not swapped, signs, degrees), and their flight.",
                )


def check_distance(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield image flights from which no echo of the scene arrives inside the cyclic prefix of any pulse."""
    waveform = inspected.waveform
    if waveform is None or inspected.grid is None:
        return
    for flight in inspected.campaign.image_flights:
        pairs = [(node, _reach(inspected, flight, node, waveform)) for node in flight.nodes]
        far = [(f"{flight.transmitter}-{node}", *found) for node, found in pairs if found and found[1] > found[2]]
        if not far:
            continue
        _, distance_m, path_m, limit_m = min(far, key=lambda row: row[2])
        yield CampaignError(
            f"the scene lies {_length(distance_m)} from the track of {flight.name} {', '.join(row[0] for row in far)}: "
            f"no echo travels less than {_length(path_m)}",
            where=f"{CONFIG}: scene",
            expected=f"a total path of at most {_length(limit_m)}, what waveform.{waveform.delay_key} holds",
            remedy=_too_high(inspected, distance_m) or likely_place(inspected) or _CHECK.format(key=waveform.delay_key),
        )


def _too_high(inspected: Inspected, distance_m: float) -> str:
    """Return what to correct where it is the height that keeps scene and track apart; else ''."""
    if inspected.middle_m is None or inspected.ground is None or inspected.ground.dem:
        return ""
    above_m = float(geodetic_from_ecef(inspected.middle_m)[2]) - inspected.level_m
    if abs(above_m) < _MOSTLY * distance_m:
        return ""
    return (
        f"The track is {above_m:.0f} m above the ground: check heights in the logs (metres, not feet, above the "
        "ellipsoid) and scene.height_m."
    )


def _reach(
    inspected: Inspected, flight: Flight, node: str, waveform: SampledWaveform
) -> tuple[float, float, float] | None:
    """Return distance from track to scene, shortest total path and the longest that the prefix holds, metres.

    The first two are never longer, the last is never shorter than any pulse's.
    """
    aperture, grid = pair_aperture(inspected, flight, node, waveform), inspected.grid
    if aperture is None or grid is None:
        return None
    points, radius_m = scene_points(inspected)
    tx_m, rx_m = aperture.legs
    steps_m = sum(float(np.linalg.norm(np.diff(leg, axis=0), axis=1).max(initial=0.0)) for leg in aperture.legs)
    paths = aperture.path(points).min() * _CURVATURE - 2 * radius_m - steps_m
    distance_m = max(0.0, float(np.linalg.norm(points - tx_m[:, None], axis=-1).min()) - radius_m)
    stated = inspected.campaign.settings.nodes[node].path_offset_m
    beyond_m = stated.radar
    if node != flight.transmitter:
        beyond_m -= stated.sidelink + float(np.linalg.norm(tx_m - rx_m, axis=1).max())
    arms = [inspected.campaign.settings.nodes[name].lever_arms_m for name in (flight.transmitter, node)]
    arms_m = sum(float(np.linalg.norm(list(point), axis=1).max()) for point in (_points(arm) for arm in arms))
    calibration = inspected.campaign.settings.calibration
    search_m = calibration.search_m if calibration else 0.0
    return distance_m, float(paths), SPEED_OF_LIGHT_M_S * waveform.longest_delay_s - beyond_m + 2 * arms_m + search_m


def _points(arms: LeverArms) -> list[tuple[float, float, float]]:
    return [arms.radar_tx, arms.radar_rx, arms.sidelink]


def pair_aperture(inspected: Inspected, flight: Flight, node: str, waveform: SampledWaveform) -> Aperture | None:
    """Return where the logs put both nodes of a pair at some of its pulses, lever arms left out; None without logs."""
    key, other = (flight.name, flight.transmitter), (flight.name, node)
    if not {key, other} <= inspected.tracks.keys() & inspected.recordings.keys():
        return None
    times = paired(inspected.recordings[key], inspected.recordings[other], waveform.prf_hz)
    if not times.size:
        first, last = (time.astype("datetime64[ns]").astype(np.int64) for time in span(inspected.recordings[key]))
        times = np.linspace(first, last, _TAGS).astype(np.int64).astype("datetime64[ns]")
    times = times[np.unique(np.linspace(0, len(times) - 1, _TAGS).astype(int))]
    return Aperture(*(_positions(inspected, one, times) for one in (key, other)))


def _positions(inspected: Inspected, key: Key, times: Times) -> NDArray[np.float64]:
    """Return (time, 3) float64 ECEF positions of a log, straight between epochs."""
    track = inspected.tracks[key]
    start, second = track.time.values[0], np.timedelta64(1, "s")
    at, epochs = (times - start) / second, (track.time.values - start) / second
    return np.stack([np.interp(at, epochs, axis) for axis in track.position.values.T], axis=-1)


def scene_points(inspected: Inspected) -> tuple[NDArray[np.float64], float]:
    """Return (point, 3) float64 positions (m) on the scene, and the radius (m) about them that holds all its pixels.

    Where the ground's height is not one number, they lie as high as the track: so no other ground is nearer to it.
    """
    grid = inspected.grid
    if grid is None:
        raise ValueError("no grid")
    points = grid.sample_points(_POINTS, inspected.level_m).reshape(-1, 3)
    side_m = max(grid.shape) * grid.spacing_m / (_POINTS - 1)
    return points, float(np.hypot(side_m, side_m) / 2)


def _length(metres: float) -> str:
    return f"{metres / 1e3:.0f} km" if metres >= 1e4 else f"{metres:.1f} m"
