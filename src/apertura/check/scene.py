"""Whether the scene's CRS is one that images can lie in, at the place where they were taken."""

from collections.abc import Iterator

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from apertura.check.hints import likely_place
from apertura.check.inspected import Inspected
from apertura.errors import CampaignError
from apertura.geometry.geodesy import LOCAL, ecef_from_geodetic
from apertura.scene.auto_grid import utm_crs
from apertura.scene.map_crs import check_crs
from apertura.settings import CONFIG

_METRE = "metre"
_WHERE = f"{CONFIG}: scene.crs"


def check_scene_crs(inspected: Inspected) -> Iterator[CampaignError]:
    """Yield a CRS that is not projected in metres, is not the frame of the recordings, or is not made for the place."""
    asked = inspected.campaign.settings.scene
    if (asked.crs == LOCAL) is bool(inspected.waveform):
        yield _other_frame(asked.crs)
        return
    if asked.crs in {LOCAL, "auto"} and (asked.crs == LOCAL or asked.bounds_m == "auto"):
        return
    if asked.crs != "auto" and (problem := _not_in_metres(inspected, asked.crs)):
        yield problem
        return
    if inspected.crs is None or asked.bounds_m == "auto":
        return
    try:
        check_crs(inspected.crs, asked.bounds_m)
    except CampaignError as problem:
        hint = likely_place(inspected)
        if not hint:
            raise
        raise CampaignError(
            f"bounds_m {list(asked.bounds_m)} are not in {inspected.crs}",
            where=f"{CONFIG}: scene.bounds_m",
            expected=f"[xmin, ymin, xmax, ymax], metres in {inspected.crs}",
            remedy=hint,
        ) from problem


def _other_frame(crs: str) -> CampaignError:
    local = crs == LOCAL
    data = "recordings whose logs hold latitude and longitude" if local else "phase history in metres of its own frame"
    expected = "an EPSG code, or auto" if local else LOCAL
    return CampaignError(f"{crs} for {data}", where=_WHERE, expected=expected, remedy="Correct scene.crs.")


def _not_in_metres(inspected: Inspected, crs: str) -> CampaignError | None:
    """Return what is wrong with a CRS wherever it is used, with the UTM zone that would do."""
    try:
        system = CRS(crs)
    except CRSError:
        return CampaignError(
            f"{crs!r} is unknown to PROJ",
            where=_WHERE,
            expected="an EPSG code such as EPSG:32632, auto, or local",
            remedy="Correct scene.crs.",
        )
    units = sorted({axis.unit_name for axis in system.axis_info})
    if system.is_projected and units == [_METRE]:
        return None
    kind = "counts in degrees" if system.is_geographic else f"counts in {', '.join(units)}"
    kind = kind if units != [_METRE] else "is not projected"
    zone = _zone(inspected, degrees=system.is_geographic)
    bounds = "and scene.bounds_m in metres of it"
    return CampaignError(
        f"{crs} ({system.name}) {kind}",
        where=_WHERE,
        expected="a projected CRS in metres",
        remedy=f"Set scene.crs to {zone}, the zone of the place, {bounds}; or both to auto."
        if zone
        else f"Set scene.crs to the UTM zone of the place {bounds}; or both to auto.",
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
