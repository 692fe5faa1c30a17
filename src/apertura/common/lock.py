"""One run of a campaign at a time: a kernel lock that dies with its process, and says who holds it."""

import fcntl
import os
import socket
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from apertura.common.errors import CampaignError, shown

_LOCK = Path("results/.run.lock")
_TRIES, _BETWEEN_S = 20, 0.02


def hold(root: Path) -> IO[str]:
    """Hold a campaign folder until the file returned is closed, or its process ends.

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
    path = root / _LOCK
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.open("a+", encoding="utf-8")
    try:
        _take(lock)
    except BlockingIOError:
        held = _said(lock)
        lock.close()
        raise CampaignError(
            f"another run holds this campaign: {held}",
            where=root,
            expected="one run at a time",
            remedy="Wait until it ends, or end it.",
        ) from None
    lock.truncate(0)
    lock.write(f"process {os.getpid()} on {socket.gethostname()} since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC\n")
    lock.flush()
    return lock


def holder(root: Path) -> str | None:
    """Return who holds a campaign folder: process, machine, since when; None if nobody does.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder, hold(Path(folder)):
    ...     holder(Path(folder))
    'process ... on ... since ... UTC'
    """
    try:
        with (root / _LOCK).open(encoding="utf-8") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return _said(lock)
    except FileNotFoundError:
        pass
    return None


def _take(lock: IO[str]) -> None:
    """Take the lock; whoever only asks who holds it has it for an instant, and is waited for."""
    for attempt in range(_TRIES):
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if attempt == _TRIES - 1:
                raise
            time.sleep(_BETWEEN_S)


def _said(lock: IO[str]) -> str:
    lock.seek(0)
    return shown(lock.read(200).strip() or "one that has just begun", 200)
