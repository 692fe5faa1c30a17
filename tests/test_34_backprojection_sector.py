"""Integration sector: equal weights in all engines, smooth over the scene; pulses outside cost no time."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scenes import (
    compiled,
    decibels,
    ecef,
    fly,
    monostatic,
    pixel_grid,
    scatter,
    straight_track,
    strip_history,
    swaying_beam,
)

from apertura.core.antenna.beam import Beams
from apertura.core.antenna.illumination import illumination_mask
from apertura.core.backprojection.engines import native, numba, reference
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.reach import PULSES, Reach
from apertura.core.backprojection.tiles import Weighing, image_array
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.sector import Sector, edge, flight_axes
from apertura.core.imaging.range_profiles import RangeWindow, range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.swath import swath
from apertura.core.scene.terrain import FlatGround

FLAT = FlatGround(0.0)


@pytest.fixture(scope="module")
def flight():
    pixels = pixel_grid(40, 60)
    scene = fly(scatter(pixels), pulses=131)
    return SimpleNamespace(
        scene=scene, pixels=pixels, profiles=scene.profiles(ecef(pixels)), aperture=Aperture(scene.tx, scene.rx)
    )


def sector_of(aperture: Aperture, half: float, centre: float = 0.02) -> Sector:
    return Sector.of(aperture, chord_m=1.2, centre=centre, half=half)


def strip(pulses: int = 3000, length_m: float = 150.0) -> tuple[Aperture, SceneGrid]:
    """Return a straight eastward flight and the grid of a strip north of it."""
    along = np.linspace(-length_m / 2, length_m / 2, pulses)
    track = np.stack([along, 0 * along, np.full(pulses, 20.0)], -1)
    return monostatic(track), SceneGrid("local", -length_m / 2, 46.0, 0.5, (32, int(2 * length_m)))


def test_weight_is_largest_at_the_shortest_total_path():
    """This also holds for antennas with different speeds."""
    along = np.linspace(-40, 40, 801)[:, None] * [1.0, 0.0, 0.0]
    aperture = Aperture(along + [0, 0, 10.0], 0.4 * along + [-6.0, -3.0, 12.0])
    points = np.array([[-5.0, 30.0, 0.0], [0.0, 20.0, 0.0], [9.0, 40.0, 2.0]])
    sector = Sector.of(aperture, chord_m=1.0, centre=0.0, half=0.05)
    shortest = aperture.path(points).argmin(axis=0)
    weight = sector.weight(aperture, points)
    middles = (weight * np.arange(801)[:, None]).sum(axis=0) / weight.sum(axis=0)
    np.testing.assert_allclose(middles, shortest, atol=3)
    tx, rx = flight_axes(aperture, chord_m=1.0)
    np.testing.assert_allclose(np.linalg.norm(tx, axis=1) + np.linalg.norm(rx, axis=1), 1)


@pytest.mark.quick("*-False-0.04", "*-True-0.25")
@compiled
@pytest.mark.parametrize("half", [0.04, 0.1, 0.25])
@pytest.mark.parametrize("antenna", [False, True])
def test_engines_agree_on_both_sides_of_the_edge(isa, flight, half, antenna):
    """Pulses are inside, at the edge and outside; the sector ends within the last, incomplete batch."""
    beam = swaying_beam(flight.scene.tx, (12, 0, 0)) if antenna else None
    beams, points = Beams(beam, None, sector_of(flight.aperture, half)), ecef(flight.pixels)
    weight = beams.sector.weight(flight.aperture, points.reshape(-1, 3))
    assert {0.0, 1.0} <= set(weight[:, 0]) or half == 0.25
    truth, counts = reference.form(flight.scene.history(), points, beams=beams), np.zeros(4, np.int64)
    image = native.form(native.prepare(flight.profiles), points, beams=beams, counts=counts)
    other = numba.form(numba.prepare(flight.profiles), points, beams=beams)
    assert decibels(image - truth, truth) <= -70
    assert decibels(other - truth, truth) <= -70
    whole = reference.form(flight.scene.history(), points, beams=beams.antennas)
    assert decibels(whole - truth, truth) > -25  # the sector has an effect
    assert counts[3] > 0 or half == 0.25


@pytest.mark.quick("*-False-0.04", "*-True-0.1")
@compiled
@pytest.mark.parametrize("half", [0.04, 0.1, 0.25])
@pytest.mark.parametrize("rough", [False, True])
def test_engines_agree_if_the_sector_centre_follows_the_flight(isa, flight, half, rough):
    """The sector is far ahead of the flight, so that each pixel has a separate centre, which varies within blocks."""
    pixels = flight.pixels.copy()
    if rough:
        pixels[..., 2] = 0.05 * np.sin(2 * pixels[..., 0])
    points = ecef(pixels)
    ahead = sector_of(flight.aperture, half, centre=0.6).following(flight.aperture, points[::8, ::8].reshape(-1, 3))
    centres, beams = ahead.centre_at(points), Beams(sector=ahead)
    assert np.ptp(centres) > 0.05
    assert centres.max() < 0.6
    truth, counts = reference.form(flight.scene.history(), points, beams=beams), np.zeros(4, np.int64)
    tables = native.prepare(flight.scene.profiles(points))
    image = native.form(tables, points, beams=beams, counts=counts)
    assert decibels(image - truth, truth) <= -70
    assert counts[1] > 0 or rough  # weighted block by block, not only pixel by pixel
    part = native.form(tables, points[16:, 32:], beams=beams)
    np.testing.assert_array_equal(part.view(np.uint32), image[16:, 32:].view(np.uint32))


@compiled
def test_rough_surface_is_weighted_at_its_height_at_the_edge(isa, flight):
    rough = flight.pixels.copy()
    rough[..., 2] = 0.3 * np.sin(2 * rough[..., 0]) + 0.04 * np.random.default_rng(6).standard_normal(rough.shape[:2])
    points, beams = ecef(rough), Beams(sector=sector_of(flight.aperture, 0.15))
    image = native.form(native.prepare(flight.scene.profiles(points)), points, beams=beams)
    truth = reference.form(flight.scene.history(), points, beams=beams)
    assert decibels(image - truth, truth) <= -65


@compiled
def test_pulses_inside_a_sector_use_the_unweighted_path(isa, flight):
    """If the whole scene is inside, path variants are unchanged and images are bit-identical."""
    tables, points = native.prepare(flight.profiles), ecef(flight.pixels)
    counts = np.zeros((2, 4), np.int64)
    plain = native.form(tables, points, counts=counts[0])
    within = native.form(tables, points, beams=Beams(sector=sector_of(flight.aperture, 2.0)), counts=counts[1])
    np.testing.assert_array_equal(plain.view(np.uint32), within.view(np.uint32))
    np.testing.assert_array_equal(*counts)


@compiled
def test_tiled_images_have_no_seams(isa, flight):
    """Tiles are bit-identical to the whole; weights vary across tile borders as little as inside tiles."""
    beams, points = Beams(sector=sector_of(flight.aperture, 0.1)), ecef(flight.pixels)
    tables = native.prepare(flight.profiles)
    whole, part = (native.form(tables, pixels, beams=beams) for pixels in (points, points[16:, 32:]))
    np.testing.assert_array_equal(part.view(np.uint32), whole[16:, 32:].view(np.uint32))
    weight = beams.sector.weight(flight.aperture, points.reshape(-1, 3)).reshape(131, *points.shape[:2])
    steps = np.abs(np.diff(weight, axis=2)).max(axis=(0, 1))
    assert steps[31] <= 1.5 * np.median(steps)


def test_sector_coordinate_follows_its_definition_next_to_undefined_points():
    track = straight_track(9) + [4.1e6, 0.9e6, 4.8e6]
    aperture, points = monostatic(track), track[4] + np.array([[0.3, 17.0, -9.0], [np.nan] * 3, [-4.0, 30.0, -10.0]])
    sector = Sector.of(aperture, chord_m=2.0, centre=0.1, half=0.25)
    lines_of_sight = points[None] - track[:, None]
    toward = 2 * lines_of_sight / np.linalg.norm(lines_of_sight, axis=-1, keepdims=True)
    expected = np.einsum("pnx,px->pn", toward, sector.tx_axis) - 0.1
    np.testing.assert_allclose(sector.place(aperture, points), expected, atol=1e-9)
    assert sector[:0].place(aperture[:0], points).shape == (0, 3)


def test_edge_weight_has_zero_slope_at_both_ends():
    depth = np.linspace(-0.5, 1.5, 2001)
    slope = np.gradient(edge(depth), depth)
    assert np.abs(np.diff(slope)).max() < 0.01


@pytest.mark.quick("False-0.05")
@pytest.mark.parametrize("centre", [0.05, 0.9])
@pytest.mark.parametrize("antenna", [False, True])
def test_excluded_pulses_have_zero_weight(antenna, centre):
    """Each pulse with a non-zero weight in a region belongs to a block that is selected for it."""
    generator = np.random.default_rng(3)
    along = np.linspace(-60, 60, 1000)
    sway = np.stack([along, 2 * np.sin(along / 9), 20 + np.cos(along / 5)], -1)
    aperture = Aperture(sway, sway + [3.0, 0.5, 1.0])
    beam = swaying_beam(sway, (20, 0, 0), 30) if antenna else None
    middle = generator.uniform([-70, 10, -2], [70, 60, 4], (40, 3))
    sector = Sector.of(aperture, chord_m=3.0, centre=centre, half=0.12)
    beams = Beams(beam, None, sector if centre < 0.5 else sector.following(aperture, middle))
    radius = generator.uniform(0.1, 9.0, 40)
    lit = illumination_mask(beams, aperture, middle, radius, pulses=PULSES)
    inside = middle + generator.uniform(-1, 1, (60, 40, 3)) * radius[:, None] / np.sqrt(3)
    weight = beams.weight(aperture, inside.reshape(-1, 3)).reshape(1000, 60, 40) != 0
    needed = np.add.reduceat(weight.any(axis=1), np.arange(0, 1000, PULSES), axis=0) > 0
    assert not (needed & ~lit).any()
    assert lit.mean() < 0.7  # a large fraction of the blocks is excluded


@compiled
def test_tiles_beyond_the_swath_are_not_formed():
    """A lazily read flight, with and without pulse blocks, gives the same image, and only required rows are read."""
    aperture, grid = strip()
    history = strip_history(aperture, np.array([[x, 36.0, 0.0] for x in (-60.0, -20.0, 0.0, 40.0)]))
    beams = Beams(sector=Sector.of(aperture, chord_m=4.0, centre=0.0, half=0.1))
    window = RangeWindow.of(
        aperture, grid, FLAT, history.frequency_hz, beams=beams, wave_speed_m_s=history.wave_speed_m_s
    )
    profiles, read = range_compress(history, grid, FLAT, window=window), []

    class RecordingSamples:
        shape, ndim, dtype = profiles.samples.shape, 2, profiles.samples.dtype

        def __len__(self):
            return self.shape[0]

        def __getitem__(self, pulses):
            read.append(pulses)
            return profiles.samples[pulses]

    weighing = Weighing(beams, None, 500)
    settings = [Setting("native", {"oversampling": 8}, {}, -60.0, 1.0, pulse_blocks=blocks) for blocks in (1, 7)]
    whole = image_array(profiles, settings[0], grid, FLAT, side_px=32, weighing=weighing).compute(scheduler="threads")
    lazy = image_array(
        replace(profiles, samples=RecordingSamples()), settings[1], grid, FLAT, side_px=32, weighing=weighing
    )
    assert decibels(lazy.compute(scheduler="threads") - whole, whole) < -120
    read.clear()
    tile = lazy[:, :32].compute(scheduler="threads")
    assert decibels(tile - whole[:, :32], whole) < -120
    assert 0 < max(pulses.stop for pulses in read) < 1000  # the first tile needs only this part of the flight
    beyond = grid[:, 64:96]
    away = replace(beyond, north_m=beyond.north_m + 400)
    narrow = Beams(sector=Sector.of(aperture[:640], chord_m=4.0, centre=0.0, half=0.1))
    reach = Reach.of(narrow, aperture[:640], away, FLAT, [(slice(0, 32), slice(0, 32))])
    assert reach.illuminated.tolist() == [True]
    far = replace(beyond, west_m=beyond.west_m + 150)
    assert not Reach.of(narrow, aperture[:640], far, FLAT, [(slice(0, 32), slice(0, 32))]).illuminated.any()


@pytest.mark.slow
def test_range_window_is_limited_by_the_sector():
    """The window covers weighted pixels at any flight length and is empty for pulses without weight in the scene."""
    spans = []
    for length in (150.0, 600.0):
        aperture, grid = strip(int(20 * length), length)
        beams = Beams(sector=Sector.of(aperture, chord_m=4.0, centre=0.0, half=0.1))
        near, far = swath(grid, FLAT, aperture, beams=beams)
        spans.append((far - near).max())
        points = FLAT.positions(grid)[::4, ::5].reshape(-1, 3)
        sampled = slice(0, None, 97)
        path, weight = aperture[sampled].path(points), beams[sampled].weight(aperture[sampled], points)
        assert ((path >= near[sampled, None]) & (path <= far[sampled, None]))[weight > 0].all()
    assert spans[1] == pytest.approx(spans[0], rel=0.15)
    aperture, _ = strip(3000, 150.0)
    beams = Beams(sector=Sector.of(aperture, chord_m=4.0, centre=0.0, half=0.1))
    near, far = swath(SceneGrid("local", -4.0, 46.0, 0.5, (16, 16)), FLAT, aperture, beams=beams)
    idle = ~np.isfinite(far)
    assert 0.5 < idle.mean() < 0.95
    assert np.abs(aperture.tx_m[~idle, 0]).max() < 15


def test_range_window_from_sampled_pulses_covers_all_pulses():
    """Every third of 40 000 pulses is evaluated; the window nevertheless covers the paths of all pulses."""
    aperture, grid = strip(40_000, 150.0)
    near, far = swath(grid, FLAT, aperture)
    sampled, points = slice(5, None, 1999), FLAT.positions(grid)[::8, ::10].reshape(-1, 3)
    path = aperture[sampled].path(points)
    assert (path >= near[sampled, None]).all()
    assert (path <= far[sampled, None]).all()
