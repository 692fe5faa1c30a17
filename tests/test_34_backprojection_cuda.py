"""GPU engine: predictions, tests in the simulator of numba, and behaviour without a device."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scenes import ecef, fly, monostatic, pixel_grid, plan, planning_job, scatter, straight_track, without_library
from scenes import side_beam as beam_of

from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines import cuda, load_engine
from apertura.core.backprojection.engines.cuda_prediction import (
    ANGLE_ERROR,
    ANGLE_RMS,
    FARTHEST,
    FLOAT32_ERROR,
    LAST_ORDER,
    LAST_TERM,
    PLACE_ERROR,
    PLACE_RMS,
    candidates,
)
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.backprojection.job import Integration
from apertura.core.geometry.sector import Sector
from apertura.core.planning.planner import SettingSearch


@pytest.fixture(scope="module")
def plain():
    pixels = pixel_grid(16, 18)
    scene = fly(scatter(pixels), pulses=12)
    return pixels, scene.profiles(ecef(pixels))


@pytest.mark.slow
def test_simulated_device_passes_its_tests():
    tests = Path(__file__).with_name("simulated_device.py")
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", str(tests)]
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1", "OPENBLAS_NUM_THREADS": "1"}
    run = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-1000:]
    assert int(re.search(r"(\d+) passed", run.stdout)[1]) >= 38


def test_series_error_stays_below_its_bound():
    """Eq. 8 in float32, as in the kernel, at random pixels of near and far patches: rounding and truncation errors."""
    draw = np.random.default_rng(0)
    for reach, distance in ((0.5, 2.3), (0.5, 4.0), (0.5, 20.0), (5.0, 500.0), (0.5, 1e4)):
        w, d = draw.standard_normal((2, 20000, 3))
        w *= distance / np.linalg.norm(w, axis=1, keepdims=True)
        d *= reach / np.linalg.norm(d, axis=1, keepdims=True) * np.sqrt(draw.random((20000, 1)))
        exact = ((2 * w + d) * d).sum(1) / (np.linalg.norm(w + d, axis=1) + distance)
        a, near = (2 * w / distance**2).astype(np.float32), d.astype(np.float32)
        s = np.float32(1 / distance**2) * (near * near).sum(1)
        s = s + a[:, 0] * near[:, 0] + a[:, 1] * near[:, 1] + a[:, 2] * near[:, 2]
        root = np.float32(7 / 128)
        for term in (-5 / 64, 1 / 8, -1 / 4, 1):
            root = np.float32(term) + s * root
        error = np.abs(np.float32(distance / 2) * s * root - exact)
        largest = reach * (2 * distance + reach) / distance**2
        bound = LAST_TERM * distance * largest**LAST_ORDER / (1 - largest) + FLOAT32_ERROR * reach
        assert largest < FARTHEST
        assert error.max() <= bound
        assert error.max() > bound / 20  # the bound is not too loose


def test_weight_error_stays_below_its_bound():
    """Eq. 8a and the angles about the beam axes are computed in float32, as in the kernel."""
    draw = np.random.default_rng(0)
    for reach, distance in ((0.5, 20.0), (5.0, 500.0), (0.5, 1e4)):
        w, d = draw.standard_normal((2, 20000, 3))
        w *= distance / np.linalg.norm(w, axis=1, keepdims=True)
        d *= reach / np.linalg.norm(d, axis=1, keepdims=True) * np.sqrt(draw.random((20000, 1)))
        axes = np.linalg.qr(draw.standard_normal((20000, 3, 3)))[0]
        near, axes_float32 = d.astype(np.float32), axes.astype(np.float32)
        # The change of s over the patch.
        exact = (axes[:, 0] * (w + d)).sum(1) / np.linalg.norm(w + d, axis=1) - (axes[:, 0] * w).sum(1) / distance
        slope, axis = (2 * w / distance**2).astype(np.float32), (axes[:, 0] / distance).astype(np.float32)
        s = np.float32(1 / distance**2) * (near * near).sum(1) + (slope * near).sum(1)
        root = np.float32(7 / 128)
        for term in (-5 / 64, 1 / 8, -1 / 4, 1):
            root = np.float32(term) + s * root
        longer, at_origin = s * root / np.float32(2), ((axes[:, 0] * w).sum(1) / distance).astype(np.float32)
        error = np.abs(((axis * near).sum(1) - at_origin * longer) / (np.float32(1) + longer) - exact)
        assert PLACE_ERROR / 3 < error.max() / (reach / distance) <= PLACE_ERROR
        assert np.sqrt((error**2).mean()) / (reach / distance) == pytest.approx(PLACE_RMS, rel=0.1)
        # Elevation angle, and its index in a cut of 4097 samples over 180°.
        along = np.einsum("nij,nj->ni", axes, w).astype(np.float32) + np.einsum("nij,nj->ni", axes_float32, near)
        truth = np.einsum("nij,nj->ni", axes, w + d)
        angle = np.arctan2(along[:, 2], np.sqrt(along[:, 0] ** 2 + along[:, 1] ** 2))
        index = (angle + np.float32(np.pi / 2)) * np.float32(4096 / np.pi)
        exact = (np.arctan2(truth[:, 2], np.hypot(truth[:, 0], truth[:, 1])) + np.pi / 2) * 4096 / np.pi
        error = np.abs(index - exact) * np.pi / 4096
        assert ANGLE_ERROR / 5 < error.max() <= ANGLE_ERROR
        assert ANGLE_RMS / 5 < np.sqrt((error**2).mean()) <= ANGLE_RMS


def test_invalid_input_is_refused(plain):
    _, profiles = plain
    tables = cuda.prepare(profiles)
    with pytest.raises(ValueError, match="must contain at least one pulse"):
        cuda.prepare(profiles[slice(0, 0)])
    with pytest.raises(ValueError, match="must be finite"):
        cuda.prepare(replace(profiles, start_m=profiles.start_m * np.nan))
    with pytest.raises(ValueError, match="oversampling"):
        cuda.prepare(replace(profiles, oversampling=1.2))
    with pytest.raises(ValueError, match=r"must be \(y, x, 3\)"):
        cuda.form(tables, np.zeros((4, 4)))
    other_aperture = monostatic(straight_track(11))
    for beams in (
        Beams(beam_of(pulses=11)),
        Beams(sector=Sector.of(other_aperture, chord_m=1.0, centre=0.0, half=0.1)),
    ):
        with pytest.raises(ValueError, match="must equal the number of pulses, 12"):
            cuda.form(tables, np.zeros((4, 4, 3)), beams=beams)
    assert cuda.form(tables, np.zeros((0, 4, 3))).shape == (0, 4)


def test_weights_add_to_predicted_time_and_error():
    """The predicted time increases with each beam and is proportional to the number of pulses in a sector."""
    sector = Sector.of(planning_job().aperture, chord_m=1.0, centre=0.0, half=0.05)
    search = {"pulses": 100_000, "requested": {"oversampling": 16, "tolerance_rad": 1.5e-5}}
    large = {"shape": (4096, 4096), "tile_px": 4096}  # transfers and launches take a small part of the time

    def predicted(**changes):
        (setting,) = candidates(planning_job(**large, **changes), **search)
        return setting

    plain, one_beam, two_beams = (
        predicted(),
        predicted(beams=Beams(beam_of())),
        predicted(beams=Beams(beam_of(), beam_of())),
    )
    assert plain.form_seconds < one_beam.form_seconds < two_beams.form_seconds < 10 * plain.form_seconds
    sector_only = Integration(sector, 30, "0.05", "asked for", share=0.1)
    assert predicted(beams=Beams(sector=sector), integration=sector_only).form_seconds < plain.form_seconds / 3
    steep = beam_of((0.5, 60.0))  # pattern falls within half a degree
    errors = [setting.error_db for setting in (plain, two_beams, predicted(beams=Beams(steep)))]
    assert errors[0] < errors[1] < errors[2] - 1
    assert ", weights -" in predicted(beams=Beams(steep)).reasons["oversampling"]
    assert "weights" not in plain.reasons["oversampling"]


@pytest.mark.slow
def test_weighted_image_uses_cuda_only_if_requested(monkeypatch):
    monkeypatch.setattr(cuda, "available", lambda: True)
    job = {"beams": Beams(beam_of(), beam_of())}
    assert plan(**job).engine != "cuda"
    for requested in ({"engine": "cuda"}, {"engine_options": {"cuda": {"oversampling": 8}}}):
        assert plan(overrides=requested, **job).engine == "cuda"


@pytest.mark.parametrize(("threads", "engine"), [(1, "cuda"), (64, "tree")])
def test_device_is_selected_where_it_is_faster_than_all_threads(monkeypatch, threads, engine):
    """All threads share the device, so that its time is compared with that of a CPU with this number of cores."""
    monkeypatch.setattr(cuda, "available", lambda: True)
    large = planning_job(shape=(20000, 20000), tile_px=1024, threads=threads)
    assert SettingSearch(large).cheapest(300, -63.0).engine == engine
    assert plan(threads=threads).engine != "cuda"  # the first kernel takes longer to start than a small image
    requested = plan(overrides={"engine_options": {"cuda": {"oversampling": 8}}}, threads=threads)
    assert requested.engine == "cuda"


def test_larger_tiles_take_less_time_on_a_device():
    job = replace(planning_job(), shape=(4096, 4096))
    small, large = (next(candidates(replace(job, tile_px=side), pulses=300, requested={})) for side in (256, 1024))
    assert small.form_seconds - large.form_seconds == pytest.approx((256 - 16) * 0.01)


def test_reason_why_no_device_can_be_used_is_reported(monkeypatch):
    """numba-cuda 0.30 fails on import with NumPy 2.5; before, the engine was available and failed at its first tile."""
    monkeypatch.setattr(cuda, "missing", lambda: "AttributeError: module 'numpy' has no attribute 'row_stack'")
    assert not cuda.available()
    assert cuda.instruction_set() == "cuda: AttributeError: module 'numpy' has no attribute 'row_stack'"
    with pytest.raises(CampaignError, match="no attribute 'row_stack'"):
        cuda.sum_on_device(SimpleNamespace(resident=None), np.zeros((1, 1, 3)), None, 1e-3)


def test_simulator_slower_than_the_double_sum_is_no_fallback(monkeypatch):
    """An engine that costs more than the double sum is not used, even if no other engine meets the accuracy."""
    monkeypatch.setenv("NUMBA_ENABLE_CUDASIM", "1")
    without_library(monkeypatch)
    monkeypatch.setattr(cuda, "available", lambda: True)
    job = planning_job()
    (double_sum,) = load_engine("reference").candidates(job, pulses=300, requested={})
    settings = list(candidates(job, pulses=300, requested={}))
    assert min(setting.seconds for setting in settings) > 10 * double_sum.seconds
    assert min(setting.error_db for setting in settings) < -100
    fallbacks = SettingSearch(job).fallbacks(Setting("numba", {}, {}, -94.0, 1.0))
    assert [setting.engine for setting in fallbacks] == ["reference"]


@pytest.mark.skipif(cuda.available(), reason="there is a device")
def test_engine_is_refused_without_a_device(plain):
    pixels, profiles = plain
    with pytest.raises(CampaignError, match="engine cuda is not available on this machine") as raised:
        plan(overrides={"engine": "cuda"})
    assert "NVIDIA" in raised.value.remedy
    assert "cuda" not in raised.value.expected
    with pytest.raises(CampaignError, match="no device can be used"):
        cuda.form(cuda.prepare(profiles), ecef(pixels))
    assert cuda.instruction_set() == "cuda: no device"
    assert plan().engine != "cuda"


@pytest.mark.slow
def test_device_query_without_a_driver_does_not_import_numba():
    program = (
        "import sys; from apertura.core.backprojection.engines import load_engine\nload_engine('cuda').available()"
    )
    program += "\nimport ctypes\ntry: ctypes.CDLL('libcuda.so.1')\nexcept OSError: assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)
