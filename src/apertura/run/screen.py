"""Console output of a run and of `apertura status`: lines for finished steps, and progress bars for running steps."""

import sys
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TextIO

from apertura.campaign.folder import Campaign
from apertura.common.errors import number_of, shown
from apertura.common.processes import INTERRUPTED, holder
from apertura.common.progress import RUN
from apertura.run.journal import JobRecord, JournalReader, RunRecord, failures
from apertura.run.results import counted, states
from apertura.run.time_left import StepProgress, TimeLeft

if TYPE_CHECKING:
    from rich.table import Table

UNKNOWN = "time left unknown"
NOTHING = "Nothing to be done: all results are up to date."

_MOST_BARS = 12
_MARGIN = 3  # number of empty columns at the end of a line, in which the terminal may print ^C


def span(seconds: float) -> str:
    """Format a duration.

    Examples
    --------
    >>> span(0.24), span(8.3), span(75), span(4000), span(90000)
    ('0.2 s', '8.3 s', '1 min 15 s', '1 h 06 min', '25 h 00 min')
    """
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    return f"{whole // 60} min {whole % 60:02} s" if whole < 3600 else f"{whole // 3600} h {whole % 3600 // 60:02} min"


def about(seconds: float) -> str:
    """Format a predicted duration with few significant digits.

    Examples
    --------
    >>> about(0.3), about(44), about(100), about(3000), about(9000)
    ('1 s', '45 s', '2 min', '50 min', '2.5 h')
    """
    if seconds < 10:
        return f"{max(1, round(seconds))} s"
    if seconds < 90:
        return f"{5 * round(seconds / 5)} s"
    return f"{round(seconds / 60)} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


@dataclass(frozen=True)
class Bar:
    """Progress bar: name, progress as text, completed fraction, and time left in seconds (None if unknown)."""

    name: str
    counts: str
    fraction: float
    left_s: float | None

    @property
    def left(self) -> str:
        """Time left, as text."""
        return UNKNOWN if self.left_s is None else f"about {about(self.left_s)} left"


def bars(campaign: Campaign, run: RunRecord, time_left: TimeLeft) -> list[Bar]:
    """Return a progress bar for each running job, in the order of their start, and a final bar for the whole run."""
    now_s = time.time()
    progress = {number: StepProgress.of(campaign, job) for number, job in list(_running(run).items())[:_MOST_BARS]}
    left, whole_s = time_left.left(run, now_s, progress)
    steps = [_bar(job, progress.get(number), left[number], now_s) for number, job in _running(run).items()]
    done = len(run.finished) + sum(bar.fraction for bar in steps)
    whole = Bar(f"{len(run.finished)} of {run.total} steps", "", done / max(run.total, 1), whole_s)
    return [*steps, whole]


def _running(run: RunRecord) -> dict[int, JobRecord]:
    return {number: job for number, job in run.jobs.items() if job.running}


def _bar(job: JobRecord, progress: StepProgress | None, left_s: float | None, now_s: float) -> Bar:
    if progress:
        counts = f"{progress.done} of {progress.total} {progress.what}"
        return Bar(job.name, counts, progress.done / progress.total, left_s)
    passed = max(job.seconds(now_s), 0.0)
    return Bar(job.name, "", 0.0 if left_s is None else min(passed / max(passed + left_s, 0.1), 0.95), left_s)


def table(rows: list[Bar]) -> "Table":
    """Return progress bars as a table that is as wide as the terminal."""
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    grid = Table.grid(expand=True, padding=(0, 2, 0, 0))
    grid.add_column(no_wrap=True, overflow="ellipsis", max_width=40)
    grid.add_column(ratio=1, min_width=8)
    grid.add_column(no_wrap=True, justify="right")
    grid.add_column(no_wrap=True, justify="right", min_width=len(UNKNOWN))
    *steps, whole = rows
    for row in steps[:_MOST_BARS]:
        grid.add_row(Text(f"{'':9}{row.name}"), ProgressBar(1.0, row.fraction), Text(row.counts), Text(row.left))
    if len(steps) > _MOST_BARS:
        grid.add_row(Text(f"{'':9}and {len(steps) - _MOST_BARS} more", style="dim"))
    grid.add_row(Text(whole.name, style="bold"), ProgressBar(1.0, whole.fraction), "", Text(whole.left, style="bold"))
    return grid


class Screen:
    """Progress display of a run; the context manager restores the terminal on exit, also after an error.

    Parameters
    ----------
    campaign, time_left
        Campaign of the run, and prediction of the time left.
    quiet
        Print nothing.
    stream
        Output stream; progress bars are displayed on a terminal, and plain lines are written otherwise.
    """

    def __init__(
        self, campaign: Campaign, time_left: TimeLeft, *, quiet: bool = False, stream: TextIO | None = None
    ) -> None:
        from rich.console import Console
        from rich.live import Live

        self._campaign, self._time_left, self._quiet = campaign, time_left, quiet
        self._stream = stream or sys.stderr
        self._shown: dict[tuple[int, float], bool] = {}
        console = Console(file=self._stream, highlight=False)
        moving = not quiet and self._stream.isatty() and not console.is_dumb_terminal
        self._live = Live(console=console, auto_refresh=False, transient=True) if moving else None

    def __enter__(self) -> "Screen":
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def update(self, run: RunRecord) -> None:
        """Display new events in chronological order."""
        news: list[tuple[float, bool, JobRecord]] = []  # time, True for the end of a job, job
        for number, job in [] if self._quiet else run.jobs.items():
            end_shown = self._shown.get((number, job.begun_s))  # a restarted job has a new start time
            if end_shown is None:
                news.append((job.begun_s, False, job))
            if not end_shown and not job.running:
                news.append((job.ended_s or 0, True, job))
            self._shown[number, job.begun_s] = not job.running
        news.sort(key=lambda event: event[0])
        ended = [job for _, has_ended, job in news if has_ended]
        whole = bars(self._campaign, run, self._time_left)[-1] if ended and not self._live else None
        done = len(run.finished) - sum(not job.failed for job in ended)
        for _, has_ended, job in news:
            if has_ended:
                done += not job.failed
                self._ended(job, whole, f"{done} of {run.total} steps")
            elif not self._live:
                self._line(f"{_clock(job.begun_s)}  started  {job.name}")
        if self._live:
            from rich.constrain import Constrain

            rows = table(bars(self._campaign, run, self._time_left)) if run.planned else "planning"
            self._live.update(Constrain(rows, self._live.console.width - _MARGIN), refresh=True)

    def ended(self, run: RunRecord) -> None:
        """Print the completion of the run."""
        done = f"{number_of(run.total, 'step')} done in {span((run.ended_s or time.time()) - run.begun_s)}"
        self._line(done if run.planned else NOTHING)

    def _ended(self, job: JobRecord, whole: Bar | None, done: str) -> None:
        word = "failed" if job.failed else "done"
        if self._live:
            self._live.console.print(_line(word, job))
        elif whole:
            left = f", {whole.left}" if not job.failed and whole.fraction < 1 else ""
            self._line(f"{_clock(job.ended_s or 0)}  {word:7}  {job.name}: {span(job.seconds())}; {done}{left}")

    def _line(self, line: str) -> None:
        if not self._quiet:
            print(line, file=self._stream, flush=True)


def _line(word: str, job: JobRecord) -> "Table":
    """Return the line of a finished job for a terminal."""
    from rich.table import Table
    from rich.text import Text

    line = Table.grid(expand=True)
    line.add_column(no_wrap=True, overflow="ellipsis", ratio=1)
    line.add_column(no_wrap=True, justify="right")
    line.add_row(Text.assemble((f"{word:9}", "red" if job.failed else "green"), job.name), span(job.seconds()))
    return line


def listed(counts: Mapping[str, int]) -> str:
    """Format the number of jobs of each rule.

    Examples
    --------
    >>> listed({"ingest": 2, "scene": 1})
    '2 ingest, 1 scene'
    """
    return ", ".join(f"{count} {shown(rule)}" for rule, count in counts.items())


def _clock(at_s: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(at_s))


def print_status(campaign: Campaign) -> None:
    """Print the state of a run in progress (owner, steps, time left), or the outcome of the last run."""
    run = JournalReader(campaign.result(RUN, "journal.jsonl")).news()
    held = holder(campaign.root)
    if held:
        print(f"a run is in progress: {held}")
        if run.planned and run.status is None:
            _print_steps(campaign, run)
        else:
            print("the steps are unknown: the run is being planned, or was not started by `apertura run`")
    else:
        print(_outcome(run))
    if run.status != INTERRUPTED and (run.failed or run.status):
        print(*failures(campaign.root, run, campaign.result("logs", "snakemake.log")), sep="\n")
    if not held:
        print(counted(states(campaign)))


def _print_steps(campaign: Campaign, run: RunRecord) -> None:
    from rich.console import Console

    print(f"done: {listed(Counter(job.rule for job in run.finished)) or 'no step'}")
    rows = bars(campaign, run, TimeLeft(campaign, cores=run.cores))
    console = Console(highlight=False)
    if console.is_terminal:
        console.print(table(rows))
    else:
        for row in rows:
            print(f"{row.name}: {100 * row.fraction:.0f} %{', ' + row.counts if row.counts else ''}, {row.left}")
    if run.waiting:
        print(f"waiting: {listed(run.waiting)}")


def _outcome(run: RunRecord) -> str:
    if not run.begun_s:
        return "no run is in progress, and no earlier run is recorded"
    start = time.strftime("%Y-%m-%d %H:%M", time.localtime(run.begun_s))
    done = (
        f"{len(run.finished)} of {run.total} steps done"
        if run.planned
        else "before any step"
        if run.status
        else NOTHING
    )
    if run.ended_s is None:
        return f"no run is in progress; the last run, started {start}, was killed: {done}. Run again to resume."
    outcome = {0: "succeeded", INTERRUPTED: "was interrupted"}.get(
        run.status or 0, f"failed with exit status {run.status}"
    )
    return (
        f"no run is in progress; the last run, started {start}, {outcome} after "
        f"{span(run.ended_s - run.begun_s)}: {done}"
    )
