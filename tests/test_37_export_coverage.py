"""What a campaign covers: polygons, GeoJSON and the picture of it."""

import numpy as np
import pytest
from rasterio import Affine

from apertura.formats.export.coverage import Covered, feature_collection, footprint, write_coverage

TRANSFORM = Affine(2.0, 0, 100.0, 0, -2.0, 80.0)
RING = np.ones((8, 10), np.float32)
RING[3:5, 4:7] = 0
RING[0] = 0


def covered(flight="f01", looks=RING):
    track = np.stack([np.linspace(90, 130, 9), np.full(9, 60.0), np.full(9, 30.0)], -1)
    return Covered(flight, "a-b", {"transmitter": track, "receiver": track + [0, -3.0, 0]}, 7 * looks)


def area(ring):
    x, y = np.asarray(ring, float).T
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) / 2


def test_a_footprint_turns_left_and_its_holes_right():
    ((outer, hole),) = footprint(RING, TRANSFORM)
    assert area(outer) == 7 * 10 * 4
    assert area(hole) == -2 * 3 * 4
    assert all(np.array_equal(ring[0], ring[-1]) for ring in (outer, hole))
    assert footprint(0 * RING, TRANSFORM) == []


def test_geojson_places_tracks_and_footprints_by_longitude_and_latitude():
    features = feature_collection([covered()], TRANSFORM, lambda at: at * [0.1, 0.01, 1] + [0, 0, 5], height_m=20.0)
    tracks, area_of = features["features"][:2], features["features"][2]
    assert [track["properties"]["antenna"] for track in tracks] == ["transmitter", "receiver"]
    assert tracks[0]["geometry"]["type"] == "LineString"
    assert tracks[0]["geometry"]["coordinates"][0] == [9.0, 0.6, 35.0]
    assert area_of["geometry"]["coordinates"][0][0][0] == pytest.approx([10.0, 0.64])  # south-west, and no height
    assert area_of["properties"] == {
        "kind": "footprint", "flight": "f01", "pair": "a-b",
        "covered_share": 0.8, "area_m2": 256.0, "looks_median": 7.0, "looks_most": 7.0,
    }  # fmt: skip


def test_a_campaign_without_place_on_earth_has_features_without_geometry():
    features = feature_collection([covered(looks=0 * RING)], TRANSFORM, None, height_m=0.0)["features"]
    assert [feature["geometry"] for feature in features] == [None] * 3
    assert features[2]["properties"]["covered_share"] == 0


def test_the_picture_is_the_same_to_the_byte_and_shows_what_is_there(tmp_path):
    several = [covered(), covered("f02", np.roll(RING, 2, axis=1)), covered("f03", 0 * RING)]
    tags = {"APERTURA_VERSION": "0.1.0"}
    for name in ("one.png", "two.png"):
        write_coverage(tmp_path / name, several, TRANSFORM, crs_name="UTM", title="campaign · coverage", tags=tags)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    write_coverage(
        tmp_path / "less.png", several[2:], TRANSFORM, crs_name="UTM", title="campaign · coverage", tags=tags
    )
    assert (tmp_path / "less.png").read_bytes() != (tmp_path / "one.png").read_bytes()
