"""Executed pages of docs/: their blocks, and the output shown below each block."""

import os
import re
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

_NUMBER = re.compile(r"-?\d+\.\d+(?:e-?\d+)?")


def blocks(page: Path):
    """Yield (line, kind, block, shown) of a page: `shown` is the output below the block."""
    text = page.read_text(encoding="utf-8")
    for block in re.finditer(r"^```(python|console)\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", text, re.M | re.S):
        yield text.count("\n", 0, block.start()) + 2, block[1], block[2], block[3] or ""


def walk(page: Path) -> dict[str, object]:
    """Run a page's blocks in the working directory and return the names that they define.

    Printed words and integers must equal the words and integers shown; numbers with a decimal point may differ by 5 %.
    """
    names: dict[str, object] = {}
    for line, kind, block, shown in blocks(page):
        printed = StringIO()
        if kind == "console":
            run_commands(block)
        else:
            with redirect_stdout(printed):
                exec(compile("\n" * (line - 1) + block, str(page), "exec"), names)
        (words, numbers), (shown_words, shown_numbers) = _parts(printed.getvalue()), _parts(shown)
        assert words == shown_words, f"{page.name}:{line} prints\n{printed.getvalue()}"
        assert numbers == pytest.approx(shown_numbers, rel=0.05), f"{page.name}:{line}"
    return names


def run_commands(block: str) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for line in block.splitlines():
        assert line.startswith("$ ")
        command = line.removeprefix("$ ").split()
        done = subprocess.run(command, env={**os.environ, "PATH": path}, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


def _parts(text: str) -> tuple[list[str], list[float]]:
    """Return the words of a text, with a marker for every number with a decimal point, and these numbers."""
    return _NUMBER.sub("#", text).split(), [float(number) for number in _NUMBER.findall(text)]
