"""Campaign of the Snakemake workflow catalogue in `.test/`: the workflow runs and gives a focused image."""

import json
import shutil
from pathlib import Path

import pytest
from folders import apertura, finished

CAMPAIGN = Path(__file__).parents[1] / ".test"


@pytest.mark.slow
def test_campaign_of_the_catalogue_gives_a_focused_image(tmp_path):
    ignored = shutil.ignore_patterns("results", ".snakemake")
    root = Path(shutil.copytree(CAMPAIGN, tmp_path / "campaign", ignore=ignored))
    code, output = finished(apertura("run", root))
    assert code == 0, output
    report = json.loads((root / "results/f01/fused/image.json").read_text())
    assert report["flags"] == {}
    assert report["focus"]["verdict"] == "focused"
    assert report["coherence"]["mean"] > 0.99
