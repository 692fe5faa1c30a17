"""How long what is left of a run will take: by the cost of each rule, in the measure of what has been timed."""

import csv
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import islice
from pathlib import Path
from statistics import fmean, median

from apertura.common.errors import CampaignError, shown
from apertura.common.progress import progress_path
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.lineage import places
from apertura.pipeline.resources import Resources
from apertura.pipeline.rules import RULES, Cost
from apertura.pipeline.runs.journal import LAST_S, JobRecord, RunRecord

_MOST_BENCHMARKS = 500
_LONGEST_S = 1e8
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, StopIteration, csv.Error)


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
    def left_s(self) -> float | None:
        """Seconds that the rest takes at the pace so far; None before there is one."""
        passed = self.at_s - self.since_s
        return passed * (self.total - self.done) / self.done if self.done and passed > 0 else None


class Outlook:
    """How long steps will take, by their cost and by what has been timed: in this run, or else in runs before it.

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

    def _expects(self, run: RunRecord, rule: str, where: tuple[str, ...]) -> float:
        """Return the seconds of a job before anything was timed; the tiles of a pair may be the work of many."""
        shared = rule in RULES and RULES[rule].shares
        shares = run.planned.get(rule, 0) / max(len(self._places(rule)), 1) if shared else 1.0
        return self._expected(rule, where[:2]) / max(shares, 1.0)

    @cached_property
    def _before(self) -> dict[str, list[float]]:
        """Rule → how much longer than expected each of its jobs took, by the benchmarks of earlier runs."""
        ratios = defaultdict(list)
        for rule, where, seconds in islice(_benchmarks(self._campaign.results / "benchmarks"), _MOST_BENCHMARKS):
            ratios[rule].append(seconds / self._expected(rule, where))
        return ratios

    def _ratios(self, run: RunRecord) -> dict[str, float]:
        """Return rule → how much longer than expected its jobs take; the rule '' stands for all others."""
        now: dict[str, list[float]] = defaultdict(list)
        for job in run.finished[-_MOST_BENCHMARKS:]:
            now[job.rule].append(max(job.seconds(), 0.1) / self._expects(run, job.rule, job.step[1:]))
        known = {rule: median(ratios) for rule, ratios in {**self._before, **now}.items()}
        return {**known, "": median(known.values()) if known else 1.0}

    def of_jobs(self, run: RunRecord, now_s: float, told: dict[int, StepProgress | None]) -> dict[int, float]:
        """Return number of a job → seconds that it will still run, of those that do."""
        ratios, left = self._ratios(run), {}
        for number, job in run.jobs.items():
            if job.running:
                report = told.get(number)
                paced = report.left_s if report else None
                whole = self._expects(run, job.rule, job.step[1:]) * ratios.get(job.rule, ratios[""])
                left[number] = max(whole - job.seconds(now_s), 0.0) if paced is None else paced
        return left

    def of_run(self, run: RunRecord, running: dict[int, float]) -> float:
        """Return the seconds until all is done: all work over all cores, and no less than one step after the other."""
        ratios = self._ratios(run)
        waiting = {
            rule: (
                count,
                fmean(self._expects(run, rule, where) for where in self._places(rule)) * ratios.get(rule, ratios[""]),
            )
            for rule, count in run.waiting.items()
        }
        at_once = self._cores or max(1, len(running))
        work = sum(running.values()) / at_once
        for rule, (count, each) in waiting.items():
            work += count * each / (1 if _cost(rule).all_cores and self._cores else at_once)
        chain = max(running.values(), default=0.0) + sum(
            each for rule, (_, each) in waiting.items() if not _cost(rule).last
        )
        return max(work, chain)

    @cache  # noqa: B019 - one per run
    def _places(self, rule: str) -> Sequence[tuple[str, ...]]:
        """Return what the jobs of a rule run on; nothing of one that the campaign does not have."""
        return (places(self._campaign, RULES[rule]) if rule in RULES else []) or [()]


def _cost(rule: str) -> Cost:
    return RULES[rule].cost if rule in RULES else Cost()


def _benchmarks(folder: Path) -> Iterator[tuple[str, tuple[str, ...], float]]:
    """Yield rule, what it ran on, and the seconds it took, of each benchmark that snakemake has left."""
    for path in folder.rglob("*.tsv"):
        of, _, rule = path.stem.rpartition(".")
        place = (*path.parent.relative_to(folder).parts, *([of] if of else []))
        folders = RULES[rule].folder.split("/") if rule in RULES else ()
        where = tuple(word for named, word in zip(folders, place, strict=False) if named.startswith("{"))
        with suppress(*_UNREADABLE), path.open(encoding="utf-8") as table:
            seconds = float(next(csv.DictReader(table, delimiter="\t"))["s"])
            if rule in RULES and not RULES[rule].shares and 0 < seconds < _LONGEST_S:
                yield rule, where, seconds
