"""Heights from the phase of two images: docs/theory/interferometry.md, sections 2 to 7, on arrays."""

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
from apertura.methods.interferometry.coherence import estimate
from apertura.methods.interferometry.common_band import LEAST_LOOKS, CommonBand
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
from apertura.stages.interferogram import legs_of

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
    """Return a straight eastward pass, 25 m south of the scene centre."""
    along = np.linspace(-length_m / 2, length_m / 2, pulses) + along_m
    return np.stack([along, np.full(pulses, -25.0), np.full(pulses, height_m)], -1)


def image(aperture, points_m, amplitude, weight):
    """Form the image of points on flat terrain from the sum of their echoes."""
    path = aperture.path(points_m)
    phasor = np.exp(-2j * np.pi * FREQUENCY[0] * path / C) * amplitude
    step = np.exp(-2j * np.pi * (FREQUENCY[1] - FREQUENCY[0]) * path / C)
    echo = np.empty((len(aperture), len(FREQUENCY)), np.complex64)
    for number in range(len(FREQUENCY)):
        echo[:, number] = phasor.sum(axis=1)
        phasor *= step
    history = ap.PhaseHistory(echo, FREQUENCY, weight / weight.sum(), np.zeros(len(aperture)), aperture)
    return ap.backproject(history, GRID, -50, certified_pixels=0).values


def looks_of(aperture):
    return Looks.of(GRID, FlatGround(0.0), aperture, None)


def assumed_ground(first, second, weight):
    """Return bands and height sensitivity of the images of two apertures over flat terrain, as step interferogram."""
    lattice = looks_of(first).lattice
    legs = tuple(legs_of(looks_of(aperture)) for aperture in (first, second))
    points = GRID.positions_at(*np.meshgrid(*lattice.nodes, indexing="ij"), 0.0).reshape(-1, 3)
    sensed = sensitivity(points, np.eye(3), *legs, band_hz=(FREQUENCY[0], FREQUENCY[-1]))
    sensed = Sensitivity(**{k: value.reshape(*lattice.shape, *value.shape[1:]) for k, value in vars(sensed).items()})
    band = CommonBand.of(lattice, points, np.eye(3), legs, (FREQUENCY, weight), spacing_m=SPACING_M, wave_speed_m_s=C)
    return AssumedGround(band, sensed, lambda window: np.zeros(GRID[window].shape), np.ones((SIDE, SIDE), bool))


def ramp_m(east, north, slope=SLOPE):
    return slope[0] * east + slope[1] * north


@cache
def two_tracks(rise_m, along_m=0.0, common=1.0, marked=False, slope=SLOPE, hann=False):
    """Form two images of a ramp of scatterers, focused on flat terrain; with `common` 1, terrain is unchanged."""
    generator = np.random.default_rng(3)
    count = round((2 * HALF_M + 4) ** 2 * 25)
    east, north = generator.uniform(-HALF_M - 2, HALF_M + 2, (2, count))

    def drawn():
        return generator.normal(size=count) + 1j * generator.normal(size=count)

    first = drawn()
    second = common * first + np.sqrt(1 - common**2) * drawn()
    if marked:
        east, north = (
            np.append(coordinates, marks) for coordinates, marks in zip((east, north), np.array(MARKS).T, strict=True)
        )
        first, second = (np.append(values, [47.0, 47.0]) for values in (first, second))
    points = np.stack([east, north, ramp_m(east, north, slope)], -1)
    weight = np.hanning(len(FREQUENCY)) if hann else np.ones(len(FREQUENCY))
    apertures = [ap.Aperture(path, path) for path in (track(25.0), track(25.0 + rise_m, along_m))]
    images = [
        image(aperture, points, amplitude, weight)
        for aperture, amplitude in zip(apertures, (first, second), strict=True)
    ]
    return *images, assumed_ground(*apertures, weight)


def imaged_heights(response):
    """Return the ramp height imaged at each pixel: h = ramp(x + s h)."""
    east, north = np.meshgrid(GRID.x_m, GRID.y_m)
    return ramp_m(east, north) / (1 - response.shift @ np.array(SLOPE))


def interferogram_of(rise_m, **changes):
    first, second, ground = two_tracks(rise_m, **changes)
    return form_interferogram(first, second, ground, GRID.tiles(64), window=WINDOW), ground.at(WHOLE)


def independent(count):
    """Return the number of independent windows among `count` pixels."""
    return count / WINDOW**2


def at_middle(first, second):
    tracks = [np.broadcast_to(path, (1, *path.shape)) for path in (first, second)]
    band = (FREQUENCY[0], FREQUENCY[-1])
    return sensitivity(np.zeros((1, 3)), np.eye(3), (tracks[0],) * 2, (tracks[1],) * 2, band_hz=band)


# Section 2: sensitivity to height


@pytest.mark.parametrize("height_m", [10.0, 25.0, 50.0])
def test_height_sensitivity_is_the_baseline_over_range_and_sine(height_m):
    angle = np.arctan2(25.0, height_m)
    across = np.array([0.0, np.cos(angle), np.sin(angle)]) * 0.2  # perpendicular to the line of sight
    short = track(height_m, length_m=1.0)
    response = at_middle(short, short + across)
    expected = 4 * np.pi * 0.2 / (WAVELENGTH * np.hypot(25.0, height_m) * np.sin(angle))
    assert abs(response.slope[0]) == pytest.approx(expected, rel=0.01)
    assert response.ambiguity_m == pytest.approx(2 * np.pi / abs(response.slope))


def test_height_error_rotates_points_about_the_track():
    response = at_middle(track(25.0), track(25.001))
    # At 45°, a height of 1 m displaces the point by 1 m away from the track.
    assert response.shift[0] == pytest.approx([0.0, 1.0], abs=1e-3)
    assert at_middle(track(25.0), track(25.0, along_m=2.0)).shift[0, 0] == pytest.approx(0.0, abs=0.05)


def test_height_solves_the_quadratic_phase_equation():
    response = at_middle(track(25.0), track(26.0))
    for height_m in (-0.7, 0.3, 2.0):
        assert response.height(response.slope * height_m + response.bend * height_m**2) == pytest.approx(height_m)


@pytest.mark.slow
def test_phase_of_a_ramp_equals_that_of_its_heights():
    for rise_m in (1.0, 4.0):
        interferogram, response = interferogram_of(rise_m)
        height = imaged_heights(response)
        residual = np.angle(
            np.exp(1j * (interferogram.panels["phase"] - response.slope * height - response.bend * height**2))
        )[INSIDE]
        assert abs(residual.mean()) < 3 * residual.std() / np.sqrt(independent(residual.size))
        assert abs(residual.mean()) < 0.03


# Sections 3 to 5: valid pixels and height accuracy


@pytest.mark.slow
@pytest.mark.parametrize("rise_m", [1.0, 4.0])
def test_height_errors_of_a_ramp_match_the_stated_deviation(rise_m):
    first, second, ground = two_tracks(rise_m, marked=True)
    response = ground.at(WHOLE)
    known = []
    for east, north in MARKS:
        height = ramp_m(east, north)
        row, column = np.round(GRID.pixel_of(east, north)).astype(int)
        position = np.array([east, north]) - response.shift[row, column] * height
        row, column = np.round(GRID.pixel_of(*position)).astype(int)
        phase = response.slope[row, column] * height + response.bend[row, column] * height**2
        known.append(KnownHeight(f"mark {east}", int(row), int(column), float(phase)))
    interferogram = form_interferogram(first, second, replace(ground, known=known), GRID.tiles(64), window=WINDOW)
    error = (interferogram.panels["height"] - ramp_m(*np.meshgrid(GRID.x_m, GRID.y_m)))[INSIDE]
    std = interferogram.panels["height_std"][INSIDE]
    valid = np.isfinite(error)
    assert valid.mean() > 0.8
    assert np.isfinite(std[valid]).all()
    by_level = interferogram.level.spread_rad / abs(np.median(response.slope))
    assert abs(error[valid].mean()) < 3 * np.median(std[valid]) / np.sqrt(independent(valid.sum())) + by_level
    assert 0.5 < np.sqrt(np.mean((error[valid] / std[valid]) ** 2)) < 1.2
    assert interferogram.level.points == ("mark -4.0", "mark 4.5")
    assert interferogram_flags(interferogram.measured) == {}


@pytest.mark.slow
def test_height_deviation_includes_that_of_the_reference_point():
    """Common offset of all heights: σ_h² grows by (σ₀/a)², with four equal points by π/8·(σ₀/a)²."""
    first, second, ground = two_tracks(1.0)
    free = form_interferogram(first, second, ground, GRID.tiles(64), window=WINDOW)
    row, column = np.argwhere(np.isfinite(free.panels["unwrapped"]))[500]
    mast = KnownHeight("mast", int(row), int(column), 0.0)
    tied = form_interferogram(first, second, replace(ground, known=[mast]), GRID.tiles(64), window=WINDOW)
    assert free.level.std_rad is None
    assert 0.02 < tied.level.std_rad < 1.0
    wider, valid = (
        tied.panels["height_std"],
        np.isfinite(free.panels["unwrapped"]) & np.isfinite(tied.panels["height_std"]),
    )
    offset_m = tied.level.std_rad / np.abs(np.median(ground.sensed.slope))
    assert wider[valid].min() > 0.7 * offset_m
    flat = Unwrapped(np.zeros((1, 4), np.float32), np.ones((1, 4), np.uint32), "", 0, 0, 0)
    four = [KnownHeight(str(index), 0, index, 0.0, measured_rad=0.0, std_rad=0.2) for index in range(4)]
    assert level(flat, four[:1]).std_rad == pytest.approx(0.2)
    assert level(flat, four).std_rad == pytest.approx(0.2 / 2 * np.sqrt(np.pi / 2), abs=1e-6)
    scattered = [replace(point, measured_rad=value) for point, value in zip(four, (-0.9, -0.3, 0.3, 0.9), strict=True)]
    assert level(flat, scattered).std_rad > 2 * level(flat, four).std_rad


@pytest.mark.slow
def test_temporal_decorrelation_lowers_coherence_and_widens_the_deviation():
    unchanged, changed = (interferogram_of(1.0, common=common)[0] for common in (1.0, 0.6))
    assert changed.measured.coherence == pytest.approx(0.6 * unchanged.measured.coherence, abs=0.05)
    assert np.nanmedian(changed.panels["height_std"]) > 3 * np.nanmedian(unchanged.panels["height_std"])
    error = (changed.panels["height"] - ramp_m(*np.meshgrid(GRID.x_m, GRID.y_m)))[INSIDE]
    error -= np.nanmedian(error)  # no point of known height exists
    assert np.sqrt(np.nanmean((error / changed.panels["height_std"][INSIDE]) ** 2)) < 1.2
    assert list(interferogram_flags(changed.measured)) == ["height_relative"]


@pytest.mark.slow
@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("correlation_s", [0.5, 4.0, 1e4])
def test_phase_deviation_of_track_errors_equals_monte_carlo_deviation(same, correlation_s):
    """Eq. 8a agrees with drawn errors of two flights, and of one flight whose receivers share a transmitter."""
    generator, time_s, std_m = np.random.default_rng(5), np.linspace(0, 30, 301), np.array([0.01, 0.02, 0.015])
    points = np.array([[x, y, 0.0] for x in (-20.0, 0.0, 25.0) for y in (20.0, 60.0)])
    along = np.stack([np.linspace(-15, 15, 301), np.zeros(301), np.full(301, 20.0)], -1)
    legs = [("a", 1, along), ("a" if same else "b", -1, along + [0, 0, 1.0]), ("c", -1, along + [3.0, 0, 0])]
    sampled, k = slice(3, None, 18), 2 * np.pi / WAVELENGTH
    times = np.tile(time_s[sampled], (6, 1))
    antennas = [
        FlownAntenna(name, sign, np.broadcast_to(leg[sampled], (6, 17, 3)), times, std_m, correlation_s)
        for name, sign, leg in legs
    ]
    reference = [0, 5]
    predicted = TrackPhase(points, np.eye(3), antennas, k).std(reference)
    lag = np.abs(np.subtract.outer(time_s, time_s))
    root = np.linalg.cholesky(autocorrelation(lag, correlation_s) + 1e-9 * np.eye(301))
    error = {name: np.einsum("tu,dux->dtx", root, generator.standard_normal((300, 301, 3)) * std_m) for name in "abc"}
    phase = np.zeros((300, 6))
    for name, sign, leg in legs:
        line_of_sight = leg[:, None] - points
        unit = line_of_sight / np.linalg.norm(line_of_sight, axis=-1, keepdims=True)
        phase += sign * k * np.tensordot(error[name], unit / 301, axes=([1, 2], [0, 2]))
    np.testing.assert_allclose(
        (phase - phase[:, reference].mean(axis=1, keepdims=True)).std(axis=0), predicted, rtol=0.15
    )


@pytest.mark.slow
def test_different_scenes_are_decorrelated_and_give_no_height():
    interferogram, _ = interferogram_of(1.0, common=0.0)
    assert "interferogram_decorrelated" in interferogram_flags(interferogram.measured)
    assert interferogram.measured.coherence == pytest.approx(interferogram.measured.chance, abs=0.05)
    assert np.isfinite(interferogram.panels["height"]).mean() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("rise_m", "along_m"), [(18.0, 0.0), (1.0, 13.0)])
def test_tracks_with_too_long_a_baseline_are_flagged_and_give_no_height(rise_m, along_m):
    interferogram, _ = interferogram_of(rise_m, along_m=along_m)
    assert interferogram.measured.overlap < 0.05
    assert "interferogram_decorrelated" in interferogram_flags(interferogram.measured)
    assert np.isfinite(interferogram.panels["height"]).mean() < 0.03


@pytest.mark.slow
def test_tracks_with_too_short_a_baseline_give_no_height():
    interferogram, _ = interferogram_of(0.05)
    assert interferogram.measured.coherent == interferogram.measured.common
    assert interferogram.measured.sensitive == 0
    assert "height_insensitive" in interferogram_flags(interferogram.measured)
    assert np.isnan(interferogram.panels["height"]).all()


@pytest.mark.slow
def test_pixels_next_to_a_bright_point_have_no_height():
    first, second, ground = two_tracks(1.0, marked=True)
    interferogram = form_interferogram(first, second, ground, GRID.tiles(64), window=WINDOW)
    error = interferogram.panels["height"] - ramp_m(*np.meshgrid(GRID.x_m, GRID.y_m))
    error -= np.nanmedian(error)
    for east, north in MARKS:
        row, column = np.round(GRID.pixel_of(east, north)).astype(int)
        neighbourhood = (slice(row - 12, row + 13), slice(column - 12, column + 13))
        assert np.isnan(error[neighbourhood]).mean() > 0.4
        std = interferogram.panels["height_std"][neighbourhood]
        assert np.nanmax(abs(error[neighbourhood] / std)) < 3.5  # residual effect of the flanks of the point


@pytest.mark.slow
def test_shadow_and_layover_of_either_image_are_undefined():
    first, second, ground = two_tracks(1.0)
    visible = np.ones((SIDE, SIDE), bool)
    visible[:, 60:] = False
    interferogram = form_interferogram(first, second, replace(ground, visible=visible), GRID.tiles(64), window=WINDOW)
    assert all(np.isnan(interferogram.panels[name][:, 60:]).all() for name in ("phase", "coherence", "unwrapped"))
    assert interferogram.measured.common == 60 * SIDE


# Section 8: common band


def measured_coherence(first, second, looks):
    """Return the rms coherence of an inner part, without its bias."""
    squares = estimate(first, second, WINDOW)[0].astype(float)[INSIDE] ** 2
    return np.sqrt(((looks * squares - 1) / (looks - 1)).mean())


@pytest.mark.slow
@pytest.mark.parametrize("hann", [False, True])
@pytest.mark.parametrize(("rise_m", "overlap"), [(1.0, 0.93), (4.0, 0.74), (7.0, 0.55)])
def test_filter_raises_coherence_from_the_overlap_to_the_limit_of_the_noise(rise_m, overlap, hann):
    """Terrain of which a share of 0.8 is common: before the filter γ is 0.8 times the overlap, after it 0.8."""
    first, second, ground = two_tracks(rise_m, common=0.8, slope=(0.0, 0.0), hann=hann)
    one, other, looks = ground.band.filtered(first, second, WHOLE, window=WINDOW)
    assert np.median(ground.sensed.overlap) == pytest.approx(overlap, abs=0.02)
    filtered = measured_coherence(one, other, np.median(looks))
    assert filtered == pytest.approx(0.8, abs=0.04)
    if not hann:  # eq. 14 is for uniform weights
        unfiltered = measured_coherence(first, second, np.median(looks) / overlap)
        assert unfiltered == pytest.approx(0.8 * overlap, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("rise_m", [4.0, 7.0])
def test_slope_that_the_terrain_model_lacks_lowers_the_coherence(rise_m):
    """Eq. 20: the displacement of the spectra is the fringe frequency of the ramp."""
    lost = []
    for slope in ((0.0, 0.0), SLOPE):
        first, second, ground = two_tracks(rise_m, slope=slope)
        one, other, looks = ground.band.filtered(first, second, WHOLE, window=WINDOW)
        lost.append(measured_coherence(one, other, np.median(looks)))
    fringes = np.abs(np.gradient(ground.at(WHOLE).slope * imaged_heights(ground.at(WHOLE)), SPACING_M, axis=0)) / (
        2 * np.pi
    )
    sines = 25 / np.hypot(25, [25, 25 + rise_m])
    common = (2 * sines[1] * FREQUENCY[-1] - 2 * sines[0] * FREQUENCY[0]) / C  # the higher track has lower frequencies
    assert lost[1] / lost[0] == pytest.approx(1 - np.median(fringes) / common, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("rise_m", [1.0, 7.0])
def test_looks_of_the_common_band_are_those_of_unrelated_images(rise_m):
    """Eq. 4: the mean square of the coherence of unrelated images is 1/L."""
    squares = []
    for slope in ((0.0, 0.0), SLOPE):  # two scenes with different speckle in the second image
        first, second, ground = two_tracks(rise_m, common=0.0, slope=slope)
        one, other, looks = ground.band.filtered(first, second, WHOLE, window=WINDOW)
        squares.append((estimate(one, other, WINDOW)[0].astype(float) ** 2 * looks)[INSIDE].mean())
    assert np.mean(squares) == pytest.approx(1, abs=3 / np.sqrt(2 * independent(88**2)))


def test_filter_of_equal_tracks_keeps_the_images():
    first, second, ground = two_tracks(0.0)
    one, *_ = ground.band.filtered(first, second, WHOLE, window=WINDOW)
    kept = estimate(one, first, WINDOW)[0][INSIDE]
    assert np.median(kept) > 0.99  # the edges of the band are one frequency wide
    assert kept.min() > 0.96


def test_filter_of_parts_equals_that_of_the_whole():
    first, second, ground = two_tracks(1.0)
    whole = ground.band.filtered(first, second, WHOLE, window=WINDOW)
    part = slice(25, 83), slice(41, 112)
    for values, expected in zip(ground.band.filtered(first, second, part, window=WINDOW), whole, strict=True):
        np.testing.assert_array_equal(values, expected[part])


def test_a_window_with_too_few_looks_is_not_filtered():
    first, second, ground = two_tracks(1.0)
    one, other, looks = ground.band.filtered(first, second, WHOLE, window=3)
    np.testing.assert_array_equal(one, first)
    np.testing.assert_array_equal(other, second)
    assert looks.max() < LEAST_LOOKS


def test_tiles_give_the_interferogram_of_the_whole_grid():
    first, second, ground = two_tracks(1.0)
    whole = form_interferogram(first, second, ground, [WHOLE], window=WINDOW)
    tiled = form_interferogram(first, second, ground, GRID.tiles(32), window=WINDOW)
    for name, values in whole.panels.items():
        np.testing.assert_allclose(tiled.panels[name], values, rtol=1e-5, atol=1e-5, err_msg=name)
    assert tiled.measured == whole.measured


# Section 6: unwrapping


def ramp_of_phase(per_pixel, noise=0.0):
    phase = per_pixel * np.arange(80.0) + np.zeros((60, 1))
    return phase, np.angle(np.exp(1j * (phase + noise * np.random.default_rng(0).normal(size=phase.shape))))


def test_steep_ramp_is_unwrapped():
    pytest.importorskip("snaphu")
    phase, wrapped = ramp_of_phase(0.5, noise=0.3)
    wrapped[20:30, 30:50] = np.nan
    unwrapped = unwrap(wrapped.astype(np.float32), np.full(phase.shape, 0.9, np.float32), looks=9.0)
    residual = (unwrapped.phase - phase)[np.isfinite(unwrapped.phase)]
    assert np.isnan(unwrapped.phase[20:30, 30:50]).all()
    assert np.ptp(np.round((residual - residual[0]) / (2 * np.pi))) == 0
    assert unwrapped.jumps > 60 * 5
    assert "snaphu" in unwrapped.by
    again = unwrap(wrapped.astype(np.float32), np.full(phase.shape, 0.9, np.float32), looks=9.0)
    np.testing.assert_array_equal(unwrapped.phase, again.phase)


@pytest.mark.parametrize("cell_px", [3, 5])
def test_phase_unwrapped_in_cells_equals_that_of_all_pixels(cell_px):
    pytest.importorskip("snaphu")
    _, wrapped = ramp_of_phase(0.4, noise=0.3)
    wrapped[20:30, 30:50] = np.nan
    every, cells = (
        unwrap(wrapped.astype(np.float32), np.full(wrapped.shape, 0.9, np.float32), looks=9.0, cell_px=side)
        for side in (1, cell_px)
    )
    np.testing.assert_allclose(cells.phase - np.nanmin(cells.phase), every.phase - np.nanmin(every.phase), atol=1e-5)


def test_without_snaphu_the_phase_stays_wrapped_and_is_flagged(monkeypatch):
    def missing(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr("apertura.methods.interferometry.heights.version", missing)
    _, wrapped = ramp_of_phase(0.5)
    unwrapped = unwrap(wrapped.astype(np.float32), np.full(wrapped.shape, 0.9, np.float32), looks=9.0)
    np.testing.assert_array_equal(unwrapped.phase, wrapped.astype(np.float32))
    levelled = remove_level(unwrapped, level(unwrapped, []))
    assert np.abs(levelled).max() <= np.pi + 1e-6
    interferogram, _ = interferogram_of(1.0)
    flags = interferogram_flags(replace(interferogram.measured, by="", jumps=unwrapped.jumps))
    assert "snaphu is not installed" in flags["height_ambiguous"]
    assert "height_ambiguous" not in interferogram_flags(replace(interferogram.measured, by="", jumps=0))


def test_residues_are_counted_at_phase_vortices():
    _, smooth = ramp_of_phase(0.5)
    assert count_residues(smooth)[0] == 0
    row, column = np.mgrid[-30:30, -40:40] + 0.5
    vortex = np.arctan2(row, column)
    assert count_residues(vortex)[0] == 1
    noise = np.random.default_rng(1).uniform(-np.pi, np.pi, (200, 200))
    residues, loops, _ = count_residues(noise)
    assert residues / loops == pytest.approx(1 / 3, abs=0.02)  # expected for a phase of pure noise
    interferogram, _ = interferogram_of(1.0)
    assert "unwrapping_inconsistent" in interferogram_flags(
        replace(interferogram.measured, residues=residues, loops=loops)
    )


# Section 7: level and position


def test_heights_of_disconnected_regions_are_excluded():
    phase = np.array([[0.1, 0.2, np.nan, 6.0, 6.1, 6.2]], np.float32)
    unwrapped = Unwrapped(phase, np.array([[1, 1, 0, 2, 2, 2]], np.uint32), "snaphu", 0, 0, 1)
    assert level(unwrapped, []) == Level(6.1, 2)
    known = [KnownHeight("mast", 0, 1, 0.5, measured_rad=0.2), KnownHeight("unseen", 0, 2, 0.0)]
    mast = level(unwrapped, known)
    assert (mast.part, mast.points, mast.spread_rad) == (1, ("mast",), None)
    assert mast.phase_rad == pytest.approx(-0.3)
    np.testing.assert_allclose(remove_level(unwrapped, mast)[0, :2], [0.4, 0.5], atol=1e-6)
    assert np.isnan(remove_level(unwrapped, mast)[0, 2:]).all()
    assert level(Unwrapped(phase * np.nan, np.zeros((1, 6), np.uint32), "", 0, 0, 0), known) is None


def test_known_point_takes_the_cycle_of_its_neighbours():
    phase = np.full((1, 4), 13.0, np.float32)
    unwrapped = Unwrapped(phase, np.ones((1, 4), np.uint32), "snaphu", 0, 0, 1)
    levelled = level(unwrapped, [KnownHeight("mast", 0, 2, 1.0, measured_rad=13.1 - 4 * np.pi)])
    assert levelled.phase_rad == pytest.approx(12.1)


def test_heights_are_placed_at_their_ground_positions():
    row, column = np.mgrid[:60, :80].astype(float)
    truth = 0.05 * column - 0.02 * row  # true terrain height at each position
    shift = np.full((60, 80, 2), [-3.0, 2.0])
    imaged = truth / (1 - (0.05 * 2.0 - 0.02 * -3.0))  # h(p) = truth(p + s h(p))
    imaged[20:25, 30:35] = np.nan
    placed = place_heights(np.full((60, 80), 100.0), imaged, np.full((60, 80), 0.1), shift)
    valid = np.isfinite(placed.height)
    np.testing.assert_allclose((placed.height - 100)[valid], truth[valid], atol=2e-3)
    assert np.abs(imaged - truth)[20, 60] > 0.3  # error of the height at the unplaced pixel
    assert valid.mean() > 0.6
    assert 20 <= np.isnan(placed.height[10:35, 20:50]).sum() <= 100  # the gap is displaced with its terrain
    assert not placed.folded.any()


def test_folded_terrain_is_excluded_and_counted():
    column = np.arange(80.0) + np.zeros((40, 1))
    placed = place_heights(
        np.zeros((40, 80)), np.where(column > 40, -1.0, 1.0), np.ones((40, 80)), np.full((40, 80, 2), [0, 10.0])
    )
    assert placed.folded.any()
    assert np.isnan(placed.height[20, 35:46]).any()
