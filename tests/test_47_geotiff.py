"""`apertura.write_geotiff` and `apertura.read_geotiff`: values, positions, certificate, and refusals."""

import json

import numpy as np
import pytest
import rasterio
import xarray as xr
from folders import complaint

import apertura as ap


def history():
    frequency = 1.2e9 + 4e6 * np.arange(64)
    track = np.stack([np.linspace(-4, 4, 128), np.full(128, -20.0), np.full(128, 10.0)], -1)
    aperture = ap.Aperture(track, track)
    delay_s = aperture.path(np.array([[0.4, -0.3, 0.0]])) / 299792458.0
    echo = np.exp(-2j * np.pi * frequency * delay_s).astype(np.complex64)
    return ap.PhaseHistory(echo, frequency, np.full(64, 1 / 64), np.zeros(128), aperture)


@pytest.fixture(scope="module")
def image():
    return ap.backproject(history(), ap.SceneGrid("local", -5.0, 5.0, 0.1, (80, 100)), calibration=1.0, tile_px=32)


def on_map(values, **attributes):
    """Return an array on a UTM grid of 0.1 m whose coordinates have no exact binary representation."""
    grid = ap.SceneGrid("EPSG:32632", 570655.3, 5363713.2, 0.1, values.shape)
    return xr.DataArray(values, grid.coordinates, ("y", "x"), attrs=attributes)


def test_complex_image_keeps_values_positions_and_certificate(image, tmp_path):
    read = ap.read_geotiff(ap.write_geotiff(image, tmp_path / "new" / "image.tif", title="a title"))
    np.testing.assert_array_equal(read.values, image.values)
    assert read.dtype == np.complex64
    for axis in "xy":
        np.testing.assert_allclose(read[axis], image[axis], rtol=0, atol=1e-9)
    certificate = ("numerical_error_db", "numerical_error_confidence", "predicted_error_db", "wave_speed_m_s")
    texts = ("verdict", "verdict_reason", "flags", "models", "budget", "setting")
    for name in (*certificate, *texts):
        assert read.attrs[name] == image.attrs[name], name
    assert read.attrs["TIFFTAG_IMAGEDESCRIPTION"] == "a title"


def test_brightest_pixel_is_at_the_target_in_gdal(image, tmp_path):
    """The outer corner of the first pixel is the origin of the raster: half a pixel is 5 cm here."""
    with rasterio.open(ap.write_geotiff(image, tmp_path / "db.tif", db=True)) as raster:
        level = raster.read(1)
        x, y = raster.xy(*np.unravel_index(np.nanargmax(level), level.shape))
        assert raster.units == ("dB",)
        assert raster.tags()["APERTURA_ERROR_DB"] == str(image.attrs["numerical_error_db"])
    assert np.hypot(x - 0.4, y + 0.3) < 0.1
    assert np.nanmax(level) == pytest.approx(20 * np.log10(float(abs(image).max())), abs=1e-4)


@pytest.mark.parametrize("ahead_m", [0.0, 6.0])
def test_phase_of_a_complex_file_is_that_of_its_tag(tmp_path, ahead_m):
    """Around a point, the phase increases by one cycle per wavelength of total path, monostatic and bistatic."""
    frequency, target = 1.2e9 + 4e6 * np.arange(64), np.array([0.4, -0.3, 0.0])
    track = np.stack([np.linspace(-4, 4, 128), np.full(128, -20.0), np.full(128, 10.0)], -1)
    aperture = ap.Aperture(track, track + [ahead_m, 0.0, 0.0])
    echo = np.exp(-2j * np.pi * frequency * aperture.path(target[None]) / 299792458.0).astype(np.complex64)
    history = ap.PhaseHistory(echo, frequency, np.full(64, 1 / 64), np.zeros(128), aperture)
    image = ap.backproject(history, ap.SceneGrid("local", 0.0, 0.1, 0.01, (80, 80)), accuracy_db=-80)
    path = ap.write_geotiff(image, tmp_path / "slc.tif")
    with rasterio.open(path) as raster:
        assert "increases by 1 cycle per wavelength of total path" in raster.tags()["APERTURA_PHASE"]
    read = ap.read_geotiff(path)
    middle_m = aperture.path(np.stack([*np.meshgrid(read.x, read.y), np.zeros((80, 80))], -1).reshape(-1, 3)).mean(
        axis=0
    )
    removed = read.values.ravel() * np.exp(-2j * np.pi * middle_m * frequency.mean() / 299792458.0)
    near = np.abs(read.values).ravel() > 0.7 * np.abs(read.values).max()
    assert near.sum() > 20
    spread = np.angle(removed[near] * removed[near].sum().conj())
    assert np.std(spread) < 0.15
    assert np.std(np.angle(read.values.ravel()[near] * read.values.ravel()[near].sum().conj())) > 0.5


def test_calibrated_values_have_their_unit_and_meaning(image, tmp_path):
    with rasterio.open(ap.write_geotiff(image.rcs, tmp_path / "rcs.tif")) as raster:
        np.testing.assert_array_equal(raster.read(1), image.rcs.values)
        assert raster.units == ("m2",)
        assert raster.descriptions == ("radar cross-section of a point at the pixel",)
        assert "APERTURA_ERROR_DB" not in raster.tags()  # the array states no error


def test_south_up_array_is_written_north_up(tmp_path):
    values = np.arange(12.0).reshape(3, 4)
    north_up = on_map(values)
    south_up = north_up.isel(y=slice(None, None, -1))
    first, second = (ap.read_geotiff(ap.write_geotiff(one, tmp_path / "a.tif")) for one in (north_up, south_up))
    xr.testing.assert_identical(first, second)
    np.testing.assert_array_equal(first.values, values)


def test_pixels_without_data_stay_without_data(tmp_path):
    values = np.ones((4, 5), np.complex64)
    values[1:3, 2] = complex(np.nan, np.nan)
    read = ap.read_geotiff(ap.write_geotiff(on_map(values), tmp_path / "a.tif"), chunks=2)
    assert read.chunks == ((2, 2), (2, 2, 1))
    np.testing.assert_array_equal(read.values, values)


def test_tags_of_the_caller_replace_those_of_the_certificate(tmp_path):
    array = on_map(np.ones((2, 2)), numerical_error_db=-50.0, flags=json.dumps({"hover": "1 s"}))
    tags = {"APERTURA_ERROR_DB": "-30", "CRUISE": "3"}
    read = ap.read_geotiff(ap.write_geotiff(array, tmp_path / "a.tif", tags=tags))
    assert read.attrs["numerical_error_db"] == -30
    assert read.attrs["CRUISE"] == 3
    assert json.loads(read.attrs["flags"]) == {"hover": "1 s"}


def test_product_of_a_campaign_is_read_with_its_certificate(finished_tiny):
    read = ap.read_geotiff(str(finished_tiny.results / "f01" / "uav1-uav1" / "slc.tif"))
    report = json.loads((finished_tiny.results / "f01" / "uav1-uav1" / "image.json").read_text())
    assert read.attrs["numerical_error_db"] == pytest.approx(report["numerical_error_db"], abs=0.006)
    assert read.attrs["verdict"] == report["focus"]["verdict"]
    assert json.loads(read.attrs["flags"]) == report["flags"]


GAP = on_map(np.ones((4, 6))).isel(x=[0, 1, 3, 4])
REFUSED = {
    "rows of a cube": (on_map(np.ones((2, 2))).expand_dims("flight"), {}, "dimensions ('flight', 'y', 'x')"),
    "numpy array": (np.ones((2, 2)), {}, "an object of type ndarray"),
    "no CRS": (on_map(np.ones((2, 2))).drop_vars("spatial_ref"), {}, "an array without a CRS"),
    "gap": (GAP, {}, "coordinate steps from"),
    "one pixel": (on_map(np.ones((1, 1))), {}, "a single pixel"),
    "real in dB": (on_map(np.ones((2, 2))), {"db": True}, "real values (float64)"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_arrays_that_are_no_image_on_a_grid_are_refused(name, tmp_path):
    array, options, found = REFUSED[name]
    assert found in complaint(lambda: ap.write_geotiff(array, tmp_path / "a.tif", **options))
    assert not list(tmp_path.iterdir())


def test_file_that_is_no_raster_is_refused(tmp_path):
    (tmp_path / "a.tif").write_text("x,y\n")
    assert "cannot be opened" in complaint(lambda: ap.read_geotiff(tmp_path / "a.tif"))


def test_file_of_several_bands_is_refused(tmp_path):
    with rasterio.open(tmp_path / "rgb.tif", "w", driver="GTiff", width=4, height=4, count=3, dtype="uint8") as raster:
        raster.write(np.zeros((3, 4, 4), np.uint8))
    assert "3 bands" in complaint(lambda: ap.read_geotiff(tmp_path / "rgb.tif"))
