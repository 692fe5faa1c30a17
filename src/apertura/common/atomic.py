"""Files and folders that are complete or absent: written beside, brought to the disk, then renamed."""

import fcntl
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4


@contextmanager
def replacement(path: Path) -> Iterator[Path]:
    """Yield where to write a file or folder; it becomes `path` when the body ends without an error.

    The work folder, ``.<name>.wip``, may hold whatever else the body needs on disk. A second writer of the same path
    waits: a kernel lock, which dies with its process, keeps it out. Leftovers of a killed writer are removed by the
    next.

    Parameters
    ----------
    path
        File, or folder that is absent or empty; folders above it are made.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with replacement(Path(folder) / "note.txt") as temporary:
    ...         _ = temporary.write_text("all of it")
    ...     [path.name for path in Path(folder).iterdir()]
    ['note.txt']
    """
    work = path.with_name(f".{path.name}.wip")
    temporary = work / path.name
    with naming(path), _locked(work):
        try:
            _clear(work)
            yield temporary
            rename(temporary, path)
        finally:
            _clear(work)


def write_text(path: Path, text: str) -> None:
    """Write a text file, UTF-8, newlines as they are.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_text(Path(folder) / "new" / "note.txt", "all of it")
    ...     (Path(folder) / "new" / "note.txt").read_text()
    'all of it'
    """
    with replacement(path) as temporary:
        temporary.write_bytes(text.encode())


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON file; the same document gives the same bytes.

    Raises
    ------
    ValueError
        If a number is not finite: JSON has no NaN.
    """
    write_text(path, json.dumps(document, indent=1, sort_keys=True, allow_nan=False, default=_plain) + "\n")


def write_beside(path: Path, content: bytes) -> None:
    """Write a file that no other process writes: beside, brought to the disk, renamed; its folder is made.

    After a power failure it is complete or absent. A killed writer leaves ``<name>.….partial``, to be removed by the
    owner of the folder. `replacement` needs no owner, and is slower.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_beside(Path(folder) / "c" / "0", b"all of it")
    ...     (Path(folder) / "c" / "0").read_bytes()
    b'all of it'
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{uuid4().hex}.partial")
    with naming(path):
        try:
            with partial.open("wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise


def rename(source: Path, target: Path) -> None:
    """Bring a file or folder to the disk and give it its name: after a power failure `target` is complete or absent."""
    for path in (source, *source.rglob("*")):
        _synchronise(path)
    source.replace(target)
    _synchronise(target.parent)


def date(paths: Iterable[Path], *, earliest_ns: int, latest_ns: int) -> None:
    """Bring the times of files between two, where they may be changed."""
    for path in paths:
        with suppress(OSError):
            found = path.stat()
            wanted_ns = min(max(found.st_mtime_ns, earliest_ns), latest_ns)
            if wanted_ns != found.st_mtime_ns:
                os.utime(path, ns=(found.st_atime_ns, wanted_ns))


def remove(path: Path) -> None:
    """Remove a file, or a folder with its contents, if there is one; targets of links stay."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the path to an `OSError` of the body: that of a write lacks it.

    Examples
    --------
    >>> with naming(Path("x.tif")):
    ...     raise OSError(28, "No space left on device")
    Traceback (most recent call last):
    OSError: [Errno 28] No space left on device: 'x.tif'
    """
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


def _synchronise(path: Path) -> None:
    if path.is_symlink():  # not written by us, nor is its target
        return
    descriptor = os.open(path, os.O_RDONLY)
    with naming(path):
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def _locked(work: Path) -> Iterator[None]:
    """Hold ``work/.lock``; on leaving, remove both."""
    name = work / ".lock"
    work.parent.mkdir(parents=True, exist_ok=True)
    while True:
        with suppress(FileExistsError):
            work.mkdir()
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
                with suppress(OSError):  # the next writer has made its own lock, or is done already
                    work.rmdir()
            return


def _is_at(descriptor: int, name: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), name.stat())
    except FileNotFoundError:
        return False


def _clear(work: Path) -> None:
    for path in work.iterdir():
        if path.name != ".lock":
            remove(path)


def _plain(value: object) -> object:
    if hasattr(value, "tolist"):  # a number or array of numpy
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")
