"""Coverage of a campaign: footprint polygons, GeoJSON and map."""

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


def test_footprint_is_counterclockwise_and_its_holes_clockwise():
    ((outer, hole),) = footprint(RING, TRANSFORM)
    assert area(outer) == 7 * 10 * 4
    assert area(hole) == -2 * 3 * 4
    assert all(np.array_equal(ring[0], ring[-1]) for ring in (outer, hole))
    assert footprint(0 * RING, TRANSFORM) == []


def test_geojson_has_tracks_and_footprints_in_longitude_and_latitude():
    features = feature_collection([covered()], TRANSFORM, lambda at: at * [0.1, 0.01, 1] + [0, 0, 5], height_m=20.0)
    tracks, area_of = features["features"][:2], features["features"][2]
    assert [track["properties"]["antenna"] for track in tracks] == ["transmitter", "receiver"]
    assert tracks[0]["geometry"]["type"] == "LineString"
    assert tracks[0]["geometry"]["coordinates"][0] == [9.0, 0.6, 35.0]
    assert area_of["geometry"]["coordinates"][0][0][0] == pytest.approx([10.0, 0.64])  # south-west
    assert area_of["properties"] == {
        "kind": "footprint", "flight": "f01", "pair": "a-b",
        "covered_share": 0.8, "area_m2": 256.0, "looks_median": 7.0, "looks_most": 7.0,
    }  # fmt: skip


def near_the_antimeridian(at_m):
    """Return exported longitude, latitude and height of points in EPSG:32660."""
    latitude, longitude, height = geodetic_from_ecef(frame_from_map("EPSG:32660", *at_m.T)).T
    return np.stack([longitude, latitude, height], -1)


def test_footprint_and_track_are_split_at_the_antimeridian():
    """As in RFC 7946 (3.1.9 and 5.2), areas have two polygons, lines two parts, and bounds extend from west to east."""
    east, north, _ = map_from_frame("EPSG:32660", ecef_from_geodetic(np.array(48.0), np.array(180.0), np.array(0.0)))
    transform = Affine(2.0, 0, east - 9, 0, -2.0, north + 8)
    track = np.stack([np.linspace(east - 20, east + 20, 9), np.full(9, north - 30), np.full(9, 30.0)], -1)
    coverage = Covered("f01", "a-a", {"transmitter": track}, 7 * RING)
    line, area_of = feature_collection([coverage], transform, near_the_antimeridian, height_m=0.0)["features"]
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
    total_area = sum(area(ring * metres) for rings in polygons for ring in rings)
    assert total_area == pytest.approx((7 * 10 - 2 * 3) * 4, rel=0.02)
    west, south, east_deg, north_deg = bounds([area_of["geometry"]])
    assert 179.9 < west < 180
    assert -180 < east_deg < -179.9
    assert south < north_deg


def test_local_campaign_has_features_without_geometry():
    features = feature_collection([covered(looks=0 * RING)], TRANSFORM, None, height_m=0.0)["features"]
    assert [feature["geometry"] for feature in features] == [None] * 3
    assert features[2]["properties"]["covered_share"] == 0


@pytest.mark.slow
def test_coverage_map_is_reproducible_and_depends_on_its_input(tmp_path):
    several = [covered(), covered("f02", np.roll(RING, 2, axis=1)), covered("f03", 0 * RING)]
    tags = {"APERTURA_VERSION": "0.1.0"}
    for name in ("first.png", "second.png"):
        write_coverage(tmp_path / name, several, TRANSFORM, crs_name="UTM", title="campaign · coverage", tags=tags)
    assert (tmp_path / "first.png").read_bytes() == (tmp_path / "second.png").read_bytes()
    write_coverage(
        tmp_path / "less.png", several[2:], TRANSFORM, crs_name="UTM", title="campaign · coverage", tags=tags
    )
    assert (tmp_path / "less.png").read_bytes() != (tmp_path / "first.png").read_bytes()


def coverage_map(monkeypatch, tmp_path, several, **options):
    """Return the axis and colour bar labels, the texts, and the figure of a coverage map."""
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: figures.append(self) or Path(path).write_bytes(b""))
    tags = {"APERTURA_VERSION": "0.1.0"}
    write_coverage(tmp_path / "map.png", several, TRANSFORM, crs_name="UTM", title="coverage", tags=tags, **options)
    (figure,) = figures
    labels = [text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel()) if text]
    return labels, [text.get_text() for text in figure.texts], figure


def test_single_pair_has_one_panel_and_a_distant_scene_a_second(monkeypatch, tmp_path):
    labels, texts, figure = coverage_map(monkeypatch, tmp_path, [covered()])
    assert labels == ["Easting, m", "Northing, m", "pulses per pixel"]
    assert texts[-2].startswith("80.0 % of the scene is covered by 1 pair of 1 flight;")
    assert not figure.legends
    far = np.stack([np.linspace(-400, 900, 9), np.full(9, -60.0), np.full(9, 30.0)], -1)
    coverage = Covered("f01", "a-a", {"transmitter": far}, 7 * RING)
    labels, _, figure = coverage_map(monkeypatch, tmp_path, [coverage])
    assert labels[-1].replace("\n", " ") == "pulses per pixel, scene only"
    assert figure.axes[2].get_xlim() == (100, 120)
    figure.canvas.draw()
    wide, high = (figure.axes[2].bbox.size / figure.dpi).tolist()
    assert max(wide, high) > 3  # inches, large enough to be readable
    canvas = figure.bbox
    for axes in figure.axes:  # nothing is cut at the edge of the figure
        box = axes.get_tightbbox()
        assert canvas.x0 <= box.x0 < box.x1 <= canvas.x1
        assert canvas.y0 <= box.y0 < box.y1 <= canvas.y1


def test_texts_of_a_narrow_map_are_not_cut(monkeypatch, tmp_path):
    north = np.stack([np.full(9, 110.0), np.linspace(20, 85, 9), np.full(9, 30.0)], -1)
    coverage = Covered("f01", "a-a", {"transmitter": north}, 7 * RING, {"transmitter": [north[3:6]]})
    _, texts, figure = coverage_map(monkeypatch, tmp_path, [coverage])
    assert any(line.endswith("thick: used for the image) and footprints") for line in texts)
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in figure.texts if text.get_text()]
    assert all(box.x1 <= figure.bbox.x1 for box in boxes)
    assert not any(box.overlaps(previous) for number, box in enumerate(boxes) for previous in boxes[:number])


@pytest.mark.slow
def test_legend_is_off_the_data_and_pair_counts_are_integers(monkeypatch, tmp_path):
    several = [covered(f"f{number // 5:02d}", np.roll(RING, number, axis=1)) for number in range(40)]
    _, texts, figure = coverage_map(monkeypatch, tmp_path, several)
    assert "covered by 40 pairs of 8 flights" in " ".join(texts)
    (legend,) = figure.legends
    figure.canvas.draw()
    box = legend.get_window_extent()
    assert not any(box.overlaps(axes.get_tightbbox()) for axes in figure.axes)
    assert not any(box.overlaps(text.get_window_extent()) for text in figure.texts)
    ticks = figure.axes[3].get_yticks()
    np.testing.assert_array_equal(ticks, ticks.round())


def test_uniform_number_of_pairs_is_stated_and_not_drawn(monkeypatch, tmp_path):
    labels, texts, _ = coverage_map(monkeypatch, tmp_path, [covered(), covered("f02")])
    assert [label.replace("\n", " ") for label in labels[2:]] == ["pulses per pixel, all pairs"]
    assert "80.0 % of the scene is covered by 2 pairs of 2 flights, every covered pixel by 2" in " ".join(texts)


def test_tracks_of_many_flights_have_one_colour_and_a_common_footprint(monkeypatch, tmp_path):
    several = [covered(f"f{number:02d}", np.roll(RING, number, axis=1)) for number in range(50)]
    _, texts, figure = coverage_map(monkeypatch, tmp_path, several)
    assert "edge of the covered area" in " ".join(texts)
    assert not figure.legends
    lines = figure.axes[0].get_lines()
    assert len({line.get_color() for line in lines}) == 2
    assert len(lines) == 2 * 50 + len(footprint(sum(coverage.looks for coverage in several), TRANSFORM)[0])
    assert not figure.axes[0].texts  # no arrows


def test_map_of_a_local_frame_has_x_and_y_and_no_north_arrow(monkeypatch, tmp_path):
    labels, texts, _ = coverage_map(monkeypatch, tmp_path, [covered()], local=True)
    assert labels[:2] == ["x, m", "y, m"]
    assert "N" not in texts
