"""Commands on campaigns that contain links, pipes and endless files, or that are read-only."""

import subprocess
import sys

import pytest
from attack.links import KINDS, table, trials_of
from folders import copy_writable

pytestmark = pytest.mark.slow

READ_ONLY = {
    "list": ("list", "{root}"),
    "status": ("status", "{root}"),
    "summary": ("summary", "{root}"),
    "check": ("check", "{root}"),
    "check --products": ("check", "--products", "{root}"),
    "plan": ("plan", "{root}"),
    "verify": ("verify", "{root}"),
    "diff": ("diff", "{root}/results/f01/uav1-uav1/db.tif", "{root}/results/f01/uav1-uav2/db.tif"),
    "inspect": ("inspect", "{root}"),
    "score": ("score", "{root}"),
}
"""Read-only commands."""

_CONFINED = """
import sys
from pathlib import Path
from apertura.common.processes import confine_changes
elsewhere = Path(sys.argv.pop(1))
if not confine_changes(elsewhere):
    sys.exit(77)
from apertura.__main__ import main
main()
"""


def state_of(root):
    """Return the status of all files below a folder except cached hashes, to detect changes."""
    hashes = root / "results" / ".hashes"
    paths = [path for path in root.rglob("*") if not path.is_relative_to(hashes)]
    return {str(path): (path.lstat()[:4], path.lstat().st_mtime_ns) for path in paths if path != root / "results"}


@pytest.mark.parametrize("words", READ_ONLY.values(), ids=READ_ONLY)
def test_read_only_command_writes_only_hashes(finished_tiny, tmp_path, words):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    (tmp_path / "elsewhere").mkdir()
    arguments = [word.format(root=root) for word in words]
    code = [sys.executable, "-c", _CONFINED, tmp_path / "elsewhere"]
    before = state_of(root)
    confined = subprocess.run([*code, *arguments], capture_output=True, text=True, check=False)
    if confined.returncode == 77:
        pytest.skip("this kernel has no Landlock, and root may write everywhere")
    unconfined = subprocess.run(
        [sys.executable, "-m", "apertura", *arguments], capture_output=True, text=True, check=False
    )
    assert confined.returncode == unconfined.returncode, confined.stderr
    assert confined.stdout.count("\n") == unconfined.stdout.count("\n")
    assert unconfined.returncode in ({0, 1} if words[0] == "diff" else {0}), unconfined.stderr
    assert state_of(root) == before


@pytest.mark.parametrize("while_running", [False, True], ids=["before", "while it runs"])
def test_links_and_pipes_in_results_change_nothing_outside(tmp_path, while_running):
    """The trials are a selection of those of `python -m tests.attack.links`."""
    names = ["list", "clean", "preview", "step scene"]
    outcomes = trials_of(tmp_path, names, kinds=list(KINDS), seed=1, most=2, while_running=while_running)
    assert len(outcomes) >= 2 * len(names)
    assert table([outcome for outcome in outcomes if outcome.is_fault]) == table([])
