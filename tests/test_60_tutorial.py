"""The tutorial runs as it stands: every block in order, and what it shows is what it prints."""

import doctest
import os
import re
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

from apertura.focus.engines import native

TUTORIAL = Path(__file__).parents[1] / "docs/tutorial.md"
SHOWN = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def blocks():
    """Yield (line, kind, block) of the tutorial, each with the output that is shown below it."""
    text = TUTORIAL.read_text(encoding="utf-8")
    for block in re.finditer(r"^```(python|console)\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", text, re.M | re.S):
        yield text.count("\n", 0, block.start()) + 2, block[1], block[2], block[3] or ""


def run_shell(block):
    here = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for line in block.splitlines():
        assert line.startswith("$ ")
        done = subprocess.run(
            line[2:].split(), capture_output=True, text=True, check=False, env={**os.environ, "PATH": here}
        )
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.skipif(not native.available(), reason="the plan that is shown takes the compiled engine")
def test_every_block_of_the_tutorial_runs_and_prints_what_it_shows(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {}
    for line, kind, block, shown in blocks():
        printed = StringIO()
        if kind == "console":
            run_shell(block)
        else:
            code = compile("\n" * (line - 1) + block, str(TUTORIAL), "exec")
            with redirect_stdout(printed):
                exec(code, names)
        same = doctest.OutputChecker().check_output(shown, printed.getvalue(), SHOWN)
        assert same, f"{TUTORIAL.name}:{line} prints\n{printed.getvalue()}"
    assert (tmp_path / "both.tif").is_file()
