"""Access to a finished campaign from Python: pairs, stages, images, reports and flags."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from folders import complaint, copy_writable, edit_config

from apertura.campaign.folder import Campaign
from apertura.campaign.store import record_files
from apertura.common.errors import CampaignError
from apertura.run.process import process
from apertura.stages import echo, scene
from apertura.stages.pair import open_pair
from apertura.stages.scene import expected_scene, settled_scene
from apertura.tools.open_campaign import OpenCampaign, open_campaign
from apertura.views.plan import first_flight
from apertura.views.score import score

PAIR = ("f01", "uav1-uav2")


@pytest.fixture
def opened(finished_tiny) -> OpenCampaign:
    return open_campaign(finished_tiny.root)


def test_pairs_are_those_of_the_image_flights(opened):
    assert opened.pairs == {"f01": ("uav1-uav1", "uav1-uav2")}


def test_image_equals_the_raster_on_the_same_grid(opened):
    image = opened.image(*PAIR)
    with rasterio.open(str(opened.campaign.results / "f01" / "uav1-uav2" / "slc.tif")) as raster:
        np.testing.assert_array_equal(image.values, raster.read(1))
        assert (raster.transform.c, raster.transform.f) == (opened.scene.grid.west_m, opened.scene.grid.north_m)
        assert raster.transform.a == opened.scene.grid.spacing_m
        middle = raster.xy(0, 0)
    assert (float(image.x[0]), float(image.y[0])) == pytest.approx(middle, abs=1e-6)
    assert "UTM zone 32N" in image.spatial_ref.attrs["crs_wkt"]


def test_stages_are_opened_by_name_and_identifiers(opened):
    assert opened.stage("raw", "f01", "uav1").attrs["node"] == "uav1"
    assert opened.stage("echo", *PAIR).sizes["subcarrier"] == 1024
    assert opened.stage("profile", *PAIR).sizes["pulse"] == opened.stage("echo", *PAIR).sizes["pulse"]
    assert opened.stage("cube").attrs["pairs"] == ["uav1-uav1", "uav1-uav2"]


def test_report_is_image_json_of_a_pair_or_of_the_fused_image(finished_tiny, tmp_path):
    opened = open_campaign(copy_writable(finished_tiny.root, tmp_path / "campaign"))
    for pair in ("uav1-uav2", "fused"):
        path = opened.campaign.results / "f01" / pair / "image.json"
        written = json.loads(path.read_text()) | {"flags": {"clipped": f"in {pair}"}}
        path.write_text(json.dumps(written))
        record_files(path.with_name("export.manifest.json"), [path])
        assert opened.report("f01", pair) == written
        assert opened.flags("f01", pair) == {"clipped": f"in {pair}"}


def test_missing_result_is_named(finished_tiny, tmp_path):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    shutil.rmtree(root / "results" / "f01" / "uav1-uav2")
    opened = open_campaign(root)
    with pytest.raises(CampaignError, match=r"image\.json: no such file; .*Run the workflow first"):
        opened.report(*PAIR)
    with pytest.raises(CampaignError, match=r"uav1-uav2"):
        opened.image(*PAIR)
    assert opened.report("f01", "uav1-uav1")["engine"]


def test_missing_scene_before_the_first_run_is_reported_with_a_remedy(tiny):
    opened = open_campaign(tiny)
    for work in (lambda: opened.scene, lambda: score(opened.campaign)):
        message = complaint(work)
        assert message.startswith(f"{tiny}/results/scene.json: the result is missing or unfinished")
        assert "`apertura run`" in message
    message = complaint(lambda: opened.stage("echo", *PAIR))
    assert "Run the workflow" in message
    assert "Delete" not in message


def test_unknown_name_is_refused_with_the_list_of_names(opened):
    names = "expected one of raw, track, echo, transfer, profile, refined_track, terrain, image, cube."
    assert names in complaint(lambda: opened.stage("ecko", *PAIR))
    assert "no flight 'f02'; expected one of f01." in complaint(lambda: opened.stage("echo", "f02", "uav1-uav2"))
    pairs = "no pair 'uav2-uav1'; expected one of uav1-uav1, uav1-uav2"
    assert f"{pairs}." in complaint(lambda: opened.image("f01", "uav2-uav1"))
    assert f"{pairs}, fused." in complaint(lambda: opened.flags("f01", "uav2-uav1"))
    assert "no flight 'f02'" in complaint(lambda: opened.report("f02", "fused"))
    assert "no node 'uav3'; expected one of uav1, uav2." in complaint(lambda: opened.stage("raw", "f01", "uav3"))


def test_missing_identifiers_of_a_stage_are_reported(opened):
    message = complaint(lambda: opened.stage("echo", "f01"))
    assert "campaign.stage('echo'): arguments: f01; expected a flight and a pair" in message
    assert "arguments: none; expected a flight and a node" in complaint(lambda: opened.stage("raw"))
    assert "arguments: f01; expected no further arguments" in complaint(lambda: opened.stage("cube", "f01"))


def test_planned_grid_equals_the_grid_of_the_workflow(tiny):
    """Automatic bounds cover all pairs of the first image flight, not only the planned pair."""
    edit_config(tiny, lambda document: document["scene"].update(bounds_m="auto", spacing_m="auto"))
    campaign = Campaign.load(tiny)
    expected = expected_scene(campaign, lambda: first_flight(campaign)).grid
    process(campaign, last="ingest")
    for pair in ("uav1-uav1", "uav1-uav2"):
        echo.echo(campaign, "f01", pair)
    scene.scene(campaign)
    assert settled_scene(campaign).grid == expected


@pytest.mark.quick("uav1-uav2")
@pytest.mark.parametrize("pair", ["uav1-uav1", "uav1-uav2"])
def test_path_limit_of_the_prefix_equals_the_planned_one(tiny, pair):
    """The prefix may limit automatic bounds: path offsets and sidelink length are included even without an echo."""
    campaign = Campaign.load(tiny)
    expected_m = open_pair(campaign, "f01", pair).path_limit_m
    process(campaign, last="ingest")
    echo.echo(campaign, "f01", pair)
    assert open_pair(campaign, "f01", pair).path_limit_m == pytest.approx(expected_m, abs=0.05)


def test_text_of_a_campaign_has_at_most_ten_lines(tiny):
    """Notebooks show the text of the last value of a cell."""
    campaign = Campaign.load(tiny)
    flight = campaign.flights[0]
    many = replace(campaign, flights=tuple(replace(flight, name=f"f{number:02d}") for number in range(1, 301)))
    assert repr(many) == f"<Campaign {campaign.settings.campaign} in {campaign.root}: 300 flights, nodes uav1, uav2>"
    lines = repr(OpenCampaign(many)).splitlines()
    assert len(lines) == 9
    assert lines[1] == "  f01: uav1-uav1, uav1-uav2"
    assert lines[-1] == "  and 293 more flights>"
    assert repr(OpenCampaign(campaign)).splitlines()[1:] == ["  f01: uav1-uav1, uav1-uav2>"]
