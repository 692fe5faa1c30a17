"""Some of the trials of `faults.py`: kills, errors and full disks; the rest by its command line."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.attack.faults import may_mount
from tests.attack.faults_control import compiler

ROOT = Path(__file__).parents[2]
SAVED, TILED, FILES = "echo f01 uav1-uav2", "image f01 uav1-uav2", "export f01 uav1-uav2"


def disturbed(*options: str, steps: tuple[str, ...] = ()) -> list[int]:
    """Run the trials; return how many kills, errors and full disks there were."""
    command = [sys.executable, "-m", "tests.attack.faults", *options, *(["--steps", *steps] if steps else [])]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return [int(count) for count in re.search(r"^all +(\d+) +(\d+) +(\d+)", done.stdout, re.MULTILINE).groups()]


@pytest.mark.slow
@pytest.mark.skipif(compiler() is None, reason="no C compiler to build what makes calls fail")
def test_a_step_killed_or_failing_or_on_a_full_disk_leaves_nothing_half_and_resumes_to_the_same_bytes():
    full = 2 if may_mount() else 0
    steps = (SAVED, TILED, FILES)
    assert disturbed("--kills", "4", "--errors", "4", "--full", "2", steps=steps) == [4, 4, full]


@pytest.mark.slow
@pytest.mark.skipif(compiler() is None, reason="no C compiler to build what makes calls fail")
def test_every_step_survives_kills_errors_and_full_disks():
    kills, errors, full = disturbed("--kills", "39", "--errors", "26", "--full", "13")
    assert (kills, errors, full >= 10) == (39, 26, may_mount())
