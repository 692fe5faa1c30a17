"""Antenna weights: agreement between the engines, and physical plausibility."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import Scene, decibels, ecef, fly, hard_beam, pixel_grid, scatter, swaying_beam

from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines import native, numba, reference
from apertura.core.geometry.aperture import Aperture

pytestmark = pytest.mark.skipif(not native.available(), reason="apertura was installed without a compiler")


def exact(scene: Scene, pixels: NDArray[np.float64], beams: Beams) -> NDArray[np.complex128]:
    return reference.form(scene.history(), ecef(pixels), beams=beams)


@pytest.fixture(scope="module")
def plain():
    pixels = pixel_grid(40, 60)
    scene = fly(scatter(pixels), pulses=36)
    return scene, pixels, scene.profiles(ecef(pixels))


def test_engines_apply_the_same_weights(isa, plain):
    scene, pixels, profiles = plain
    beams = Beams(swaying_beam(scene.tx, (12, 0, 0)), swaying_beam(scene.rx, (11.5, 0.4, 0), 60))
    truth, counts = exact(scene, pixels, beams), np.zeros(4, np.int64)
    image = native.form(native.prepare(profiles), ecef(pixels), beams=beams, counts=counts)
    other = numba.form(numba.prepare(profiles), ecef(pixels), beams=beams)
    assert decibels(image - truth, truth) <= -65
    assert decibels(other - truth, truth) <= -65
    assert counts[1] == counts.sum()  # no pulse is weighted pixel by pixel
    assert decibels(exact(scene, pixels, Beams()) - truth, truth) > -20  # the weight has an effect


def test_rough_surface_is_weighted_at_its_height(isa, plain):
    scene, pixels, _ = plain
    rough = pixels.copy()
    rough[..., 2] = 0.3 * np.sin(2 * pixels[..., 0]) + 0.04 * np.random.default_rng(6).standard_normal(rough.shape[:2])
    beams = Beams(swaying_beam(scene.tx, (16, 0, 0), 25))  # the scene lies on the slope of the antenna pattern
    counts = np.zeros(4, np.int64)
    tables = native.prepare(scene.profiles(ecef(rough)))
    image, truth = native.form(tables, ecef(rough), beams=beams, counts=counts), exact(scene, rough, beams)
    assert decibels(image - truth, truth) <= -65
    assert counts[1] > counts.sum() / 2


@pytest.mark.parametrize("width_deg", [4, 12, 25])
def test_narrow_beam_is_weighted_with_sufficient_resolution(isa, plain, width_deg):
    scene, pixels, profiles = plain
    beams = Beams(swaying_beam(scene.tx, (12, 0, 0), width_deg), swaying_beam(scene.rx, (12, 0, 0), width_deg))
    image, truth = native.form(native.prepare(profiles), ecef(pixels), beams=beams), exact(scene, pixels, beams)
    assert decibels(image - truth, truth) <= -60


def test_pulses_whose_beam_points_away_are_skipped(isa, plain):
    scene, pixels, profiles = plain
    lit = swaying_beam(scene.tx, (12, 0, 0), sway_deg=1)
    axes = lit.axes.copy()
    axes[: len(axes) // 2] *= np.array([-1, -1, 1])[:, None]
    kept, counts = slice(len(axes) // 2, None), np.zeros(4, np.int64)
    image = native.form(native.prepare(profiles), ecef(pixels), beams=Beams(replace(lit, axes=axes)), counts=counts)
    kept_tables = native.prepare(profiles[kept])
    kept_image = native.form(kept_tables, ecef(pixels), beams=Beams(replace(lit, axes=lit.axes[kept])))
    assert decibels(image - kept_image, kept_image) <= -110
    assert counts[3] == counts.sum() / 2  # pulses whose beam points away are skipped


def test_pixels_outside_every_beam_are_zero(isa, plain):
    scene, pixels, profiles = plain
    beams = Beams(None, hard_beam(swaying_beam(scene.rx, (11.4, 0, 0), sway_deg=1), 2.0))
    tables, points = native.prepare(profiles), ecef(pixels)
    counts = np.zeros(4, np.int64)
    image, truth = native.form(tables, points, beams=beams, counts=counts), exact(scene, pixels, beams)
    lit = beams.weight(Aperture(scene.tx, scene.rx), points.reshape(-1, 3)).any(0).reshape(image.shape)
    assert 0.1 < lit.mean() < 0.9
    assert np.array_equal(image != 0, lit)
    assert counts[3] > 0  # the pulse is skipped where a whole patch is outside the beam
    assert decibels(image - truth, truth) <= -65  # the pixels at the edge of the beam included


def test_uniform_beam_leaves_the_image_unchanged(isa, plain):
    scene, pixels, profiles = plain
    angle = np.linspace(-np.pi, np.pi, 9)
    uniform = replace(swaying_beam(scene.tx, (12, 0, 0)), azimuth_rad=angle, azimuth_gain=np.ones(9))
    uniform = replace(uniform, elevation_rad=angle / 2, elevation_gain=np.ones(9))
    tables, points = native.prepare(profiles), ecef(pixels)
    image, weighted = native.form(tables, points), native.form(tables, points, beams=Beams(uniform, uniform))
    assert decibels(image - weighted, image) <= -70


def test_tiles_of_a_weighted_image_are_bit_identical(isa, plain):
    scene, pixels, profiles = plain
    beams = Beams(swaying_beam(scene.tx, (12, 0, 0)), hard_beam(swaying_beam(scene.rx, (11.5, 0, 0)), 4.0))
    tables, points = native.prepare(profiles), ecef(pixels)
    whole = native.form(tables, points, beams=beams)
    part = native.form(tables, points[16:, 32:], beams=beams)
    np.testing.assert_array_equal(part.view(np.uint32), whole[16:, 32:].view(np.uint32))


def test_doubled_gain_doubles_the_image(isa, plain):
    scene, pixels, profiles = plain
    beam = swaying_beam(scene.tx, (12, 0, 0))
    tables, points = native.prepare(profiles), ecef(pixels)
    once = native.form(tables, points, beams=Beams(beam))
    twice = native.form(tables, points, beams=Beams(replace(beam, azimuth_gain=2 * beam.azimuth_gain)))
    assert decibels(twice - 2 * once, twice) <= -110


def test_invalid_beams_are_refused(plain):
    scene, pixels, profiles = plain
    good = swaying_beam(scene.tx, (12, 0, 0))
    with pytest.raises(ValueError, match="must equal the number of pulses, 36"):
        native.form(native.prepare(profiles), ecef(pixels), beams=Beams(replace(good, axes=good.axes[:5])))
    with pytest.raises(ValueError, match="orthogonal unit vectors"):
        replace(good, axes=1.1 * good.axes)
    with pytest.raises(ValueError, match="azimuth: angles must ascend in equal steps"):
        replace(good, azimuth_rad=good.azimuth_rad**3)
    with pytest.raises(ValueError, match=r"elevation: .* must be equal"):
        replace(good, elevation_gain=good.azimuth_gain)
    with pytest.raises(ValueError, match=r"must be \(pulse, 3, 3\)"):
        replace(good, axes=np.eye(3))
