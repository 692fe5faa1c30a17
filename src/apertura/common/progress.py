"""Progress reports of a step: a small file in the campaign folder, which the run and `apertura status` read."""

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from apertura.common.errors import CampaignError

RUN = ".run"
"""Subfolder of the results: journal of the run, and a progress file for each running step."""

_BETWEEN_S = 1.0
_files: list[Path] = []
"""Progress file of this process; empty outside a step of a campaign."""


def progress_path(step: Sequence[str]) -> tuple[str, ...]:
    """Return the path of a step's progress file, as components relative to the results.

    Parameters
    ----------
    step
        Arguments of ``apertura step``: step name, flight and pair.

    Examples
    --------
    >>> print(*progress_path(["image", "f01", "uav1-uav2"]), sep="/")
    .run/steps/image/f01/uav1-uav2.json
    """
    *folders, name = step
    return RUN, "steps", *folders, f"{name}.json"


@contextmanager
def reporting_to(file: Path) -> Iterator[None]:
    """Write the progress reported in the context to `file`; remove the file on exit."""
    _files.append(file)
    try:
        yield
    finally:
        _files.remove(file)
        with suppress(OSError, CampaignError):
            file.unlink(missing_ok=True)


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Report the progress of a step at most once a second; outside `reporting_to`, nothing is written.

    Parameters
    ----------
    what
        Unit of work, such as ``tiles`` or ``pulses``.
    total
        Number of units.

    Yields
    ------
    callable
        Function that adds a number of finished units; it may be called from any thread.

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
    """Replace the file atomically; a failure to write the file never stops the step."""
    report = {"what": what, "done": done, "total": total, "since": since_s, "at": round(time.time(), 1)}
    for file in _files[-1:]:
        partial = file.with_suffix(".partial")
        with suppress(OSError, CampaignError):
            file.parent.mkdir(parents=True, exist_ok=True)
            partial.write_text(json.dumps(report))
            partial.replace(file)
