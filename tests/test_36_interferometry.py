"""Heights from the phase of two images: physics of docs/theory/interferometry.md, sections 2 to 7, on arrays."""

from dataclasses import replace
from functools import cache
from importlib.metadata import PackageNotFoundError

import numpy as np
import pytest

import apertura as ap
from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.quality.path_errors import autocorrelation
from apertura.core.scene.looks import Looks
from apertura.core.scene.terrain import FlatGround
from apertura.methods.interferometry.comparison import AssumedGround, form_interferogram, interferogram_flags
from apertura.methods.interferometry.heights import (
    KnownHeight,
    Level,
    Unwrapped,
    count_residues,
    level,
    place_heights,
    remove_level,
    unwrap,
)
from apertura.methods.interferometry.sensitivity import FlownAntenna, Sensitivity, TrackPhase, sensitivity

FREQUENCY = 1.0e9 + np.arange(128) * 400e6 / 128
WAVELENGTH = C / FREQUENCY.mean()
HALF_M, SPACING_M, WINDOW = 7.0, 0.125, 15
SIDE = round(2 * HALF_M / SPACING_M)
GRID = ap.SceneGrid("local", -HALF_M, HALF_M, SPACING_M, (SIDE, SIDE))
WHOLE = (slice(0, SIDE), slice(0, SIDE))
INSIDE = (slice(12, -12), slice(12, -12))
SLOPE = (0.02, 0.05)
MARKS = ((-4.0, -4.0), (4.5, 3.0))


def track(height_m, along_m=0.0, pulses=80, length_m=10.0):
    """A straight pass along east, 25 m south of the middle."""
    along = np.linspace(-length_m / 2, length_m / 2, pulses) + along_m
    return np.stack([along, np.full(pulses, -25.0), np.full(pulses, height_m)], -1)


def image(flown, points_m, amplitude):
    """The image of some points on flat ground, by the sum of their echoes."""
    path = flown.path(points_m)
    now = np.exp(-2j * np.pi * FREQUENCY[0] * path / C) * amplitude
    turn = np.exp(-2j * np.pi * (FREQUENCY[1] - FREQUENCY[0]) * path / C)
    echo = np.empty((len(flown), len(FREQUENCY)), np.complex64)
    for number in range(len(FREQUENCY)):
        echo[:, number] = now.sum(axis=1)
        now *= turn
    weight = np.full(len(FREQUENCY), 1 / len(FREQUENCY))
    history = ap.PhaseHistory(echo, FREQUENCY, weight, np.zeros(len(flown)), flown)
    return ap.backproject(history, GRID, -50, certified_pixels=0).values


def legs_of(flown):
    looks = Looks.of(GRID, FlatGround(0.0), flown, None)
    pulses = looks.pulses.reshape(-1, looks.pulses.shape[-1])
    return looks.lattice, tuple(leg[pulses] for leg in flown.legs)


def sensed(first, second):
    """The answer to height at every pixel of `GRID`, as `load.two_images` tells it."""
    lattice, one = legs_of(first)
    other = legs_of(second)[1]
    rows, columns = np.meshgrid(*lattice.nodes, indexing="ij")
    places = GRID.positions_at(rows, columns, 0.0).reshape(-1, 3)
    told = sensitivity(places, np.eye(3), one, other, band_hz=(FREQUENCY[0], FREQUENCY[-1]))
    return Sensitivity(
        **{
            name: lattice.between(values.reshape(*lattice.shape, *values.shape[1:]), WHOLE)
            for name, values in vars(told).items()
        }
    )


def ground_of(told, known=()):
    shift_px = np.stack([-told.shift[..., 1], told.shift[..., 0]], -1) / SPACING_M
    return AssumedGround(np.zeros((SIDE, SIDE)), np.ones((SIDE, SIDE), bool), told, shift_px, known)


def ramp_m(east, north):
    return SLOPE[0] * east + SLOPE[1] * north


@cache
def two_tracks(rise_m, along_m=0.0, common=1.0, marked=False):
    """Two images of a ramp of many scatterers, focused on flat ground; of `common` 1 nothing changes between them."""
    generator = np.random.default_rng(3)
    count = round((2 * HALF_M + 4) ** 2 * 25)
    east, north = generator.uniform(-HALF_M - 2, HALF_M + 2, (2, count))

    def drawn():
        return generator.normal(size=count) + 1j * generator.normal(size=count)

    first = drawn()
    second = common * first + np.sqrt(1 - common**2) * drawn()
    if marked:
        east, north = (np.append(at, marks) for at, marks in zip((east, north), np.array(MARKS).T, strict=True))
        first, second = (np.append(one, [47.0, 47.0]) for one in (first, second))
    points = np.stack([east, north, ramp_m(east, north)], -1)
    flown = [ap.Aperture(one, one) for one in (track(25.0), track(25.0 + rise_m, along_m))]
    images = [image(one, points, amplitude) for one, amplitude in zip(flown, (first, second), strict=True)]
    return *images, sensed(*flown)


def heights_shown(told):
    """How high the ramp is where a pixel shows it: h = ramp(x + s h)."""
    east, north = np.meshgrid(GRID.x_m, GRID.y_m)
    return ramp_m(east, north) / (1 - told.shift @ np.array(SLOPE))


def parts(rise_m, **changes):
    first, second, told = two_tracks(rise_m, **changes)
    return form_interferogram(first, second, ground_of(told), GRID.tiles(64), window=WINDOW), told


def independent(count):
    """Windows among so many pixels."""
    return count / WINDOW**2


def at_middle(first, second):
    flown = [np.broadcast_to(one, (1, *one.shape)) for one in (first, second)]
    band = (FREQUENCY[0], FREQUENCY[-1])
    return sensitivity(np.zeros((1, 3)), np.eye(3), (flown[0],) * 2, (flown[1],) * 2, band_hz=band)


# Section 2: what a height does


@pytest.mark.parametrize("height_m", [10.0, 25.0, 50.0])
def test_a_height_turns_the_phase_by_the_baseline_over_range_and_sine(height_m):
    angle = np.arctan2(25.0, height_m)
    across = np.array([0.0, np.cos(angle), np.sin(angle)]) * 0.2  # perpendicular to the line of sight
    short = track(height_m, length_m=1.0)
    told = at_middle(short, short + across)
    expected = 4 * np.pi * 0.2 / (WAVELENGTH * np.hypot(25.0, height_m) * np.sin(angle))
    assert abs(told.slope[0]) == pytest.approx(expected, rel=0.01)
    assert told.ambiguity_m == pytest.approx(2 * np.pi / abs(told.slope))


def test_the_ground_shown_is_turned_about_the_track():
    told = at_middle(track(25.0), track(25.001))
    assert told.shift[0] == pytest.approx([0.0, 1.0], abs=1e-3)  # 45°: a metre for a metre, away from the track
    assert at_middle(track(25.0), track(25.0, along_m=2.0)).shift[0, 0] == pytest.approx(0.0, abs=0.05)


def test_heights_are_the_root_of_their_phase():
    told = at_middle(track(25.0), track(26.0))
    for height_m in (-0.7, 0.3, 2.0):
        assert told.height(told.slope * height_m + told.bend * height_m**2) == pytest.approx(height_m)


@pytest.mark.slow
def test_the_phase_of_a_ramp_is_that_of_its_heights():
    for rise_m in (1.0, 4.0):
        found, told = parts(rise_m)
        height = heights_shown(told)
        left = np.angle(np.exp(1j * (found.panels["phase"] - told.slope * height - told.bend * height**2)))[INSIDE]
        assert abs(left.mean()) < 3 * left.std() / np.sqrt(independent(left.size))
        assert abs(left.mean()) < 0.03


# Sections 3 to 5: which pixels tell a height, and how well


@pytest.mark.quick("1.0")
@pytest.mark.parametrize("rise_m", [1.0, 4.0])
def test_heights_of_a_ramp_lie_within_their_deviation(rise_m):
    first, second, told = two_tracks(rise_m, marked=True)
    known = []
    for east, north in MARKS:
        height = ramp_m(east, north)
        row, column = np.round(GRID.pixel_of(east, north)).astype(int)
        place = np.array([east, north]) - told.shift[row, column] * height
        row, column = np.round(GRID.pixel_of(*place)).astype(int)
        phase = told.slope[row, column] * height + told.bend[row, column] * height**2
        known.append(KnownHeight(f"mark {east}", int(row), int(column), float(phase)))
    found = form_interferogram(first, second, ground_of(told, known), GRID.tiles(64), window=WINDOW)
    wrong = (found.panels["height"] - ramp_m(*np.meshgrid(GRID.x_m, GRID.y_m)))[INSIDE]
    std = found.panels["height_std"][INSIDE]
    there = np.isfinite(wrong)
    assert there.mean() > 0.8
    assert np.isfinite(std[there]).all()
    by_level = found.level.spread_rad / abs(np.median(told.slope))
    assert abs(wrong[there].mean()) < 3 * np.median(std[there]) / np.sqrt(independent(there.sum())) + by_level
    assert 0.5 < np.sqrt(np.mean((wrong[there] / std[there]) ** 2)) < 1.2
    assert found.level.points == ("mark -4.0", "mark 4.5")
    assert interferogram_flags(found.measured) == {}


@pytest.mark.slow
def test_heights_carry_the_deviation_of_the_point_that_they_count_from():
    """One offset of all heights: σ_h² grows by (σ₀/a)², with four equal points by a quarter and a median's π/2."""
    first, second, told = two_tracks(1.0)
    free = form_interferogram(first, second, ground_of(told, []), GRID.tiles(64), window=WINDOW)
    row, column = np.argwhere(np.isfinite(free.panels["unwrapped"]))[500]
    one = KnownHeight("mast", int(row), int(column), 0.0)
    tied = form_interferogram(first, second, ground_of(told, [one]), GRID.tiles(64), window=WINDOW)
    assert free.level.std_rad is None
    assert 0.02 < tied.level.std_rad < 1.0
    wider, there = (
        tied.panels["height_std"],
        np.isfinite(free.panels["unwrapped"]) & np.isfinite(tied.panels["height_std"]),
    )
    offset_m = tied.level.std_rad / np.abs(np.median(told.slope))
    assert wider[there].min() > 0.7 * offset_m
    flat = Unwrapped(np.zeros((1, 4), np.float32), np.ones((1, 4), np.uint32), "", 0, 0, 0)
    four = [KnownHeight(str(place), 0, place, 0.0, measured_rad=0.0, std_rad=0.2) for place in range(4)]
    assert level(flat, four[:1]).std_rad == pytest.approx(0.2)
    assert level(flat, four).std_rad == pytest.approx(0.2 / 2 * np.sqrt(np.pi / 2), abs=1e-6)
    apart = [replace(one, measured_rad=value) for one, value in zip(four, (-0.9, -0.3, 0.3, 0.9), strict=True)]
    assert level(flat, apart).std_rad > 2 * level(flat, four).std_rad


@pytest.mark.slow
def test_what_has_changed_between_the_flights_lowers_coherence_and_widens_the_deviation():
    still, changed = (parts(1.0, common=common)[0] for common in (1.0, 0.6))
    assert changed.measured.coherence == pytest.approx(0.6 * still.measured.coherence, abs=0.05)
    assert np.nanmedian(changed.panels["height_std"]) > 3 * np.nanmedian(still.panels["height_std"])
    wrong = (changed.panels["height"] - ramp_m(*np.meshgrid(GRID.x_m, GRID.y_m)))[INSIDE]
    wrong -= np.nanmedian(wrong)  # no point of known height
    assert np.sqrt(np.nanmean((wrong / changed.panels["height_std"][INSIDE]) ** 2)) < 1.2
    assert list(interferogram_flags(changed.measured)) == ["height_relative"]


@pytest.mark.slow
@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("correlation_s", [0.5, 4.0, 1e4])
def test_errors_of_the_tracks_turn_the_phase_as_much_as_told(same, correlation_s):
    """Eq. 8a against drawn errors: of two flights, and of one whose receivers share a transmitter."""
    generator, time_s, std_m = np.random.default_rng(5), np.linspace(0, 30, 301), np.array([0.01, 0.02, 0.015])
    places = np.array([[x, y, 0.0] for x in (-20.0, 0.0, 25.0) for y in (20.0, 60.0)])
    along = np.stack([np.linspace(-15, 15, 301), np.zeros(301), np.full(301, 20.0)], -1)
    flown = [("a", 1, along), ("a" if same else "b", -1, along + [0, 0, 1.0]), ("c", -1, along + [3.0, 0, 0])]
    some, k = slice(3, None, 18), 2 * np.pi / WAVELENGTH
    times = np.tile(time_s[some], (6, 1))
    antennas = [
        FlownAntenna(name, sign, np.broadcast_to(leg[some], (6, 17, 3)), times, std_m, correlation_s)
        for name, sign, leg in flown
    ]
    reference = [0, 5]
    told = TrackPhase(places, np.eye(3), antennas, k).std(reference)
    lag = np.abs(np.subtract.outer(time_s, time_s))
    root = np.linalg.cholesky(autocorrelation(lag, correlation_s) + 1e-9 * np.eye(301))
    error = {name: np.einsum("tu,dux->dtx", root, generator.standard_normal((300, 301, 3)) * std_m) for name in "abc"}
    phase = np.zeros((300, 6))
    for name, sign, leg in flown:
        away = leg[:, None] - places
        toward = away / np.linalg.norm(away, axis=-1, keepdims=True)
        phase += sign * k * np.tensordot(error[name], toward / 301, axes=([1, 2], [0, 2]))
    np.testing.assert_allclose((phase - phase[:, reference].mean(axis=1, keepdims=True)).std(axis=0), told, rtol=0.15)


@pytest.mark.slow
def test_another_scene_is_decorrelated_and_tells_no_height():
    found, _ = parts(1.0, common=0.0)
    assert "interferogram_decorrelated" in interferogram_flags(found.measured)
    assert found.measured.coherence == pytest.approx(found.measured.chance, abs=0.05)
    assert np.isfinite(found.panels["height"]).mean() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("rise_m", "along_m"), [(18.0, 0.0), (1.0, 13.0)])
def test_tracks_too_far_apart_are_flagged_and_tell_no_height(rise_m, along_m):
    found, _ = parts(rise_m, along_m=along_m)
    assert found.measured.overlap < 0.05
    assert "interferogram_decorrelated" in interferogram_flags(found.measured)
    assert np.isfinite(found.panels["height"]).mean() < 0.03


@pytest.mark.quick("1.0-0.93")
@pytest.mark.parametrize(("rise_m", "overlap"), [(1.0, 0.93), (4.0, 0.74), (7.0, 0.55)])
def test_coherence_is_what_geometry_leaves(rise_m, overlap):
    found, _ = parts(rise_m)
    assert found.measured.overlap == pytest.approx(overlap, abs=0.02)
    assert found.measured.coherence == pytest.approx(found.measured.overlap, abs=0.06)


@pytest.mark.slow
def test_tracks_too_close_together_tell_no_height():
    found, _ = parts(0.05)
    assert found.measured.coherent == found.measured.common
    assert found.measured.sensitive == 0
    assert "height_insensitive" in interferogram_flags(found.measured)
    assert np.isnan(found.panels["height"]).all()


def test_a_bright_point_tells_no_height_beside_itself():
    first, second, told = two_tracks(1.0, marked=True)
    found = form_interferogram(first, second, ground_of(told), GRID.tiles(64), window=WINDOW)
    wrong = found.panels["height"] - ramp_m(*np.meshgrid(GRID.x_m, GRID.y_m))
    wrong -= np.nanmedian(wrong)
    for east, north in MARKS:
        row, column = np.round(GRID.pixel_of(east, north)).astype(int)
        beside = (slice(row - 12, row + 13), slice(column - 12, column + 13))
        assert np.isnan(wrong[beside]).mean() > 0.4
        assert np.nanmax(abs(wrong[beside] / found.panels["height_std"][beside])) < 3.5  # what its flanks still shift


def test_shadow_and_layover_of_either_image_tell_nothing():
    first, second, told = two_tracks(1.0)
    visible = np.ones((SIDE, SIDE), bool)
    visible[:, 60:] = False
    found = form_interferogram(first, second, replace(ground_of(told), visible=visible), GRID.tiles(64), window=WINDOW)
    assert all(np.isnan(found.panels[name][:, 60:]).all() for name in ("phase", "coherence", "unwrapped"))
    assert found.measured.common == 60 * SIDE


# Section 6: unwrapping


def ramp_of_phase(per_pixel, noise=0.0):
    phase = per_pixel * np.arange(80.0) + np.zeros((60, 1))
    return phase, np.angle(np.exp(1j * (phase + noise * np.random.default_rng(0).normal(size=phase.shape))))


def test_a_steep_ramp_is_unwrapped():
    pytest.importorskip("snaphu")
    phase, wrapped = ramp_of_phase(0.5, noise=0.3)
    wrapped[20:30, 30:50] = np.nan
    told = unwrap(wrapped.astype(np.float32), np.full(phase.shape, 0.9, np.float32), looks=9.0)
    left = (told.phase - phase)[np.isfinite(told.phase)]
    assert np.isnan(told.phase[20:30, 30:50]).all()
    assert np.ptp(np.round((left - left[0]) / (2 * np.pi))) == 0
    assert told.jumps > 60 * 5
    assert "snaphu" in told.by
    again = unwrap(wrapped.astype(np.float32), np.full(phase.shape, 0.9, np.float32), looks=9.0)
    np.testing.assert_array_equal(told.phase, again.phase)


def test_without_the_library_the_phase_stays_within_a_turn_and_says_so(monkeypatch):
    def missing(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr("apertura.methods.interferometry.heights.version", missing)
    _, wrapped = ramp_of_phase(0.5)
    told = unwrap(wrapped.astype(np.float32), np.full(wrapped.shape, 0.9, np.float32), looks=9.0)
    np.testing.assert_array_equal(told.phase, wrapped.astype(np.float32))
    alone = remove_level(told, level(told, []))
    assert np.abs(alone).max() <= np.pi + 1e-6
    found, _ = parts(1.0)
    flags = interferogram_flags(replace(found.measured, by="", jumps=told.jumps))
    assert "snaphu is not installed" in flags["height_ambiguous"]
    assert "height_ambiguous" not in interferogram_flags(replace(found.measured, by="", jumps=0))


def test_residues_are_where_the_phase_contradicts_itself():
    _, smooth = ramp_of_phase(0.5)
    assert count_residues(smooth)[0] == 0
    row, column = np.mgrid[-30:30, -40:40] + 0.5
    vortex = np.arctan2(row, column)
    assert count_residues(vortex)[0] == 1
    noise = np.random.default_rng(1).uniform(-np.pi, np.pi, (200, 200))
    residues, loops, _ = count_residues(noise)
    assert residues / loops == pytest.approx(1 / 3, abs=0.02)  # of phase that is noise alone
    found, _ = parts(1.0)
    assert "unwrapping_inconsistent" in interferogram_flags(replace(found.measured, residues=residues, loops=loops))


# Section 7: level and place


def test_heights_of_a_part_apart_are_left_out():
    phase = np.array([[0.1, 0.2, np.nan, 6.0, 6.1, 6.2]], np.float32)
    told = Unwrapped(phase, np.array([[1, 1, 0, 2, 2, 2]], np.uint32), "snaphu", 0, 0, 1)
    assert level(told, []) == Level(6.1, 2)
    known = [KnownHeight("mast", 0, 1, 0.5, measured_rad=0.2), KnownHeight("unseen", 0, 2, 0.0)]
    mast = level(told, known)
    assert (mast.part, mast.points, mast.spread_rad) == (1, ("mast",), None)
    assert mast.phase_rad == pytest.approx(-0.3)
    np.testing.assert_allclose(remove_level(told, mast)[0, :2], [0.4, 0.5], atol=1e-6)
    assert np.isnan(remove_level(told, mast)[0, 2:]).all()
    assert level(Unwrapped(phase * np.nan, np.zeros((1, 6), np.uint32), "", 0, 0, 0), known) is None


def test_a_known_point_takes_the_turns_of_its_neighbours():
    phase = np.full((1, 4), 13.0, np.float32)
    told = Unwrapped(phase, np.ones((1, 4), np.uint32), "snaphu", 0, 0, 1)
    one = level(told, [KnownHeight("mast", 0, 2, 1.0, measured_rad=13.1 - 4 * np.pi)])
    assert one.phase_rad == pytest.approx(12.1)


def test_heights_stand_at_their_own_places():
    row, column = np.mgrid[:60, :80].astype(float)
    truth = 0.05 * column - 0.02 * row  # of the ground, at its place
    shift = np.full((60, 80, 2), [-3.0, 2.0])
    shown = truth / (1 - (0.05 * 2.0 - 0.02 * -3.0))  # h(p) = truth(p + s h(p))
    shown[20:25, 30:35] = np.nan
    told = place_heights(np.full((60, 80), 100.0), shown, np.full((60, 80), 0.1), shift)
    there = np.isfinite(told.height)
    np.testing.assert_allclose((told.height - 100)[there], truth[there], atol=2e-3)
    assert np.abs(shown - truth)[20, 60] > 0.3  # what would stand there by the pixel
    assert there.mean() > 0.6
    assert 20 <= np.isnan(told.height[10:35, 20:50]).sum() <= 100  # the gap moves with its ground
    assert told.folded == 0


def test_ground_that_folds_over_is_left_out_and_counted():
    column = np.arange(80.0) + np.zeros((40, 1))
    told = place_heights(
        np.zeros((40, 80)), np.where(column > 40, -1.0, 1.0), np.ones((40, 80)), np.full((40, 80, 2), [0, 10.0])
    )
    assert told.folded > 0
    assert np.isnan(told.height[20, 35:46]).any()
