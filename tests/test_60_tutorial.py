"""The tutorial runs as it stands: every block in order, and what it shows is what it prints."""

import os
import re
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest
import rasterio

from apertura.focus.engines import native

TUTORIAL = Path(__file__).parents[1] / "docs/tutorial.md"
NUMBER = re.compile(r"-?\d+\.\d+(?:e-?\d+)?")


def blocks():
    """Yield (line, kind, block, shown) of the tutorial: shown is the output that stands below the block."""
    text = TUTORIAL.read_text(encoding="utf-8")
    for block in re.finditer(r"^```(python|console)\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", text, re.M | re.S):
        yield text.count("\n", 0, block.start()) + 2, block[1], block[2], block[3] or ""


def run_commands(block):
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for line in block.splitlines():
        assert line.startswith("$ ")
        command = line.removeprefix("$ ").split()
        done = subprocess.run(command, env={**os.environ, "PATH": path}, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


def parts(text):
    """Return the words of a text with a mark for every number that has a decimal point, and these numbers."""
    return NUMBER.sub("#", text).split(), [float(number) for number in NUMBER.findall(text)]


@pytest.mark.skipif(not native.available(), reason="the plan that is shown takes the compiled engine")
def test_every_block_of_the_tutorial_runs_and_prints_what_it_shows(tmp_path, monkeypatch):
    """Words and whole numbers are the same; numbers with a decimal point differ by 5 % at most."""
    monkeypatch.chdir(tmp_path)
    names = {}
    for line, kind, block, shown in blocks():
        printed = StringIO()
        if kind == "console":
            run_commands(block)
        else:
            with redirect_stdout(printed):
                exec(compile("\n" * (line - 1) + block, str(TUTORIAL), "exec"), names)
        (words, numbers), (shown_words, shown_numbers) = parts(printed.getvalue()), parts(shown)
        assert words == shown_words, f"{TUTORIAL.name}:{line} prints\n{printed.getvalue()}"
        assert numbers == pytest.approx(shown_numbers, rel=0.05), f"{TUTORIAL.name}:{line}"
    with rasterio.open(tmp_path / "both.tif") as raster:
        certified = [pair.attrs["numerical_error_db"] for pair in names["pairs"]]
        assert raster.tags()["APERTURA_ERROR_DB"] == f"{max(certified):.2f}"
