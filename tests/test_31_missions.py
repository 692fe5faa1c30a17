"""Missions of ground control stations: waypoints, height references, speeds; one message for an invalid file."""

import json

import numpy as np
import pytest

from apertura.common.errors import CampaignError
from apertura.formats.tracks.missions import read_mission, write_kml


def item(command, latitude=0.0, longitude=0.0, height=0.0, frame=3, second=0.0):
    return {
        "type": "SimpleItem",
        "command": command,
        "frame": frame,
        "params": [0, second, 0, None, latitude, longitude, height],
    }


def plan(*items, **mission):
    mission = {"vehicleType": 2, "hoverSpeed": 5, "cruiseSpeed": 15, "plannedHomePosition": [48.4, 9.9, 480]} | mission
    return json.dumps({"fileType": "Plan", "mission": mission | {"items": list(items)}})


SURVEY = {
    "type": "ComplexItem",
    "TransectStyleComplexItem": {"Items": [item(16, 48.402, 9.90, 50), item(206), item(16, 48.402, 9.91, 50)]},
}


def test_qgroundcontrol_plan_gives_waypoints_and_speeds(tmp_path):
    file = tmp_path / "dike.plan"
    file.write_text(plan(item(22, 48.4, 9.9, 50), item(178, second=3.0), item(16, 48.401, 9.9, 50), SURVEY, item(20)))
    mission = read_mission(file)
    assert mission.reference == "home"
    assert mission.home_deg == (48.4, 9.9)
    assert mission.place[:, 0].tolist() == [48.4, 48.401, 48.402, 48.402]
    assert mission.speed_m_s.tolist() == [5, 3, 3, 3]


def test_ardupilot_waypoints_start_with_home(tmp_path):
    rows = ["QGC WPL 110", "0 1 0 16 0 0 0 0 48.4 9.9 480 1", "1 0 3 178 0 4 0 0 0 0 0 1"]
    rows += [f"{number} 0 3 16 0 0 0 0 48.40{number} 9.9 40 1" for number in (2, 3)]
    file = tmp_path / "one.waypoints"
    file.write_text("\n".join(row.replace(" ", "\t") if number else row for number, row in enumerate(rows)))
    mission = read_mission(file)
    assert mission.place.tolist() == [[48.402, 9.9, 40], [48.403, 9.9, 40]]
    assert mission.speed_m_s.tolist() == [4, 4]
    assert mission.home_deg == (48.4, 9.9)


def test_kml_is_read_back_unchanged(tmp_path):
    lines = {"uav<1>": np.array([[9.9, 48.4, 500.0], [9.91, 48.4, 501.0]])}
    write_kml(tmp_path / "one.kml", "a & b", lines, {"seen": [[lines["uav<1>"]]]})
    mission = read_mission(tmp_path / "one.kml")
    assert mission.reference == "sea"
    assert mission.place == pytest.approx(np.array([[48.4, 9.9, 500.0], [48.4, 9.91, 501.0]]))


def test_table_has_heights_above_terrain(tmp_path):
    (tmp_path / "one.csv").write_text("latitude_deg,longitude_deg,height_m,speed_m_s\n48.4,9.9,30,2\n48.41,9.9,30,3\n")
    mission = read_mission(tmp_path / "one.csv")
    assert (mission.reference, mission.speed_m_s.tolist()) == ("ground", [2, 3])


WRONG = {
    "a.plan": ("{}", "no key 'mission'"),
    "b.plan": (
        plan(item(16, 48.4, 9.9, 50), item(16, 48.5, 9.9, 50, frame=0)),
        "height reference home up to waypoint 1, sea at waypoint 2; use the same altitude frame for all waypoints",
    ),
    "c.plan": (plan(item(16, 48.4, 9.9, 50)), "1 waypoints"),
    "d.plan": (plan(item(16, 148.4, 9.9, 50), item(16, 48.4, 9.9, 50)), "1 of them with invalid coordinates"),
    "e.waypoints": ("hello\n", "not QGC WPL 110"),
    "f.kml": ("<kml><LineString><coordinates>9,48,1 9,49,1</coordinates></LineString></kml>", "clampToGround"),
    "g.csv": ("latitude_deg\n48\n", "no column longitude_deg"),
    "h.gpx": ("", "suffix '.gpx'"),
    "i.plan": (plan(item(16, 10**400, 9.9, 50), item(16, 48.4, 9.9, 50)), "unreadable mission"),
    "j.plan": (plan(item(16, 48.4, 9.9, 50)).replace('"command": 16', '"command": 1e400'), "unreadable mission"),
    "k.kml": ("<LineString>" * 80_000, "no complete element LineString"),
}


@pytest.mark.parametrize("name", WRONG)
def test_invalid_mission_is_one_message(tmp_path, name):
    text, words = WRONG[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(CampaignError) as caught:
        read_mission(tmp_path / name)
    assert words in str(caught.value)
