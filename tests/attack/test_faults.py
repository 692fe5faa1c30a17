"""A selection of the trials of `faults.py`: kills, errors and full disks."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.attack.faults import may_mount
from tests.attack.faults_campaign import TARGETS
from tests.attack.faults_control import compiler

ROOT = Path(__file__).parents[2]


def disturbed(*options: str) -> list[int]:
    """Run the trials; return the numbers of kills, errors and full disks."""
    command = [sys.executable, "-m", "tests.attack.faults", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return [int(count) for count in re.search(r"^all +(\d+) +(\d+) +(\d+)", done.stdout, re.MULTILINE).groups()]


@pytest.mark.slow
@pytest.mark.skipif(compiler() is None, reason="no C compiler for the fault injection library")
def test_steps_resume_after_kills_errors_and_full_disks():
    """One kill and one error per kind of step, and a full disk for every second kind."""
    kinds, half = len(TARGETS), len(TARGETS) // 2
    kills, errors, full = disturbed("--kills", str(kinds), "--errors", str(kinds), "--full", str(half))
    assert (kills, errors, full >= half - 3) == (kinds, kinds, may_mount())
