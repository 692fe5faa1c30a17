"""Check the scene's CRS, reference points and DEM against the location of the tracks."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from apertura.campaign.config import CONFIG
from apertura.check.examination import Examination
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import LOCAL, ecef_from_geodetic, geodetic_from_ecef, projected_from_ecef
from apertura.core.scene.auto_grid import utm_crs
from apertura.core.scene.dem import Dem
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.map_crs import check_crs, horizontal_crs

_WHERE = f"{CONFIG}: scene.crs"
_FAR_UP_M = 1000.0  # largest height of a reference point above or below the terrain
TALLEST_M = 500.0
"""Largest height above its surroundings of a real feature narrower than two posts, metres. The limit is raised to
`_STEEPEST_POSTS` post widths if these are larger."""

_NEAR_M = 20e3
"""Largest distance between scene and track, after correction of a mistake, for which the mistake is reported, metres.
"""

_STEEPEST_POSTS = 10.0
_PER_POST = 2  # samples per post
_WINDOW = 7  # window width in samples, i.e. three and a half posts
_MOST_SAMPLES = 1_000_000
_COARSE = 256
_MARGIN = _WINDOW - 1  # width of the margin around the scene in samples, in which no spikes are reported

Place = tuple[float, float]
"""Latitude and longitude, degrees."""

_NOWHERE = (np.nan, np.nan)


def check_scene_crs(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem if the CRS is not in metres, contradicts the positions' frame, or is not valid in the area."""
    crs = examined.campaign.settings.scene.crs
    if examined.other_frame:
        local = crs == LOCAL
        data = "positions on Earth, in latitude and longitude" if local else "positions in metres of a local frame"
        expected = "an EPSG code, or auto" if local else LOCAL
        yield CampaignError(f"CRS {crs} with {data}", where=_WHERE, expected=expected, remedy="Correct scene.crs.")
    elif examined.history_problems:
        return  # the frame of the positions is unknown
    elif crs not in {LOCAL, "auto"} and examined.crs is None:
        yield _not_in_metres(examined, crs)
    elif examined.crs not in {LOCAL, None}:
        yield from _elsewhere(examined, str(examined.crs))


def check_reference_points(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem for each reference point or reflector outside the scene, or far above or below the terrain."""
    grid = examined.grid
    if grid is None:
        return
    scene = examined.campaign.settings.scene
    known = {"reference_points": scene.reference_points, "reflectors": scene.reflectors}
    for key, number, point in ((key, *item) for key, points in known.items() for item in enumerate(points)):
        west, south, east, north = grid.bounds_m
        x, y, height_m = point.position_m
        where, remedy = f"{CONFIG}: scene.{key}[{number}]", "Correct position_m, or remove the point."
        if not (west <= x <= east and south <= y <= north):
            swapped = west <= y <= east and south <= x <= north
            yield CampaignError(
                f"{point.name} at {x:.2f}, {y:.2f} lies outside the scene",
                where=where,
                expected=f"easting {west:.2f} to {east:.2f}, northing {south:.2f} to {north:.2f} in {grid.crs}",
                remedy="State easting before northing." if swapped else remedy,
            )
        elif examined.ground is not None and abs(height_m - examined.level_m) > _FAR_UP_M:
            yield CampaignError(
                f"{point.name} has a height of {height_m:.1f} m",
                where=where,
                expected=f"a height close to the terrain of the scene, about {examined.level_m:.1f} m",
                remedy=f"Heights refer to {'the ellipsoid' if grid.frame == 'ecef' else 'the local frame'}. {remedy}",
            )


def _elsewhere(examined: Examination, crs: str) -> Iterator[CampaignError]:
    """Yield a problem if the bounds, or the track if bounds are automatic, lie outside the area of use of the CRS."""
    bounds = examined.campaign.settings.scene.bounds_m
    if bounds != "auto":
        try:
            check_crs(crs, bounds)
        except CampaignError as problem:
            hint = likely_place(examined)
            yield (
                problem
                if not hint
                else CampaignError(
                    f"bounds_m {list(bounds)} lie outside the area of use of {crs}",
                    where=f"{CONFIG}: scene.bounds_m",
                    expected=f"[xmin, ymin, xmax, ymax], metres in {crs}",
                    remedy=hint,
                )
            )
    elif examined.middle_m is not None:
        east, north = projected_from_ecef(crs, examined.middle_m)[:2].tolist()
        try:
            check_crs(crs, (east - 1, north - 1, east + 1, north + 1))
        except CampaignError:
            zone, name = utm_crs(examined.middle_m), CRS(crs).name
            yield CampaignError(
                f"the track lies outside the area of use of {crs} ({name})",
                where=_WHERE,
                expected="a CRS for the area of the track, such as its UTM zone",
                remedy=f"Set scene.crs to {zone}, or to auto.",
            )


def _not_in_metres(examined: Examination, crs: str) -> CampaignError:
    """Return the problem of a CRS that is not in metres; the remedy contains the suitable UTM zone."""
    try:
        system = horizontal_crs(crs)
    except CampaignError as problem:
        return CampaignError(problem.found, _WHERE, problem.expected, problem.remedy)
    units = {axis.unit_name for axis in system.axis_info} - {"metre"}
    kind = "is in degrees" if system.is_geographic else f"is in {', '.join(sorted(units))}"
    zone = _zone(examined, degrees=system.is_geographic) or "the UTM zone of the scene"
    return CampaignError(
        f"{crs} ({system.name}) {kind if units else 'is not projected'}",
        where=_WHERE,
        expected="a projected CRS in metres",
        remedy=f"Set scene.crs to {zone} and scene.bounds_m to metres in this CRS, or set both to auto.",
    )


def _zone(examined: Examination, *, degrees: bool) -> str:
    """Return the UTM zone of the track, or of bounds in degrees; '' if neither is available."""
    bounds = examined.campaign.settings.scene.bounds_m
    if examined.middle_m is not None:
        return utm_crs(examined.middle_m)
    if not degrees or bounds == "auto" or np.abs(bounds).max() > 180 or np.abs(bounds[1::2]).max() > 90:
        return ""
    longitude, latitude = (np.array((bounds[axis] + bounds[axis + 2]) / 2) for axis in (0, 1))
    return utm_crs(ecef_from_geodetic(latitude, longitude, np.array(0.0)))


def check_dem(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem if the DEM or geoid grid cannot be read, or if heights of the scene are missing or invalid."""
    yield from examined.ground_problems
    dem, grid = examined.ground and examined.ground.dem, examined.grid
    if dem and grid:
        dem.check_cover(grid)


def check_spikes(examined: Examination) -> Iterator[CampaignError]:
    """Yield a problem if the DEM has spikes in the scene, upward or downward.

    Heights are sampled twice per post. A morphological opening with a window of seven samples removes peaks narrower
    than the window and preserves slopes, ridges and cliffs of any height; a closing does the same for pits. A removed
    height is a spike if it exceeds both 500 m and the width of ten posts, i.e. if the slope exceeds 80° on all sides.
    If the scene has more than a million samples, only a million samples around its centre are tested.
    """
    dem, grid = examined.ground and examined.ground.dem, examined.grid
    if not dem or not grid:
        return
    post_m = post_width_m(dem, grid)
    window = sampled_about(grid, post_m / _PER_POST)
    heights = _heights(dem, grid, window)
    spikes = needles(heights, taller_than_m=max(TALLEST_M, _STEEPEST_POSTS * post_m))
    if not spikes.any():
        return
    row, column = np.argwhere(spikes)[0]
    x, y = window.map_at(row, column)
    yield CampaignError(
        f"a height of {heights[row, column]:.0f} m at x {x:.1f}, y {y:.1f}, where the median height of the "
        f"surroundings is {np.nanmedian(heights[max(row - 6, 0) : row + 7, max(column - 6, 0) : column + 7]):.0f} m; "
        f"{int(spikes.sum())} of {spikes.size} samples are such spikes",
        where=dem.path,
        expected=f"no post more than {TALLEST_M:.0f} m and ten post widths above or below all its neighbours",
        remedy="Set these posts to nodata and fill the voids with a GIS.",
    )


def _heights(dem: Dem, grid: SceneGrid, window: SceneGrid) -> NDArray[np.float64]:
    """Return the heights in a window; all NaN if posts of the window outside the scene have invalid heights."""
    try:
        return dem.heights(window)
    except CampaignError:
        dem.heights(grid.coarse(_COARSE))
    return np.full(window.shape, np.nan)


def post_width_m(dem: Dem, grid: SceneGrid) -> float:
    """Return the post spacing of a DEM at the centre of a grid along the axis with the finer spacing, metres."""
    xmin, ymin, xmax, ymax = grid.bounds_m
    x, y = (xmin + xmax) / 2 + np.array([0.0, 1.0, 0.0]), (ymin + ymax) / 2 + np.array([0.0, 0.0, 1.0])
    if grid.crs != LOCAL:
        x, y = Transformer.from_crs(grid.crs, dem.horizontal, always_xy=True).transform(x, y)
    a, b, _, d, e, _ = dem.pixel_from_map
    posts = np.stack([a * x + b * y, d * x + e * y])
    per_metre = np.linalg.norm(posts[:, 1:] - posts[:, :1], axis=0).max()
    return float(1 / per_metre)


def sampled_about(grid: SceneGrid, spacing_m: float) -> SceneGrid:
    """Return a sampling grid with a given spacing that covers a grid with a margin, limited to a million samples."""
    (xmin, ymin, xmax, ymax), most = grid.bounds_m, int(np.sqrt(_MOST_SAMPLES))
    sides = [min(round(side / spacing_m) + 2 * _MARGIN, most) for side in (xmax - xmin, ymax - ymin)]
    west, north = (xmin + xmax - sides[0] * spacing_m) / 2, (ymin + ymax + sides[1] * spacing_m) / 2
    return SceneGrid(grid.crs, west, north, spacing_m, (sides[1], sides[0]))


def needles(heights: NDArray[np.float64], *, taller_than_m: float) -> NDArray[np.bool_]:
    """Return (row, column) bool, True at upward or downward spikes of a surface that are narrower than seven samples.

    Samples closer to a void or the edge than twice the half width of the window are excluded, because their
    surroundings are unknown.

    Examples
    --------
    >>> cliff = np.where(np.arange(40) < 20, 0.0, 3000.0) + np.zeros((40, 1))
    >>> spike = cliff.copy()
    >>> spike[10, 10] = 900.0
    >>> needles(cliff, taller_than_m=500.0).sum(), np.argwhere(needles(spike, taller_than_m=500.0))
    (np.int64(0), array([[10, 10]]))
    """
    with np.errstate(invalid="ignore"):
        up = heights - _over_windows(_over_windows(heights, np.fmin), np.fmax)
        down = _over_windows(_over_windows(heights, np.fmax), np.fmin) - heights
        near = _over_windows(_over_windows(heights, np.maximum), np.maximum)  # NaN near voids and edges
        return np.asarray(((up > taller_than_m) | (down > taller_than_m)) & np.isfinite(near))


def _over_windows(heights: NDArray[np.float64], by: np.ufunc) -> NDArray[np.float64]:
    """Return the extreme value in the window around each sample; samples outside the array are NaN, like voids."""
    half = _WINDOW // 2
    for axis in (0, 1):
        padded = np.pad(
            heights, [(half, half) if dimension == axis else (0, 0) for dimension in (0, 1)], constant_values=np.nan
        )
        parts = [np.take(padded, range(first, first + heights.shape[axis]), axis) for first in range(_WINDOW)]
        heights = by.reduce(parts)
    return heights


def likely_place(examined: Examination) -> str:
    """Return a remedy for a scene far from the track: the correction that brings both together; '' if none does."""
    bounds = examined.campaign.settings.scene.bounds_m
    if bounds == "auto" or examined.middle_m is None or examined.crs is None:
        return ""
    x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    latitude, longitude, _ = map(float, geodetic_from_ecef(examined.middle_m))
    zone, crs = utm_crs(examined.middle_m), str(examined.crs)
    scene, track = _place(crs, x, y), (latitude, longitude)
    degrees = f"The bounds appear to be in degrees: set scene.bounds_m in metres in {crs}."
    mistakes = [  # remedy of each mistake, and the locations of scene and track after its correction
        (degrees, (y, x), track),
        (degrees, (x, y), track),
        ("Set scene.bounds_m with easting before northing: [xmin, ymin, xmax, ymax].", _place(crs, y, x), track),
        (
            f"Check if scene.crs should be {zone}, the UTM zone of the track, instead of {crs}.",
            _place(zone, x, y) if zone != crs else _NOWHERE,
            track,
        ),
        ("Check if latitude and longitude are swapped in the logs.", scene, (longitude, latitude)),
        ("Check the sign of longitude in the logs (east is positive).", scene, (latitude, -longitude)),
        ("Check the sign of latitude in the logs (north is positive).", scene, (-latitude, longitude)),
        ("Check if the logs are in radians.", scene, (float(np.degrees(latitude)), float(np.degrees(longitude)))),
    ]
    return next((sentence for sentence, *places in mistakes if _distance_m(*places) < _NEAR_M), "")


def _place(crs: str, x: float, y: float) -> Place:
    try:
        longitude, latitude = Transformer.from_crs(crs, CRS(crs).geodetic_crs, always_xy=True).transform(x, y)
    except ProjError:
        return _NOWHERE
    return float(latitude), float(longitude)


def _distance_m(*places: Place) -> float:
    """Return the straight-line distance between two locations, metres; inf if a location is not on Earth."""
    if not all(abs(latitude) <= 90 and abs(longitude) <= 180 for latitude, longitude in places):
        return np.inf
    first, second = (ecef_from_geodetic(*(np.array(value) for value in (*place, 0.0))) for place in places)
    return float(np.linalg.norm(first - second))
