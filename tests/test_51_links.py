"""Commands on campaigns that hold links, pipes and endless files, or that may not be written."""

import subprocess
import sys

import pytest
from attack.links import KINDS, table, trials_of
from folders import copy_writable

pytestmark = pytest.mark.slow

LOOKS = {
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
"""Commands that only look."""

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
    """Return everything below a folder but the kept hashes, and what a change would show in."""
    kept = root / "results" / ".hashes"
    paths = [path for path in root.rglob("*") if not path.is_relative_to(kept)]
    return {str(path): (path.lstat()[:4], path.lstat().st_mtime_ns) for path in paths if path != root / "results"}


@pytest.mark.parametrize("words", LOOKS.values(), ids=LOOKS)
def test_a_command_that_only_looks_writes_nothing_but_hashes_and_needs_no_right_to_write(
    finished_tiny, tmp_path, words
):
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    (tmp_path / "elsewhere").mkdir()
    told = [word.format(root=root) for word in words]
    code = [sys.executable, "-c", _CONFINED, tmp_path / "elsewhere"]
    before = state_of(root)
    confined = subprocess.run([*code, *told], capture_output=True, text=True, check=False)
    if confined.returncode == 77:
        pytest.skip("this kernel has no Landlock, and root may write everywhere")
    free = subprocess.run([sys.executable, "-m", "apertura", *told], capture_output=True, text=True, check=False)
    assert confined.returncode == free.returncode, confined.stderr
    assert confined.stdout.count("\n") == free.stdout.count("\n")
    assert free.returncode in ({0, 1} if words[0] == "diff" else {0}), free.stderr
    assert state_of(root) == before


@pytest.mark.parametrize("while_running", [False, True], ids=["before", "while it runs"])
def test_links_pipes_and_endless_files_in_place_of_what_commands_write_change_nothing_outside(tmp_path, while_running):
    """Some trials of those of `python -m tests.attack.links`; the review's come first."""
    names = ["list", "clean", "preview", "step scene"]
    outcomes = trials_of(tmp_path, names, kinds=list(KINDS), seed=1, most=2, while_running=while_running)
    assert len(outcomes) >= 2 * len(names)
    assert table([outcome for outcome in outcomes if outcome.is_fault]) == table([])
