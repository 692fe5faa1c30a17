"""Why a run failed: the message of each step that did, once, and where to read on."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from apertura.common.errors import shown
from apertura.pipeline.runs.journal import Run

_TAIL = 1 << 16
"""Bytes of a log that are looked at."""
_SAID = "error: "


def failures(root: Path, run: Run, log: Path) -> Iterator[str]:
    """Yield what to tell of a run that failed: messages of steps, or what the workflow said, and the logs.

    Parameters
    ----------
    root
        The campaign folder.
    run
        As its journal tells it.
    log
        Of snakemake.
    """
    told: dict[str, list[str]] = {}
    for job in run.failed:
        told.setdefault(_message(root / job.log if job.log else None), []).append(job.log)
    if not told:
        told = {shown(" ".join(message.split()), 2000): [] for message in run.said or _tail(log)[-1:]}
    for message, logs in told.items():
        yield f"error: {message.removeprefix(_SAID)}"
        for name in filter(None, logs):
            yield f"  log of the step: {shown(root / name, 400)}"
    if log.is_relative_to(root):  # that of a dry run is not kept
        yield f"  log of snakemake: {shown(log, 400)}"


def _message(log: Path | None) -> str:
    lines = _tail(log) if log else []
    for line in reversed(lines):
        if line.startswith(_SAID):
            return shown(line, 2000)
    if any(line.startswith("Traceback") for line in lines):
        return f"a defect of ours, please report it with the log: {shown(lines[-1], 2000)}"
    return "a step ended without a word: was it killed, or did its machine end?"


def _tail(log: Path) -> list[str]:
    """Return the last lines of a log that hold something."""
    with suppress(OSError), log.open("rb") as stream:
        stream.seek(max(0, log.stat().st_size - _TAIL))
        return [line for line in stream.read().decode("utf-8", "replace").splitlines() if line.strip()]
    return []
