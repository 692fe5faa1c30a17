"""`apertura status`: what a run does, told from another terminal; or how the last one ended and what there is."""

import time
from collections import Counter

from apertura.common.processes import INTERRUPTED, holder
from apertura.common.progress import RUN
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.runs.expectation import Outlook
from apertura.pipeline.runs.failure import failures
from apertura.pipeline.runs.inventory import states
from apertura.pipeline.runs.journal import Reader, Run
from apertura.pipeline.runs.screen import NOTHING, bars, listed, span, table


def print_status(campaign: Campaign) -> None:
    """Print whether a run is under way, who holds it, its steps and the time left; or how the last one ended."""
    run = Reader(campaign.result(RUN, "journal.jsonl")).news()
    held = holder(campaign.root)
    if held:
        print(f"a run is under way: {held}")
        if run.planned and run.status is None:
            _print_steps(campaign, run)
        else:
            print("it is planning, or was started without `apertura run`: nothing known of its steps")
    else:
        print(_ended(run))
    if run.status != INTERRUPTED and (run.failed or run.status):
        print(*failures(campaign.root, run, campaign.result("logs", "snakemake.log")), sep="\n")
    if not held:
        counts = Counter[str]()
        for found in states(campaign).values():
            counts.update({state: len(names) for state, names in found.items()})
        print(", ".join(f"{count} results {state}" for state, count in counts.items() if count))


def _print_steps(campaign: Campaign, run: Run) -> None:
    from rich.console import Console

    print(f"done: {listed(Counter(job.rule for job in run.finished)) or 'nothing yet'}")
    rows = bars(campaign, run, Outlook(campaign, cores=run.cores))
    console = Console(highlight=False)
    if console.is_terminal:
        console.print(table(rows))
    else:
        for row in rows:
            print(f"{row.name}: {100 * row.fraction:.0f} %{', ' + row.told if row.told else ''}, {row.left}")
    if run.waiting:
        print(f"to come: {listed(run.waiting)}")


def _ended(run: Run) -> str:
    if not run.begun_s:
        return "no run is under way, and none is remembered"
    begun = time.strftime("%Y-%m-%d %H:%M", time.localtime(run.begun_s))
    done = (
        f"{len(run.finished)} of {run.total} steps done"
        if run.planned
        else "before any step"
        if run.status
        else NOTHING
    )
    if run.ended_s is None:
        return (
            f"no run is under way; the last one, begun {begun}, was killed, {done}. Run again: it goes on where it was."
        )
    how = {0: "ended well", INTERRUPTED: "was interrupted"}.get(run.status or 0, f"failed with {run.status}")
    return f"no run is under way; the last one, begun {begun}, {how} after {span(run.ended_s - run.begun_s)}: {done}"
