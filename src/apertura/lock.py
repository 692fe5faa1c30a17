"""One run of a campaign at a time: a kernel lock that dies with its process, and says who holds it."""

import fcntl
import os
import socket
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from apertura.errors import CampaignError

_LOCK = Path("results/.run.lock")


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
    apertura.errors.CampaignError: ...: another run holds this campaign: process ... on ... since ...; expected ...
    """
    path = root / _LOCK
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.open("a+", encoding="utf-8")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.seek(0)
        holder = lock.read(200).strip() or "one that has just begun"
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
