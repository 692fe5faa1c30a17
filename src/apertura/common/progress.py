"""How far a step is: a small file in the campaign folder that the run around it, and `apertura status`, look at."""

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

RUN = ".run"
"""Folder of the results: what a run keeps of itself, its journal and a file for each step under way."""

_BETWEEN_S = 1.0
_told_in: list[Path] = []
"""Where this process tells; empty where it is no step of a campaign."""


def told_at(step: Sequence[str]) -> tuple[str, ...]:
    """Return where below the results a step tells how far it is.

    Parameters
    ----------
    step
        The words after ``apertura step``: its name, flight and pair.

    Examples
    --------
    >>> print(*told_at(["image", "f01", "uav1-uav2"]), sep="/")
    .run/steps/image/f01/uav1-uav2.json
    """
    *folders, name = step
    return RUN, "steps", *folders, f"{name}.json"


@contextmanager
def telling(file: Path) -> Iterator[None]:
    """Tell in `file` what `progress` reports meanwhile; it goes when the step ends."""
    _told_in.append(file)
    try:
        yield
    finally:
        _told_in.remove(file)
        with suppress(OSError):
            file.unlink(missing_ok=True)


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Tell how much of a step's work is done, at most once a second; nothing where nobody asked (`telling`).

    Parameters
    ----------
    what
        Of which work is counted: ``tiles``, ``pulses``.
    total
        How many there are.

    Yields
    ------
    callable
        Takes how many more are done; from any thread.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder, telling(Path(folder, "image.json")), progress("tiles", 8) as done:
    ...     done(2)
    ...     print(Path(folder, "image.json").read_text())
    {"what": "tiles", "done": 0, "total": 8, "since": ..., "at": ...}
    """
    lock, finished, told_s, since_s = threading.Lock(), 0, time.monotonic(), round(time.time(), 1)

    def done(more: int) -> None:
        nonlocal finished, told_s
        with lock:
            finished += more
            if (now := time.monotonic()) - told_s >= _BETWEEN_S:
                told_s = now
                _tell(what, finished, total, since_s)

    _tell(what, 0, total, since_s)
    yield done
    _tell(what, finished, total, since_s)


def _tell(what: str, done: int, total: int, since_s: float) -> None:
    """Write the file anew, whole at any instant; what only shows how far a step is never ends it."""
    report = {"what": what, "done": done, "total": total, "since": since_s, "at": round(time.time(), 1)}
    for file in _told_in[-1:]:
        beside = file.with_suffix(".partial")
        with suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            beside.write_text(json.dumps(report))
            beside.replace(file)
