"""Confinement of a campaign folder: nothing outside is read, written or deleted, whatever links exist."""

import ast
import os
import pickle
import socket
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from folders import copy_writable

from apertura.common.atomic import remove, replacement, write_beside, write_json, write_text
from apertura.common.confined import LARGEST_READ, ConfinedPath, on_disk
from apertura.common.errors import CampaignError
from apertura.common.processes import hold

SOURCES = Path(__file__).parents[1] / "src" / "apertura"


@pytest.fixture
def root(tmp_path):
    (tmp_path / "campaign" / "results" / "f01").mkdir(parents=True)
    return ConfinedPath.at(tmp_path / "campaign")


@pytest.fixture
def outside(tmp_path):
    """A folder of the user next to the campaign."""
    (tmp_path / "outside" / "deep").mkdir(parents=True)
    for name in ("a.json", "deep/b.log"):
        (tmp_path / "outside" / name).write_text("kept")
    return tmp_path / "outside"


def state_of(folder):
    """Return the state of everything below a folder: mode, times and contents."""
    return {
        path.relative_to(folder).as_posix(): (
            path.lstat()[:4],
            path.lstat().st_mtime_ns,
            path.is_file() and path.read_bytes(),
        )
        for path in (folder, *folder.rglob("*"))
    }


WAYS = {
    "read": lambda path: path.read_bytes(),
    "open": lambda path: path.open("rb").close(),
    "write": lambda path: path.write_text("x"),
    "append": lambda path: path.open("a").close(),
    "stat": lambda path: path.stat(),
    "is_file": lambda path: path.is_file(),
    "exists": lambda path: path.exists(),
    "mkdir": lambda path: (path / "new").mkdir(parents=True),
    "list": lambda path: list(path.iterdir()),
    "walk": lambda path: list(path.walk()),
    "on_disk": lambda path: on_disk(path).__enter__(),
    "json": lambda path: write_json(path / "x.json", {}),
    "beside": lambda path: write_beside(path / "x", b""),
    "remove below": lambda path: (path / "a.json").unlink(),
    "remove all below": lambda path: remove(path / "deep"),
    "rename from": lambda path: (path / "a.json").rename(path.parent / "stolen"),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("place", ["results/f01/link", "results/link/f01", "results"])
def test_links_are_not_followed(root, outside, way, place):
    linked = Path(root) / (place.removesuffix("/f01") if place.startswith("results/link") else place)
    if linked.is_dir():
        (linked / "f01").rmdir()
        linked.rmdir()
    linked.symlink_to(outside)
    before = state_of(outside)
    with pytest.raises(CampaignError, match="symbolic link"):
        WAYS[way](root / place)
    assert state_of(outside) == before


def test_removing_or_replacing_a_link_keeps_its_target(root, outside):
    before, link = state_of(outside), root / "results" / "link"
    for change in (link.unlink, lambda: remove(link), lambda: write_text(link, "new")):
        Path(link).unlink(missing_ok=True)
        Path(link).symlink_to(outside / "a.json")
        change()
        assert not link.is_symlink()
    assert link.read_text() == "new"
    Path(root / "results" / "f01" / "link").symlink_to(outside)
    remove(root / "results" / "f01")
    assert not (root / "results" / "f01").exists()
    assert state_of(outside) == before


@pytest.mark.parametrize("work", [".note.json.wip", ".note.json.wip/.lock"])
def test_linked_work_folder_or_lock_is_rejected_and_not_cleared(root, outside, work):
    path = Path(root) / "results" / work
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(outside if work.endswith("wip") else outside / "a.json")
    before = state_of(outside)
    with pytest.raises(CampaignError, match="a symbolic link"):
        write_json(root / "results" / "note.json", {})
    assert state_of(outside) == before


def test_clearing_a_work_folder_removes_links_but_not_targets(root, outside):
    work = Path(root) / "results" / ".note.json.wip"
    work.mkdir()
    (work / "of a killed writer").symlink_to(outside)
    before = state_of(outside)
    write_json(root / "results" / "note.json", {"a": 1})
    assert (root / "results" / "note.json").read_text() == '{\n "a": 1\n}\n'
    assert not work.exists()
    assert state_of(outside) == before


def test_folder_swapped_for_a_link_during_a_write_is_safe(root, outside):
    """The write uses the descriptor of the created folder, even if the name of the folder leads elsewhere."""
    folder, before = Path(root) / "results" / "f01", state_of(outside)

    def written():
        with replacement(root / "results" / "f01" / "a.npy") as temporary:
            folder.rename(folder.with_name("moved"))
            folder.symlink_to(outside)
            np.save(temporary, np.zeros(3))

    with pytest.raises(CampaignError, match="symbolic link"):
        written()
    assert state_of(outside) == before


@pytest.mark.parametrize("kind", ["named pipe", "socket", "device", "folder"])
@pytest.mark.parametrize("mode", ["rb", "a", "w"])
def test_special_file_is_rejected_at_once(root, kind, mode):
    path = Path(root) / "results" / "x"
    if kind == "named pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind(str(path))
    elif kind == "device":
        path.symlink_to("/dev/zero")
        kind = "symbolic link"
    else:
        path.mkdir()
        kind = "Is a directory"
    done = []

    def opened():
        with pytest.raises((CampaignError, IsADirectoryError), match=kind):
            (root / "results" / "x").open(mode)
        done.append(True)

    thread = threading.Thread(target=opened, daemon=True)
    thread.start()
    thread.join(5)
    assert done


def test_hard_link_to_an_outside_file_is_read_but_not_written(root, outside):
    path = Path(root) / "results" / ".run.lock"
    path.hardlink_to(outside / "a.json")
    assert (root / "results" / ".run.lock").read_text() == "kept"
    with pytest.raises(CampaignError, match=r"a file with 2 hard links"):
        hold(root)
    assert (outside / "a.json").read_text() == "kept"


def test_huge_sparse_file_is_rejected_before_reading(root):
    with (root / "results" / "x").open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(CampaignError, match=f"1099511627776 bytes; expected a file of at most {LARGEST_READ}"):
        (root / "results" / "x").read_bytes()


@pytest.mark.parametrize("name", ["../outside/a.json", "results/../../outside/a.json", "/etc/hostname"])
def test_path_that_leads_out_of_the_folder_is_rejected(root, outside, name):
    with pytest.raises(CampaignError, match="leads out of the campaign folder"):
        (root / name).read_text()


def test_library_opens_the_checked_file(root, outside):
    (root / "results" / "x.npy").write_bytes(b"")
    with pytest.raises(TypeError, match="use on_disk"):
        np.load(root / "results" / "x.npy")
    with on_disk(root / "results" / "x.npy") as name:
        Path(root / "results" / "x.npy").unlink()
        Path(root / "results" / "x.npy").symlink_to(outside / "a.json")
        assert name.read_bytes() == b""


def test_derived_paths_are_confined(root, tmp_path):
    (tmp_path / "link").symlink_to(Path(root))
    linked = ConfinedPath.at(tmp_path / "link")
    path = linked / "results" / "f01"
    derived = [
        path,
        path.parent,
        path.parents[0],
        path.with_name("f01"),
        path.with_suffix(""),
        linked.joinpath("results", "f01"),
        next(linked.glob("results")),
        next(linked.rglob("f01")),
        pickle.loads(pickle.dumps(path)),
        ConfinedPath.referenced(path.reference()),
    ]
    assert all(path.is_dir() and isinstance(path, ConfinedPath) for path in derived)
    assert not isinstance(path.relative_to(linked), ConfinedPath)


def test_with_elsewhere_redirects_a_subfolder(root, outside):
    redirected = root.with_elsewhere({"raw": outside})
    assert (redirected / "raw" / "a.json").read_text() == "kept"
    assert str((redirected / "raw" / "a.json").location) == str(outside / "a.json")
    (outside / "deep" / "link").symlink_to(outside / "a.json")
    with pytest.raises(CampaignError, match="a symbolic link"):
        (redirected / "raw" / "deep" / "link").read_text()


# ---- No other code path --------------------------------------------------------------------------------------------

_FILE_MODULES = {"common/confined.py", "common/atomic.py"}
_CHANGES_BY_NAME = {
    "os": {
        *("open", "mkdir", "makedirs", "remove", "unlink", "rmdir", "removedirs", "rename", "renames", "replace"),
        *("truncate", "utime", "chmod", "chown", "link", "symlink", "mkfifo", "mknod"),
    },
    "shutil": {"rmtree", "move", "copy", "copy2", "copyfile", "copytree", "copymode", "copystat"},
}
_ELSEWHERE = {
    ("common/processes.py", "os.open"): "folders for Landlock rules, opened without following links",
    ("cli.py", "os.open"): "/dev/null",
    ("views/report/step.py", "shutil.copyfile"): "from a temporary folder into a replacement",
    ("tools/design/expected_images.py", "shutil.copyfile"): "into a campaign folder that was just made",
    ("tools/init/__init__.py", "os.link"): "into a campaign folder that was just made",
    ("tools/init/__init__.py", "shutil.copyfile"): "into a campaign folder that was just made",
    ("tools/write_campaign.py", "shutil.copyfile"): "into a replacement of the whole campaign folder",
}


def test_only_listed_code_changes_files_by_name():
    calls = set()
    for path in SOURCES.rglob("*.py"):
        file = path.relative_to(SOURCES).as_posix()
        for call in (node for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Call)):
            of, name = getattr(getattr(call.func, "value", None), "id", ""), getattr(call.func, "attr", "")
            if name in _CHANGES_BY_NAME.get(of, ()):
                calls.add((file, f"{of}.{name}"))
            if getattr(call.func, "id", "") == "open":
                calls.add((file, "open"))
    assert {call for call in calls if call[0] not in _FILE_MODULES} == set(_ELSEWHERE)


_WATCH = """
import sys
changed, root = [], sys.argv.pop(1)
NAMES = {"os.remove", "os.rmdir", "os.mkdir", "os.rename", "os.truncate", "os.utime", "os.chmod", "os.link",
         "os.symlink", "shutil.rmtree", "shutil.move", "shutil.copyfile"}
def watch(event, arguments):
    if event == "open":
        name, mode, flags = arguments
        writes = isinstance(flags, int) and flags & 0o1103
    elif event in NAMES:
        name, writes = arguments[-1] if event == "os.rename" else arguments[0], True
    else:
        return
    if writes and isinstance(name, (str, bytes)) and str(name).startswith(root):
        changed.append((event, str(name)))
sys.addaudithook(watch)
from apertura.__main__ import main
try:
    main()
finally:
    for event, name in changed:
        print("BY NAME", event, name, file=sys.stderr)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("list",),
        ("check", "--products"),
        ("step", "ingest", "f01", "uav1", "--campaign"),
        ("step", "image", "f01", "uav1-uav2", "--campaign"),
        ("step", "export", "f01", "uav1-uav2", "--campaign"),
        ("step", "stac", "--campaign"),
        ("preview",),
        ("clean", "--yes"),
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_commands_write_campaign_files_by_descriptor(finished_tiny, tmp_path, words):
    """Python reports every opened or deleted file to audit hooks, by the name that was passed."""
    root = copy_writable(finished_tiny.root, tmp_path / "campaign")
    done = subprocess.run(
        [sys.executable, "-c", _WATCH, str(root), *words, str(root)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "BY NAME" not in done.stderr
    assert done.returncode == 0, done.stderr
