"""Untrusted rasters: read as GeoTIFF only, without sidecar files and without network access."""

import socket
import struct
import threading

import numpy as np
import pytest
import rasterio
from folders import complaint
from pyproj import Transformer
from rasterio.transform import from_origin
from scenes import UTM_GRID

from apertura.core.scene.dem import MOST_POSTS, open_dem
from apertura.core.scene.geoid import geoid_file, undulation

PLACE = (500000, 5400100, 2, 2)


def write_dem(path, heights=None, place=PLACE, crs="EPSG:32632", **profile):
    """Write a sloping DEM with 2 m posts under `UTM_GRID`, about 600 m high."""
    rows, columns = np.mgrid[:60, :60]
    heights = (600 + 0.1 * rows + 0.2 * columns).astype(np.float32) if heights is None else heights
    shape = {"height": heights.shape[0], "width": heights.shape[1], "count": 1, "dtype": heights.dtype}
    with rasterio.open(path, "w", "GTiff", crs=crs, transform=from_origin(*place), **shape, **profile) as raster:
        raster.write(heights, 1)
    return path


def heights_of(path):
    return open_dem(path, UTM_GRID, datum="ellipsoid").heights(UTM_GRID)


def tagged(path, tag, kind, value):
    """Overwrite the value of a TIFF tag in a little-endian file."""
    data = bytearray(path.read_bytes())
    first = struct.unpack_from("<I", data, 4)[0]
    for entry in range(struct.unpack_from("<H", data, first)[0]):
        at = first + 2 + 12 * entry
        if struct.unpack_from("<H", data, at)[0] == tag:
            struct.pack_into("<HII", data, at + 2, kind, 1, value)
    path.write_bytes(data)
    return path


@pytest.fixture
def listener():
    """A server that records connections."""
    calls = []
    server = socket.create_server(("127.0.0.1", 0))

    def serve():
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            calls.append(connection.recv(1000))
            connection.close()

    threading.Thread(target=serve, daemon=True).start()
    yield server.getsockname()[1], calls
    server.close()


VRT = """<VRTDataset rasterXSize="60" rasterYSize="60"><SRS>EPSG:32632</SRS>
<GeoTransform>500000, 2, 0, 5400100, 0, -2</GeoTransform><VRTRasterBand dataType="Float32" band="1">
<SimpleSource><SourceFilename>{}</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"""
WMS = """<GDAL_WMS><Service name="TMS"><ServerUrl>http://127.0.0.1:{}/${{z}}</ServerUrl></Service>
<DataWindow><UpperLeftX>500000</UpperLeftX><UpperLeftY>5400100</UpperLeftY><LowerRightX>500120</LowerRightX>
<LowerRightY>5399980</LowerRightY><SizeX>60</SizeX><SizeY>60</SizeY></DataWindow><Projection>EPSG:32632</Projection>
<BandsCount>1</BandsCount></GDAL_WMS>"""


def test_vrt_or_wms_named_tif_is_rejected_without_network_access(tmp_path, listener):
    port, calls = listener
    path = tmp_path / "dem.tif"
    for text in (VRT.format(f"/vsicurl/http://127.0.0.1:{port}/x.tif"), WMS.format(port), VRT.format("/etc/passwd")):
        path.write_text(text)
        assert "dem.tif: not readable as GeoTIFF" in complaint(lambda: heights_of(path))
    for name in (f"/vsicurl/http://127.0.0.1:{port}/x.tif", f"http://127.0.0.1:{port}/x.tif"):
        assert "no such file" in complaint(lambda name=name: heights_of(name))
    with socket.create_connection(("127.0.0.1", port)) as own:
        own.sendall(b"own")
    while not calls:
        pass
    assert calls == [b"own"]


def test_gdal_itself_connects_to_the_server_of_the_vrt(tmp_path, listener):
    """Confirms that the listener of the test above records connections."""
    port, calls = listener
    (tmp_path / "dem.tif").write_text(VRT.format(f"/vsicurl/http://127.0.0.1:{port}/x.tif"))
    with pytest.raises(rasterio.errors.RasterioIOError), rasterio.open(tmp_path / "dem.tif") as raster:
        raster.read(1)
    assert calls


AUX = """<PAMDataset><SRS>EPSG:32633</SRS><GeoTransform>500010, 2, 0, 5400100, 0, -2</GeoTransform>
<PAMRasterBand band="1">
<Offset>100</Offset><Scale>2</Scale><NoDataValue>600</NoDataValue></PAMRasterBand></PAMDataset>"""


@pytest.mark.parametrize(
    ("name", "text"), [("dem.tif.aux.xml", AUX), ("dem.tfw", "9\n0\n0\n-9\n0\n0\n"), ("dem.wld", "9\n0\n0\n-9\n0\n0\n")]
)
def test_sidecar_file_of_a_dem_is_ignored(tmp_path, name, text):
    path = write_dem(tmp_path / "dem.tif")
    alone = heights_of(path)
    (tmp_path / name).write_text(text)
    np.testing.assert_array_equal(heights_of(path), alone)
    with rasterio.open(path) as raster:  # plain GDAL applies the .aux.xml
        assert name != "dem.tif.aux.xml" or raster.offsets[0] == 100


def test_external_mask_or_overview_of_a_dem_is_ignored(tmp_path):
    path = write_dem(tmp_path / "dem.tif")
    alone = heights_of(path)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK="NO"), rasterio.open(path, "r+") as raster:
        raster.write_mask(np.zeros((60, 60), bool))
    write_dem(tmp_path / "dem.tif.ovr", np.zeros((30, 30), np.float32))
    assert (tmp_path / "dem.tif.msk").is_file()
    np.testing.assert_array_equal(heights_of(path), alone)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7])
def test_truncated_dem_is_one_message(tmp_path, share):
    path = write_dem(tmp_path / "dem.tif", compress="deflate", tiled=True, blockxsize=16, blockysize=16)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    message = complaint(lambda: heights_of(path))
    assert message.startswith(str(path))
    assert "not readable as GeoTIFF" in message


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((500000, 5400100, 0, 2), "no geodetic CRS"),  # GDAL reads such a file without a CRS
        ((500000, 5400100, 1e-300, 1e-300), "a degenerate transform [1e-300, "),
        ((500000, 5400100, float("nan"), 2), "a degenerate transform [nan, "),
    ],
)
def test_degenerate_transform_is_rejected(tmp_path, place, expected):
    path = write_dem(tmp_path / "dem.tif", place=place)
    message = complaint(lambda: heights_of(path))
    assert expected in message


def test_dem_with_a_billion_declared_rows_is_rejected(tmp_path):
    path = write_dem(tmp_path / "dem.tif")
    for tag in (256, 257, 278):  # width, height, rows of a strip
        tagged(path, tag, 4, 10**9)
    assert "dem.tif: " in complaint(lambda: heights_of(path))


def test_dem_with_too_many_posts_is_rejected_before_reading(tmp_path):
    """With half a micrometre between posts, 120 m of scene contain 10^16 posts."""
    side = 1 << 20
    path = tmp_path / "dem.tif"
    shape = {"height": side, "width": side, "count": 1, "dtype": "float32", "SPARSE_OK": True}
    tiles = {"tiled": True, "blockxsize": 4096, "blockysize": 4096, "crs": "EPSG:32632"}
    with rasterio.open(path, "w", "GTiff", transform=from_origin(500000, 5400100, 1e-4, 1e-4), **shape, **tiles):
        pass
    message = complaint(lambda: heights_of(path))
    assert f"at most {MOST_POSTS} posts at once" in message


def test_complex_heights_are_rejected(tmp_path):
    path = write_dem(tmp_path / "dem.tif", np.ones((60, 60), np.complex64))
    assert "heights of type complex64" in complaint(lambda: heights_of(path))


# Geoid grids


def gtx(path, *, rows=9, values=None, header=(47.0, 7.0, 0.5, 0.5)):
    values = np.linspace(40, 50, 81) if values is None else values
    path.write_bytes(struct.pack(">4d2i", *header, rows, 9) + values.astype(">f4").tobytes())
    return path


def lifted(path):
    return undulation(geoid_file("egm96", path), np.array([9.0]), np.array([48.5]))


def test_grid_size_must_match_its_header(tmp_path):
    path = tmp_path / "egm96.gtx"
    assert 40 < lifted(gtx(path))[0] < 50
    for rows in (8, 10, -9, 0, 2**31 - 1):
        assert "bytes for" in complaint(lambda rows=rows: lifted(gtx(path, rows=rows)))
    for header in ((np.nan, 7, 0.5, 0.5), (47, 7, 0, 0.5), (47, 7, 0.5, -1), (47, 1e300, 0.5, 0.5)):
        assert "a grid that starts" in complaint(lambda header=header: lifted(gtx(path, header=header)))
    path.write_bytes(b"short")
    assert "5 bytes" in complaint(lambda: lifted(path))


def test_implausible_undulation_is_rejected(tmp_path):
    for value in (1e30, -2000.0, np.nan):
        path = gtx(tmp_path / "egm96.gtx", values=np.full(81, value))
        assert "no valid undulation at longitude" in complaint(lambda path=path: lifted(path))


@pytest.mark.parametrize(
    ("place", "shape"),
    [((6.75, 51.25, 0.5, 0.5), (9, 9)), ((-180, 90, 10, 7.5), (24, 36)), ((0, 90, 10, 7.5), (24, 36))],
)
def test_tif_grid_matches_proj(tmp_path, place, shape):
    """A regional and a global grid, also with a post beyond the last column."""
    values = np.random.default_rng(1).uniform(-50, 50, shape).astype(np.float32)
    path = write_dem(tmp_path / "egm96.tif", values, place, "EPSG:4326", nodata=-999)
    west, south = (-179.9, -80) if shape[1] > 9 else (7.1, 47.1)
    east, north = (179.9, 80) if shape[1] > 9 else (10.9, 50.9)
    longitude, latitude = np.random.default_rng(2).uniform([west, south], [east, north], (500, 2)).T
    radians = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad"
    shift = Transformer.from_pipeline(f"{radians} +step +proj=vgridshift +grids={path} +multiplier=1")
    expected = shift.transform(longitude, latitude, np.zeros(500))[2]
    np.testing.assert_allclose(undulation(path, longitude, latitude), expected, atol=1e-6)
    values[:] = -999
    write_dem(path, values, place, "EPSG:4326", nodata=-999)
    assert "no valid undulation at longitude" in complaint(lambda: undulation(path, longitude, latitude))


def test_tif_without_rows_per_strip_is_read(tmp_path):
    """The tag RowsPerStrip is missing; the reader of PROJ divides by zero and ends the process."""
    path = write_dem(tmp_path / "egm96.tif", np.full((9, 9), 45, np.float32), (6.75, 51.25, 0.5, 0.5), "EPSG:4326")
    rows_of_a_strip, unknown = (struct.pack("<HHI", tag, 3, 1) for tag in (278, 30000))
    path.write_bytes(path.read_bytes().replace(rows_of_a_strip, unknown))
    assert lifted(path)[0] == 45


def test_grid_of_another_suffix_or_format_is_rejected(tmp_path):
    assert "a file of type '.gsb'" in complaint(lambda: lifted(gtx(tmp_path / "egm96.gsb")))
    (tmp_path / "egm96.tif").write_text(VRT.format("/etc/passwd"))
    assert "not readable as GeoTIFF" in complaint(lambda: lifted(tmp_path / "egm96.tif"))
