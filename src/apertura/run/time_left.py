"""Prediction of the time left of a run, from the durations of finished steps and of steps that report their progress.

The cost of rule r predicts a duration of b + w seconds for a job, with start-up b and work w. Given the ratios ρ of
measured to predicted durations in this run, the expected duration of the job is

    ρ_r (b + w)       if a job of the same rule has finished, or reports its progress;
    ρ_p (b + w)       for raster jobs and imaging jobs (sums of pulses at pixels), if such a job was measured;
    ρ_b b + ρ_w w     otherwise, with ρ_b from jobs dominated by start-up and ρ_w from the other jobs.

The third prediction is only displayed for jobs dominated by start-up, w ≤ b, after such jobs of two rules were
measured. Start-up times of jobs are similar, except that the first jobs of a run wait for common imports.

The time left of the run is displayed while jobs without a displayed prediction contribute at most a fifth. If these
jobs took no time, the displayed value would be 1.25 times the true value; if they took six times as long as expected,
the displayed value would be half the true value. The time left of the run is not displayed before an imaging job was
measured, because engine and accuracy change the duration of imaging jobs by up to a factor of a thousand. The time left
is also not displayed for an imaging job that takes 1.5 times as long as expected, because tiles of its image are then
being recomputed. Any other overdue job is expected to continue for the time by which it is overdue.
"""

import json
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from math import ceil
from statistics import fmean, median, median_low

from apertura.campaign.folder import Campaign
from apertura.common.errors import CampaignError, shown
from apertura.common.progress import progress_path
from apertura.run.journal import LAST_S, JobRecord, RunRecord
from apertura.workflow.lineage import places
from apertura.workflow.resources import Resources
from apertura.workflow.rules import RULES, Cost

_MOST_TIMED = 500
_LEAST_S = 0.1
_TELLS = 0.05  # minimum completed fraction of a step (and at least two units) before its pace is used for other jobs
_SURE = 0.8  # minimum fraction of the time left that is due to jobs with a reliable prediction


@dataclass(frozen=True)
class StepProgress:
    """Progress reported by a step: `done` of `total` units; start, and time of the report, seconds since the epoch."""

    what: str
    done: int
    total: int
    since_s: float
    at_s: float

    @classmethod
    def of(cls, campaign: Campaign, job: JobRecord) -> "StepProgress | None":
        """Read the progress report of a job; None if there is no valid report."""
        with suppress(CampaignError, OSError, ValueError, KeyError, TypeError):
            file = json.loads(campaign.result(*progress_path(job.step)).read_text("utf-8"))
            report = cls(shown(file["what"]), int(file["done"]), int(file["total"]), file["since"], file["at"])
            has_valid_times = job.begun_s - 5 <= report.since_s <= report.at_s < LAST_S
            if 0 <= report.done <= report.total and report.total and has_valid_times:
                return report
        return None

    @property
    def tells(self) -> bool:
        """True if enough units are done for a reliable pace, which also includes preparations such as tables."""
        return self.done >= max(_TELLS * self.total, 2)

    @property
    def left_s(self) -> float | None:
        """Time left at the current pace, seconds; None before the first unit is done."""
        passed = self.at_s - self.since_s
        return passed * (self.total - self.done) / self.done if self.done and passed > 0 else None


@dataclass(frozen=True)
class Measure:
    """Ratios of measured to predicted durations of jobs.

    Attributes
    ----------
    of_rule
        Rule → ratio, for rules with measured jobs.
    of_rasters, of_imaging
        Ratio for raster jobs, and for imaging jobs (sums of pulses at pixels); None if no such job was measured.
    of_start, of_work
        Ratio for the start-up of jobs, and for their work; None if no job was measured.
    starts
        True if jobs of at least two rules dominated by start-up were measured.
    """

    of_rule: dict[str, float]
    of_rasters: float | None
    of_imaging: float | None
    of_start: float | None
    of_work: float | None
    starts: bool

    @classmethod
    def of(cls, timed: Sequence[tuple[str, float, float, float]]) -> "Measure":
        """Compute the ratios from jobs: rule, measured duration, predicted durations of start-up and work, seconds."""
        ratios: dict[str, list[float]] = defaultdict(list)
        grows: dict[str, list[bool]] = defaultdict(list)
        for rule, seconds, start_s, work_s in timed:
            ratios[rule].append(seconds / (start_s + work_s))
            grows[rule].append(work_s > start_s)
        of_rule = {rule: median(values) for rule, values in ratios.items()}
        starts = [ratio for rule, ratio in of_rule.items() if not any(grows[rule])]
        works = [ratio for rule, ratio in of_rule.items() if any(grows[rule])]
        rasters = [ratio for rule, ratio in of_rule.items() if _cost(rule).of_rasters]
        imaging = [ratio for rule, ratio in of_rule.items() if _cost(rule).of_imaging]
        every = median_low(of_rule.values()) if timed else None
        return cls(
            of_rule,
            median(rasters) if rasters else None,
            median(imaging) if imaging else None,
            median_low(starts) if starts else every,
            median_low(works) if works else every,
            len(starts) > 1,
        )

    def seconds(self, rule: str, start_s: float, work_s: float) -> tuple[float, bool]:
        """Return the expected duration of a job, seconds, and True if this value is reliable."""
        if rule in self.of_rule:
            return self.of_rule[rule] * (start_s + work_s), True
        cost = _cost(rule)
        alike = self.of_rasters if cost.of_rasters else self.of_imaging if cost.of_imaging else None
        if alike is not None:
            return alike * (start_s + work_s), True
        if self.of_start is None or self.of_work is None:
            return start_s + work_s, False
        return self.of_start * start_s + self.of_work * work_s, self.starts and work_s <= start_s


class TimeLeft:
    """Prediction of the time left of a run.

    Parameters
    ----------
    campaign
        The campaign.
    cores
        Number of cores; 0 on a cluster, where the number of running jobs is used instead.
    """

    def __init__(self, campaign: Campaign, cores: int) -> None:
        self._campaign, self._cores = campaign, cores
        sizes = Resources(campaign)
        self._expected = cache(lambda rule, where: sizes.expected_seconds(rule, *where))

    def _expects(self, run: RunRecord, rule: str, where: tuple[str, ...]) -> tuple[float, float]:
        """Return the predicted start-up and work of a job, seconds; the work of a pair may be divided among jobs."""
        shared = rule in RULES and RULES[rule].shares
        shares = max(run.planned.get(rule, 0) / max(len(self._places(rule)), 1) if shared else 1.0, 1.0)
        start_s = _cost(rule).begin_s
        return start_s, (self._expected(rule, where[:2]) - start_s) / shares

    def left(
        self, run: RunRecord, now_s: float, progress: dict[int, StepProgress | None]
    ) -> tuple[dict[int, float | None], float | None]:
        """Return job number → time left of the job, and the time left of the run, seconds; None if unknown.

        Parameters
        ----------
        run
            State of the run.
        now_s
            Current time, seconds since the epoch.
        progress
            Job number → progress report of the job.
        """
        running = {number: job for number, job in run.jobs.items() if job.running}
        paced = {number: report.left_s for number in running if (report := progress.get(number))}
        timed = [(job, max(job.seconds(), _LEAST_S)) for job in run.finished[-_MOST_TIMED:]]
        for number, left_s in paced.items():
            report = progress[number]
            if left_s is not None and report and report.tells:
                timed.append((running[number], running[number].seconds(report.at_s) + left_s))
        measure = Measure.of([(job.rule, took, *self._expects(run, job.rule, job.step[1:])) for job, took in timed])
        left: dict[int, tuple[float, bool]] = {}
        for number, job in running.items():
            whole, sure = measure.seconds(job.rule, *self._expects(run, job.rule, job.step[1:]))
            pace, report = paced.get(number), progress.get(number)
            early = job.rule in measure.of_rule and report and not report.tells
            if pace is None or early:
                over_s = job.seconds(now_s) - whole
                # Tiles that do not meet the accuracy are recomputed with a finer setting, which takes an unknown time.
                left[number] = abs(over_s), sure and not (_cost(job.rule).of_imaging and over_s > whole / 2)
            else:
                left[number] = pace, True
        waiting: dict[str, tuple[float, bool]] = {}
        for rule in run.waiting:
            each = [measure.seconds(rule, *self._expects(run, rule, where)) for where in self._places(rule)]
            waiting[rule] = fmean(seconds for seconds, _ in each), all(sure for _, sure in each)
        whole, sure_s = (self._sum(run, left, waiting, all_of_it=all_of_it) for all_of_it in (True, False))
        of_jobs = {number: seconds if sure else None for number, (seconds, sure) in left.items()}
        unfinished = {*run.waiting, *(job.rule for job in running.values())}
        guessed = measure.of_imaging is None and any(_cost(rule).of_imaging for rule in unfinished)
        known = measure.of_rule and sure_s >= _SURE * whole and not guessed
        return of_jobs, whole if known else None

    def _sum(
        self,
        run: RunRecord,
        left: dict[int, tuple[float, bool]],
        waiting: dict[str, tuple[float, bool]],
        *,
        all_of_it: bool,
    ) -> float:
        """Return the larger of total work divided by the number of cores and duration of the critical path, seconds."""
        running = [seconds for seconds, sure in left.values() if sure or all_of_it]
        at_once = self._cores or max(1, len(left))
        work, chain = sum(running) / at_once, max(running, default=0.0)
        for rule, (each, sure) in waiting.items():
            if sure or all_of_it:
                concurrent = 1 if _cost(rule).all_cores and self._cores else at_once
                work += ceil(run.waiting[rule] / concurrent) * each
                chain += 0.0 if _cost(rule).last else each
        return max(work, chain)

    @cache  # noqa: B019 - one instance per run
    def _places(self, rule: str) -> Sequence[tuple[str, ...]]:
        """Return the flights, pairs or nodes processed by the jobs of a rule; one empty entry if there are none."""
        return (places(self._campaign, RULES[rule]) if rule in RULES else []) or [()]


def _cost(rule: str) -> Cost:
    return RULES[rule].cost if rule in RULES else Cost()
