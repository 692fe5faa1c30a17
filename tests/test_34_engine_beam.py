"""Antenna weights: the same in every engine, and physical."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from test_34_engine_native import AXES, Scene, decibels, ecef, fly, grid, scatter

from apertura.antenna.beam import Beam, Beams
from apertura.focus.engines import native, native_binding, numba, reference
from apertura.focus.inputs import PhaseHistory
from apertura.geometry.aperture import Aperture

pytestmark = pytest.mark.skipif(not native.available(), reason="apertura was installed without a compiler")


def beam(
    antenna: NDArray[np.float64], at: tuple[float, float, float], width_deg: float = 40.0, *, sway_deg: float = 15.0
) -> Beam:
    """A Gaussian beam (width at half power, cut where it has fallen to nothing) kept on one local place, swaying."""
    boresight = ecef(np.array(at)) - antenna
    boresight /= np.linalg.norm(boresight, axis=-1, keepdims=True)
    sideways = np.cross(AXES[:, 2], boresight)
    sideways /= np.linalg.norm(sideways, axis=-1, keepdims=True)
    axes = np.stack([boresight, sideways, np.cross(boresight, sideways)], 1)
    sway = np.radians(sway_deg) * np.sin(np.arange(len(antenna)))
    turn = np.zeros((len(antenna), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(sway)
    turn[:, 0, 1], turn[:, 1, 0], turn[:, 2, 2] = np.sin(sway), -np.sin(sway), 1
    edge = np.radians(2.2 * width_deg)
    angle = np.linspace(-edge, edge, 701)
    gain = np.exp(-2 * np.log(2) * (angle / np.radians(width_deg)) ** 2)
    return Beam(turn @ axes, angle, gain, angle[150:-150], gain[150:-150])


def hard(soft: Beam, half_deg: float) -> Beam:
    """The same axes with a gain of one out to `half_deg`."""
    angle = np.radians([-half_deg, 0, half_deg])
    return Beam(soft.axes, angle, np.ones(3), angle, np.ones(3))


def exact(scene: Scene, pixels: NDArray[np.float64], beams: Beams) -> NDArray[np.complex128]:
    frequency = scene.carrier_hz + scene.offset_hz
    silent = np.zeros(len(scene.tx))
    spectra = PhaseHistory(scene.transfer, frequency, np.ones(frequency.size), silent, Aperture(scene.tx, scene.rx))
    return reference.form(spectra, ecef(pixels), beams=beams)


@pytest.fixture(params=native.INSTRUCTION_SETS)
def isa(request, monkeypatch):
    if not native_binding.runs(request.param):
        pytest.skip(f"this machine has no {request.param}")
    monkeypatch.setenv("APERTURA_ISA", request.param)
    return request.param


@pytest.fixture(scope="module")
def plain():
    pixels = grid(40, 60)
    scene = fly(scatter(pixels), pulses=36)
    return scene, pixels, scene.profiles(ecef(pixels))


def test_engines_weigh_alike(isa, plain):
    scene, pixels, profiles = plain
    beams = Beams(beam(scene.tx, (12, 0, 0)), beam(scene.rx, (11.5, 0.4, 0), 60))
    truth, counts = exact(scene, pixels, beams), np.zeros(4, np.int64)
    image = native.form(native.prepare(profiles), ecef(pixels), beams=beams, counts=counts)
    other = numba.form(numba.prepare(profiles), ecef(pixels), beams=beams)
    assert decibels(image - truth, truth) <= -65
    assert decibels(other - truth, truth) <= -65
    assert counts[1] == counts.sum()  # none had to be weighed pixel by pixel
    assert decibels(exact(scene, pixels, Beams()) - truth, truth) > -20  # the weight matters


def test_a_rough_surface_is_weighed_at_its_height(isa, plain):
    scene, pixels, _ = plain
    rough = pixels.copy()
    rough[..., 2] = 0.3 * np.sin(2 * pixels[..., 0]) + 0.04 * np.random.default_rng(6).standard_normal(rough.shape[:2])
    beams = Beams(beam(scene.tx, (16, 0, 0), 25))  # the scene lies on the slope of the beam
    counts = np.zeros(4, np.int64)
    tables = native.prepare(scene.profiles(ecef(rough)))
    image, truth = native.form(tables, ecef(rough), beams=beams, counts=counts), exact(scene, rough, beams)
    assert decibels(image - truth, truth) <= -65
    assert counts[1] > counts.sum() / 2


@pytest.mark.parametrize("width_deg", [4, 12, 25])
def test_a_narrow_beam_is_weighed_as_finely_as_it_needs(isa, plain, width_deg):
    scene, pixels, profiles = plain
    beams = Beams(beam(scene.tx, (12, 0, 0), width_deg), beam(scene.rx, (12, 0, 0), width_deg))
    image, truth = native.form(native.prepare(profiles), ecef(pixels), beams=beams), exact(scene, pixels, beams)
    assert decibels(image - truth, truth) <= -60


def test_pulses_that_look_away_are_as_good_as_dropped(isa, plain):
    scene, pixels, profiles = plain
    lit = beam(scene.tx, (12, 0, 0), sway_deg=1)
    axes = lit.axes.copy()
    axes[: len(axes) // 2] *= np.array([-1, -1, 1])[:, None]
    kept, counts = slice(len(axes) // 2, None), np.zeros(4, np.int64)
    image = native.form(native.prepare(profiles), ecef(pixels), beams=Beams(replace(lit, axes=axes)), counts=counts)
    few = native.prepare(profiles[kept])
    fewer = native.form(few, ecef(pixels), beams=Beams(replace(lit, axes=lit.axes[kept])))
    assert decibels(image - fewer, fewer) <= -110
    assert counts[3] == counts.sum() / 2  # they cost nothing


def test_pixels_outside_the_beam_of_all_pulses_are_zero(isa, plain):
    scene, pixels, profiles = plain
    beams = Beams(None, hard(beam(scene.rx, (11.4, 0, 0), sway_deg=1), 2.0))
    tables, places = native.prepare(profiles), ecef(pixels)
    counts = np.zeros(4, np.int64)
    image, truth = native.form(tables, places, beams=beams, counts=counts), exact(scene, pixels, beams)
    lit = beams.weight(Aperture(scene.tx, scene.rx), places.reshape(-1, 3)).any(0).reshape(image.shape)
    assert 0.1 < lit.mean() < 0.9
    assert np.array_equal(image != 0, lit)
    assert counts[3] > 0  # where all of a patch is dark the pulse costs nothing
    assert decibels(image - truth, truth) <= -65  # to the very edge


def test_a_beam_that_is_one_everywhere_changes_nothing(isa, plain):
    scene, pixels, profiles = plain
    angle = np.linspace(-np.pi, np.pi, 9)
    everywhere = replace(beam(scene.tx, (12, 0, 0)), azimuth_rad=angle, azimuth_gain=np.ones(9))
    everywhere = replace(everywhere, elevation_rad=angle / 2, elevation_gain=np.ones(9))
    tables, places = native.prepare(profiles), ecef(pixels)
    image, weighed = native.form(tables, places), native.form(tables, places, beams=Beams(everywhere, everywhere))
    assert decibels(image - weighed, image) <= -70


def test_weighed_tiles_have_the_same_bits(isa, plain):
    scene, pixels, profiles = plain
    beams = Beams(beam(scene.tx, (12, 0, 0)), hard(beam(scene.rx, (11.5, 0, 0)), 4.0))
    tables, places = native.prepare(profiles), ecef(pixels)
    whole = native.form(tables, places, beams=beams)
    part = native.form(tables, places[16:, 32:], beams=beams)
    np.testing.assert_array_equal(part.view(np.uint32), whole[16:, 32:].view(np.uint32))


def test_gain_times_two_is_an_image_times_two(isa, plain):
    scene, pixels, profiles = plain
    soft = beam(scene.tx, (12, 0, 0))
    tables, places = native.prepare(profiles), ecef(pixels)
    once = native.form(tables, places, beams=Beams(soft))
    twice = native.form(tables, places, beams=Beams(replace(soft, azimuth_gain=2 * soft.azimuth_gain)))
    assert decibels(twice - 2 * once, twice) <= -110


def test_bad_beams_are_refused(plain):
    scene, pixels, profiles = plain
    good = beam(scene.tx, (12, 0, 0))
    with pytest.raises(ValueError, match="must be one for each of 36 pulses"):
        native.form(native.prepare(profiles), ecef(pixels), beams=Beams(replace(good, axes=good.axes[:5])))
    with pytest.raises(ValueError, match="right angles"):
        replace(good, axes=1.1 * good.axes)
    with pytest.raises(ValueError, match="azimuth: angles must grow in equal steps"):
        replace(good, azimuth_rad=good.azimuth_rad**3)
    with pytest.raises(ValueError, match=r"elevation: .* must be equal"):
        replace(good, elevation_gain=good.azimuth_gain)
    with pytest.raises(ValueError, match=r"must be \(pulse, 3, 3\)"):
        replace(good, axes=np.eye(3))
