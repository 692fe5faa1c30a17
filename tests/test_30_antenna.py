"""Antenna patterns, axes and weights, and their effect on plans."""

from dataclasses import replace

import numpy as np
import pytest
from campaigns import draw
from scenes import (
    compiled,
    ecef,
    fly,
    ground_points,
    monostatic,
    pixel_grid,
    plan,
    scatter,
    side_beam,
    straight_track,
    swaying_beam,
)

from apertura.core.antenna.beam import Beam, Beams, antenna_axes, gaussian_cut, sampled_cut
from apertura.core.antenna.illumination import illuminate
from apertura.core.backprojection.engines import load_engine, native, reference
from apertura.core.backprojection.engines.native import NO_BEAMS, PatchWeights, patch_weights, pixel_seconds
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import body_axes
from apertura.core.planning.planner import make_plan
from apertura.core.quality.measures import numerical_error_db


def test_antenna_axes_are_the_body_axes_rotated_to_the_boresight():
    for azimuth, elevation in ((0, 0), (90, -30), (-135, 60), (200, -90)):
        body = body_axes(np.radians([[10.0, -20.0, 30.0]]))
        ahead, right, below = np.moveaxis(body @ body_axes(np.radians([0.0, elevation, azimuth])), -1, 0)
        np.testing.assert_allclose(
            antenna_axes(body, (azimuth, elevation))[0], np.concatenate([ahead, right, -below]), atol=1e-12
        )


def test_gain_is_half_power_at_half_width_and_zero_past_cutoff():
    beam = side_beam((20.0, 50.0), boresight_deg=(0.0, 0.0), pulses=1)
    angle = np.radians([10.0, 25.0])
    places = np.array([[np.cos(angle[0]), -np.sin(angle[0]), 0], [np.cos(angle[1]), 0, np.sin(angle[1])], [1, -0.6, 0]])
    np.testing.assert_allclose(beam.gain(np.zeros((1, 3)), places)[0] ** 2, [0.5, 0.5, 0.0], atol=1e-4)
    assert np.degrees(beam.azimuth_rad[-1]) == pytest.approx(20 * np.sqrt(20 / 12.0412), abs=1e-3)


def test_wide_beam_ends_at_90_degrees():
    angle, gain = gaussian_cut(170.0, cutoff_db=-20.0, limit_rad=np.pi / 2)
    assert angle[-1] == np.pi / 2
    assert gain[-1] > 0.1


def test_sampled_cut_keeps_only_the_main_lobe():
    angle = np.array([-40.0, -30, -20, 0, 20, 30, 40])
    kept, gain = sampled_cut(angle, np.array([-5.0, -13, -60, 0, -60, -13, -5]), cutoff_db=-20)
    assert np.degrees(kept[-1]) == pytest.approx(20 / 3, abs=0.05)
    assert gain.min() >= 0.1


def test_pulses_that_illuminate_a_point_are_counted():
    tx, places = straight_track(3000), np.array([[0.0, 20, 0], [2.0, 20, 0], [0.0, -20, 0]])
    beams = Beams(side_beam((4.0, 60.0), boresight_deg=(-90.0, -26.6), pulses=3000))
    illumination = illuminate(beams, monostatic(tx), places)
    half_m = np.hypot(20, 10) * np.tan(np.radians(4 * np.sqrt(20 / 12.0412)))
    expected = [2 * half_m / 6 * 3000, (half_m + 1) / 6 * 3000, 0]
    np.testing.assert_allclose(illumination.pulse_counts, expected, atol=12)
    assert illumination.unilluminated == pytest.approx(1 / 3)


def jobs(beams, *, shape=(200, 200)):
    tx = straight_track()
    lit = None if beams is None else illuminate(beams, monostatic(tx), ground_points().reshape(-1, 3))
    return {"beams": beams, "illumination": lit, "shape": shape}


def test_pulses_cost_less_outside_a_beam_and_more_inside():
    shared = (1.0, 0.0, 0.0)
    lit, half, dark = (pixel_seconds(shared, 2, PatchWeights(1 - share, 0.0, share, 0.0, 2)) for share in (0, 0.5, 1))
    assert half == pytest.approx((lit + dark) / 2)
    assert 2 * dark < pixel_seconds(shared, 2, NO_BEAMS) < lit / 2.5


@pytest.mark.slow
@compiled
def test_plan_includes_the_cost_of_beams():
    native = {"engine": "native"}
    lit = plan(overrides=native, **jobs(None, shape=(2000, 2000))).predicted_seconds
    wide = Beams(side_beam((100.0, 100.0), cutoff_db=-40.0), side_beam((100.0, 100.0), cutoff_db=-40.0))
    assert plan(overrides=native, **jobs(wide, shape=(2000, 2000))).predicted_seconds > 1.8 * lit


@compiled
@pytest.mark.parametrize("width_deg", [20.0, 35.0, 60.0])
def test_weighting_method_of_native_is_predicted(width_deg):
    pixels = pixel_grid(48, 64)
    scene = fly(scatter(pixels), pulses=64)
    places = ecef(pixels)
    beams = Beams(
        swaying_beam(scene.tx, (12, 0, 0), width_deg, sway_deg=width_deg), swaying_beam(scene.rx, (12, 0, 0), width_deg)
    )
    counts = np.zeros(4, np.int64)
    native.form(native.prepare(scene.profiles(places)), places, beams=beams, counts=counts)
    middle = places[8::16, 8::16]
    steps = np.stack([(places[8::16, 9::16] - middle).reshape(-1, 3), (places[9::16, 8::16] - middle).reshape(-1, 3)])
    predicted = patch_weights(beams, Aperture(scene.tx, scene.rx), steps, middle.reshape(-1, 3))
    np.testing.assert_allclose(
        [predicted.smooth, predicted.pixelwise, predicted.dark], counts[1:] / counts.sum(), atol=0.1
    )


@pytest.mark.slow
@compiled
def test_high_accuracy_needs_exact_weights():
    beams = Beams(side_beam((8.0, 16.0)), side_beam((8.0, 16.0)))
    assert plan(-60.0, **jobs(beams)).engine == "native"
    fine = plan(-100.0, **jobs(beams))
    assert fine.engine != "native"
    assert fine.setting.error_db <= -100


def aimed(position_m, middle_m, width_deg):
    """Return the beam of a level body that flies along the track; at mid-track, it points at the scene centre."""
    ahead = (position_m[-1] - position_m[0]) * [1, 1, 0]
    ahead /= np.linalg.norm(ahead)
    body = np.stack([ahead, np.cross(ahead, [0, 0, 1.0]), [0, 0, -1.0]], 1)
    forward, right, down = (middle_m - position_m[len(position_m) // 2]) @ body
    boresight_deg = np.degrees([np.arctan2(right, forward), np.arctan2(-down, np.hypot(forward, right))])
    angle, gain = gaussian_cut(width_deg, cutoff_db=-20.0, limit_rad=np.pi / 2)
    axes = antenna_axes(np.broadcast_to(body, (len(position_m), 3, 3)), tuple(boresight_deg))
    return Beam(axes, angle, gain, angle, gain)


@pytest.mark.quick("2.0-1")
@pytest.mark.parametrize("seed", [0, 1, 2, 5])
@pytest.mark.parametrize("widths", [0.5, 2.0, 10.0])
def test_certified_error_is_met_for_any_illuminated_part(seed, widths):
    drawn = draw(np.random.default_rng(seed), pixels=64, pulses=90)
    aperture = drawn.job.aperture
    middle = drawn.job.points_m[len(drawn.job.points_m) // 2]
    across_deg = np.degrees(64 * drawn.grid.spacing_m / np.linalg.norm(middle - aperture.tx_m[45]))
    beams = Beams(*(aimed(position, middle, min(60.0, widths * across_deg)) for position in aperture.legs))
    lit = illuminate(beams, aperture, drawn.job.points_m)
    planned = make_plan(replace(drawn.job, beams=beams, illumination=lit), accuracy_db=drawn.accuracy_db)
    engine = load_engine(planned.engine)
    inputs = {"phase_history": drawn.history, "profiles": planned.inputs(drawn.profiles)}[engine.READS]
    places = drawn.grid.positions(0.0)
    image = engine.form(
        engine.prepare(inputs, **planned.setting.options), places, beams=beams, **planned.setting.form_options
    )
    sample = tuple(np.random.default_rng(1).integers(0, drawn.grid.shape, (200, 2)).T)
    exact = reference.form(drawn.history, places[sample], beams=beams)
    assert numerical_error_db(image[sample].astype(np.complex64), exact) <= drawn.accuracy_db
