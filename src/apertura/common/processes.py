"""Processes of a run: lock, isolation from an untrusted working directory, and orderly termination by signals."""

import ctypes
import fcntl
import os
import re
import signal
import socket
import stat
import struct
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import IO

from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError, shown

# ---- Termination of a command: signals, and the exit status reported to the run -------------------------------------

INTERRUPTED = 130
SIGNALLED = 128
"""Base of the exit status of a process that was terminated by a signal; the signal number is added, as in shells."""
STATUS_FILE = "APERTURA_STATUS_FILE"
"""Environment variable: file for the exit status of a step, which Snakemake does not pass on; given as
`ConfinedPath.reference`."""

ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""Signals that terminate a run."""

ALGEBRA_THREADS = "OPENBLAS_NUM_THREADS"
"""Environment variable for the number of OpenBLAS threads, read when numpy is imported; 1 in every command. Because
OpenBLAS only multiplies small matrices here, its threads wait for each other longer than they compute: the simulation
of the demo takes 6.8 CPU seconds with two threads and 1.9 with one. With one thread, results are bit-identical for any
number of cores. Engines create separate threads."""

_PR_SET_PDEATHSIG = 1  # of prctl(2)


class Interrupted(SystemExit):
    """Termination of the process by a signal."""


def leave_status(status: int) -> None:
    """Report the exit status of a step to its run, if the step is part of a run."""
    if STATUS_FILE in os.environ and status:
        file = ConfinedPath.referenced(os.environ[STATUS_FILE])
        with suppress(OSError, CampaignError), file.open("a", encoding="utf-8") as stream:  # absent on another node
            stream.write(f"{status}\n")


def die_with_parent(parent: int) -> None:
    """Request that the kernel terminate this process when its parent exits, even by SIGKILL.

    Parameters
    ----------
    parent
        Process ID of the parent, which may already have exited.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(SIGNALLED + signal.SIGKILL)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Convert SIGTERM, SIGINT and SIGHUP to `Interrupted`, so that open resources are closed on exit."""

    def end(number: int, _: FrameType | None) -> None:
        for other in ENDING:
            signal.signal(other, signal.SIG_IGN)
        raise Interrupted(f"interrupted by {signal.Signals(number).name}")

    before = {number: signal.signal(number, end) for number in ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# ---- Isolation from an untrusted working directory ------------------------------------------------------------------
#
# Python and libraries load modules and settings from the working directory (``yaml.py``, numba's ``.numba_config.yaml``
# with its cache of pickled code, ``matplotlibrc``). Users run commands in campaign folders, and Snakemake starts every
# step in such a folder.

SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable that prevents Python, including ``python -m snakemake``, from importing from the working
folder."""

_SEARCHED = ("PATH", "PYTHONPATH")
_left: list[Path] = []


def leave_working_folder() -> None:
    """Change the working directory to the package folder and call `isolate`; `given` then resolves command-line paths.

    Raises
    ------
    FileNotFoundError
        If the working directory no longer exists.
    """
    _left[:] = [Path.cwd()]
    os.chdir(Path(__file__).parents[1])
    isolate()


def isolate() -> None:
    """Prevent imports and commands from the working directory, in this process and its child processes.

    Empty and relative entries of PATH, PYTHONPATH and ``sys.path``, which refer to the working directory, are removed.
    Snakemake itself adds such an entry, ``.snakemake/pip-deployments``.

    Examples
    --------
    >>> isolate()
    >>> os.environ["PYTHONSAFEPATH"], all(Path(path).is_absolute() for path in sys.path)
    ('1', True)
    """
    os.environ[SAFE_PATH] = "1"
    for name in _SEARCHED:
        if name in os.environ:
            os.environ[name] = os.pathsep.join(filter(_is_absolute, os.environ[name].split(os.pathsep)))
    sys.path[:] = filter(_is_absolute, sys.path)
    keep_caches_writable()


_CACHE, _MATPLOTLIB = "XDG_CACHE_HOME", "MPLCONFIGDIR"


def keep_caches_writable() -> None:
    """Redirect the caches of libraries to a private temporary folder if the home folder is read-only.

    Without a cache, Snakemake exits, and matplotlib warns and scans all fonts in every process.
    """
    cache, config = _user_folder(_CACHE, ".cache"), _user_folder("XDG_CONFIG_HOME", ".config")
    if not _is_writable(cache):
        os.environ[_CACHE] = str(_private_folder())
    if _MATPLOTLIB not in os.environ and not (config and _is_writable(config / "matplotlib")):
        os.environ[_MATPLOTLIB] = str(Path(os.environ.get(_CACHE) or cache or _private_folder()) / "matplotlib")


def _user_folder(variable: str, name: str) -> Path | None:
    """Return a folder of the XDG base directory specification; None if the user has no home folder."""
    if configured := os.environ.get(variable):
        return Path(configured)
    try:
        return Path.home() / name
    except RuntimeError:
        return None


def _is_writable(folder: Path | None) -> bool:
    """Return True if a folder is writable or can be created; permissions alone do not tell, such as below /proc."""
    while folder is not None and not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if folder is None:
        return False
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _private_folder() -> Path:
    """Return this user's folder in the temporary folder; a new folder if another user owns the standard name."""
    folder = Path(tempfile.gettempdir()) / f"apertura-cache-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    state = folder.lstat()
    is_private = stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o022
    return folder if is_private else Path(tempfile.mkdtemp(prefix=f"{folder.name}-"))


def _is_absolute(path: str) -> bool:
    return Path(path).is_absolute()


def given(path: Path) -> Path:
    """Resolve a path of the command line relative to the folder in which the command was started.

    Examples
    --------
    >>> given(Path("campaign")) == Path.cwd() / "campaign"
    True
    """
    return started() / path


def started() -> Path:
    """Return the folder in which the command was started."""
    return _left[0] if _left else Path.cwd()


def as_typed(text: object) -> str:
    """Shorten the paths in a text to paths relative to the folder in which the command was started.

    Examples
    --------
    >>> as_typed(Path.cwd() / "campaign" / "results"), as_typed(f"{Path.cwd()}/a: no such file")
    ('campaign/results', 'a: no such file')
    """
    folder = str(started())
    return str(text) if folder == os.sep else re.sub(rf"(?<![\w./-]){re.escape(folder)}{os.sep}", "", str(text))


# ---- Confinement of Snakemake ---------------------------------------------------------------------------------------
#
# Snakemake and the shells of its jobs write and delete files (records in .snakemake, logs, benchmarks, outputs of
# failed jobs) by full path, in which the kernel follows links. Landlock (Linux 5.19 and newer, landlock(7)) prevents a
# process and its child processes from changing anything outside a list of folders, also through links.

CONFINED = "APERTURA_CONFINED"
"""Environment variable: campaign folder to which changes by Snakemake are confined."""

TEMPORARY = ("TMPDIR", "TMP", "TEMP", "TEMPDIR")
"""Environment variables for the folder of temporary files; Snakemake sets all of these variables for its jobs."""

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # system calls, the same on every architecture
_VERSION, _PATH_BENEATH, _PR_SET_NO_NEW_PRIVS = 1, 1, 38
_CHANGES = sum(1 << right for right in (1, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13))
"""Landlock rights: write files; remove and create folders and files of every type; move files between folders."""
_TRUNCATE, _MOVES, _TRUNCATES = 1 << 14, 2, 3
"""Landlock right to truncate files; Landlock ABI versions that support moves and truncation."""


def confine_changes(root: Path, *others: Path) -> bool:
    """Prevent this process and its child processes from changing files outside results and caches.

    The following folders remain writable: ``results`` and ``.snakemake`` of the campaign (the latter also for temporary
    files), the user's cache, the package folder with its compiled code, and the folders of devices and processes.
    Recordings and config are read-only.

    Parameters
    ----------
    root
        The campaign folder.
    *others
        Further writable folders.

    Returns
    -------
    bool
        True if confined; False if the kernel has no Landlock or only an older version. In this case, only the check
        before a run detects links.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    version = libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _VERSION)
    if version < _MOVES:
        return False
    rights = _CHANGES | (_TRUNCATE if version >= _TRUNCATES else 0)
    ruleset = libc.syscall(_CREATE_RULESET, struct.pack("=Q", rights), ctypes.c_size_t(8), 0)
    cache = _user_folder(_CACHE, ".cache") or _private_folder()
    with suppress(OSError):  # created now, because Snakemake cannot create it once changes are confined
        cache.mkdir(parents=True, exist_ok=True)
    folders = [*others, cache, Path(__file__).parents[1], Path("/dev"), Path("/proc")]
    with ExitStack() as stack:
        for name in ("results", ".snakemake"):
            folder = ConfinedPath.at(root) / name
            folder.mkdir(exist_ok=True)
            folders.append(stack.enter_context(folder.on_disk()))
        os.environ[TEMPORARY[0]] = tempfile.tempdir = str(folder.absolute())
        for writable in filter(Path.is_dir, folders):
            opened = os.open(writable, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
            libc.syscall(_ADD_RULE, ruleset, _PATH_BENEATH, struct.pack("=Qi", rights, opened), 0)
            os.close(opened)
    libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    confined: bool = libc.syscall(_RESTRICT_SELF, ruleset, 0) == 0
    os.close(ruleset)
    return confined


# ---- Lock of a campaign: one run at a time; the lock is released when its process exits -----------------------------

_LOCK = Path("results/.run.lock")
_TRIES, _BETWEEN_S = 20, 0.02


def hold(root: Path) -> IO[str]:
    """Lock a campaign folder until the returned file is closed or this process exits.

    Raises
    ------
    CampaignError
        If another process holds the lock; the message contains process ID, machine and start time.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder, hold(Path(folder)):
    ...     hold(Path(folder))
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: ...: the campaign is locked by another run: process ...; expected ...
    """
    path = ConfinedPath.at(root) / _LOCK
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.open("a+", encoding="utf-8")
    try:
        _take(lock)
    except BlockingIOError:
        holder = _read_holder(lock)
        lock.close()
        raise CampaignError(
            f"the campaign is locked by another run: {holder}",
            where=root,
            expected="one run at a time",
            remedy="Wait until that run finishes, or stop it.",
        ) from None
    lock.truncate(0)
    lock.write(f"process {os.getpid()} on {socket.gethostname()} since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC\n")
    lock.flush()
    return lock


def holder(root: Path) -> str | None:
    """Return process ID, machine and start time of the holder of a campaign's lock; None if it is not locked.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder, hold(Path(folder)):
    ...     holder(Path(folder))
    'process ... on ... since ... UTC'
    """
    try:
        with (ConfinedPath.at(root) / _LOCK).open(encoding="utf-8") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return _read_holder(lock)
    except FileNotFoundError:
        pass
    return None


def _take(lock: IO[str]) -> None:
    """Acquire the lock; retry, because `holder` acquires the lock for an instant."""
    for attempt in range(_TRIES):
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if attempt == _TRIES - 1:
                raise
            time.sleep(_BETWEEN_S)


def _read_holder(lock: IO[str]) -> str:
    lock.seek(0)
    return shown(lock.read(200).strip() or "a process that has just started", 200)
