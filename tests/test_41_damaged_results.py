"""Damaged results: the message contains the file and the remedy."""

import re

import pytest
from folders import complaint, edit_config

from apertura.campaign.folder import Campaign
from apertura.campaign.store import manifest_of, record_files, save_document
from apertura.stages.agreement import assessment_of
from apertura.stages.calibration import calibrated
from apertura.stages.scene import settled_scene
from apertura.tools.open_campaign import open_campaign
from apertura.views.score import score
from apertura.views.summary import print_summary

DAMAGE = [b"", b"{", b"[]", b"{}", b'{"grid": 3}', b"\xff", b"null", b'{"pairs": 3}', b'{"pairs": {"uav1-uav2": {}}}']


@pytest.mark.parametrize("content", DAMAGE)
def test_damaged_result_is_reported_with_remedy(tiny, content):
    edit_config(
        tiny,
        lambda document: document.update(calibration={"flight": "c01", "reflector_m": [570660.0, 5363700.0, 620.0]}),
    )
    (tiny / "config" / "flights.tsv").write_text(
        "flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\tuav1,uav2\nc01\tcalibration\tuav1\tuav1,uav2\n"
    )
    campaign, results = Campaign.load(tiny), tiny / "results"
    readers = {
        "scene.json": lambda: settled_scene(campaign),
        "c01/calibration.json": lambda: calibrated(campaign, "f01", "uav1-uav2"),
        "f01/assessment.json": lambda: assessment_of(campaign, "f01"),
        "f01/uav1-uav1/image.json": lambda: print_summary(campaign),
    }
    for name, read in readers.items():
        assert "no such file" in complaint(read) or "missing or unfinished" in complaint(read)
        (results / name).parent.mkdir(parents=True, exist_ok=True)
        (results / name).write_bytes(content)
        manifest = manifest_of(results / name)
        if name.endswith("image.json"):
            manifest = manifest.with_name("export.manifest.json")
        record_files(manifest, [results / name])  # a manifest that matches the damaged file
        message = complaint(read)
        assert f"results/{name}: " in message
        assert re.search(r"(Delete .* and r|R)un the workflow again", message) or content == b"\xff"
    if content in {b"", b"{", b"[]", b"null"}:
        assert "image.json: damaged" in complaint(lambda: open_campaign(tiny).report("f01", "uav1-uav1"))


def test_scene_with_invalid_grid_is_damaged(tmp_path):
    grid = {
        "crs": "EPSG:32632",
        "west_m": 0,
        "north_m": 0,
        "spacing_m": 1,
        "shape": [2, 2],
        "first": [0, 0],
        "name": "x",
    }
    document = {"grid": grid, "height_m": 1.0, "inputs": {}, "chosen": {}}
    path = tmp_path / "results" / "scene.json"
    path.parent.mkdir()
    save_document(path, document)
    campaign = Campaign(tmp_path, None, ())
    assert settled_scene(campaign).grid.shape == (2, 2)
    for change in ({"spacing_m": -1}, {"shape": [1e308, 2]}, {"shape": [0, 2]}, {"west_m": "x"}, {"crs": None}):
        save_document(path, document | {"grid": grid | change})
        assert "scene.json: damaged" in complaint(lambda: settled_scene(campaign))


def test_damaged_truth_is_one_message(tiny):
    (tiny / "truth.json").write_text('{"targets": [{"x": "left"}]}')
    assert "truth.json: damaged" in complaint(lambda: score(Campaign.load(tiny)))
