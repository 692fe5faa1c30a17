"""The compiled engine against the double sum over pulses and subcarriers, in each instruction set."""

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
    assert counts[0] == counts.sum()  # no pulse needed a slower way


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
def test_the_predicted_error_is_kept(isa, plain, oversampling, degree):
    scene, pixels, profiles = plain
    tables = native.prepare(profiles, oversampling=oversampling, degree=degree)
    image = native.form(tables, ecef(pixels), tolerance_rad=2e-4)  # so that geometry adds nothing to the table's error
    assert error_db(scene, pixels, image) <= tables.error_db + 1


def test_more_oversampling_errs_less(plain):
    profiles = plain[2]
    errors = [native.prepare(profiles, oversampling=n).error_db for n in (4, 5, 6, 8)]
    assert errors == sorted(errors, reverse=True)


@pytest.mark.parametrize("carrier_hz", [0.41e9, 3e9, 10e9])
def test_carriers_that_turn_often_within_a_cell_are_held(isa, carrier_hz):
    pixels = pixel_grid(40, 40, spacing_m=C / carrier_hz / 4)
    scene = fly(scatter(pixels), carrier_hz=carrier_hz)
    image = native.form(native.prepare(scene.profiles(ecef(pixels)), oversampling=6), ecef(pixels))
    assert error_db(scene, pixels, image) <= -70


@pytest.mark.parametrize("size", [(1, 1), (1, 17), (33, 5), (15, 16), (17, 49)])
def test_any_size_of_tile_will_do(isa, size):
    pixels = pixel_grid(*size)
    scene = fly(scatter(pixel_grid(40, 40)))
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels))
    assert image.shape == size
    assert error_db(scene, pixels, image) <= -70


@pytest.mark.parametrize("size", [(1, 1), (17, 3)])
@pytest.mark.parametrize("rough_m", [0.0, 0.03])
def test_one_pulse_will_do(isa, size, rough_m):
    pixels = pixel_grid(*size)
    pixels[..., 2] = rough_m * np.random.default_rng(6).standard_normal(size)
    scene = fly(scatter(pixel_grid(40, 40)), pulses=1)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels))
    assert error_db(scene, pixels, image) <= -70


def test_splitting_into_tiles_changes_nothing_to_the_bit(isa, plain):
    _, pixels, profiles = plain
    tables, places = native.prepare(profiles), ecef(pixels)
    whole = native.form(tables, places)
    parts = np.block(
        [
            [native.form(tables, places[y, x]) for x in (slice(0, 32), slice(32, None))]
            for y in (slice(0, 16), slice(16, None))
        ]
    )
    np.testing.assert_array_equal(parts.view(np.uint32), whole.view(np.uint32))


def test_threads_give_the_same_bits(plain):
    _, pixels, profiles = plain
    tables, places = native.prepare(profiles), ecef(pixels)
    with ThreadPoolExecutor(2) as pool:
        images = list(pool.map(lambda _: native.form(tables, places), range(4)))
    assert all(np.array_equal(image, images[0]) for image in images)


def test_a_turned_grid_takes_the_same_way_with_the_same_error(isa):
    pixels = pixel_grid(64, 64, turned_deg=30)
    scene = fly(scatter(pixels))
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert error_db(scene, pixels, image) <= -70
    assert counts[0] == counts.sum()


@pytest.mark.parametrize("rough_m", [0.002, 0.02])
def test_heights_that_change_from_pixel_to_pixel_are_followed(isa, rough_m):
    pixels = pixel_grid(48, 64)
    generator = np.random.default_rng(6)
    pixels[..., 2] = 0.3 * np.sin(pixels[..., 0]) * np.cos(pixels[..., 1]) + rough_m * generator.standard_normal(
        (48, 64)
    )
    scene = fly(scatter(pixels))
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert error_db(scene, pixels, image) <= -70
    assert counts[2] == 0  # none had to go pixel by pixel in float64


def test_a_crooked_surface_goes_the_exact_way(isa):
    pixels = pixel_grid(32, 32) + 0.1 * np.random.default_rng(6).standard_normal((32, 32, 3))
    scene = fly(scatter(pixels))
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert counts[2] == counts.sum()
    assert error_db(scene, pixels, image) <= -70


@pytest.mark.parametrize(("range_m", "rough_m"), [(12, 3.0), (2000, 1.5)])  # beyond the series; beyond the window alone
def test_heights_that_leave_the_windows_are_taken_one_by_one(isa, range_m, rough_m):
    pixels = pixel_grid(33, 21, range_m=range_m)
    pixels[..., 2] = rough_m * np.random.default_rng(6).standard_normal((33, 21))
    scene = fly(scatter(pixels), range_m=range_m)
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert error_db(scene, pixels, image) <= -70
    assert counts[2] == counts.sum()


def test_rough_tiles_have_the_same_bits(isa):
    pixels = pixel_grid(40, 56)
    pixels[..., 2] = 0.02 * np.random.default_rng(6).standard_normal((40, 56))
    tables = native.prepare(fly(scatter(pixels)).profiles(ecef(pixels)))
    whole, part = native.form(tables, ecef(pixels)), native.form(tables, ecef(pixels)[16:, 32:])
    np.testing.assert_array_equal(part.view(np.uint32), whole[16:, 32:].view(np.uint32))


@pytest.mark.parametrize("size", [(1, 1), (17, 3)])
def test_a_pixel_at_a_phase_centre_is_formed_like_any_other(isa, size):
    antenna = (fly(np.zeros((1, 3)), pulses=3).tx[1] - PLACE) @ AXES
    pixels = pixel_grid(*size) - pixel_grid(*size)[0, 0] + antenna
    scene = fly(scatter(pixel_grid(40, 40)) - pixel_grid(40, 40)[0, 0] + antenna, pulses=3, bistatic=False)
    assert np.linalg.norm(ecef(pixels)[0, 0] - scene.tx[1]) < 1e-8
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels))
    assert np.isfinite(image).all()
    assert error_db(scene, pixels, image) <= -70


@pytest.mark.parametrize("spacing_m", [0.12, 0.25, 0.6, 2.0])
def test_coarse_pixels_leave_the_windows_without_leaving_the_truth(isa, spacing_m):
    pixels = pixel_grid(20, 20, spacing_m=spacing_m, range_m=60)
    scene = fly(scatter(pixels), range_m=60)
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert error_db(scene, pixels, image) <= -70
    assert (counts[2] == 0) == (spacing_m < 0.5)


@pytest.mark.parametrize(("range_m", "way"), [(12, 0), (4, 1), (0.6, 2)])
def test_near_ranges_take_more_exact_paths(isa, range_m, way):
    pixels = pixel_grid(32, 32, range_m=range_m)
    scene = fly(scatter(pixels), range_m=range_m, bistatic=False)
    counts = np.zeros(4, np.int64)
    image = native.form(native.prepare(scene.profiles(ecef(pixels))), ecef(pixels), counts=counts)
    assert error_db(scene, pixels, image) <= -70
    assert counts[way] > counts.sum() / 2


def test_swapping_transmitter_and_receiver_gives_the_same_image(isa, plain):
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


def test_a_raised_target_focuses_where_geometry_predicts(isa):
    height_m, ground_m = 1.0, 12.0
    scene = fly(np.array([[ground_m, 0, height_m]]), bistatic=False)
    laid_over_m = np.sqrt(ground_m**2 + (12 - height_m) ** 2 - 12**2)
    pixels = pixel_grid(48, 96, spacing_m=0.03, range_m=ground_m - 0.5)
    lifted = pixels + np.array([0, 0, height_m])
    tables = native.prepare(scene.profiles(np.concatenate([ecef(pixels), ecef(lifted)])))
    for surface, expected_m in ((pixels, laid_over_m), (lifted, ground_m)):
        image = np.abs(native.form(tables, ecef(surface)))
        row, column = np.unravel_index(image.argmax(), image.shape)
        assert surface[row, column, 0] == pytest.approx(expected_m, abs=0.08)
        assert surface[row, column, 1] == pytest.approx(0, abs=0.05)


def test_blocks_of_pulses_add_up(isa, plain):
    _, pixels, profiles = plain
    whole = native.form(native.prepare(profiles), ecef(pixels))
    blocks = (profiles[slice(0, 33)], profiles[slice(33, None)])
    parts = [native.form(native.prepare(block), ecef(pixels)) for block in blocks]
    assert decibels(sum(parts) - whole, whole) <= -110


def test_summing_in_float64_agrees(isa, plain):
    _, pixels, profiles = plain
    tables = native.prepare(profiles)
    image, wide = (native.form(tables, ecef(pixels), accumulate=kind) for kind in ("complex64", "complex128"))
    assert decibels(image - wide, wide) <= -115


def test_pixels_beyond_the_profiles_are_zero_and_others_unharmed(isa, plain):
    _, pixels, profiles = plain
    tables = native.prepare(profiles)
    far = pixels.copy()
    far[:, 40:, 0] += 1000.0
    image = native.form(tables, ecef(far))
    assert np.all(image[:, 40:] == 0)
    np.testing.assert_allclose(
        image[:, :40], native.form(tables, ecef(pixels))[:, :40], atol=2e-3 * np.abs(image).max()
    )


def test_a_pulse_counts_only_where_its_profile_reaches(isa, plain):
    scene, pixels, profiles = plain
    cut = replace(profiles, samples=profiles.samples[:, : profiles.samples.shape[1] // 2])
    image = native.form(native.prepare(cut), ecef(pixels))
    end = cut.start_m + cut.step_m * (cut.samples.shape[1] - 1)
    reach = scene.path_m(ecef(pixels).reshape(-1, 3)).min(0).reshape(image.shape)
    assert np.all(image[reach > end.max() + cut.step_m] == 0)
    assert np.all(np.isfinite(image))


@pytest.mark.parametrize("nowhere", [np.nan, np.inf, -np.inf])
def test_a_pixel_without_a_position_is_nan_and_spoils_no_other(isa, plain, nowhere):
    scene, pixels, profiles = plain
    places = ecef(pixels)
    places[20, 21] = nowhere
    image = native.form(native.prepare(profiles), places)
    assert np.argwhere(np.isnan(image)).tolist() == [[20, 21]]
    image[20, 21] = scene.exact(ecef(pixels)[20, 21][None])[0]
    assert error_db(scene, pixels, image) <= -70


def test_bad_input_is_refused(plain):
    profiles = plain[2]
    tables = native.prepare(profiles)
    with pytest.raises(ValueError, match="degree=3"):
        native.prepare(profiles, degree=3)
    with pytest.raises(ValueError, match="contains no pulse"):
        native.prepare(profiles[slice(0, 0)])
    with pytest.raises(ValueError, match="must be finite"):
        native.prepare(replace(profiles, start_m=profiles.start_m * np.nan))
    with pytest.raises(ValueError, match="oversampling"):
        native.prepare(replace(profiles, oversampling=1.2))
    with pytest.raises(ValueError, match=r"must be \(y, x, 3\)"):
        native.form(tables, np.zeros((4, 4)))
    with pytest.raises(ValueError, match="accumulate"):
        native.form(tables, np.zeros((4, 4, 3)), accumulate="float16")


def test_rows_of_a_table_do_not_share_lines_of_the_cache(plain):
    """Rows a multiple of 1 KiB apart fall on the same ones; lengths of profiles meet such rows again and again."""
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
