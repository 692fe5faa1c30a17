"""The front door from Python: lazy, planned, certified, and the same bits on every scheduler."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from campaigns import draw
from scenes import TARGET_GRID, point_history

import apertura as ap
from apertura.errors import CampaignError
from apertura.focus.engines import reference
from apertura.quality.measures import numerical_error


@pytest.fixture(scope="module")
def image() -> xr.DataArray:
    return ap.backproject(point_history(), TARGET_GRID, tile_px=64)


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
    profiles = ap.range_compress(point_history(), TARGET_GRID, ap.FlatGround(0.0))
    alone = ap.backproject(profiles, TARGET_GRID, tile_px=64)
    assert alone.attrs["numerical_error_db"] < -60
    difference = np.abs(alone.values - image.values).max() / np.abs(image.values).max()
    assert 20 * np.log10(difference + 1e-12) < -60
    with pytest.raises(CampaignError, match="reference"):
        ap.backproject(profiles, TARGET_GRID, engine="reference")


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


def test_a_toy_engine_is_planned_where_it_is_exact_enough(toy):
    rough = ap.backproject(point_history(), TARGET_GRID, accuracy_db=-20.0)
    assert rough.attrs["setting"].startswith("toy refine=")
    assert rough.attrs["numerical_error_db"] < -20
    assert not ap.backproject(point_history(), TARGET_GRID, accuracy_db=-60.0).attrs["setting"].startswith("toy")
    asked = ap.backproject(point_history(), TARGET_GRID, accuracy_db=-20.0, engine_options={"toy": {"refine": 2}})
    assert asked.attrs["models"]["refine"] == "2: asked for in the config; nearest sample of a refined profile"


def test_an_antenna_in_the_ground_is_refused():
    with pytest.raises(CampaignError, match="in or below the ground of the scene"):
        ap.backproject(point_history(), TARGET_GRID, terrain=ap.FlatGround(1e4))
