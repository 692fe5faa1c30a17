"""Atomic writes: a file or folder is written under a temporary name, flushed to disk and renamed."""

import fcntl
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

from apertura.common.confined import ConfinedPath


@contextmanager
def replacement(path: Path) -> Iterator[Path]:
    """Yield a temporary path for a file or folder that becomes `path` when the body finishes without an error.

    A second writer of the same path waits for a kernel lock, which is released when the first writer's process exits.
    Files left by a killed writer are removed by the next writer.

    Parameters
    ----------
    path
        File, or folder that is absent or empty; missing parent folders are created.

    Yields
    ------
    pathlib.Path
        Path in a new folder with a random name: ``.<name>.wip/<random>/<name>``. The body may store other temporary
        files in that folder. The path is valid in this process and its forks.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with replacement(Path(folder) / "note.txt") as temporary:
    ...         _ = temporary.write_text("all of it")
    ...     [path.name for path in Path(folder).iterdir()]
    ['note.txt']
    """
    target = confined_target(path)
    work = target.with_name(f".{target.name}.wip")
    with _locked(work):
        _clear(work)
        private = work / uuid4().hex
        try:
            private.mkdir(mode=0o700)
            with private.on_disk() as folder, _naming_target(folder, path):
                yield folder / target.name
            rename(private / target.name, target)
        finally:
            _clear(work)


def write_text(path: Path, text: str) -> None:
    """Write a text file as UTF-8 with newlines unchanged.

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
    """Write a file under a temporary name, flush it to disk and rename it; create its folder; a single writer only.

    After a power failure the file is complete or absent. A killed writer leaves a file ``<name>.….partial``, which the
    owner of the folder has to remove. `replacement` is slower, but removes such files and permits several writers.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_beside(Path(folder) / "c" / "0", b"all of it")
    ...     (Path(folder) / "c" / "0").read_bytes()
    b'all of it'
    """
    target = confined_target(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{target.name}.{uuid4().hex}.partial")
    with naming(target):
        try:
            with partial.open("wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            partial.rename(target)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise


def rename(source: Path, target: Path) -> None:
    """Flush a file or folder to disk and rename it: after a power failure `target` is complete or absent."""
    confined = ConfinedPath.of(source)
    confined.synchronise()
    confined.rename(target).parent.synchronise_folder()


def date(paths: Iterable[ConfinedPath], *, earliest_ns: int, latest_ns: int) -> None:
    """Clip the modification times of files to an interval; files of other users remain unchanged."""
    for path in paths:
        with suppress(OSError):
            state = path.stat()
            clipped_ns = min(max(state.st_mtime_ns, earliest_ns), latest_ns)
            if clipped_ns != state.st_mtime_ns:
                path.set_times(accessed_ns=state.st_atime_ns, modified_ns=clipped_ns)


def remove(path: Path) -> None:
    """Remove a file, or a folder with its contents, if it exists; targets of links remain."""
    ConfinedPath.of(path).remove()


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the path to an `OSError` raised in the context, because errors of write calls contain no path.

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


def confined_target(path: Path) -> ConfinedPath:
    """Return an output path as a confined path; missing parent folders of an unconfined path are created."""
    if not isinstance(path, ConfinedPath):
        path.parent.mkdir(parents=True, exist_ok=True)
    return ConfinedPath.of(path)


def made_folder(path: Path) -> ConfinedPath:
    """Return an output folder as a confined path; an unconfined folder and its missing parents are created."""
    if not isinstance(path, ConfinedPath):
        path.mkdir(parents=True, exist_ok=True)
    return ConfinedPath.at(path)


@contextmanager
def _naming_target(folder: Path, path: Path) -> Iterator[None]:
    """Set the path in an `OSError` raised in the context to the target, if it is missing or in the work folder."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and (error.filename is None or str(error.filename).startswith(str(folder))):
            error.filename = str(path)
        raise


@contextmanager
def _locked(work: ConfinedPath) -> Iterator[None]:
    """Hold the lock ``work/.lock``; on exit, remove the lock file and the work folder."""
    name = work / ".lock"
    while True:
        work.mkdir(parents=True, exist_ok=True)
        try:
            lock = name.open("a")
        except FileNotFoundError:  # the previous writer has just removed the folder
            continue
        with lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not _is_at(lock.fileno(), name):  # the previous writer has removed this lock file: open a new one
                continue
            try:
                yield
            finally:
                name.unlink(missing_ok=True)
                with suppress(OSError):  # the next writer has already created its lock file or removed the folder
                    work.rmdir()
            return


def _is_at(descriptor: int, name: ConfinedPath) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), name.stat())
    except FileNotFoundError:
        return False


def _clear(work: ConfinedPath) -> None:
    for path in work.iterdir():
        if path.name != ".lock":
            path.remove()


def _plain(value: object) -> object:
    if hasattr(value, "tolist"):  # a NumPy scalar or array
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON serializable")
