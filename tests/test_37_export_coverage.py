"""What a campaign covers: polygons, GeoJSON and the picture of it."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rasterio import Affine

from apertura.core.geometry.geodesy import ecef_from_geodetic, frame_from_map, geodetic_from_ecef, map_from_frame
from apertura.formats.catalog.stac import bounds
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


def near_the_antimeridian(at_m):
    """Places of EPSG:32660 as they are exported."""
    latitude, longitude, height = geodetic_from_ecef(frame_from_map("EPSG:32660", *at_m.T)).T
    return np.stack([longitude, latitude, height], -1)


def test_footprint_and_track_across_180_degrees_are_cut_there_and_their_bounds_run_west_to_east():
    """RFC 7946, 3.1.9 and 5.2: the same area in two polygons, and a line in two parts."""
    east, north, _ = map_from_frame("EPSG:32660", ecef_from_geodetic(np.array(48.0), np.array(180.0), np.array(0.0)))
    place = Affine(2.0, 0, east - 9, 0, -2.0, north + 8)
    track = np.stack([np.linspace(east - 20, east + 20, 9), np.full(9, north - 30), np.full(9, 30.0)], -1)
    one = Covered("f01", "a-a", {"transmitter": track}, 7 * RING)
    line, area_of = feature_collection([one], place, near_the_antimeridian, height_m=0.0)["features"]
    assert line["geometry"]["type"] == "MultiLineString"
    ends = [np.array(part)[:, 0] for part in line["geometry"]["coordinates"]]
    assert (ends[0][-1], ends[1][0]) == (180.0, -180.0)
    assert (np.diff(ends[0]) > 0).all()
    assert (np.diff(ends[1]) > 0).all()
    polygons = [[np.array(ring) for ring in rings] for rings in area_of["geometry"]["coordinates"]]
    sides = [np.sign(rings[0][:, 0]) for rings in polygons]
    assert {float(side[0]) for side in sides} == {-1.0, 1.0}
    assert all((side == side[0]).all() for side in sides)
    metres = 6378137.0 * np.radians(1.0) * np.array([np.cos(np.radians(48.0)), 0.9973])
    found = sum(area(ring * metres) for rings in polygons for ring in rings)
    assert found == pytest.approx((7 * 10 - 2 * 3) * 4, rel=0.02)
    west, south, east_deg, north_deg = bounds([area_of["geometry"]])
    assert 179.9 < west < 180
    assert -180 < east_deg < -179.9
    assert south < north_deg


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


def drawn(monkeypatch, tmp_path, several, **how):
    """Texts of the picture's panels: labels of axes and colour bars, and of the figure."""
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: figures.append(self) or Path(path).write_bytes(b""))
    tags = {"APERTURA_VERSION": "0.1.0"}
    write_coverage(tmp_path / "map.png", several, TRANSFORM, crs_name="UTM", title="coverage", tags=tags, **how)
    (figure,) = figures
    labels = [text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel()) if text]
    return labels, [text.get_text() for text in figure.texts], figure


def test_one_pair_has_one_panel_and_a_distant_scene_is_drawn_once_more(monkeypatch, tmp_path):
    labels, words, figure = drawn(monkeypatch, tmp_path, [covered()])
    assert labels == ["Easting, m", "Northing, m", "pulses per pixel"]
    assert words[-2].startswith("80.0 % of the scene is covered by 1 pair of 1 flight;")
    assert not figure.legends
    far = np.stack([np.linspace(-400, 900, 9), np.full(9, -60.0), np.full(9, 30.0)], -1)
    one = Covered("f01", "a-a", {"transmitter": far}, 7 * RING)
    labels, _, figure = drawn(monkeypatch, tmp_path, [one])
    assert labels[-1].replace("\n", " ") == "pulses per pixel, scene only"
    assert figure.axes[2].get_xlim() == (100, 120)
    figure.canvas.draw()
    wide, high = (figure.axes[2].bbox.size / figure.dpi).tolist()
    assert max(wide, high) > 3  # inch: it is drawn to be looked at
    room = figure.bbox
    for axes in figure.axes:  # nothing is cut at the edge of the picture
        box = axes.get_tightbbox()
        assert room.x0 <= box.x0 < box.x1 <= room.x1
        assert room.y0 <= box.y0 < box.y1 <= room.y1


def test_no_words_of_a_narrow_map_are_cut(monkeypatch, tmp_path):
    north = np.stack([np.full(9, 110.0), np.linspace(20, 85, 9), np.full(9, 30.0)], -1)
    one = Covered("f01", "a-a", {"transmitter": north}, 7 * RING, {"transmitter": [north[3:6]]})
    _, words, figure = drawn(monkeypatch, tmp_path, [one])
    assert any(line.endswith("thick: used for the image) and footprints") for line in words)
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in figure.texts if text.get_text()]
    assert all(box.x1 <= figure.bbox.x1 for box in boxes)
    assert not any(one.overlaps(other) for number, one in enumerate(boxes) for other in boxes[:number])


def test_several_flights_have_a_legend_off_the_data_and_whole_numbers_of_pairs(monkeypatch, tmp_path):
    several = [covered(f"f{number // 5:02d}", np.roll(RING, number, axis=1)) for number in range(40)]
    _, words, figure = drawn(monkeypatch, tmp_path, several)
    assert "covered by 40 pairs of 8 flights" in " ".join(words)
    (legend,) = figure.legends
    figure.canvas.draw()
    box = legend.get_window_extent()
    assert not any(box.overlaps(axes.get_tightbbox()) for axes in figure.axes)
    assert not any(box.overlaps(text.get_window_extent()) for text in figure.texts)
    ticks = figure.axes[3].get_yticks()
    np.testing.assert_array_equal(ticks, ticks.round())


def test_a_number_of_pairs_that_is_the_same_everywhere_is_stated_and_not_drawn(monkeypatch, tmp_path):
    labels, words, _ = drawn(monkeypatch, tmp_path, [covered(), covered("f02")])
    assert [label.replace("\n", " ") for label in labels[2:]] == ["pulses per pixel, all pairs"]
    assert "80.0 % of the scene is covered by 2 pairs of 2 flights, every pixel by 2" in " ".join(words)


def test_tracks_of_many_flights_are_one_colour_without_footprints_of_each(monkeypatch, tmp_path):
    several = [covered(f"f{number:02d}", np.roll(RING, number, axis=1)) for number in range(50)]
    _, words, figure = drawn(monkeypatch, tmp_path, several)
    assert "edge of the covered area" in " ".join(words)
    assert not figure.legends
    lines = figure.axes[0].get_lines()
    assert len({line.get_color() for line in lines}) == 2
    assert len(lines) == 2 * 50 + len(footprint(sum(one.looks for one in several), TRANSFORM)[0])
    assert not figure.axes[0].texts  # no arrows


def test_a_local_frame_has_x_and_y_and_no_north(monkeypatch, tmp_path):
    labels, words, _ = drawn(monkeypatch, tmp_path, [covered()], local=True)
    assert labels[:2] == ["x, m", "y, m"]
    assert "N" not in words
