"""Python function `backproject`: images are lazy, planned and certified, and identical on every scheduler."""

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from campaigns import draw
from scenes import TARGET_GRID, compiled, point_history

import apertura as ap
from apertura.common.errors import CampaignError
from apertura.core.backprojection.engines import reference
from apertura.core.quality.measures import numerical_error_db
from apertura.core.scene.grid import SceneGrid


@pytest.fixture(scope="module")
def image() -> xr.DataArray:
    return ap.backproject(point_history(), TARGET_GRID, tile_px=64)


def test_image_is_lazy_and_its_chunks_are_the_tiles(image):
    assert image.chunks == ((64, 64, 32), (64, 64, 32))
    assert image.dtype == np.complex64
    assert image.attrs["units"] == "1"
    assert set(json.loads(image.attrs["models"])) >= {"engine", "presum", "terrain"}
    assert image.spatial_ref.attrs["crs_wkt"].startswith("LOCAL_CS")


def test_target_focuses_at_its_position_with_its_echo_amplitude(image):
    level = abs(image).compute()
    peak = level[level.argmax(...)]
    assert float(peak) == pytest.approx(1.0, abs=0.05)
    assert (float(peak.x), float(peak.y)) == (pytest.approx(1.25, abs=0.05), pytest.approx(-0.75, abs=0.05))


def test_certified_error_matches_a_comparison_with_the_double_sum():
    """The image is speckle, in which no pixel dominates the power; the certified error is an upper bound."""
    drawn = draw(np.random.default_rng(4), pixels=80, pulses=60)
    noise = np.random.default_rng(6).standard_normal((2, *drawn.history.transfer.shape))
    history = replace(drawn.history, transfer=(noise[0] + 1j * noise[1]).astype(np.complex64))
    image = ap.backproject(history, drawn.grid, certified_pixels=256)
    pixels = np.random.default_rng(5).integers(0, drawn.grid.shape, (400, 2)).T
    exact = reference.form(history, drawn.grid.positions_at(*pixels, 0.0)) / len(history)
    measured = numerical_error_db(image.values[tuple(pixels)], exact)
    assert image.attrs["numerical_error_estimate_db"] == pytest.approx(measured, abs=1.0)
    assert measured < image.attrs["numerical_error_db"] < measured + 3
    assert image.attrs["numerical_error_confidence"] == 0.95
    assert measured < -60


@pytest.mark.quick("871")
@compiled
@pytest.mark.parametrize("seed", [860, 863, 871])
def test_bound_from_few_pixels_is_not_below_the_predicted_error(seed):
    """Four pixels miss the bright pixels; the bound from these four alone is up to 9 dB below the error."""
    drawn = draw(np.random.default_rng(seed), pixels=48, pulses=60)
    image = ap.backproject(
        drawn.history, drawn.grid, -40, engine="tree", integration="all", certified_pixels=4, judge=False
    )
    assert image.attrs["numerical_error_db"] >= image.attrs["predicted_error_db"]


def test_profiles_give_the_same_image_and_their_own_certificate(image):
    """The error is relative to band-limited interpolation of the profiles; that of range compression is -130 dB."""
    profiles = ap.range_compress(point_history(), TARGET_GRID, ap.FlatGround(0.0))
    alone = ap.backproject(profiles, TARGET_GRID, tile_px=64)
    assert alone.attrs["numerical_error_db"] < -60
    difference = np.abs(alone.values - image.values).max() / np.abs(image.values).max()
    assert 20 * np.log10(difference + 1e-12) < -60
    with pytest.raises(CampaignError, match="reference"):
        ap.backproject(profiles, TARGET_GRID, engine="reference")


def test_campaign_stage_gives_the_image_of_the_workflow(finished_tiny):
    campaign = ap.open_campaign(finished_tiny.root)
    flight, pairs = next(iter(campaign.pairs.items()))
    scene, echo = campaign.scene, campaign.stage("echo", flight, pairs[0])
    image = ap.backproject(echo, scene.grid, terrain=scene.terrain, certified_pixels=0)
    np.testing.assert_array_equal(image.values, campaign.image(flight, pairs[0]).values)
    assert campaign.report(flight, pairs[0])["flags"] == campaign.flags(flight, pairs[0])
    result, workflow_focus = ap.judge(image), campaign.report(flight, pairs[0])["focus"]
    for name in ("verdict", "reason", "points", "parts"):
        assert result.focus[name] == workflow_focus[name]


@pytest.mark.slow
def test_threads_processes_and_one_thread_give_identical_images(image):
    alone = image.compute(scheduler="synchronous").values
    np.testing.assert_array_equal(image.compute(scheduler="threads").values, alone)
    np.testing.assert_array_equal(image.compute(scheduler="processes", num_workers=2).values, alone)


@pytest.mark.slow
def test_local_cluster_gives_an_identical_image(image):
    distributed = pytest.importorskip("distributed")
    alone = image.compute(scheduler="synchronous").values
    with (
        distributed.LocalCluster(2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        distributed.Client(cluster),
    ):
        np.testing.assert_array_equal(image.compute().values, alone)


def test_single_tile_equals_that_of_the_whole_image(image):
    np.testing.assert_array_equal(image[64:128, 128:160].compute().values, image.values[64:128, 128:160])


@pytest.mark.slow
def test_toy_engine_is_used_if_accurate_enough(toy):
    rough = ap.backproject(point_history(), TARGET_GRID, accuracy_db=-20.0)
    assert rough.attrs["setting"].startswith("toy refine=")
    assert rough.attrs["numerical_error_db"] < -20
    assert not ap.backproject(point_history(), TARGET_GRID, accuracy_db=-60.0).attrs["setting"].startswith("toy")
    requested = ap.backproject(point_history(), TARGET_GRID, accuracy_db=-10.0, engine_options={"toy": {"refine": 2}})
    assert json.loads(requested.attrs["models"])["refine"] == "2: requested; nearest sample of a refined profile"


def test_setting_that_misses_the_accuracy_is_replaced_by_the_next(toy):
    """The toy engine uses the nearest sample of a profile and underestimates the error in its prediction."""
    requested = {"engine": "toy", "engine_options": {"toy": {"refine": 2}}}
    image = ap.backproject(point_history(), TARGET_GRID, accuracy_db=-60.0, **requested)
    assert not image.attrs["setting"].startswith("toy")
    assert image.attrs["numerical_error_db"] < -60
    models = json.loads(image.attrs["models"])
    assert "did not meet the requested accuracy" in models["engine"]
    assert "refine" not in models
    assert "accuracy_not_met" not in json.loads(image.attrs["flags"])


def test_accuracy_met_by_no_setting_is_flagged():
    """With profiles as input, the double sum is not available as a fallback."""
    profiles = ap.range_compress(point_history(), TARGET_GRID, ap.FlatGround(0.0))
    flags = json.loads(ap.backproject(profiles, TARGET_GRID, accuracy_db=-120.0).attrs["flags"])
    assert "-120 dB requested" in flags["accuracy_not_met"]


def test_image_can_be_written_with_plan_and_certificate(image, tmp_path):
    parts = xr.Dataset({"real": image.real, "imag": image.imag}, attrs=image.attrs)
    parts.to_netcdf(tmp_path / "image.nc", engine="scipy")
    assert xr.open_dataset(tmp_path / "image.nc", engine="scipy").attrs["models"] == image.attrs["models"]


@pytest.mark.parametrize(
    ("offset_m", "grid", "options", "complaint"),
    [
        (1e6, TARGET_GRID, {}, "the samples contain no echo of the scene"),
        (0.0, SceneGrid("EPSG:32632", 5e5, 5e6, 0.5, (9, 9)), {"terrain": 0.0}, "no echo of the scene"),
        (0.0, SceneGrid("EPSG:32632", 5e5, 5e6, 0.5, (9, 9)), {}, "no terrain for a georeferenced grid"),
    ],
)
def test_scene_outside_the_samples_is_refused(offset_m, grid, options, complaint):
    history = point_history()
    displaced = ap.Aperture(history.aperture.tx_m + offset_m, history.aperture.rx_m + offset_m)
    with pytest.raises(CampaignError, match=complaint):
        ap.backproject(replace(history, aperture=displaced), grid, **options)


def test_lists_are_accepted_as_arrays():
    history = point_history()
    from_lists = replace(history, weight=list(history.weight), reference_delay_s=[0.0] * len(history))
    np.testing.assert_array_equal(from_lists.weight, history.weight)
    assert len(ap.Aperture([[0.0, 0, 9], [1, 0, 9]], [[0.0, 0, 9], [1, 0, 9]])) == 2
    with pytest.raises(CampaignError, match=r"tx_m \(3,\).*one row of x, y and z per pulse"):
        ap.Aperture([0.0, 0, 9], [0.0, 0, 9])


def test_profiles_that_end_within_the_scene_are_flagged():
    profiles = ap.range_compress(point_history(), TARGET_GRID, ap.FlatGround(0.0))
    short = replace(profiles, samples=profiles.samples[:, :60])
    assert "beyond the samples" in json.loads(ap.backproject(short, TARGET_GRID).attrs["flags"])["scene_beyond_samples"]
    with pytest.raises(CampaignError, match=r"samples \(50, .*the same number of pulses"):
        replace(profiles, samples=profiles.samples[:50])


@pytest.mark.slow
def test_requested_subcarrier_window_is_used(finished_tiny):
    campaign = ap.open_campaign(finished_tiny.root)
    flight, pairs = next(iter(campaign.pairs.items()))
    echo, scene = campaign.stage("echo", flight, pairs[0]), campaign.scene
    hann, none = (ap.backproject(echo, scene.grid, terrain=scene.terrain, window=name) for name in ("hann", "none"))
    assert float(np.abs(none.values - hann.values).max()) > 1e-3 * float(np.abs(hann.values).max())
