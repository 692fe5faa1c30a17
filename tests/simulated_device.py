"""The GPU engine in numba's simulator against the double sum: run by a test in a process of its own.

The simulator must be asked for before numba is imported, and would be in the way of other tests. By hand:
NUMBA_ENABLE_CUDASIM=1 python -m pytest -n0 tests/simulated_device.py
"""

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scenes import BANDWIDTH_HZ, SUBCARRIERS, C, decibels, ecef, error_db, fly, pixel_grid, plan, scatter

import apertura as ap
from apertura.common.errors import CampaignError
from apertura.core.backprojection.engines import cuda
from apertura.core.backprojection.engines.cuda_prediction import candidates
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.backprojection.job import Job, Signal
from apertura.core.geometry.aperture import Aperture
from apertura.core.scene.grid import SceneGrid

PULSES = 12


@pytest.fixture(scope="module")
def plain():
    pixels = pixel_grid(16, 18)
    scene = fly(scatter(pixels), pulses=PULSES)
    return scene, pixels, scene.profiles(ecef(pixels))


@pytest.fixture(scope="module")
def tables(plain):
    """On the device once for all tests: the simulator takes longer for them than for an image."""
    return cuda.prepare(plain[2])


def predicted_db(scene, pixels, profiles, **requested):
    """What the engine's own prediction says of a setting."""
    signal = Signal(scene.carrier_hz, 2.0, profiles.step_m, profiles.samples.shape[1])
    spacing = float(np.linalg.norm((pixels[0, 1] - pixels[0, 0])[:2]))
    job = Job(
        profiles.aperture, ecef(pixels), pixels.shape[:2], spacing, scene.carrier_hz, BANDWIDTH_HZ, SUBCARRIERS, signal
    )
    (setting,) = candidates(job, pulses=len(profiles), requested=requested)
    return setting.error_db


@pytest.mark.parametrize(("bistatic", "rough_m"), [(True, 0.3), (False, 0.0)])
def test_the_predicted_error_is_kept(bistatic, rough_m):
    """Any surface: pixels need not lie on a plane, nor near one."""
    pixels = pixel_grid(16, 18)
    pixels[..., 2] = rough_m * np.random.default_rng(6).standard_normal((16, 18))
    scene = fly(scatter(pixels), pulses=PULSES, bistatic=bistatic)
    profiles = scene.profiles(ecef(pixels))
    image = cuda.form(cuda.prepare(profiles, oversampling=6), ecef(pixels), tolerance_rad=1.5e-3)
    said = predicted_db(scene, pixels, profiles, oversampling=6, tolerance_rad=1.5e-3)
    assert -80 < said < -70
    assert error_db(scene, pixels, image) <= said + 3


@pytest.mark.parametrize(("range_m", "tolerance_rad"), [(4.0, 1.5e-3), (4.0, 1e-9), (0.6, 1.5e-3)])
def test_near_ranges_and_small_tolerances_take_exact_paths_and_the_same_error(range_m, tolerance_rad):
    """At 4 m by the series or in float64 alone; at 0.6 m the series would not converge."""
    pixels = pixel_grid(16, 16, range_m=range_m)
    scene = fly(scatter(pixels), range_m=range_m, pulses=6)
    profiles = scene.profiles(ecef(pixels))
    image = cuda.form(cuda.prepare(profiles, oversampling=8), ecef(pixels), tolerance_rad=tolerance_rad)
    said = predicted_db(scene, pixels, profiles, oversampling=8, tolerance_rad=tolerance_rad)
    assert error_db(scene, pixels, image) <= said + 3


def test_carriers_that_turn_often_within_a_cell_are_held():
    pixels = pixel_grid(16, 16, spacing_m=C / 10e9 / 4)
    scene = fly(scatter(pixels), carrier_hz=10e9, pulses=8)
    profiles = scene.profiles(ecef(pixels))
    image = cuda.form(cuda.prepare(profiles, oversampling=6), ecef(pixels))
    assert error_db(scene, pixels, image) <= predicted_db(scene, pixels, profiles, oversampling=6, tolerance_rad=1.5e-3)


def test_tiles_and_threads_give_the_same_bits(plain, tables):
    """Two threads at one device, each with a tile that begins at a multiple of 16 pixels."""
    places = ecef(plain[1])
    whole = cuda.form(tables, places)
    with ThreadPoolExecutor(2) as pool:
        left, right = pool.map(lambda part: cuda.form(tables, places[:, part]), (slice(0, 16), slice(16, None)))
    np.testing.assert_array_equal(np.hstack([left, right]).view(np.uint32), whole.view(np.uint32))


def test_slices_and_copies_of_tables_are_those_of_their_pulses(plain, tables):
    """A slice shares what is on the device; a copy that went to another process makes its own."""
    places = ecef(plain[1])[:, :16]
    whole = cuda.form(tables, places)
    parts = [tables[0:10], tables[2:][8:]]
    assert {part.resident for part in parts} == {tables.resident}
    assert decibels(sum(cuda.form(part, places) for part in parts) - whole, whole) <= -110
    copy = pickle.loads(pickle.dumps(tables[0:10]))
    assert copy.resident.arrays is None
    np.testing.assert_array_equal(cuda.form(copy, places), cuda.form(parts[0], places))


def test_more_pulses_than_are_looked_at_together_are_all_summed():
    pixels = pixel_grid(4, 4)
    scene = fly(scatter(pixels), pulses=70)
    profiles = scene.profiles(ecef(pixels))
    tables = cuda.prepare(profiles, oversampling=4)
    for tolerance_rad in (1.5e-3, 1e-12):  # by the series, and by exact paths
        image = cuda.form(tables, ecef(pixels), tolerance_rad=tolerance_rad)
        said = predicted_db(scene, pixels, profiles, oversampling=4, tolerance_rad=tolerance_rad)
        assert error_db(scene, pixels, image) <= said


@pytest.mark.parametrize("nowhere", [np.nan, -np.inf])
def test_a_pixel_without_a_position_is_nan_and_spoils_no_other(plain, tables, nowhere):
    scene, pixels, _ = plain
    pixels = pixels[:, :16]
    places = ecef(pixels)
    places[3, 5, 1] = nowhere
    image = cuda.form(tables, places)
    assert np.argwhere(np.isnan(image)).tolist() == [[3, 5]]
    image[3, 5] = scene.exact(ecef(pixels)[3, 5][None])[0]
    assert error_db(scene, pixels, image) <= -70


def test_pixels_beyond_the_profiles_are_zero_and_others_unharmed(plain, tables):
    """Beyond all profiles; and where profiles that are cut short end inside the patch."""
    scene, pixels, profiles = plain
    far = ecef(pixels)
    far[:, 16:] += 1000.0
    image = cuda.form(tables, far)
    assert np.all(image[:, 16:] == 0)
    np.testing.assert_array_equal(image[:, :16], cuda.form(tables, far[:, :16]))
    cut = replace(profiles, samples=profiles.samples[:, : profiles.samples.shape[1] // 2])
    end = cut.start_m + cut.step_m * (cut.samples.shape[1] - 1)
    reach = scene.path_m(ecef(pixels).reshape(-1, 3)).reshape(len(end), 16, 18)
    ended = (reach > end[:, None, None] + cut.step_m).all(axis=0)
    assert 0 < ended.sum() < ended.size
    image = cuda.form(cuda.prepare(cut, oversampling=2), ecef(pixels))
    assert np.all(image[ended] == 0)
    assert np.isfinite(image).all()
    assert np.all(image[(reach < end[:, None, None] - cut.step_m).all(axis=0)] != 0)


def test_an_image_by_the_device_is_certified_like_any_other():
    frequency = 1.2e9 + 4e6 * np.arange(64)
    along = np.linspace(-4, 4, 12)
    track = np.stack([along, np.full(12, -10.0), np.full(12, 5.0)], -1)
    flown = Aperture(track, track + [1.0, 0.5, 0.0])
    echo = np.exp(-2j * np.pi * frequency * flown.path(np.array([[0.05, -0.05, 0.0]])) / C).astype(np.complex64)
    history = PhaseHistory(echo, frequency, np.full(64, 1 / 64), np.zeros(12), flown)
    image = ap.backproject(
        history,
        SceneGrid("local", -0.8, 0.8, 0.1, (16, 16)),
        accuracy_db=-50,
        engine="cuda",
        engine_options={"cuda": {"oversampling": 4}},
        certified_pixels=4,
    ).compute()
    assert image.attrs["setting"].startswith("cuda ")
    assert image.attrs["numerical_error_db"] <= -50
    assert np.abs(image).max().item() == pytest.approx(1.0, abs=0.05)


def test_the_simulator_is_taken_where_it_is_asked_for_and_nowhere_else():
    assert cuda.available()
    assert plan(overrides={"engine": "cuda"}).engine == "cuda"
    for accuracy_db in (-30.0, -60.0, -100.0, -125.0):
        chosen = plan(accuracy_db)
        assert "cuda" not in {chosen.engine, *(setting.engine for setting in chosen.fallbacks)}


def test_what_the_device_refuses_is_one_message(plain, monkeypatch):
    """A device without room, or one that breaks off: numba.cuda's own error, as drivers raise it."""
    from numba import cuda as numba_cuda
    from numba.cuda.cudadrv.driver import CudaAPIError

    def full(*_args, **_more):
        raise CudaAPIError("[2] Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY")

    _, pixels, profiles = plain
    monkeypatch.setattr(numba_cuda, "device_array", full)
    with pytest.raises(CampaignError, match=r"the device failed: \[2\] .*OUT_OF_MEMORY; expected an NVIDIA GPU"):
        cuda.form(cuda.prepare(profiles), ecef(pixels))
