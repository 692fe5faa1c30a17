"""Which mistake explains times or places that do not meet."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from apertura.check.examination import Examination
from apertura.common.leap_seconds import LATEST_S
from apertura.core.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from apertura.core.scene.auto_grid import utm_crs

_NEAR_S = 3.0  # logs and recordings of one flight begin and end within a few seconds of each other
_NEAR_ZONE_S = 120.0
_ZONE_S = 1800.0
_LONGEST_ZONE_S = 14 * 3600.0
_NEAR_M = 20e3
"""A scene this close to the track is where it was meant to be, far as a mistake puts it."""

Place = tuple[float, float]
"""Latitude and longitude, degrees."""


def likely_cause(shift: float) -> str:
    """Return which mistake moves times by so many seconds, as the end of a sentence; '' where none comes to mind.

    Examples
    --------
    >>> likely_cause(17.9), likely_cause(-7201.0), likely_cause(400.0)
    (': GPST taken for UTC?', ': local time taken for UTC?', '')
    """
    size = abs(shift)
    if abs(size - LATEST_S) <= _NEAR_S:
        return ": GPST taken for UTC?" if shift > 0 else f": {LATEST_S} s of GPST taken off times in UTC?"
    zones = round(size / _ZONE_S)
    if zones and size <= _LONGEST_ZONE_S + _NEAR_ZONE_S and abs(size - zones * _ZONE_S) <= _NEAR_ZONE_S:
        return ": local time taken for UTC?"
    return ": a log of another day?" if size > 86400 else ""


def likely_place(examined: Examination, *, near_m: float = _NEAR_M) -> str:
    """Return what to correct, as a sentence that names the mistake under which scene and track meet; '' if none does.

    Parameters
    ----------
    examined
        Whose scene has stated bounds and lies elsewhere than the first image flight flew.
    near_m
        How close is a meeting, metres.
    """
    bounds = examined.campaign.settings.scene.bounds_m
    if bounds == "auto" or examined.middle_m is None or examined.crs is None:
        return ""
    latitude, longitude, _ = map(float, geodetic_from_ecef(examined.middle_m))
    flown, middle = (latitude, longitude), ((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
    for sentence, place in _scene_places(examined, middle):
        if _apart_m(place, flown) < near_m:
            return sentence
    stated = _place(examined.crs, *middle)
    for sentence, place in _track_places(*flown):
        if _apart_m(place, stated) < near_m:
            return sentence
    return ""


def _scene_places(examined: Examination, middle: tuple[float, float]) -> Iterator[tuple[str, Place | None]]:
    """Yield what may be wrong with the scene, and where its middle lies then."""
    x, y = middle
    zone, crs = utm_crs(examined.middle_m), str(examined.crs)  # type: ignore[arg-type]
    degrees = f"These look like degrees: give scene.bounds_m in metres of {crs}."
    yield degrees, (y, x)
    yield degrees, (x, y)
    yield "Give scene.bounds_m easting before northing: [xmin, ymin, xmax, ymax].", _place(crs, y, x)
    if zone != crs:
        yield f"Is scene.crs {zone}, the zone of the track, instead of {crs}?", _place(zone, x, y)


def _track_places(latitude: float, longitude: float) -> Iterator[tuple[str, Place]]:
    """Yield what may be wrong with the logs, and where they were flown then."""
    yield "Are latitude and longitude swapped in the logs?", (longitude, latitude)
    yield "Has longitude the wrong sign in the logs (east is positive)?", (latitude, -longitude)
    yield "Has latitude the wrong sign in the logs (north is positive)?", (-latitude, longitude)
    yield "Are the logs in radians?", (float(np.degrees(latitude)), float(np.degrees(longitude)))


def _place(crs: str, x: float, y: float) -> Place | None:
    try:
        longitude, latitude = Transformer.from_crs(crs, CRS(crs).geodetic_crs, always_xy=True).transform(x, y)
    except ProjError:
        return None
    return float(latitude), float(longitude)


def _apart_m(one: Place | None, other: Place | None) -> float:
    """Return the distance of two places, straight; inf where one is none on Earth."""
    places: list[NDArray[np.float64]] = []
    for place in (one, other):
        if place is None or not np.isfinite(place).all() or abs(place[0]) > 90 or abs(place[1]) > 180:
            return np.inf
        places.append(ecef_from_geodetic(*(np.array(value) for value in (*place, 0.0))))
    return float(np.linalg.norm(places[0] - places[1]))
