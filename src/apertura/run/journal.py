"""Journal of a run in the campaign folder: writing, reading the state of a run, and messages of a failed run."""

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
"""Environment variable: path of the journal of a run."""

RECORDER, NAME = "apertura.run.recorder", "apertura"
"""Module that runs Snakemake with a journal, and name of the logger plugin."""

_STEP = re.compile(r"\bapertura step ((?:[\w.-]+ ?)+)")
LAST_S = float(1 << 33)
"""Upper limit of valid times, seconds since the epoch: year 2242."""

_LONGEST = 1 << 26  # maximum number of bytes read from a journal; 10^5 jobs write 3·10^7 bytes
_NO_STEPS = {"all", "total"}


def step_of(command: str | None, rule: str, wildcards: Sequence[str]) -> tuple[str, ...]:
    """Return the step name and arguments of a job, for display.

    Examples
    --------
    >>> step_of("apertura step image f01 uav1-uav2 --threads 4 > a.log", "image", ["f01", "uav1-uav2"])
    ('image', 'f01', 'uav1-uav2')
    >>> step_of("apertura study claims", "paper_claims", ["lab"])
    ('paper_claims', 'lab')
    """
    match = _STEP.search(command or "")
    words = match[1].split() if match else [rule, *wildcards]
    first_option = next((at for at, word in enumerate(words) if word.startswith("-")), len(words))
    return tuple(words[:first_option])


@dataclass
class JobRecord:
    """Job that has started.

    Attributes
    ----------
    rule, step
        Name of the rule; step name and arguments.
    log
        Log of the step, relative to the campaign folder; empty if the step has no log.
    begun_s, ended_s
        Start and end, seconds since the epoch; `ended_s` is None while the job runs.
    failed
        True if the job failed.
    """

    rule: str
    step: tuple[str, ...]
    log: str
    begun_s: float
    ended_s: float | None = None
    failed: bool = False

    @property
    def name(self) -> str:
        """Step name and arguments, safe for a terminal."""
        return shown(" ".join(self.step))

    @property
    def running(self) -> bool:
        """True if the job has not finished."""
        return self.ended_s is None

    def seconds(self, now_s: float | None = None) -> float:
        """Return the duration of the job, or its duration so far if it is running, seconds."""
        return (self.ended_s or now_s or time.time()) - self.begun_s


@dataclass
class RunRecord:
    """State of a run according to its journal.

    Attributes
    ----------
    planned
        Rule → number of jobs, as planned before the first job.
    jobs
        Job number → job, for jobs that have started.
    errors
        Error messages of Snakemake.
    cores
        Number of cores used; 0 on a cluster.
    status
        Exit status; None while the run is in progress, or if it was killed.
    begun_s, ended_s
        Start and end, seconds since the epoch.
    """

    planned: dict[str, int] = field(default_factory=dict)
    jobs: dict[int, JobRecord] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    cores: int = 0
    status: int | None = None
    begun_s: float = 0.0
    ended_s: float | None = None

    @property
    def finished(self) -> list[JobRecord]:
        """Jobs that succeeded."""
        return [job for job in self.jobs.values() if not job.running and not job.failed]

    @property
    def running(self) -> list[JobRecord]:
        """Running jobs, in the order of their start."""
        return [job for job in self.jobs.values() if job.running]

    @property
    def failed(self) -> list[JobRecord]:
        """Jobs that failed and were not restarted."""
        return [job for job in self.jobs.values() if job.failed]

    @property
    def total(self) -> int:
        """Total number of jobs."""
        return max(sum(self.planned.values()), len(self.jobs))

    @property
    def waiting(self) -> Counter[str]:
        """Rule → number of jobs that have not started."""
        return Counter(self.planned) - Counter(job.rule for job in self.jobs.values())

    def take(self, line: Mapping[str, Any]) -> None:
        """Apply a line of the journal; invalid lines are ignored."""
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
            self.errors.append(str(line["message"]))
        elif event == "start":
            self.begun_s, self.cores = at, int(line["cores"])
        elif event == "end":
            self.status, self.ended_s = int(line["status"]), at


class JournalReader:
    """Incremental reader of a growing journal.

    Parameters
    ----------
    path
        Path of the journal, which need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.run = path, RunRecord()
        self._read, self._rest = 0, b""

    def news(self) -> RunRecord:
        """Read new lines and return the current state of the run."""
        with suppress(FileNotFoundError), self.path.open("rb") as journal:
            journal.seek(self._read)
            data = journal.read(max(0, _LONGEST - self._read))
            self._read += len(data)
            *lines, self._rest = (self._rest + data).split(b"\n")
            for line in lines:
                with suppress(ValueError, RecursionError):
                    self.run.take(json.loads(line))
        return self.run


def note(path: Path, event: str, **values: Any) -> None:
    """Append a line to the journal."""
    with path.open("a", encoding="utf-8") as journal:
        journal.write(json.dumps({"at": round(time.time(), 2), "event": event, **values}) + "\n")


_TAIL = 1 << 16
"""Number of bytes at the end of a log that are read."""
_ERROR_PREFIX = "error: "


def failures(root: Path, run: RunRecord, log: Path) -> Iterator[str]:
    """Yield the error report of a failed run: messages of steps or of Snakemake, and paths of the logs.

    Parameters
    ----------
    root
        The campaign folder.
    run
        State of the run.
    log
        Log of Snakemake.
    """
    messages: dict[str, list[str]] = {}
    for job in run.failed:
        messages.setdefault(_message(root / job.log if job.log else None), []).append(job.log)
    if not messages:
        last = [_installable(line) for line in _tail(log)[-1:]]
        messages = {shown(" ".join(message.split()), 2000): [] for message in run.errors or last}
    for message, logs in messages.items():
        yield f"error: {message.removeprefix(_ERROR_PREFIX)}"
        for name in filter(None, logs):
            yield f"  log of the step: {shown(root / name, 400)}"
    if log.is_relative_to(root):  # the log of a dry run is not kept
        yield f"  log of Snakemake: {shown(log, 400)}"


def a_step_was_killed(root: Path, run: RunRecord) -> bool:
    """Return True if the log of a failed step of a run contains no message."""
    return any(_message(root / job.log) == _KILLED for job in run.failed if job.log)


_KILLED = "a step exited without a message: the step was killed, possibly out of memory, or its machine failed"
_NO_EXECUTOR = re.compile(r"argument --executor/-e: invalid choice: '([\w-]+)'")


def _installable(line: str) -> str:
    """Return an error of Snakemake's command line, with installation instructions for a missing executor.

    Examples
    --------
    >>> _installable("snakemake: error: argument --executor/-e: invalid choice: 'slurm' (choose from 'local')")
    "executor 'slurm' is not installed. Install it with apertura: pip install snakemake-executor-plugin-slurm"
    """
    if not (match := _NO_EXECUTOR.search(line)):
        return line
    plugin = f"snakemake-executor-plugin-{match[1]}"
    return f"executor {match[1]!r} is not installed. Install it with apertura: pip install {plugin}"


def _message(log: Path | None) -> str:
    lines = _tail(log) if log else []
    for line in reversed(lines):
        if line.startswith(_ERROR_PREFIX):
            return shown(line, 2000)
    if any(line.startswith("Traceback") for line in lines):
        return f"internal error, please report this error with the log: {shown(lines[-1], 2000)}"
    return _KILLED


def _tail(log: Path) -> list[str]:
    """Return the last non-empty lines of a log."""
    with suppress(OSError, CampaignError), log.open("rb") as stream:
        stream.seek(max(0, log.stat().st_size - _TAIL))
        return [line for line in stream.read().decode("utf-8", "replace").splitlines() if line.strip()]
    return []
