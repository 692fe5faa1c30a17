"""The cube as people open it: by names, with its CRS, and with phases between pairs and between flights."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import rioxarray  # noqa: F401
import xarray as xr
import zarr
from folders import ROOT, complaint, copy_writable, edit_config, run_steps
from walked import walk

from apertura.campaign.folder import Campaign
from apertura.campaign.store import create, damaged_files, finish, manifest_of, open_stage, writing
from apertura.methods.interferometry.coherence import chance, coherence
from apertura.simulation import ImageGrid, preset, simulate
from apertura.stages import cube

LIFTED_M = 0.1


def two_days(root):
    """Two flights, the second of one node, a little higher and a day later; tiles of 16 of 60 pixels."""
    plan = preset("demo", pulses=120)
    first, grid = plan.flights[0], ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1)
    track = first.tracks["uav1"]
    east, north, up = track.start_m
    lifted = {"uav1": replace(track, start_m=(east, north, up + LIFTED_M))}
    second = replace(first, name="f02", tracks=lifted, start_utc="2025-05-15T09:30:00")
    simulate(root, replace(plan, scene=grid, flights=(first, second)), seed=7)
    edit_config(root, lambda document: document.setdefault("processing", {}).update(tile_px=16))
    run_steps(root, exports=False)


@pytest.fixture(scope="session")
def campaign(made_once):
    """That, made once."""
    return Campaign.load(made_once("cube", two_days))


@pytest.fixture(scope="module")
def opened(campaign):
    """The cube as a stranger opens it; a warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return xr.open_zarr(str(campaign.stage("cube")))


def test_images_are_selected_by_name(campaign, opened):
    assert opened.flight.values.tolist() == ["f01", "f02"]
    assert opened.pair.values.tolist() == ["uav1-uav1", "uav1-uav2"]
    for flight, pair in (("f01", "uav1-uav1"), ("f01", "uav1-uav2"), ("f02", "uav1-uav1")):
        image = open_stage(campaign.stage("image", flight, pair), "image")
        np.testing.assert_array_equal(opened.image.sel(flight=flight, pair=pair), image.image)
    missing = opened.sel(flight="f02", pair="uav1-uav2")
    assert np.isnan(missing.image).all()
    assert np.isnan(missing.incidence)
    assert missing.verdict.values.item() == ""
    assert opened.sel(flight="f01", pair="uav1-uav2").verdict.values.item() in {"focused", "inconclusive", "defocused"}


def test_the_cube_says_what_it_is_as_cf_has_it(campaign, opened):
    """What compliance-checker of IOOS asks of CF-1.11; decibels it does not know are a unit of CF all the same."""
    assert opened.attrs["Conventions"] == "CF-1.11"
    assert campaign.settings.campaign in opened.attrs["title"]
    assert opened.attrs["history"]
    named = {
        name: array.attrs["standard_name"] for name, array in opened.variables.items() if "standard_name" in array.attrs
    }
    assert named == {
        "incidence": "angle_of_incidence",
        "centre_frequency": "sensor_band_central_radiation_frequency",
        "time": "time",
        "x": "projection_x_coordinate",
        "y": "projection_y_coordinate",
    }
    for name, array in opened.variables.items():
        assert array.attrs["long_name"]
        texts = array.dtype.kind in "TOM" or name == "spatial_ref"
        assert texts or array.attrs["units"] in {"1", "m", "Hz", "dB", "rad", "degree"}
    assert not any("_FillValue" in array.attrs for array in opened.variables.values())


def test_the_crs_is_one_line_away_and_every_raster_names_it(campaign, opened):
    assert opened.rio.crs.to_epsg() == 32632
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PendingDeprecationWarning)
        xmin, ymin, xmax, ymax = campaign.settings.scene.bounds_m
        assert opened.rio.bounds() == pytest.approx((xmin, ymin, xmax, ymax), abs=1e-6)
        assert tuple(opened.image.rio.transform())[:6] == pytest.approx((0.1, 0, xmin, 0, -0.1, ymax), abs=1e-6)
    rasters = [name for name, array in opened.items() if {"y", "x"} <= set(array.dims)]
    assert len(rasters) == 8
    for name, array in opened.items():
        assert (array.attrs.get("grid_mapping") == "spatial_ref") == (name in rasters)


def test_names_and_units_are_those_of_cf(opened):
    assert opened.attrs["Conventions"].startswith("CF-")
    for name, array in opened.variables.items():
        assert name == "spatial_ref" or array.attrs.keys() & {"long_name", "standard_name"}, name
        assert "units" in array.attrs or array.dtype.kind in "TMO" or name == "spatial_ref", name
    assert opened.x.attrs["standard_name"] == "projection_x_coordinate"
    assert opened.y.attrs["axis"] == "Y"
    assert opened.time.attrs["standard_name"] == "time"
    assert opened.spatial_ref.attrs["grid_mapping_name"] == "transverse_mercator"


def test_a_flight_has_the_time_of_its_middle(opened):
    middle = np.array(
        ["2025-05-14T09:30:02.975", "2025-05-15T09:30:02.975"], "datetime64[ns]"
    )  # of 120 pulses at 20 Hz
    assert (np.abs(opened.time.values - middle) < np.timedelta64(100, "ms")).all()


def test_each_image_says_how_it_saw_the_scene(opened):
    f01, f02 = (opened.sel(flight=flight, pair="uav1-uav1") for flight in ("f01", "f02"))
    assert float(f02.height - f01.height) == pytest.approx(LIFTED_M, abs=0.15)  # both wobble
    assert float(f01.heading) == pytest.approx(40, abs=5)  # of the demo's tracks
    assert (float(f01.look_direction) - float(f01.heading)) % 360 == pytest.approx(90, abs=30)
    assert np.degrees(np.arccos(float(f01.height / f01.range))) == pytest.approx(float(f01.incidence), abs=1)
    assert float(f01.bandwidth) == pytest.approx(409.6e6, rel=1e-3)
    assert float(f01.bistatic_angle) < 1 < float(opened.bistatic_angle.sel(flight="f01", pair="uav1-uav2"))


def test_coherence_and_phase_are_those_of_whole_images_whatever_the_tiles(opened):
    window = opened.attrs["coherence_window"]
    images = opened.image.load()
    reference = opened.reference_pair.sel(flight="f01").values.item()
    (other,) = set(opened.pair.values.tolist()) - {reference}
    for kind, one, against in (
        ("pair", ("f01", other), ("f01", reference)),
        ("flight", ("f02", "uav1-uav1"), ("f01", "uav1-uav1")),
    ):
        whole = coherence(
            images.sel(flight=one[0], pair=one[1]).values,
            images.sel(flight=against[0], pair=against[1]).values,
            window=window,
        )
        held = opened.sel(flight=one[0], pair=one[1])
        np.testing.assert_array_equal(held[f"{kind}_coherence"], whole[0])
        np.testing.assert_array_equal(held[f"{kind}_phase"], whole[1])
        assert float(held[f"{kind}_chance"]) == pytest.approx(chance(whole[2]), abs=0.03)  # looks are told tile by tile
        assert np.isnan(opened.sel(flight=against[0], pair=against[1])[f"{kind}_coherence"]).all()


def test_a_target_is_as_coherent_as_the_common_band_lets_it(opened):
    brightest = np.abs(opened.image.sel(flight="f01", pair="uav1-uav2")).argmax(...)
    assert opened.reference_pair.sel(flight="f01") == "uav1-uav2"
    for name, flight in (("pair", "f01"), ("flight", "f02")):
        here = opened.sel(flight=flight, pair="uav1-uav1").isel(brightest)
        assert float(here[f"{name}_coherence"]) == pytest.approx(float(here[f"{name}_common_band"]), abs=0.12)
        assert abs(float(here[f"{name}_phase"])) < 0.3


def test_the_sum_says_how_far_it_lowers_clutter(opened):
    floors = opened.noise_floor.sel(flight="f01")
    mean_db = 10 * np.log10((10 ** (floors / 10)).mean())
    assert np.isfinite(opened.phase_removed.sel(flight="f01")).all()  # both pairs are in the sum
    assert float(opened.clutter_reduction[0]) == pytest.approx(
        float(mean_db - opened.coherent_noise_floor[0]), abs=1e-9
    )


def test_a_flight_of_one_pair_has_no_sum(opened):
    alone = opened.sel(flight="f02")
    for name in ("coherent", "noncoherent", "magnitude", "clutter_reduction", "coherent_noise_floor", "phase_removed"):
        assert alone[name].isnull().all(), name
    assert [*opened.attrs["fusion"]] == ["f01"]
    assert not opened.coherent.sel(flight="f01").isnull().all()


def test_metadata_are_consolidated_and_hashed_with_the_rest(campaign):
    folder = campaign.stage("cube")
    held = zarr.open_group(str(folder), mode="r", use_consolidated=True)
    assert {"image", "flight", "time"} <= set(held.metadata.consolidated_metadata.metadata)
    assert damaged_files(manifest_of(folder)) == []


def test_chunks_are_tiles_and_files(campaign, opened):
    assert opened.image.encoding["chunks"] == (1, 1, 16, 16)
    assert opened.image.encoding["shards"] is None
    assert len([*(campaign.stage("cube") / "pair_phase" / "c").rglob("*")]) == 1 + 1 + 4 + 16  # of one pair alone
    assert not (campaign.stage("cube") / "flight_phase" / "c" / "0").exists()


def test_a_cube_made_again_by_any_number_of_threads_is_the_same_to_the_byte(campaign, tmp_path):
    again = Campaign.load(copy_writable(campaign.root, tmp_path / "campaign"))
    cube.cube(again, threads=3)
    assert manifest_of(again.stage("cube")).read_bytes() == manifest_of(campaign.stage("cube")).read_bytes()


def test_images_of_an_older_version_end_in_one_message(campaign, tmp_path):
    root = copy_writable(campaign.root, tmp_path / "campaign")
    folder = Campaign.load(root).stage("image", "f01", "uav1-uav1")
    image = open_stage(folder, "image").load()
    del image.attrs["quality"]["view"]
    with writing(folder) as wip:
        create(wip, image, {"image": (16, 16)})
        finish(wip, folder)
    said = complaint(lambda: cube.cube(Campaign.load(root)))
    assert "'view' missing" in said
    assert "Run the workflow again" in said


@pytest.mark.slow
def test_every_block_of_the_how_to_runs_and_prints_what_it_shows(campaign, tmp_path, monkeypatch):
    copy_writable(campaign.root, tmp_path / "campaign")
    monkeypatch.chdir(tmp_path)
    walk(ROOT / "docs/howto/xarray.md")
    with rasterio.open("phase.tif") as raster:
        assert raster.crs.to_epsg() == 32632
        assert tuple(raster.bounds) == pytest.approx(campaign.settings.scene.bounds_m, abs=1e-6)
