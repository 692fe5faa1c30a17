"""Changes of a flight of a small stack: rasters, polygons, report, map, and bytes that do not depend on the time."""

import json
import sqlite3
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from folders import complaint, contents, copy_writable, edit_config
from test_40_graph import check

from apertura.campaign.folder import Campaign
from apertura.formats.export.change import COLUMNS, NO_DATA
from apertura.run.process import process
from apertura.simulation import Clutter, ImageGrid, PointTarget, TargetChange, simulate
from apertura.simulation.presets import revisit
from apertura.stages.change import change
from apertura.views.summary import print_summary
from apertura.views.verify.chain import print_verified
from apertura.workflow.lineage import result_of

PAIR, WINDOW, HALF_M, SPACING_M = "uav1-uav1", 11, 6.0, 0.125
APPEARED, VANISHED = (-2.5, 2.0), (2.5, -2.0)


def revisited():
    """Return two flights; in the second one, a target has appeared and another has vanished."""
    flown = revisit(flights=2, slope_mm=0.0, pulses=60, error_m=0.004)
    targets = (
        Clutter((-7.0, -7.0, 7.0, 7.0), 1.0, 25.0),
        *(PointTarget((*at, 0.0), 6.0) for at in (APPEARED, VANISHED)),
    )
    absent = (TargetChange(1, factor=0.0),), (TargetChange(2, factor=0.0),)
    flights = [replace(flight, changes=gone) for flight, gone in zip(flown.flights, absent, strict=True)]
    grid = ImageGrid("EPSG:32632", half_width_m=HALF_M, spacing_m=SPACING_M)
    return replace(flown, targets=targets, flights=tuple(flights), scene=grid)


def configure(config):
    config["processing"] = {"autofocus": "off"}
    config["stack"] = {"reference": "f01", "flights": ["f02"], "pair": PAIR, "window_px": WINDOW}


@pytest.fixture(scope="module")
def small(made_once):
    def made(root):
        simulate(root, revisited())
        edit_config(root, configure)
        process(root)

    return made_once("change", made)


def results(root):
    return root / "results/stack/f02"


def report_of(root):
    return json.loads((results(root) / "change.json").read_text())


def offset_m(region, transform, shape):
    """Return the position of a region relative to the scene centre, east and north."""
    middle = transform @ (shape[1] / 2, shape[0] / 2)
    return np.array([region["x_m"] - middle[0], region["y_m"] - middle[1]])


@pytest.mark.slow
def test_appeared_and_vanished_targets_are_regions(small):
    report = report_of(small)
    with rasterio.open(results(small) / "change.tif") as raster:
        classes, transform = raster.read(1), raster.transform
        assert raster.tags()["APERTURA_CHANGE"] == report["says"]
    certain = {region["kind"]: region for region in report["regions"] if region["confidence"] > 0.99}
    assert certain.keys() == {"brighter", "darker"}
    for kind, place in (("brighter", APPEARED), ("darker", VANISHED)):
        away = offset_m(certain[kind], transform, classes.shape) - place
        assert np.abs(away).max() < WINDOW * SPACING_M
    for value, name in ((0, "unchanged"), (1, "brighter"), (2, "darker"), (3, "coherent change")):
        assert (classes == value).sum() == report["pixels"][name]
    with rasterio.open(results(small) / "amplitude_ratio.tif") as ratio:
        assert np.array_equal(np.isnan(ratio.read(1)), classes == NO_DATA)


@pytest.mark.slow
def test_polygons_have_the_area_of_their_regions(small):
    report = report_of(small)
    with sqlite3.connect(results(small) / "change_regions.gpkg") as database:
        rows = database.execute("SELECT kind, area_m2, flight FROM change_regions ORDER BY fid").fetchall()
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert [row[1] for row in database.execute("PRAGMA table_info(change_regions)")] == ["fid", "geom", *COLUMNS]
    assert rows == [(region["kind"], region["area_m2"], "f02") for region in report["regions"]]
    changed = sum(count for name, count in report["pixels"].items() if name != "unchanged")
    assert sum(area for _, area, _ in rows) == pytest.approx(changed * SPACING_M**2, abs=1e-4 * len(rows))  # rounded


@pytest.mark.slow
def test_changes_are_in_map_and_summary(small, capsys):
    document = json.loads((small / "results/map/map.json").read_text())
    (image,) = (image for image in document["images"] if image["flight"] == "f02")
    urls = {layer["file"]: layer["url"] for layer in image["layers"]}
    for name in ("amplitude_ratio.tif", "coherence_loss.tif", "change.tif"):
        assert urls[name].startswith(f"../stack/f02/{name}?sha256=")
    assert "amplitude_ratio.tif" not in {
        layer["file"] for image in document["images"] if image["flight"] == "f01" for layer in image["layers"]
    }
    print_summary(Campaign.load(small))
    assert f"changes f02: {report_of(small)['says']}" in " ".join(capsys.readouterr().out.split())
    print_verified(small, [results(small) / "change.tif"])


@pytest.mark.slow
def test_changes_are_reproduced_byte_for_byte(small, tmp_path):
    again = copy_writable(small, tmp_path / "again")
    before = contents(results(again))
    change(Campaign.load(again), "f02")
    assert contents(results(again)) == before


@pytest.mark.slow
def test_smallest_area_limits_the_regions_only(small, tmp_path):
    again = copy_writable(small, tmp_path / "again")
    edit_config(again, lambda config: config["stack"].update(change={"smallest_m2": 1e4}))
    change(Campaign.load(again), "f02")
    assert report_of(again)["pixels"] == report_of(small)["pixels"]
    assert report_of(again)["regions"] == []


@pytest.mark.slow
def test_rules_of_changes_match_lineage(small, tmp_path):
    root = copy_writable(small, tmp_path / "again")
    assert check(root, "results/f02/page.manifest.json") >= {"change"}
    campaign = Campaign.load(root)
    sources = set(result_of(campaign, "change", "f02").sources)
    assert {f"results/stack/{flight}/stack_image.manifest.json" for flight in ("f01", "f02")} <= sources
    assert "results/stack/f02/change.manifest.json" in result_of(campaign, "page", "f02").sources
    assert "no change of f01" in complaint(lambda: change(campaign, "f01"))


@pytest.mark.parametrize(
    ("requested", "expected"),
    [({"false_alarm_rate": 0}, "stack.change.false_alarm_rate"), ({"smallest_m2": -1}, "stack.change.smallest_m2")],
)
def test_invalid_settings_are_refused(tiny, requested, expected):
    stack = {"reference": "f01", "flights": ["f02"], "pair": PAIR, "change": requested}
    edit_config(tiny, lambda config: config.update(stack=stack))
    assert expected in complaint(lambda: Campaign.load(tiny))
