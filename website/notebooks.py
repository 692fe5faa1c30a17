"""Jupyter notebooks of the pages of docs/ whose code is Python; the tests run the blocks of the pages."""

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[1] / "docs"

_BLOCK = re.compile(r"^```(python|console)\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", re.M | re.S)
_LINK = re.compile(r"\]\((?!https?:|#|/)([^)]+)\)")
_LINE = re.compile(r"^\[This page as a notebook\].*\n\n", re.M)


PAGES = ("tutorial", *(f"howto/{name}" for name in ("bench", "calibration_flight", "dem", "gis", "notebook", "xarray")))
"""Pages that create their own data, so that their notebooks run as they are; the tests run all their blocks."""


def notebook(page: Path) -> str:
    """Return a page as a notebook in nbformat 4.5: text, code, and the output shown below each block."""
    text = _LINE.sub("", page.read_text(encoding="utf-8"))
    cells: list[dict[str, Any]] = []
    end = 0
    for block in _BLOCK.finditer(text):
        _add_text(cells, text[end : block.start()], page)
        _add_code(cells, *block.groups())
        end = block.end()
    _add_text(cells, text[end:], page)
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number:02d}"
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    document = {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(document, ensure_ascii=False, indent=1, sort_keys=True) + "\n"


def _add_text(cells: list[dict[str, Any]], text: str, page: Path) -> None:
    if text.strip():
        folder = page.parent.relative_to(DOCS)
        moved = _LINK.sub(lambda link: f"]({_from_notebooks(folder, link[1])})", text.strip())
        cells.append({"cell_type": "markdown", "metadata": {}, "source": moved.splitlines(keepends=True)})


def _from_notebooks(folder: Path, target: str) -> str:
    """Return a link of a page in `folder`, relative to docs/notebooks."""
    parts: list[str] = []
    for part in (*folder.parts, *target.split("/")):
        if part == ".." and parts and parts[-1] != "..":
            parts.pop()
        elif part != ".":
            parts.append(part)
    return "/".join(("..", *parts))


def _add_code(cells: list[dict[str, Any]], kind: str, code: str, shown: str | None) -> None:
    source = code.rstrip("\n")
    if kind == "console":
        source = "\n".join(f"!{line.removeprefix('$ ')}" for line in source.splitlines())
    output = {"name": "stdout", "output_type": "stream", "text": (shown or "").splitlines(keepends=True)}
    cells.append(
        {
            "cell_type": "code",
            "execution_count": None,
            "metadata": {},
            "outputs": [output] if shown else [],
            "source": source.splitlines(keepends=True),
        }
    )


def notebook_pages() -> dict[str, Any]:
    """Return notebook → function that returns its content."""
    pages = [DOCS / f"{name}.md" for name in PAGES]
    return {f"docs/notebooks/{page.stem}.ipynb": partial(notebook, page) for page in pages}
