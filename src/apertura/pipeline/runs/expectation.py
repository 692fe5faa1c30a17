"""How long what is left of a run will take: a cost for each step, in the measure of what has been timed."""

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
from typing import NamedTuple

from apertura.common.errors import CampaignError, shown
from apertura.common.progress import progress_path
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.runs.journal import LAST_S, Job, Run


class _Cost(NamedTuple):
    """Seconds: to begin, per MB recorded, per million pixels, and per both."""

    begin: float = 1.5
    mb: float = 0.0
    mpx: float = 0.0
    mb_mpx: float = 0.0


_COSTS = {
    "ingest": _Cost(1.3, mb=0.01),
    "echo": _Cost(2.8, mb=0.02),
    "profile": _Cost(1.8, mb=0.01),
    "refine": _Cost(2.5, mb=0.02, mpx=0.5),
    "image": _Cost(3.5, mpx=2.0, mb_mpx=0.06),
    "tiles": _Cost(3.0, mb_mpx=0.06),
    "layers": _Cost(1.4, mpx=0.5),
    "assess": _Cost(1.3, mpx=0.5),
    "cube": _Cost(2.5, mpx=1.0),
    "cphd": _Cost(2.0, mb=0.02),
    "interferogram": _Cost(3.0, mpx=20.0),
    "export": _Cost(3.0, mpx=1.0),
    "export_fused": _Cost(3.0, mpx=2.0),
    "pictures": _Cost(5.0, mb=0.01),
    "page": _Cost(2.5, mpx=0.5),
}
"""Rule → what it costs, on two cores of 2023; only its form counts once a step has been timed."""

_WIDE = frozenset({"image", "tiles"})
"""Rules whose jobs take all cores."""
_BESIDE = frozenset({"cphd", "interferogram", "layers", "export", "map", "pictures", "scene"})
"""Rules that no other waits for, or hardly."""
_MOST_BENCHMARKS = 500
_USUAL_MPX = 0.25
_LONGEST_S = 1e8
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, StopIteration, csv.Error)


def expected_seconds(campaign: Campaign, rule: str, *where: str) -> float:
    """Return what a step is expected to take, seconds.

    Parameters
    ----------
    campaign
        Its recordings and grid say how much there is to do.
    rule
        The rule's name.
    *where
        Flight and node, flight and pair, or flight; nothing for the whole campaign.
    """
    cost = _COSTS.get(rule, _Cost())
    mb = _megabytes(campaign, *where[:2]) if cost.mb or cost.mb_mpx else 0.0
    mpx = _megapixels(campaign) if cost.mpx or cost.mb_mpx else 0.0
    return cost.begin + cost.mb * mb + cost.mpx * mpx + cost.mb_mpx * mb * mpx


def _megabytes(campaign: Campaign, flight: str = "", of: str = "") -> float:
    """Return how much was recorded of a node, or by the nodes of a pair; 0 of what the campaign does not have."""
    flown = {each.name for each in campaign.flights} & {flight}
    nodes = campaign.settings.nodes.keys() & set(of.split("-"))
    files = [path for name in flown for node in nodes for path in campaign.flight_folder(name).glob(f"{node}.*")]
    return sum(path.stat().st_size for path in files) / 1e6


def _megapixels(campaign: Campaign) -> float:
    """Return the size of the grid, where it is settled or the config tells it."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        rows, columns = json.loads((campaign.results / "scene.json").read_text("utf-8"))["grid"]["shape"]
        return float(rows * columns / 1e6)
    scene = campaign.settings.scene
    if scene.bounds_m == "auto" or scene.spacing_m == "auto":
        return _USUAL_MPX
    west, south, east, north = scene.bounds_m
    return (east - west) * (north - south) / scene.spacing_m**2 / 1e6


@dataclass(frozen=True)
class Told:
    """How far a step says it is: `done` of `total` since an instant, seconds since the epoch."""

    what: str
    done: int
    total: int
    since_s: float
    at_s: float

    @classmethod
    def by(cls, campaign: Campaign, job: Job) -> "Told | None":
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
        self._expected = cache(lambda rule, where: expected_seconds(campaign, rule, *where))

    def _expects(self, run: Run, rule: str, where: tuple[str, ...]) -> float:
        """Return the seconds of a job before anything was timed; the tiles of a pair may be the work of many."""
        shares = run.planned.get(rule, 0) / max(len(self._places(rule)), 1) if rule == "tiles" else 1.0
        return self._expected(rule, where[:2]) / max(shares, 1.0)

    @cached_property
    def _before(self) -> dict[str, list[float]]:
        """Rule → how much longer than expected each of its jobs took, by the benchmarks of earlier runs."""
        ratios = defaultdict(list)
        for rule, where, seconds in islice(_benchmarks(self._campaign.results / "benchmarks"), _MOST_BENCHMARKS):
            ratios[rule].append(seconds / self._expected(rule, where))
        return ratios

    def _ratios(self, run: Run) -> dict[str, float]:
        """Return rule → how much longer than expected its jobs take; the rule '' stands for all others."""
        now: dict[str, list[float]] = defaultdict(list)
        for job in run.finished[-_MOST_BENCHMARKS:]:
            now[job.rule].append(max(job.seconds(), 0.1) / self._expects(run, job.rule, job.step[1:]))
        known = {rule: median(ratios) for rule, ratios in {**self._before, **now}.items()}
        return {**known, "": median(known.values()) if known else 1.0}

    def of_jobs(self, run: Run, now_s: float, told: dict[int, Told | None]) -> dict[int, float]:
        """Return number of a job → seconds that it will still run, of those that do."""
        ratios, left = self._ratios(run), {}
        for number, job in run.jobs.items():
            if job.running:
                report = told.get(number)
                paced = report.left_s if report else None
                whole = self._expects(run, job.rule, job.step[1:]) * ratios.get(job.rule, ratios[""])
                left[number] = max(whole - job.seconds(now_s), 0.0) if paced is None else paced
        return left

    def of_run(self, run: Run, running: dict[int, float]) -> float:
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
        work += sum(
            count * each / (1 if rule in _WIDE and self._cores else at_once) for rule, (count, each) in waiting.items()
        )
        chain = max(running.values(), default=0.0) + sum(
            each for rule, (_, each) in waiting.items() if rule not in _BESIDE
        )
        return max(work, chain)

    @cache  # noqa: B019 - one per run
    def _places(self, rule: str) -> Sequence[tuple[str, ...]]:
        """Return where a rule has jobs: flight and node, flight and pair, flight, or nothing."""
        flights = self._campaign.flights
        if rule == "ingest":
            return [(flight.name, node) for flight in flights for node in flight.participants]
        if rule in {"echo", "profile", "image", "tiles", "export", "pictures"}:
            return [(flight.name, pair) for flight in flights for pair in flight.pairs]
        if rule in {"assess", "calibrate", "export_fused", "page", "refine"}:
            return [(flight.name,) for flight in flights]
        return [()]


def _benchmarks(folder: Path) -> Iterator[tuple[str, tuple[str, ...], float]]:
    """Yield rule, where, and the seconds it took, of each benchmark that snakemake has left."""
    for path in folder.rglob("*.tsv"):
        of, _, rule = path.stem.rpartition(".")
        where = (*path.parent.relative_to(folder).parts, *([of] if of else []))
        with suppress(*_UNREADABLE), path.open(encoding="utf-8") as table:
            seconds = float(next(csv.DictReader(table, delimiter="\t"))["s"])
            if rule != "tiles" and 0 < seconds < _LONGEST_S:  # nobody knows of how many shares tiles were
                yield ("export_fused" if of == "fused" else rule), where, seconds
