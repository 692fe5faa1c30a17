"""Where the echo of the pulses comes from, and what parts of the aperture show of it."""

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
    focus_report,
    joint_peak_power,
    part_images,
)
from apertura.core.imaging.formation import Formation
from apertura.core.imaging.job import imaging_job
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.planning.planner import make_plan
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, GroundModels

FREQUENCY_HZ = 1.2e9 + 1e6 * np.arange(256)
PULSES = 128
GRID, GROUND = SceneGrid("local", -3.2, 3.2, 0.1, (64, 64)), FlatGround(0.0)
TRACK = np.stack([np.linspace(-4, 4, PULSES), np.full(PULSES, -20.0), np.full(PULSES, 10.0)], -1)


def echo_of(places, *, noise=1e-3, seed=1):
    generator = np.random.default_rng(seed)
    flown = Aperture(TRACK, TRACK)
    transfer = sum(
        np.exp(-2j * np.pi * FREQUENCY_HZ * path[:, None] / SPEED_OF_LIGHT_M_S) for path in flown.path(places).T
    )
    transfer = transfer + noise * (generator.standard_normal((2, *transfer.shape)) * [[[1]], [[1j]]]).sum(axis=0)
    return PhaseHistory(
        transfer.astype(np.complex64), FREQUENCY_HZ, np.hanning(258)[1:-1] / 128.5, np.zeros(PULSES), flown
    )


def test_an_echo_that_the_scene_has_no_range_for_is_elsewhere():
    line = echo_outside_scene(echo_of(np.array([[0.0, 40.0, 0.0]])), GRID, GROUND)
    assert "has a total path of 12" in line  # 2·√(60² + 10²) = 121.7 m
    assert "those of the scene are" in line


def test_a_strong_echo_that_no_place_gathers_is_said_to_be():
    """Asked only where no bright point was found: a point in the scene's own ranges is then at no place."""
    line = echo_outside_scene(echo_of(np.zeros((1, 3))), GRID, GROUND)
    assert "no pixel of the image focuses it" in line


def test_points_that_share_a_range_cell_are_no_echo_from_elsewhere():
    """Three equal points 2.6 m apart on one cell of 0.6 m: each gathers its third of the echo."""
    east = np.array([-2.6, 0.0, 2.6])
    places = np.column_stack([east, np.sqrt(400 - east**2) - 20, 0 * east])
    history = echo_of(places)
    assert "no pixel of the image focuses it" in echo_outside_scene(history, GRID, GROUND)
    terms = list(reference.terms(history, places).T)
    assert echo_outside_scene(history, GRID, GROUND, points=terms) is None
    elsewhere = list(reference.terms(history, places + [1.5, 0.0, 0.0]).T)
    assert "no pixel of the image focuses it" in echo_outside_scene(history, GRID, GROUND, points=elsewhere)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [1e-3, 30.0])
def test_speckle_and_noise_are_no_echo_of_a_point(noise):
    generator = np.random.default_rng(2)
    places = np.column_stack([generator.uniform(-3.2, 3.2, (400, 2)), np.zeros(400)])
    assert echo_outside_scene(echo_of(places, noise=noise), GRID, GROUND) is None


@pytest.mark.slow
def test_the_direct_path_between_two_antennas_is_not_an_echo():
    generator = np.random.default_rng(3)
    places = np.column_stack([generator.uniform(-3.2, 3.2, (400, 2)), np.zeros(400)])
    ahead = np.array([5.0, 0.0, 0.0])
    history = echo_of(places)
    flown = Aperture(TRACK, TRACK + ahead)
    direct = 1e4 * np.exp(-2j * np.pi * FREQUENCY_HZ * 5.0 / SPEED_OF_LIGHT_M_S)
    transfer = sum(
        np.exp(-2j * np.pi * FREQUENCY_HZ * path[:, None] / SPEED_OF_LIGHT_M_S) for path in flown.path(places).T
    )
    bistatic = PhaseHistory(
        (transfer + direct).astype(np.complex64), FREQUENCY_HZ, history.weight, np.zeros(PULSES), flown
    )
    assert echo_outside_scene(bistatic, GRID, GROUND) is None


def test_parts_of_the_aperture_add_up_to_the_image_of_a_place():
    history = echo_of(np.zeros((1, 3)))
    rows, columns = np.meshgrid(np.arange(PART_PX), np.arange(PART_PX), indexing="ij")
    places = GROUND.positions_at(GRID, rows.astype(float), columns.astype(float))
    parts = part_images(range_compress(history, GRID, GROUND), [places])
    assert parts.shape == (1, 2, PARTS, PART_PX, PART_PX)
    whole = np.abs(parts.sum(axis=(1, 2))[0])
    assert whole.max() == pytest.approx(1.0, abs=0.05)
    assert np.unravel_index(whole.argmax(), whole.shape) in {(31, 31), (31, 32), (32, 31), (32, 32)}


def test_echoes_gather_best_where_the_antennas_were():
    """The measure that hypotheses are compared by: a track taken 2 cm wrong at random gathers less."""
    history = echo_of(np.zeros((1, 3)))
    wrong = TRACK + 0.02 * np.random.default_rng(4).standard_normal(TRACK.shape)
    moved = PhaseHistory(
        history.transfer, FREQUENCY_HZ, history.weight, history.reference_delay_s, Aperture(wrong, wrong)
    )
    right, less = (joint_peak_power([one], GRID, 0.0) for one in (history, moved))
    assert 0.8 < right < 1.3
    assert less < 0.7 * right


# ---- Focus of points along coarse range cells

COARSE_HZ = 1.2e9 + 100e6 / 256 * np.arange(256)
"""Cells of 3 m along the line of sight, and of 0.16 m across it from 50 m of track 67 m away."""


ALONG = np.linspace(-1, 1, 512)
LOGGED = np.stack([25 * ALONG, np.full(512, -60.0), np.full(512, 30.0)], -1)


def coarse_report(targets, *, seed, bow_m=0.0):
    """The focus report of an image of points, and where they are; the antennas flew off the log by a bow."""
    generator = np.random.default_rng(seed)
    places = np.column_stack([generator.uniform(-17, 17, (targets, 2)), np.zeros(targets)])
    flown = Aperture(*[LOGGED + bow_m * np.cos(2 * np.pi * ALONG)[:, None] * [0, 1, 0]] * 2)
    path, echo = flown.path(places), np.zeros((512, 256), np.complex64)
    for number, amplitude in enumerate(generator.uniform(0.5, 1, targets) * np.exp(2j * np.pi * generator.random())):
        echo += amplitude * np.exp(-2j * np.pi * COARSE_HZ * path[:, number, None] / SPEED_OF_LIGHT_M_S)
    echo += 0.1 * (generator.standard_normal(echo.shape) + 1j * generator.standard_normal(echo.shape))
    window = np.hanning(258)[1:-1]
    history = PhaseHistory(echo, COARSE_HZ, window / window.sum(), np.zeros(512), Aperture(LOGGED, LOGGED))
    grid, ground = SceneGrid("local", -20.0, 20.0, 0.08, (500, 500)), FlatGround(0.0)
    models = GroundModels.of(ground, None, grid)
    job = imaging_job(history.aperture, COARSE_HZ, history.weight, grid, models)
    plan = make_plan(job, accuracy_db=-50.0)
    formation = Formation(history, range_compress(history, grid, ground), grid, plan, 256)
    return focus_report(formation, formation.image.compute()), places, flown


@pytest.mark.quick("1-5")
@pytest.mark.parametrize("targets", [5, 12, 30])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_sidelobes_along_a_coarse_range_cell_are_no_points(targets, seed):
    """What is told to be a point is one, and sound images of 5 to 30 of them lose nothing."""
    report, places, _ = coarse_report(targets, seed=seed)
    told = np.array([[point["x_m"], point["y_m"]] for point in report["points"]])
    distance = np.linalg.norm(told[:, None] - places[:, :2], axis=-1)
    assert distance.min(axis=1).max() < 0.5
    assert len(set(distance.argmin(axis=1))) == len(told)
    assert report["verdict"] == "focused"
    assert report["loss_db"] == pytest.approx(0.0, abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("targets", [5, 12])
def test_the_loss_of_points_along_a_coarse_range_cell_is_told(targets):
    """Truth: the phases between the paths flown to a target and those of the log to where the image has it."""
    report, places, flown = coarse_report(targets, seed=3, bow_m=0.018)
    wavenumber, losses = 2 * np.pi * COARSE_HZ.mean() / SPEED_OF_LIGHT_M_S, []
    for point in report["points"]:
        told = np.array([[point["x_m"], point["y_m"], 0.0]])
        nearest = np.linalg.norm(places - told, axis=1).argmin()
        error_m = (Aperture(LOGGED, LOGGED).path(told) - flown.path(places[[nearest]]))[:, 0]
        losses.append(20 * np.log10(np.abs(np.fft.fft(np.exp(1j * wavenumber * error_m), 4096)).max() / 512))
    assert -2.0 < np.median(losses) < -1.0
    assert report["loss_db"] == pytest.approx(np.median(losses), abs=0.2)
