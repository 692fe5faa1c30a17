"""The cube: selection by name, CF metadata, CRS, and phases between pairs and between flights."""

import json
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
import rasterio
import rioxarray  # noqa: F401
import xarray as xr
import zarr
from folders import ROOT, complaint, contents, copy_writable, edit_config
from pyproj import CRS, Transformer
from walked import walk

from apertura.campaign.folder import Campaign
from apertura.campaign.store import create, damaged_files, finish, manifest_of, open_stage, writing
from apertura.common.confined import ConfinedPath
from apertura.common.contracts import RASTERS
from apertura.core.scene.grid import SceneGrid
from apertura.methods.interferometry.coherence import chance, coherence
from apertura.run.process import process
from apertura.simulation import ImageGrid, preset, simulate
from apertura.stages import cube
from apertura.workflow.stale import stale_results

pytestmark = pytest.mark.slow  # the campaign of two flights takes 5 s

HEIGHT_OFFSET_M = 0.1


def run_two_flights(root):
    """Run two flights, the second with one node, 0.1 m higher and a day later; tiles are 16 of 60 pixels wide."""
    plan = preset("demo", pulses=120)
    first, grid = plan.flights[0], ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1)
    track = first.tracks["uav1"]
    east, north, up = track.start_m
    lifted = {"uav1": replace(track, start_m=(east, north, up + HEIGHT_OFFSET_M))}
    second = replace(first, name="f02", tracks=lifted, start_utc="2025-05-15T09:30:00")
    simulate(root, replace(plan, scene=grid, flights=(first, second)), seed=7)
    edit_config(root, lambda document: document.setdefault("processing", {}).update(tile_px=16))
    process(root, last="cube")


@pytest.fixture(scope="session")
def campaign(made_once):
    """Return the campaign of two flights, run once per session."""
    return Campaign.load(made_once("cube", run_two_flights))


@pytest.fixture(scope="module")
def opened(campaign):
    """Open the cube with xarray; a warning is an error."""
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


def test_cube_has_the_metadata_of_cf(campaign, opened):
    """The cube passes the IOOS compliance checker for CF-1.11, except for dB, which CF permits."""
    assert opened.attrs["Conventions"] == "CF-1.11, ACDD-1.3"
    assert campaign.settings.campaign in opened.attrs["title"]
    assert opened.attrs["history"]
    standard_names = {
        name: array.attrs["standard_name"] for name, array in opened.variables.items() if "standard_name" in array.attrs
    }
    assert standard_names == {
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


def test_cube_has_the_metadata_of_acdd(campaign, opened):
    """The IOOS compliance checker for ACDD-1.3 reports no missing attribute of the level "highly recommended"."""
    attributes = opened.attrs
    assert all(attributes[name] for name in ("title", "summary", "keywords", "Conventions", "project", "source"))
    start, end = (np.datetime64(attributes[f"time_coverage_{name}"].removesuffix("Z")) for name in ("start", "end"))
    assert start <= opened.time.values.min() < opened.time.values.max() <= end
    duration_s = float(attributes["time_coverage_duration"].removeprefix("PT").removesuffix("S"))
    assert duration_s == pytest.approx((end - start) / np.timedelta64(1, "s"), abs=1e-3)
    to_map = Transformer.from_crs("EPSG:4326", 32632)
    outline = attributes["geospatial_bounds"].removeprefix("POLYGON ((").removesuffix("))").split(", ")
    latitude, longitude = np.transpose([list(map(float, corner.split())) for corner in outline])
    east, north = to_map.transform(latitude, longitude)
    xmin, ymin, xmax, ymax = campaign.settings.scene.bounds_m
    assert (min(east), min(north)) < (xmin + 1e-3, ymin + 1e-3)
    assert (max(east), max(north)) > (xmax - 1e-3, ymax - 1e-3)
    assert attributes["geospatial_lat_min"] == pytest.approx(latitude.min())
    assert attributes["geospatial_lon_max"] == pytest.approx(longitude.max())
    not_stated = {"license", "creator_name", "institution", "id", "platform", "instrument", "references"}
    assert not attributes.keys() & not_stated
    assert all(array.attrs["coverage_content_type"] for array in opened.data_vars.values())


@pytest.mark.skipif(
    tuple(map(int, rasterio.__gdal_version__.split(".")[:2])) < (3, 12), reason="GDAL 3.12 reads Zarr version 3"
)
@pytest.mark.parametrize("array", ["image:1:0", "overviews/2/power:1:0"])
def test_gdal_reads_an_image_with_its_crs(campaign, opened, array):
    with rasterio.open(f'ZARR:"{campaign.stage("cube")}":/{array}') as raster:
        assert raster.crs.to_epsg() == 32632
        assert tuple(raster.bounds) == pytest.approx(campaign.settings.scene.bounds_m, abs=1e-6)
        if array.startswith("image"):
            np.testing.assert_array_equal(raster.read(1), opened.image[1, 0])


def test_codecs_of_the_cube_are_those_of_gdal(campaign):
    """GDAL 3.12 supports bytes, vlen-utf8 and zstd, but not crc32c; zstd has a checksum."""
    arrays = [json.loads(path.read_bytes()) for path in campaign.stage("cube").rglob("zarr.json")]
    codecs = [codec for array in arrays for codec in array.get("codecs", [])]
    assert {codec["name"] for codec in codecs} == {"bytes", "vlen-utf8", "zstd"}
    assert all(codec["configuration"]["checksum"] for codec in codecs if codec["name"] == "zstd")


def test_overviews_are_the_mean_power_of_blocks_of_pixels(campaign, opened):
    """Each level has its own grid, is valid as a level of the convention, and contains the sum, too."""
    power = (np.abs(opened.image.load()) ** 2).values
    layout = opened.attrs["multiscales"]["layout"]
    assert [level["asset"] for level in layout] == ["image", "overviews/2/power", "overviews/4/power"]
    for factor, placed in zip((2, 4), layout[1:], strict=True):
        level = xr.open_zarr(str(campaign.stage("cube")), group=f"overviews/{factor}").load()
        blocks = power.reshape(2, 2, 60 // factor, factor, 60 // factor, factor)
        np.testing.assert_allclose(level.power, blocks.mean(axis=(3, 5)), rtol=1e-5)
        assert placed["spatial:shape"] == [level.sizes["y"], level.sizes["x"]] == [60 // factor] * 2
        assert level.rio.bounds() == pytest.approx(opened.rio.bounds(), abs=1e-6)
        assert level.rio.crs == opened.rio.crs
        assert level.flight.values.tolist() == ["f01", "f02"]
        sums = opened.noncoherent.values.reshape(2, *blocks.shape[2:])
        np.testing.assert_allclose(level.noncoherent, sums.mean(axis=(2, 4)), rtol=1e-5)


def test_overview_omits_missing_pixels():
    """Only illuminated pixels are averaged; the last row and column of an odd image are blocks of fewer pixels."""
    source = np.full((3, 3), np.nan, np.complex64)
    source[0, 0], source[2, 2] = 2j, 3
    target = np.full((2, 2), -1, np.float32)
    grid = SceneGrid("local", 0.0, 0.0, 2.0, (2, 2))
    with ThreadPoolExecutor(1) as workers:
        cube._write_overviews(source, [target], [grid], 2, workers)
    np.testing.assert_array_equal(target, [[4, np.nan], [np.nan, 9]])


@pytest.mark.parametrize("name", ["spatial", "proj", "multiscales"])
def test_attributes_follow_the_zarr_conventions(campaign, opened, name):
    """The group is valid against the schema of each convention, with its UUID, and describes the stored grid."""
    schema = json.loads((ROOT / "tests/zarr_conventions" / f"{name}.json").read_text())
    group = json.loads((campaign.stage("cube") / "zarr.json").read_bytes())
    jsonschema.Draft7Validator(schema).validate(group)
    stated = {one["name"]: one["uuid"] for one in group["attributes"]["zarr_conventions"]}
    assert stated[name] == schema["$defs"]["conventionMetadata"]["properties"]["uuid"]["const"]
    for level in ("2", "4"):
        group = json.loads((campaign.stage("cube") / "overviews" / level / "zarr.json").read_bytes())
        if name != "multiscales":
            jsonschema.Draft7Validator(schema).validate(group)
    step, _, west, _, down, north = opened.attrs["spatial:transform"]
    assert opened.x.values[0] == pytest.approx(west + step / 2, abs=1e-9)
    assert opened.y.values[-1] == pytest.approx(north + down * (opened.sizes["y"] - 0.5), abs=1e-6)
    assert opened.attrs["spatial:shape"] == [opened.sizes[dim] for dim in opened.attrs["spatial:dimensions"]]
    assert CRS(opened.attrs["proj:code"]) == CRS(opened.attrs["proj:wkt2"]) == CRS(opened.rio.crs)


def test_rioxarray_reads_the_crs_of_every_raster(campaign, opened):
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


def test_names_and_units_follow_cf(opened):
    assert opened.attrs["Conventions"].startswith("CF-")
    for name, array in opened.variables.items():
        assert name == "spatial_ref" or array.attrs.keys() & {"long_name", "standard_name"}, name
        assert "units" in array.attrs or array.dtype.kind in "TMO" or name == "spatial_ref", name
    assert opened.x.attrs["standard_name"] == "projection_x_coordinate"
    assert opened.y.attrs["axis"] == "Y"
    assert opened.time.attrs["standard_name"] == "time"
    assert opened.spatial_ref.attrs["grid_mapping_name"] == "transverse_mercator"


def test_flight_has_the_time_of_its_middle(opened):
    middle = np.array(
        ["2025-05-14T09:30:02.975", "2025-05-15T09:30:02.975"], "datetime64[ns]"
    )  # of 120 pulses at 20 Hz
    assert (np.abs(opened.time.values - middle) < np.timedelta64(100, "ms")).all()


def test_each_image_states_its_geometry(opened):
    f01, f02 = (opened.sel(flight=flight, pair="uav1-uav1") for flight in ("f01", "f02"))
    assert float(f02.height - f01.height) == pytest.approx(HEIGHT_OFFSET_M, abs=0.15)  # both tracks have wobble
    assert float(f01.heading) == pytest.approx(40, abs=5)  # heading of the demo's tracks
    assert (float(f01.look_direction) - float(f01.heading)) % 360 == pytest.approx(90, abs=30)
    assert np.degrees(np.arccos(float(f01.height / f01.range))) == pytest.approx(float(f01.incidence), abs=1)
    assert float(f01.bandwidth) == pytest.approx(409.6e6, rel=1e-3)
    assert float(f01.bistatic_angle) < 1 < float(opened.bistatic_angle.sel(flight="f01", pair="uav1-uav2"))


def test_coherence_and_phase_do_not_depend_on_the_tiles(opened):
    images = opened.image.load()
    reference = opened.reference_pair.sel(flight="f01").values.item()
    (other,) = set(opened.pair.values.tolist()) - {reference}
    for kind, one, against in (
        ("pair", ("f01", other), ("f01", reference)),
        ("flight", ("f02", "uav1-uav1"), ("f01", "uav1-uav1")),
    ):
        stored = opened.sel(flight=one[0], pair=one[1])
        whole = coherence(
            images.sel(flight=one[0], pair=one[1]).values,
            images.sel(flight=against[0], pair=against[1]).values,
            window=int(stored[f"{kind}_window"]),
        )
        np.testing.assert_array_equal(stored[f"{kind}_coherence"], whole[0])
        np.testing.assert_array_equal(stored[f"{kind}_phase"], whole[1])
        assert float(stored[f"{kind}_chance"]) == pytest.approx(chance(whole[2]), abs=0.03)  # looks estimated per tile
        assert np.isnan(opened.sel(flight=against[0], pair=against[1])[f"{kind}_coherence"]).all()


def test_coherence_of_a_target_is_limited_by_the_common_band(opened):
    brightest = np.abs(opened.image.sel(flight="f01", pair="uav1-uav2")).argmax(...)
    assert opened.reference_pair.sel(flight="f01") == "uav1-uav2"
    for name, flight in (("pair", "f01"), ("flight", "f02")):
        pixel = opened.sel(flight=flight, pair="uav1-uav1").isel(brightest)
        assert float(pixel[f"{name}_coherence"]) == pytest.approx(float(pixel[f"{name}_common_band"]), abs=0.12)
        assert abs(float(pixel[f"{name}_phase"])) < 0.3


def test_clutter_reduction_of_the_sum_is_stated(opened):
    floors = opened.noise_floor.sel(flight="f01")
    mean_db = 10 * np.log10((10 ** (floors / 10)).mean())
    assert np.isfinite(opened.phase_removed.sel(flight="f01")).all()  # both pairs are in the sum
    assert float(opened.clutter_reduction[0]) == pytest.approx(
        float(mean_db - opened.coherent_noise_floor[0]), abs=1e-9
    )


def test_flight_of_one_pair_has_no_sum(opened):
    alone = opened.sel(flight="f02")
    for name in ("coherent", "noncoherent", "magnitude", "clutter_reduction", "coherent_noise_floor", "phase_removed"):
        assert alone[name].isnull().all(), name
    assert [*opened.attrs["fusion"]] == ["f01"]
    assert not opened.coherent.sel(flight="f01").isnull().all()


def test_metadata_are_consolidated_and_hashed_with_the_rest(campaign):
    folder = campaign.stage("cube")
    group = zarr.open_group(str(folder), mode="r", use_consolidated=True)
    assert {"image", "flight", "time"} <= set(group.metadata.consolidated_metadata.metadata)
    assert damaged_files(manifest_of(folder)) == []


def test_chunks_are_tiles_in_separate_files(campaign, opened):
    assert opened.image.encoding["chunks"] == (1, 1, 16, 16)
    assert opened.image.encoding["shards"] is None
    assert len([*(campaign.stage("cube") / "pair_phase" / "c").rglob("*")]) == 1 + 1 + 4 + 16  # chunks of one pair only
    assert not (campaign.stage("cube") / "flight_phase" / "c" / "0").exists()


def test_cube_does_not_depend_on_the_number_of_threads(campaign, tmp_path):
    again = Campaign.load(copy_writable(campaign.root, tmp_path / "campaign"))
    cube.cube(again, threads=3)
    assert manifest_of(again.stage("cube")).read_bytes() == manifest_of(campaign.stage("cube")).read_bytes()


# ---- Appending: chunks of unchanged flights are linked, and the bytes equal those of a cube written at once ----------


@pytest.fixture
def written(campaign, tmp_path, monkeypatch):
    """A writable copy of the campaign, a function that writes its cube for some flights, and the flights computed."""
    root = copy_writable(campaign.root, tmp_path / "campaign")
    table, computed, real = root / "config/flights.tsv", [], cube._write_images
    head, *rows = table.read_text().splitlines(keepends=True)
    monkeypatch.setattr(cube, "_write_images", lambda *given: (computed.append(given[3]), real(*given))[1])

    def write(*flights):
        computed.clear()
        table.write_text(head + "".join(row for name in flights for row in rows if row.split()[0] == name))
        return cube.cube(Campaign.load(root))

    return root, write, computed


def test_appended_flight_computes_only_its_own_chunks(campaign, written):
    root, write, computed = written
    (root / "results/.cube.zarr.lock").unlink()  # record of the earlier cube
    folder = write("f01")
    assert computed == ["f01"]
    before = {path: path.stat().st_ino for path in (folder / "image/c/0").rglob("*") if path.is_file()}
    write("f01", "f02")
    assert computed == ["f02"]
    assert len(before) == 2 * 16
    assert all(path.stat().st_ino == inode for path, inode in before.items())
    assert manifest_of(folder).read_bytes() == manifest_of(campaign.stage("cube")).read_bytes()
    assert damaged_files(manifest_of(folder)) == []


def test_further_flight_leaves_results_of_other_flights_up_to_date(campaign, written):
    """Only results of the campaign as a whole are out of date: the cube, and catalogs where there are any."""
    root, write, _ = written
    write("f01")
    assert stale_results(Campaign.load(root)) == {}
    (root / "config/flights.tsv").write_text((campaign.root / "config/flights.tsv").read_text())
    assert stale_results(Campaign.load(root)).keys() == {"results/cube.manifest.json"}


def test_removed_flight_leaves_no_chunks(campaign, written):
    _, write, computed = written
    folder = write("f01")
    assert computed == []
    assert not any((folder / name / "c" / "1").exists() for name in RASTERS)
    assert open_stage(folder, "cube").flight.values.tolist() == ["f01"]
    write("f02")  # without its reference flight
    assert computed == ["f02"]
    assert np.isnan(open_stage(folder, "cube").flight_coherence).all()


def test_flights_in_another_order_are_moved(written):
    """Chunks move with their flights; a flight is written again if its reference flight has changed."""
    root, write, computed = written
    folder = write("f02", "f01")
    opened = open_stage(folder, "cube")
    assert set(computed) == {"f01", "f02"}
    assert opened.reference_flight.sel(pair="uav1-uav1") == "f02"
    computed.clear()
    (root / "results/.cube.zarr.lock").unlink()
    before = manifest_of(folder).read_bytes()
    write("f02", "f01")
    assert manifest_of(folder).read_bytes() == before


def test_damaged_chunk_is_written_again_if_no_flight_was_added(campaign, written):
    _, write, computed = written
    folder = write("f01", "f02")
    next(path for path in (folder / "image/c/1").rglob("*") if path.is_file()).write_bytes(b"x")
    write("f01", "f02")
    assert computed == ["f02"]
    assert manifest_of(folder).read_bytes() == manifest_of(campaign.stage("cube")).read_bytes()


@pytest.mark.parametrize("step", ["_compare", "finish"])
def test_killed_append_leaves_the_earlier_cube_valid(campaign, written, monkeypatch, step):
    _, write, _ = written
    folder = write("f01")
    before = contents(folder) | {"manifest": manifest_of(folder).read_bytes()}

    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(cube, step, killed)
        with pytest.raises(KeyboardInterrupt):
            write("f01", "f02")
    assert contents(folder) | {"manifest": manifest_of(folder).read_bytes()} == before
    assert open_stage(folder, "cube").sizes["flight"] == 1
    write("f01", "f02")
    assert manifest_of(folder).read_bytes() == manifest_of(campaign.stage("cube")).read_bytes()


@pytest.mark.parametrize("last", [0, 30, 75, 95])
def test_append_killed_while_files_are_moved_leaves_the_earlier_cube_valid(campaign, written, monkeypatch, last):
    """Readers of the consolidated metadata see the earlier cube until zarr.json is replaced."""
    _, write, _ = written
    folder, real, moved = write("f01"), ConfinedPath.rename, []
    before = xr.open_zarr(str(folder)).load()

    def killed(self, target):
        if "cube.zarr.wip" in self.parts and not self.name.endswith(".partial"):
            moved.append(self.name)
            if len(moved) > last:
                raise KeyboardInterrupt
        return real(self, target)

    with monkeypatch.context() as patched:
        patched.setattr(ConfinedPath, "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            write("f01", "f02")
    after = xr.open_zarr(str(folder)).load()
    for name in {*before.variables} - {"flight_window", "reference_flight"}:
        np.testing.assert_array_equal(after[name], before[name])
    assert "missing or unfinished" in complaint(lambda: open_stage(folder, "cube"))
    write("f01", "f02")
    assert manifest_of(folder).read_bytes() == manifest_of(campaign.stage("cube")).read_bytes()


def test_writer_killed_between_two_renamings_is_recovered(campaign, written, monkeypatch):
    root, write, _ = written
    folder, real = root / "results/cube.zarr", ConfinedPath.rename

    def killed(self, target):
        if self.name == "cube.zarr.wip":
            raise KeyboardInterrupt
        return real(self, target)

    with monkeypatch.context() as patched:
        patched.setattr(ConfinedPath, "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            write("f01")  # removes f02
    assert not folder.exists()
    write("f01", "f02")
    assert manifest_of(folder).read_bytes() == manifest_of(campaign.stage("cube")).read_bytes()


def test_readers_of_the_earlier_metadata_can_read_chunks_with_a_further_flight(written):
    """Coordinates and measures have chunks of a fixed length, so that a published cube may be replaced file by file."""
    _, write, _ = written
    folder = write("f01")
    metadata = (folder / "zarr.json").read_bytes()
    before = xr.open_zarr(str(folder)).load()
    write("f01", "f02")
    (folder / "zarr.json").write_bytes(metadata)
    after = xr.open_zarr(str(folder)).load()
    for name in {*before.variables} - {"reference_flight", "pair", *RASTERS}:
        np.testing.assert_array_equal(after[name], before[name])
    np.testing.assert_array_equal(after.image, before.image)


def test_images_of_an_older_version_are_one_message(campaign, tmp_path):
    root = copy_writable(campaign.root, tmp_path / "campaign")
    folder = Campaign.load(root).stage("image", "f01", "uav1-uav1")
    image = open_stage(folder, "image").load()
    del image.attrs["quality"]["view"]
    with writing(folder) as wip:
        create(wip, image, {"image": (16, 16)})
        finish(wip, folder)
    message = complaint(lambda: cube.cube(Campaign.load(root)))
    assert "'view' missing" in message
    assert "Run the workflow again" in message


def test_code_blocks_of_the_how_to_print_what_they_show(campaign, tmp_path, monkeypatch):
    copy_writable(campaign.root, tmp_path / "campaign")
    monkeypatch.chdir(tmp_path)
    walk(ROOT / "docs/howto/xarray.md")
    with rasterio.open("phase.tif") as raster:
        assert raster.crs.to_epsg() == 32632
        assert tuple(raster.bounds) == pytest.approx(campaign.settings.scene.bounds_m, abs=1e-6)
