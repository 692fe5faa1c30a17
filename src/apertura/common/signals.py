"""How a command ends: signals that close what is open, and a status that the run around it hears of."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

INTERRUPTED = 130
STATUS_FILE = "APERTURA_STATUS_FILE"
"""Environment variable: where steps leave the exit status that snakemake does not pass on."""

_ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class Interrupted(SystemExit):
    """A signal asked this process to end."""


def leave_status(status: int) -> None:
    """Tell the run that this step belongs to, if any, how the step ended."""
    if STATUS_FILE in os.environ and status:
        with suppress(OSError), Path(os.environ[STATUS_FILE]).open("a", encoding="utf-8") as said:  # on another node
            said.write(f"{status}\n")


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Turn SIGTERM, SIGINT and SIGHUP into `Interrupted`, so that whatever is open is closed on the way out."""

    def end(number: int, _: FrameType | None) -> None:
        for other in _ENDING:
            signal.signal(other, signal.SIG_IGN)
        raise Interrupted(f"interrupted by {signal.Signals(number).name}")

    before = {number: signal.signal(number, end) for number in _ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
