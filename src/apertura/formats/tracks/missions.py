"""Reading of planned missions (QGroundControl, ArduPilot, KML, tables of waypoints), and output of plans as KML."""

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Literal

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.atomic import write_text
from apertura.common.documents import read_json, read_text
from apertura.common.errors import CampaignError, quoted
from apertura.formats.tracks.csv_track import read_table

Reference = Literal["home", "sea", "ground", "ellipsoid"]
"""Height reference: terrain at the take-off point, mean sea level, terrain below the waypoint, ellipsoid."""

LARGEST_MISSION = 4_000_000
"""Maximum size of a mission file, bytes."""

_MOST_WAYPOINTS = 20_000
_FRAMES: Mapping[int, Reference] = {0: "sea", 3: "home", 5: "sea", 6: "home", 10: "ground", 11: "ground"}
_PASSED = {16, 17, 18, 19, 22, 82}  # MAV_CMD with a position: waypoints, loiters, take-off, splines
_SPEED = 178  # MAV_CMD_DO_CHANGE_SPEED; the speed is its second parameter
_REMEDY = "Export the mission again, or define the track as a line, racetrack or circle."


@dataclass(frozen=True, eq=False)
class Mission:
    """Waypoints of a mission.

    Attributes
    ----------
    place
        (waypoint, 3) float64: latitude, longitude (degrees, WGS 84), metres above `reference`.
    reference
        Height reference.
    speed_m_s
        (waypoint,) float64: speed on the way to each waypoint; NaN where not stated in the mission.
    home_deg
        Latitude and longitude of the take-off point; None: not stated in the mission, the first waypoint is used.
    """

    place: Floats
    reference: Reference
    speed_m_s: Floats
    home_deg: tuple[float, float] | None = None


def read_mission(path: Path) -> Mission:
    """Read a mission file in the format given by its suffix.

    Parameters
    ----------
    path
        ``.plan`` of QGroundControl, ``.waypoints`` or ``.txt`` of ArduPilot's ground stations (QGC WPL 110), ``.kml``
        with a LineString, ``.csv`` with columns latitude_deg, longitude_deg, height_m and, if it varies, speed_m_s.

    Raises
    ------
    CampaignError
        If the file is missing, has another format, or contains fewer than two waypoints.
    """
    reader = _READERS.get(path.suffix.lower())
    expected = f"a mission: {', '.join(_READERS)}"
    if reader is None:
        raise CampaignError(f"suffix {quoted(path.suffix)}", path, expected, _REMEDY)
    if not path.is_file():
        raise CampaignError("no such file", path, expected, "Copy the mission to the folder of the plan.")
    try:
        mission = reader(path)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        if isinstance(error, CampaignError):
            raise
        reason = f"no key {error}" if isinstance(error, KeyError) else str(error)
        raise CampaignError(f"unreadable mission: {quoted(reason, 200)}", path, expected, _REMEDY) from error
    latitude, longitude, height = mission.place.T
    good = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 360) & (np.abs(height) < 1e5)
    if not 2 <= len(mission.place) <= _MOST_WAYPOINTS or not good.all():
        found = f"{len(mission.place)} waypoints, {int((~good).sum())} of them with invalid coordinates"
        raise CampaignError(found, path, f"2 to {_MOST_WAYPOINTS} waypoints on Earth", _REMEDY)
    return mission


def _items(mission: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield the simple items of a QGroundControl mission, including those nested in surveys and corridors."""
    for item in mission["items"]:
        if item.get("type") == "SimpleItem":
            yield item
        else:
            inside = item.get("TransectStyleComplexItem", item).get("Items", [])
            if not inside:
                raise ValueError(f"{item.get('complexItemType', 'complex item')} without transects")
            yield from _items({"items": inside})


def _of_commands(rows: list[tuple[int, int, list[float]]], speed: float, home: tuple[float, float] | None) -> Mission:
    """Convert MAVLink commands (command, frame, seven parameters, NaN if missing) to a mission."""
    positions, references, speeds = [], [], []
    for command, frame, parameters in rows:
        if command == _SPEED and parameters[1] > 0:
            speed = parameters[1]
        elif command in _PASSED and frame in _FRAMES and any(parameters[4:6]):
            positions.append(parameters[4:7])
            references.append(_FRAMES[frame])
            speeds.append(speed)
    for number, reference in enumerate(references, 1):
        if reference != references[0]:
            mixed = f"height reference {references[0]} up to waypoint {number - 1}, {reference} at waypoint {number}"
            raise ValueError(f"{mixed}; use the same altitude frame for all waypoints")
    place = np.array(positions, float).reshape(-1, 3)
    return Mission(place, (references or ["home"])[0], np.array(speeds, float), home)


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _plan(path: Path) -> Mission:
    document = read_json(path, expected="a QGroundControl plan", remedy=_REMEDY, largest=LARGEST_MISSION)
    mission = document["mission"]
    rows = [
        (int(item["command"]), int(item["frame"]), [_number(value) for value in item["params"]])
        for item in _items(mission)
    ]
    copter = mission.get("vehicleType") in {2, 13, 14, 15}  # MAV_TYPE of quadrotor, hexa-, octo-, tricopter
    home = mission.get("plannedHomePosition")
    return _of_commands(
        rows, _number(mission["hoverSpeed" if copter else "cruiseSpeed"]), home and (float(home[0]), float(home[1]))
    )


def _waypoints(path: Path) -> Mission:
    first, *lines = read_text(path, expected="a mission", remedy=_REMEDY, largest=LARGEST_MISSION).splitlines()
    if not first.startswith("QGC WPL"):
        raise ValueError("the first line is not QGC WPL 110")
    cells = [line.split() for line in lines if line.strip()]
    rows = [(int(row[3]), int(row[2]), [float(cell) for cell in row[4:11]]) for row in cells]
    _, _, home = rows[0]  # line 0 is home
    return _of_commands(rows[1:], math.nan, (home[4], home[5]) if any(home[4:6]) else None)


def _kml(path: Path) -> Mission:
    text = read_text(path, expected="KML", remedy=_REMEDY, largest=LARGEST_MISSION)
    # Plain text search: an XML parser expands entities of untrusted files, and a regular expression may rescan the
    # whole text for every unclosed element.
    line = _element(text, "LineString")
    listed = _element(line, "coordinates")
    mode = re.search(r"<altitudeMode>\s*(\w+)\s*</altitudeMode>", line)
    references: Mapping[str, Reference] = {"absolute": "sea", "relativeToGround": "ground"}
    altitude_mode = mode[1] if mode else "clampToGround"
    if altitude_mode not in references:
        raise ValueError(f"altitudeMode {altitude_mode}, not absolute or relativeToGround")
    place = np.array([[float(value) for value in triple.split(",")] for triple in listed.split()], float)
    return Mission(place[:, [1, 0, 2]], references[altitude_mode], np.full(len(place), np.nan))


def _element(text: str, name: str) -> str:
    """Return the content of the first element with a name."""
    start = text.find(f"<{name}")
    inner, end = text.find(">", start) + 1, text.find(f"</{name}>", start)
    if start < 0 or not 0 < inner <= end:
        raise ValueError(f"no complete element {name}")
    return text[inner:end]


def _csv(path: Path) -> Mission:
    columns = ["latitude_deg", "longitude_deg", "height_m"]
    table = read_table(path, columns, optional=("speed_m_s",))
    speed = table["speed_m_s"].to_numpy(float) if "speed_m_s" in table else np.full(len(table), np.nan)
    return Mission(table[columns].to_numpy(float), "ground", speed)


_READERS: Mapping[str, Callable[[Path], Mission]] = {
    ".plan": _plan,
    ".waypoints": _waypoints,
    ".txt": _waypoints,
    ".kml": _kml,
    ".csv": _csv,
}


def write_kml(path: Path, name: str, lines: Mapping[str, Floats], areas: Mapping[str, list[list[Floats]]]) -> None:
    """Write planned tracks and footprints as KML.

    Parameters
    ----------
    path
        ``….kml``.
    name
        Name of the document.
    lines
        Name → (vertex, 3) float64: longitude, latitude (degrees), height (m).
    areas
        Name → polygons, each a list of rings (vertex, 3) in the same coordinates, outer ring first.
    """

    def ring(place: Floats) -> str:
        return " ".join(f"{east:.8f},{north:.8f},{up:.2f}" for east, north, up in place)

    marks = [
        f"<Placemark><name>{escape(title)}</name><LineString><altitudeMode>absolute</altitudeMode><coordinates>"
        f"{ring(place)}</coordinates></LineString></Placemark>"
        for title, place in lines.items()
    ]
    for title, polygons in areas.items():
        for outer, *holes in polygons:
            edges = [("outer", outer), *(("inner", hole) for hole in holes)]
            bounds = "".join(
                f"<{side}BoundaryIs><LinearRing><coordinates>{ring(edge)}</coordinates></LinearRing></{side}BoundaryIs>"
                for side, edge in edges
            )
            marks.append(f"<Placemark><name>{escape(title)}</name><Polygon>{bounds}</Polygon></Placemark>")
    body = "\n".join(marks)
    heading = '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
    write_text(path, f"{heading}<name>{escape(name)}</name>\n{body}\n</Document></kml>\n")
