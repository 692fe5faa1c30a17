"""Campaigns with terrain, from folder to products: DEM, datum, geometry layers, provenance and bad input."""

import hashlib
import json
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import rasterio
import xarray as xr
import yaml
from folders import ALONG, SLOPE, UPHILL, complaint, copy_writable, expected_plan, require_files, write_plane

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.cli import main
from apertura.core.backprojection.engines import load_engine
from apertura.core.geometry.geodesy import projected_from_ecef
from apertura.core.imaging.range_profiles import profiles_of
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.run.process import process
from apertura.simulation import ImageGrid, preset, simulate
from apertura.simulation.presets import DEMO_ORIGIN
from apertura.simulation.targets import PointTarget
from apertura.stages import profile, scene
from apertura.stages.pair import open_pair
from apertura.stages.planning import job_of, plan_pair
from apertura.stages.scene import ConfiguredGround, OpenScene, expected_scene, open_scene, settled_scene
from apertura.stages.transfer import PairEcho
from apertura.views.score import score

UNDULATION_M = 47.392  # EGM96 at the demo's origin, read from egm96_15.gtx with rasterio
PAIR = ("f01", "uav1-uav2")


def edit_scene(root, **keys):
    path = root / "config" / "config.yaml"
    document = yaml.safe_load(path.read_text())
    document["scene"] |= keys
    path.write_text(yaml.safe_dump(document))
    return Campaign.load(root)


@pytest.fixture(scope="module")
def hillside(tmp_path_factory):
    """Image the tiny campaign with three targets on a plane tilted by 20° with its DEM."""
    plan = replace(preset("demo", pulses=60), scene=ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1))
    right = np.array([ALONG[1], -ALONG[0]])  # separated in range, which a short aperture resolves
    offsets = [across * right + along * ALONG for across, along in ((0.0, 0.0), (2.0, 0.8), (-2.0, -0.6))]
    targets = tuple(PointTarget((x, y, SLOPE * float(UPHILL @ (x, y)))) for x, y in offsets)
    root = simulate(tmp_path_factory.mktemp("hillside") / "campaign", plan, targets=targets, seed=7)
    write_plane(root)
    edit_scene(root, dem="dem.tif", dem_datum="ellipsoid")
    return process(root)


@pytest.mark.slow
def test_targets_on_a_hillside_are_at_their_positions(hillside):
    findings = score(hillside)
    assert len(findings) == 9
    assert max(finding.error_m for finding in findings) < 0.03


@pytest.mark.slow
def test_flat_terrain_displaces_targets_of_a_hillside(hillside, tmp_path):
    root = copy_writable(hillside.root, tmp_path / "campaign")
    shutil.rmtree(root / "results")
    edit_scene(root, dem=None, dem_datum=None)
    findings = score(process(root))
    errors_m = [finding.error_m for finding in findings if finding.target and finding.image == "uav1-uav1"]
    assert min(errors_m) > 0.1


def test_step_of_the_dem_flags_images_of_the_scene():
    grid, level = SceneGrid("local", 0.0, 8.0, 0.5, (16, 16)), FlatGround(0.0)
    step = {"height_m": 618.4, "over_m": 20.0, "x_m": 500041.0, "y_m": 5400040.0}
    for steepest, flagged in ((step, True), (None, False)):
        stage = xr.Dataset(attrs={"terrain": {"dem": "dem.tif", "steepest_step": steepest}})
        flags = OpenScene(grid, level, level, (stage,), {}, {}).flags
        line = "the DEM has a step of 618 m over 20 m at x 500041.0, y 5400040.0"
        assert flags == ({"terrain_step": line} if flagged else {})
    assert OpenScene(grid, level, level, (), {}, {}).flags == {}


@pytest.mark.slow
def test_product_on_terrain_names_the_dem(hillside):
    report = json.loads((hillside.results / "f01" / "uav1-uav2" / "image.json").read_text())
    assert report["terrain"]["dem"] == "dem.tif"
    assert report["terrain"]["datum"] == "ellipsoid"
    assert report["numerical_error_db"] < -50
    assert report["terrain"]["lowest_m"] < settled_scene(hillside).level.height_m < report["terrain"]["highest_m"]
    digest = hashlib.sha256((hillside.root / "dem.tif").read_bytes()).hexdigest()
    pair_of = {"f01/uav1-uav2/slc.tif": None, "f01/fused/coherent_db.tif": "uav1-uav2", "f01/uav1-uav2/mask.tif": None}
    for name, pair in pair_of.items():
        with rasterio.open(str(hillside.results / name)) as raster:
            assert json.loads(raster.tags()["APERTURA_INPUTS"])["dem"] == digest
            runspec = json.loads(raster.tags()["APERTURA_RUNSPEC"])
            runspec = runspec[pair] if pair else runspec
            assert (runspec["dem"], runspec["dem_datum"]) == ("dem.tif", "ellipsoid")


@pytest.mark.slow
def test_layers_contain_the_angles_of_the_slope_on_the_grid(hillside):
    grid = settled_scene(hillside).grid
    heights = open_stage(hillside.stage("terrain"), "terrain").height.values
    values = {}
    for name in ("incidence", "bistatic_angle", "mask"):
        with rasterio.open(str(hillside.results / "f01" / "uav1-uav2" / f"{name}.tif")) as raster:
            assert tuple(raster.transform)[:6] == grid.transform
            assert raster.crs.to_epsg() == 32632
            values[name] = raster.read(1)
    echo = PairEcho.opened(hillside, "f01", "uav1-uav2").stage
    middle = tuple(size // 2 for size in grid.shape)
    place = grid.positions_at(*middle, heights[middle])
    legs = [echo[name].values for name in ("tx_position", "rx_position")]
    # Track wobble displaces the closest approach of a short track, which changes the angles by tenths of a degree.
    closest = sum(np.linalg.norm(leg - place, axis=1) for leg in legs).argmin()
    tx, rx = (leg[closest] for leg in legs)
    to_tx, to_rx = ((leg - place) / np.linalg.norm(leg - place) for leg in (tx, rx))
    east, north, up = DEMO_ORIGIN.enu(to_tx + DEMO_ORIGIN.ecef(np.zeros(3)))
    normal = np.array([-SLOPE * UPHILL[0], -SLOPE * UPHILL[1], 1.0]) / np.hypot(1, SLOPE)
    assert values["incidence"][middle] == pytest.approx(np.degrees(np.arccos([east, north, up] @ normal)), abs=0.5)
    assert values["bistatic_angle"][middle] == pytest.approx(np.degrees(np.arccos(to_tx @ to_rx)), abs=0.3)
    assert not values["mask"].any()  # the slope is smaller than the incidence angle: no layover


@pytest.mark.slow
def test_constant_dem_gives_the_image_of_flat_terrain(finished_tiny, tmp_path):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    shutil.rmtree(root / "results")
    write_plane(root, slope=0.0)
    edit_scene(root, dem="dem.tif", dem_datum="ellipsoid", height_m=-99.0)
    campaign = process(root, last="cube")
    one, other = (
        open_stage(which.stage("image", "f01", "uav1-uav2"), "image").image.values
        for which in (campaign, finished_tiny)
    )
    assert np.abs(one - other).max() < 1e-3 * np.abs(other).max()


def test_undulation_is_added_to_geoid_heights(shared, tiny):
    shutil.copyfile(shared / "dem_isce3" / "egm96_15.gtx", tiny / "egm96_15.gtx")
    campaign = edit_scene(tiny, height_m=572.0, height_datum="egm96", geoid="egm96_15.gtx")
    path = scene.scene(campaign)
    settled = json.loads(path.read_text())
    assert settled["height_m"] - 572.0 == pytest.approx(UNDULATION_M, abs=0.01)
    assert settled["inputs"] == {"geoid": hashlib.sha256((tiny / "egm96_15.gtx").read_bytes()).hexdigest()}


@pytest.mark.slow
@pytest.mark.parametrize("has_stage", [True, False])
def test_plan_predicts_the_profiles_of_a_hillside(hillside, has_stage, tmp_path):
    """The numbers of samples and table bytes are those for the terrain, from the stage or from the DEM alone."""
    root = copy_writable(hillside.root, tmp_path / "campaign")
    if not has_stage:
        (root / "results" / "terrain.manifest.json").unlink()
    campaign, pair = Campaign.load(root), ("f01", "uav1-uav2")
    opened, profiles = open_pair(campaign, *pair), open_stage(campaign.stage("profile", *pair), "profile")
    hill = expected_scene(campaign, partial(getattr, opened, "flown"))
    level = replace(hill, terrain=hill.level)
    assert job_of(campaign, opened, hill).signal.samples == profiles.sizes["range"]
    assert job_of(campaign, opened, level).signal.samples != profiles.sizes["range"]
    plan = expected_plan(campaign, *pair)
    tables = load_engine(plan.engine).prepare(plan.inputs(profiles_of(profiles)), **plan.setting.options)
    assert plan.setting.table_bytes == (tables.cells if plan.engine == "native" else tables.samples).nbytes


@pytest.mark.slow
def test_opened_echo_is_not_read_again(hillside, tmp_path):
    """The pair is opened and planned from the arrays in memory, even if the stage is deleted."""
    campaign = Campaign.load(copy_writable(hillside.root, tmp_path / "campaign"))
    echo = PairEcho.opened(campaign, *PAIR).stage.load()
    shutil.rmtree(str(campaign.stage("echo", *PAIR)))
    opened = open_pair(campaign, *PAIR, echo=echo)
    assert np.shares_memory(opened.history.transfer, echo.transfer.values)
    planned = plan_pair(campaign, opened, open_scene(campaign))
    assert planned.setting == plan_pair(hillside, open_pair(hillside, *PAIR), open_scene(hillside)).setting


# Bad input


def test_dem_without_datum_is_refused(tiny):
    write_plane(tiny)
    message = complaint(lambda: edit_scene(tiny, dem="dem.tif"))
    assert "dem_datum" in message
    assert "has no default" in message
    assert "stated without dem" in complaint(lambda: edit_scene(tiny, dem=None, dem_datum="egm96"))


def test_missing_dem_is_reported_before_a_run(tiny):
    campaign = edit_scene(tiny, dem="terrain/dem.tif", dem_datum="ellipsoid")
    message = complaint(lambda: require_files(campaign))
    assert "terrain/dem.tif: no such file" in message
    assert "scene.dem" in message


def test_void_in_the_scene_is_reported_with_count_and_position(tiny):
    write_plane(tiny, void=np.nan)
    campaign = edit_scene(tiny, dem="dem.tif", dem_datum="ellipsoid")
    planned = complaint(lambda: expected_plan(campaign, *PAIR))  # before any step runs
    message = complaint(lambda: process(campaign, first="scene", last="terrain"))
    assert planned == message
    assert "of 3600 pixels" in message
    assert "first at x " in message
    assert not (tiny / "results" / "terrain.zarr").exists()
    write_plane(tiny)  # with the corrected DEM, unfinished work with the old DEM is discarded
    process(campaign, first="scene", last="terrain")
    assert np.isfinite(open_stage(campaign.stage("terrain"), "terrain").height.values).all()


def test_dem_that_misses_part_of_the_scene_is_refused(tiny):
    write_plane(tiny)
    bounds = Campaign.load(tiny).settings.scene.bounds_m
    campaign = edit_scene(
        tiny, dem="dem.tif", dem_datum="ellipsoid", bounds_m=[bounds[0], bounds[1], bounds[2] + 40, bounds[3]]
    )
    message = complaint(lambda: scene.scene(campaign))
    assert "% of the scene lies outside the DEM, to the east" in message


def test_dem_of_the_scene_suffices_with_configured_bounds(tiny):
    """The terrain height below the track is needed only for automatic bounds."""
    write_plane(tiny, keep=slice(16, 25))
    for spacing_m in (Campaign.load(tiny).settings.scene.spacing_m, "auto"):
        campaign = edit_scene(tiny, dem="dem.tif", dem_datum="ellipsoid", spacing_m=spacing_m)
        opened = open_pair(campaign, *PAIR)
        expected = expected_scene(campaign, partial(getattr, opened, "flown"))
        assert expected.level.height_m == pytest.approx(620.0, abs=0.1)
        assert not np.isfinite(expected.terrain.dem.heights(pixel_below_track(expected.grid, opened)))
    campaign = edit_scene(tiny, bounds_m="auto")
    message = complaint(lambda: expected_plan(campaign, *PAIR))
    assert "below the track, required for scene.bounds_m: auto" in message
    assert "% of the scene" not in message


def pixel_below_track(grid, opened):
    """Return the grid of one pixel below the midpoint of the track."""
    x, y, _ = projected_from_ecef(grid.crs, np.median(np.concatenate(opened.aperture.legs), axis=0))
    return SceneGrid(grid.crs, x - 0.5, y + 0.5, 1.0, (1, 1))


@pytest.mark.parametrize("spacing_m", [0.1, "auto"])
def test_plan_and_run_report_a_partial_dem_alike(tiny, spacing_m):
    write_plane(tiny, keep=(slice(None), slice(20, None)))
    campaign = edit_scene(tiny, dem="dem.tif", dem_datum="ellipsoid", spacing_m=spacing_m)
    message = complaint(lambda: expected_plan(campaign, *PAIR))
    share, rest = message.split(": ", 1)[1].split(" % of the scene lies outside the DEM, ")
    assert rest.startswith("to the west: ")
    (west, _, east, _), (start, *_) = campaign.settings.scene.bounds_m, rasterio.open(tiny / "dem.tif").bounds
    assert float(share) == pytest.approx(100 * (start - west) / (east - west), abs=1.0)
    if spacing_m != "auto":
        assert complaint(lambda: scene.scene(campaign)) == message


def test_narrow_scene_has_the_mean_height_of_its_dem(tiny):
    write_plane(tiny, slope=0.0, height_m=623.0)
    bounds_m = Campaign.load(tiny).settings.scene.bounds_m
    settings = edit_scene(tiny, dem="dem.tif", dem_datum="ellipsoid").settings.scene
    strip = SceneGrid("EPSG:32632", bounds_m[0], bounds_m[3], 0.1, (1, 100))
    assert ConfiguredGround.of(settings, {"dem": tiny / settings.dem}, crs=strip.crs).level(strip).height_m == 623.0


def test_undeclared_void_is_an_impossible_height(tiny):
    """Values of -9999 without a nodata tag are refused wherever the DEM is first read."""
    write_plane(tiny, void=-9999.0)
    campaign = edit_scene(tiny, dem="dem.tif", dem_datum="ellipsoid")
    for read in (lambda: expected_plan(campaign, *PAIR), lambda: process(campaign, first="scene", last="terrain")):
        message = complaint(read)
        assert "dem.tif: 1 of the " in message
        assert "impossible heights, most frequently -9999 m" in message
        assert "nodata" in message


@pytest.mark.slow
def test_dem_above_the_antennas_is_flagged_and_flat_terrain_refused(tiny):
    """A radar next to a hill may be directed upwards, so that a higher DEM is not an error; 620 m are 2034 ft."""
    write_plane(tiny, height_m=620.0 / 0.3048)
    campaign = edit_scene(tiny, dem="dem.tif", dem_datum="ellipsoid")
    message = complaint(lambda: expected_plan(campaign, *PAIR))  # out of range of the echoes
    assert "unit and datum of scene.dem" in message
    write_plane(tiny, height_m=680.0)
    assert "below the lowest terrain of the scene" in expected_plan(campaign, *PAIR).flags["platform_below_scene"]
    campaign = edit_scene(tiny, dem=None, dem_datum=None, height_m=2034.0)
    message = complaint(lambda: expected_plan(campaign, *PAIR))
    assert message.startswith("scene.height_m: ")
    assert "terrain height 2034.00 m" in message


def test_command_line_names_the_file_of_a_key(tiny, monkeypatch, capsys):
    """Error messages of library functions contain the key only, because their Python callers have no config file."""
    edit_scene(tiny, height_m=2034.0)
    monkeypatch.setattr("sys.argv", ["apertura", "plan", str(tiny)])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert capsys.readouterr().err.startswith("error: config/config.yaml: scene.height_m: ")


@pytest.mark.slow
def test_platform_below_the_terrain_is_refused_with_its_pulse(hillside, tmp_path):
    """Move the hill above the track and extend the scene to cover it."""
    root = copy_writable(hillside.root, tmp_path / "campaign")
    bounds = [
        round(edge + by, 6) for edge, by in zip(hillside.settings.scene.bounds_m, (-12, -12, 12, 12), strict=True)
    ]
    write_plane(root, slope=-1.5 * SLOPE)
    shutil.rmtree(root / "results")
    campaign = edit_scene(root, bounds_m=bounds)
    planned = complaint(lambda: expected_plan(campaign, "f01", "uav1-uav1"))  # before any step runs
    assert "flight f01, pair uav1-uav1: at " in planned
    assert "transmitter is at or below the terrain" in planned
    shutil.copytree(str(hillside.results / "f01"), str(root / "results" / "f01"))
    process(campaign, first="scene", last="terrain")
    message = complaint(lambda: profile.profile(campaign, "f01", "uav1-uav1"))
    assert message.split(", worst")[0].split(": at ")[0] == planned.split(": at ")[0]
    assert "transmitter is at or below the terrain" in message
    assert "worst at pulse" in message


def test_terrain_step_without_dem_is_refused(tiny):
    campaign = Campaign.load(tiny)
    scene.scene(campaign)
    assert "scene.dem: no DEM" in complaint(lambda: scene.terrain(campaign))
