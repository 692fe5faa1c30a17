"""Phase centres between the epochs of a log: smoothing, and local frames that are not georeferenced."""

import numpy as np
import pytest

from apertura.core.geometry.lever_arms import phase_centres, position_spline

BEGAN = np.datetime64("2025-05-14T09:30", "ns")


def times(seconds):
    return BEGAN + np.round(np.asarray(seconds) * 1e9).astype("timedelta64[ns]")


def test_smoothing_spline_removes_the_given_noise():
    rng, noise_m = np.random.default_rng(7), 0.02
    time_s = np.arange(400) * 0.05
    flown = np.stack([5 * time_s, np.sin(time_s), 0.2 * np.cos(0.5 * time_s)], -1) + [4.1e6, 7e5, 4.8e6]
    logged = flown + rng.normal(0, noise_m, flown.shape)
    smooth = position_spline(time_s, logged, smoothing_m=noise_m)
    residual_m = float(np.sqrt(np.mean((smooth(time_s) - logged) ** 2)))
    assert residual_m == pytest.approx(noise_m, rel=1e-3)
    between = np.linspace(1, 18, 999)
    truth = np.stack([5 * between, np.sin(between), 0.2 * np.cos(0.5 * between)], -1) + [4.1e6, 7e5, 4.8e6]
    rough = position_spline(time_s, logged)

    def error_m(spline):
        return float(np.sqrt(np.mean((spline(between) - truth) ** 2)))

    assert error_m(smooth) < error_m(rough) / 2


@pytest.mark.parametrize(("yaw_deg", "expected"), [(0, (0, 1, 0)), (90, (1, 0, 0)), (180, (0, -1, 0))])
def test_yaw_in_a_local_frame_is_clockwise_from_north(yaw_deg, expected):
    """Axes are east, north and up; a lever arm with a positive third component points down."""
    position = np.array([[0.0, 0, 2], [0, 0, 2], [0, 0, 2]])
    attitude = np.radians([[0.0, 0.0, yaw_deg]] * 3)
    placed = phase_centres(
        times([0, 1, 2]),
        position,
        attitude,
        at=times([0.5, 1.5]),
        lever_arm_m=(1.0, 0.0, 0.5),
        attitude_from="log",
        where="log",
        frame="local",
    )
    np.testing.assert_allclose(placed, np.array([expected, expected]) + [0, 0, 1.5], atol=1e-12)
