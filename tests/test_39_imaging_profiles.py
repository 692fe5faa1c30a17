"""Range profiles of a scene: range window, echo peaks and unambiguous range."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import tried
from scenes import TARGET, TARGET_GRID, point_history

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.common.errors import CampaignError
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.range_profiles import GUARD_SAMPLES, RangeWindow, range_compress
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround, GridHeights

FLAT = FlatGround(0.0)


def test_echo_peaks_at_its_path_with_amplitude_and_band_centre_phase():
    history = point_history(8)
    profiles = range_compress(history, TARGET_GRID, FLAT)
    path = history.aperture.path(TARGET)[:, 0]
    sample = (path - profiles.start_m) / profiles.step_m
    np.testing.assert_array_equal(np.abs(profiles.samples).argmax(axis=1), np.rint(sample))
    window = RangeWindow.of(history.aperture, TARGET_GRID, FLAT, history.frequency_hz, wave_speed_m_s=C)
    peak_samples = range_compress(
        history, TARGET_GRID, FLAT, window=replace(window, start_m=path - 40 * window.step_m)
    ).samples[:, 40]
    demodulated = peak_samples * np.exp(2j * np.pi * profiles.centre_frequency_hz * path / C)
    np.testing.assert_allclose(demodulated, 1.0, atol=1e-4)


def test_reference_delay_does_not_change_the_profiles():
    history = point_history(8)
    delay = history.aperture.path(TARGET)[:, 0] / C - 3e-9
    delayed = history.transfer * np.exp(2j * np.pi * history.frequency_hz * delay[:, None])
    referred = replace(history, transfer=delayed.astype(np.complex64), reference_delay_s=delay)
    plain, other = (range_compress(echo, TARGET_GRID, FLAT).samples for echo in (history, referred))
    np.testing.assert_allclose(other, plain, atol=1e-4)


@given(
    shape=st.tuples(st.integers(2, 40), st.integers(2, 40)),
    relief_m=st.floats(0, 3),
    middle=st.tuples(st.floats(-40, 40), st.floats(-40, 40)),
    seed=st.integers(0, 99),
)
@tried(25, derandomize=False)
def test_range_window_covers_every_pixel_with_guard_samples(shape, relief_m, middle, seed):
    generator = np.random.default_rng(seed)
    grid = SceneGrid("local", middle[0], middle[1], 0.5, shape)
    heights = relief_m * generator.uniform(-1, 1, shape)
    track = np.stack([np.linspace(-4, 4, 9), np.zeros(9), np.full(9, 10.0)], -1)
    aperture = Aperture(track, track + [2.0, 1.0, 0.5])
    window = RangeWindow.of(aperture, grid, GridHeights(grid, heights), 1.2e9 + 2e6 * np.arange(200), wave_speed_m_s=C)
    path = aperture.path(grid.positions(heights)).reshape(9, -1)
    guard = GUARD_SAMPLES * window.step_m
    assert (path.min(axis=1) >= window.start_m + guard - 1e-9).all()
    assert (path.max(axis=1) <= window.start_m + window.samples * window.step_m - guard + 1e-9).all()
    assert (path.max(axis=1) <= window.farthest_m + 1e-9).all()


def test_scene_deeper_than_the_unambiguous_range_is_refused():
    """With 2 MHz between subcarriers, the total path repeats every 150 m or 400 samples."""
    deep = SceneGrid("local", -50.0, 100.0, 1.0, (150, 100))
    with pytest.raises(CampaignError, match=r"spans \d+ range samples; expected at most 400"):
        range_compress(point_history(4), deep, FLAT)
