"""Files that are whole or absent: written in a folder beside, then renamed."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yield where to write a draft; it becomes `path` when the body ends without an error.

    The folder of the draft, ``.<name>.wip``, may hold whatever else the body needs on disk. A second
    writer of the same file waits; a kernel lock that dies with its process sees to it. What a killed
    writer left behind is cleared by the next one.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with whole(Path(folder) / "note.txt") as draft:
    ...         _ = draft.write_text("all of it")
    ...     [path.name for path in Path(folder).iterdir()]
    ['note.txt']
    """
    workshop = path.with_name(f".{path.name}.wip")
    with _locked(workshop):
        try:
            _clear(workshop)
            yield workshop / path.name
            (workshop / path.name).replace(path)
        finally:
            _clear(workshop)


@contextmanager
def _locked(workshop: Path) -> Iterator[None]:
    """Hold ``workshop/lock``; on leaving, remove both."""
    name = workshop / "lock"
    while True:
        workshop.mkdir(parents=True, exist_ok=True)
        try:
            lock = name.open("a")
        except FileNotFoundError:  # the writer before us has just removed the folder
            continue
        with lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not _is_at(lock.fileno(), name):  # removed by the writer we waited for: not the lock any more
                continue
            try:
                yield
            finally:
                name.unlink()
                if not any(workshop.iterdir()):  # else the next writer has made its own lock
                    workshop.rmdir()
            return


def _is_at(descriptor: int, name: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), name.stat())
    except FileNotFoundError:
        return False


def _clear(workshop: Path) -> None:
    for left_over in workshop.iterdir():
        if left_over.name != "lock":
            left_over.unlink()
