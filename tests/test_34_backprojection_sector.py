"""The sector integrated: the same weights in every engine, smooth over the scene, and what is outside costs nothing."""

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
def flown():
    pixels = pixel_grid(40, 60)
    scene = fly(scatter(pixels), pulses=131)
    return SimpleNamespace(
        scene=scene, pixels=pixels, profiles=scene.profiles(ecef(pixels)), aperture=Aperture(scene.tx, scene.rx)
    )


def sector_of(aperture: Aperture, half: float, centre: float = 0.02) -> Sector:
    return Sector.of(aperture, chord_m=1.2, centre=centre, half=half)


def strip(pulses: int = 3000, length_m: float = 150.0) -> tuple[Aperture, SceneGrid]:
    """A straight flight eastward, and a strip north of it."""
    along = np.linspace(-length_m / 2, length_m / 2, pulses)
    track = np.stack([along, 0 * along, np.full(pulses, 20.0)], -1)
    return monostatic(track), SceneGrid("local", -length_m / 2, 46.0, 0.5, (32, int(2 * length_m)))


def test_a_pulse_counts_where_the_total_path_is_shortest():
    """For two antennas of other speeds the weight is largest at the pulse with the least total path."""
    along = np.linspace(-40, 40, 801)[:, None] * [1.0, 0.0, 0.0]
    aperture = Aperture(along + [0, 0, 10.0], 0.4 * along + [-6.0, -3.0, 12.0])
    places = np.array([[-5.0, 30.0, 0.0], [0.0, 20.0, 0.0], [9.0, 40.0, 2.0]])
    sector = Sector.of(aperture, chord_m=1.0, centre=0.0, half=0.05)
    shortest = aperture.path(places).argmin(axis=0)
    weight = sector.weight(aperture, places)
    middles = (weight * np.arange(801)[:, None]).sum(axis=0) / weight.sum(axis=0)
    np.testing.assert_allclose(middles, shortest, atol=3)
    tx, rx = flight_axes(aperture, chord_m=1.0)
    np.testing.assert_allclose(np.linalg.norm(tx, axis=1) + np.linalg.norm(rx, axis=1), 1)


@pytest.mark.quick("*-False-0.04", "*-True-0.25")
@compiled
@pytest.mark.parametrize("half", [0.04, 0.1, 0.25])
@pytest.mark.parametrize("antenna", [False, True])
def test_engines_agree_on_both_sides_of_the_edge(isa, flown, half, antenna):
    """Pulses wholly inside, at the edge, wholly outside; the last ones fill no batch, the sector ends within them."""
    beam = swaying_beam(flown.scene.tx, (12, 0, 0)) if antenna else None
    beams, places = Beams(beam, None, sector_of(flown.aperture, half)), ecef(flown.pixels)
    weight = beams.sector.weight(flown.aperture, places.reshape(-1, 3))
    assert {0.0, 1.0} <= set(weight[:, 0]) or half == 0.25
    truth, counts = reference.form(flown.scene.history(), places, beams=beams), np.zeros(4, np.int64)
    image = native.form(native.prepare(flown.profiles), places, beams=beams, counts=counts)
    other = numba.form(numba.prepare(flown.profiles), places, beams=beams)
    assert decibels(image - truth, truth) <= -70
    assert decibels(other - truth, truth) <= -70
    whole = reference.form(flown.scene.history(), places, beams=beams.antennas)
    assert decibels(whole - truth, truth) > -25  # the sector matters
    assert counts[3] > 0 or half == 0.25


@pytest.mark.quick("*-False-0.04", "*-True-0.1")
@compiled
@pytest.mark.parametrize("half", [0.04, 0.1, 0.25])
@pytest.mark.parametrize("rough", [False, True])
def test_engines_agree_where_the_centre_follows_what_was_flown(isa, flown, half, rough):
    """A sector far ahead of the flight: the centre of each pixel is its own, and changes within patches and blocks."""
    pixels = flown.pixels.copy()
    if rough:
        pixels[..., 2] = 0.05 * np.sin(2 * pixels[..., 0])
    places = ecef(pixels)
    ahead = sector_of(flown.aperture, half, centre=0.6).following(flown.aperture, places[::8, ::8].reshape(-1, 3))
    centres, beams = ahead.centre_at(places), Beams(sector=ahead)
    assert np.ptp(centres) > 0.05
    assert centres.max() < 0.6
    truth, counts = reference.form(flown.scene.history(), places, beams=beams), np.zeros(4, np.int64)
    tables = native.prepare(flown.scene.profiles(places))
    image = native.form(tables, places, beams=beams, counts=counts)
    assert decibels(image - truth, truth) <= -70
    assert counts[1] > 0 or rough  # weighed block by block, not only pixel by pixel
    part = native.form(tables, places[16:, 32:], beams=beams)
    np.testing.assert_array_equal(part.view(np.uint32), image[16:, 32:].view(np.uint32))


@compiled
def test_a_rough_surface_is_weighed_at_its_height_at_the_edge(isa, flown):
    rough = flown.pixels.copy()
    rough[..., 2] = 0.3 * np.sin(2 * rough[..., 0]) + 0.04 * np.random.default_rng(6).standard_normal(rough.shape[:2])
    places, beams = ecef(rough), Beams(sector=sector_of(flown.aperture, 0.15))
    image = native.form(native.prepare(flown.scene.profiles(places)), places, beams=beams)
    truth = reference.form(flown.scene.history(), places, beams=beams)
    assert decibels(image - truth, truth) <= -65


@compiled
def test_inside_a_sector_pulses_go_as_fast_as_without(isa, flown):
    """All of the scene inside: the same variants, and the same bits."""
    tables, places = native.prepare(flown.profiles), ecef(flown.pixels)
    counts = np.zeros((2, 4), np.int64)
    plain = native.form(tables, places, counts=counts[0])
    within = native.form(tables, places, beams=Beams(sector=sector_of(flown.aperture, 2.0)), counts=counts[1])
    np.testing.assert_array_equal(plain.view(np.uint32), within.view(np.uint32))
    np.testing.assert_array_equal(*counts)


@compiled
def test_images_by_parts_of_the_scene_have_no_seams(isa, flown):
    """A tile has the bits of the whole, and a weight changes between neighbours as little across tiles as inside."""
    beams, places = Beams(sector=sector_of(flown.aperture, 0.1)), ecef(flown.pixels)
    tables = native.prepare(flown.profiles)
    whole, part = (native.form(tables, pixels, beams=beams) for pixels in (places, places[16:, 32:]))
    np.testing.assert_array_equal(part.view(np.uint32), whole[16:, 32:].view(np.uint32))
    weight = beams.sector.weight(flown.aperture, places.reshape(-1, 3)).reshape(131, *places.shape[:2])
    steps = np.abs(np.diff(weight, axis=2)).max(axis=(0, 1))
    assert steps[31] <= 1.5 * np.median(steps)


def test_a_place_is_what_the_definition_says_in_any_frame_and_beside_one_that_is_none():
    track = straight_track(9) + [4.1e6, 0.9e6, 4.8e6]
    aperture, points = monostatic(track), track[4] + np.array([[0.3, 17.0, -9.0], [np.nan] * 3, [-4.0, 30.0, -10.0]])
    sector = Sector.of(aperture, chord_m=2.0, centre=0.1, half=0.25)
    away = points[None] - track[:, None]
    toward = 2 * away / np.linalg.norm(away, axis=-1, keepdims=True)
    expected = np.einsum("pnx,px->pn", toward, sector.tx_axis) - 0.1
    np.testing.assert_allclose(sector.place(aperture, points), expected, atol=1e-9)
    assert sector[:0].place(aperture[:0], points).shape == (0, 3)


def test_the_edge_is_level_at_both_ends():
    depth = np.linspace(-0.5, 1.5, 2001)
    slope = np.gradient(edge(depth), depth)
    assert np.abs(np.diff(slope)).max() < 0.01


@pytest.mark.quick("False-0.05")
@pytest.mark.parametrize("centre", [0.05, 0.9])
@pytest.mark.parametrize("antenna", [False, True])
def test_pulses_that_are_left_out_add_nothing_at_all(antenna, centre):
    """Whatever piece of the scene: each pulse with a weight anywhere in it is in a block that reaches it."""
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
    assert lit.mean() < 0.7  # and most of the others are left out


@compiled
def test_tiles_beyond_the_swath_are_not_formed():
    """By blocks of pulses and not, a lazily read flight gives the image of the whole, from the rows it needs alone."""
    aperture, grid = strip()
    history = strip_history(aperture, np.array([[x, 36.0, 0.0] for x in (-60.0, -20.0, 0.0, 40.0)]))
    beams = Beams(sector=Sector.of(aperture, chord_m=4.0, centre=0.0, half=0.1))
    window = RangeWindow.of(
        aperture, grid, FLAT, history.frequency_hz, beams=beams, wave_speed_m_s=history.wave_speed_m_s
    )
    profiles, read = range_compress(history, grid, FLAT, window=window), []

    class Read:
        shape, ndim, dtype = profiles.samples.shape, 2, profiles.samples.dtype

        def __len__(self):
            return self.shape[0]

        def __getitem__(self, pulses):
            read.append(pulses)
            return profiles.samples[pulses]

    weighing = Weighing(beams, None, 500)
    settings = [Setting("native", {"oversampling": 8}, {}, -60.0, 1.0, pulse_blocks=blocks) for blocks in (1, 7)]
    whole = image_array(profiles, settings[0], grid, FLAT, side_px=32, weighing=weighing).compute(scheduler="threads")
    lazy = image_array(replace(profiles, samples=Read()), settings[1], grid, FLAT, side_px=32, weighing=weighing)
    assert decibels(lazy.compute(scheduler="threads") - whole, whole) < -120
    read.clear()
    tile = lazy[:, :32].compute(scheduler="threads")
    assert decibels(tile - whole[:, :32], whole) < -120
    assert 0 < max(pulses.stop for pulses in read) < 1000  # the first of eleven tiles needs no more of the flight
    beyond = grid[:, 64:96]
    away = replace(beyond, north_m=beyond.north_m + 400)
    narrow = Beams(sector=Sector.of(aperture[:640], chord_m=4.0, centre=0.0, half=0.1))
    reach = Reach.of(narrow, aperture[:640], away, FLAT, [(slice(0, 32), slice(0, 32))])
    assert reach.illuminated.tolist() == [True]
    far = replace(beyond, west_m=beyond.west_m + 150)
    assert not Reach.of(narrow, aperture[:640], far, FLAT, [(slice(0, 32), slice(0, 32))]).illuminated.any()


@pytest.mark.slow
def test_the_range_window_of_a_long_flight_is_that_of_its_sector():
    """It holds what the pulse may add to, at any length of the flight, and nothing for pulses that add to nothing."""
    spans = []
    for length in (150.0, 600.0):
        aperture, grid = strip(int(20 * length), length)
        beams = Beams(sector=Sector.of(aperture, chord_m=4.0, centre=0.0, half=0.1))
        near, far = swath(grid, FLAT, aperture, beams=beams)
        spans.append((far - near).max())
        places = FLAT.positions(grid)[::4, ::5].reshape(-1, 3)
        some = slice(0, None, 97)
        path, weight = aperture[some].path(places), beams[some].weight(aperture[some], places)
        assert ((path >= near[some, None]) & (path <= far[some, None]))[weight > 0].all()
    assert spans[1] == pytest.approx(spans[0], rel=0.15)
    aperture, _ = strip(3000, 150.0)
    beams = Beams(sector=Sector.of(aperture, chord_m=4.0, centre=0.0, half=0.1))
    near, far = swath(SceneGrid("local", -4.0, 46.0, 0.5, (16, 16)), FLAT, aperture, beams=beams)
    idle = ~np.isfinite(far)
    assert 0.5 < idle.mean() < 0.95
    assert np.abs(aperture.tx_m[~idle, 0]).max() < 15


def test_a_long_flight_is_bounded_by_pulses_that_stand_for_others():
    """Of 40 000 pulses every third is looked at; no path of any pulse is left out."""
    aperture, grid = strip(40_000, 150.0)
    near, far = swath(grid, FLAT, aperture)
    some, places = slice(5, None, 1999), FLAT.positions(grid)[::8, ::10].reshape(-1, 3)
    path = aperture[some].path(places)
    assert (path >= near[some, None]).all()
    assert (path <= far[some, None]).all()
