"""Run commands in a campaign folder, in forks of one interpreter, and record which paths they write and open."""

import ctypes
import importlib
import json
import os
import pkgutil
import re
import resource
import select
import signal
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .link_commands import INPUTS, Command, environment, first_target, program

# ---- Processes ------------------------------------------------------------------------------------------------------


def _limit() -> None:
    """Limit memory and file size, so that a copied sparse file does not exhaust the machine."""
    resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 30, 1 << 30))


def serve() -> None:
    """Fork a process for each line (JSON object) of standard input; print the process ID and the exit status.

    Runs in a separate interpreter, which has imported the package and has no threads.
    """
    from apertura.workflow.rules import RULES

    for name in ("apertura.__main__", "apertura.cli", *sorted({rule.module for rule in RULES.values()})):
        importlib.import_module(name)
    for line in iter(sys.stdin.readline, ""):
        order = json.loads(line)
        number = os.fork()
        if number == 0:
            _execute(order)
        print(number, flush=True)
        _, status = os.waitpid(number, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _execute(order: dict[str, Any]) -> None:
    """Execute the command of an order in this process; exits with `SystemExit`, like the program."""
    os.setsid()
    _limit()
    os.chdir(order["folder"])
    for stream, (name, flags) in enumerate(
        ((os.devnull, os.O_RDONLY), (order["stdout"], os.O_WRONLY), (order["stderr"], os.O_WRONLY))
    ):
        opened = os.open(name, flags | (os.O_CREAT | os.O_TRUNC if stream else 0), 0o666)
        os.dup2(opened, stream)
        os.close(opened)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 - stays open until the process exits
    sys.argv = ["apertura", *order["words"]]
    pkgutil.resolve_name("apertura.__main__:main")()
    sys.exit(0)


@dataclass
class Ended:
    """End of a command.

    Attributes
    ----------
    status
        Exit status, negative for a signal; None if it was killed after the time limit.
    seconds
        Duration.
    printed, message
        Standard output and standard error.
    """

    status: int | None
    seconds: float
    printed: str
    message: str


class Runner:
    """Runner of commands in sequence, each as a fork or as a new process.

    Parameters
    ----------
    folder
        Folder for output and temporary files.
    """

    def __init__(self, folder: Path) -> None:
        self._output = folder / "stdout", folder / "stderr"
        self._environment = environment(folder)
        self._status = 0
        self._server = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd="/",
            env={**self._environment, "PYTHONPATH": os.pathsep.join(filter(None, map(os.path.abspath, sys.path)))},
        )

    def close(self) -> None:
        """Stop the server."""
        if self._server.stdin and self._server.stdout:
            self._server.stdin.close()
            self._server.stdout.close()
        self._server.wait(10)

    @contextmanager
    def started(self, command: Command, root: Path) -> Iterator[tuple[int, int]]:
        """Start a command; yield its process group and a descriptor that becomes readable when it ends."""
        words = command.words.format(point=" ".join(map(str, first_target(root)))).split()
        if command.is_cold:
            files = [path.open("w") for path in self._output]
            process = subprocess.Popen(
                [program(), *words],
                cwd=root,
                stdin=subprocess.DEVNULL,
                stdout=files[0],
                stderr=files[1],
                env=self._environment,
                start_new_session=True,
                preexec_fn=_limit,  # noqa: PLW1509 - the harness has no threads
            )
            ending = os.pidfd_open(process.pid)
            try:
                yield process.pid, ending
            finally:
                _kill(process.pid)
                self._status = process.wait()
                os.close(ending)
                for file in files:
                    file.close()
        else:
            assert self._server.stdin
            assert self._server.stdout
            order = {"words": words, "folder": str(root)}
            order |= dict(zip(("stdout", "stderr"), map(str, self._output), strict=True))
            self._server.stdin.write(json.dumps(order) + "\n")
            self._server.stdin.flush()
            number = int(self._server.stdout.readline())
            ending = os.pidfd_open(number)
            try:
                yield number, ending
            finally:
                _kill(number)
                self._status = int(self._server.stdout.readline())
                os.close(ending)

    def run(self, command: Command, root: Path, limit_s: float, meanwhile: Callable[[], object] | None = None) -> Ended:
        """Run a command in a campaign folder until it ends or a time limit is reached."""
        start_s = time.monotonic()
        is_ended = was_interrupted = False
        with self.started(command, root) as (group, ending):
            until_ended = select.poll()  # `select.select` fails for descriptors beyond 1023
            until_ended.register(ending, select.POLLIN)
            while not is_ended and time.monotonic() - start_s < limit_s:
                if meanwhile:
                    meanwhile()
                is_ended = until_ended.poll(2 if meanwhile else 20)
                if not was_interrupted and command.words.startswith("map ") and self._is_serving():
                    os.killpg(group, signal.SIGINT)
                    was_interrupted = True
        seconds = time.monotonic() - start_s
        printed, message = (path.read_text(errors="replace") for path in self._output)
        return Ended(self._status if is_ended else None, seconds, printed, message)

    def _is_serving(self) -> bool:
        return self._output[0].exists() and "http" in self._output[0].read_text(errors="replace")


def _kill(group: int) -> None:
    """Kill the remaining processes of a process group."""
    with suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


# ---- Recording ------------------------------------------------------------------------------------------------------

_LIBC = ctypes.CDLL(None, use_errno=True)
_EVENT = struct.Struct("iIII")
_MODIFY, _CLOSE_WRITE, _OPEN, _MOVED_FROM, MOVED_TO, CREATE, _DELETE = 0x2, 0x8, 0x20, 0x40, 0x80, 0x100, 0x200
_ONLY_FOLDERS, _NO_LINKS, _IS_FOLDER, _NONBLOCK = 0x1000000, 0x2000000, 0x40000000, 0o4000
_WRITTEN = _MODIFY | _CLOSE_WRITE | _MOVED_FROM | MOVED_TO | CREATE | _DELETE

_RANDOM = re.compile(r"(?<![0-9A-Za-z])[0-9a-f]{8,}(?![0-9A-Za-z])|tmp[a-z0-9_]{8}|\d{4}-\d\d-\d\dT")
_CHUNK = re.compile(r"(.*\.zarr/.*?)/c(/.*)?$|(.*\.snakemake/metadata)/[^/]*$|(.*/\.hashes/.*)/[^/]*$")


def read_now(descriptor: int) -> bytes:
    """Return the bytes that a non-blocking descriptor holds; empty if none."""
    try:
        return os.read(descriptor, 1 << 18)
    except BlockingIOError:
        return b""


class Watch:
    """Watch for file events below a folder, including new subfolders.

    Parameters
    ----------
    root
        Folder to be watched.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._descriptor = _LIBC.inotify_init1(_NONBLOCK)
        if self._descriptor < 0:
            raise OSError(ctypes.get_errno(), "inotify_init1")
        self._folders: dict[int, str] = {}
        self._add("")

    def _add(self, name: str) -> list[tuple[str, int]]:
        """Watch a folder and its subfolders; return their existing entries as events."""
        mask = _WRITTEN | _OPEN | _ONLY_FOLDERS | _NO_LINKS
        number = _LIBC.inotify_add_watch(self._descriptor, os.fsencode(self._root / name), mask)
        events: list[tuple[str, int]] = []
        if number >= 0:
            self._folders[number] = name
            with suppress(OSError), os.scandir(self._root / name) as entries:
                for entry in entries:
                    below = os.path.join(name, entry.name)  # noqa: PTH118
                    is_folder = entry.is_dir(follow_symlinks=False)
                    events += [(below, CREATE | (_IS_FOLDER if is_folder else 0)), *(self._add(below) * is_folder)]
        return events

    def read(self) -> list[tuple[str, int]]:
        """Return the events so far: path relative to the root, and mask."""
        events: list[tuple[str, int]] = []
        while data := read_now(self._descriptor):
            at = 0
            while at < len(data):
                number, mask, _, length = _EVENT.unpack_from(data, at)
                name = data[at + _EVENT.size : at + _EVENT.size + length].rstrip(b"\0").decode(errors="replace")
                at += _EVENT.size + length
                if name and number in self._folders:
                    path = os.path.join(self._folders[number], name)  # noqa: PTH118
                    events.append((path, mask))
                    if mask & _IS_FOLDER and mask & (CREATE | MOVED_TO):
                        events += self._add(path)
        return events

    def close(self) -> None:
        """Stop watching."""
        os.close(self._descriptor)


@dataclass
class Recording:
    """Paths that a command uses, relative to the campaign folder.

    Attributes
    ----------
    written
        Paths created, written, renamed or deleted, even temporarily, with their parent folders.
    opened
        Files that are only read; inputs are excluded.
    folders
        Folders among the written and opened paths.
    random
        Number of names with a random part, which cannot be planted in advance.
    seconds, status
        Duration and exit status of the command.
    """

    written: list[str] = field(default_factory=list)
    opened: list[str] = field(default_factory=list)
    folders: set[str] = field(default_factory=set)
    random: int = 0
    seconds: float = 0.0
    status: int | None = 0


def record(runner: Runner, command: Command, root: Path) -> Recording:
    """Run a command in a copy of a campaign and return the paths that it uses."""
    watch = Watch(root)
    events: list[tuple[str, int]] = []
    try:
        ended = runner.run(command, root, 300, lambda: events.extend(watch.read()))
        events += watch.read()
    finally:
        watch.close()
    if ended.status != 0 and not ended.printed and not ended.message.startswith("error:"):
        raise RuntimeError(f"{command.words}: {ended.status}: {ended.message}")
    masks: dict[str, int] = {}
    for path, mask in events:
        masks[path] = masks.get(path, 0) | mask
    return _sorted(masks, ended)


def _sorted(masks: dict[str, int], ended: Ended) -> Recording:
    """Return a recording from the event masks per path."""
    recording = Recording(seconds=ended.seconds, status=ended.status)
    kept: Counter[str] = Counter()
    folders_above: set[str] = set()
    for path, mask in sorted(masks.items()):
        is_written = bool(mask & _WRITTEN)
        is_input = path.split("/")[0] in INPUTS
        if mask & _IS_FOLDER:
            recording.folders.add(path)
        if not is_written and (is_input or mask & _IS_FOLDER):
            continue
        if _RANDOM.search(path):
            recording.random += 1
            continue
        chunk = _CHUNK.match(path)
        if chunk:
            kept[key := "".join(filter(None, chunk.group(1, 3, 4)))] += 1
            if kept[key] > 3:
                continue
        (recording.written if is_written else recording.opened).append(path)
        if is_written:
            folders_above |= {str(above) for above in Path(path).parents} - {"."}
    above = {path for path in folders_above if path.split("/")[0] not in INPUTS and not _RANDOM.search(path)}
    recording.folders |= above
    recording.written = sorted({*recording.written, *above})
    return recording


if __name__ == "__main__":
    serve()
