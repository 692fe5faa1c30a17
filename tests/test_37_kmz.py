"""KMZ of an image: positions of its pixels and corners on WGS 84, its texts, and its requests."""

import io
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.image import imread
from pyproj import Transformer
from rasterio import Affine

from apertura.common.errors import CampaignError
from apertura.formats.export.cog import Band, write_cog
from apertura.views.webmap import kmz
from apertura.views.webmap.kmz import geographic, overlay_of

KML = "{http://www.opengis.net/kml/2.2}"
HOSTILE = "]]><script>alert('x')</script>&\x00"
EDGE_OF_ZONE = ("EPSG:32632", 721_000.0, 5_400_000.0)  # 3° east of the central meridian: convergence 2.2°
PLACES = [
    EDGE_OF_ZONE,
    ("EPSG:32733", 280_000.0, 6_250_000.0),  # southern hemisphere
    ("EPSG:25835", 500_000.0, 7_700_000.0),  # ETRS89, latitude 69°
    ("EPSG:2056", 2_600_000.0, 1_200_000.0),  # not on the ellipsoid of WGS 84
]
EARTH_M = 6.37e6
SCALE = {"low": "-40", "high": "0", "colours": "grey"}
ELLIPSOIDS_M = 1.1e-4  # GRS 80 and WGS 84 differ by 0.1 mm in the semi-minor axis


def pixel_positions(crs, shape, edges):
    """Return easting and northing by PROJ of the pixel centres that the edges of a LatLonBox imply."""
    west, south, east, north = edges
    latitude = north - (np.arange(shape[0]) + 0.5) * (north - south) / shape[0]
    longitude = west + (np.arange(shape[1]) + 0.5) * (east - west) / shape[1]
    to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    return to_map.transform(*np.meshgrid(longitude, latitude)), np.abs(latitude).max()


@pytest.mark.parametrize("spacing_m", [0.1, 10.0])
@pytest.mark.parametrize(("crs", "west", "north"), PLACES)
def test_every_pixel_of_an_overlay_is_at_its_position(crs, west, north, spacing_m):
    """A raster that contains its own map coordinates contains those of each resampled pixel, within eq. 3."""
    i, j = np.mgrid[0:400, 0:300]
    for axis, ramp in enumerate((j + 0.5, -(i + 0.5))):
        placed, edges = geographic(ramp.astype("f4"), crs=crs, west=west, north=north, spacing_m=spacing_m)
        position, latitude = pixel_positions(crs, placed.shape, edges)
        error_m = placed * spacing_m - (position[axis] - (west, north)[axis])
        inside = np.ones(placed.shape, bool)
        for coordinate, (low, high) in zip(
            position, ((west, west + 300 * spacing_m), (north - 400 * spacing_m, north)), strict=True
        ):
            inside &= (coordinate > low + spacing_m / 2) & (coordinate < high - spacing_m / 2)
        assert inside.mean() > 0.8
        rounding_m = 2 * 400 * np.finfo("f4").eps * spacing_m  # of the ramp itself, in float32
        bound_m = 1.1 * (32 * spacing_m) ** 2 / 8 * np.tan(np.radians(latitude)) / EARTH_M + rounding_m + ELLIPSOIDS_M
        assert np.abs(error_m[inside]).max() < bound_m
        assert bound_m < 0.01


@pytest.mark.parametrize(("crs", "west", "north"), PLACES)
def test_overlay_contains_the_raster_and_nothing_else(crs, west, north):
    placed, edges = geographic(np.ones((400, 300), "f4"), crs=crs, west=west, north=north, spacing_m=1.0)
    (easting, northing), _ = pixel_positions(crs, placed.shape, edges)
    off_m = np.max([west - easting, easting - west - 300, northing - north, north - 400 - northing], axis=0)
    assert np.isfinite(placed[off_m < -0.01]).all()
    assert np.isnan(placed[off_m > 0.01]).all()
    assert np.isfinite(placed).sum() == pytest.approx(400 * 300, rel=2e-3)  # area: eq. 1 has pixels of one square metre


@pytest.mark.parametrize("side_m", [100.0, 1000.0, 10_000.0])
def test_overlay_without_resampling_has_the_stated_errors(side_m):
    """Eq. 5: errors of a box and of a quadrilateral through the corners of an image that is not resampled."""
    crs, west, north = EDGE_OF_ZONE
    to_wgs84, to_map = (
        Transformer.from_crs(*pair, always_xy=True) for pair in ((crs, "EPSG:4326"), ("EPSG:4326", crs))
    )
    down, right = np.mgrid[0:1:51j, 0:1:51j]
    expected = np.array([west + right * side_m, north - down * side_m])
    place = to_wgs84.transform(*expected)
    longitude, latitude = place
    box = longitude.min() + right * np.ptp(longitude), latitude.max() - down * np.ptp(latitude)
    weights = (1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right
    quad = [
        sum(w * axis[corner] for w, corner in zip(weights, ((0, 0), (0, -1), (-1, 0), (-1, -1)), strict=True))
        for axis in place
    ]
    box_m, quad_m = (np.hypot(*(np.array(to_map.transform(*each)) - expected)).max() for each in (box, quad))
    middle = np.radians(latitude.mean())
    convergence = np.radians(longitude.mean() - 9) * np.sin(middle)
    assert box_m == pytest.approx(side_m * convergence, rel=0.05)
    assert quad_m == pytest.approx(side_m**2 / 8 * np.tan(middle) / EARTH_M, rel=0.05)


def test_power_is_interpolated_in_linear_units_and_gaps_remain_gaps():
    values = np.full((40, 40), 1.0, "f4")
    values[:, 20:] = np.nan
    values[10, 10] = 100.0
    placed, _ = geographic(values, crs="EPSG:32632", west=500_000.0, north=5_400_000.0, spacing_m=1.0)
    assert np.nansum(placed[5:16, 5:16] - 1) == pytest.approx(99, rel=0.02)
    assert np.nanmin(placed) == pytest.approx(1)  # pixels without a value do not contribute
    assert np.isnan(placed[:, 22:]).all()


def raster(folder, values, *, crs="EPSG:32632", west=721_000.0, north=5_400_000.0, spacing_m=0.5, unit="dB", **image):
    """Write a raster as an image of a map; return the document."""
    path = folder / "f01" / "fused" / "coherent_db.tif"
    path.parent.mkdir(parents=True, exist_ok=True)
    transform = Affine(spacing_m, 0, west, 0, -spacing_m, north)
    band = Band("float32", np.nan, unit, "power", "AVERAGE")
    write_cog(path, values, band, transform=transform, crs=crs, tags={}, value=lambda block: block)
    rows, columns = values.shape
    layer = {"url": "../f01/fused/coherent_db.tif?sha256=0f", "file": path.name, "kind": "image", "title": "power"}
    entry = {
        "flight": "f01",
        "image": "fused",
        "verdict": "defocused",
        "reason": "peak loss 3 dB",
        "error_db": -61.0,
        "flags": {"defocused": "3.0 dB. Check the tracks."},
        "acquired": ["2025-05-14T09:30:00Z"] * 2,
        "licence": "CC-BY-4.0",
        "layers": [layer | {"unit": unit, "low": -40.0, "high": 0.0}],
        **image,
    }
    bounds = [west, north - rows * spacing_m, west + columns * spacing_m, north]
    return {
        "campaign": "demo",
        "grid": {"bounds_m": bounds, "spacing_m": spacing_m, "shape": [rows, columns]},
        "crs": {"code": crs, "name": "UTM", "local": crs == "local"},
        "images": [entry],
    }


def unpacked(content):
    """Return doc.kml as a tree, and the pictures of a KMZ."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert archive.namelist() == ["doc.kml", "image.png", "legend.png"]
        files = [archive.read(name) for name in archive.namelist()]
    return ElementTree.fromstring(files[0]), *(imread(io.BytesIO(picture)) for picture in files[1:])


def test_corners_of_a_kmz_agree_with_proj(tmp_path):
    crs, west, north = EDGE_OF_ZONE
    document = raster(tmp_path, np.zeros((200, 300), "f4"), crs=crs, west=west, north=north)
    tree, picture, _ = unpacked(overlay_of(tmp_path, document, "f01/fused/coherent_db.tif", SCALE))
    ring = [[float(number) for number in place.split(",")] for place in tree.find(f".//{KML}coordinates").text.split()]
    to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    corners = [to_map.transform(longitude, latitude) for longitude, latitude, _ in ring]
    west, south, east, north = document["grid"]["bounds_m"]
    expected = [(west, south), (east, south), (east, north), (west, north), (west, south)]
    assert np.abs(np.subtract(corners, expected)).max() < 1e-4
    box = {each.tag.removeprefix(KML): float(each.text) for each in tree.find(f".//{KML}LatLonBox")}
    longitude, latitude, _ = np.transpose(ring)
    metres = 111_320 * np.array([np.cos(np.radians(latitude[0])), 1, np.cos(np.radians(latitude[0])), 1])
    beyond = np.subtract(
        [box["west"], box["south"], box["east"], box["north"]],
        [longitude.min(), latitude.min(), longitude.max(), latitude.max()],
    )
    assert (np.abs(beyond * metres) < 0.51).all()  # the box ends within a pixel of the corners
    corner_pixels = picture[[0, 0, -1, -1], [0, -1, 0, -1], 3]
    assert (corner_pixels == 0).all()  # transparent, because the raster is rotated against the meridian


def test_bright_point_is_drawn_at_its_position(tmp_path):
    """The centroid of a symmetric point in the picture lies at its position; here, 2.2° of rotation move it by 5 m."""
    crs, west, north = EDGE_OF_ZONE
    rows, columns = np.mgrid[0:300, 0:300]
    point = (280.0, 30.0)  # row and column
    ramp = np.clip(10 - np.hypot(rows - point[0], columns - point[1]), 0, None).astype("f4")
    document = raster(tmp_path, ramp, crs=crs, west=west, north=north, unit="1")
    parameters = {"low": "0", "high": "10", "colours": "grey"}
    tree, picture, _ = unpacked(overlay_of(tmp_path, document, "f01/fused/coherent_db.tif", parameters))
    box = {each.tag.removeprefix(KML): float(each.text) for each in tree.find(f".//{KML}LatLonBox")}
    grey = picture[..., 0] * picture[..., 3]
    height, width = grey.shape
    i, j = (float((grey * axis).sum() / grey.sum()) for axis in np.mgrid[0:height, 0:width])
    latitude = box["north"] - (i + 0.5) * (box["north"] - box["south"]) / height
    longitude = box["west"] + (j + 0.5) * (box["east"] - box["west"]) / width
    easting, northing = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(longitude, latitude)
    assert easting == pytest.approx(west + (point[1] + 0.5) * 0.5, abs=0.01)
    assert northing == pytest.approx(north - (point[0] + 0.5) * 0.5, abs=0.01)


def test_layer_in_decibels_is_averaged_in_power(tmp_path):
    """At an edge between -20 and 0 dB, the mean of equal parts is -3 dB; a mean of decibels is -10 dB."""
    values = np.full((300, 200), -20.0, "f4")
    values[:, 100:] = 0.0
    crs, west, north = EDGE_OF_ZONE
    document = raster(tmp_path, values, crs=crs, west=west, north=north)
    _, picture, _ = unpacked(overlay_of(tmp_path, document, "f01/fused/coherent_db.tif", SCALE))
    grey = picture[..., 0][picture[..., 3] == 1]
    assert np.median(grey[grey < 0.51]) == pytest.approx(0.5, abs=2 / 256)
    assert (grey > 0.99).mean() == pytest.approx(0.5, abs=0.01)
    between = grey[(grey > 0.51) & (grey < 0.99)]
    assert len(between) > 100
    assert np.median(between) == pytest.approx((40 - 2.97) / 40, abs=0.04)  # 10 log10(0.5 + 0.5 / 100)


def test_kmz_of_a_large_raster_uses_an_overview_at_the_same_positions(tmp_path, monkeypatch):
    monkeypatch.setattr(kmz, "MOST_PIXELS", 600)
    crs, west, north = EDGE_OF_ZONE
    values = np.broadcast_to(np.arange(1101, dtype="f4"), (700, 1101)).copy()
    document = raster(tmp_path, values, crs=crs, west=west, north=north, spacing_m=0.25, unit="1")
    scale = {"low": "400", "high": "440", "colours": "grey"}
    content = overlay_of(tmp_path, document, "f01/fused/coherent_db.tif", scale)
    tree, picture, _ = unpacked(content)
    assert "0.5 m, resampled" in tree.find(f".//{KML}Placemark/{KML}description").text
    box = {each.tag.removeprefix(KML): float(each.text) for each in tree.find(f".//{KML}LatLonBox")}
    edges = [box[name] for name in ("west", "south", "east", "north")]
    (easting, _), _ = pixel_positions(crs, picture.shape, edges)
    within = (picture[..., 3] == 1) & (picture[..., 0] > 0.02) & (picture[..., 0] < 0.98)
    position_m = (400.5 + 40 * picture[..., 0]) * 0.25
    level_m = 40 * 0.25 / 256
    assert within.sum() > 5000
    assert np.abs(position_m - (easting - west))[within].max() < 2 * level_m  # index and byte of a colour are truncated


def test_balloon_states_verdict_flags_error_time_and_licence(tmp_path):
    document = raster(tmp_path, np.zeros((20, 30), "f4"))
    tree, _, legend = unpacked(overlay_of(tmp_path, document, "f01/fused/coherent_db.tif", SCALE))
    for element in ("GroundOverlay", "Placemark"):
        words = tree.find(f".//{KML}{element}/{KML}description").text
        for text in (
            "defocused: peak loss 3 dB",
            "3.0 dB. Check the tracks.",
            "below -61.0 dB",
            "09:30:00Z",
            "CC-BY-4.0",
        ):
            assert text in words
    assert ((legend[..., 0] > 0.6) & (legend[..., 1] < 0.3)).any()  # the flags in red


def test_hostile_text_is_text_in_a_kmz(tmp_path):
    document = raster(tmp_path, np.zeros((20, 30), "f4"), verdict=HOSTILE, flags={HOSTILE: HOSTILE}, licence=HOSTILE)
    tree, _, _ = unpacked(overlay_of(tmp_path, document, "f01/fused/coherent_db.tif", SCALE))
    words = tree.find(f".//{KML}Placemark/{KML}description").text
    assert "<script" not in words
    assert "&lt;script&gt;alert(&#x27;x&#x27;)&lt;/script&gt;&amp;?" in words


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("f01/fused/other.tif", {}),
        ("f01/fused/coherent_db.tif", {"low": "0"}),
        ("f01/fused/coherent_db.tif", {"low": "nan"}),
        ("f01/fused/coherent_db.tif", {"high": "inf"}),
        ("f01/fused/coherent_db.tif", {"low": "x"}),
        ("f01/fused/coherent_db.tif", {"colours": "jet"}),
    ],
)
def test_kmz_of_another_file_or_scale_is_one_message(tmp_path, name, parameters):
    document = raster(tmp_path, np.zeros((20, 30), "f4"))
    with pytest.raises(CampaignError, match="expected an image and a colour scale"):
        overlay_of(tmp_path, document, name, SCALE | parameters)


def test_local_frame_has_no_kmz(tmp_path):
    document = raster(tmp_path, np.zeros((20, 30), "f4"))
    document["crs"]["local"] = True
    with pytest.raises(CampaignError, match="expected a campaign with geographic positions"):
        overlay_of(tmp_path, document, "f01/fused/coherent_db.tif", SCALE)
