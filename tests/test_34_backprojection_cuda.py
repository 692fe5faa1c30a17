"""The GPU engine: its prediction, its tests in numba's simulator, and what becomes of it where there is no device."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import ecef, fly, pixel_grid, plan, planning_job, scatter, without_library
from scenes import side_beam as beam_of

from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines import cuda, load_engine
from apertura.core.backprojection.engines.cuda_prediction import (
    FARTHEST,
    FLOAT32_ERROR,
    LAST_ORDER,
    LAST_TERM,
    candidates,
)
from apertura.core.backprojection.engines.engine import Setting
from apertura.core.planning.planner import SettingSearch


@pytest.fixture(scope="module")
def plain():
    pixels = pixel_grid(16, 18)
    scene = fly(scatter(pixels), pulses=12)
    return pixels, scene.profiles(ecef(pixels))


@pytest.mark.slow
def test_the_simulated_device_passes_its_tests():
    tests = Path(__file__).with_name("simulated_device.py")
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", str(tests)]
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1", "OPENBLAS_NUM_THREADS": "1"}
    run = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-1000:]
    assert int(re.search(r"(\d+) passed", run.stdout)[1]) >= 14


def test_the_series_errs_by_no_more_than_is_reckoned_with():
    """(8) in float32 as the kernel has it, random pixels about patches near and far: rounding, and orders left out."""
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
        most = reach * (2 * distance + reach) / distance**2
        bound = LAST_TERM * distance * most**LAST_ORDER / (1 - most) + FLOAT32_ERROR * reach
        assert most < FARTHEST
        assert error.max() <= bound
        assert error.max() > bound / 20  # and not by far less


def test_bad_input_is_refused(plain):
    _, profiles = plain
    tables = cuda.prepare(profiles)
    with pytest.raises(ValueError, match="holds no pulse"):
        cuda.prepare(profiles[slice(0, 0)])
    with pytest.raises(ValueError, match="must be finite"):
        cuda.prepare(replace(profiles, start_m=profiles.start_m * np.nan))
    with pytest.raises(ValueError, match="oversampling"):
        cuda.prepare(replace(profiles, oversampling=1.2))
    with pytest.raises(ValueError, match=r"must be \(y, x, 3\)"):
        cuda.form(tables, np.zeros((4, 4)))
    with pytest.raises(ValueError, match="does not weigh"):
        cuda.form(tables, np.zeros((4, 4, 3)), beams=Beams())
    assert cuda.form(tables, np.zeros((0, 4, 3))).shape == (0, 4)


def test_pulses_that_are_weighed_are_left_to_other_engines(monkeypatch):
    """Under auto nobody notices; who asks for it is told."""
    monkeypatch.setattr(cuda, "available", lambda: True)
    seen = {"beams": Beams(beam_of(), beam_of())}
    assert plan(**seen).engine != "cuda"
    for requested in ({"engine": "cuda"}, {"engine_options": {"cuda": {"oversampling": 8}}}):
        with pytest.raises(CampaignError, match="cannot form this image, whose pulses are weighed by antennas") as told:
            plan(overrides=requested, **seen)
        assert "numba" in told.value.expected
        assert "cuda" not in told.value.expected


def test_an_engine_that_nobody_has_timed_is_taken_by_name_alone(monkeypatch):
    """However large the image and however few the seconds predicted; not as a fallback either."""
    monkeypatch.setattr(cuda, "available", lambda: True)
    large = plan(shape=(20000, 20000))
    assert "cuda" not in {large.engine, *(setting.engine for setting in large.fallbacks)}
    for requested in ({"engine": "cuda"}, {"engine_options": {"cuda": {"oversampling": 8}}}):
        named = plan(shape=(20000, 20000), overrides=requested)
        assert named.engine == "cuda"
        assert any("seconds are not measured" in decision.reason for decision in named.decisions)
    monkeypatch.setattr(cuda, "TIMED", True)
    assert plan(shape=(20000, 20000)).engine == "cuda"
    assert plan().engine != "cuda"  # its first kernel takes longer to start than a small image on a processor


def test_the_simulator_is_said_to_be_slower_than_the_double_sum_and_is_no_fallback(monkeypatch):
    """Nor where it alone would come near an accuracy: what costs more than the double sum is worth nothing."""
    monkeypatch.setenv("NUMBA_ENABLE_CUDASIM", "1")
    without_library(monkeypatch)
    monkeypatch.setattr(cuda, "available", lambda: True)
    job = planning_job()
    (double_sum,) = load_engine("reference").candidates(job, pulses=300, requested={})
    settings = list(candidates(job, pulses=300, requested={}))
    assert min(setting.seconds for setting in settings) > 10 * double_sum.seconds
    assert min(setting.error_db for setting in settings) < -100
    last = SettingSearch(job).fallbacks(Setting("numba", {}, {}, -94.0, 1.0))
    assert [setting.engine for setting in last] == ["reference"]


@pytest.mark.skipif(cuda.available(), reason="there is a device")
def test_without_a_device_the_engine_is_refused_with_one_message(plain):
    pixels, profiles = plain
    with pytest.raises(CampaignError, match="engine cuda cannot run here") as told:
        plan(overrides={"engine": "cuda"})
    assert "NVIDIA" in told.value.remedy
    assert "cuda" not in told.value.expected
    with pytest.raises(CampaignError, match="no device can be used"):
        cuda.form(cuda.prepare(profiles), ecef(pixels))
    assert cuda.instruction_set() == "cuda: no device"
    assert plan().engine != "cuda"


def test_looking_for_a_device_imports_nothing_where_there_is_no_driver():
    program = (
        "import sys; from apertura.core.backprojection.engines import load_engine\nload_engine('cuda').available()"
    )
    program += "\nimport ctypes\ntry: ctypes.CDLL('libcuda.so.1')\nexcept OSError: assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)
