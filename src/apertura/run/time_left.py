"""How long what is left of a run will take, by the steps of this run that were timed; nothing where these say nothing.

A job of rule r takes b + w seconds by the cost of its rule: its start and what grows with its work. With ratios ρ of
what was timed in this run to that, it is expected to take

    ρ_r (b + w)       where a job of its rule has ended, or tells how far it is;
    ρ_p (b + w)       of rasters, or of sums of pulses over pixels, where those of another rule have: they are alike;
    ρ_b b + ρ_w w     elsewhere: ρ_b by jobs that are mostly start, ρ_w by the others.

The last is only told of a job that is mostly start, w ≤ b, when such jobs of two rules were timed: starts are alike,
but the first of a run wait for what all of them import. A sum over a run is told while no more than a fifth of it is of
jobs of which that is not: where these take nothing it is 1.25 times the truth, where six times as much, half of it.
Nothing is told of it before one that sums pulses over pixels was timed: engine and accuracy change that a thousandfold;
nor is one told that takes half as long again as expected: its tiles are formed again. Another job that does runs on for
as long again as it is over.
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
_TELLS = 0.05  # of its work that a step has done, and two parts of it, before its pace is taken for others
_SURE = 0.8


@dataclass(frozen=True)
class StepProgress:
    """How far a step says it is: `done` of `total` since an instant, seconds since the epoch."""

    what: str
    done: int
    total: int
    since_s: float
    at_s: float

    @classmethod
    def of(cls, campaign: Campaign, job: JobRecord) -> "StepProgress | None":
        """Return what a job tells; None if nothing."""
        with suppress(CampaignError, OSError, ValueError, KeyError, TypeError):
            said = json.loads(campaign.result(*progress_path(job.step)).read_text("utf-8"))
            told = cls(shown(said["what"]), int(said["done"]), int(said["total"]), said["since"], said["at"])
            if 0 <= told.done <= told.total and told.total and job.begun_s - 5 <= told.since_s <= told.at_s < LAST_S:
                return told
        return None

    @property
    def tells(self) -> bool:
        """Whether enough is done for a pace: what comes before the first part, tables, is in that of few."""
        return self.done >= max(_TELLS * self.total, 2)

    @property
    def left_s(self) -> float | None:
        """Seconds that the rest takes at the pace so far; None before there is one."""
        passed = self.at_s - self.since_s
        return passed * (self.total - self.done) / self.done if self.done and passed > 0 else None


@dataclass(frozen=True)
class Measure:
    """What jobs take, in the measure of what was timed.

    Attributes
    ----------
    of_rule
        Rule → how much longer than expected its jobs take, of those that were timed.
    of_rasters, of_imaging
        The same of any job of rasters, and of any that sums pulses over pixels; None where none was timed.
    of_start, of_work
        The same of the start of any job, and of what grows with its work; None where nothing was timed.
    starts
        Whether jobs of two rules were timed that are mostly start.
    """

    of_rule: dict[str, float]
    of_rasters: float | None
    of_imaging: float | None
    of_start: float | None
    of_work: float | None
    starts: bool

    @classmethod
    def of(cls, timed: Sequence[tuple[str, float, float, float]]) -> "Measure":
        """Return that of jobs: rule, seconds, and the seconds expected for its start and for its work."""
        ratios: dict[str, list[float]] = defaultdict(list)
        grows: dict[str, list[bool]] = defaultdict(list)
        for rule, seconds, start_s, work_s in timed:
            ratios[rule].append(seconds / (start_s + work_s))
            grows[rule].append(work_s > start_s)
        of_rule = {rule: median(found) for rule, found in ratios.items()}
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
        """Return what a job is expected to take, and whether that is to be told."""
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
    """How long the steps of a run will take, as far as it can be told.

    Parameters
    ----------
    campaign
        The campaign.
    cores
        How many jobs run at once; 0: as many as do, on machines of a cluster.
    """

    def __init__(self, campaign: Campaign, cores: int) -> None:
        self._campaign, self._cores = campaign, cores
        sizes = Resources(campaign)
        self._expected = cache(lambda rule, where: sizes.expected_seconds(rule, *where))

    def _expects(self, run: RunRecord, rule: str, where: tuple[str, ...]) -> tuple[float, float]:
        """Return the seconds of a job's start and work by the cost of its rule; tiles of a pair may be work of many."""
        shared = rule in RULES and RULES[rule].shares
        shares = max(run.planned.get(rule, 0) / max(len(self._places(rule)), 1) if shared else 1.0, 1.0)
        start_s = _cost(rule).begin_s
        return start_s, (self._expected(rule, where[:2]) - start_s) / shares

    def left(
        self, run: RunRecord, now_s: float, told: dict[int, StepProgress | None]
    ) -> tuple[dict[int, float | None], float | None]:
        """Return number of a job → seconds that it will still run, and the seconds until all is done; None: unknown.

        Parameters
        ----------
        run
            So far.
        now_s
            Seconds since the epoch.
        told
            Number of a job → what it tells.
        """
        under_way = {number: job for number, job in run.jobs.items() if job.running}
        paced = {number: report.left_s for number in under_way if (report := told.get(number))}
        timed = [(job, max(job.seconds(), _LEAST_S)) for job in run.finished[-_MOST_TIMED:]]
        for number, left_s in paced.items():
            report = told[number]
            if left_s is not None and report and report.tells:
                timed.append((under_way[number], under_way[number].seconds(report.at_s) + left_s))
        measure = Measure.of([(job.rule, took, *self._expects(run, job.rule, job.step[1:])) for job, took in timed])
        left: dict[int, tuple[float, bool]] = {}
        for number, job in under_way.items():
            whole, sure = measure.seconds(job.rule, *self._expects(run, job.rule, job.step[1:]))
            pace, report = paced.get(number), told.get(number)
            early = job.rule in measure.of_rule and report and not report.tells
            if pace is None or early:
                over_s = job.seconds(now_s) - whole
                # Tiles that missed the accuracy are formed again by a finer setting: in a time that nobody knows.
                left[number] = abs(over_s), sure and not (_cost(job.rule).of_imaging and over_s > whole / 2)
            else:
                left[number] = pace, True
        waiting: dict[str, tuple[float, bool]] = {}
        for rule in run.waiting:
            each = [measure.seconds(rule, *self._expects(run, rule, where)) for where in self._places(rule)]
            waiting[rule] = fmean(seconds for seconds, _ in each), all(sure for _, sure in each)
        whole, sure_s = (self._sum(run, left, waiting, all_of_it=all_of_it) for all_of_it in (True, False))
        of_jobs = {number: seconds if sure else None for number, (seconds, sure) in left.items()}
        to_come = {*run.waiting, *(job.rule for job in under_way.values())}
        guessed = measure.of_imaging is None and any(_cost(rule).of_imaging for rule in to_come)
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
        """Return the seconds of all work over all cores, and no less than those of one step after the other."""
        running = [seconds for seconds, sure in left.values() if sure or all_of_it]
        at_once = self._cores or max(1, len(left))
        work, chain = sum(running) / at_once, max(running, default=0.0)
        for rule, (each, sure) in waiting.items():
            if sure or all_of_it:
                turns = 1 if _cost(rule).all_cores and self._cores else at_once
                work += ceil(run.waiting[rule] / turns) * each
                chain += 0.0 if _cost(rule).last else each
        return max(work, chain)

    @cache  # noqa: B019 - one per run
    def _places(self, rule: str) -> Sequence[tuple[str, ...]]:
        """Return what the jobs of a rule run on; nothing of one that the campaign does not have."""
        return (places(self._campaign, RULES[rule]) if rule in RULES else []) or [()]


def _cost(rule: str) -> Cost:
    return RULES[rule].cost if rule in RULES else Cost()
