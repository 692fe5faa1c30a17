"""A flight of one pair: nothing is made of sums, and what people see names the pair."""

import json

import pystac
import pytest
from folders import complaint, copy_writable, run_steps

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.contracts import SUMMED
from apertura.formats.catalog import CATALOG
from apertura.formats.export import product_files
from apertura.stages.export import export_fused
from apertura.views.report.pictures import pictures, pictures_fused
from apertura.views.report.step import landing, page
from apertura.views.score import score
from apertura.views.summary import is_finished, print_summary
from apertura.workflow.lineage import places_of

PAIR = "uav1-uav1"


def of_one_node(root):
    """Leave the transmitter alone in a copy of the tiny campaign."""
    (root / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\tuav1\n")
    return root


@pytest.fixture(scope="session")
def alone(_tiny, made_once):
    """The tiny campaign with all its results, of the transmitter alone; read only."""
    return Campaign.load(made_once("alone", lambda root: run_steps(of_one_node(copy_writable(_tiny, root)))))


def test_no_result_no_source_and_no_file_is_of_sums(tiny):
    campaign = Campaign.load(of_one_node(tiny))
    assert {result for result, _, _ in places_of(campaign)}.isdisjoint({"fused", "pictures_fused"})
    assert not [one for _, _, result in places_of(campaign) for one in result.sources if "fused" in one]
    assert not [name for name in product_files(campaign.images, campaign.coefficients) if "fused" in name]
    for step in (export_fused, pictures_fused):
        assert "of f01" in complaint(lambda step=step: step(campaign, "f01"))


@pytest.mark.slow
def test_every_file_that_is_named_is_there_and_none_of_sums(alone):
    named = set(product_files(alone.images, alone.coefficients))
    assert not [name for name in named if not (alone.results / name).is_file()]
    assert not list(alone.results.rglob("*fused*"))


@pytest.mark.slow
def test_the_cube_the_catalog_and_the_map_hold_the_pair_alone(alone):
    cube = open_stage(alone.stage("cube"), "cube")
    assert not SUMMED & {*cube.variables}
    assert cube.attrs["fusion"] == {}
    assert cube.phase_removed.isnull().all()
    items = pystac.Catalog.from_file(str(alone.results / "stac" / CATALOG)).get_items(recursive=True)
    assert [item.id for item in items] == [f"f01-{PAIR}"]
    images = json.loads((alone.results / "map" / "map.json").read_text())["images"]
    assert [(one["flight"], one["image"]) for one in images] == [("f01", PAIR)]


@pytest.mark.slow
def test_score_summary_and_report_are_of_the_pair(alone, tmp_path, capsys):
    assert {one.image for one in score(alone)} == {PAIR}
    assert is_finished(alone)
    print_summary(alone)
    said = capsys.readouterr().out
    assert f"results/f01/{PAIR}/db.tif" in said
    assert "missing or out of date" not in said
    campaign = Campaign.load(copy_writable(alone.root, tmp_path / "campaign"))
    pictures(campaign, "f01", PAIR)
    assert page(campaign, "f01") == [campaign.result("f01", "report.html")]
    assert "Pairs and their sums" not in campaign.result("f01", "report.html").read_text()
    assert landing(campaign)["sentences"] == []
