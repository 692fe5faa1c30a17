"""Atomic writes: a file or folder is complete or absent, also with several writers and with killed writers."""

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


def test_second_writer_of_a_file_waits(tmp_path):
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
for _ in range(40):
    write_text(Path(sys.argv[1]), sys.argv[2] * 20000)
"""


@pytest.mark.slow
def test_concurrent_writers_leave_one_complete_file(tmp_path):
    path = tmp_path / "note.txt"
    writers = [subprocess.Popen([sys.executable, "-c", MANY, path, letter]) for letter in "abc"]
    contents = set()
    while any(writer.poll() is None for writer in writers):
        if path.exists():
            contents.add(path.read_text())
        time.sleep(0.001)
    assert [writer.returncode for writer in writers] == [0, 0, 0]
    assert contents | {path.read_text()} <= {letter * 20000 for letter in "abc"}
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


def test_next_writer_clears_leftovers_of_a_killed_writer(tmp_path):
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


def test_failed_write_keeps_the_previous_file(tmp_path):
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


def test_file_is_synced_before_renaming_and_folder_after(tmp_path, monkeypatch):
    path, synchronised = tmp_path / "note.txt", []

    def fsync(descriptor):
        name = str(Path(f"/proc/self/fd/{descriptor}").readlink())
        synchronised.append((re.sub("[0-9a-f]{32}", "random", name.removeprefix(str(tmp_path))), path.exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    write_text(path, "all of it")
    assert synchronised == [("/.note.txt.wip/random/note.txt", False), ("", True)]


def test_numpy_numbers_and_arrays_are_written_as_json(tmp_path):
    write_json(tmp_path / "x.json", {"b": np.float32(0.5), "a": np.arange(2)})
    assert (tmp_path / "x.json").read_text() == '{\n "a": [\n  0,\n  1\n ],\n "b": 0.5\n}\n'


def test_write_beside_syncs_before_renaming(tmp_path, monkeypatch):
    path, synchronised = tmp_path / "c" / "0", []
    monkeypatch.setattr(os, "fsync", lambda _: synchronised.append(path.exists()))
    write_beside(path, b"all of it")
    assert synchronised == [False]
    assert path.read_bytes() == b"all of it"


def test_full_disk_keeps_the_file_and_names_it(tmp_path, monkeypatch):
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


def test_removing_a_link_keeps_its_target(tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "kept")
    for name in ("link", "absent"):
        remove(tmp_path / name)
    assert names(tmp_path) == ["kept"]


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "MB free on the file system. Free disk space and run again"),
        (errno.EDQUOT, "a larger quota"),
        (errno.EFBIG, "ulimit -f"),
        (errno.EROFS, "to a writable file system"),
        (errno.EACCES, "its folder writable"),
        (errno.EIO, "Check the disk"),
        (errno.EMFILE, "ulimit -n"),
    ],
)
def test_system_error_message_has_path_cause_and_remedy(tmp_path, number, remedy):
    message = explained(OSError(number, os.strerror(number), str(tmp_path / "absent" / "x.tif")))
    assert message.startswith(f"{tmp_path}/absent/x.tif: {os.strerror(number)} ({errno.errorcode[number]})")
    assert remedy in message
    assert message.endswith("run again: the run resumes.")


def test_out_of_memory_and_broken_pipe_are_explained():
    with pytest.raises(MemoryError) as caught:
        np.empty(1 << 62, np.uint8)
    assert explained(caught.value).startswith("out of memory: Unable to allocate")
    assert explained(BrokenPipeError(errno.EPIPE, "Broken pipe")).startswith("output: Broken pipe (EPIPE)")


@pytest.mark.parametrize("defect", [KeyError("x"), FileNotFoundError(errno.ENOENT, "no"), ValueError("No space left")])
def test_internal_error_is_not_explained(defect):
    assert explained(defect) is None
