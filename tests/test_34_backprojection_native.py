"""Compiled engine compared with the double sum over pulses and subcarriers, in each instruction set."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scenes import AXES, PLACE, decibels, ecef, error_db, fly, pixel_grid, scatter

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.backprojection.engines import native, native_binding
from apertura.core.geometry.aperture import Aperture

pytestmark = pytest.mark.skipif(not native.available(), reason="apertura was installed without a compiler")


@pytest.fixture(scope="module")
def plain():
    pixels = pixel_grid(50, 83)
    scene = fly(scatter(pixels))
    return scene, pixels, scene.profiles(ecef(pixels))


def test_every_instruction_set_agrees_with_the_double_sum(isa, plain):
    scene, pixels, profiles = plain
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(profiles), ecef(pixels), counts=counts)
    assert native.instruction_set() == isa
    assert error_db(scene, pixels, image) <= -70
    assert counts[0] == counts.sum()  # no pulse needed a slower path variant


def test_a_monostatic_image_agrees_with_the_double_sum(isa):
    pixels = pixel_grid(48, 48)
    scene = fly(scatter(pixels), bistatic=False)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels))
    assert error_db(scene, pixels, image) <= -70


def test_instruction_sets_agree_with_each_other(plain, monkeypatch):
    _, pixels, profiles = plain
    images = []
    for name in filter(native_binding.supports, native.INSTRUCTION_SETS):
        monkeypatch.setenv("APERTURA_ISA", name)
        images.append(native.form(native.prepare(profiles), ecef(pixels)))
    if len(images) < 2:
        pytest.skip("this machine runs one instruction set")
    assert max(decibels(image - images[0], images[0]) for image in images[1:]) <= -95


@pytest.mark.parametrize(("oversampling", "degree"), [(5, 2), (6, 2), (8, 2), (8, 1), (10, 1), (16, 1)])
def test_error_stays_below_the_prediction(isa, plain, oversampling, degree):
    scene, pixels, profiles = plain
    tables = native.prepare(profiles, oversampling=oversampling, degree=degree)
    # The tolerance makes the geometry error negligible against the table error.
    image = native.form(tables, ecef(pixels), tolerance_rad=2e-4)
    assert error_db(scene, pixels, image) <= tables.error_db + 1


def test_predicted_error_falls_with_oversampling(plain):
    profiles = plain[2]
    errors = [native.prepare(profiles, oversampling=n).error_db for n in (4, 5, 6, 8)]
    assert errors == sorted(errors, reverse=True)


@pytest.mark.parametrize("carrier_hz", [0.41e9, 3e9, 10e9])
def test_short_wavelengths_are_accurate(isa, carrier_hz):
    pixels = pixel_grid(40, 40, spacing_m=C / carrier_hz / 4)
    scene = fly(scatter(pixels), carrier_hz=carrier_hz)
    image = native.form(native.prepare(scene.profiles(ecef(pixels)), oversampling=6), ecef(pixels))
    assert error_db(scene, pixels, image) <= -70


@pytest.mark.quick("*size1*", "*size4*")
@pytest.mark.parametrize("size", [(1, 1), (1, 17), (33, 5), (15, 16), (17, 49)])
def test_tiles_of_any_size_are_accurate(isa, size):
    pixels = pixel_grid(*size)
    scene = fly(scatter(pixel_grid(40, 40)))
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels))
    assert image.shape == size
    assert error_db(scene, pixels, image) <= -70


@pytest.mark.parametrize("size", [(1, 1), (17, 3)])
@pytest.mark.parametrize("rough_m", [0.0, 0.03])
def test_single_pulse_is_accurate(isa, size, rough_m):
    pixels = pixel_grid(*size)
    pixels[..., 2] = rough_m * np.random.default_rng(6).standard_normal(size)
    scene = fly(scatter(pixel_grid(40, 40)), pulses=1)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels))
    assert error_db(scene, pixels, image) <= -70


def test_tiles_are_bit_identical_to_the_whole_image(isa, plain):
    _, pixels, profiles = plain
    tables, points = native.prepare(profiles), ecef(pixels)
    whole = native.form(tables, points)
    parts = np.block(
        [
            [native.form(tables, points[y, x]) for x in (slice(0, 32), slice(32, None))]
            for y in (slice(0, 16), slice(16, None))
        ]
    )
    np.testing.assert_array_equal(parts.view(np.uint32), whole.view(np.uint32))


def test_threads_give_bit_identical_images(plain):
    _, pixels, profiles = plain
    tables, points = native.prepare(profiles), ecef(pixels)
    with ThreadPoolExecutor(2) as pool:
        images = list(pool.map(lambda _: native.form(tables, points), range(4)))
    assert all(np.array_equal(image, images[0]) for image in images)


def test_rotated_grid_uses_the_same_path_variant_with_the_same_error(isa):
    pixels = pixel_grid(64, 64, turned_deg=30)
    scene = fly(scatter(pixels))
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert error_db(scene, pixels, image) <= -70
    assert counts[0] == counts.sum()


@pytest.mark.parametrize("rough_m", [0.002, 0.02])
def test_heights_that_vary_between_pixels_are_accurate(isa, rough_m):
    pixels = pixel_grid(48, 64)
    generator = np.random.default_rng(6)
    pixels[..., 2] = 0.3 * np.sin(pixels[..., 0]) * np.cos(pixels[..., 1]) + rough_m * generator.standard_normal(
        (48, 64)
    )
    scene = fly(scatter(pixels))
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert error_db(scene, pixels, image) <= -70
    assert counts[2] == 0  # no pulse is summed pixel by pixel in float64


def test_irregular_surface_uses_the_exact_path(isa):
    pixels = pixel_grid(32, 32) + 0.1 * np.random.default_rng(6).standard_normal((32, 32, 3))
    scene = fly(scatter(pixels))
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert counts[2] == counts.sum()
    assert error_db(scene, pixels, image) <= -70


@pytest.mark.parametrize(("range_m", "rough_m"), [(12, 3.0), (2000, 1.5)])  # outside the series; outside the window
def test_heights_beyond_the_windows_use_the_exact_path(isa, range_m, rough_m):
    pixels = pixel_grid(33, 21, range_m=range_m)
    pixels[..., 2] = rough_m * np.random.default_rng(6).standard_normal((33, 21))
    scene = fly(scatter(pixels), range_m=range_m)
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert error_db(scene, pixels, image) <= -70
    assert counts[2] == counts.sum()


def test_tiles_of_a_rough_surface_are_bit_identical(isa):
    pixels = pixel_grid(40, 56)
    pixels[..., 2] = 0.02 * np.random.default_rng(6).standard_normal((40, 56))
    tables = native.prepare(fly(scatter(pixels)).profiles(ecef(pixels)))
    whole, part = native.form(tables, ecef(pixels)), native.form(tables, ecef(pixels)[16:, 32:])
    np.testing.assert_array_equal(part.view(np.uint32), whole[16:, 32:].view(np.uint32))


@pytest.mark.parametrize("size", [(1, 1), (17, 3)])
def test_pixel_at_a_phase_centre_is_accurate(isa, size):
    antenna = (fly(np.zeros((1, 3)), pulses=3).tx[1] - PLACE) @ AXES
    pixels = pixel_grid(*size) - pixel_grid(*size)[0, 0] + antenna
    scene = fly(scatter(pixel_grid(40, 40)) - pixel_grid(40, 40)[0, 0] + antenna, pulses=3, bistatic=False)
    assert np.linalg.norm(ecef(pixels)[0, 0] - scene.tx[1]) < 1e-8
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels))
    assert np.isfinite(image).all()
    assert error_db(scene, pixels, image) <= -70


@pytest.mark.parametrize("spacing_m", [0.12, 0.25, 0.6, 2.0])
def test_coarse_pixels_beyond_the_windows_are_accurate(isa, spacing_m):
    pixels = pixel_grid(20, 20, spacing_m=spacing_m, range_m=60)
    scene = fly(scatter(pixels), range_m=60)
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert error_db(scene, pixels, image) <= -70
    assert (counts[2] == 0) == (spacing_m < 0.5)


@pytest.mark.parametrize(("range_m", "path_variant"), [(12, 0), (4, 1), (0.6, 2)])
def test_near_ranges_use_more_exact_paths(isa, range_m, path_variant):
    pixels = pixel_grid(32, 32, range_m=range_m)
    scene = fly(scatter(pixels), range_m=range_m, bistatic=False)
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert error_db(scene, pixels, image) <= -70
    assert counts[path_variant] > counts.sum() / 2


def test_swapping_transmitter_and_receiver_leaves_the_image_unchanged(isa, plain):
    _, pixels, profiles = plain
    swapped = replace(profiles, aperture=Aperture(*reversed(profiles.aperture.legs)))
    image, other = (native.form(native.prepare(p), ecef(pixels)) for p in (profiles, swapped))
    assert decibels(image - other, image) <= -100


def test_a_constant_height_equals_a_lowered_track(isa):
    pixels = pixel_grid(32, 48)
    scene = fly(scatter(pixels))
    raised = pixels + np.array([0, 0, 1.5])
    lowered = [antenna - 1.5 * AXES[:, 2] for antenna in (scene.tx, scene.rx)]
    profiles = scene.profiles(ecef(raised))
    image = native.form(native.prepare(profiles), ecef(raised))
    other = native.form(native.prepare(replace(profiles, aperture=Aperture(*lowered))), ecef(pixels))
    assert decibels(image - other, image) <= -70


def test_raised_target_is_laid_over_as_geometry_predicts(isa):
    height_m, ground_m = 1.0, 12.0
    scene = fly(np.array([[ground_m, 0, height_m]]), bistatic=False)
    laid_over_m = np.sqrt(ground_m**2 + (12 - height_m) ** 2 - 12**2)
    pixels = pixel_grid(48, 96, spacing_m=0.03, range_m=ground_m - 0.5)
    raised = pixels + np.array([0, 0, height_m])
    tables = native.prepare(scene.profiles(np.concatenate([ecef(pixels), ecef(raised)])))
    for surface, expected_m in ((pixels, laid_over_m), (raised, ground_m)):
        image = np.abs(native.form(tables, ecef(surface)))
        row, column = np.unravel_index(image.argmax(), image.shape)
        assert surface[row, column, 0] == pytest.approx(expected_m, abs=0.08)
        assert surface[row, column, 1] == pytest.approx(0, abs=0.05)


def test_images_of_pulse_blocks_sum_to_the_whole(isa, plain):
    _, pixels, profiles = plain
    whole = native.form(native.prepare(profiles), ecef(pixels))
    blocks = (profiles[slice(0, 33)], profiles[slice(33, None)])
    parts = [native.form(native.prepare(block), ecef(pixels)) for block in blocks]
    assert decibels(sum(parts) - whole, whole) <= -110


def test_summation_in_complex128_agrees(isa, plain):
    _, pixels, profiles = plain
    tables = native.prepare(profiles)
    image, wide = (native.form(tables, ecef(pixels), accumulate=kind) for kind in ("complex64", "complex128"))
    assert decibels(image - wide, wide) <= -115


def test_pixels_beyond_the_profiles_are_zero_and_others_unchanged(isa, plain):
    _, pixels, profiles = plain
    tables = native.prepare(profiles)
    far = pixels.copy()
    far[:, 40:, 0] += 1000.0
    image = native.form(tables, ecef(far))
    assert np.all(image[:, 40:] == 0)
    np.testing.assert_allclose(
        image[:, :40], native.form(tables, ecef(pixels))[:, :40], atol=2e-3 * np.abs(image).max()
    )


def test_pulses_contribute_only_within_their_profile(isa, plain):
    scene, pixels, profiles = plain
    cut = replace(profiles, samples=profiles.samples[:, : profiles.samples.shape[1] // 2])
    image = native.form(native.prepare(cut), ecef(pixels))
    end = cut.start_m + cut.step_m * (cut.samples.shape[1] - 1)
    reach = scene.path_m(ecef(pixels).reshape(-1, 3)).min(0).reshape(image.shape)
    assert np.all(image[reach > end.max() + cut.step_m] == 0)
    assert np.all(np.isfinite(image))


@pytest.mark.parametrize("nowhere", [np.nan, np.inf, -np.inf])
def test_pixel_without_position_is_nan_and_leaves_others_unchanged(isa, plain, nowhere):
    scene, pixels, profiles = plain
    points = ecef(pixels)
    points[20, 21] = nowhere
    image = native.form(native.prepare(profiles), points)
    assert np.argwhere(np.isnan(image)).tolist() == [[20, 21]]
    image[20, 21] = scene.exact(ecef(pixels)[20, 21][None])[0]
    assert error_db(scene, pixels, image) <= -70


def test_invalid_input_is_refused(plain):
    profiles = plain[2]
    tables = native.prepare(profiles)
    with pytest.raises(ValueError, match="degree=3"):
        native.prepare(profiles, degree=3)
    with pytest.raises(ValueError, match="must contain at least one pulse"):
        native.prepare(profiles[slice(0, 0)])
    with pytest.raises(ValueError, match="must be finite"):
        native.prepare(replace(profiles, start_m=profiles.start_m * np.nan))
    with pytest.raises(ValueError, match="oversampling"):
        native.prepare(replace(profiles, oversampling=1.2))
    with pytest.raises(ValueError, match=r"must be \(y, x, 3\)"):
        native.form(tables, np.zeros((4, 4)))
    with pytest.raises(ValueError, match="accumulate"):
        native.form(tables, np.zeros((4, 4, 3)), accumulate="float16")


def test_table_rows_do_not_share_cache_lines(plain):
    """Rows separated by a multiple of 1 KiB share cache lines; common profile lengths give such rows."""
    profiles = plain[2][:1]
    rows = [
        native.prepare(
            replace(profiles, samples=np.zeros((1, length), np.complex64)), oversampling=oversampling
        ).cells.strides[1]
        for oversampling in (6, 16, 20)
        for length in range(40, 140)
    ]
    assert all(row % 1024 for row in rows)
    assert all(row % 64 == 0 for row in rows)
