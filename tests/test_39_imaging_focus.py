"""Where the echo of the pulses comes from, and what parts of the aperture show of it."""

import numpy as np
import pytest

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.focus.inputs import PhaseHistory
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.focus_check import PART_PX, PARTS, echo_elsewhere, joint_peak_power, part_images
from apertura.core.imaging.range_profiles import range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround

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
    line = echo_elsewhere(echo_of(np.array([[0.0, 40.0, 0.0]])), GRID, GROUND)
    assert "has a total path of 12" in line  # 2·√(60² + 10²) = 121.7 m
    assert "the scene's are" in line


def test_a_strong_echo_that_no_place_gathers_is_said_to_be():
    """Asked only where no bright point was found: a point in the scene's own ranges is then at no place."""
    line = echo_elsewhere(echo_of(np.zeros((1, 3))), GRID, GROUND)
    assert "no place of the image gathers it" in line


@pytest.mark.parametrize("noise", [1e-3, 30.0])
def test_speckle_and_noise_are_no_echo_of_a_point(noise):
    generator = np.random.default_rng(2)
    places = np.column_stack([generator.uniform(-3.2, 3.2, (400, 2)), np.zeros(400)])
    assert echo_elsewhere(echo_of(places, noise=noise), GRID, GROUND) is None


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
    assert echo_elsewhere(bistatic, GRID, GROUND) is None


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
