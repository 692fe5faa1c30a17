"""A file or folder is complete or absent, whoever writes it and whoever is killed."""

import errno
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from apertura.common.atomic import remove, replacement, write_beside, write_json, write_text
from apertura.common.errors import explained


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_second_writer_of_the_same_file_waits(tmp_path):
    path = tmp_path / "note.txt"

    def write_second():
        with replacement(path) as temporary:
            temporary.write_text("second")

    second = threading.Thread(target=write_second)
    with replacement(path) as temporary:
        second.start()
        temporary.write_text("first")
        second.join(timeout=0.2)
        assert second.is_alive()
        assert temporary.read_text() == "first"
    second.join()
    assert path.read_text() == "second"
    assert names(tmp_path) == ["note.txt"]


MANY = """
import sys
from pathlib import Path
from apertura.common.atomic import write_text
for turn in range(40):
    write_text(Path(sys.argv[1]), sys.argv[2] * 20000)
"""


@pytest.mark.slow
def test_many_writers_at_once_leave_one_complete_file(tmp_path):
    path = tmp_path / "note.txt"
    writers = [subprocess.Popen([sys.executable, "-c", MANY, path, letter]) for letter in "abc"]
    seen = set()
    while any(writer.poll() is None for writer in writers):
        if path.exists():
            seen.add(path.read_text())
        time.sleep(0.001)
    assert [writer.returncode for writer in writers] == [0, 0, 0]
    assert seen | {path.read_text()} <= {letter * 20000 for letter in "abc"}
    assert names(tmp_path) == ["note.txt"]


KILLED = """
import os, signal, sys
from pathlib import Path
from apertura.common.atomic import replacement
with replacement(Path(sys.argv[1])) as temporary:
    temporary.mkdir()
    (temporary / "half").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_writer_left_is_cleared_by_the_next(tmp_path):
    path = tmp_path / "folder"
    killed = subprocess.run([sys.executable, "-c", KILLED, path], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert names(tmp_path) == [".folder.wip"]
    with replacement(path) as temporary:
        assert not temporary.exists()
        temporary.mkdir()
        (temporary / "all").write_text("all")
    assert names(tmp_path) == ["folder"]
    assert names(path) == ["all"]


def test_an_error_keeps_what_was_there_and_leaves_nothing_else(tmp_path):
    write_text(tmp_path / "note.txt", "before")

    def fail():
        with replacement(tmp_path / "note.txt") as temporary:
            temporary.write_text("after")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "note.txt", {"x": np.nan})
    assert names(tmp_path) == ["note.txt"]
    assert (tmp_path / "note.txt").read_text() == "before"


def test_a_file_reaches_the_disk_before_it_has_its_name_and_its_name_after(tmp_path, monkeypatch):
    path, synchronised = tmp_path / "note.txt", []

    def fsync(descriptor):
        name = str(Path(f"/proc/self/fd/{descriptor}").readlink())
        synchronised.append((re.sub("[0-9a-f]{32}", "random", name.removeprefix(str(tmp_path))), path.exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    write_text(path, "all of it")
    assert synchronised == [("/.note.txt.wip/random/note.txt", False), ("", True)]


def test_numbers_and_arrays_of_numpy_are_json(tmp_path):
    write_json(tmp_path / "x.json", {"b": np.float32(0.5), "a": np.arange(2)})
    assert (tmp_path / "x.json").read_text() == '{\n "a": [\n  0,\n  1\n ],\n "b": 0.5\n}\n'


def test_a_file_written_beside_reaches_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    path, synchronised = tmp_path / "c" / "0", []
    monkeypatch.setattr(os, "fsync", lambda _: synchronised.append(path.exists()))
    write_beside(path, b"all of it")
    assert synchronised == [False]
    assert path.read_bytes() == b"all of it"


def test_a_write_that_fails_leaves_what_was_there_and_names_its_file(tmp_path, monkeypatch):
    path = tmp_path / "0"
    write_beside(path, b"before")

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    for write in (lambda: write_beside(path, b"after"), lambda: write_text(path, "after")):
        with pytest.raises(OSError, match="No space left on device") as caught:
            write()
        assert caught.value.filename.endswith("0")
    assert names(tmp_path) == ["0"]
    assert path.read_bytes() == b"before"


def test_removing_a_link_keeps_what_it_points_to(tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "kept")
    for name in ("link", "absent"):
        remove(tmp_path / name)
    assert names(tmp_path) == ["kept"]


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "MB free there. Free disk space there"),
        (errno.EDQUOT, "a larger quota"),
        (errno.EFBIG, "ulimit -f"),
        (errno.EROFS, "to a writable file system"),
        (errno.EACCES, "its folder writable"),
        (errno.EIO, "Check the disk"),
        (errno.EMFILE, "ulimit -n"),
    ],
)
def test_an_error_of_the_machine_says_what_it_was_where_and_what_to_do(tmp_path, number, remedy):
    message = explained(OSError(number, os.strerror(number), str(tmp_path / "absent" / "x.tif")))
    assert message.startswith(f"{tmp_path}/absent/x.tif: {os.strerror(number)} ({errno.errorcode[number]})")
    assert remedy in message
    assert message.endswith("run again: the run resumes.")


def test_memory_that_is_gone_and_a_reader_that_is_gone_are_no_defects():
    with pytest.raises(MemoryError) as caught:
        np.empty(1 << 62, np.uint8)
    assert explained(caught.value).startswith("out of memory: Unable to allocate")
    assert explained(BrokenPipeError(errno.EPIPE, "Broken pipe")).startswith("output: Broken pipe (EPIPE)")


@pytest.mark.parametrize("defect", [KeyError("x"), FileNotFoundError(errno.ENOENT, "no"), ValueError("No space left")])
def test_a_defect_is_not_explained_away(defect):
    assert explained(defect) is None
