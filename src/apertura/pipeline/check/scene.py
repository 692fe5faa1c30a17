"""Whether the scene's CRS is one that images can lie in, at the place where they were taken."""

from collections.abc import Iterator

import numpy as np
from pyproj import CRS

from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import LOCAL, ecef_from_geodetic, projected_from_ecef
from apertura.core.scene.auto_grid import utm_crs
from apertura.core.scene.map_crs import check_crs, horizontal_crs
from apertura.pipeline.check.hints import likely_place
from apertura.pipeline.check.inspected import Inspected
from apertura.pipeline.config import CONFIG

_WHERE = f"{CONFIG}: scene.crs"
_FAR_UP_M = 1000.0  # between a point and the ground: heights are known at least so well


def check_scene_crs(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield a CRS that is not projected in metres, is not the frame of the recordings, or is not made for the place."""
    asked = inspected.campaign.settings.scene
    if inspected.other_frame:
        yield _other_frame(asked.crs)
    elif inspected.unread_histories:
        return  # which frame they are in is not known
    elif asked.crs not in {LOCAL, "auto"} and inspected.crs is None:
        yield _not_in_metres(inspected, asked.crs)
    elif inspected.crs not in {LOCAL, None}:
        yield from _elsewhere(inspected, str(inspected.crs))


def check_reference_points(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield each point of known place that lies outside the scene, or so high that it is no height of the ground."""
    grid = inspected.grid
    if grid is None:
        return
    for number, point in enumerate(inspected.campaign.settings.scene.reference_points):
        west, south, east, north = grid.bounds_m
        x, y, height_m = point.position_m
        where, remedy = f"{CONFIG}: scene.reference_points[{number}]", "Correct position_m, or take the point out."
        if not (west <= x <= east and south <= y <= north):
            swapped = west <= y <= east and south <= x <= north
            yield CampaignError(
                f"{point.name} at {x:.2f}, {y:.2f} lies outside the scene",
                where=where,
                expected=f"easting {west:.2f} to {east:.2f}, northing {south:.2f} to {north:.2f} in {grid.crs}",
                remedy="Easting comes before northing." if swapped else remedy,
            )
        elif inspected.ground is not None and abs(height_m - inspected.level_m) > _FAR_UP_M:
            yield CampaignError(
                f"{point.name} is at height {height_m:.1f} m",
                where=where,
                expected=f"a point of the scene, whose ground lies at about {inspected.level_m:.1f} m",
                remedy=f"Heights count from {'the ellipsoid' if grid.frame == 'ecef' else 'the local frame'}. {remedy}",
            )


def _elsewhere(inspected: Inspected, crs: str) -> Iterator[CampaignError]:
    """Yield bounds, or where they are `auto` a track, that lie beyond where the CRS is of use."""
    bounds = inspected.campaign.settings.scene.bounds_m
    if bounds != "auto":
        try:
            check_crs(crs, bounds)
        except CampaignError as problem:
            hint = likely_place(inspected)
            yield (
                problem
                if not hint
                else CampaignError(
                    f"bounds_m {list(bounds)} are not in {crs}",
                    where=f"{CONFIG}: scene.bounds_m",
                    expected=f"[xmin, ymin, xmax, ymax], metres in {crs}",
                    remedy=hint,
                )
            )
    elif inspected.middle_m is not None:
        east, north = projected_from_ecef(crs, inspected.middle_m)[:2].tolist()
        try:
            check_crs(crs, (east - 1, north - 1, east + 1, north + 1))
        except CampaignError:
            zone, name = utm_crs(inspected.middle_m), CRS(crs).name
            yield CampaignError(
                f"{crs} ({name}) is not made for where the track lies",
                where=_WHERE,
                expected="a CRS that is of use there, such as the UTM zone of the place",
                remedy=f"Set scene.crs to {zone}, or to auto.",
            )


def _other_frame(crs: str) -> CampaignError:
    local = crs == LOCAL
    data = "positions on Earth, in latitude and longitude" if local else "positions in metres of a frame of their own"
    expected = "an EPSG code, or auto" if local else LOCAL
    return CampaignError(f"{crs} for {data}", where=_WHERE, expected=expected, remedy="Correct scene.crs.")


def _not_in_metres(inspected: Inspected, crs: str) -> CampaignError:
    """Return what is wrong with a CRS wherever it is used, with the UTM zone that would do."""
    try:
        system = horizontal_crs(crs)
    except CampaignError as problem:
        return CampaignError(problem.found, _WHERE, problem.expected, problem.remedy)
    units = {axis.unit_name for axis in system.axis_info} - {"metre"}
    kind = "counts in degrees" if system.is_geographic else f"counts in {', '.join(sorted(units))}"
    zone = _zone(inspected, degrees=system.is_geographic) or "the UTM zone of the place"
    return CampaignError(
        f"{crs} ({system.name}) {kind if units else 'is not projected'}",
        where=_WHERE,
        expected="a projected CRS in metres",
        remedy=f"Set scene.crs to {zone}, and scene.bounds_m in metres of it; or both to auto.",
    )


def _zone(inspected: Inspected, *, degrees: bool) -> str:
    """Return the UTM zone of the track, or of bounds in degrees; '' where neither is known."""
    bounds = inspected.campaign.settings.scene.bounds_m
    if inspected.middle_m is not None:
        return utm_crs(inspected.middle_m)
    if not degrees or bounds == "auto" or np.abs(bounds).max() > 180 or np.abs(bounds[1::2]).max() > 90:
        return ""
    longitude, latitude = (np.array((bounds[axis] + bounds[axis + 2]) / 2) for axis in (0, 1))
    return utm_crs(ecef_from_geodetic(latitude, longitude, np.array(0.0)))
