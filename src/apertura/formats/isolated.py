"""Execution of readers that may crash in a child process, with limits of memory and time; failures are reported.

The child process receives paths and returns all arrays in one file, which is mapped once: a flight may have more files
than a process may hold open. The output is neither executed nor unpickled.
"""

import json
import math
import os
import pkgutil
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from apertura.common.confined import ConfinedPath, on_disk
from apertura.common.errors import shown
from apertura.common.lazy import module_of, name_of

SPARE_BYTES = 1 << 30
"""Fixed part of a reader's limit of address space, bytes; `BYTES_PER_BYTE` times the largest file size is added."""

BYTES_PER_BYTE = 16
"""Limit of address space per byte of the largest file."""

SECONDS, SECONDS_PER_BYTE = 30.0, 1e-6
"""Time limit of a reader, s: fixed part, and part per byte of its files."""

_ARRAYS = "arrays"
_REFUSED = 3
_THREADS = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL")}


class UnreadableError(ValueError):
    """Failure of a reader, with the file concerned.

    Attributes
    ----------
    path
        File that was being read.
    """

    def __init__(self, path: Path, found: str) -> None:
        self.path = path
        super().__init__(found)


def read_isolated(
    function: Callable[[Path], Any],
    paths: Sequence[Path],
    *,
    seconds: float | None = None,
    memory_bytes: int | None = None,
) -> list[dict[str, NDArray[Any]]]:
    """Run a reader on each file in a single child process and return its arrays.

    Parameters
    ----------
    function
        Module-level function: path → {name: array}; its ValueError is reported as the reason for rejecting a file.
    paths
        The files.
    seconds, memory_bytes
        Limits; by default proportional to the file sizes, plus a constant.

    Returns
    -------
    list
        For each file, name → array, memory-mapped and read-only.

    Raises
    ------
    UnreadableError
        If the function rejects a file, or the process crashes, times out or exceeds its memory limit.
    """
    sizes = [path.stat().st_size for path in paths]
    seconds = SECONDS + SECONDS_PER_BYTE * sum(sizes) if seconds is None else seconds
    memory_bytes = SPARE_BYTES + BYTES_PER_BYTE * max(sizes, default=0) if memory_bytes is None else memory_bytes
    with TemporaryDirectory(prefix="apertura-") as name, ExitStack() as stack:
        folder = Path(name)
        # -P: do not import modules from the campaign folder
        command = [
            sys.executable,
            "-P",
            "-m",
            __name__,
            f"{module_of(function)}:{name_of(function)}",
            str(memory_bytes),
            str(int(seconds) + 1),
            name,
        ]
        files = [str(stack.enter_context(on_disk(path.absolute()))) for path in paths]
        confined = [file for file, path in zip(files, paths, strict=True) if isinstance(path, ConfinedPath)]
        try:
            done = subprocess.run(
                [*command, *files],
                check=False,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=seconds,
                env={**os.environ, **_THREADS},
                pass_fds=[int(Path(file).name) for file in confined],
            )
            found = _ended(done.returncode, done.stderr)
        except subprocess.TimeoutExpired:
            found = f"its reader exceeded the time limit of {seconds:.0f} s"
        finished = sum((folder / f"{number}.json").is_file() for number in range(len(paths)))
        if found or finished < len(paths):
            raise UnreadableError(paths[min(finished, len(paths) - 1)], found or "its reader wrote no output")
        mapped = np.memmap(folder / _ARRAYS, mode="r")
        return [_read(folder / f"{number}.json", mapped) for number in range(len(paths))]


def _ended(status: int, stderr: bytes) -> str:
    """Return the cause of the process's failure; empty if it succeeded."""
    if status < 0:
        return f"its reader was terminated by {signal.Signals(-status).name}"
    lines = stderr.decode("utf-8", errors="replace").strip().splitlines()
    return "" if status == 0 else shown(lines[-1] if lines else f"its reader exited with status {status}", 300)


def _read(index: Path, mapped: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    arrays = {}
    for name, kind, shape, start in json.loads(index.read_text()):
        dtype = np.dtype(kind)
        stop = start + dtype.itemsize * math.prod(shape)
        arrays[name] = mapped[start:stop].view(dtype).reshape(shape)
    return arrays


def _write(index: Path, file: BinaryIO, arrays: dict[str, NDArray[Any]]) -> None:
    """Append arrays to the common file, each at a multiple of 64 bytes; write their types, shapes and offsets."""
    entries = []
    for name, array in arrays.items():
        if array.dtype.hasobject or array.dtype.fields:
            raise TypeError(f"{name} has type {array.dtype}")
        file.write(bytes(-file.tell() % 64))
        entries.append((name, array.dtype.str, array.shape, file.tell()))
        np.asarray(array, order="C").tofile(file)
    file.flush()
    index.write_text(json.dumps(entries))


def _main(function: str, memory_bytes: str, seconds: str, folder: str, *paths: str) -> int:
    """Set the limits of this process, read the files, and write their arrays."""
    limits = {
        resource.RLIMIT_AS: int(memory_bytes),
        resource.RLIMIT_FSIZE: int(memory_bytes) * len(paths),
        resource.RLIMIT_CPU: int(seconds),
        resource.RLIMIT_CORE: 0,
    }
    for kind, limit in limits.items():
        hard = resource.getrlimit(kind)[1]
        bound = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (bound, bound))
    try:
        reader = pkgutil.resolve_name(function)
        with (Path(folder) / _ARRAYS).open("wb") as file:
            file.write(bytes(64))  # an empty file cannot be mapped
            for number, path in enumerate(paths):
                _write(Path(folder) / f"{number}.json", file, reader(Path(path)))
    except Exception as error:  # any exception of a parser means that the file is unreadable
        text = "its reader ran out of memory" if isinstance(error, MemoryError) else " ".join(str(error).split())
        sys.stderr.write((text or type(error).__name__).encode("ascii", "backslashreplace").decode() + "\n")
        return _REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
