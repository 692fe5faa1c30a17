"""Chart of the whole workflow: error against processing time from raw samples to GeoTIFFs."""

import csv

import pytest
from folders import copy_writable

from apertura.campaign.folder import Campaign
from apertura.tools.chart.whole import Whole, draw_whole, spread_db, whole_chart


def whole(setting="a", *, loss_db=-0.1):
    return Whole(setting, 4.0, 3.9, 4.2, 11.0, 2, 5.0, -0.01, loss_db, 0.02, -70.0, "")


def test_peak_loss_of_3_db_spreads_half_of_the_power():
    assert spread_db(-3.0103) == pytest.approx(-3.0103, abs=1e-3)
    assert spread_db(0.2) == spread_db(0.0) < -100


@pytest.mark.slow
def test_chart_is_reproducible(tmp_path):
    rows = [whole(), whole("b", loss_db=float("nan"))]
    for name in ("a.png", "b.png"):
        draw_whole(rows, tmp_path / name, title="a campaign", refused=["presum 2"])
    draw_whole(rows, tmp_path / "c.png", title="a campaign", refused=[])
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a.png").read_bytes() != (tmp_path / "c.png").read_bytes()


@pytest.mark.slow
def test_every_setting_is_processed_and_intermediate_results_are_deleted(finished_tiny, tmp_path):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    image = (root / "results" / "f01" / "uav1-uav2" / "slc.tif").read_bytes()
    paths = whole_chart(Campaign.load(root), repeats=1)
    rows = {row["setting"]: row for row in csv.DictReader(paths[0].open(encoding="utf-8"))}
    assert float(rows["accuracy −90 dB"]["numerical_error_db"]) < -90
    assert float(rows["accuracy −30 dB"]["numerical_error_db"]) > -90
    assert {"as configured", "sidelink divide"} <= set(rows)
    assert not {"DEM", "level ground"} & set(rows)  # there is no DEM
    assert all(float(row["seconds"]) > 0 for row in rows.values())
    assert not (root / "results" / "study" / "whole").exists()
    assert (root / "results" / "f01" / "uav1-uav2" / "slc.tif").read_bytes() == image
    assert paths[1].read_bytes().startswith(b"\x89PNG")
