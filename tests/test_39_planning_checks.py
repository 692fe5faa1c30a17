"""Checks of the geometry by the planner before processing."""

import numpy as np
import pytest
from scenes import ground_points, monostatic, plan, planning_job, straight_track

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.common.errors import CampaignError
from apertura.core.geometry.aperture import Aperture
from apertura.core.planning.plan import check_geometry


def test_spacing_coarser_than_the_resolution_cell_is_flagged():
    cell_m = monostatic(straight_track()).resolution_cell_m(ground_points(), band_hz=(1.0e9, 1.4e9))
    assert 0.2 < cell_m < 0.5  # λ/(4 sin(θ/2)) for 6 m of aperture at 22 m: 0.43 m
    finer, coarser = (check_geometry(planning_job(spacing_m=factor * cell_m)) for factor in (1.04, 1.06))
    assert "spacing_coarse" not in finer
    assert f"{cell_m:.3g} m" in coarser["spacing_coarse"]


@pytest.mark.slow
def test_platform_above_the_scene_is_flagged():
    over = straight_track() + np.array([0.0, 25.0, 0.0])
    assert "300 of 300 pulses" in plan(aperture=monostatic(over)).flags["platform_inside_scene"]
    assert "platform_inside_scene" not in plan().flags
    for narrow in (np.s_[4:5, 4:5], np.s_[4:5], np.s_[:, 4:5]):  # a row, a column or a pixel has no extent
        assert "platform_inside_scene" not in plan(ground_m=ground_points()[narrow]).flags


def test_missing_pulses_and_undefined_positions_are_refused():
    with pytest.raises(CampaignError, match="no pulses"):
        plan(aperture=monostatic(np.zeros((0, 3))))
    incomplete = straight_track()
    incomplete[7, 1] = np.nan
    with pytest.raises(CampaignError, match="1 of 300 phase centres are not finite, first at pulse 7"):
        plan(aperture=Aperture(incomplete, straight_track()))


@pytest.mark.parametrize(
    ("spread", "bandwidth_hz", "flagged"),
    [
        (0.97, 400e6, False),
        (1.15, 400e6, False),  # the edges are aliased in some pulses, with ambiguities at -34 dB
        (1.03, 2e6, False),  # ambiguities as bright as the points, in the outermost corners
        (1.4, 2e6, True),  # a third of the scene has ambiguities
        (2.5, 400e6, True),  # weak ambiguities, but their sum equals the signal at each pixel
    ],
)
def test_aperture_is_flagged_if_its_ambiguities_are_significant(spread, bandwidth_hz, flagged):
    fine, _ = monostatic(straight_track()).phase_rates(ground_points().reshape(-1, 3), wavelength_m=C / 1.4e9)
    track = straight_track(300, length_m=6.0 * spread / fine)
    for _ in range(3):  # a longer track also covers larger angles
        rate, _ = monostatic(track).phase_rates(ground_points().reshape(-1, 3), wavelength_m=C / 1.4e9)
        track[:, 0] *= spread / rate
    job = planning_job(aperture=monostatic(track), centre_hz=1.4e9 - bandwidth_hz / 2, bandwidth_hz=bandwidth_hz)
    assert ("azimuth_undersampled" in check_geometry(job)) == flagged


@pytest.mark.slow
def test_azimuth_ambiguity_of_a_point_migrates_through_range_cells():
    """With 150 of 300 required pulses, the highest ambiguity, half a scene away, is 2f/BM of the peak."""
    track, half = straight_track(150, length_m=30.0), 8.0
    frequency = 1.2e9 + 400e6 * (np.arange(256) / 256 - 0.5)
    window = np.hanning(258)[1:-1] / np.hanning(258).sum()
    aperture, point = monostatic(track), np.array([[-7.6, 12.8, 0.0]])
    east, north = np.meshgrid(np.arange(0, half, 0.05), 20 + np.arange(-half, half, 0.08))
    path_difference_m = aperture.path(np.stack([east, north, 0 * east], -1).reshape(-1, 3)) - aperture.path(point)
    along_m = np.linspace(-4, 4, 801)
    response = (np.exp(2j * np.pi * np.outer(along_m, frequency - 1.2e9) / C) @ window).real
    range_response = np.interp(path_difference_m, along_m, response, left=0.0, right=0.0)
    ghost = np.abs((range_response * np.exp(2j * np.pi * 1.2e9 / C * path_difference_m)).mean(axis=0)).max()
    assert ghost == pytest.approx(2 * 1.2e9 / 400e6 / 150, rel=0.3)


def test_missed_pulses_and_gaps_do_not_undersample_an_aperture():
    """The aperture is oversampled seven times and has 20 % random losses and a gap of 10 %."""
    points = ground_points().reshape(-1, 3)
    whole, _ = monostatic(straight_track(3000)).phase_rates(points, wavelength_m=C / 1.4e9)
    kept = np.random.default_rng(1).random(3000) > 0.2
    kept[1200:1500] = False
    remaining = monostatic(straight_track(3000)[kept])
    spread, widest = remaining.phase_rates(points, wavelength_m=C / 1.4e9)
    assert spread == pytest.approx(whole, rel=0.05)
    assert widest > 100 * whole
    assert "azimuth_undersampled" not in plan(aperture=remaining).flags
