"""The tutorial runs as it stands: every block in order, and what it shows is what it prints."""

from pathlib import Path

import pytest
import rasterio
from walked import walk

from apertura.focus.engines import native

TUTORIAL = Path(__file__).parents[1] / "docs/tutorial.md"


@pytest.mark.skipif(not native.available(), reason="the plan that is shown takes the compiled engine")
def test_every_block_of_the_tutorial_runs_and_prints_what_it_shows(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = walk(TUTORIAL)
    with rasterio.open(tmp_path / "both.tif") as raster:
        certified = [pair.attrs["numerical_error_db"] for pair in names["pairs"]]
        assert raster.tags()["APERTURA_ERROR_DB"] == f"{max(certified):.2f}"
