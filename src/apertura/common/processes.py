"""Processes of a run: one at a time, apart from the folder's own code, and ended with what they opened closed."""

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

# ---- End of a command: signals, and the exit status for the run around it -------------------------------------------

INTERRUPTED = 130
SIGNALLED = 128
"""Exit status of a process that a signal has ended, as shells count: this and the number of the signal."""
STATUS_FILE = "APERTURA_STATUS_FILE"
"""Environment variable: where steps leave the exit status that snakemake does not pass on, as a reference of
`ConfinedPath`."""

ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""Signals that end a run."""

ALGEBRA_THREADS = "OPENBLAS_NUM_THREADS"
"""Environment variable, read when numpy is imported: 1 in every command. Only products of small matrices are left to
OpenBLAS, whose threads wait on each other longer than they compute (simulating the demo: 6.8 CPU seconds with two, 1.9
with one); engines have threads of their own. What is computed then has the same bits on any number of cores."""

_PR_SET_PDEATHSIG = 1  # of prctl(2)


class Interrupted(SystemExit):
    """The process was ended by a signal."""


def leave_status(status: int) -> None:
    """Write the exit status of a step for the run that it belongs to, if any."""
    if STATUS_FILE in os.environ and status:
        file = ConfinedPath.referenced(os.environ[STATUS_FILE])
        with suppress(OSError, CampaignError), file.open("a", encoding="utf-8") as stream:  # on another node
            stream.write(f"{status}\n")


def die_with_parent(parent: int) -> None:
    """Ask the kernel to end this process with its parent, also where that is killed outright.

    Parameters
    ----------
    parent
        Number of the process that started this one: it may have ended by now.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(SIGNALLED + signal.SIGKILL)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Turn SIGTERM, SIGINT and SIGHUP into `Interrupted`, so that whatever is open is closed on the way out."""

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


# ---- Isolation from an untrusted working folder ---------------------------------------------------------------------
#
# Python and libraries take modules and settings from the working folder (``yaml.py``, numba's ``.numba_config.yaml``
# with its cache of pickled code, ``matplotlibrc``). Commands are typed in campaign folders, and Snakemake starts
# every step in one.

SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable: Python then imports nothing from the working folder; ``python -m snakemake`` of a job, too."""

_SEARCHED = ("PATH", "PYTHONPATH")
_left: list[Path] = []


def leave_working_folder() -> None:
    """Make the package's own folder the working folder, and `isolate`; typed paths are then resolved by `given`.

    Raises
    ------
    FileNotFoundError
        If the working folder is gone.
    """
    _left[:] = [Path.cwd()]
    os.chdir(Path(__file__).parents[1])
    isolate()


def isolate() -> None:
    """Prevent imports and commands from the working folder, in this process and in those that it starts.

    Empty and relative entries of PATH, PYTHONPATH and ``sys.path`` mean whatever folder is the working one: Snakemake
    adds ``.snakemake/pip-deployments`` itself.

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
    """Point the caches of libraries at a folder of this user in the temporary folder where the home is read-only.

    Snakemake ends without its cache; matplotlib warns, and scans all fonts in every process.
    """
    cache, config = (_user_folder(*one) for one in ((_CACHE, ".cache"), ("XDG_CONFIG_HOME", ".config")))
    if not _is_writable(cache):
        os.environ[_CACHE] = str(_private_folder())
    if _MATPLOTLIB not in os.environ and not (config and _is_writable(config / "matplotlib")):
        os.environ[_MATPLOTLIB] = str(Path(os.environ.get(_CACHE) or cache or _private_folder()) / "matplotlib")


def _user_folder(variable: str, name: str) -> Path | None:
    """Return a folder of the XDG base directory specification; None where the user has no home."""
    if stated := os.environ.get(variable):
        return Path(stated)
    try:
        return Path.home() / name
    except RuntimeError:
        return None


def _is_writable(folder: Path | None) -> bool:
    """Test whether a folder can be written to, or made."""
    while folder is not None and not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder is not None and folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def _private_folder() -> Path:
    """Return this user's folder below the temporary folder; a new one where the usual name is not this user's."""
    folder = Path(tempfile.gettempdir()) / f"apertura-cache-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    private = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return folder if private else Path(tempfile.mkdtemp(prefix=f"{folder.name}-"))


def _is_absolute(path: str) -> bool:
    return Path(path).is_absolute()


def given(path: Path) -> Path:
    """Return a path that a person typed as an absolute one: it counts from where the command was started.

    Examples
    --------
    >>> given(Path("campaign")) == Path.cwd() / "campaign"
    True
    """
    return started() / path


def started() -> Path:
    """Return the folder that the command was started in."""
    return _left[0] if _left else Path.cwd()


def as_typed(text: object) -> str:
    """Return a path, or a message with paths, as a person would type them where the command was started.

    Examples
    --------
    >>> as_typed(Path.cwd() / "campaign" / "results"), as_typed(f"{Path.cwd()}/a: no such file")
    ('campaign/results', 'a: no such file')
    """
    folder = str(started())
    return str(text) if folder == os.sep else re.sub(rf"(?<![\w./-]){re.escape(folder)}{os.sep}", "", str(text))


# ---- Confinement of Snakemake ---------------------------------------------------------------------------------------
#
# Snakemake, and the shells of its jobs, write and delete by whole names, in which the kernel follows links: records in
# .snakemake, logs, benchmarks, outputs of failed jobs. Landlock (Linux 5.19 and newer, landlock(7)) keeps a process and
# all that it starts from changing anything outside some folders, wherever a link leads.

CONFINED = "APERTURA_CONFINED"
"""Environment variable: the campaign folder to which Snakemake's changes are confined."""

TEMPORARY = ("TMPDIR", "TMP", "TEMP", "TEMPDIR")
"""Environment variables: where temporary files go; Snakemake sets all of them for its jobs."""

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # system calls, the same on every architecture
_VERSION, _PATH_BENEATH, _PR_SET_NO_NEW_PRIVS = 1, 1, 38
_CHANGES = sum(1 << right for right in (1, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13))
"""Rights of Landlock: write a file; remove and make folders and files of every kind; move between folders."""
_TRUNCATE, _MOVES, _TRUNCATES = 1 << 14, 2, 3
"""Right to truncate, and the versions of Landlock that know moves and truncation."""


def confine_changes(root: Path, *others: Path) -> bool:
    """Keep this process, and all that it starts, from changing files but for results and caches; return whether it is.

    What stays writable: ``results`` and ``.snakemake`` of the campaign, the latter for temporary files, too; the user's
    cache, the package's own compiled code, and devices. Recordings and config do not.

    Parameters
    ----------
    root
        The campaign folder.
    *others
        Further folders whose files may be changed.

    Returns
    -------
    bool
        False where the kernel has no Landlock, or too old a one: links are then found by the check before a run alone.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    version = libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _VERSION)
    if version < _MOVES:
        return False
    rights = _CHANGES | (_TRUNCATE if version >= _TRUNCATES else 0)
    ruleset = libc.syscall(_CREATE_RULESET, struct.pack("=Q", rights), ctypes.c_size_t(8), 0)
    cache = _user_folder(_CACHE, ".cache") or _private_folder()
    with suppress(OSError):  # of a new account it is not there yet, and Snakemake would make it
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


# ---- Lock of a campaign: one run at a time, released with its process -----------------------------------------------

_LOCK = Path("results/.run.lock")
_TRIES, _BETWEEN_S = 20, 0.02


def hold(root: Path) -> IO[str]:
    """Lock a campaign folder until the returned file is closed, or its process ends.

    Raises
    ------
    CampaignError
        If another process holds it: which, on which machine, since when.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder, hold(Path(folder)):
    ...     hold(Path(folder))
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: ...: another run holds this campaign: process ...; expected ...
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
            f"another run holds this campaign: {holder}",
            where=root,
            expected="one run at a time",
            remedy="Wait until it ends, or end it.",
        ) from None
    lock.truncate(0)
    lock.write(f"process {os.getpid()} on {socket.gethostname()} since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC\n")
    lock.flush()
    return lock


def holder(root: Path) -> str | None:
    """Return the holder of a campaign's lock: process, machine, start; None if it is free.

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
    """Take the lock; wait for `holder`, which has it for an instant."""
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
    return shown(lock.read(200).strip() or "one that has just begun", 200)
