"""How-tos that bring their own data run as they stand, and print what they show."""

from pathlib import Path

import pytest
from walked import blocks, walk

HOWTOS = Path(__file__).parents[1] / "docs/howto"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bench", "calibration_flight", "dem", "gis", "notebook"])
def test_every_block_of_a_how_to_runs_and_prints_what_it_shows(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert len(list(blocks(HOWTOS / f"{name}.md"))) > 1
    walk(HOWTOS / f"{name}.md")
