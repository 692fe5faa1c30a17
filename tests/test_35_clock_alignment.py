"""Clock offset and path offset of a recorder from its echoes: estimated if the speed changes, otherwise flagged."""

import numpy as np
import pytest

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.methods.alignment.on_ground import align_on_scene
from apertura.methods.alignment.on_point import align_on_point, estimate_drift
from apertura.methods.autofocus.motion import Logged, Recorded, plausible_offsets

BEHIND_S, PATH_M = 3.217, 1.43
FREQUENCY = 3.0e9 + 10e6 * np.arange(100)
POINTS = np.array([[0.3, 4.0, 0.0], [-0.9, 4.6, 0.0], [1.1, 3.5, 0.0]])


def start_and_stop(time_s):
    """Return the positions along a track: stationary until 5 s, then 3 m in 8 s with varying speed, then stationary."""
    along = np.clip((time_s - 5.0) / 8.0, 0.0, 1.0)
    return 3.0 * (along + 0.04 * np.sin(4 * np.pi * along)) - 1.5


def steadily(time_s):
    return 0.3 * (time_s - 9.0)


def track(along):
    return np.stack([along, 0 * along, np.full_like(along, 1.0)], -1)


def echo_and_log(motion, *, amplitudes=(1.0, 0.4, 0.5), seed=3):
    """Simulate pulses from 1 to 15 s with a clock late by `BEHIND_S`, constant coupling and noise; and a log."""
    pulse_s = np.arange(1.0, 15.0, 0.04)
    antenna = track(motion(pulse_s))
    rng = np.random.default_rng(seed)
    paths = [2 * np.linalg.norm(antenna - point, axis=1) + PATH_M for point in POINTS]
    transfer = sum(
        amplitude * np.exp(-2j * np.pi * FREQUENCY * path[:, None] / SPEED_OF_LIGHT_M_S)
        for amplitude, path in zip(amplitudes, paths, strict=True)
    )
    transfer = transfer + 5 * np.exp(-2j * np.pi * FREQUENCY * 0.5 / SPEED_OF_LIGHT_M_S)
    transfer = transfer + rng.normal(0, 0.3, (2, *transfer.shape)).T.swapaxes(0, 1) @ [1, 1j]
    echo = Recorded(
        transfer.astype(np.complex64), FREQUENCY, np.zeros(len(pulse_s)), pulse_s - BEHIND_S, SPEED_OF_LIGHT_M_S
    )
    log = Logged(lambda at_s: Aperture(track(motion(at_s)), track(motion(at_s))), 0.0, 18.0)
    return echo, log


def test_start_and_stop_limit_the_offset_to_two_seconds():
    low, high = plausible_offsets(*echo_and_log(start_and_stop), (-10.0, 15.0))
    assert low < BEHIND_S < high
    assert high - low < 2.0


def test_constant_velocity_excludes_no_offset():
    low, high = plausible_offsets(*echo_and_log(steadily), (1.0, 6.0))
    assert (low, high) == pytest.approx((1.0, 6.0), abs=0.1)


def test_offset_and_path_are_estimated_from_a_known_point():
    alignment = align_on_point(*echo_and_log(start_and_stop), POINTS[0], within_s=(-10.0, 15.0), search_m=5.0)
    assert alignment.offset_s == pytest.approx(BEHIND_S, abs=0.003)
    assert alignment.path_m == pytest.approx(PATH_M, abs=0.005)
    assert alignment.contrast_db > 15
    assert not alignment.flags
    assert 0.01 < alignment.offset_width_s < 0.2


def test_known_path_offset_is_kept():
    echo, log = echo_and_log(start_and_stop)
    known = Recorded(
        echo.transfer, FREQUENCY, echo.reference_delay_s - PATH_M / SPEED_OF_LIGHT_M_S, echo.time_s, SPEED_OF_LIGHT_M_S
    )
    alignment = align_on_point(known, log, POINTS[0], within_s=(-10.0, 15.0), search_m=0.0)
    assert alignment.path_m == 0.0
    assert alignment.offset_s == pytest.approx(BEHIND_S, abs=0.003)


@pytest.mark.slow
def test_clock_drift_is_estimated_on_a_long_recording():
    """Over ten minutes of oscillation, 40 ppm cause 24 ms and a path error of 4 cm, more than half a wavelength."""

    def to_and_fro(time_s):
        return 2.0 * np.sin(0.6 * time_s + 0.4 * np.sin(0.05 * time_s))

    slow_ppm, pulse_s = 40.0, np.arange(1.0, 600.0, 0.2)
    path = 2 * np.linalg.norm(track(to_and_fro(pulse_s)) - POINTS[0], axis=1) + PATH_M
    transfer = np.exp(-2j * np.pi * FREQUENCY * path[:, None] / SPEED_OF_LIGHT_M_S).astype(np.complex64)
    clock_s = (pulse_s - pulse_s[0]) / (1 + slow_ppm * 1e-6) + pulse_s[0] - BEHIND_S
    echo = Recorded(transfer, FREQUENCY, np.zeros(len(pulse_s)), clock_s, SPEED_OF_LIGHT_M_S)
    log = Logged(lambda at_s: Aperture(track(to_and_fro(at_s)), track(to_and_fro(at_s))), 0.0, 610.0)
    without_drift = align_on_point(echo, log, POINTS[0], within_s=(2.9, 3.5), search_m=2.0)
    with_drift = estimate_drift(without_drift, echo, log, POINTS[0])
    assert with_drift.drift_ppm == pytest.approx(slow_ppm, abs=0.5)
    assert with_drift.offset_s == pytest.approx(BEHIND_S, abs=1e-3)
    assert abs(without_drift.offset_s - BEHIND_S) > 5e-3


def test_clock_drift_is_not_observable_on_a_short_recording():
    echo, log = echo_and_log(start_and_stop)
    alignment = align_on_point(echo, log, POINTS[0], within_s=(-10.0, 15.0), search_m=5.0)
    with_drift = estimate_drift(alignment, echo, log, POINTS[0])
    assert with_drift.drift_ppm == 0.0
    assert "not observable" in with_drift.report["drift"]


def test_absent_reference_point_is_flagged():
    alignment = align_on_point(
        *echo_and_log(start_and_stop), np.array([-1.4, 9.0, 0.0]), within_s=(-10.0, 15.0), search_m=0.2
    )
    assert {"alignment_uncertain", "alignment_ambiguous"} & alignment.flags.keys()


@pytest.mark.slow
def test_sharpness_determines_offset_and_path_if_the_speed_changes():
    grid = SceneGrid.from_bounds("local", (-2.0, 2.5, 2.0, 5.5), spacing_m=0.05)
    alignment = align_on_scene(
        *echo_and_log(start_and_stop), grid, FlatGround(0.0), within_s=(-10.0, 15.0), search_m=1.6
    )
    assert alignment.offset_s == pytest.approx(BEHIND_S, abs=0.1)
    assert alignment.path_m == pytest.approx(PATH_M, abs=0.1)
    assert np.linalg.norm(np.array(alignment.report["brightest_m"]) - POINTS[0]) < 0.06


@pytest.mark.slow
def test_sharpness_is_ambiguous_at_constant_velocity():
    grid = SceneGrid.from_bounds("local", (-2.0, 2.5, 2.0, 5.5), spacing_m=0.05)
    alignment = align_on_scene(*echo_and_log(steadily), grid, FlatGround(0.0), within_s=(2.5, 4.0), search_m=0.0)
    assert "alignment_ambiguous" in alignment.flags


def test_log_without_overlap_is_refused():
    echo, log = echo_and_log(start_and_stop)
    with pytest.raises(ValueError, match="no offset puts half of the pulses inside the log"):
        plausible_offsets(echo, log, (100.0, 120.0))
