"""Focus check of an image: origin of the echo, subaperture images, bright points."""

from dataclasses import replace

import numpy as np
import pytest

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.backprojection.engines import reference
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.focus_check import (
    PART_PX,
    PARTS,
    echo_outside_scene,
    focus_flags,
    focus_report,
    joint_peak_power,
    part_images,
)
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.job import imaging_job
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.planning.planner import make_plan
from apertura.core.quality.path_errors import Effect
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, GroundModels

FREQUENCY_HZ = 1.2e9 + 1e6 * np.arange(256)
PULSES = 128
GRID, GROUND = SceneGrid("local", -3.2, 3.2, 0.1, (64, 64)), FlatGround(0.0)
TRACK = np.stack([np.linspace(-4, 4, PULSES), np.full(PULSES, -20.0), np.full(PULSES, 10.0)], -1)


def echo_of(points, *, noise=1e-3, seed=1):
    generator = np.random.default_rng(seed)
    aperture = Aperture(TRACK, TRACK)
    transfer = sum(
        np.exp(-2j * np.pi * FREQUENCY_HZ * path[:, None] / SPEED_OF_LIGHT_M_S) for path in aperture.path(points).T
    )
    transfer = transfer + noise * (generator.standard_normal((2, *transfer.shape)) * [[[1]], [[1j]]]).sum(axis=0)
    return PhaseHistory(
        transfer.astype(np.complex64), FREQUENCY_HZ, np.hanning(258)[1:-1] / 128.5, np.zeros(PULSES), aperture
    )


def test_echo_beyond_the_ranges_of_the_scene_is_reported():
    line = echo_outside_scene(echo_of(np.array([[0.0, 40.0, 0.0]])), GRID, GROUND)
    assert "has a total path of 12" in line  # 2·√(60² + 10²) = 121.7 m
    assert "total paths of the scene are" in line


def test_strong_echo_not_focused_in_the_image_is_reported():
    """The check is called without bright points, so that the echo of a point within the scene counts as unfocused."""
    line = echo_outside_scene(echo_of(np.zeros((1, 3))), GRID, GROUND)
    assert "but it is not focused at any pixel of the image" in line


def test_points_in_one_range_cell_are_not_an_outside_echo():
    """Three equal points, spaced by 2.6 m, lie in one range cell of 0.6 m; each has a third of the echo."""
    east = np.array([-2.6, 0.0, 2.6])
    points = np.column_stack([east, np.sqrt(400 - east**2) - 20, 0 * east])
    history = echo_of(points)
    assert "but it is not focused at any pixel of the image" in echo_outside_scene(history, GRID, GROUND)
    terms = list(reference.terms(history, points).T)
    assert echo_outside_scene(history, GRID, GROUND, points=terms) is None
    wrong_terms = list(reference.terms(history, points + [1.5, 0.0, 0.0]).T)
    assert "but it is not focused at any pixel of the image" in echo_outside_scene(
        history, GRID, GROUND, points=wrong_terms
    )


@pytest.mark.slow
@pytest.mark.parametrize("noise", [1e-3, 30.0])
def test_speckle_and_noise_are_not_reported_as_a_point_echo(noise):
    generator = np.random.default_rng(2)
    points = np.column_stack([generator.uniform(-3.2, 3.2, (400, 2)), np.zeros(400)])
    assert echo_outside_scene(echo_of(points, noise=noise), GRID, GROUND) is None


@pytest.mark.slow
def test_direct_path_between_antennas_is_not_an_echo():
    generator = np.random.default_rng(3)
    points = np.column_stack([generator.uniform(-3.2, 3.2, (400, 2)), np.zeros(400)])
    baseline_m = np.array([5.0, 0.0, 0.0])
    history = echo_of(points)
    aperture = Aperture(TRACK, TRACK + baseline_m)
    direct = 1e4 * np.exp(-2j * np.pi * FREQUENCY_HZ * 5.0 / SPEED_OF_LIGHT_M_S)
    transfer = sum(
        np.exp(-2j * np.pi * FREQUENCY_HZ * path[:, None] / SPEED_OF_LIGHT_M_S) for path in aperture.path(points).T
    )
    bistatic = PhaseHistory(
        (transfer + direct).astype(np.complex64), FREQUENCY_HZ, history.weight, np.zeros(PULSES), aperture
    )
    assert echo_outside_scene(bistatic, GRID, GROUND) is None


def test_subaperture_images_sum_to_the_image():
    history = echo_of(np.zeros((1, 3)))
    rows, columns = np.meshgrid(np.arange(PART_PX), np.arange(PART_PX), indexing="ij")
    points = GROUND.positions_at(GRID, rows.astype(float), columns.astype(float))
    parts = part_images(range_compress(history, GRID, GROUND), [points])
    assert parts.shape == (1, 2, PARTS, PART_PX, PART_PX)
    whole = np.abs(parts.sum(axis=(1, 2))[0])
    assert whole.max() == pytest.approx(1.0, abs=0.05)
    assert np.unravel_index(whole.argmax(), whole.shape) in {(31, 31), (31, 32), (32, 31), (32, 32)}


def test_joint_peak_power_is_largest_on_the_true_track():
    """Random track errors of 2 cm reduce the measure by which hypotheses are compared."""
    history = echo_of(np.zeros((1, 3)))
    erroneous = TRACK + 0.02 * np.random.default_rng(4).standard_normal(TRACK.shape)
    displaced = PhaseHistory(
        history.transfer, FREQUENCY_HZ, history.weight, history.reference_delay_s, Aperture(erroneous, erroneous)
    )
    true_power, displaced_power = (joint_peak_power([pulses], GRID, 0.0) for pulses in (history, displaced))
    assert 0.8 < true_power < 1.3
    assert displaced_power < 0.7 * true_power


# Focus of points with coarse range cells

COARSE_HZ = 1.2e9 + 100e6 / 256 * np.arange(256)
"""Resolution of 3 m along the line of sight; across, 0.16 m with 50 m of track at a range of 67 m."""


ALONG = np.linspace(-1, 1, 512)
LOGGED = np.stack([25 * ALONG, np.full(512, -60.0), np.full(512, 30.0)], -1)


def reported(history, grid, ground):
    """Return the focus report of the image of a phase history."""
    models = GroundModels.of(ground, None, grid)
    job = imaging_job(history.aperture, history.frequency_hz, history.weight, grid, models)
    plan = make_plan(job, accuracy_db=-50.0)
    formation = Formation(history, range_compress(history, grid, ground), grid, plan, 256)
    return focus_report(formation, formation.image.compute())


@pytest.mark.parametrize(("phase_rad", "verdict"), [(0.0, "focused"), (6.0, "defocused")])
def test_image_with_a_phase_error_over_frequency_is_flagged(phase_rad, verdict):
    """Two points, one of which has a neighbour in the next range cell; a quadratic phase smears all of them."""
    history = echo_of(np.array([[-1.5, -1.0, 0.0], [-1.5, -0.4, 0.0], [1.5, 1.0, 0.0], [0.5, -2.0, 0.0]]))
    error = np.exp(1j * phase_rad * np.linspace(-1, 1, 256) ** 2)
    report = reported(replace(history, transfer=(history.transfer * error).astype(np.complex64)), GRID, GROUND)
    assert report["range"]["verdict"] == verdict
    assert report["range"]["phase_rad"] == pytest.approx(phase_rad, abs=0.5)
    assert ("range_defocused" in focus_flags(report, Effect(0, 0, 0, 0))) == (verdict == "defocused")


def coarse_report(targets, *, seed, bow_m=0.0):
    """Return focus report, point positions and true aperture; the track differs from the log by a bow."""
    generator = np.random.default_rng(seed)
    points = np.column_stack([generator.uniform(-17, 17, (targets, 2)), np.zeros(targets)])
    aperture = Aperture(*[LOGGED + bow_m * np.cos(2 * np.pi * ALONG)[:, None] * [0, 1, 0]] * 2)
    path, echo = aperture.path(points), np.zeros((512, 256), np.complex64)
    for number, amplitude in enumerate(generator.uniform(0.5, 1, targets) * np.exp(2j * np.pi * generator.random())):
        echo += amplitude * np.exp(-2j * np.pi * COARSE_HZ * path[:, number, None] / SPEED_OF_LIGHT_M_S)
    echo += 0.1 * (generator.standard_normal(echo.shape) + 1j * generator.standard_normal(echo.shape))
    window = np.hanning(258)[1:-1]
    history = PhaseHistory(echo, COARSE_HZ, window / window.sum(), np.zeros(512), Aperture(LOGGED, LOGGED))
    grid, ground = SceneGrid("local", -20.0, 20.0, 0.08, (500, 500)), FlatGround(0.0)
    return reported(history, grid, ground), points, aperture


@pytest.mark.slow
@pytest.mark.parametrize("targets", [5, 12, 30])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_sidelobes_along_a_coarse_range_cell_are_not_points(targets, seed):
    """Reported points are true points, and focused images of 5 to 30 points have no loss."""
    report, true_points, _ = coarse_report(targets, seed=seed)
    reported = np.array([[point["x_m"], point["y_m"]] for point in report["points"]])
    distance = np.linalg.norm(reported[:, None] - true_points[:, :2], axis=-1)
    assert distance.min(axis=1).max() < 0.5
    assert len(set(distance.argmin(axis=1))) == len(reported)
    assert report["verdict"] == "focused"
    assert report["loss_db"] == pytest.approx(0.0, abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("targets", [5, 12])
def test_loss_of_points_with_coarse_range_cells_is_measured(targets):
    """The true loss follows from the paths of the true track to a target minus the paths of the log to its image."""
    report, true_points, aperture = coarse_report(targets, seed=3, bow_m=0.018)
    wavenumber, losses = 2 * np.pi * COARSE_HZ.mean() / SPEED_OF_LIGHT_M_S, []
    for point in report["points"]:
        imaged = np.array([[point["x_m"], point["y_m"], 0.0]])
        nearest = np.linalg.norm(true_points - imaged, axis=1).argmin()
        error_m = (Aperture(LOGGED, LOGGED).path(imaged) - aperture.path(true_points[[nearest]]))[:, 0]
        losses.append(20 * np.log10(np.abs(np.fft.fft(np.exp(1j * wavenumber * error_m), 4096)).max() / 512))
    assert -2.0 < np.median(losses) < -1.0
    assert report["loss_db"] == pytest.approx(np.median(losses), abs=0.2)
