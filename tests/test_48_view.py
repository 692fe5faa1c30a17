"""Viewing geometry of an image: angles, carrier, side and times, compared with layers, echo and tags."""

import json
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio

import apertura as ap
from apertura.campaign.store import open_stage
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.imaging.view import view_report

PAIRS = ("uav1-uav1", "uav1-uav2")


@pytest.mark.parametrize("pair", PAIRS)
def test_view_angles_agree_with_the_layers_at_the_centre(finished_tiny, pair):
    folder = finished_tiny.results / "f01" / pair
    view = json.loads((folder / "image.json").read_text())["view"]
    for name in ("incidence", "bistatic_angle"):
        with rasterio.open(str(folder / f"{name}.tif")) as raster:
            rows, columns = (slice(size // 2 - 1, size // 2 + 1) for size in raster.shape)
            middle = raster.read(1)[rows, columns].mean()
        assert view[f"{name}_deg"] == pytest.approx(middle, abs=0.1)


@pytest.mark.parametrize("pair", PAIRS)
def test_spatial_carrier_of_the_view_is_that_of_the_image(finished_tiny, pair):
    """Power-weighted mean phase difference between adjacent pixels, modulo one cycle."""
    image = open_stage(finished_tiny.stage("image", "f01", pair), "image")
    east, north = image.attrs["quality"]["view"]["carrier_cycles_m"]
    values, spacing_m = image.image.values, 0.1
    for axis, cycles in ((1, east), (0, -north)):
        ahead = np.take(values, range(1, 60), axis) * np.take(values, range(59), axis).conj()
        measured = np.angle(ahead.sum()) / (2 * np.pi)
        assert abs((measured - cycles * spacing_m + 0.5) % 1 - 0.5) < 0.02


def view_of(track_m, positions_at=None):
    """Return the view report of a scene centred at (0, 20) for a track."""
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
    scene = SimpleNamespace(profiles=formation.profiles, beams=None, grid=formation.grid)
    scene.positions_at = partial(positions_at, formation.grid) if positions_at else formation.positions_at
    return view_report(scene, np.datetime64("2025-05-14", "ns"), np.arange(len(track_m)) / 10)


def test_angles_of_the_view_are_referred_to_the_vertical_on_slopes():
    """A slope of 35 degrees at the scene centre changes the local incidence, not the incidence at the ellipsoid."""
    track = straight_track()
    level, slope = view_of(track), np.tan(np.radians(35.0))

    def tilted(grid, row, column):
        x, y = grid.map_at(np.asarray(row), np.asarray(column)).T
        return np.stack([x, y, slope * (y - 20.0) + 0.2 * x], -1)

    view = view_of(track, positions_at=tilted)
    assert view["incidence_deg"] == pytest.approx(np.degrees(np.arctan2(20, 10)), abs=0.3)
    for name in ("incidence_deg", "height_m", "heading_deg", "look_deg"):
        assert view[name] == pytest.approx(level[name], abs=0.05)


def straight_track(north_m=0.0):
    east = np.linspace(-5, 5, 101)
    return np.stack([east, np.broadcast_to(north_m, 101), np.full(101, 10.0)], -1)


def test_side_of_a_straight_track_is_stated_but_not_observable():
    for track, side in ((straight_track(), "left"), (straight_track()[::-1], "right")):
        view = view_of(track)
        assert (view["side"], view["side_observable"]) == (side, False)
        assert view["side_mirror_rad"] < 1e-6


@pytest.mark.slow
def test_side_is_observable_with_lateral_but_not_vertical_motion():
    """The phase error of a mirrored point for a lateral rms deviation w is 4π/λ·2w sin θ."""
    bend = 0.05 * np.sin(np.linspace(-9, 9, 101))
    view = view_of(straight_track(bend))
    wavelength = SPEED_OF_LIGHT_M_S / (1.2e9 + 32e6)
    line = np.polyval(np.polyfit(np.linspace(-5, 5, 101), bend, 1), np.linspace(-5, 5, 101))
    expected = 8 * np.pi / wavelength * np.std(bend - line) * np.sin(np.arctan2(20, 10))
    assert view["side_mirror_rad"] == pytest.approx(expected, rel=0.02)
    assert view["side_observable"]
    vertical = straight_track() + np.outer(bend, [0, 0, 1])
    assert not view_of(vertical)["side_observable"]


def test_track_around_the_scene_has_no_side():
    angle = np.linspace(0, 2 * np.pi, 201)[:-1]
    track = np.stack([10 * np.sin(angle), 20 + 10 * np.sin(2 * angle), np.full(200, 10.0)], -1)
    assert view_of(track)["side"] == "both"


def test_tags_agree_with_the_view_of_the_report(finished_tiny):
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


def test_times_of_the_view_are_those_of_the_pulses(finished_tiny):
    for pair in PAIRS:
        view = open_stage(finished_tiny.stage("image", "f01", pair), "image").attrs["quality"]["view"]
        echo = open_stage(finished_tiny.stage("echo", "f01", pair), "echo")
        assert np.datetime64(view["first_utc"]) == echo.time.values[0]
        assert abs(np.datetime64(view["last_utc"]) - echo.time.values[-1]) < np.timedelta64(1, "us")
