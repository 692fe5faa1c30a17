"""How an image says that it saw its scene, against the layers that are computed pixel by pixel."""

import json

import numpy as np
import pytest
import rasterio

from apertura.pipeline.store import open_stage

PAIRS = ("uav1-uav1", "uav1-uav2")


@pytest.mark.parametrize("pair", PAIRS)
def test_angles_of_the_view_are_those_of_the_layers_in_the_middle(finished_tiny, pair):
    folder = finished_tiny.results / "f01" / pair
    view = json.loads((folder / "image.json").read_text())["view"]
    for name in ("incidence", "bistatic_angle"):
        with rasterio.open(str(folder / f"{name}.tif")) as raster:
            rows, columns = (slice(size // 2 - 1, size // 2 + 1) for size in raster.shape)
            middle = raster.read(1)[rows, columns].mean()
        assert view[f"{name}_deg"] == pytest.approx(middle, abs=0.1)


@pytest.mark.parametrize("pair", PAIRS)
def test_the_carrier_of_the_view_is_that_of_the_images_band(finished_tiny, pair):
    """The mean turn from pixel to pixel over the image, weighed by power, up to whole turns."""
    image = open_stage(finished_tiny.stage("image", "f01", pair), "image")
    east, north = image.attrs["quality"]["view"]["carrier_cycles_m"]
    values, spacing_m = image.image.values, 0.1
    for axis, cycles in ((1, east), (0, -north)):
        ahead = np.take(values, range(1, 60), axis) * np.take(values, range(59), axis).conj()
        turn = np.angle(ahead.sum()) / (2 * np.pi)
        assert abs((turn - cycles * spacing_m + 0.5) % 1 - 0.5) < 0.02


def test_a_flight_is_timed_by_its_pulses(finished_tiny):
    for pair in PAIRS:
        view = open_stage(finished_tiny.stage("image", "f01", pair), "image").attrs["quality"]["view"]
        echo = open_stage(finished_tiny.stage("echo", "f01", pair), "echo")
        assert np.datetime64(view["first_utc"]) == echo.time.values[0]
        assert abs(np.datetime64(view["last_utc"]) - echo.time.values[-1]) < np.timedelta64(1, "us")
