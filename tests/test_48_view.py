"""How an image says that it saw its scene, against the layers that are computed pixel by pixel."""

import json

import numpy as np
import pytest
import rasterio

import apertura as ap
from apertura.campaign.store import open_stage
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.imaging.view import view_report

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


def view_of(track_m):
    """The view of a scene about (0, 20) from a track past it."""
    frequency = 1.2e9 + 1e6 * np.arange(64)
    history = ap.PhaseHistory(
        np.ones((len(track_m), 64), np.complex64),
        frequency,
        np.full(64, 1 / 64),
        np.full(len(track_m), 2 * np.hypot(20, 10) / SPEED_OF_LIGHT_M_S),
        ap.Aperture(track_m, track_m),
    )
    image = ap.backproject(history, ap.SceneGrid("local", -2.0, 22.0, 0.2, (20, 20)), judge=False).data
    formation = image.dask.layers[image.name].origin
    return view_report(formation, np.datetime64("2025-05-14", "ns"), np.arange(len(track_m)) / 10)


def flown(north_m=0.0):
    east = np.linspace(-5, 5, 101)
    return np.stack([east, np.broadcast_to(north_m, 101), np.full(101, 10.0)], -1)


def test_the_side_is_that_of_the_scene_and_no_straight_track_observes_it():
    for track, side in ((flown(), "left"), (flown()[::-1], "right")):
        view = view_of(track)
        assert (view["side"], view["side_observable"]) == (side, False)
        assert view["side_mirror_rad"] < 1e-6


@pytest.mark.slow
def test_a_track_that_bends_sideways_observes_its_side_and_one_that_bobs_does_not():
    """4π/λ·2w sin θ of a lateral rms w: a mirrored point is out of phase by it."""
    bend = 0.05 * np.sin(np.linspace(-9, 9, 101))
    view = view_of(flown(bend))
    wavelength = SPEED_OF_LIGHT_M_S / (1.2e9 + 32e6)
    line = np.polyval(np.polyfit(np.linspace(-5, 5, 101), bend, 1), np.linspace(-5, 5, 101))
    expected = 8 * np.pi / wavelength * np.std(bend - line) * np.sin(np.arctan2(20, 10))
    assert view["side_mirror_rad"] == pytest.approx(expected, rel=0.02)
    assert view["side_observable"]
    bobbing = flown() + np.outer(bend, [0, 0, 1])
    assert not view_of(bobbing)["side_observable"]


def test_a_track_around_the_scene_has_no_side():
    turn = np.linspace(0, 2 * np.pi, 201)[:-1]
    wave = np.stack([10 * np.sin(turn), 20 + 10 * np.sin(2 * turn), np.full(200, 10.0)], -1)
    assert view_of(wave)["side"] == "both"


def test_tags_state_time_frequency_side_and_incidence_as_the_report_does(finished_tiny):
    folder = finished_tiny.results / "f01" / "uav1-uav2"
    view = json.loads((folder / "image.json").read_text())["view"]
    with rasterio.open(str(folder / "db.tif")) as raster:
        tags = raster.tags()
    assert tags["APERTURA_ACQUISITION_START"] == f"{view['first_utc'][:26]}Z"
    assert float(tags["APERTURA_CENTRE_FREQUENCY_HZ"]) == view["centre_hz"]
    assert float(tags["APERTURA_WAVELENGTH_M"]) == pytest.approx(SPEED_OF_LIGHT_M_S / view["centre_hz"], rel=1e-5)
    assert float(tags["APERTURA_INCIDENCE_DEG"]) == pytest.approx(view["incidence_deg"], abs=0.01)
    assert tags["APERTURA_LOOK_SIDE"].split(",")[0] == view["side"] == "right"
    date, time = view["first_utc"][:19].split("T")
    assert tags["TIFFTAG_DATETIME"] == f"{date.replace('-', ':')} {time}"


def test_a_flight_is_timed_by_its_pulses(finished_tiny):
    for pair in PAIRS:
        view = open_stage(finished_tiny.stage("image", "f01", pair), "image").attrs["quality"]["view"]
        echo = open_stage(finished_tiny.stage("echo", "f01", pair), "echo")
        assert np.datetime64(view["first_utc"]) == echo.time.values[0]
        assert abs(np.datetime64(view["last_utc"]) - echo.time.values[-1]) < np.timedelta64(1, "us")
