"""Flights of one pair: no results of sums exist, and catalog, map, summary and report list the pair."""

import json

import pystac
import pytest
from folders import complaint, copy_writable

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.contracts import SUMMED
from apertura.formats.catalog import CATALOG
from apertura.formats.export import product_files
from apertura.run.process import process
from apertura.stages.export import export_fused
from apertura.views.report.pictures import pictures, pictures_fused
from apertura.views.report.step import landing, page
from apertura.views.score import score
from apertura.views.summary import is_finished, print_summary
from apertura.workflow.lineage import places_of

PAIR = "uav1-uav1"


def keep_one_node(root):
    """Reduce a copy of the tiny campaign to its transmitter."""
    (root / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\tuav1\n")
    return root


@pytest.fixture(scope="session")
def alone(_tiny, made_once):
    """Return the tiny campaign with the transmitter only and all its results; read only."""
    return Campaign.load(made_once("alone", lambda root: process(keep_one_node(copy_writable(_tiny, root)))))


def test_single_pair_has_no_results_of_sums(tiny):
    campaign = Campaign.load(keep_one_node(tiny))
    assert {result for result, _, _ in places_of(campaign)}.isdisjoint({"fused", "pictures_fused"})
    assert not [source for _, _, result in places_of(campaign) for source in result.sources if "fused" in source]
    assert not [name for name in product_files(campaign.images, campaign.coefficients) if "fused" in name]
    for step in (export_fused, pictures_fused):
        assert "of f01" in complaint(lambda step=step: step(campaign, "f01"))


@pytest.mark.slow
def test_listed_products_exist_and_none_is_of_sums(alone):
    products = set(product_files(alone.images, alone.coefficients))
    assert not [name for name in products if not (alone.results / name).is_file()]
    assert not list(alone.results.rglob("*fused*"))


@pytest.mark.slow
def test_cube_catalog_and_map_contain_only_the_pair(alone):
    cube = open_stage(alone.stage("cube"), "cube")
    assert not SUMMED & {*cube.variables}
    assert cube.attrs["fusion"] == {}
    assert cube.phase_removed.isnull().all()
    items = pystac.Catalog.from_file(str(alone.results / "stac" / CATALOG)).get_items(recursive=True)
    assert [item.id for item in items] == [f"f01-{PAIR}"]
    images = json.loads((alone.results / "map" / "map.json").read_text())["images"]
    assert [(image["flight"], image["image"]) for image in images] == [("f01", PAIR)]


@pytest.mark.slow
def test_score_summary_and_report_list_the_pair(alone, tmp_path, capsys):
    assert {finding.image for finding in score(alone)} == {PAIR}
    assert is_finished(alone)
    print_summary(alone)
    printed = capsys.readouterr().out
    assert f"results/f01/{PAIR}/db.tif" in printed
    assert "missing or out of date" not in printed
    campaign = Campaign.load(copy_writable(alone.root, tmp_path / "campaign"))
    pictures(campaign, "f01", PAIR)
    assert page(campaign, "f01") == [campaign.result("f01", "report.html")]
    assert "Pairs and sums" not in campaign.result("f01", "report.html").read_text()
    assert landing(campaign)["sentences"] == []
