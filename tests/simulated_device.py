"""The GPU engine in numba's simulator against the double sum: run by a test in a separate process.

The simulator must be requested before numba is imported, and would affect other tests. To run it manually:
NUMBA_ENABLE_CUDASIM=1 python -m pytest -n0 tests/simulated_device.py
"""

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scenes import (
    BANDWIDTH_HZ,
    SUBCARRIERS,
    C,
    compiled,
    decibels,
    ecef,
    error_db,
    fly,
    hard_beam,
    pixel_grid,
    plan,
    scatter,
    swaying_beam,
)

import apertura as ap
from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.engines import cuda, native, reference
from apertura.core.backprojection.engines.cuda_prediction import candidates, simulated
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.backprojection.job import Job, Signal
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.sector import Sector
from apertura.core.scene.grid import SceneGrid

PULSES = 12


@pytest.fixture(scope="module")
def plain():
    pixels = pixel_grid(16, 18)
    scene = fly(scatter(pixels), pulses=PULSES)
    return scene, pixels, scene.profiles(ecef(pixels))


@pytest.fixture(scope="module")
def tables(plain):
    """Tables on the device, shared by all tests, because the simulator computes them more slowly than an image."""
    return cuda.prepare(plain[2])


def predicted_db(scene, pixels, profiles, beams=None, **requested):
    """Return the error that the engine predicts for a setting."""
    signal = Signal(scene.carrier_hz, 2.0, profiles.step_m, profiles.samples.shape[1])
    spacing = float(np.linalg.norm((pixels[0, 1] - pixels[0, 0])[:2]))
    job = Job(
        profiles.aperture, ecef(pixels), pixels.shape[:2], spacing, scene.carrier_hz, BANDWIDTH_HZ, SUBCARRIERS, signal
    )
    job = replace(job, beams=beams)
    (setting,) = candidates(job, pulses=len(profiles), requested=requested)
    return setting.error_db


@pytest.mark.parametrize(("bistatic", "rough_m"), [(True, 0.3), (False, 0.0)])
def test_error_stays_within_prediction(bistatic, rough_m):
    """The prediction holds for any surface; pixels need not lie near a plane."""
    pixels = pixel_grid(16, 18)
    pixels[..., 2] = rough_m * np.random.default_rng(6).standard_normal((16, 18))
    scene = fly(scatter(pixels), pulses=PULSES, bistatic=bistatic)
    profiles = scene.profiles(ecef(pixels))
    image = cuda.form(cuda.prepare(profiles, oversampling=6), ecef(pixels), tolerance_rad=1.5e-3)
    predicted_error_db = predicted_db(scene, pixels, profiles, oversampling=6, tolerance_rad=1.5e-3)
    assert -80 < predicted_error_db < -70
    assert error_db(scene, pixels, image) <= predicted_error_db + 3


@pytest.mark.parametrize(("range_m", "tolerance_rad"), [(4.0, 1.5e-3), (4.0, 1e-9), (0.6, 1.5e-3)])
def test_near_ranges_and_small_tolerances_use_exact_paths(range_m, tolerance_rad):
    """At 4 m, paths are computed by the series or in float64 only; at 0.6 m, the series does not converge."""
    pixels = pixel_grid(16, 16, range_m=range_m)
    scene = fly(scatter(pixels), range_m=range_m, pulses=6)
    profiles = scene.profiles(ecef(pixels))
    image = cuda.form(cuda.prepare(profiles, oversampling=8), ecef(pixels), tolerance_rad=tolerance_rad)
    predicted_error_db = predicted_db(scene, pixels, profiles, oversampling=8, tolerance_rad=tolerance_rad)
    assert error_db(scene, pixels, image) <= predicted_error_db + 3


def test_many_carrier_cycles_per_resolution_cell_keep_the_error():
    pixels = pixel_grid(16, 16, spacing_m=C / 10e9 / 4)
    scene = fly(scatter(pixels), carrier_hz=10e9, pulses=8)
    profiles = scene.profiles(ecef(pixels))
    image = cuda.form(cuda.prepare(profiles, oversampling=6), ecef(pixels))
    assert error_db(scene, pixels, image) <= predicted_db(scene, pixels, profiles, oversampling=6, tolerance_rad=1.5e-3)


def test_tiles_and_threads_are_bitwise_equal(plain, tables):
    """Two threads on one device, each with a tile that starts at a multiple of 16 pixels."""
    places = ecef(plain[1])
    whole = cuda.form(tables, places)
    with ThreadPoolExecutor(2) as pool:
        left, right = pool.map(lambda part: cuda.form(tables, places[:, part]), (slice(0, 16), slice(16, None)))
    np.testing.assert_array_equal(np.hstack([left, right]).view(np.uint32), whole.view(np.uint32))


def test_slices_and_copies_of_tables_sum_their_pulses(plain, tables):
    """A slice shares the arrays on the device; a copy in another process creates new arrays."""
    places = ecef(plain[1])[:, :16]
    whole = cuda.form(tables, places)
    parts = [tables[0:10], tables[2:][8:]]
    assert {part.resident for part in parts} == {tables.resident}
    assert decibels(sum(cuda.form(part, places) for part in parts) - whole, whole) <= -110
    copy = pickle.loads(pickle.dumps(tables[0:10]))
    assert copy.resident.tables is None
    np.testing.assert_array_equal(cuda.form(copy, places), cuda.form(parts[0], places))


def test_more_pulses_than_a_chunk_are_all_summed():
    pixels = pixel_grid(4, 4)
    scene = fly(scatter(pixels), pulses=70)
    profiles = scene.profiles(ecef(pixels))
    tables = cuda.prepare(profiles, oversampling=4)
    for tolerance_rad in (1.5e-3, 1e-12):  # by the series, and by exact paths
        image = cuda.form(tables, ecef(pixels), tolerance_rad=tolerance_rad)
        predicted_error_db = predicted_db(scene, pixels, profiles, oversampling=4, tolerance_rad=tolerance_rad)
        assert error_db(scene, pixels, image) <= predicted_error_db


@pytest.mark.parametrize("nowhere", [np.nan, -np.inf])
def test_pixel_without_position_is_nan_and_affects_no_other(plain, tables, nowhere):
    scene, pixels, _ = plain
    pixels = pixels[:, :16]
    places = ecef(pixels)
    places[3, 5, 1] = nowhere
    image = cuda.form(tables, places)
    assert np.argwhere(np.isnan(image)).tolist() == [[3, 5]]
    image[3, 5] = scene.exact(ecef(pixels)[3, 5][None])[0]
    assert error_db(scene, pixels, image) <= -70


def test_pixels_beyond_the_profiles_are_zero_and_others_unchanged(plain, tables):
    """Pixels beyond all profiles, and pixels behind the end of truncated profiles inside a patch."""
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


# ---- Weights of pulses


def weights_of(scene, places, kind):
    """Return weights: a sector with pulses inside, outside and at its edge; beams; both; or one beam."""
    flown = Aperture(scene.tx, scene.rx)
    sector = Sector.of(flown, chord_m=1.2, centre=0.02, half=0.12)
    ahead = Sector.of(flown, chord_m=1.2, centre=0.6, half=0.15).following(flown, places[::8, ::8].reshape(-1, 3))
    other = swaying_beam(scene.rx, (11.5, 0.4, 0), 30)
    other = replace(other, azimuth_rad=other.azimuth_rad[::2], azimuth_gain=other.azimuth_gain[::2] ** 2)
    beams = swaying_beam(scene.tx, (12, 0, 0), 25), other
    return {
        "sector": Beams(sector=sector),
        "centre that follows": Beams(sector=ahead),
        "beams": Beams(*beams),
        "transmit": Beams(beams[0]),
        "receive": Beams(None, beams[1]),
        "both": Beams(*beams, sector),
        "all": Beams(*beams, ahead),
    }[kind]


@pytest.mark.parametrize(
    ("kind", "bistatic", "rough_m", "tolerance_rad"),
    [
        ("sector", True, 0.0, 1.5e-3),
        ("sector", False, 0.3, 1.5e-3),
        ("sector", True, 0.3, 1e-9),
        ("centre that follows", True, 0.3, 1.5e-3),
        ("centre that follows", False, 0.0, 1e-9),
        ("beams", False, 0.0, 1.5e-3),
        ("beams", True, 0.3, 1e-9),
        ("transmit", True, 0.0, 1.5e-3),
        ("receive", True, 0.0, 1e-9),
        ("both", True, 0.3, 1.5e-3),
        ("all", True, 0.0, 1e-9),
    ],
)
def test_weighted_pulses_match_the_double_sum(kind, bistatic, rough_m, tolerance_rad):
    """Paths by series with weights in float32, and exact paths with weights in float64, on any surface."""
    pixels = pixel_grid(16, 18)
    pixels[..., 2] = rough_m * np.random.default_rng(6).standard_normal((16, 18))
    places = ecef(pixels)
    scene = fly(scatter(pixels), pulses=PULSES, bistatic=bistatic)
    profiles, beams = scene.profiles(places), weights_of(scene, places, kind)
    weight = beams.weight(profiles.aperture, places.reshape(-1, 3))
    assert np.any((weight > 0) & (weight < 1))
    if beams.antennas is None:
        assert {0.0, 1.0} <= set(weight.ravel())
    if kind in {"centre that follows", "all"}:
        assert np.ptp(beams.sector.centre_at(places)) > 0.01
    counts = np.zeros(len(cuda.VARIANTS), np.int64)
    tables = cuda.prepare(profiles, oversampling=6)
    image = cuda.form(tables, places, beams=beams, tolerance_rad=tolerance_rad, counts=counts)
    truth = reference.form(scene.history(), places, beams=beams)
    predicted_error_db = predicted_db(scene, pixels, profiles, beams, oversampling=6, tolerance_rad=tolerance_rad)
    assert -80 < predicted_error_db < -70
    assert decibels(image - truth, truth) <= predicted_error_db + 3
    assert decibels(reference.form(scene.history(), places) - truth, truth) > -20  # the weights have an effect
    summed = counts[0] if tolerance_rad > 1e-6 else counts[1]
    assert counts.sum() == weight.size
    assert (weight != 0).sum() <= summed == counts[:2].sum()


def test_sector_finer_than_float32_is_weighted_exactly():
    """An edge 4e-5 wide across a patch at 28 km: s is computed relative to its value at the patch origin."""
    pixels = pixel_grid(16, 16, range_m=20e3)
    scene = fly(scatter(pixels), range_m=20e3, pulses=8)
    places, profiles = ecef(pixels), scene.profiles(ecef(pixels))
    sector = Sector.of(profiles.aperture, chord_m=2e3, centre=0.0, half=2e-4)
    at_patch = float(sector.place(profiles.aperture, places[8, 8][None])[2, 0])
    beams = Beams(sector=replace(sector, centre=at_patch + sector.half))
    weight = beams.weight(profiles.aperture, places.reshape(-1, 3))
    assert np.all((weight[2] > 0.05) & (weight[2] < 0.95))
    assert np.all(np.delete(weight, 2, axis=0) == 0)
    image = cuda.form(cuda.prepare(profiles, oversampling=16), places, beams=beams)
    truth = reference.form(scene.history(), places, beams=beams)
    assert decibels(image - truth, truth) <= -80


def test_pattern_phase_is_not_compensated(plain, tables):
    scene, pixels, _ = plain
    places = ecef(pixels)[:, :16]
    soft = swaying_beam(scene.tx, (12, 0, 0))
    with_pattern_phase = replace(
        soft, azimuth_phase_rad=np.linspace(0, 3, 701), elevation_phase_rad=np.linspace(1, 0, 401)
    )
    with_phase, without = (cuda.form(tables, places, beams=Beams(beam)) for beam in (with_pattern_phase, soft))
    np.testing.assert_array_equal(with_phase.view(np.uint32), without.view(np.uint32))


def test_weighted_tiles_and_unit_weights_are_bitwise_equal(plain, tables):
    scene, pixels, _ = plain
    places = ecef(pixels)
    beams = weights_of(scene, places, "all")
    whole, part = (cuda.form(tables, points, beams=beams) for points in (places, places[:, 16:]))
    np.testing.assert_array_equal(part.view(np.uint32), whole[:, 16:].view(np.uint32))
    everywhere = Sector.of(Aperture(scene.tx, scene.rx), chord_m=1.2, centre=0.0, half=3.0)
    inside, plainly = (cuda.form(tables, places[:, 16:], beams=beams) for beams in (Beams(sector=everywhere), None))
    np.testing.assert_array_equal(inside.view(np.uint32), plainly.view(np.uint32))


@pytest.fixture(scope="module")
def long():
    """More than two chunks of 64 pulses; an image of few pixels."""
    pixels = pixel_grid(3, 4)
    scene = fly(scatter(pixels), pulses=130)
    return scene, ecef(pixels), cuda.prepare(scene.profiles(ecef(pixels)), oversampling=4)


def steady(scene, turn_deg, width_deg=8.0):
    """Return a beam that follows the scene at an offset angle."""
    beam = swaying_beam(scene.tx, (12, 0, 0), width_deg, sway_deg=0)
    offset_rad, zero = np.radians(turn_deg), np.zeros(len(scene.tx))
    rows = [
        [np.cos(offset_rad), np.sin(offset_rad), zero],
        [-np.sin(offset_rad), np.cos(offset_rad), zero],
        [zero, zero, zero + 1],
    ]
    return Beams(replace(beam, axes=np.moveaxis(np.array(rows), -1, 0) @ beam.axes))


def veering(sector, flown, place):
    """Return the same sector for a flight that heads for the scene for some pulses at the end of each group of 64."""
    axes = []
    for leg, axis in zip(flown.legs, (sector.tx_axis, sector.rx_axis), strict=True):
        toward = (place - leg) / np.linalg.norm(place - leg, axis=1, keepdims=True)
        axes.append(np.where(np.arange(len(leg))[:, None] % 64 > 60, 0.35 * toward, axis))
    return Beams(sector=replace(sector, tx_axis=axes[0], rx_axis=axes[1], centre=0.7))


def ending_near(sector, scene, place):
    """Return the same sector, centred on a near pulse, whose s changes more over a patch than s of other pulses."""
    near_position = ecef(np.array([12.0, 0.0, 2.0]))[None]
    along = (ecef(np.array([0.7, 0.7, 0.0])) - ecef(np.zeros(3)))[None] / 2
    end = Sector(along, along, 0.0, sector.half)
    at = float(end.place(Aperture(near_position, near_position), place[None])[0, 0])
    return Beams(sector=replace(sector, centre=at, ends=(Aperture(near_position, near_position), end)))


@pytest.mark.parametrize(
    "kind",
    [
        "end of a sector",
        "middle of a sector",
        "a flight that veers",
        "a centre that moves",
        "a beam that leaves",
        "a beam that looks in",
    ],
)
def test_excluded_pulses_change_no_bit(long, kind):
    """Whole chunks and single pulses are excluded, also the middle pulses of chunks whose ends contribute."""
    scene, places, tables = long
    flown = Aperture(scene.tx, scene.rx)
    sector = Sector.of(flown, chord_m=1.2, centre=0.0, half=0.03)
    at = sector.place(flown, places[1, 2][None])[:, 0]
    beams = {
        "end of a sector": Beams(sector=replace(sector, centre=float(at[4]))),
        "middle of a sector": Beams(sector=replace(sector, centre=float(at[70]))),
        "a flight that veers": veering(sector, flown, places[1, 2]),
        "a centre that moves": ending_near(sector, scene, places[1, 2]),
        "a beam that leaves": steady(scene, np.where(np.arange(130) < 64, 0.3 * np.arange(130), 100.0)),
        "a beam that looks in": steady(scene, np.where(np.arange(130) % 64 > 60, 0.0, 40.0)),
    }[kind]
    weight = beams.weight(flown, places.reshape(-1, 3)).any(axis=1)
    counts = np.zeros((2, 4), np.int64)
    image = cuda.form(tables, places, beams=beams, counts=counts[0])
    every = cuda.sum_on_device(tables, places, beams, 1.5e-3, counts[1], rejecting=False)
    np.testing.assert_array_equal(image.view(np.uint32), every.view(np.uint32))
    assert counts[1].tolist() == [12 * 130, 0, 0, 0]
    chunks = np.add.reduceat(weight, [0, 64, 128]) > 0
    unseen = 12 * np.array([64, 64, 2])[~chunks].sum()
    assert counts[0, 3] == unseen  # a whole chunk costs one check
    assert 12 * weight.sum() <= counts[0, 0] <= 12 * (weight.sum() + 4)
    parts = [cuda.form(tables[chunk], places, beams=beams[chunk]) for chunk in (slice(0, 64), slice(64, 130))]
    assert decibels(sum(parts) - image, image) <= -110


def test_more_chunks_than_threads_are_checked_in_groups(long):
    """128 pulses repeated 33 times: 66 chunks, and ten pulses of the last one illuminate the scene."""
    from numba import cuda as numba_cuda

    scene, places, tables = long
    cuda.form(tables, places)
    repeated, pulses = cuda.Resident(), 33 * 128
    repeated.tables = tuple(
        numba_cuda.to_device(np.concatenate([array.copy_to_host()[:128]] * 33)) for array in tables.resident.tables
    )
    many, turn = replace(tables, pulses=slice(0, pulses), resident=repeated), np.full(pulses, 100.0)
    turn[-20:-10] = 0.0
    beams, counts = steady(replace(scene, tx=np.tile(scene.tx[:128], (33, 1))), turn), np.zeros(4, np.int64)
    image = cuda.form(many, places, beams=beams, counts=counts)
    assert counts.tolist() == [12 * 10, 0, 12 * 54, 12 * (pulses - 64)]
    last = slice(pulses - 64, pulses)
    last_chunk = cuda.form(many[last], places, beams=beams[last])
    np.testing.assert_array_equal(image.view(np.uint32), last_chunk.view(np.uint32))
    assert np.all(image != 0)


@compiled
def test_unilluminated_pixels_match_the_compiled_engine(plain, tables):
    """Pixels that no pulse illuminates are zero; the steps write these as no data."""
    scene, pixels, profiles = plain
    places, flown = ecef(pixels), Aperture(scene.tx, scene.rx)
    beams = Beams(None, hard_beam(swaying_beam(scene.rx, (11.8, 0, 0), sway_deg=1), 0.8))
    lit = beams.weight(flown, places.reshape(-1, 3)).any(axis=0).reshape(16, 18)
    assert 0.1 < lit.mean() < 0.9
    image, compiled_image = (
        cuda.form(tables, places, beams=beams),
        native.form(native.prepare(profiles), places, beams=beams),
    )
    np.testing.assert_array_equal(image != 0, compiled_image != 0)
    np.testing.assert_array_equal(image != 0, lit)
    truth = reference.form(scene.history(), places, beams=beams)
    assert decibels(image - truth, truth) <= -70  # up to the edge of the beam


def test_pixel_without_position_affects_no_weight(plain, tables):
    scene, pixels, _ = plain
    places = ecef(pixels)[:, :16]
    beams = weights_of(scene, places, "all")
    whole = cuda.form(tables, places, beams=beams)
    places[3, 5] = np.nan
    image = cuda.form(tables, places, beams=beams)
    assert np.argwhere(np.isnan(image)).tolist() == [[3, 5]]
    image[3, 5] = whole[3, 5]
    assert decibels(image - whole, whole) <= -100


# ---- The engine


@pytest.mark.parametrize("weights", [{}, {"integration": {"degrees": 20.0}}])
def test_device_image_is_certified(weights):
    frequency = 1.2e9 + 4e6 * np.arange(64)
    along = np.linspace(-4, 4, 12)
    track = np.stack([along, np.full(12, -10.0), np.full(12, 5.0)], -1)
    flown = Aperture(track, track + [1.0, 0.5, 0.0])
    echo = np.exp(-2j * np.pi * frequency * flown.path(np.array([[0.05, -0.05, 0.0]])) / C).astype(np.complex64)
    history = PhaseHistory(echo, frequency, np.full(64, 1 / 64), np.zeros(12), flown)
    image, exact = (
        ap.backproject(
            history,
            SceneGrid("local", -0.8, 0.8, 0.1, (16, 16)),
            accuracy_db=-50,
            engine=engine,
            engine_options={"cuda": {"oversampling": 4}},
            certified_pixels=4,
            **weights,
        ).compute()
        for engine in ("cuda", "reference")
    )
    assert image.attrs["setting"].startswith("cuda ")
    assert image.attrs["numerical_error_db"] <= -50
    assert decibels(image - exact, exact) <= -50
    assert np.abs(image).max().item() == pytest.approx(1.0, abs=0.05) or weights


def test_simulator_is_used_only_on_request():
    assert cuda.available()
    assert plan(overrides={"engine": "cuda"}).engine == "cuda"
    for accuracy_db in (-30.0, -60.0, -100.0, -125.0):
        chosen = plan(accuracy_db)
        assert "cuda" not in {chosen.engine, *(setting.engine for setting in chosen.fallbacks)}


def test_device_error_is_one_message(plain, monkeypatch):
    """The device has no memory or fails: numba.cuda raises its own error, as with real drivers."""
    from numba import cuda as numba_cuda
    from numba.cuda.cudadrv.driver import CudaAPIError

    def full(*_args, **_more):
        message = "Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY"
        raise CudaAPIError(f"[2] {message}") if simulated() else CudaAPIError(2, message)

    _, pixels, profiles = plain
    monkeypatch.setattr(numba_cuda, "device_array", full)
    with pytest.raises(CampaignError, match=r"the device failed: \[2\] .*OUT_OF_MEMORY; expected an NVIDIA GPU"):
        cuda.form(cuda.prepare(profiles), ecef(pixels))
