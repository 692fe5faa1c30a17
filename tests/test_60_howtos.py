"""How-tos that create their own data: every code block runs and prints the output shown."""

import re
from pathlib import Path

import nbformat
import pytest
from walked import blocks, walk

from website.notebooks import PAGES

HOWTOS = Path(__file__).parents[1] / "docs/howto"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bench", "calibration_flight", "dem", "gis", "notebook"])
def test_code_blocks_of_a_how_to_print_what_they_show(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert len(list(blocks(HOWTOS / f"{name}.md"))) > 1
    walk(HOWTOS / f"{name}.md")


@pytest.mark.parametrize("name", PAGES)
def test_notebook_has_the_blocks_outputs_and_links_of_its_page(name):
    """The blocks of these pages are run by the test above, `test_60_tutorial` and `test_48_cube`."""
    docs = HOWTOS.parent
    page = docs / f"{name}.md"
    path = docs / "notebooks" / f"{page.stem}.ipynb"
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    expected = [
        block.replace("$ ", "!").rstrip("\n") if kind == "console" else block.rstrip("\n")
        for _, kind, block, _ in blocks(page)
    ]
    assert [cell.source for cell in cells] == expected
    printed = ["".join(output.text for output in cell.outputs) for cell in cells]
    assert printed == [shown for *_, shown in blocks(page)]
    text = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    links = re.findall(r"\]\((?!https?:)([^)#]+)", text)
    assert links
    assert not [link for link in links if not (path.parent / link).exists()]
