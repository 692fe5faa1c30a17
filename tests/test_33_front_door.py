"""The front door from Python: lazy, planned, certified, and the same bits on every scheduler."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from campaigns import draw

import apertura as ap
from apertura.constants import SPEED_OF_LIGHT_M_S as C
from apertura.errors import CampaignError
from apertura.focus.engines import ENGINES, numba, reference
from apertura.focus.engines.engine import Setting
from apertura.focus.tiles import image_array
from apertura.quality.measures import numerical_error

TARGET = np.array([[1.25, -0.75, 0.0]])


def recorded(pulses: int = 96) -> ap.PhaseHistory:
    """One point target seen from a straight track 20 m south of the scene."""
    frequency = 1.2e9 + 2e6 * np.arange(200)
    along = np.linspace(-4, 4, pulses)
    track = np.stack([along, np.full(pulses, -20.0), np.full(pulses, 10.0)], -1)
    flown = ap.Aperture(track, track + [0.5, 0.0, 0.0])
    echo = np.exp(-2j * np.pi * frequency * flown.path(TARGET) / C).astype(np.complex64)
    return ap.PhaseHistory(echo, frequency, np.full(200, 1 / 200), np.zeros(pulses), flown)


def grid() -> ap.SceneGrid:
    return ap.SceneGrid("local", -4.0, 4.0, 0.05, (160, 160))


@pytest.fixture(scope="module")
def image() -> xr.DataArray:
    return ap.backproject(recorded(), grid(), tile_px=64)


def test_an_image_is_lazy_and_its_chunks_are_the_tiles(image):
    assert image.chunks == ((64, 64, 32), (64, 64, 32))
    assert image.dtype == np.complex64
    assert image.attrs["units"] == "1"
    assert set(image.attrs["models"]) >= {"engine", "presum", "terrain"}
    assert image.spatial_ref.attrs["crs_wkt"].startswith("LOCAL_CS")


def test_a_target_focuses_where_it_is_with_the_amplitude_of_its_echo(image):
    level = abs(image).compute()
    peak = level[level.argmax(...)]
    assert float(peak) == pytest.approx(1.0, abs=0.05)
    assert (float(peak.x), float(peak.y)) == (pytest.approx(1.25, abs=0.05), pytest.approx(-0.75, abs=0.05))


def test_the_certificate_is_what_a_comparison_with_the_double_sum_measures():
    """On speckle, where no pixel holds most of the power."""
    drawn = draw(np.random.default_rng(4), pixels=80, pulses=60)
    noise = np.random.default_rng(6).standard_normal((2, *drawn.history.transfer.shape))
    history = replace(drawn.history, transfer=(noise[0] + 1j * noise[1]).astype(np.complex64))
    image = ap.backproject(history, drawn.grid, certified_pixels=256)
    pixels = np.random.default_rng(5).integers(0, drawn.grid.shape, (400, 2)).T
    exact = reference.form(history, drawn.grid.positions_at(*pixels, 0.0)) / len(history)
    measured = numerical_error(image.values[tuple(pixels)], exact)
    assert image.attrs["numerical_error_db"] == pytest.approx(measured.rms_db, abs=1.0)
    assert measured.rms_db < -60


def test_profiles_alone_give_the_same_image_and_a_certificate_of_their_own(image):
    """Their error counts against band-limited interpolation; what range compression errs by is -130 dB."""
    profiles = ap.range_compress(recorded(), grid(), ap.FlatGround(0.0))
    alone = ap.backproject(profiles, grid(), tile_px=64)
    assert alone.attrs["numerical_error_db"] < -60
    difference = np.abs(alone.values - image.values).max() / np.abs(image.values).max()
    assert 20 * np.log10(difference + 1e-12) < -60
    with pytest.raises(CampaignError, match="reference"):
        ap.backproject(profiles, grid(), engine="reference")


def test_a_stage_of_a_campaign_gives_the_image_of_its_workflow(finished_tiny):
    campaign = ap.open_campaign(finished_tiny.root)
    flight, pairs = next(iter(campaign.pairs.items()))
    scene, echo = campaign.scene, campaign.stage("echo", flight, pairs[0])
    front = ap.backproject(echo, scene.grid, terrain=scene.terrain, certified_pixels=0)
    np.testing.assert_array_equal(front.values, campaign.image(flight, pairs[0]).values)
    assert campaign.report(flight, pairs[0])["flags"] == campaign.flags(flight, pairs[0])


def test_threads_processes_and_one_thread_give_the_same_bits(image):
    alone = image.compute(scheduler="synchronous").values
    np.testing.assert_array_equal(image.compute(scheduler="threads").values, alone)
    np.testing.assert_array_equal(image.compute(scheduler="processes", num_workers=2).values, alone)


def test_a_local_cluster_of_two_processes_gives_the_same_bits(image):
    distributed = pytest.importorskip("distributed")
    alone = image.compute(scheduler="synchronous").values
    with (
        distributed.LocalCluster(2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        distributed.Client(cluster),
    ):
        np.testing.assert_array_equal(image.compute().values, alone)


def test_one_tile_alone_is_that_of_the_whole_image(image):
    np.testing.assert_array_equal(image[64:128, 128:160].compute().values, image.values[64:128, 128:160])


def test_blocks_of_pulses_are_prepared_one_after_the_other(monkeypatch):
    """The next block's tables wait for every tile of the block before: one block's tables are held at a time."""
    drawn, events = draw(np.random.default_rng(2), pixels=40, pulses=64), []
    prepare, form = numba.prepare, numba.form
    monkeypatch.setattr(numba, "prepare", lambda *given, **how: (events.append("tables"), prepare(*given, **how))[1])
    monkeypatch.setattr(numba, "form", lambda *given, **how: (events.append("tile"), form(*given, **how))[1])
    setting = Setting("numba", {}, {}, -60.0, 1.0, pulse_blocks=3)
    image_array(drawn.profiles, setting, drawn.grid, ap.FlatGround(0.0), side_px=32).compute(scheduler="threads")
    tiles = len(list(drawn.grid.tiles(32)))
    assert events == (["tables"] + ["tile"] * tiles) * 3


@pytest.fixture
def toy(monkeypatch):
    monkeypatch.setitem(ENGINES, "toy", "toy_engine")


def test_a_toy_engine_is_planned_where_it_is_exact_enough(toy):
    rough = ap.backproject(recorded(), grid(), accuracy_db=-20.0)
    assert rough.attrs["setting"].startswith("toy refine=")
    assert rough.attrs["numerical_error_db"] < -20
    assert not ap.backproject(recorded(), grid(), accuracy_db=-60.0).attrs["setting"].startswith("toy")
    asked = ap.backproject(recorded(), grid(), accuracy_db=-20.0, engine_options={"toy": {"refine": 2}})
    assert asked.attrs["models"]["refine"] == "2: asked for in the config; nearest sample of a refined profile"


def test_an_antenna_in_the_ground_is_refused():
    with pytest.raises(CampaignError, match="in or below the ground of the scene"):
        ap.backproject(recorded(), grid(), terrain=ap.FlatGround(1e4))
