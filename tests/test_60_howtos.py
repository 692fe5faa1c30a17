"""How-tos that create their own data: every code block runs and prints the output shown."""

from pathlib import Path

import pytest
from walked import blocks, walk

HOWTOS = Path(__file__).parents[1] / "docs/howto"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bench", "calibration_flight", "dem", "gis", "notebook"])
def test_code_blocks_of_a_how_to_print_what_they_show(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert len(list(blocks(HOWTOS / f"{name}.md"))) > 1
    walk(HOWTOS / f"{name}.md")
