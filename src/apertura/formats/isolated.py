"""Execution of readers that may crash in a child process, with limits of memory and time; failures are reported.

The child process receives paths and returns arrays as .npy files. Its output is neither executed nor unpickled.
"""

import json
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
from typing import Any

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
        return [_read(folder, number) for number in range(len(paths))]


def _ended(status: int, stderr: bytes) -> str:
    """Return the cause of the process's failure; empty if it succeeded."""
    if status < 0:
        return f"its reader was terminated by {signal.Signals(-status).name}"
    lines = stderr.decode("utf-8", errors="replace").strip().splitlines()
    return "" if status == 0 else shown(lines[-1] if lines else f"its reader exited with status {status}", 300)


def _read(folder: Path, number: int) -> dict[str, NDArray[Any]]:
    names = json.loads((folder / f"{number}.json").read_text())
    return {
        name: np.load(folder / f"{number}.{index}.npy", mmap_mode="r", allow_pickle=False)
        for index, name in enumerate(names)
    }


def _main(function: str, memory_bytes: str, seconds: str, folder: str, *paths: str) -> int:
    """Set the limits of this process, and read files; write the arrays of each file, then the names of the arrays."""
    limits = {
        resource.RLIMIT_AS: int(memory_bytes),
        resource.RLIMIT_FSIZE: int(memory_bytes),
        resource.RLIMIT_CPU: int(seconds),
        resource.RLIMIT_CORE: 0,
    }
    for kind, limit in limits.items():
        hard = resource.getrlimit(kind)[1]
        bound = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (bound, bound))
    try:
        reader = pkgutil.resolve_name(function)
        for number, path in enumerate(paths):
            arrays = reader(Path(path))
            for index, array in enumerate(arrays.values()):
                np.save(Path(folder) / f"{number}.{index}.npy", array, allow_pickle=False)
            (Path(folder) / f"{number}.json").write_text(json.dumps(list(arrays)))
    except Exception as error:  # any exception of a parser means that the file is unreadable
        text = "its reader ran out of memory" if isinstance(error, MemoryError) else " ".join(str(error).split())
        sys.stderr.write((text or type(error).__name__).encode("ascii", "backslashreplace").decode() + "\n")
        return _REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
