"""What happened in a run so far, by the journal that it keeps in the campaign folder; and why it failed."""

import json
import re
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from apertura.common.errors import CampaignError, shown

JOURNAL = "APERTURA_JOURNAL"
"""Environment variable: where the journal of a run is written."""

RECORDER, NAME = "apertura.run.recorder", "apertura"
"""Module that is snakemake with a journal, and the name of its logger plugin."""

_STEP = re.compile(r"\bapertura step ((?:[\w.-]+ ?)+)")
LAST_S = float(1 << 33)
"""Times from here on, in the year 2242, are none."""

_LONGEST = 1 << 26  # bytes of a journal; 10^5 jobs write 3·10^7
_NO_STEPS = {"all", "total"}


def step_of(command: str | None, rule: str, wildcards: Sequence[str]) -> tuple[str, ...]:
    """Return the words by which a person knows a job: those of its step.

    Examples
    --------
    >>> step_of("apertura step image f01 uav1-uav2 --threads 4 > a.log", "image", ["f01", "uav1-uav2"])
    ('image', 'f01', 'uav1-uav2')
    >>> step_of("apertura study claims", "paper_claims", ["lab"])
    ('paper_claims', 'lab')
    """
    found = _STEP.search(command or "")
    words = found[1].split() if found else [rule, *wildcards]
    first_option = next((at for at, word in enumerate(words) if word.startswith("-")), len(words))
    return tuple(words[:first_option])


@dataclass
class JobRecord:
    """A job that began.

    Attributes
    ----------
    rule, step
        Which rule, and the words of its step.
    log
        What the step says, relative to the campaign folder; empty if nothing.
    begun_s, ended_s
        Seconds since the epoch; None while it runs.
    failed
        Whether it failed.
    """

    rule: str
    step: tuple[str, ...]
    log: str
    begun_s: float
    ended_s: float | None = None
    failed: bool = False

    @property
    def name(self) -> str:
        """The words of the step, as a terminal may show them."""
        return shown(" ".join(self.step))

    @property
    def running(self) -> bool:
        """Whether it has begun and not ended."""
        return self.ended_s is None

    def seconds(self, now_s: float | None = None) -> float:
        """Return how long it took, or has been running."""
        return (self.ended_s or now_s or time.time()) - self.begun_s


@dataclass
class RunRecord:
    """A run as its journal tells it.

    Attributes
    ----------
    planned
        Rule → number of jobs, as planned before the first.
    jobs
        Number of a job → the job, of those that began.
    said
        Errors of the workflow itself.
    cores
        That it uses at once; 0 on a cluster.
    status
        Exit status; None while it runs, or after it was killed.
    begun_s, ended_s
        Seconds since the epoch.
    """

    planned: dict[str, int] = field(default_factory=dict)
    jobs: dict[int, JobRecord] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    cores: int = 0
    status: int | None = None
    begun_s: float = 0.0
    ended_s: float | None = None

    @property
    def finished(self) -> list[JobRecord]:
        """Jobs that ended well."""
        return [job for job in self.jobs.values() if not job.running and not job.failed]

    @property
    def running(self) -> list[JobRecord]:
        """Jobs under way, the oldest first."""
        return [job for job in self.jobs.values() if job.running]

    @property
    def failed(self) -> list[JobRecord]:
        """Jobs that failed, and were not tried again."""
        return [job for job in self.jobs.values() if job.failed]

    @property
    def total(self) -> int:
        """How many jobs there are to do."""
        return max(sum(self.planned.values()), len(self.jobs))

    @property
    def waiting(self) -> Counter[str]:
        """Rule → jobs that have not begun."""
        return Counter(self.planned) - Counter(job.rule for job in self.jobs.values())

    def take(self, line: Mapping[str, Any]) -> None:
        """Take a line of the journal; one that makes no sense is left out."""
        with suppress(KeyError, TypeError, ValueError, AttributeError):
            if 0 <= (at := float(line["at"])) < LAST_S:
                self._take(str(line["event"]), at, line)

    def _take(self, event: str, at: float, line: Mapping[str, Any]) -> None:
        if event == "planned":
            self.planned = {str(rule): int(count) for rule, count in line["jobs"].items() if rule not in _NO_STEPS}
        elif event == "begun" and line["rule"] not in _NO_STEPS:
            step = tuple(str(word) for word in line["step"])
            self.jobs[int(line["job"])] = JobRecord(str(line["rule"]), step, str(line["log"]), at)
        elif event in {"finished", "failed"} and line["job"] in self.jobs:
            job = self.jobs[line["job"]]
            job.ended_s, job.failed = at, event == "failed"
        elif event == "said":
            self.said.append(str(line["message"]))
        elif event == "start":
            self.begun_s, self.cores = at, int(line["cores"])
        elif event == "end":
            self.status, self.ended_s = int(line["status"]), at


class JournalReader:
    """Follows a journal as it grows.

    Parameters
    ----------
    path
        The journal; it may not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.run = path, RunRecord()
        self._read, self._rest = 0, b""

    def news(self) -> RunRecord:
        """Return the run as it is told by now."""
        with suppress(FileNotFoundError), self.path.open("rb") as journal:
            journal.seek(self._read)
            data = journal.read(max(0, _LONGEST - self._read))
            self._read += len(data)
            *lines, self._rest = (self._rest + data).split(b"\n")
            for line in lines:
                with suppress(ValueError, RecursionError):
                    self.run.take(json.loads(line))
        return self.run


def note(path: Path, event: str, **told: Any) -> None:
    """Write a line of the journal."""
    with path.open("a", encoding="utf-8") as journal:
        journal.write(json.dumps({"at": round(time.time(), 2), "event": event, **told}) + "\n")


_TAIL = 1 << 16
"""Bytes of a log that are looked at."""
_SAID = "error: "


def failures(root: Path, run: RunRecord, log: Path) -> Iterator[str]:
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
    messages: dict[str, list[str]] = {}
    for job in run.failed:
        messages.setdefault(_message(root / job.log if job.log else None), []).append(job.log)
    if not messages:
        last = [_installable(line) for line in _tail(log)[-1:]]
        messages = {shown(" ".join(message.split()), 2000): [] for message in run.said or last}
    for message, logs in messages.items():
        yield f"error: {message.removeprefix(_SAID)}"
        for name in filter(None, logs):
            yield f"  log of the step: {shown(root / name, 400)}"
    if log.is_relative_to(root):  # that of a dry run is not kept
        yield f"  log of snakemake: {shown(log, 400)}"


def a_step_was_killed(root: Path, run: RunRecord) -> bool:
    """Return whether a failed step of a run has left no message in its log."""
    return any(_message(root / job.log) == _KILLED for job in run.failed if job.log)


_KILLED = "a step exited without a message: it was killed, perhaps for lack of memory, or its machine went down"
_NO_EXECUTOR = re.compile(r"argument --executor/-e: invalid choice: '([\w-]+)'")


def _installable(line: str) -> str:
    """Return an error of snakemake's command line, or what to install for the executor that it does not have.

    Examples
    --------
    >>> _installable("snakemake: error: argument --executor/-e: invalid choice: 'slurm' (choose from 'local')")
    "executor 'slurm' is not installed. Install it beside apertura: pip install snakemake-executor-plugin-slurm"
    """
    if not (named := _NO_EXECUTOR.search(line)):
        return line
    plugin = f"snakemake-executor-plugin-{named[1]}"
    return f"executor {named[1]!r} is not installed. Install it beside apertura: pip install {plugin}"


def _message(log: Path | None) -> str:
    lines = _tail(log) if log else []
    for line in reversed(lines):
        if line.startswith(_SAID):
            return shown(line, 2000)
    if any(line.startswith("Traceback") for line in lines):
        return f"internal error, please report it with the log: {shown(lines[-1], 2000)}"
    return _KILLED


def _tail(log: Path) -> list[str]:
    """Return the last lines of a log that hold something."""
    with suppress(OSError, CampaignError), log.open("rb") as stream:
        stream.seek(max(0, log.stat().st_size - _TAIL))
        return [line for line in stream.read().decode("utf-8", "replace").splitlines() if line.strip()]
    return []
