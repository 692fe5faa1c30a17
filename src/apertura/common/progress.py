"""Progress of a step: a small file in the campaign folder, read by the run and by `apertura status`."""

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from apertura.common.errors import CampaignError

RUN = ".run"
"""Folder of the results: journal of a run, and a progress file for each running step."""

_BETWEEN_S = 1.0
_files: list[Path] = []
"""Progress file of this process; empty outside a step of a campaign."""


def progress_path(step: Sequence[str]) -> tuple[str, ...]:
    """Return the progress file of a step, as parts of a path below the results.

    Parameters
    ----------
    step
        The words after ``apertura step``: its name, flight and pair.

    Examples
    --------
    >>> print(*progress_path(["image", "f01", "uav1-uav2"]), sep="/")
    .run/steps/image/f01/uav1-uav2.json
    """
    *folders, name = step
    return RUN, "steps", *folders, f"{name}.json"


@contextmanager
def reporting_to(file: Path) -> Iterator[None]:
    """Write the progress reported in the body to `file`; remove it at the end."""
    _files.append(file)
    try:
        yield
    finally:
        _files.remove(file)
        with suppress(OSError, CampaignError):
            file.unlink(missing_ok=True)


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Report how much of a step's work is done, at most once a second; nothing outside `reporting_to`.

    Parameters
    ----------
    what
        Unit of work: ``tiles``, ``pulses``.
    total
        How many there are.

    Yields
    ------
    callable
        Takes how many more are done; from any thread.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder, reporting_to(Path(folder, "image.json")), progress("tiles", 8) as done:
    ...     done(2)
    ...     print(Path(folder, "image.json").read_text())
    {"what": "tiles", "done": 0, "total": 8, "since": ..., "at": ...}
    """
    lock, finished, written_s, since_s = threading.Lock(), 0, time.monotonic(), round(time.time(), 1)

    def done(more: int) -> None:
        nonlocal finished, written_s
        with lock:
            finished += more
            if (now := time.monotonic()) - written_s >= _BETWEEN_S:
                written_s = now
                _write(what, finished, total, since_s)

    _write(what, 0, total, since_s)
    yield done
    _write(what, finished, total, since_s)


def _write(what: str, done: int, total: int, since_s: float) -> None:
    """Replace the file atomically; a failure to report never ends a step."""
    report = {"what": what, "done": done, "total": total, "since": since_s, "at": round(time.time(), 1)}
    for file in _files[-1:]:
        beside = file.with_suffix(".partial")
        with suppress(OSError, CampaignError):
            file.parent.mkdir(parents=True, exist_ok=True)
            beside.write_text(json.dumps(report))
            beside.replace(file)
